"""Constraints between frames of a robot: residuals, projection, path optimization and trees under them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apex_ompl.errors import ParameterError
from apex_ompl.kernel.compiled.arrays import FIXED
from apex_ompl.kernel.compiled.constraint import duration, path_optimization, projection, proof, search
from apex_ompl.kernel.compiled.constraint.rows import AXIS, POSITION, ROTATION, ConstraintArrays, RowBuffers
from apex_ompl.kernel.compiled.layout import Floats, Integers, new_buffers, pack
from apex_ompl.kernel.compiled.path.path_cost import CostSettings, PathReport
from apex_ompl.kernel.compiled.workspace import workspace_sizes
from apex_ompl.kernel.duration import DurationReport, DurationSettings, TimeGrid, duration_buffers
from apex_ompl.kernel.kernel import Kernel
from apex_ompl.kernel.path import PathGrid
from apex_ompl.kernel.search import SearchBuffers, SearchCounts, TreePair
from apex_ompl.kernel.tables import RobotTables
from apex_ompl.types import Array, Flags
from apex_ompl.util.arrays import compact
from apex_ompl.util.validation import check_indices, shape_error

__all__ = [
    "AXIS",
    "POSITION",
    "ROTATION",
    "ConstrainedTreePair",
    "ConstraintGroup",
    "ConstraintProof",
    "ConstraintRows",
    "JointFrame",
    "ManifoldConnection",
    "lower_constrained_duration",
    "optimize_constrained_path",
    "prove_motion",
    "prove_path",
]

MOST_ROWS = {POSITION: 3, AXIS: 2, ROTATION: 3}
LONGEST, PIECES = 0.3, 2  # of an edge of trees [rad], and its chords
CONNECTED_BY = 0.15  # length of an edge of a connection [rad]
MOST_EDGES = 200  # of a connection
AT_ONCE = 8  # random states between two looks at the clock
ORTHOGONAL = 1e-12


class JointFrame(NamedTuple):
    """A frame that is fixed to a joint; joint 0 is the world.

    Attributes:
        joint: Number of the joint.
        rotation: Its axes in the joint's frame, as columns, shape (3, 3).
        point: Its origin there, shape (3,) [m].
    """

    joint: int
    rotation: Array
    point: Array


@dataclass(frozen=True, eq=False)
class ConstraintGroup:
    """Rows of a constraint between two frames that hold together, where |r| <= tolerance.

    Attributes:
        kind: POSITION: places of the second frame's origin along axes of the first one, minus ``value`` [m]; AXIS: the
            rotation vector between their z axes, along x and y of the first [rad]; ROTATION: that between the frames.
        rows: Number of rows: 1 to 3 of a POSITION, for the first axes; 2 and 3 of the others.
        first: First frame.
        second: Second frame.
        tolerance: Largest |r| with which it holds [m, rad].
        value: Values of the rows of a POSITION, shape (3,) [m].
        slack: |r| below which optimizer and projection see no violation; 0 for equalities.
    """

    kind: int
    rows: int
    first: JointFrame
    second: JointFrame
    tolerance: float
    value: Sequence[float] | Array = (0.0, 0.0, 0.0)
    slack: float = 0.0

    def __post_init__(self) -> None:
        """Check what the compiled code trusts.

        Raises:
            ParameterError: Another kind, number of rows, shape or tolerance.
        """
        if self.kind not in MOST_ROWS:
            raise ParameterError("constraint", self.kind, "one of POSITION, AXIS and ROTATION")
        if not (1 if self.kind == POSITION else MOST_ROWS[self.kind]) <= self.rows <= MOST_ROWS[self.kind]:
            raise ParameterError("rows of a constraint", self.rows, f"at most {MOST_ROWS[self.kind]}")
        for frame in (self.first, self.second):
            rotation = np.asarray(frame.rotation, float)
            if rotation.shape != (3, 3) or np.abs(rotation.T @ rotation - np.eye(3)).max() > ORTHOGONAL:
                raise ParameterError("rotation of a constraint's frame", frame.rotation, "a rotation of shape (3, 3)")
            if np.shape(frame.point) != (3,) or not np.isfinite(frame.point).all():
                raise ParameterError("point of a constraint's frame", frame.point, "finite numbers of shape (3,)")
        if np.shape(self.value) != (3,) or not np.isfinite(self.value).all():
            raise ParameterError("value of a constraint", self.value, "finite numbers of shape (3,)")
        if not self.tolerance > 0.0 or not 0.0 <= self.slack < self.tolerance:
            raise ParameterError("tolerance of a constraint", self.tolerance, "above 0 and above its slack")


class ConstraintRows:
    """Groups of rows for a robot; serial, and safe to use from several threads.

    Attributes:
        groups: The groups.
        rows: Number of all rows.
        tolerances: Tolerances of the groups, shape (G,) [m, rad].
        packed: The groups, as compiled code takes them.
    """

    def __init__(
        self, robot: RobotTables, groups: Sequence[ConstraintGroup], fixed: Sequence[int] | NDArray[np.intp] = ()
    ) -> None:
        """Tabulate groups; planned joints whose numbers are ``fixed`` are not moved.

        Raises:
            ParameterError: There is no group, or one is on a joint that the robot does not have.
        """
        arrays = robot.arrays
        joints = [(int(g.first.joint), int(g.second.joint)) for g in groups]
        most = len(arrays.joint_parent) - 1
        if not groups or min(min(pair) for pair in joints) < 0 or max(max(pair) for pair in joints) > most:
            raise ParameterError("constraints", joints, f"groups on joints 0 to {most}")
        check_indices(fixed, robot.dof, "fixed", "planned joints")
        self.robot, self.groups = robot, tuple(groups)
        self.rows = sum(g.rows for g in groups)
        self.tolerances = np.array([g.tolerance for g in groups])
        self._workspace_sizes = workspace_sizes(arrays)
        parents = arrays.joint_parent.tolist()
        spans, links, sides, chain = list[tuple[int, int]](), list[int](), list[float](), set[int]()
        for first, second in joints:
            above, below = _ancestors(parents, first), _ancestors(parents, second)
            chain.update(above, below)
            mine = [(j, 1.0) for j in below if j not in above]
            mine += [(j, -1.0) for j in reversed(above) if j not in below]
            mine = [(j, side) for j, side in mine if arrays.joint_kind[j] != FIXED and arrays.joint_source[j] >= 0]
            spans.append((len(links), len(mine)))
            links += [j for j, _ in mine]
            sides += [side for _, side in mine]
        scale = np.ones(robot.dof)
        scale[list(fixed)] = 0.0
        self.packed: tuple[Integers, Floats] = pack(
            ConstraintArrays(
                kind=np.array([g.kind for g in groups], np.int64), rows=np.array([g.rows for g in groups], np.int64),
                joints=np.array(joints, np.int64), span=np.array(spans, np.int64),
                chain=np.array(sorted(chain), np.int64), link=np.array(links, np.int64), side=np.array(sides),
                rotation=np.array([[g.first.rotation, g.second.rotation] for g in groups], float),
                point=np.array([[g.first.point, g.second.point] for g in groups], float),
                value=np.array([g.value for g in groups], float), tolerance=self.tolerances,
                slack=np.array([g.slack for g in groups]), scale=scale,
            )
        )  # fmt: skip

    def norms(self, states: ArrayLike) -> Array:
        """Return |r| of each group at states, shape (N, G) [m, rad].

        Raises:
            ParameterError: Another shape than (N, dof).
        """
        q = self._states(states)
        found = np.empty((len(q), len(self.groups)))
        projection.constraint_norms(*self._head(), q, found, *self.buffers(), self.rows)
        return found

    def residual(self, q: ArrayLike, share: float = 0.0) -> tuple[Array, Array]:
        """Return the rows at a state, shape (m,), and their Jacobian, shape (m, dof).

        Args:
            q: The state, shape (dof,).
            share: Factor on dead zones; with 0 all groups have all of their rows.

        Raises:
            ParameterError: Another shape.
        """
        state = compact(q)
        if state.shape != (self.robot.dof,):
            raise shape_error(state, (self.robot.dof,), "state")
        integers, floats, b = new_buffers(RowBuffers, rows=self.rows, dof=self.robot.dof)
        m = projection.constraint_rows(*self._head(), state, float(share), integers, floats, self.rows)
        return b.residual[:m], b.jacobian[:m]

    def project(
        self, states: ArrayLike, tolerance: float = 1e-9, steps: int = 20, share: float = 1.0
    ) -> tuple[Array, Flags]:
        """Return states moved onto the constraints, inside the limits, shape (N, dof), and which arrived, shape (N,).

        Newton's method with the pseudoinverse; groups with a slack end inside of it.

        Args:
            states: The states, shape (N, dof).
            tolerance: Norm of all rows at which to stop.
            steps: Most steps.
            share: Factor on dead zones.

        Raises:
            ParameterError: Another shape.
        """
        ends = np.array(self._states(states), order="C")
        counts = np.empty(len(ends), np.int64)
        projection.project_states(
            *self._head(), ends, float(share), float(tolerance), int(steps), counts, *self.buffers(), self.rows
        )
        return ends, counts >= 0

    def buffers(self) -> tuple[Integers, Floats]:
        """Return memory for compiled code."""
        integers, floats = projection.row_buffer_sizes(self.rows, self.robot.dof)
        return np.empty(integers, np.int64), np.empty(floats)

    def _head(self) -> tuple[Integers | Floats, ...]:
        integers, floats = self._workspace_sizes
        return *self.robot.packed, np.empty(integers, np.int64), np.empty(floats), *self.packed

    def _states(self, states: ArrayLike) -> Array:
        q = np.array(states, float, order="C", ndmin=2)
        if q.ndim != 2 or q.shape[1] != self.robot.dof:
            raise shape_error(q, ("N", self.robot.dof), "states")
        return q


def _ancestors(parents: Sequence[int], joint: int) -> list[int]:
    """Return a joint and those above it but for the world, the joint first."""
    found = []
    while joint > 0:
        found.append(joint)
        joint = parents[joint]
    return found


def optimize_constrained_path(
    kernel: Kernel, rows: ConstraintRows, grid: PathGrid, pinned: int, control: Array, settings: CostSettings,
    weight: float, buffers: tuple[Integers, Array], share: float = 1.0,
) -> PathReport:  # fmt: skip
    """Improve a path in place with a penalty on rows of constraints at its samples.

    Args:
        kernel: The robot among its obstacles.
        rows: The constraints.
        grid: Samples of the path.
        pinned: Number of control points at each end that stay.
        control: Control points, shape (P, dof).
        settings: Margins, stiffness and steps.
        weight: Weight of half the mean of the squared rows [1/m^2, 1/rad^2].
        buffers: Memory of :func:`apex_ompl.kernel.path.optimization_buffers`.
        share: Factor on dead zones.
    """
    return PathReport(
        *path_optimization.optimize_constrained_path(
            *kernel.packed,
            *kernel.workspace(),
            *grid,
            pinned,
            control,
            tuple(settings),
            *buffers,
            *rows.packed,
            float(weight),
            float(share),
            rows.rows,
            *rows.buffers(),
        )  # fmt: skip
    )


def lower_constrained_duration(
    kernel: Kernel, rows: ConstraintRows, grid: TimeGrid, limits: Array, pinned: int, control: Array, spacing: float,
    settings: DurationSettings, weight: float, share: float = 1.0,
) -> DurationReport:  # fmt: skip
    """Lower the objective of a motion from rest to rest in place, with a penalty on rows of constraints at its samples.

    Args:
        kernel: The robot among its obstacles.
        rows: The constraints.
        grid: Samples of the motion.
        limits: Limits of velocity, acceleration and jerk, shape (3, dof); 0 for joints that stay.
        pinned: Number of control points at each end that stay.
        control: Control points, shape (P, dof), inside the position limits.
        spacing: Knot spacing, with which the motion is inside all limits [s].
        settings: Objective, margin and steps.
        weight: Weight of half the square of a row [1/m^2, 1/rad^2].
        share: Factor on dead zones.
    """
    return DurationReport(
        *duration.lower_constrained_duration(
            *kernel.packed, *kernel.workspace(), *grid, limits, pinned, float(spacing), control, tuple(settings),
            *duration_buffers(grid, control, pinned), *rows.packed, float(weight), float(share), rows.rows,
            *rows.buffers(),
        )
    )  # fmt: skip


class ConstrainedTreePair(TreePair):
    """RRT-Connect on the manifold of constraints, see :mod:`apex_ompl.kernel.compiled.constraint.search`."""

    def __init__(
        self, kernel: Kernel, rows: ConstraintRows, starts: Array, goals: Array, resolution: float,
        rng: np.random.Generator, longest: float = LONGEST, pieces: int = PIECES,
    ) -> None:  # fmt: skip
        """Plant the trees.

        Args:
            kernel: The robot among its obstacles, with the limits of the states.
            rows: The constraints.
            starts: Roots of one tree, on the constraints, shape (N, dof); they are taken to be free.
            goals: Roots of the other, shape (N, dof).
            resolution: Largest spacing of the states that are checked along an edge [rad, max-norm].
            rng: Source of the random states.
            longest: Length of an edge before its projection [rad].
            pieces: Number of chords of an edge.
        """
        super().__init__(kernel, starts, goals, 2.0 * longest, resolution, rng)
        self._longest, self._at_once = longest, AT_ONCE
        self._constrained = *rows.packed, int(pieces), rows.rows, *rows.buffers(), np.empty((2, kernel.robot.dof))

    def _advance(self, samples: Array) -> int:
        return int(search.grow_constrained_trees(*self._arguments(samples), *self._constrained))


class ManifoldConnection:
    """Connections of states on the manifold of constraints, in edges as trees have them."""

    def __init__(
        self, kernel: Kernel, rows: ConstraintRows, resolution: float, longest: float = CONNECTED_BY,
        pieces: int = PIECES,
    ) -> None:  # fmt: skip
        """Connect states; arguments as of :class:`ConstrainedTreePair`."""
        self._kernel, self._resolution, self._longest = kernel, resolution, longest
        self._buffers = SearchBuffers(kernel, 2.0 * longest, resolution)
        self._constrained = *rows.packed, int(pieces), rows.rows, *rows.buffers(), np.empty((2, kernel.robot.dof))

    def between(self, first: Array, last: Array, most: int = MOST_EDGES) -> Array | None:
        """Return states from one to another, shape (N, dof), or None where the way by projected steps does not arrive.

        Args:
            first: The first state, shape (dof,).
            last: The last state, shape (dof,).
            most: Largest number of edges.
        """
        nodes, target = np.empty((most, len(first))), np.array(last)
        count = search.connect_states(
            *self._kernel.packed, *self._buffers.workspace, compact(first), self._longest, self._resolution, target,
            nodes, *self._buffers.proof, *self._constrained,
        )  # fmt: skip
        return None if count < 0 else np.concatenate([first[None], nodes[:count]])

    def take_counts(self) -> SearchCounts:
        """Return the counts since the last call."""
        return self._buffers.take_counts()


@dataclass(frozen=True, eq=False)
class ConstraintProof:
    """Whether G groups hold along a whole curve, see :mod:`apex_ompl.kernel.compiled.constraint.proof`.

    Attributes:
        proved: Whether |r| <= tolerance holds for all of them.
        bounds: Proved upper bounds on their largest |r|, shape (G,) [m, rad]; infinite where it is not proved.
        violations: Their largest |r| at the states that were examined, shape (G,).
        intervals: Number of intervals that were examined.
        piece: Piece between states ``piece`` and ``piece + 1`` at which the proof failed, or -1.
        share: Place on that piece, from 0 to 1.
        group: Group that failed there; -1 where it did not, or where the piece has no numbers.
        value: Its |r| there; where that is within the tolerance, it is so near to it that bisection did not end.
    """

    proved: bool
    bounds: Array
    violations: Array
    intervals: int
    piece: int = -1
    share: float = math.nan
    group: int = -1
    value: float = math.nan


def prove_path(rows: ConstraintRows, states: ArrayLike) -> ConstraintProof:
    """Prove that constraints hold along straight lines between states; what has no finite numbers is not proved.

    Args:
        rows: The constraints.
        states: One or more states, shape (N, dof).

    Raises:
        ParameterError: Another shape.
    """
    q = compact(states)
    if q.ndim != 2 or q.shape[1] != rows.robot.dof or len(q) == 0:
        raise shape_error(q, ("N", rows.robot.dof), "states")
    none = np.empty((0, rows.robot.dof))
    return _proof(rows, np.empty(0), q, none, none)


def prove_motion(
    rows: ConstraintRows, times: ArrayLike, positions: ArrayLike, velocities: ArrayLike, accelerations: ArrayLike
) -> ConstraintProof:
    """Prove that constraints hold along a motion of constant jerk between knots.

    Gaps between the end of a piece and the knot there are counted in. What has no finite numbers, or times that
    decrease, is not proved.

    Args:
        rows: The constraints.
        times: Times of the knots, one or more, shape (K,) [s].
        positions: At them, shape (K, dof).
        velocities: At them.
        accelerations: At them.

    Raises:
        ParameterError: Another shape.
    """
    knots, states = compact(times), tuple(compact(one) for one in (positions, velocities, accelerations))
    if knots.ndim != 1 or len(knots) == 0:
        raise shape_error(knots, ("K",), "times")
    for one, name in zip(states, ("positions", "velocities", "accelerations"), strict=True):
        if one.shape != (len(knots), rows.robot.dof):
            raise shape_error(one, (len(knots), rows.robot.dof), name)
    return _proof(rows, knots, *states)


def _proof(rows: ConstraintRows, *curve: Array) -> ConstraintProof:
    integers, floats, b = new_buffers(proof.ConstraintProofBuffers, groups=len(rows.groups), dof=rows.robot.dof)
    outcome = proof.prove_constraints(*rows._head(), *curve, *rows.buffers(), rows.rows, integers, floats)
    (intervals, piece, group), violations = b.counts.tolist(), b.violations.copy()
    if outcome == proof.PROVED:
        return ConstraintProof(True, b.bounds.copy(), violations, intervals)
    return ConstraintProof(
        False, np.full(len(rows.groups), np.inf), violations, intervals, piece, float(b.figures[0]), group,
        float(b.figures[1]),
    )  # fmt: skip
