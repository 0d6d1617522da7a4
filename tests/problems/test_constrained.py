"""Levels with constraints: drawn by seed alone; starts and goals on the constraint, by Pinocchio, and clear."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pinocchio as pin
import pytest

from apex_ompl import problems
from apex_ompl.collision import CollisionChecker
from apex_ompl.constraints.constraint_set import ConstraintSet
from apex_ompl.errors import ParameterError, UnknownNameError
from apex_ompl.ompl.validity import full_check
from apex_ompl.problems import constrained, frozen
from apex_ompl.problems.broad_tasks import Held
from apex_ompl.problems.catalogue import CONSTRAINED, ProblemId, first_drawn, levels_of
from apex_ompl.problems.constrained_ends import line_is_free
from apex_ompl.problems.constrained_held import CUP_ANGLE, LEVEL_ANGLE, SYNERGY, TraySize, carried_tray
from apex_ompl.problems.frozen import digest
from apex_ompl.robot import Robot
from apex_ompl.scene.problem import Problem
from apex_ompl.training.units import plan_units
from apex_ompl.types import Array

LEVELS = [(suite, level) for suite, levels in CONSTRAINED.items() for level in levels]
UNFROZEN = 800_500
ON = 1e-5  # how well the ends keep their constraint [m, rad]


def name_of(suite: str, level: str, seed: int) -> str:
    return f"{suite}/{level}/{UNFROZEN + seed}"


def ends(problem: Problem, robot: Robot) -> Array:
    return np.stack([problem.start_state(robot.joint_names), problem.goal_states(robot.joint_names)[0]])


def palms(robot: Robot, q: Array) -> list[Array]:
    """Poses of the left and the right palm, by Pinocchio."""
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, robot.to_pinocchio(q))
    links = (robot.link_frame(hand.palm) for hand in robot.hands.values())
    return [np.array(data.oMf[number].homogeneous) for number in links]


def axis_angle(first: Array, second: Array) -> float:
    return float(np.arctan2(np.linalg.norm(np.cross(first, second)), first @ second))


@pytest.mark.parametrize(("suite", "level"), LEVELS)
def test_starts_and_goals_keep_the_constraint_and_a_centimeter(robot: Robot, suite: str, level: str) -> None:
    for seed in range(2):
        problem = problems.load(name_of(suite, level, seed))
        states = ends(problem, robot)
        (left, right), (left_goal, right_goal) = (palms(robot, q) for q in states)
        if level == "cups":
            assert [(c.kind, c.frame, c.angle) for c in problem.constraints] == [
                ("upright", "left_cup", CUP_ANGLE), ("upright", "right_cup", CUP_ANGLE),
            ]  # fmt: skip
            assert [body.name for body in problem.attached] == ["left_cup", "right_cup"]
            for at_start, at_goal, body in ((left, left_goal, 0), (right, right_goal, 1)):
                for palm in (at_start, at_goal):
                    up = palm[:3, :3] @ problem.attached[body].pose[:3, 2]
                    assert axis_angle(up, np.array([0.0, 0.0, 1.0])) < min(ON, CUP_ANGLE)
        else:
            moved = np.linalg.inv(np.linalg.inv(left) @ right) @ np.linalg.inv(left_goal) @ right_goal
            assert np.linalg.norm(moved[:3, 3]) < ON and np.linalg.norm(pin.log3(moved[:3, :3])) < ON
            tray = problem.attached[0]
            tilts = [axis_angle((p @ tray.pose)[:3, 2], np.array([0.0, 0.0, 1.0])) for p in (left, left_goal)]
            assert tray.links == tuple(hand.palm for hand in robot.hands.values())
            assert [(c.frame, c.angle) for c in problem.constraints] == [("tray", LEVEL_ANGLE)] * (level == "level")
            assert tray.name == "tray" and (level != "level" or max(tilts) < min(ON, LEVEL_ANGLE))
            assert [body.name for body in problem.attached[1:]] == ["cargo"] * (level == "level")
        checker = CollisionChecker(robot, problem.scene, problem.attached, proofs=False)
        for q in states:
            assert robot.limit_fault(q) is None and checker.is_free(q) and checker.clearance(q) >= 0.01
        assert np.array_equal(*states[:, robot.groups["hands"]])
        assert np.abs(states[1] - states[0]).max() >= constrained.LEAST_MOTION


@pytest.mark.parametrize("level", ["tray", "level", "cups"])
def test_the_same_seed_gives_the_same_problem(level: str) -> None:
    names = [name_of(suite, level, 1) for suite in CONSTRAINED]
    first = [problems.load(name) for name in names]
    assert len({digest(one.model_copy(update={"name": "any"})) for one in first}) == len(names)
    assert [problems.load(name) for name in names[::-1]] == first[::-1]
    assert problems.load(name_of("shelf", level, 2)).start != first[0].start


def test_another_process_draws_the_same() -> None:
    names = [name_of("wall", "tray", 5), name_of("clutter", "level", 5), name_of("unseen", "cups", 5)]
    code = "import sys; from apex_ompl import problems; from apex_ompl.problems.frozen import digest\n"
    code += "print([digest(problems.load(name)) for name in sys.argv[1:]])"
    done = subprocess.run([sys.executable, "-c", code, *names], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == str([digest(problems.load(name)) for name in names])


def test_palms_hold_a_tray_at_its_ends(robot: Robot) -> None:
    size = TraySize(0.2, 0.26, 0.6)
    for side, hand in enumerate(robot.hands.values()):
        palm, y = size.palm(side), (0.2, -0.2)[side]
        assert np.linalg.det(palm[:3, :3]) == pytest.approx(1.0)
        np.testing.assert_allclose((palm @ [*hand.point, 1.0])[:3], (0.0, y, 0.0), atol=1e-12)
        np.testing.assert_allclose(palm[:3, :3] @ hand.axis, (0.0, -np.sign(y), 0.0), atol=1e-12)  # towards the tray
        np.testing.assert_allclose(palm[:3, :3] @ hand.fingers, (np.cos(0.6), 0.0, -np.sin(0.6)), atol=1e-12)
    tray, cargo = carried_tray(size, loaded=True).held.attached
    assert tray.box == (0.26, 0.4, 0.02)
    between = np.linalg.inv(tray.pose) @ cargo.pose
    np.testing.assert_allclose(between[:3, :3], np.eye(3), atol=1e-9)
    assert between[2, 3] - cargo.cylinder.length / 2 == pytest.approx(0.011, abs=2e-6)  # 1 mm above the tray
    assert (carried_tray(size, loaded=False).held.low == SYNERGY).all()


def test_most_straight_lines_are_blocked_in_clutter_and_among_unseen_parts(robot: Robot) -> None:
    free = 0
    for suite, level in (("clutter", "tray"), ("unseen", "level"), ("unseen", "cups")):
        for seed in range(4):
            drawn = first_drawn(ProblemId(suite, level, UNFROZEN + seed))[1]
            kernel = CollisionChecker(robot, drawn.scene, drawn.attached).kernel
            attached, line = drawn.attached, np.stack([drawn.start, drawn.goal])
            held = constrained.Carried(Held.of(attached, (0.5, 0.5), (0.5, 0.5)), drawn.constraints)
            free += line_is_free(held, kernel.scene, line)
    assert free <= 6


def test_grammars_take_turns_and_stay_validation_problems() -> None:
    for seed in range(3):
        drawn = [first_drawn(ProblemId("unseen", level, UNFROZEN + seed))[1] for level in ("tray", "cups")]
        assert all(0 < len(one.scene) <= 300 for one in drawn)
    with pytest.raises(ParameterError, match="unseen is for validation only"):
        problems.load("unseen/tray/12")


def test_levels_with_constraints_are_apart_from_the_others() -> None:
    assert set(CONSTRAINED) == {"shelf", "wall", "posts", "clutter", "unseen"}
    assert levels_of("shelf") == (*problems.suites()["shelf"], "tray", "level", "cups")
    assert {unit.level for unit in plan_units(3000)}.isdisjoint({"tray", "level", "cups"})
    with pytest.raises(UnknownNameError, match="tray"):
        problems.load("bins/tray/12")
    with pytest.raises(UnknownNameError, match="did you mean 'cups'"):
        problems.load("shelf/cup/12")


FROZEN = [pair for pair in LEVELS if frozen.exists(*pair)]


@pytest.mark.parametrize(("suite", "level"), FROZEN)
def test_witnesses_keep_the_constraints_and_are_free(robot: Robot, suite: str, level: str) -> None:
    split = "validation" if suite == "unseen" else "test"
    names = problems.frozen_names(suite, level, split)
    assert len(names) == frozen.COUNTS[split]["unseen constrained" if suite == "unseen" else "constrained"]
    for name in names[::34]:
        problem, witness = problems.load(name), problems.witness(name)
        states = ends(problem, robot)
        assert np.array_equal(witness.path[[0, -1]], states)
        path = frozen.on_constraints(problem, witness.path)
        assert path is not None
        checker = CollisionChecker(robot, problem.scene, problem.attached)
        constraints = ConstraintSet.of(robot, problem.constraints, problem.attached, states[0])
        check = full_check(checker, path, states[0], states[1:], constraints=constraints)
        assert check, check.reason
        assert problem.constraints == first_drawn(ProblemId(suite, level, UNFROZEN))[1].constraints
