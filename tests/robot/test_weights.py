"""Distances with prismatic joints: what a meter counts, in trees, shortcuts, perturbations and lengths of paths."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
from small_arm import write_arm

from apex_ompl import plan
from apex_ompl.apex.models import PerturbationModel
from apex_ompl.collision import CollisionChecker
from apex_ompl.kernel.search import TreePair, shortcut
from apex_ompl.paths.path import Path as JointPath
from apex_ompl.robot import Robot, load_robot
from apex_ompl.robot.model import Limits, weights_of
from apex_ompl.scene.problem import Problem

LONGEST, RESOLUTION = 0.7, 0.031
WALL = {"name": "wall", "box": [0.05, 1.0, 3.0], "position": [0.5, 0.0, 0.5]}


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    """An arm on a base that drives, slowly along x and y."""
    file = write_arm(tmp_path_factory.mktemp("base"))
    planar = "planar: {x: [-1, 2], y: [-1.5, 1.5], velocity: [0.1, 1.0]}"
    file.write_text(file.read_text().replace("urdf: small_arm.urdf}", f"urdf: small_arm.urdf, {planar}}}"))
    return load_robot(file)


def past_the_wall(robot: Robot) -> Problem:
    ends = [dict(zip(robot.joint_names, map(float, (x, *robot.home[1:])), strict=True)) for x in (-0.5, 1.5)]
    file = str(next(path for path in robot.files if path.suffix == ".yaml"))
    return Problem(name="past", robot=file, scene=[WALL], start=ends[0], goal={"joints": [ends[1]]})


def test_a_meter_counts_as_turning_joints_move_meanwhile_and_a_range_as_a_turn_at_most() -> None:
    velocity = np.array([1.0, 3.0, 2.0, 1.0, 0.01, 0.1])
    upper = np.array([3.0, 3.0, 3.0, 0.5, 0.3, 20.0])
    limits = Limits(np.zeros(6), upper, velocity, np.ones(6), np.ones(6))
    turning = np.array([True, True, True, False, False, False])
    assert np.allclose(weights_of(limits, turning), [1.0, 1.0, 1.0, 2.0, 2.0 * math.pi / 0.3, 1.0])
    assert np.allclose(weights_of(limits, np.zeros(6, bool)), [2.0, 2.0 / 3.0, 1.0, 2.0, 2.0 * math.pi / 0.3, 1.0])
    assert (load_robot("panda").weights == 1.0).all()


def test_steps_of_trees_and_shortcuts_are_measured_with_weights(robot: Robot) -> None:
    weights = robot.weights
    assert np.allclose(weights, [*[2.0 * math.pi / 3.0] * 2, 1.0, 1.0, 1.0, 1.0])
    problem = past_the_wall(robot)
    checker = CollisionChecker(robot, problem.scene)
    start, goals = problem.start_state(robot.joint_names)[None], problem.goal_states(robot.joint_names)
    pair = TreePair(checker.kernel, start, goals, LONGEST, RESOLUTION, np.random.default_rng(0))
    path = pair.grow(20_000)
    assert path is not None
    steps = np.diff(path, axis=0)
    along = np.linalg.norm(steps * weights, axis=1)
    assert along.max() <= LONGEST * (1.0 + 1e-12)
    assert along.max() > 0.99 * LONGEST
    assert np.abs(pair._random_states(500)[:, 2]).max() <= math.pi
    short, _ = shortcut(checker.kernel, path, 100, RESOLUTION, np.random.default_rng(0))
    lengths = [JointPath(states, weights=weights).length for states in (path, short)]
    assert lengths[0] == pytest.approx(along.sum()) and lengths[1] < 0.9 * lengths[0]


def test_perturbations_of_joints_that_count_more_are_smaller(robot: Robot) -> None:
    checker, q = CollisionChecker(robot, ()), np.array([0.5, 0.0, *robot.home[2:]])
    query = [SimpleNamespace(start=q, goal=q)]
    found = PerturbationModel().propose(query, checker.kernel, 400, generator=np.random.default_rng(3))  # type: ignore[arg-type]
    spread = np.std(found.control[:, 4:-4], axis=(0, 1)) * robot.weights
    assert np.allclose(spread[:3], spread[2], rtol=0.15)


def test_lengths_of_results_are_weighed(robot: Robot) -> None:
    result = plan(past_the_wall(robot), timeout=20.0)
    assert result.path is not None, result.reason
    assert result.length == pytest.approx(result.path.length)
    steps = np.diff(result.path.states, axis=0) * robot.weights
    assert result.length == pytest.approx(float(np.linalg.norm(steps, axis=1).sum()))
    assert result.length >= 2.0 * robot.weights[0]
