"""Rows of constraints: residuals against Pinocchio and definitions, Jacobians against differences, projections."""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin
import pytest
from constraint_groups import Placed, Real, Sample, Tree, residual, sample
from hypothesis import given, settings
from hypothesis import strategies as st
from support import states_around_home

from apex_ompl.errors import ParameterError
from apex_ompl.kernel.constraints import AXIS, POSITION, ROTATION, ConstraintGroup, ConstraintRows, JointFrame
from apex_ompl.robot import Robot

KINDS = [POSITION, AXIS, ROTATION]
WORLD = JointFrame(0, np.eye(3), np.zeros(3))


def turned(q: np.ndarray) -> np.ndarray:
    """A pose without translation from a rotation vector."""
    found = np.eye(4)
    found[:3, :3] = pin.exp3(q)
    return found


def differences(rows: ConstraintRows, q: np.ndarray, share: float, step: float = 1e-6) -> np.ndarray:
    """Central differences of the residual, shape (m, dof)."""
    columns = []
    for k in range(len(q)):
        move = np.zeros(len(q))
        move[k] = step
        columns.append((rows.residual(q + move, share)[0] - rows.residual(q - move, share)[0]) / (2.0 * step))
    return np.array(columns).T


def in_world(kind: int, pose: np.ndarray, **more: float) -> ConstraintRows:
    """A group of a frame in the world, on a robot that has no part in it."""
    frame = JointFrame(0, pose[:3, :3], pose[:3, 3])
    group = ConstraintGroup(kind, 2 if kind == AXIS else 3, WORLD, frame, 4.0, **more)
    return ConstraintRows(Tree(1).tables, [group])


@pytest.mark.parametrize("which", ["robot", "baxter"])
def test_residuals_are_those_of_pinocchios_placements(which: str, request: pytest.FixtureRequest) -> None:
    robot: Robot = request.getfixturevalue(which)
    rng = np.random.default_rng(3)
    real = Real(robot)
    for q in states_around_home(robot, rng, 10, 0.8):
        found = sample(real, rng, KINDS * 3)
        rows, wanted = found.rows(), found.residuals(q)
        np.testing.assert_allclose(rows.residual(q)[0], np.concatenate(wanted), atol=1e-9)
        np.testing.assert_allclose(rows.norms(q)[0], [np.linalg.norm(r) for r in wanted], atol=1e-9)


@settings(max_examples=40)
@given(seed=st.integers(0, 10**6))
def test_residuals_of_random_trees_are_those_by_definition(seed: int) -> None:
    rng = np.random.default_rng(seed)
    found = sample(Tree(seed), rng)
    q = rng.uniform(-1.0, 1.0, found.mechanism.tables.dof)
    np.testing.assert_allclose(found.rows().residual(q)[0], np.concatenate(found.residuals(q)), atol=1e-9)


@settings(max_examples=40)
@given(seed=st.integers(0, 10**6), is_near=st.booleans(), share=st.sampled_from([0.0, 0.5]))
def test_jacobians_are_those_of_differences(seed: int, is_near: bool, share: float) -> None:
    rng = np.random.default_rng(seed)
    tree = Tree(seed)
    q = rng.uniform(-1.0, 1.0, tree.tables.dof)
    found = sample(tree, rng, near=q if is_near else None)
    groups = [ConstraintGroup(g.kind, g.rows, g.first, g.second, 1.0, g.value, 2e-3) for g in found.groups]
    norms = ConstraintRows(tree.tables, groups).norms(q)[0]
    if (norms[1:] > 3.0).any() or (abs(norms - share * 2e-3) < 1e-4).any():  # where there is no derivative
        return
    rows = ConstraintRows(tree.tables, groups)
    np.testing.assert_allclose(rows.residual(q, share)[1], differences(rows, q, share), atol=2e-7)


@pytest.mark.parametrize("which", ["robot", "baxter"])
def test_jacobians_of_real_robots_are_those_of_differences(which: str, request: pytest.FixtureRequest) -> None:
    robot: Robot = request.getfixturevalue(which)
    rng = np.random.default_rng(5)
    real = Real(robot)
    for q in states_around_home(robot, rng, 5):
        rows = sample(real, rng, near=q).rows()
        value, jacobian = rows.residual(q)
        assert jacobian.shape == (len(value), robot.dof)
        np.testing.assert_allclose(jacobian, differences(rows, q, 0.0), atol=2e-7)


