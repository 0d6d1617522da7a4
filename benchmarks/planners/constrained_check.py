"""What the rivals under constraints share: the check of their paths.

The check evaluates constraints by Pinocchio from the record of the problem, independent of the kernel, and looks for
collisions, at states twenty times as dense as those of the search. A rival's path is refined before it,
in its favor: states between its own are moved to the constraint. Its times do not include refinement and check.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import pinocchio as pin

from apex_ompl.api import load_problem
from apex_ompl.collision import CollisionChecker
from apex_ompl.constraints.constraint_set import ConstraintSet
from apex_ompl.constraints.frames import frame_of
from apex_ompl.evaluation.rows import Job
from apex_ompl.ompl.setup import PlanningSetup
from apex_ompl.paths.path import SEARCH_RESOLUTION, path_length, states_between
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import pose_matrix
from apex_ompl.scene.constraints import WORLD, FixedOrientation, OnLine, OnPlane, RelativePose, ToolRegion, Upright
from apex_ompl.scene.problem import Problem
from apex_ompl.types import Array
from apex_ompl.util.clocks import timed

DENSE = SEARCH_RESOLUTION / 20.0  # spacing of the states of the check [rad, max-norm]
REFINED = 0.01  # of those of a rival's path after refinement [rad, max-norm]
SLACK = 1e-9  # by which a violation may pass its tolerance, for rounding [m, rad]

LATE = 1.1  # times the limit, until which a rival's path counts: rivals look at the clock from time to time
WARM_UP = "carry_tray"  # problem of the runs that load code

Residual = Callable[[Mapping[str, Array]], Array]
"""Distance or angle from what is wanted, over its tolerance, shape (...), by the poses of frames, shape (..., 4, 4)."""


@dataclass(frozen=True)
class DenseCheck:
    """What the check of a path found.

    Attributes:
        states: Number of states that were checked.
        violation: Largest violation of a constraint over its tolerance.
        free: Whether no state collides.
    """

    states: int
    violation: float
    free: bool

    def __bool__(self) -> bool:
        """Whether the path keeps its constraints and is free."""
        return self.free and self.violation <= 1.0 + SLACK


class FrameReader:
    """Poses of frames of a problem at states, by Pinocchio."""

    def __init__(self, robot: Robot, problem: Problem) -> None:
        """Prepare for the frames that constraints of the problem name."""
        self.robot, self._data = robot, robot.model.createData()
        self._held = {body.name: body for body in problem.attached}

    def __call__(self, states: Array, names: tuple[str, ...]) -> dict[str, Array]:
        """Return the poses in the world of frames at states, shape (..., dof); shape (..., 4, 4) each [m]."""
        model, data, rows = self.robot.model, self._data, np.atleast_2d(states)
        frames = [frame_of(self.robot, name, self._held) for name in names]
        numbers = [self.robot.link_frame(frame.link) for frame in frames]
        found = np.empty((len(names), len(rows), 4, 4))
        for k, q in enumerate(rows):
            pin.forwardKinematics(model, data, self.robot.to_pinocchio(q))
            for n, number in enumerate(numbers):
                found[n, k] = pin.updateFramePlacement(model, data, number).homogeneous
        shape = (*np.shape(states)[:-1], 4, 4)
        poses = {
            name: (found[n] @ frame.pose).reshape(shape)
            for n, (name, frame) in enumerate(zip(names, frames, strict=True))
        }
        return {**poses, WORLD: np.broadcast_to(np.eye(4), shape)}


def _turned(first: Array, second: Array) -> Array:
    """Return the angles between orientations, shape (...) [rad]."""
    turn = np.swapaxes(first[..., :3, :3], -1, -2) @ second[..., :3, :3]
    skew = turn - np.swapaxes(turn, -1, -2)
    sine = np.linalg.norm(skew[..., (2, 0, 1), (1, 2, 0)], axis=-1)
    return np.arctan2(sine, np.trace(turn, axis1=-2, axis2=-1) - 1.0)


def _angle(first: Array, second: Array) -> Array:
    """Return the angles between vectors, shape (...) [rad]."""
    return np.arctan2(np.linalg.norm(np.cross(first, second), axis=-1), (first * second).sum(axis=-1))


def _unit(vector: Any) -> Array:
    return np.asarray(vector, float) / np.linalg.norm(vector)


def _region(constraint: ToolRegion) -> Residual:
    origin = pose_matrix(constraint.position, constraint.orientation)

    def worst(poses: Mapping[str, Array]) -> Array:
        found = np.linalg.inv(origin) @ poses[constraint.frame]
        off = np.zeros(found.shape[:-2])
        if constraint.angle is not None:
            off = _turned(np.eye(4), found) / constraint.angle
        for k, (low, high) in enumerate(zip(constraint.lower, constraint.upper, strict=True)):
            value = found[..., k, 3]
            if low is not None and high is not None:
                off = np.maximum(off, abs(value - (low + high) / 2.0) / ((high - low) / 2.0))
            else:
                outside = value < low if low is not None else value > high if high is not None else False
                off = np.where(outside, np.inf, off)
        return off

    return worst


def frames_of(constraint: Any) -> tuple[str, ...]:
    """Return the names of the frames of a constraint but for the world."""
    names = (constraint.first, constraint.second) if isinstance(constraint, RelativePose) else (constraint.frame,)
    return tuple(name for name in names if name != WORLD)


def residual_of(constraint: Any, start: Mapping[str, Array]) -> Residual:
    """Return the violation of a constraint over its tolerance as a function of the poses of its frames.

    Args:
        constraint: A record of :mod:`apex_ompl.scene.constraints`; turns of a relative pose are all free or none.
        start: Poses of its frames at the start.

    Raises:
        NotImplementedError: Another constraint.
    """
    if isinstance(constraint, Upright):
        axis, up = _unit(constraint.axis), _unit(constraint.up)
        return lambda p: _angle(p[constraint.frame][..., :3, :3] @ axis, up) / constraint.angle
    if isinstance(constraint, RelativePose):
        return _relative(constraint, start)
    if isinstance(constraint, OnPlane | OnLine):
        name = constraint.frame
        origin = start[name][:3, 3].copy() if constraint.point is None else np.array(constraint.point)
        along = _unit(constraint.normal if isinstance(constraint, OnPlane) else constraint.direction)

        def distance(poses: Mapping[str, Array]) -> Array:
            offset = poses[name][..., :3, 3] - origin
            on_line = isinstance(constraint, OnLine)
            off = np.linalg.norm(np.cross(along, offset), axis=-1) if on_line else abs(offset @ along)
            return np.asarray(off / constraint.tolerance)

        return distance
    if isinstance(constraint, FixedOrientation):
        wanted = start[constraint.frame].copy()
        if constraint.orientation is not None:
            wanted = pose_matrix((0.0, 0.0, 0.0), constraint.orientation)
        return lambda p: _turned(wanted, p[constraint.frame]) / constraint.angle
    if isinstance(constraint, ToolRegion):
        return _region(constraint)
    raise NotImplementedError(f"no dense check of {type(constraint).__name__}")


def _relative(constraint: RelativePose, start: Mapping[str, Array]) -> Residual:
    first, second, tolerance = constraint.first, constraint.second, constraint.tolerance
    wanted = np.linalg.inv(start[first]) @ start[second]
    if constraint.pose is not None:
        wanted = pose_matrix(constraint.pose.position, constraint.pose.orientation)
    kept = [k for k, name in enumerate("xyz") if name not in constraint.free]
    turns = [name for name in constraint.free if name.startswith("r")]

    def worst(poses: Mapping[str, Array]) -> Array:
        found = np.linalg.inv(poses[first]) @ poses[second]
        off = np.linalg.norm((found - wanted)[..., kept, 3], axis=-1) / tolerance.position
        if len(turns) == 3:
            return np.asarray(off)
        if len(turns) == 1:
            k = "xyz".index(turns[0][1])
            return np.maximum(off, _angle(found[..., :3, k], wanted[:3, k]) / tolerance.angle)
        return np.maximum(off, _turned(wanted, found) / tolerance.angle)

    return worst


def problem_of(job: Job) -> Problem:
    """Return the problem of a run; that of a run to warm up has constraints, too."""
    return load_problem(WARM_UP if job.experiment == "warm-up" else job.problem)


def arm_joints(ready: PlanningSetup) -> Array:
    """Return the numbers of the planned joints that do not close a hand, shape (n,)."""
    hands = {hand.synergy for hand in ready.robot.hands.values()}
    return np.array([k for k, name in enumerate(ready.robot.joint_names) if name not in hands])


def all_constraints(problem: Problem) -> tuple[Any, ...]:
    """Return the constraints of a problem, with the chains that objects in two hands close."""
    chains = [
        RelativePose(first=body.links[0], second=link)
        for body in problem.attached
        for link in (body.links or ())[1:]
    ]  # fmt: skip
    return (*chains, *problem.constraints)


def dense_check(robot: Robot, problem: Problem, path: Array, spacing: float = DENSE) -> DenseCheck:
    """Check constraints and collisions at states along a path, between whose states it is straight.

    Args:
        robot: The robot.
        problem: The problem.
        path: Shape (N, dof).
        spacing: Of the states that are checked [rad, max-norm].
    """
    stretches = (np.concatenate([states_between(a, b, spacing), b[None]]) for a, b in pairwise(path))
    states = np.concatenate([path[:1], *stretches])
    reader, constraints = FrameReader(robot, problem), all_constraints(problem)
    names = tuple(dict.fromkeys(name for one in constraints for name in frames_of(one)))
    at_start = reader(problem.start_state(robot.joint_names), names)
    residuals = [residual_of(one, at_start) for one in constraints]
    poses = reader(states, names)
    worst = max((float(residual(poses).max()) for residual in residuals), default=0.0)
    checker = CollisionChecker(robot, problem.scene, problem.attached, problem.allowed)
    return DenseCheck(len(states), worst, bool(checker.are_free(states).all()))


def refined(constraints: ConstraintSet, path: Array, spacing: float = REFINED) -> Array:
    """Return a path with further states between its own, moved to the constraints where that works, shape (M, dof)."""
    rows = [path[:1]]
    for a, b in pairwise(path):
        between = states_between(a, b, spacing)
        if len(between):
            moved, arrived = constraints.project(between)
            rows.append(np.where(arrived[:, None], moved, between))
        rows.append(b[None])
    return np.concatenate(rows)


def columns(
    ready: PlanningSetup, constraints: ConstraintSet, paths: Sequence[Array], times: dict[str, float], *, limit: float,
    reason: str = "",
) -> dict[str, Any]:  # fmt: skip
    """Return the columns of a rival's run.

    Args:
        ready: The problem, ready to plan.
        constraints: Its constraints.
        paths: The final path, shape (N, dof), then that before simplification, which is tried where the final one fails
            the check; none where none was found.
        times: Times of the stages [s]; ``solve`` and ``simplify`` make up the run.
        limit: Latest end of ``solve`` for which a path counts [s].
        reason: Why there is no path.
    """
    found, check = None, None
    if times["solve"] > LATE * limit:
        paths, reason = (), reason or "the path came late"
    for states in paths:
        if found is not None:
            break
        with timed(times, "check"):
            dense = refined(constraints, states)
            check = dense_check(ready.robot, ready.problem, dense)
        found = dense if check else None
    if found is None and check is not None:
        reason = f"violation {check.violation:.2f} of the tolerance" if check.free else "the path collides"
    total = times.get("solve", 0.0) + times.get("simplify", 0.0)
    return {
        "solved": found is not None, "first": times["solve"] if found is not None else None, "total": total,
        "cpu": total, "times": times, "length": None if found is None else path_length(found), "reason": reason,
        "failed_check": len(paths) > 0 and found is None,
        "violation": None if check is None else check.violation,
    }  # fmt: skip
