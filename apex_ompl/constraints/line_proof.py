"""Proof that tools stay near a path of poses (:mod:`apex_ompl.constraints.line`) along states and motions.

Samples are at times t_i, with parameters s_i at which the path is nearest. In between, the parameter s(t) is taken to
be linear in time. With e(t) = p(t) - p_path(s(t)), and E(t) = R_path(s(t))^T R(t),

    |e| <= max(|e_i|, |e_i+1|) + h^2 / 8 max |e''|,    h = t_i+1 - t_i,

and alike for |E - I| (Frobenius norm), which is 2 sqrt(2) sin(angle / 2). The second derivatives are bounded by sums
over joints (:meth:`apex_ompl.constraints.tools.Tools.bends`) and by those of the path:
|E''| <= sqrt(2) ((w + w_path)^2 + |w'| + |w_path'|). In blends frames may leave the curve, by
:meth:`apex_ompl.constraints.line.ToolPath.freedom` and the angle that counts as much.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from apex_ompl.constraints.line import TURN, ToolPath
from apex_ompl.constraints.tools import Tools, pose_errors
from apex_ompl.kernel.timing import sample_motion
from apex_ompl.types import Array

REMAINDER = 5e-6, 1e-4  # largest h^2 / 8 max |e''|, and of the angle, that samples are chosen for [m, rad]
WEIGHTS = 1e4, 600.0  # of lengths and angles in the search for the nearest pose [1/m, 1/rad]
SEARCH_STEPS = 3
MOST_PARTS = 10_000
ROUNDING = 1e-9  # [m, rad]


class Deviation(NamedTuple):
    """Bounds of how far tools are from the poses of a path, less the freedom that they have in blends.

    Attributes:
        position: Largest distance of a tool's origin [m].
        angle: Largest angle [rad].
    """

    position: float
    angle: float


class Samples(NamedTuple):
    """States along a path or a motion, and bounds of the derivatives from each to the next.

    Attributes:
        states: Shape (N, dof).
        steps: Times between them, shape (N - 1,) [s].
        velocity: Bounds of |q'|, shape (N - 1, dof).
        acceleration: Bounds of |q''|, shape (N - 1, dof).
    """

    states: Array
    steps: Array
    velocity: Array
    acceleration: Array


def path_deviation(tools: Tools, path: ToolPath, u: Array, states: Array) -> Deviation:
    """Return bounds for straight lines between states, shape (N, dof), which belong to parameters, shape (N,).

    Args:
        tools: The tools.
        path: Their path.
        u: Parameters, increasing.
        states: The states.
    """
    steps = np.diff(states, axis=0)
    speed, still = np.abs(steps), np.zeros_like(steps)
    parts = _parts(tools, np.ones(len(steps)), speed, still)
    share, which = _shares(parts), np.repeat(np.arange(len(steps)), parts)
    fine = states[which] + share[:, None] * steps[which]
    guess = u[which] + share * np.diff(u)[which]
    samples = Samples(np.append(fine, states[-1:], axis=0), 1.0 / parts[which], speed[which], still[which])
    return _deviation(tools, path, samples, np.append(guess, u[-1]))


def motion_deviation(
    tools: Tools, path: ToolPath, u: Array, states: Array, knots: tuple[Array, Array, Array, Array]
) -> Deviation:
    """Return bounds for a motion along states.

    Args:
        tools: The tools.
        path: Their path.
        u: Parameters of the states, increasing, shape (N,).
        states: States that the motion follows, shape (N, dof).
        knots: Times, positions, velocities and accelerations of the motion, which is cubic in between.
    """
    times, _, velocity, acceleration = knots
    spans = np.diff(times)
    a = np.maximum(np.abs(acceleration[:-1]), np.abs(acceleration[1:]))
    v = np.maximum(np.abs(velocity[:-1]), np.abs(velocity[1:])) + 0.5 * spans[:, None] * a
    parts = _parts(tools, spans, v, a)
    steps = np.repeat(spans / parts, parts)
    fine = np.append(np.repeat(times[:-1], parts) + _shares(parts) * np.repeat(spans, parts), times[-1])
    q = sample_motion(knots, fine, count=1)[0]
    samples = Samples(q, steps, np.repeat(v, parts, axis=0), np.repeat(a, parts, axis=0))
    gone, arc = _arcs(q), _arcs(states)
    return _deviation(tools, path, samples, np.interp(gone * (arc[-1] / max(gone[-1], 1e-12)), arc, u))


def _deviation(tools: Tools, path: ToolPath, samples: Samples, guess: Array) -> Deviation:
    """Return bounds, with the nearest parameters looked for from a guess on, shape (N,)."""
    rotation, point = tools.poses(samples.states)
    u = _nearest(path, rotation, point, guess)
    wanted_rotation, wanted = path.poses(u)
    off = np.sqrt(((point - wanted) ** 2).sum(axis=-1))
    turned = np.sqrt(((rotation - wanted_rotation) ** 2).sum(axis=(-2, -1)))
    low, high = np.minimum(u[:-1], u[1:]), np.maximum(u[:-1], u[1:])
    freedom = path.freedom(u)
    free = np.minimum(freedom[:-1], freedom[1:])
    rates, pace, eighth = path.bounds(low, high), ((high - low) / samples.steps)[:, None], samples.steps**2 / 8.0
    position = angle = 0.0
    for f in range(len(tools.tools)):
        bend, turn, turning = tools.bends(f, samples.velocity, samples.acceleration)
        path_bend, path_turn = (pace**2 * rates.acceleration)[:, f], (pace * rates.turn)[:, f]
        within = np.maximum(off[:-1, f], off[1:, f]) + eighth * (bend + path_bend) - free[:, f]
        position = max(position, float(within.max(initial=0.0)))
        twisting = math.sqrt(2.0) * ((turn + path_turn) ** 2 + turning + (pace**2 * rates.turning)[:, f])
        norm = np.maximum(turned[:-1, f], turned[1:, f]) + eighth * twisting
        norm -= math.sqrt(2.0) / TURN * free[:, f]
        most = float(norm.max(initial=0.0)) / (2.0 * math.sqrt(2.0))
        angle = max(angle, 2.0 * math.asin(min(most, 1.0)))
    return Deviation(position + ROUNDING, angle + ROUNDING)


def _nearest(path: ToolPath, rotation: Array, point: Array, guess: Array) -> Array:
    """Return the parameters of the nearest poses, by Gauss-Newton steps from a guess, shape (N,).

    They stay between the stops of the path, where it has corners, and where the guess is a stop.
    """
    stops, u = np.array(path.stops), guess
    low = stops[np.searchsorted(stops, guess, side="right") - 1]
    high = stops[np.minimum(np.searchsorted(stops, guess, side="left"), len(stops) - 1)]
    weights = np.repeat(WEIGHTS, 3) ** 2
    for _ in range(SEARCH_STEPS):
        error = pose_errors(rotation, point, *path.poses(u))
        slope = np.concatenate(path.rates(u), axis=-1)
        along = (weights * error * slope).sum(axis=(1, 2)) / (weights * slope * slope).sum(axis=(1, 2))
        u = np.clip(u - along, low, high)
    return u


def _parts(tools: Tools, spans: Array, velocity: Array, acceleration: Array) -> NDArray[np.intp]:
    """Return into how many parts stretches are divided, shape (N,), so that remainders are small.

    Args:
        tools: The tools.
        spans: Times of the stretches, shape (N,) [s].
        velocity: Bounds of |q'|, shape (N, dof).
        acceleration: Bounds of |q''|, shape (N, dof).
    """
    needed = np.zeros(len(spans))
    for f in range(len(tools.tools)):
        bend, turn, turning = tools.bends(f, velocity, acceleration)
        needed = np.maximum(needed, bend / (8.0 * REMAINDER[0]))
        needed = np.maximum(needed, (4.0 * turn * turn + 2.0 * turning) / (8.0 * REMAINDER[1]))
    return np.clip(np.ceil(spans * np.sqrt(needed)), 1.0, MOST_PARTS).astype(np.intp)


def _shares(parts: NDArray[np.intp]) -> Array:
    """Return 0, 1/n, ..., (n - 1)/n for each number of parts n, one after the other."""
    first = np.cumsum(parts) - parts
    return np.asarray((np.arange(int(parts.sum())) - np.repeat(first, parts)) / np.repeat(parts, parts))


def _arcs(states: Array) -> Array:
    """Return the length of a polyline up to each of its states, shape (N,) [rad]."""
    steps = np.diff(states, axis=0)
    return np.append(0.0, np.cumsum(np.sqrt((steps * steps).sum(axis=1))))