def test_joints_that_stay_have_no_column() -> None:
    tree, rng = Tree(12), np.random.default_rng(0)
    q = rng.uniform(-1.0, 1.0, tree.tables.dof)
    found = sample(tree, rng, KINDS * 4)
    whole, part = found.rows().residual(q)[1], found.rows(fixed=[1, 3]).residual(q)[1]
    assert whole[:, [1, 3]].any()
    assert not part[:, [1, 3]].any()
    assert np.array_equal(part[:, [0, 2]], whole[:, [0, 2]])


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-8, 9e-5, 1.1e-4, 0.1, 1.5, 3.0, math.pi - 1e-3, math.pi - 2e-6])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_angles_are_exact_from_0_to_half_a_turn(angle: float, seed: int) -> None:
    axis = np.random.default_rng(seed).normal(size=3)
    axis /= np.linalg.norm(axis)
    turn = turned(angle * axis)
    # the axis of a rotation by pi - e is known to the rounding of its sine
    np.testing.assert_allclose(
        in_world(ROTATION, turn).residual(np.zeros(4))[0], angle * axis, atol=1e-15 + 1e-15 / max(math.pi - angle, 1e-6)
    )
    across = np.array([math.sin(seed), math.cos(seed)])
    tilt = turned(angle * np.array([-across[1], across[0], 0.0]))
    np.testing.assert_allclose(in_world(AXIS, tilt).residual(np.zeros(4))[0], angle * across, atol=1e-9)


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.6, 0.0, 0.8), (0.48, 0.6, 0.64)])
def test_half_turns_have_their_angle(axis: tuple[float, float, float]) -> None:
    n = np.array(axis)
    half = np.eye(4)
    half[:3, :3] = 2.0 * np.outer(n, n) - np.eye(3)
    found, _ = in_world(ROTATION, half).residual(np.zeros(4))
    np.testing.assert_allclose(abs(found @ n), math.pi, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(found), math.pi, atol=1e-12)
    assert in_world(AXIS, np.diag([1.0, -1.0, -1.0, 1.0])).norms(np.zeros((1, 4))) == pytest.approx(math.pi)


@settings(max_examples=40)
@given(seed=st.integers(0, 10**6), size=st.floats(0.0, 2.0))
def test_dead_zones_leave_what_is_beyond_them(seed: int, size: float) -> None:
    """A group has no row in its zone, else the row |r| - share * slack."""
    rng = np.random.default_rng(seed)
    tree = Tree(seed)
    q = rng.uniform(-1.0, 1.0, tree.tables.dof)
    found = sample(tree, rng)
    groups = [ConstraintGroup(g.kind, g.rows, g.first, g.second, 4.0, g.value, size) for g in found.groups]
    for share in (1.0, 0.5):
        value, jacobian = ConstraintRows(tree.tables, groups).residual(q, share)
        norms = found.norms(q[None])[0]
        wanted = norms[norms > share * size] - share * size if size > 0.0 else np.concatenate(found.residuals(q))
        assert len(jacobian) == len(value)
        np.testing.assert_allclose(value, wanted, atol=1e-9)


@settings(max_examples=40)
@given(seed=st.integers(0, 10**6), kind=st.sampled_from(KINDS), slack=st.sampled_from([0.0, 5e-3]))
def test_states_are_projected_inside_the_limits(seed: int, kind: int, slack: float) -> None:
    """States beside a state of the constraint arrive on it, where a joint can move the frames."""
    rng = np.random.default_rng(seed)
    tree = Tree(seed, joints=12)
    middle = rng.uniform(-0.8, 0.8, tree.tables.dof)
    found = sample(tree, rng, [kind], near=middle)
    a, b = found.frames[0]
    exact = Placed(b.link, np.linalg.inv(tree.placement(Placed(b.link, np.eye(4)), middle)) @ tree.placement(a, middle))
    group = ConstraintGroup(kind, found.groups[0].rows, tree.frame(a), tree.frame(exact), 0.01, slack=slack)
    rows, states = ConstraintRows(tree.tables, [group]), middle + rng.uniform(-0.1, 0.1, (8, len(middle)))
    there = Sample(tree, [group], [(a, exact)])
    assert residual(group, tree.placement(a, middle), tree.placement(exact, middle)) == pytest.approx(0.0, abs=1e-9)
    ends, ok = rows.project(states, tolerance=1e-10, steps=40)
    assert (abs(ends) <= 1.0).all()
    assert (there.norms(ends)[ok] <= slack + 1e-9).all()
    assert (there.norms(ends)[~ok] > slack + 1e-10).all()
    jacobian = differences(rows, middle, 0.0)
    if np.linalg.matrix_rank(jacobian, 0.05) == group.rows:
        assert ok.all()
        assert abs(ends - states).max() < 1.0
    again, ok_again = rows.project(ends[ok], tolerance=1e-9)
    assert ok_again.all() and np.array_equal(again, ends[ok])


