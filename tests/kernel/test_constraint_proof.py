"""Proofs of constraints along paths and motions, against dense samples, searched maxima and closed forms."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest
from constraint_groups import Placed, Real, Sample, Tree, sample
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar

from apex_ompl.errors import ParameterError
from apex_ompl.kernel import robot_builder
from apex_ompl.kernel.arrays import PRISMATIC, REVOLUTE
from apex_ompl.kernel.constraints import (
    AXIS,
    POSITION,
    ROTATION,
    ConstraintGroup,
    ConstraintProof,
    ConstraintRows,
    JointFrame,
    prove_motion,
    prove_path,
)
from apex_ompl.kernel.joint_tree import JointTree
from apex_ompl.kernel.tables import JointSpec, RobotTables
from apex_ompl.robot import Robot

KINDS = [POSITION, AXIS, ROTATION]
EVERYTHING = [100.0, 4.0, 4.0]  # tolerances that every interval keeps
WORLD = JointFrame(0, np.eye(3), np.zeros(3))
SHARES = np.linspace(0.0, 1.0, 21)


class Curve(NamedTuple):
    """A path where there are no times, else a motion of constant jerk between knots."""

    states: np.ndarray
    times: np.ndarray | None = None
    velocities: np.ndarray | None = None
    accelerations: np.ndarray | None = None

    def prove(self, rows: ConstraintRows) -> ConstraintProof:
        if self.times is None:
            return prove_path(rows, self.states)
        return prove_motion(rows, self.times, self.states, self.velocities, self.accelerations)

    def __call__(self, piece: int, share: np.ndarray | float) -> np.ndarray:
        """States at shares of a piece, shape (N, dof)."""
        x = np.atleast_1d(share)[:, None]
        first, last = self.states[piece : piece + 2]
        if self.times is None:
            return first + x * (last - first)
        t, since = self.times[piece + 1] - self.times[piece], x * (self.times[piece + 1] - self.times[piece])
        a, b = self.accelerations[piece : piece + 2]
        return first + since * self.velocities[piece] + since**2 / 2.0 * a + since**3 / 6.0 * (b - a) / t

    @property
    def pieces(self) -> int:
        return len(self.states) - 1

    def dense(self, shares: np.ndarray = SHARES) -> np.ndarray:
        return np.concatenate([self(k, shares) for k in range(self.pieces)])

    def divided(self, count: int) -> Curve:
        """The same curve in ``count`` times as many pieces."""
        shares = np.arange(count) / count
        states = np.concatenate([self.dense(shares), self.states[-1:]])
        if self.times is None:
            return Curve(states)
        times = np.interp(np.arange(self.pieces * count + 1) / count, np.arange(self.pieces + 1), self.times)
        k = np.minimum(np.arange(len(times)) // count, self.pieces - 1)
        since, long = (times - self.times[k])[:, None], np.diff(self.times)[k][:, None]
        jerk = np.diff(self.accelerations, axis=0)[k] / long
        accelerations = self.accelerations[k] + since * jerk
        velocities = self.velocities[k] + since * self.accelerations[k] + since**2 / 2.0 * jerk
        return Curve(states, times, velocities, accelerations)


def random_curve(rng: np.random.Generator, middle: np.ndarray, size: float, pieces: int, is_motion: bool) -> Curve:
    """A curve through a state, with pieces of about a size [rad]."""
    dof = len(middle)
    if not is_motion:
        return Curve(middle + np.cumsum(rng.normal(0.0, size, (pieces + 1, dof)), axis=0))
    times = np.concatenate([[0.0], np.cumsum(rng.uniform(0.1, 0.6, pieces))])
    jerks = rng.normal(0.0, 30.0 * size, (pieces, dof))
    p, v, a = [middle], [rng.normal(0.0, 2.0 * size, dof)], [rng.normal(0.0, 6.0 * size, dof)]
    for t, jerk in zip(np.diff(times), jerks, strict=True):
        p.append(p[-1] + t * v[-1] + t**2 / 2.0 * a[-1] + t**3 / 6.0 * jerk)
        v.append(v[-1] + t * a[-1] + t**2 / 2.0 * jerk)
        a.append(a[-1] + t * jerk)
    return Curve(np.array(p), times, np.array(v), np.array(a))


def largest(rows: ConstraintRows, curve: Curve) -> np.ndarray:
    """Largest |r| of each group along a curve, by dense samples and a search around the largest of them."""
    shares = np.linspace(0.0, 1.0, 101)
    norms = rows.norms(curve.dense(shares)).reshape(curve.pieces, len(shares), -1)
    found = norms.max(axis=(0, 1))
    around = np.pad(norms, ((0, 0), (1, 1), (0, 0)), constant_values=-1.0)
    is_peak = (norms >= around[:, :-2]) & (norms > around[:, 2:]) & (norms > 0.99 * found)
    for g in range(len(found)):
        peaks = np.argwhere(is_peak[..., g])
        for piece, at in sorted(peaks.tolist(), key=lambda one, g=g: -norms[*one, g])[:3]:
            low, high = shares[max(at - 1, 0)], shares[min(at + 1, len(shares) - 1)]
            best = minimize_scalar(
                lambda x, piece=piece, g=g: -rows.norms(curve(piece, x))[0, g],
                bounds=(low, high), method="bounded", options={"xatol": 1e-9},
            )  # fmt: skip
            found[g] = max(found[g], -best.fun)
    return found


def scene(seed: int, size: float, pieces: int, is_motion: bool, is_near: bool) -> tuple[Sample, Curve]:
    """Groups of all kinds on a random tree, and a curve."""
    rng, tree = np.random.default_rng(seed), Tree(seed, joints=10)
    middle = rng.uniform(-1.0, 1.0, tree.tables.dof)
    found = sample(tree, rng, KINDS, near=middle if is_near else None)
    return found, random_curve(rng, middle, size, pieces, is_motion)


def planar(*lengths: float, kind: int = REVOLUTE) -> RobotTables:
    """A chain of joints along or about z, one length along x apart; the first is at the origin."""
    specs, ahead = [JointSpec(0)], np.eye(4)
    for k in range(len(lengths)):
        specs.append(JointSpec(k, kind, ahead.copy(), np.array([0.0, 0.0, 1.0]), k))
        ahead[0, 3] = lengths[k]
    box, names = np.full(len(lengths), 4.0), [f"q{k}" for k in range(len(lengths))]
    return robot_builder.robot_tables(
        "chain", names, lower=-box, upper=box, tree=JointTree(specs), bodies=[], pairs=[]
    )  # fmt: skip


def tip_rows(tables: RobotTables, reach: float, tolerance: float, rows: int = 3, at: float = 0.0) -> ConstraintRows:
    """Rows of the place of a chain's tip in the world, less ``at`` along x."""
    tip = JointFrame(tables.dof, np.eye(3), np.array([reach, 0.0, 0.0]))
    return ConstraintRows(tables, [ConstraintGroup(POSITION, rows, WORLD, tip, tolerance, (at, 0.0, 0.0))])


