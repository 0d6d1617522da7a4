"""Constraints along a path as residuals, the violation of states, and projection onto the constraints.

A record of :mod:`apex_ompl.scene.constraints` becomes one or more groups of rows of the kernel, each with a tolerance:
POSITION (coordinates of a frame's origin in another frame), AXIS (the angle between two axes) and ROTATION (the angle
between two frames). It holds where |r| <= tolerance for each of its groups. Constraints of a user's own are evaluated
in Python.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from apex_ompl.constraints.frames import frame_of
from apex_ompl.constraints.links import Links
from apex_ompl.constraints.user import UserConstraint, check_user_constraint
from apex_ompl.errors import ConstraintError
from apex_ompl.kernel.constraints import AXIS, POSITION, ROTATION, ConstraintGroup, ConstraintRows, JointFrame
from apex_ompl.kernel.library import compile_for_constraints
from apex_ompl.kernel.products import cholesky, product, solve
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject, pose_matrix
from apex_ompl.scene.constraints import (
    WORLD,
    Constraint,
    FixedOrientation,
    OnLine,
    OnPlane,
    RelativePose,
    ToolRegion,
    Upright,
)
from apex_ompl.types import Array, Flags
from apex_ompl.util.arrays import length

SLACK = 0.8  # dead zone of an inequality, as a share of its tolerance
EDGE = 0.02  # largest distance between the dead zone of a region and its bounds [m]
HALF_SPACE = 10.0  # half the width that stands for that of a region with one bound along an axis [m]
EXACT = 1e-3  # tolerance up to which a region has no dead zone [m]
ROUNDING = 1e-12  # in units of a tolerance
STEPS, MANY_STEPS = 20, 60  # most steps of Newton's method: of a projection, and where contradictions are looked for
NEWTON_END = 1e-9  # |r| at which it stops with constraints of a user's own
DAMPING = 1e-10  # of the normal equations of these steps
BATCH, BATCHES, USER_BATCHES = (
    50,
    10,
    2,
)  # states around the start, and random ones, where contradictions are looked for
SPREAD = 0.3  # standard deviation of states around the start [rad]
AXES = ("x", "y", "z")


Residual = Callable[[Array], tuple[Array, Array]]
"""Returns rows at a state, shape (m,), and their Jacobian, shape (m, dof)."""


class Part(NamedTuple):
    """A group of rows of a constraint, and what its |r| is called in messages.

    Attributes:
        group: The rows.
        what: The name: ``distance``, ``angle``, or that of an axis along which a region has bounds.
    """

    group: ConstraintGroup
    what: str

    def fault(self, size: float) -> str:
        """Return a clause on a norm |r| above the tolerance [m or rad]."""
        tolerance = self.group.tolerance
        if self.what in AXES:
            return f"{self.what} is {size - tolerance:.4g} m outside of its bounds"
        unit = "m" if self.group.kind == POSITION else "rad"
        return f"the {self.what} is {size:.4g} {unit}, expected at most {tolerance:.4g} {unit}"


class Member(NamedTuple):
    """A constraint of a set: its name and its groups of rows, or a constraint of a user's own."""

    name: str
    parts: tuple[Part, ...]
    user: UserConstraint | None = None


class Projected(NamedTuple):
    """States that were moved onto constraints.

    Attributes:
        states: Shape (N, dof), inside the limits.
        ok: Whether each satisfies the constraints, shape (N,).
    """

    states: Array
    ok: Flags


