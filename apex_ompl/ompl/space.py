"""The OMPL state space of a robot, and states and paths as arrays.

Positions enter as they are: radians for joints, and a hand synergy's 0 (open) .. 1 (closed) counts as one
radian, so that OMPL's Euclidean distance is the joint-space distance with hands scaled by 1 rad.
"""

from __future__ import annotations

import sys
import time
import traceback
from typing import Any

import numpy as np
from ompl import base as ob
from ompl import geometric as og

from apex_ompl.errors import ParameterError
from apex_ompl.paths.path import SEARCH_RESOLUTION
from apex_ompl.robot import Robot
from apex_ompl.types import Array, Flags

Bounds = tuple[Array, Array]
"""Lowest and highest positions of the joints, each of shape (dof,) [rad; synergies 0..1]."""

GOAL_LOOK = 0.002  # period at which a goal that another thread samples is polled [s]


def state_space(
    robot: Robot, resolution: float = SEARCH_RESOLUTION, bounds: Bounds | None = None
) -> ob.RealVectorStateSpace:
    """Return the state space of a robot: one real dimension for each planned joint.

    Args:
        robot: The robot.
        resolution: Longest step that OMPL's own interpolation leaves between states [rad].
        bounds: Bounds inside the robot's limits; by default these, of joints that turn without end a turn to either
            side of 0.
    """
    lower, upper = bounds or robot.range_around(turns=1.0)
    space = ob.RealVectorStateSpace(robot.dof)
    box = ob.RealVectorBounds(robot.dof)
    for k, name in enumerate(robot.joint_names):
        box.setLow(k, float(lower[k]))
        box.setHigh(k, float(upper[k]))
        space.setDimensionName(k, name)
    space.setBounds(box)
    space.setName(robot.name)
    space.setLongestValidSegmentFraction(resolution / space.getMaximumExtent())
    return space


def ambient_space(space: ob.StateSpace) -> ob.StateSpace:
    """Return the space that a constrained state space is a part of, or the given one where it is not constrained."""
    return space.getSpace() if isinstance(space, ob.ConstrainedStateSpace) else space


def require_real_vectors(space: ob.StateSpace) -> None:
    """Refuse spaces whose states are no vectors, or lie on a manifold that straight lines leave.

    Raises:
        ParameterError: The space is not OMPL's space of real vectors.
    """
    if not isinstance(space, ob.RealVectorStateSpace):
        expected = "an ob.RealVectorStateSpace, as apex_ompl.ompl.space.state_space makes it"
        if isinstance(space, ob.ConstrainedStateSpace):
            expected += ", since the planner knows no constraints along the path"
        raise ParameterError("state space", type(space).__name__, expected)


def bounds_of(si: ob.SpaceInformation, robot: Robot) -> Bounds:
    """Return the bounds of a state space inside of the robot's limits."""
    box = ambient_space(si.getStateSpace()).getBounds()
    return np.maximum(robot.limits.lower, box.low), np.minimum(robot.limits.upper, box.high)


def to_array(state: Any, dof: int) -> Array:
    """Return an OMPL state as an array, shape (dof,)."""
    return np.array(values_of(state, dof))


def values_of(state: Any, dof: int) -> Any:
    """Return the values of an OMPL state as a list."""
    if isinstance(state, ob.ConstrainedStateSpaceStateType):  # which has no slices
        return [state[k] for k in range(dof)]
    return state[0:dof]


def set_values(state: Any, q: Array) -> None:
    """Set the values of an OMPL state to those of ``q``, shape (dof,)."""
    values = [float(v) for v in q]
    if isinstance(state, ob.ConstrainedStateSpaceStateType):
        state.copy(values)
    else:
        state[0 : len(values)] = values


def new_state(si: ob.SpaceInformation) -> Any:
    """Return a new OMPL state, which is freed when Python drops it.

    In OMPL's bindings states that a space allocates, and not a space information, are never freed. And where Python
    still holds the object of a state that OMPL has freed, as a checker does that keeps what it was given, a new state
    at the same address gets that object, and its memory is freed at once. Such an address is given away for good here.
    """
    while True:
        state = si.allocState()
        if sys.getrefcount(state) <= _users_of_new():
            return state
        del state
        si.getStateSpace().allocState()  # at the same address, and never freed


def _users_of_new() -> int:
    state = object()
    return sys.getrefcount(state)


def to_state(si: ob.SpaceInformation, q: Array) -> Any:
    """Return a new OMPL state with the values of ``q``, shape (dof,), which is freed when Python drops it."""
    state = new_state(si)
    set_values(state, q)
    return state


def path_to_array(path: og.PathGeometric, dof: int) -> Array:
    """Return the states of an OMPL path, shape (N, dof)."""
    return np.array([to_array(path.getState(k), dof) for k in range(path.getStateCount())]).reshape(-1, dof)


def array_to_path(si: ob.SpaceInformation, states: Array) -> og.PathGeometric:
    """Return an OMPL path through ``states``, shape (N, dof)."""
    path = og.PathGeometric(si)
    state = new_state(si)
    for q in states:
        set_values(state, q)
        path.append(state)  # a copy
    return path


def motions_free(si: ob.SpaceInformation, first: Array, last: Array) -> Flags:
    """Return whether straight motions are free by the motion validator of ``si``, shape (N,).

    Args:
        si: OMPL's space information.
        first: First states, assumed free, shape (N, dof).
        last: Last states, shape (N, dof).
    """
    a, b, found = new_state(si), new_state(si), []
    for p, q in zip(first, last, strict=True):
        set_values(a, p)
        set_values(b, q)
        found.append(bool(si.checkMotion(a, b)))
    return np.array(found, bool)


def await_goal(goal: ob.Goal | None, ptc: ob.PlannerTerminationCondition) -> None:
    """Wait for the first state of a goal that is sampled by another thread, until a condition holds.

    ``nextGoal`` of OMPL's bindings waits for it, too, but holds the interpreter's lock, which Python's sampler needs.
    """
    if isinstance(goal, ob.GoalLazySamples):
        while not goal.maxSampleCount() and goal.couldSample() and not ptc():
            time.sleep(GOAL_LOOK)


def forget_states(error: BaseException) -> None:
    """Clear the finished frames of an error's traceback, so that no OMPL state lives on in them.

    The Python object of a state must not outlive a state that OMPL owns and frees. OMPL's bindings hand out the object
    that they know for an address; the next state that is allocated there would get the old object, its own memory
    would be freed at once, and writing to it damages the heap. A checker of a user that raises, and a log that keeps
    the error, are enough for that.
    """
    traceback.clear_frames(error.__traceback__)