@settings(max_examples=60)
@given(
    seed=st.integers(0, 10**6), size=st.floats(1e-3, 0.6), is_motion=st.booleans(), is_near=st.booleans(),
)  # fmt: skip
def test_one_interval_is_bounded(seed: int, size: float, is_motion: bool, is_near: bool) -> None:
    """With tolerances that all intervals keep, the bound is that of the whole piece."""
    found, curve = scene(seed, size, 1, is_motion, is_near)
    proof = curve.prove(found.with_tolerances(EVERYTHING))
    assert proof.proved and proof.intervals == 1
    assert (found.norms(curve.dense()) <= proof.bounds + 1e-9).all()  # by definition, as 1e-9 allows for
    np.testing.assert_allclose(proof.violations, found.norms(curve(0, 0.5))[0], atol=1e-9)


@settings(max_examples=40)
@given(
    seed=st.integers(0, 10**6), size=st.floats(0.01, 0.4), is_motion=st.booleans(), is_near=st.booleans(),
    over=st.floats(1.02, 2.0),
)  # fmt: skip
def test_proved_bounds_hold_at_all_states(
    seed: int, size: float, is_motion: bool, is_near: bool, over: float
) -> None:  # fmt: skip
    found, curve = scene(seed, size, 3, is_motion, is_near)
    norms = found.rows().norms(curve.dense())
    tolerances = over * norms.max(axis=0) + 1e-6
    proof = curve.prove(found.with_tolerances(tolerances))
    assert proof.proved
    assert (norms <= proof.bounds).all()
    assert (proof.violations <= proof.bounds).all() and (proof.bounds <= tolerances).all()
    assert (proof.piece, proof.group) == (-1, -1)