class ConstraintSet:
    """The constraints along a path, safe to use from several threads; made by :meth:`of`.

    Attributes:
        robot: The robot.
        names: Names of the C constraints, such as ``upright of left_hand``.
        tolerances: Tolerance of each, shape (C,): that of its first group [m or rad], or a user's own.
        rows: The groups of rows of all of them, or None where there are none.
        user: Constraints of a user's own.
        fixed: Planned joints that projection leaves alone, by their numbers.
    """

    def __init__(self, robot: Robot, members: Sequence[Member], start: Array, fixed: Sequence[int]) -> None:
        """Tabulate the rows.

        Args:
            robot: The robot.
            members: The constraints.
            start: The start, shape (dof,).
            fixed: Planned joints that projection leaves alone.
        """
        self.robot, self.start, self.fixed = robot, start, tuple(fixed)
        self._members = tuple(members)
        self.names = _told_apart([member.name for member in members])
        self._parts = tuple(part for member in members for part in member.parts)
        self._owners = [k for k, member in enumerate(members) for _ in member.parts]
        self.user = tuple(member.user for member in members if member.user is not None)
        self._user_owners = [k for k, member in enumerate(members) if member.user is not None]
        groups = [part.group for part in self._parts]
        self.rows = ConstraintRows(Links.of(robot).tables, groups, self.fixed) if groups else None
        self._part_tolerances = np.array([group.tolerance for group in groups])
        self._user_tolerances = np.array([one.tolerance for one in self.user], float)
        self.tolerances = np.array(
            [m.parts[0].group.tolerance if m.user is None else float(m.user.tolerance) for m in members]
        )

    @classmethod
    def of(
        cls, robot: Robot, constraints: Sequence[Constraint | UserConstraint], attached: Sequence[AttachedObject],
        start: ArrayLike, fixed: Sequence[int] | None = None,
    ) -> ConstraintSet:  # fmt: skip
        """Return the constraints of a plan, with the closed chains of objects that two links hold.

        Args:
            robot: The robot.
            constraints: Records and constraints of a user's own.
            attached: The held objects.
            start: The start, shape (dof,), which gives what a record leaves open.
            fixed: Planned joints that projection leaves alone; those that close the hands by default.

        Raises:
            UnknownNameError: A frame is not a hand, a link or a held object.
            ConstraintError: No planned joint moves the frames of a constraint against each other.
            ParameterError: A constraint is neither a record nor one of a user's own that can be used.
        """
        compile_for_constraints()
        state = np.clip(np.asarray(start, float), robot.limits.lower, robot.limits.upper)  # as plans clip it
        tables = _Tables(robot, attached, state)
        members = [tables.member(one) if isinstance(one, Constraint) else _of_user(one, state) for one in constraints]
        for held in attached:
            if held.links is not None:
                closed = RelativePose(first=held.links[0], second=held.links[1])
                members.append(tables.member(closed)._replace(name=f"closed chain of {held.name}"))
        if fixed is None:
            hands = (hand.synergy for hand in robot.hands.values() if hand.synergy is not None)
            fixed = [robot.joint_names.index(name) for name in hands]
        return cls(robot, members, state, fixed)

    def __len__(self) -> int:
        """Return the number of constraints."""
        return len(self.names)

    def by_constraint(self, groups: Array, user: Array) -> Array:
        """Return the norms of constraints from those of groups, in the unit of each constraint's tolerance.

        A constraint of several groups has the largest norm relative to the tolerance of the group, times the tolerance
        of the first group: it is at most that one where all groups hold.

        Args:
            groups: Norms |r| of the groups of ``rows``, shape (..., G).
            user: Norms of the constraints of a user's own, shape (..., U).

        Returns:
            Norms, shape (..., C).
        """
        found = np.zeros((*groups.shape[:-1], len(self)))
        for g, owner in enumerate(self._owners):
            relative = groups[..., g] * (self.tolerances[owner] / self._part_tolerances[g])
            found[..., owner] = np.maximum(found[..., owner], relative)
        for u, owner in enumerate(self._user_owners):
            found[..., owner] = user[..., u]
        return found

    def violations(self, states: ArrayLike) -> Array:
        """Return |r| of each constraint at states, shape (N, dof), as :meth:`by_constraint` does, shape (N, C)."""
        return self.by_constraint(*self._norms(states))

    def is_satisfied(self, q: ArrayLike) -> bool:
        """Whether a state, shape (dof,), satisfies all constraints, up to rounding."""
        return bool(self._satisfied(self._states(q))[0])

    def fault(self, q: ArrayLike) -> str:
        """Return a sentence on the constraint that a state, shape (dof,), violates most; empty if it satisfies all."""
        name, clause = self._worst(q)
        return f"{name}: {clause}" if clause else ""

    def project(self, states: ArrayLike, steps: int = STEPS) -> Projected:
        """Move states, shape (N, dof), onto the constraints by Newton's method, inside the limits.

        Inequalities end inside of their dead zones. There are at most ``steps`` steps.
        """
        q = self._states(states)
        if self.user:
            found = [self.newton(row, steps=steps) for row in q]
            ends = np.array([end for end, _ in found]).reshape(q.shape)
            arrived = np.array([there for _, there in found], bool)
        elif self.rows is not None:
            ends, arrived = self.rows.project(q, steps=steps)
        else:
            ends = np.clip(q, self.robot.limits.lower, self.robot.limits.upper)
            arrived = np.ones(len(q), bool)
        return Projected(ends, arrived & self._satisfied(ends))

    def check(self, seed: int = 0) -> None:
        """Look for a state that satisfies the constraints, from the start, around it and from random states.

        Raises:
            ConstraintError: None was found; the message names the constraint that fails alone, else all of them.
        """
        found, _, _ = self._search(seed)
        if found:
            return
        text = "no state within the limits was found that satisfies"
        for name, member in zip(self.names, self._members, strict=True):
            alone, _, clause = ConstraintSet(self.robot, [member], self.start, self.fixed)._search(seed)
            if not alone:
                raise ConstraintError(name, f"{text} it; at the nearest one, {clause}")
        _, name, clause = self._search(seed)
        raise ConstraintError(", ".join(self.names), f"{text} all of them; at the nearest one, {name}: {clause}")

    def _search(self, seed: int) -> tuple[bool, str, str]:
        """Return whether a state was found that satisfies the constraints, else what is worst at the nearest one."""
        rng, nearest, least = np.random.default_rng(seed), self.start, np.inf
        lower, upper = self.robot.limits.lower, self.robot.limits.upper
        for _ in range(USER_BATCHES if self.user else BATCHES):
            around = np.clip(self.start + SPREAD * rng.normal(size=(BATCH, len(lower))), lower, upper)
            states = np.vstack([self.start, around, self.robot.random_state(rng, BATCH)])
            states[:, list(self.fixed)] = self.start[list(self.fixed)]
            ends, ok = self.project(states, MANY_STEPS)
            if ok.any():
                return True, "", ""
            relative = (self.violations(ends) / self.tolerances).max(axis=1)
            k = int(np.argmin(np.where(np.isnan(relative), np.inf, relative)))
            if relative[k] < least:
                nearest, least = ends[k], float(relative[k])
        return False, *self._worst(nearest)

    def _worst(self, q: ArrayLike) -> tuple[str, str]:
        """Return the name of the constraint that a state violates most, and a clause on it; two empty texts if none."""
        groups, user = self._norms(q)
        relative = np.concatenate([groups[0] / self._part_tolerances, user[0] / self._user_tolerances])
        if not len(relative) or (relative <= 1.0 + ROUNDING).all():
            return "", ""
        worst = int(np.argmax(np.where(np.isnan(relative), np.inf, relative)))
        if worst < len(self._parts):
            return self.names[self._owners[worst]], self._parts[worst].fault(float(groups[0, worst]))
        u = worst - len(self._parts)
        clause = f"the residual is {user[0, u]:.4g}, expected at most {self._user_tolerances[u]:.4g}"
        return self.names[self._user_owners[u]], clause

    def _satisfied(self, states: Array) -> Flags:
        return np.asarray((self.violations(states) <= self.tolerances * (1.0 + ROUNDING)).all(axis=1), bool)

    def _norms(self, states: ArrayLike) -> tuple[Array, Array]:
        """Return |r| of groups and of a user's own constraints at states, shapes (N, G) and (N, U)."""
        q = self._states(states)
        groups = np.zeros((len(q), 0)) if self.rows is None else self.rows.norms(q)
        user = [[length(np.asarray(one.residual(row.copy()), float)) for one in self.user] for row in q]
        return groups, np.array(user, float).reshape(len(q), len(self.user))

    def _states(self, states: ArrayLike) -> Array:
        return np.array(states, float, ndmin=2)

    def newton(self, q: Array, also: Residual | None = None, *, steps: int = STEPS) -> tuple[Array, bool]:
        """Return the end of Newton's method with the pseudoinverse from a state, and whether it arrived.

        A joint that a step takes beyond a limit stays out of the next step.

        Args:
            q: The state, shape (dof,).
            also: Further rows, such as those of a goal, and their Jacobian.
            steps: Most steps.
        """
        lower, upper = self.robot.limits.lower, self.robot.limits.upper
        q, free = np.clip(q, lower, upper), np.ones(len(q), bool)
        for step in range(steps + 1):
            r, jacobian = self.residual(q, also)
            if length(r) <= NEWTON_END:
                return q, True
            if step == steps or not np.isfinite(r).all() or not np.isfinite(jacobian).all():
                break
            j = jacobian * free
            factor = cholesky(product(j, j.T) + DAMPING * np.eye(len(r)))
            if not np.isfinite(factor).all():
                break
            moved = q - product(j.T, solve(factor, r[:, None]))[:, 0]
            q = np.clip(moved, lower, upper)
            free = q == moved
        return q, self.is_satisfied(q)

    def residual(self, q: Array, also: Residual | None = None) -> tuple[Array, Array]:
        """Return the rows outside of dead zones, shape (m,), and their Jacobian, shape (m, dof); see :meth:`newton`."""
        rows = [] if self.rows is None else [self.rows.residual(q, 1.0)]
        for one in self.user:
            rows.append((np.array(one.residual(q.copy()), float), np.array(one.jacobian(q.copy()), float)))
        rows += [] if also is None else [also(q)]
        for _, jacobian in rows:
            jacobian[:, list(self.fixed)] = 0.0
        return np.concatenate([r for r, _ in rows]), np.vstack([jacobian for _, jacobian in rows])


