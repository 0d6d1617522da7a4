"""Starts of tasks that are drawn by seed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from physics import library
from planning import cached_problem

from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ParameterError
from apex_ompl.physics.trials import Spread, draw, nominal
from apex_ompl.robot import Robot

library()
DENSITY = 300.0


@pytest.mark.parametrize("name", ["stack_boxes", "pour_upright", "carry_tray"])
def test_starts_are_within_the_spread_and_differ_from_what_the_plan_knows(name: str, robot: Robot) -> None:
    problem, spread = cached_problem(name), Spread()
    arms = [k for k, joint in enumerate(robot.joint_names) if "synergy" not in joint]
    first = problem.start_state(robot.joint_names)
    for seed in range(5):
        trial = draw(robot, problem, seed, spread, DENSITY)
        start = trial.known.start_state(robot.joint_names)
        # on constraints starts are projected, which moves them on
        assert 0.0 < np.abs(start - first)[arms].max() <= spread.joints * (2.0 if name != "stack_boxes" else 1.0)
        assert np.array_equal(np.delete(start, arms), np.delete(first, arms))
        assert np.array_equal(trial.real.start_state(robot.joint_names), start)
        assert CollisionChecker(robot, problem.scene, problem.attached, problem.allowed).is_free(start)
        assert 0.8 <= trial.friction <= 1.2
        real = {held.name: held for held in trial.real.attached}
        for held in trial.known.attached:
            there = robot.link_pose(start, held.link) @ real[held.name].pose
            off = (there - robot.link_pose(start, held.link) @ held.pose)[:3, 3]
            np.testing.assert_allclose(off, trial.off[held.name], atol=1e-12)
            assert np.linalg.norm(off) <= spread.place and (held.links is None) == bool(np.any(off))
            if held.touch_links == ():
                assert off[2] == pytest.approx(0.0, abs=1e-12)
            mass, known = real[held.name].mass, held.mass
            assert mass is not None and known is not None and mass == pytest.approx(trial.masses[held.name] * known)
            assert 0.8 <= mass / known <= 1.2


def test_a_seed_is_one_start_and_without_one_it_is_that_of_the_problem(robot: Robot) -> None:
    problem = cached_problem("pour")
    first, again, other = (draw(robot, problem, seed, Spread(), DENSITY) for seed in (3, 3, 4))
    assert first.known == again.known and first.real == again.real and first.friction == again.friction
    assert other.known != first.known and other.friction != first.friction
    trial = nominal(robot, problem, DENSITY)
    assert trial.known.start == dict(problem.start) and trial.friction == 1.0
    assert trial.real.attached[:2] == trial.known.attached and len(trial.real.attached) == 22  # with the liquid


def test_obstacles_that_are_grasped_later_stand_free(robot: Robot) -> None:
    problem = cached_problem("stack_three_boxes")
    for seed in (None, 3):
        trial = draw(robot, problem, seed, Spread(), DENSITY)
        assert trial.known.scene == problem.scene and not trial.known.attached
        assert [one.name for one in trial.real.scene] == ["lamp"]
        for held in trial.real.attached:
            there = robot.link_pose(robot.random_state(np.random.default_rng(0), 1)[0], held.link) @ held.pose
            off = there - next(one for one in problem.scene if one.name == held.name).pose
            np.testing.assert_allclose(off[:3, 3], trial.off[held.name], atol=1e-9)
            assert np.abs(off[:3, :3]).max() < 1e-7 and abs(off[2, 3]) < 1e-9
            assert np.any(off[:2, 3] > 1e-6) or seed is None or np.any(off[:2, 3] < -1e-6)
            assert held.mass is not None and held.mass > 0.0


@pytest.mark.parametrize(("name", "value"), [("joints", -0.1), ("place", np.nan), ("mass", 1.0), ("friction", np.inf)])
def test_a_spread_that_is_out_of_range_is_refused(name: str, value: float) -> None:
    with pytest.raises(ParameterError, match=name):
        replace(Spread(), **{name: value})