def test_a_closed_chain_of_two_arms_is_projected(robot: Robot) -> None:
    real, rng = Real(robot), np.random.default_rng(2)
    grip = Placed("left_link8", np.eye(4))
    pose = np.linalg.inv(real.placement(Placed("right_link8", np.eye(4)), robot.home)) @ real.placement(
        grip, robot.home
    )
    other = Placed("right_link8", pose)
    groups = [
        ConstraintGroup(kind, 3, real.frame(grip), real.frame(other), most)
        for kind, most in ((POSITION, 1e-3), (ROTATION, 0.01))
    ]
    hands = robot.groups["hands"]
    rows = ConstraintRows(real.tables, groups, fixed=hands)
    states = states_around_home(robot, rng, 20, 0.2)
    ends, ok = rows.project(states)
    assert ok.mean() > 0.9
    assert (Sample(real, groups, [(grip, other)] * 2).norms(ends[ok]) <= 1e-8).all()
    assert np.array_equal(ends[:, hands], states[:, hands])
    assert (ends >= robot.limits.lower).all() and (ends <= robot.limits.upper).all()


def test_what_cannot_be_reached_does_not_arrive() -> None:
    tree = Tree(4)
    far = np.eye(4)
    far[:3, 3] = 50.0
    group = ConstraintGroup(POSITION, 3, JointFrame(0, np.eye(3), far[:3, 3]), tree.frame(Placed(8, np.eye(4))), 1e-3)
    ends, ok = ConstraintRows(tree.tables, [group]).project(np.zeros((2, 4)))
    assert not ok.any() and (abs(ends) <= 1.0).all()
    _, ok = ConstraintRows(tree.tables, [group]).project(np.full((1, 4), np.nan))
    assert not ok.any()


def test_bad_groups_and_shapes_are_named() -> None:
    tree = Tree(4)
    good = ConstraintGroup(POSITION, 3, WORLD, JointFrame(3, np.eye(3), np.zeros(3)), 1e-3)
    rows = ConstraintRows(tree.tables, [good])
    for call in (
        lambda: ConstraintGroup(7, 1, WORLD, WORLD, 1.0),
        lambda: ConstraintGroup(AXIS, 3, WORLD, WORLD, 1.0),
        lambda: ConstraintGroup(POSITION, 0, WORLD, WORLD, 1.0),
        lambda: ConstraintGroup(POSITION, 1, WORLD, WORLD, math.nan),
        lambda: ConstraintGroup(POSITION, 1, WORLD, WORLD, 1.0, slack=1.0),
        lambda: ConstraintGroup(POSITION, 1, WORLD, WORLD, 1.0, value=(0.0, math.nan, 0.0)),
        lambda: ConstraintGroup(POSITION, 1, JointFrame(0, 2.0 * np.eye(3), np.zeros(3)), WORLD, 1.0),
        lambda: ConstraintGroup(POSITION, 1, JointFrame(0, np.eye(3), np.zeros(2)), WORLD, 1.0),
        lambda: ConstraintRows(tree.tables, []),
        lambda: ConstraintRows(
            tree.tables, [ConstraintGroup(POSITION, 1, WORLD, JointFrame(9, np.eye(3), np.zeros(3)), 1.0)]
        ),
        lambda: ConstraintRows(tree.tables, [good], fixed=[4]),
        lambda: rows.norms(np.zeros((2, 3))),
        lambda: rows.residual(np.zeros(3)),
        lambda: rows.project(np.zeros((2, 5))),
    ):
        with pytest.raises(ParameterError):
            call()
