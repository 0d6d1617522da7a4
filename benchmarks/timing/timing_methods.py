"""Methods of time parameterization that benchmarks/timing/timing.py compares, and TOPP-RA's optimum."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import ruckig
import toppra
from toppra import algorithm, constraint

from apex_ompl.kernel.timing import max_path_speeds
from apex_ompl.problems.suite_robot import robot
from apex_ompl.timing import Timing, Trajectory
from apex_ompl.timing.curve import Curve, Polyline
from apex_ompl.timing.ruckig_method import calculate, knots, stops
from apex_ompl.timing.spline_method import (
    CONTROL_POINT_SPACING,
    GRID_POINTS_PER_SPAN,
    least_knot_spacing,
    spline_in_time,
)
from apex_ompl.timing.trajectory import joined

LIMITS, NAMES = robot().limits, robot().joint_names
APART_ON_PATH = CONTROL_POINT_SPACING * Timing().deviation  # of control points, as the first that time_path tries [rad]
EACH, APART, POINTS = 0.004, 0.05, 500  # of samples [s], of TOPP-RA's states [s], of its grid


def optimum(path: np.ndarray) -> tuple[Any, float] | None:
    """Return TOPP-RA's trajectory along the cubic spline through a path, and its duration [s]."""
    line = Polyline.through(path)
    v, a = LIMITS.velocity, LIMITS.acceleration
    along = toppra.SplineInterpolator(line.arc, line.states)
    bounds = [
        constraint.JointVelocityConstraint(np.stack([-v, v], 1)),
        constraint.JointAccelerationConstraint(np.stack([-a, a], 1)),
    ]
    grid = np.linspace(0.0, line.length, POINTS)
    made = algorithm.TOPPRA(bounds, along, gridpoints=grid, parametrizer="ParametrizeConstAccel").compute_trajectory()
    return None if made is None else (made, float(made.duration))


def in_all_joints(states: list[tuple[np.ndarray, np.ndarray, np.ndarray]], least: float | None) -> Trajectory | None:
    """Return Ruckig's motion through positions, velocities and accelerations."""
    solver, task, parts = ruckig.Ruckig(len(NAMES)), ruckig.InputParameter(len(NAMES)), list[Trajectory]()
    for name in ("velocity", "acceleration", "jerk"):
        setattr(task, f"max_{name}", getattr(LIMITS, name).tolist())
    task.minimum_duration = least
    for before, after in zip(states[:-1], states[1:], strict=True):
        for which, state in (("current", before), ("target", after)):
            for name, value in zip(("position", "velocity", "acceleration"), state, strict=True):
                setattr(task, f"{which}_{name}", value.tolist())
        made = ruckig.Trajectory(len(NAMES))
        try:
            calculate(solver, task, made)
        except ruckig.RuckigError:
            return None
        parts.append(Trajectory(*knots(made), NAMES))
    return joined(parts)


def after_toppra(path: np.ndarray) -> Trajectory | None:
    """Return the motion by TOPP-RA, then Ruckig."""
    found = optimum(path)
    if found is None:
        return None
    made, duration = found
    times = np.linspace(0.0, duration, max(2, math.ceil(duration / APART)))
    states = [
        (made(t), 0.999 * made(t, 1), np.clip(made(t, 2), -LIMITS.acceleration, LIMITS.acceleration)) for t in times
    ]
    still = np.zeros(len(NAMES))
    states[0], states[-1] = (path[0], still, still), (path[-1], still, still)
    return in_all_joints(states, times[1])


def curve_of(path: np.ndarray) -> tuple[Curve, np.ndarray, np.ndarray]:
    """Return the curve along a path and its derivatives."""
    curve = Curve.along(Polyline.through(path), APART_ON_PATH)
    return curve, *curve.derivatives(GRID_POINTS_PER_SPAN)


