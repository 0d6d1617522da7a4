"""Motions by Ruckig (Berscheid and Kroeger 2021): blended ones, and stops at corners."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import ruckig

from apex_ompl.errors import TimingError
from apex_ompl.robot.model import Limits
from apex_ompl.timing.curve import Polyline
from apex_ompl.timing.deviation import deviation_bound
from apex_ompl.timing.ruckig_profiles import Profiles, calculate, joined, knots
from apex_ompl.timing.spline_method import blend
from apex_ompl.timing.trajectory import ROUNDING, Trajectory, concatenate
from apex_ompl.util.arrays import distinct

LIMITS_SHARE = 1.0 - 1e-6  # of the limits that Ruckig is given, for its rounding
JERK_SHARE = 1.0 - 1e-5  # of the limit which leaves room for rounding
LIMITS_MARGIN = 1.0 + 1e-10  # on the limits where Ruckig is given states that are at them
STILL = 1e-12  # range of a joint that stays [rad]
STRIDES = (2, 1)  # of the knots of a spline that Ruckig's motion goes through; the first that keeps the deviation
SLOWEST = 1.02  # duration as a multiple of the guide's
DERIVATIVES = ("velocity", "acceleration", "jerk")


def blended(
    line: Polyline, limits: Limits, joint_names: tuple[str, ...], deviation: float,
    stop: Callable[[], bool] = lambda: False,
) -> tuple[Trajectory, float] | None:  # fmt: skip
    """Return Ruckig's motion along a polyline, its corners rounded.

    The states of the fastest spline in time (:func:`apex_ompl.timing.spline_method.blend`) at every second knot
    are targets of Ruckig's state-to-state problems in all joints, each with the time between its knots as the least
    duration. The spline itself solves them within the limits, so that Ruckig's motion takes no longer but for rounding.
    Where it leaves the polyline too far, or the position limits, which Ruckig does not know, or is slower (there may be
    durations in which no motion between two states exists), it goes through all of the knots.

    Args:
        line: The polyline, of positive length.
        limits: Limits of the joints.
        joint_names: Names of the joints, in the order of the columns.
        deviation: Largest distance of the motion from the polyline [rad].
        stop: Asked before every state-to-state problem whether to give up.

    Returns:
        The motion and a bound on its distance from the polyline [rad], or None where none keeps ``deviation``, or when
        told to stop meanwhile.
    """
    room = {name: LIMITS_SHARE * getattr(limits, name) for name in ("velocity", "acceleration")}
    guide = blend(line, replace(limits, **room), joint_names, deviation, stop)
    if guide is None:
        return None
    knot_times, arc = guide.arc_at
    for stride in STRIDES:
        motion = through_knots(guide.trajectory, limits, stride, stop)
        if motion is None or motion.use(limits)["position"] > 1.0 + ROUNDING:
            continue
        if motion.duration > SLOWEST * guide.trajectory.duration:
            continue
        times = knot_times * (motion.duration / guide.trajectory.duration)
        bound = deviation_bound(motion, line, (times, arc), guide.window, deviation, stop=stop)
        if bound <= deviation:
            return motion, bound
    return None


def through_knots(
    guide: Trajectory, limits: Limits, stride: int, stop: Callable[[], bool] = lambda: False
) -> Trajectory | None:
    """Return Ruckig's motion through every ``stride``-th knot of another motion, in its time.

    Args:
        guide: Motion within the limits.
        limits: Limits of the joints.
        stride: Of the knots; the ends are among them.
        stop: Asked before every state-to-state problem whether to give up.

    Returns:
        The motion, or None where Ruckig finds none or is told to stop.
    """
    chosen = distinct([*range(0, len(guide.times), stride), len(guide.times) - 1])
    solver, query = ruckig.Ruckig(guide.dof), ruckig.InputParameter(guide.dof)
    for name, share in zip(DERIVATIVES, (LIMITS_MARGIN, LIMITS_MARGIN, JERK_SHARE), strict=True):
        setattr(query, f"max_{name}", (share * getattr(limits, name)).tolist())
    states = np.stack([guide.positions[chosen], guide.velocities[chosen], guide.accelerations[chosen]])
    still = np.ptp(guide.positions, axis=0) <= STILL  # by rounding alone, which Ruckig would follow
    states[0][:, still], states[1:, :, still] = guide.positions[0, still], 0.0
    rows = states.tolist()
    solutions = []
    for k, least in enumerate(np.diff(guide.times[chosen]).tolist()):
        if stop():
            return None
        query.current_position, query.current_velocity, query.current_acceleration = (values[k] for values in rows)
        query.target_position, query.target_velocity, query.target_acceleration = (values[k + 1] for values in rows)
        query.minimum_duration = least
        solution = ruckig.Trajectory(guide.dof)
        try:
            calculate(solver, query, solution)
        except ruckig.RuckigError:
            return None
        solutions.append(solution)
    profiles = Profiles.of(solutions)
    return None if profiles.brakes else _within(joined(profiles, states, guide.joint_names), limits)


def _within(motion: Trajectory, limits: Limits) -> Trajectory:
    """Return a motion slowed down by what it uses over the limits through rounding."""
    use = motion.use(limits)
    over = max(use[name] ** (1.0 / order) for order, name in enumerate(DERIVATIVES, 1))
    return motion if over <= 1.0 else motion.slower(over * (1.0 + ROUNDING))


def stops(
    line: Polyline, limits: Limits, joint_names: tuple[str, ...], stop: Callable[[], bool] = lambda: False
) -> tuple[Trajectory, float] | None:
    """Return the fastest motion from corner to corner of a polyline, at rest at each.

    Along each straight line the arc length moves by Ruckig, within the tightest of the joints' limits divided by the
    joints' share of the direction.

    Args:
        line: The polyline, of positive length.
        limits: Limits of the joints.
        joint_names: Names of the joints, in the order of the columns.
        stop: Asked at every corner whether to give up.

    Returns:
        The motion and its largest distance from the polyline [rad], or None when told to stop meanwhile.

    Raises:
        TimingError: Ruckig finds no motion.
    """
    corners = line.corners()
    parts = []
    solver, query, solution = ruckig.Ruckig(1), ruckig.InputParameter(1), ruckig.Trajectory(1)
    for start, end in zip(corners.states[:-1], corners.states[1:], strict=True):
        if stop():
            return None
        length = float(np.linalg.norm(end - start))
        direction = (end - start) / length
        moves = np.abs(direction) > 1e-12
        query.target_position = [length]
        for name in DERIVATIVES:
            limit = LIMITS_SHARE * np.min(getattr(limits, name)[moves] / np.abs(direction[moves]))
            setattr(query, f"max_{name}", [float(limit)])
        try:
            calculate(solver, query, solution)
        except ruckig.RuckigError as error:
            limit = ", ".join(f"{name} {getattr(query, f'max_{name}')[0]:.3g}" for name in DERIVATIVES)
            raise TimingError(f"Ruckig finds no motion along a line of {length:.3g} rad within {limit}") from error
        times, arc, speed, acceleration = knots(solution)
        positions = start + arc * direction
        positions[0], positions[-1] = start, end
        speed[[0, -1]], acceleration[[0, -1]] = 0.0, 0.0  # without rounding
        parts.append(Trajectory(times, positions, speed * direction, acceleration * direction, joint_names))
    return concatenate(parts), float(np.linalg.norm(line.states - corners.at(line.arc), axis=1).max())