@settings(max_examples=12)
@given(seed=st.integers(0, 10**6), is_motion=st.booleans(), is_near=st.booleans())
def test_bounds_converge_to_the_largest_residual(seed: int, is_motion: bool, is_near: bool) -> None:
    """The error falls with the square of the length of intervals, or with the length for turns near half a turn."""
    found, curve = scene(seed, 0.05, 2, is_motion, is_near)
    rows = found.with_tolerances(EVERYTHING)
    true, errors = largest(rows, curve), []
    for count in (8, 128):
        errors.append(curve.divided(count).prove(rows).bounds - true)
        assert (errors[-1] >= -1e-12).all()
    assert (errors[1] <= (1e-5 if is_near else 0.01)).all()
    if is_near:
        assert (errors[1] <= errors[0] / 50.0 + 1e-9).all()


@settings(max_examples=12)
@given(seed=st.integers(0, 10**6), size=st.floats(0.02, 0.3), is_motion=st.booleans(), is_near=st.booleans())
def test_tolerances_above_the_largest_residual_are_proved_and_those_below_refused(
    seed: int, size: float, is_motion: bool, is_near: bool
) -> None:
    found, curve = scene(seed, size, 3, is_motion, is_near)
    true = largest(found.rows(), curve)
    some = np.array([1.01, 1.01, 1.01])
    assert curve.prove(found.with_tolerances(true * some)).proved
    for g in np.nonzero(true > 1e-6)[0]:  # what no joint moves is not distinct from its rounding
        for share, is_kept in ((0.99, False), (1.0 - 1e-6, False), (1.0 + 1e-6, true[g] < 1.0)):
            some[g] = share
            proof = curve.prove(found.with_tolerances(true * some))
            assert proof.proved == is_kept or share > 1.0
            if share < 1.0:
                assert proof.group == g and np.isinf(proof.bounds).all()
                assert 0 <= proof.piece < 3 and 0.0 <= proof.share <= 1.0
                there = found.rows().norms(curve(proof.piece, proof.share))[0, g]
                assert there > share * true[g] and proof.value == pytest.approx(there, abs=1e-12)
        some[g] = 1.01


def test_a_path_shifted_to_its_tolerance_is_refused_one_percent_beyond_and_proved_one_percent_below() -> None:
    """States of a closed chain are moved until the largest violation between them, searched for, is the tolerance."""
    tables, tolerance = planar(0.5, 0.4, 0.3), 1e-3
    rows = tip_rows(tables, 0.3, tolerance, rows=2, at=0.9)
    angles = np.array([0.3, -1.0, 0.9])
    states, ok = rows.project(angles + np.linspace(0.0, 1.0, 40)[:, None] * np.array([0.8, -0.3, 0.2]))
    assert ok.all() and prove_path(rows, states).proved
    bent = np.sin(np.linspace(0.0, math.pi, len(states)))[:, None] * np.array([0.0, 0.0, 1.0])
    low, high = 0.0, 0.1
    for _ in range(25):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if largest(rows, Curve(states + middle * bent))[0] < tolerance else (low, middle)
    path = states + low * bent
    assert largest(rows, Curve(path))[0] == pytest.approx(tolerance, rel=1e-6)
    for share, is_proved in ((0.99, False), (0.9999, False), (1.0001, True), (1.01, True)):
        assert prove_path(tip_rows(tables, 0.3, share * tolerance, rows=2, at=0.9), path).proved == is_proved
    for share, is_proved in ((0.99, True), (1.01, False)):  # the path is shifted, and not the tolerance
        assert prove_path(rows, states + share * low * bent).proved == is_proved


@pytest.mark.parametrize("is_motion", [False, True])
def test_a_spike_between_the_states_that_are_examined_first_is_found(is_motion: bool) -> None:
    tables = planar(1.0)
    states = np.zeros((6, 1))
    states[3] = 1.0
    curve = Curve(states)
    if is_motion:
        curve = Curve(states, np.arange(6.0), np.zeros((6, 1)), np.zeros((6, 1)))  # gaps of 1 rad at two knots
    rows = tip_rows(tables, 1.0, 0.9, rows=1, at=1.0)  # |cos q - 1| <= 1 - cos 1 = 0.46
    assert curve.prove(rows).proved == (not is_motion)
    for share, is_proved in ((1.001, not is_motion), (0.999, False)):
        assert curve.prove(tip_rows(tables, 1.0, share * (1.0 - math.cos(1.0)), 1, 1.0)).proved == is_proved