class _Placed(NamedTuple):
    """A frame: its joint, its pose in the joint's frame, and in the world at the start [m]."""

    joint: int
    pose: pin.SE3
    start: pin.SE3

    def turned(self, turn: Array) -> JointFrame:
        """Return the frame with its axes turned by a rotation in its own frame, shape (3, 3)."""
        return JointFrame(self.joint, product(self.pose.rotation, turn), self.pose.translation.copy())


class _Tables:
    """What the frames of constraints are in the kernel, and the groups of rows of records."""

    def __init__(self, robot: Robot, attached: Sequence[AttachedObject], start: Array) -> None:
        self.robot, self.start = robot, start
        self.held = {one.name: one for one in attached}
        self.links = Links.of(robot)

    def member(self, constraint: Constraint) -> Member:
        """Return a constraint with its groups of rows."""
        match constraint:
            case Upright():
                return self._upright(constraint)
            case RelativePose():
                return self._relative_pose(constraint)
            case OnPlane():
                turn = _with_last(constraint.normal)[:, [2, 0, 1]]
                return self._on_axes("plane", constraint, turn, 1)
            case OnLine():
                return self._on_axes("line", constraint, _with_last(constraint.direction), 2)
            case FixedOrientation():
                return self._fixed_orientation(constraint)
            case ToolRegion():
                return self._tool_region(constraint)
        raise TypeError(type(constraint))

    def _upright(self, c: Upright) -> Member:
        name, frame = f"upright of {c.frame}", self._frame(c.frame)
        up, axis = _in_world(_with_last(c.up)), frame.turned(_with_last(c.axis))
        group = ConstraintGroup(AXIS, 2, up, axis, tolerance=c.angle, slack=SLACK * c.angle)
        return self._checked(name, [Part(group, "angle")])

    def _relative_pose(self, c: RelativePose) -> Member:
        first, second = self._frame(c.first, or_world=True), self._frame(c.second)
        pose = (
            first.start.actInv(second.start)
            if c.pose is None
            else pin.SE3(pose_matrix(c.pose.position, c.pose.orientation))
        )
        parts = []
        kept = [k for k in range(3) if AXES[k] not in c.free]
        if kept:
            # the axes that are kept come first, by a cyclic order, so that they stay right-handed
            order = next(shift for shift in ([0, 1, 2], [1, 2, 0], [2, 0, 1]) if sorted(shift[: len(kept)]) == kept)
            frames = first.turned(np.eye(3)[:, order]), second.turned(np.eye(3))
            group = ConstraintGroup(
                POSITION, len(kept), *frames, tolerance=c.tolerance.position, value=pose.translation[order]
            )
            parts.append(Part(group, "distance"))
        turns = [k for k in range(3) if f"r{AXES[k]}" in c.free]
        if not turns:
            frames = first.turned(pose.rotation), second.turned(np.eye(3))
            parts.append(Part(ConstraintGroup(ROTATION, 3, *frames, tolerance=c.tolerance.angle), "angle"))
        elif len(turns) == 1:
            axis = _with_last(np.eye(3)[turns[0]])
            frames = first.turned(product(pose.rotation, axis)), second.turned(axis)
            parts.append(Part(ConstraintGroup(AXIS, 2, *frames, tolerance=c.tolerance.angle), "angle"))
        return self._checked(f"pose of {c.second} in {c.first}", parts)

    def _on_axes(self, what: str, c: OnPlane | OnLine, turn: Array, rows: int) -> Member:
        """Return a constraint to a point along the first ``rows`` axes of ``turn``."""
        frame = self._frame(c.frame)
        point = frame.start.translation if c.point is None else np.array(c.point)
        group = ConstraintGroup(POSITION, rows, _in_world(turn, point), frame.turned(np.eye(3)), tolerance=c.tolerance)
        return self._checked(f"{what} of {c.frame}", [Part(group, "distance")])

    def _fixed_orientation(self, c: FixedOrientation) -> Member:
        frame = self._frame(c.frame)
        wanted = frame.start.rotation if c.orientation is None else _rotation(c.orientation)
        group = ConstraintGroup(ROTATION, 3, _in_world(wanted), frame.turned(np.eye(3)), tolerance=c.angle)
        return self._checked(f"orientation of {c.frame}", [Part(group, "angle")])

    def _tool_region(self, c: ToolRegion) -> Member:
        frame, turn, parts = self._frame(c.frame), _rotation(c.orientation), list[Part]()
        own, origin = frame.turned(np.eye(3)), np.array(c.position)
        for k in range(3):
            low, high = c.lower[k], c.upper[k]
            if low is None:
                if high is None:
                    continue
                low = high - 2.0 * HALF_SPACE
            if high is None:
                high = low + 2.0 * HALF_SPACE
            half = (high - low) / 2.0
            along = np.roll(turn, -k, axis=1)  # axis k first
            group = ConstraintGroup(
                POSITION, 1, _in_world(along, origin), own, tolerance=half, value=((low + high) / 2.0, 0.0, 0.0),
                slack=half - min((1.0 - SLACK) * half, EDGE) if half > EXACT else 0.0,
            )  # fmt: skip
            parts.append(Part(group, AXES[k]))
        if c.angle is not None:
            group = ConstraintGroup(ROTATION, 3, _in_world(turn), own, tolerance=c.angle, slack=SLACK * c.angle)
            parts.append(Part(group, "angle"))
        return self._checked(f"region of {c.frame}", parts)

    def _frame(self, name: str, or_world: bool = False) -> _Placed:
        if or_world and name == WORLD:
            return _Placed(0, pin.SE3.Identity(), pin.SE3.Identity())
        frame = frame_of(self.robot, name, self.held, "frame of a constraint")
        joint, pose = self.links.frame(frame.link, pin.SE3(frame.pose))
        return _Placed(joint, pose, pin.SE3(self.robot.link_pose(self.start, frame.link)) * pin.SE3(frame.pose))

    def _checked(self, name: str, parts: Sequence[Part]) -> Member:
        for part in parts:
            if not self.links.moved(part.group.first.joint, part.group.second.joint):
                raise ConstraintError(name, "expected frames that planned joints move against each other")
        return Member(name, tuple(parts))


def _of_user(constraint: object, start: Array) -> Member:
    user = check_user_constraint(constraint, start)
    return Member(user.name, (), user)


def _told_apart(names: Sequence[str]) -> tuple[str, ...]:
    """Return names with a number behind those that others before have."""
    counts = [names[:k].count(name) + 1 for k, name in enumerate(names)]
    return tuple(name if count == 1 else f"{name} ({count})" for name, count in zip(names, counts, strict=True))


def _in_world(rotation: Array, point: Array | None = None) -> JointFrame:
    return JointFrame(0, rotation, np.zeros(3) if point is None else point)


def _rotation(orientation: Sequence[float]) -> Array:
    return pose_matrix((0.0, 0.0, 0.0), orientation)[:3, :3]


def _with_last(direction: ArrayLike) -> Array:
    """Return a rotation whose last axis has a direction, shape (3, 3)."""
    last = np.asarray(direction, float) / length(direction)
    first = np.cross(np.eye(3)[int(np.argmin(np.abs(last)))], last)
    first = first / length(first)
    return np.column_stack([first, np.cross(last, first), last])
