from __future__ import annotations

import gc
import weakref

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from apex_ompl.constraints.links import Links, in_world
from apex_ompl.errors import ParameterError, UnknownNameError
from apex_ompl.kernel import FixedVector, Target, angle_target, offset_target, opposition_target
from apex_ompl.robot import Robot, load_robot
from apex_ompl.robot.config import DATA

LINKS = {
    "dual_panda_softhand": ("right_hand_index_distal", "left_link5"),  # a finger that follows a synergy, and an arm
    "baxter": ("left_gripper", "right_lower_elbow"),
}
LOCAL, AXIS, OTHER = np.array([0.01, 0.04, -0.03]), np.array([0.0, 0.6, 0.8]), np.array([0.8, 0.0, -0.6])
POINT = np.array([0.4, 0.1, 0.3])


def placed(robot: Robot, q: np.ndarray, link: str, vector: np.ndarray, point: bool) -> np.ndarray:
    """A point or direction of a link in the world, by Pinocchio."""
    pose = robot.link_pose(q, link)
    return pose[:3, :3] @ vector + (pose[:3, 3] if point else 0.0)


def targets_and_residual(robot: Robot, kind: str):
    """Targets, and their residual from the links' poses."""
    links, (a, b) = Links.of(robot), LINKS[robot.name]
    if kind == "gap":
        target = offset_target(links.point(a, LOCAL), links.point(b, OTHER), links.direction(a, AXIS), 0.3, 2.0)

        def residual(q: np.ndarray) -> np.ndarray:
            first, second = placed(robot, q, a, LOCAL, True), placed(robot, q, b, OTHER, True)
            return 2.0 * (second - first - 0.3 * placed(robot, q, a, AXIS, False))
    elif kind == "facing":
        target = opposition_target(links.direction(a, AXIS), links.direction(b, OTHER), -1.0, 0.5)

        def residual(q: np.ndarray) -> np.ndarray:
            return 0.5 * (placed(robot, q, a, AXIS, False) - placed(robot, q, b, OTHER, False))
    elif kind == "slope":
        target = angle_target(links.direction(a, AXIS), links.direction(b, OTHER), 0.25, 3.0)

        def residual(q: np.ndarray) -> np.ndarray:
            return 3.0 * np.array([placed(robot, q, a, AXIS, False) @ placed(robot, q, b, OTHER, False) - 0.25])
    else:
        target = offset_target(in_world(POINT), links.point(b, LOCAL))

        def residual(q: np.ndarray) -> np.ndarray:
            return placed(robot, q, b, LOCAL, True) - POINT

    return target, residual


@pytest.mark.parametrize("kind", ["gap", "facing", "slope", "world"])
@pytest.mark.parametrize("name", list(LINKS))
def test_residuals_are_pinocchios_and_jacobians_those_of_finite_differences(
    name: str, kind: str, robot: Robot, baxter: Robot
) -> None:
    some = {"dual_panda_softhand": robot, "baxter": baxter}[name]
    target, residual = targets_and_residual(some, kind)
    inverse = Links.of(some).inverse([target])
    for q in some.random_state(np.random.default_rng(0), 5):
        value, jacobian = inverse.residual(q)
        np.testing.assert_allclose(value, residual(q), atol=1e-12)
        steps = np.eye(some.dof) * 1e-6
        numeric = np.array([(residual(q + s) - residual(q - s)) / 2e-6 for s in steps]).T
        np.testing.assert_allclose(jacobian, numeric, atol=1e-7)


def pose_targets(robot: Robot, link: str, pose: np.ndarray) -> list[Target]:
    links = Links.of(robot)
    point, axis = pose[:3, :3] @ LOCAL + pose[:3, 3], pose[:3, :3] @ AXIS
    return [
        offset_target(in_world(point), links.point(link, LOCAL)),
        opposition_target(links.direction(link, AXIS), in_world(axis), -1.0),
    ]