@pytest.mark.parametrize("angle", [1e-3, 0.2, 1.0, 1.7, 2.5, 3.1])
def test_turns_about_one_axis_have_their_angle(angle: float) -> None:
    """A joint that turns a frame by an angle gives this angle; its axis does not tilt, another one does."""
    tables = planar(0.5)
    tilt = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # z along the world's x
    frames = [JointFrame(1, rotation, np.zeros(3)) for rotation in (np.eye(3), np.eye(3), tilt)]
    bases = [WORLD, WORLD, JointFrame(0, tilt, np.zeros(3))]
    kinds = [ROTATION, AXIS, AXIS]

    def proof(tolerance: float) -> ConstraintProof:
        groups = [
            ConstraintGroup(kind, 2 if kind == AXIS else 3, a, b, tolerance)
            for kind, a, b in zip(kinds, bases, frames, strict=True)
        ]
        return prove_path(ConstraintRows(tables, groups), [[0.0], [angle]])

    assert not proof(0.999 * angle).proved
    assert proof(1.001 * angle).proved
    np.testing.assert_allclose(proof(1.001 * angle).bounds, [angle, 0.0, angle], rtol=1.1e-3, atol=1e-11)


def test_places_of_sliding_joints_are_exact() -> None:
    """Of joints that slide along one line the bound is the largest value; that of their motion converges to it."""
    tables = planar(0.3, 0.3, kind=PRISMATIC)
    rows = tip_rows(tables, 0.3, 2.0, at=0.6)
    path = np.array([[0.0, 0.1], [0.5, 0.2], [-0.3, 0.4]])
    np.testing.assert_allclose(prove_path(rows, path).bounds, 0.7, rtol=1e-9)
    rise = Curve(np.array([[0.0, 0.0], [1.0, 0.5]]), np.array([0.0, 1.0]), np.zeros((2, 2)), np.zeros((2, 2)))
    times = np.array([0.0, 1.0, 2.0])
    jerk = 1.5 * np.array([[0.4, 0.2]])
    a = np.concatenate([0.0 * jerk, jerk, 0.0 * jerk])
    v = np.concatenate([0.0 * jerk, jerk / 2.0, jerk])
    q = np.concatenate([0.0 * jerk, jerk / 6.0, jerk])
    motion = Curve(q, times, v, a)
    np.testing.assert_allclose(motion.prove(rows).bounds, 0.9, rtol=0.05)
    np.testing.assert_allclose(motion.divided(32).prove(rows).bounds, 0.9, rtol=1e-4)
    gap = rise.prove(rows)  # a motion that stays, with knots elsewhere: the gaps add up
    assert gap.bounds[0] >= 1.5


def test_joints_that_the_projection_does_not_move_count() -> None:
    tables = planar(0.5, 0.5)
    tip = JointFrame(2, np.eye(3), np.array([0.5, 0.0, 0.0]))
    group = ConstraintGroup(POSITION, 2, WORLD, tip, 0.1, (1.0, 0.0, 0.0))
    rows = ConstraintRows(tables, [group], fixed=[0, 1])
    assert prove_path(rows, [[0.0, 0.0], [0.05, 0.0]]).proved
    assert not prove_path(rows, [[0.0, 0.0], [0.2, 0.0]]).proved


def test_a_constraint_that_stands_at_its_tolerance_is_not_proved_and_ends_soon() -> None:
    """Where |r| is the tolerance all along, no bisection helps; nor does it where all but the rounding is."""
    tables = planar(0.5, 0.5)
    side = JointFrame(2, np.eye(3), np.array([0.5, 0.0, 0.2]))
    frame = JointFrame(0, np.eye(3)[:, [2, 0, 1]], np.zeros(3))  # its first axis is the world's z, about which all turn
    path = np.array([[0.0, 0.0], [1.0, -1.0], [2.0, 1.5]])
    for tolerance, is_proved in ((0.2, False), (0.2 + 1e-13, False), (0.2 + 1e-10, False), (0.21, True)):
        rows = ConstraintRows(tables, [ConstraintGroup(POSITION, 1, frame, side, tolerance)])
        proof = prove_path(rows, path)
        assert proof.proved == is_proved
        assert proof.intervals <= 40_000
        if not is_proved:
            assert proof.value == pytest.approx(0.2, abs=1e-12) and proof.group == 0