def by_waypoints(path: np.ndarray) -> Trajectory | None:
    """Return the motion by Ruckig from waypoint to waypoint."""
    curve, first, second = curve_of(path)
    step = curve.spacing / GRID_POINTS_PER_SPAN
    x = max_path_speeds(first, second, LIMITS.velocity, LIMITS.acceleration, step)
    chosen = np.unique(np.linspace(0, len(x) - 1, max(2, math.ceil(step * len(x) / 0.2))).astype(int))
    points, still = curve.points(chosen * step), np.zeros(len(NAMES))
    states = [(q, 0.999 * first[k] * math.sqrt(x[k]), still) for q, k in zip(points, chosen, strict=True)]
    states[0], states[-1] = (path[0], still, still), (path[-1], still, still)
    return in_all_joints(states, None)


def along_arc(path: np.ndarray) -> Trajectory | None:
    """Return the motion by Ruckig along the arc."""
    curve, first, second = curve_of(path)
    made = (in_stretches(curve, first, second, count) for count in (1, 2, 4, 8, 16, 32))
    return min((one for one in made if one is not None), key=lambda one: one.duration, default=None)


def in_stretches(curve: Curve, first: np.ndarray, second: np.ndarray, count: int) -> Trajectory | None:
    """Return the motion along a curve in so many stretches, each with limits of its own."""
    length, n = curve.spans * curve.spacing, len(first)
    edges = np.linspace(0, n - 1, count + 1).astype(int)
    parts = [slice(a, b + 1) for a, b in zip(edges[:-1], edges[1:], strict=True)]
    with np.errstate(divide="ignore"):
        speed = [
            min(np.min(LIMITS.velocity / abs(first[p])), math.sqrt(np.min(0.5 * LIMITS.acceleration / abs(second[p]))))
            for p in parts
        ]
        acceleration = [float(np.min(0.5 * LIMITS.acceleration / abs(first[p]))) for p in parts]
        jerk = [float(np.min(0.5 * LIMITS.jerk / abs(first[p]))) for p in parts]
    ends = edges / (n - 1) * length
    between = [0.0, *(min(pair) for pair in zip(speed[:-1], speed[1:], strict=True)), 0.0]
    for order in (range(count), reversed(range(count))):  # forwards, then backwards
        for k in order:
            slow, fast = (k, k + 1) if between[k] < between[k + 1] else (k + 1, k)
            between[fast] = within_reach(between[slow], between[fast], acceleration[k], jerk[k], ends[k + 1] - ends[k])
    solver, task = ruckig.Ruckig(1), ruckig.InputParameter(1)
    pieces, took = [], 0.0
    for k in range(count):
        task.current_position, task.target_position = [float(ends[k])], [float(ends[k + 1])]
        task.current_velocity, task.target_velocity = [between[k]], [between[k + 1]]
        task.max_velocity, task.max_acceleration, task.max_jerk = [float(speed[k])], [acceleration[k]], [jerk[k]]
        made = ruckig.Trajectory(1)
        try:
            solver.calculate(task, made)
        except ruckig.RuckigError:
            return None
        pieces.append((took, made))
        took += made.duration
    times = np.linspace(0.0, took, max(2, math.ceil(took / EACH)))
    place = np.empty(len(times))
    for k, time_ in enumerate(times):
        start, made = next(piece for piece in reversed(pieces) if piece[0] <= time_)
        place[k] = made.at_time(float(time_ - start))[0][0]
    points = curve.points(np.clip(place, 0.0, length))
    control = np.concatenate([points[[0, 0]], points, points[[-1, -1]]])
    return spline_in_time(control, least_knot_spacing(control, LIMITS), NAMES)


def within_reach(slow: float, fast: float, acceleration: float, jerk: float, distance: float) -> float:
    """Return the greatest speed up to ``fast`` that a jerk-limited ramp reaches from ``slow`` over a distance."""

    def needs(speed: float) -> float:
        gain = speed - slow
        long_ramp = gain > acceleration**2 / jerk
        took = gain / acceleration + acceleration / jerk if long_ramp else 2.0 * math.sqrt(gain / jerk)
        return 0.5 * (slow + speed) * took

    if needs(fast) <= distance:
        return fast
    low, high = slow, fast
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if needs(middle) <= distance else (low, middle)
    return low


def from_corner_to_corner(path: np.ndarray) -> Trajectory:
    """Return the motion by Ruckig that stops at each corner."""
    return stops(Polyline.through(path), LIMITS, NAMES)[0]