def test_descents_reach_reachable_poses_inside_the_limits(robot: Robot) -> None:
    rng, links = np.random.default_rng(1), Links.of(robot)
    solved = 0
    targets = robot.home + rng.normal(0, 0.3, (20, robot.dof))
    for target in np.clip(targets, robot.limits.lower, robot.limits.upper):
        inverse = links.inverse(pose_targets(robot, "left_hand_palm", robot.link_pose(target, "left_hand_palm")))
        found = inverse.descend(robot.home)
        assert robot.limit_fault(found.states[0]) is None
        assert np.linalg.norm(inverse.residual(found.states[0])[0]) == pytest.approx(found.errors[0])
        solved += found.errors[0] < 1e-4
    assert solved >= 18


@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_descent_never_gets_worse_and_leaves_the_rest_alone(robot: Robot, seed: int) -> None:
    rng = np.random.default_rng(seed)
    first, goal = robot.random_state(rng, 2)
    inverse = Links.of(robot).inverse(
        pose_targets(robot, "left_hand_palm", robot.link_pose(goal, "left_hand_palm")), fixed=[2]
    )
    ends = [inverse.descend(first, max_steps=n) for n in (0, 3, 30)]
    errors = [end.errors[0] for end in ends]
    assert (
        errors[0] == pytest.approx(np.linalg.norm(inverse.residual(first)[0])) and errors[0] >= errors[1] >= errors[2]
    )
    changed = np.flatnonzero(ends[2].states[0] != first)
    assert set(changed) <= set(range(7)) - {2}  # the left arm's other joints
    alone = inverse.descend(first[None], max_steps=30)
    batch = inverse.descend(np.stack([goal, first]), max_steps=30)
    assert np.array_equal(batch.states[1], alone.states[0]) and batch.steps[1] == alone.steps[0]


def test_an_unreachable_point_gives_the_nearest_error(robot: Robot) -> None:
    target = offset_target(in_world((3.0, 0.5, 0.5)), Links.of(robot).point("left_hand_palm", (0, 0, 0)))
    found = Links.of(robot).inverse([target]).descend(robot.home, max_steps=200)
    assert 1.7 < found.errors[0] < 2.2  # the palm reaches about 1.1 m from the shoulder


def test_bad_input_is_named(robot: Robot) -> None:
    links = Links.of(robot)
    with pytest.raises(UnknownNameError, match="no_such_link"):
        links.point("no_such_link", (0, 0, 0))
    with pytest.raises(ParameterError, match="targets"):
        links.inverse([])
    with pytest.raises(ParameterError, match="states"):
        links.inverse([targets_and_residual(robot, "gap")[0]]).descend(np.zeros(3))
    inverse = links.inverse([targets_and_residual(robot, "gap")[0]])
    for wrong in (np.zeros(3), np.zeros(17), np.zeros((1, 16)), np.zeros(0)):
        with pytest.raises(ParameterError, match="state"):
            inverse.residual(wrong)
    with pytest.raises(ParameterError, match="fixed"):
        links.inverse([targets_and_residual(robot, "gap")[0]], fixed=[16])
    good, strange = FixedVector(0, (0.0, 0.0, 1.0)), FixedVector(0.5, (0.0, 0.0, 1.0))
    for kind, vectors in ((3, (good,) * 3), (0, (good,) * 2), (0, (good, good, strange))):
        with pytest.raises(ParameterError, match="target"):
            Target(kind, vectors, 0.0, 1.0)
    with pytest.raises(ParameterError, match="target"):
        offset_target(good, FixedVector(1, (0.0, 0.0)))
    bad = robot.home.copy()
    bad[0] = np.nan
    target = pose_targets(robot, "left_hand_palm", robot.link_pose(robot.home, "left_hand_palm"))
    assert not links.inverse(target).descend(bad).errors[0] <= 1.0


def test_links_do_not_keep_their_robot_alive() -> None:
    some = load_robot(DATA / "baxter.robot.yaml")  # robots that ship are kept by their name
    kept, _ = weakref.ref(some), Links.of(some)
    del some
    gc.collect()
    assert kept() is None
