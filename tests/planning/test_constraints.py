"""Plans under constraints along the path, checked by Pinocchio's placements alone."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin
import pytest
from planning import cached_problem

from apex_ompl import plan
from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ParameterError, UnknownNameError
from apex_ompl.problems.suite_robot import robot
from apex_ompl.result import PlanResult, PlanStatus
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.constraints import OnPlane, Upright
from apex_ompl.scene.problem import Problem
from apex_ompl.scene.scripts import obstacle_at, problem_at
from apex_ompl.types import Array

HANDS = "left_hand_palm", "right_hand_palm"
BETWEEN = 20  # states between two of a path that are looked at


def dense(result: PlanResult) -> Array:
    """Return states along the path and the motion of a result, close to each other."""
    assert result.path is not None and result.trajectory is not None
    states = result.path.states
    share = np.arange(BETWEEN)[:, None] / BETWEEN
    along = [a + share * (b - a) for a, b in zip(states, states[1:], strict=False)]
    motion = result.trajectory(np.linspace(0.0, result.trajectory.duration, 4000))
    return np.concatenate([*along, states[-1:], motion])


def placement(q: Array, link: str) -> pin.SE3:
    """Return the pose of a link at a state."""
    model, data = robot().model, robot().model.createData()
    pin.framesForwardKinematics(model, data, robot().to_pinocchio(q))
    return data.oMf[model.getFrameId(link)].copy()


def tilt(q: Array, link: str, axis: Array) -> float:
    """Return the angle between an axis of a link and up [rad]."""
    return float(np.arccos(np.clip((placement(q, link).rotation @ axis)[2], -1.0, 1.0)))


@pytest.fixture(scope="module")
def carried() -> PlanResult:
    """The plan of the tray."""
    return plan(cached_problem("carry_tray"), timeout=20.0)


def test_both_hands_keep_their_tray(carried: PlanResult) -> None:
    assert carried and carried.trajectory is not None
    first, second = (placement(carried.path.states[0], hand) for hand in HANDS)  # type: ignore[union-attr]
    wanted = first.actInv(second)
    for q in dense(carried)[::7]:
        found = placement(q, HANDS[0]).actInv(placement(q, HANDS[1]))
        assert np.linalg.norm(found.translation - wanted.translation) <= 1e-3
        assert np.linalg.norm(pin.log3(wanted.rotation.T @ found.rotation)) <= 1e-2


def test_the_result_names_the_violation_and_its_bound(carried: PlanResult) -> None:
    assert set(carried.constraint_bound) == {"closed chain of tray", "upright of tray"}
    for name, bound in carried.constraint_bound.items():
        assert 0.0 <= carried.constraint_violation[name] <= bound <= 1e-2
    assert "closed chain of tray, violated by at most" in str(carried)


def test_a_motion_under_constraints_ends_within_the_limits(carried: PlanResult) -> None:
    assert carried.trajectory is not None
    assert max(carried.trajectory.use(robot().limits).values()) <= 1.0 + 1e-9


def test_cups_stay_upright() -> None:
    problem = cached_problem("pour_upright")
    result = plan(problem, timeout=20.0)
    assert result
    held = {one.name: one for one in problem.attached}
    for constraint in problem.constraints:
        assert isinstance(constraint, Upright)
        cup = held[constraint.frame]
        axis = cup.pose[:3, :3] @ np.array([0.0, 0.0, 1.0])
        worst = max(tilt(q, cup.link, axis) for q in dense(result)[::7])
        assert 0.0 < worst <= constraint.angle + 1e-9


def test_the_tray_waits_for_what_crosses_its_way(carried: PlanResult) -> None:
    motion = carried.trajectory
    assert motion is not None
    half = 0.5 * motion.duration
    hands = [placement(motion(half), hand).translation for hand in HANDS]
    velocity = np.array([0.0, 0.0, -0.4])
    ball = Obstacle(
        name="ball", sphere={"radius": 0.06}, position=tuple(np.mean(hands, axis=0) - half * velocity),
        velocity=tuple(velocity),
    )  # fmt: skip
    problem = cached_problem("carry_tray")
    crossed = problem.model_copy(update={"scene": (*problem.scene, ball)})
    result = plan(crossed, timeout=20.0)
    assert result and result.dynamic_obstacles == ("ball",) and result.trajectory is not None
    assert not np.array_equal(result.trajectory.times, motion.times), "or the ball is not in the way"
    first, second = (placement(motion.positions[0], hand) for hand in HANDS)
    wanted = first.actInv(second)
    checker = CollisionChecker(robot(), problem_at(crossed, 0.0).scene, problem.attached)
    for time in np.linspace(0.0, result.trajectory.duration, 300):
        q = result.trajectory(time)
        checker.move("ball", obstacle_at(ball, float(time)).position)
        assert checker.is_free(q)
        found = placement(q, HANDS[0]).actInv(placement(q, HANDS[1]))
        off = np.linalg.norm(found.translation - wanted.translation)
        assert off <= result.constraint_bound["closed chain of tray"] <= 1e-3


def test_a_contact_is_not_left_under_a_constraint() -> None:
    with pytest.raises(ParameterError, match="leave_contact: expected 0, since there is a constraint: upright of tray"):
        plan(cached_problem("carry_tray"), leave_contact=0.001)


def test_the_same_seed_gives_the_same_path(carried: PlanResult) -> None:
    again = plan(cached_problem("carry_tray"), timeout=20.0)
    assert np.array_equal(again.path.states, carried.path.states)  # type: ignore[union-attr]


def test_without_the_constraint_the_tray_tilts(carried: PlanResult) -> None:
    problem = cached_problem("carry_tray")
    touched = {"links": None, "touch_links": tuple(link for hand in HANDS for link in robot().hand_of(hand))}
    held = tuple(one.model_copy(update=touched) for one in problem.attached)
    free = problem.model_copy(update={"constraints": (), "attached": held})
    result = plan(free, timeout=20.0)
    first, second = (placement(result.path.states[0], hand) for hand in HANDS)  # type: ignore[union-attr]
    apart = [
        np.linalg.norm(
            placement(q, HANDS[0]).actInv(placement(q, HANDS[1])).translation - first.actInv(second).translation
        )
        for q in dense(result)[::50]
    ]
    assert max(apart) > 0.01, "or the tests above show nothing"


def test_a_start_off_its_constraint_has_a_status_and_a_nearest_state() -> None:
    problem = cached_problem("carry_tray")
    lower = Upright(frame="tray", angle=1e-3)
    moved = dict(problem.start)
    moved["left_joint7"] += 0.05
    moved["right_joint7"] += 0.05
    tilted = plan(problem.model_copy(update={"start": moved, "constraints": (lower,)}))
    assert tilted.status is PlanStatus.START_OFF_CONSTRAINT
    assert "upright of tray" in tilted.reason and "rad" in tilted.reason
    assert tilted.nearest_state is not None
    assert tilt(tilted.nearest_state, HANDS[0], problem.attached[0].pose[:3, 2]) <= 1e-3


def test_a_goal_off_its_constraint_has_a_status() -> None:
    problem = cached_problem("carry_tray")
    goal = dict(problem.goal.joints[0])  # type: ignore[index]
    goal["left_joint2"] -= 0.05
    off = problem.model_copy(update={"goal": problem.goal.model_copy(update={"joints": (goal,)})})
    result = plan(off)
    assert result.status is PlanStatus.GOAL_OFF_CONSTRAINT and "closed chain of tray" in result.reason


@dataclass
class Sum:
    """The sum of two joints stays as it is at the start."""

    start: Array
    name: str = "sum"
    tolerance: float = 0.01
    row: Array = field(init=False)

    def __post_init__(self) -> None:
        self.row = np.zeros((1, len(self.start)))
        self.row[0, [1, 8]] = 1.0

    def residual(self, q: Array) -> Array:
        return np.asarray(self.row @ (q - self.start))

    def jacobian(self, q: Array) -> Array:
        return self.row

    def bound(self, q: Array, step: Array) -> float:
        return float(np.abs(self.residual(q)).sum() + np.abs(self.row @ step).sum())


def own_problem() -> tuple[Problem, Array]:
    """Return a problem whose goal keeps the sum of joints 1 and 8, and its start."""
    problem, names = cached_problem("ball_in_cup"), robot().joint_names
    start = problem.start_state(names)
    goal = start.copy()
    goal[[0, 1, 7, 8]] += [0.9, 0.3, -0.9, -0.3]
    joints = dict(zip(names, goal.tolist(), strict=True))
    return problem.model_copy(update={"attached": (), "goal": problem.goal.model_validate({"joints": joints})}), start


def test_a_constraint_of_a_users_own_holds_along_path_and_motion() -> None:
    problem, start = own_problem()
    post = {"name": "post", "sphere": {"radius": 0.03}}
    middle = 0.5 * (start + problem.goal_states(robot().joint_names)[0])
    at = placement(middle, "left_hand_palm").translation
    blocked = Problem.parse({**problem.as_dict(), "scene": [{**post, "position": at.tolist()}]}, "test")
    one = Sum(start)
    result = plan(blocked, constraints=[one], timeout=20.0)
    assert result
    assert max(abs(float((one.residual(q)).sum())) for q in dense(result)) <= one.tolerance
    assert result.constraint_bound["sum"] <= one.tolerance


def test_poses_are_sampled_on_the_constraints() -> None:
    problem, start = own_problem()
    hand = placement(start, "left_hand_palm")
    plane = OnPlane(frame="left_hand_palm", normal=(0.0, 0.0, 1.0))
    wanted = (hand.translation + np.array([0.05, -0.1, 0.0])).tolist()
    goal = {"poses": [{"frame": "left_hand_palm", "position": wanted}]}
    result = plan(problem.model_copy(update={"goal": problem.goal.model_validate(goal)}), constraints=[plane])
    assert result
    heights = [placement(q, "left_hand_palm").translation[2] for q in dense(result)[::7]]
    assert np.abs(np.array(heights) - hand.translation[2]).max() <= 1e-3
    assert np.linalg.norm(placement(result.path.states[-1], "left_hand_palm").translation - wanted) <= 1e-3  # type: ignore[union-attr]


def test_an_unknown_frame_is_named() -> None:
    with pytest.raises(UnknownNameError, match="left_thumb"):
        plan(cached_problem("ball_in_cup"), constraints=[Upright(frame="left_thumb")])