def spoiled(place: Callable[[Curve], np.ndarray | None], value: float) -> Curve:
    rng = np.random.default_rng(1)
    curve = random_curve(rng, np.zeros(4), 0.1, 4, True)
    array = place(curve)
    assert array is not None
    array[2, ...] = value
    return curve


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e308])
def test_what_is_no_number_is_not_proved(value: float) -> None:
    """Nor is it in joints that do not move the frames."""
    tree = Tree(3)
    rows = sample(tree, np.random.default_rng(0), links=lambda: (0, 1)).with_tolerances(EVERYTHING)
    assert not rows.residual(np.zeros(4))[1].all(axis=0).all()
    fields = [lambda c: c.times, lambda c: c.states, lambda c: c.velocities, lambda c: c.accelerations]
    for field in fields[:: 1 if abs(value) != 1e308 else 4]:
        proof = spoiled(field, value).prove(rows)
        assert not proof.proved and proof.piece in {1, 2} and proof.group == -1
        assert np.isinf(proof.bounds).all()
    for joint in range(4):
        path = np.zeros((4, 4))
        path[2, joint] = value
        assert not prove_path(rows, path).proved or value == 1e308
        assert not prove_path(rows, path[2:3]).proved or value == 1e308


def test_times_that_decrease_are_not_proved_and_pieces_without_duration_are() -> None:
    rows = sample(Tree(3), np.random.default_rng(0)).with_tolerances(EVERYTHING)
    curve = random_curve(np.random.default_rng(1), np.zeros(4), 0.1, 3, True)
    twice = Curve(*(np.repeat(one, 2, axis=0) for one in curve))
    assert twice.prove(rows).proved
    np.testing.assert_allclose(twice.prove(rows).bounds, curve.prove(rows).bounds, rtol=1e-6)
    times = curve.times
    assert times is not None
    times[1] = times[2] + 0.1
    proof = curve.prove(rows)
    assert not proof.proved and (proof.piece, proof.group) == (1, -1)


def test_one_state_is_a_curve() -> None:
    found, _ = scene(5, 0.1, 1, False, True)
    q = np.full((1, 4), 0.3)
    zero, norms = np.zeros((1, 4)), found.norms(q)[0]
    for curve in (Curve(q), Curve(q, np.zeros(1), zero, zero)):
        proof = curve.prove(found.with_tolerances(norms + 1e-9))
        assert proof.proved and proof.intervals == 1
        np.testing.assert_allclose(proof.bounds, norms, atol=1e-9)
        assert not curve.prove(found.with_tolerances(norms - 1e-9)).proved


def test_a_tray_between_two_arms_is_proved_and_checked_by_pinocchio(robot: Robot) -> None:
    """On states projected onto a closed chain, and along a motion through them, beside the group that keeps it level."""
    real, rng = Real(robot), np.random.default_rng(2)
    left, right = Placed("left_link8", np.eye(4)), Placed("right_link8", np.eye(4))
    pose = np.linalg.inv(real.placement(right, robot.home)) @ real.placement(left, robot.home)
    held, level = Placed("right_link8", pose), Placed(0, real.placement(left, robot.home))
    pairs = [(left, held), (left, held), (level, left)]
    groups = [
        ConstraintGroup(kind, 2 if kind == AXIS else 3, real.frame(a), real.frame(b), most)
        for (a, b), kind, most in zip(pairs, (POSITION, ROTATION, AXIS), (1e-3, 0.01, 0.3), strict=True)
    ]
    found, hands = Sample(real, groups, pairs), robot.groups["hands"]
    rows = ConstraintRows(real.tables, groups, fixed=hands)
    goals, ok = rows.project(
        np.where(np.isin(np.arange(robot.dof), hands), 0.0, 0.3) * rng.normal(size=(40, robot.dof)) + robot.home
    )
    goal = goals[ok][0]
    path, ok = rows.project(robot.home + np.linspace(0.0, 1.0, 65)[:, None] * (goal - robot.home))
    assert ok.all()
    proof = prove_path(rows, path)
    norms = found.norms(Curve(path).dense())
    assert proof.proved and (norms <= proof.bounds).all() and (norms.max(axis=0) >= proof.violations - 1e-9).all()
    off = path.copy()
    off[30, 2] += 0.02
    assert not prove_path(rows, off).proved and prove_path(rows, off).piece in {28, 29, 30}


def test_other_shapes_are_named() -> None:
    rows = sample(Tree(3), np.random.default_rng(0)).rows()
    q, t = np.zeros((3, 4)), np.arange(3.0)
    for call in (
        lambda: prove_path(rows, np.zeros(4)),
        lambda: prove_path(rows, np.zeros((3, 5))),
        lambda: prove_path(rows, np.zeros((0, 4))),
        lambda: prove_motion(rows, t[:2], q, q, q),
        lambda: prove_motion(rows, t, q, q[:2], q),
        lambda: prove_motion(rows, t, q, q, q[:, :3]),
        lambda: prove_motion(rows, t[None], q, q, q),
        lambda: prove_motion(rows, t[:0], q[:0], q[:0], q[:0]),
    ):
        with pytest.raises(ParameterError):
            call()
