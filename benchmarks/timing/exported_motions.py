"""Saved motions as a controller follows them, with NumPy, json, yaml and csv alone: nothing here knows the package.

Like the joint_trajectory_controller of ROS 2, it interpolates between points by quintic polynomials with position,
velocity and acceleration at both, at times that are whole nanoseconds.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from numpy.typing import NDArray

Array = NDArray[np.float64]
NANOSECONDS = 1_000_000_000
SHARES = np.linspace(0.0, 1.0, 33)  # of each interval, at which velocities are evaluated


class Points(NamedTuple):
    """Points of a saved motion.

    Attributes:
        nanoseconds: Times since the start, whole numbers, shape (N,).
        states: Positions, velocities and accelerations, shape (3, N, joints) [rad, s].
        joints: Names of the columns.
    """

    nanoseconds: NDArray[np.int64]
    states: Array
    joints: tuple[str, ...]


def read_points(path: Path) -> Points:
    """Read a motion by the suffix of its file; times in seconds are rounded to nanoseconds."""
    if path.suffix == ".npz":
        with np.load(path) as archive:
            states = np.stack([archive[name] for name in ("positions", "velocities", "accelerations")])
            return Points(whole(archive["times"]), states, tuple(str(name) for name in archive["joint_names"]))
    text = path.read_text()
    if path.suffix == ".csv":
        head, *rows = csv.reader(text.splitlines())
        table = np.array(rows, float)
        count = (len(head) - 1) // 3
        states = np.stack([table[:, 1 + k * count : 1 + (k + 1) * count] for k in range(3)])
        return Points(whole(table[:, 0]), states, tuple(head[1 : 1 + count]))
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    return of_message(json.loads(text) if path.suffix == ".json" else yaml.load(text, Loader=loader))


def of_message(message: Mapping[str, Any]) -> Points:
    """Return the points of a ``trajectory_msgs/JointTrajectory``."""
    points = message["points"]
    stamps = [point["time_from_start"]["sec"] * NANOSECONDS + point["time_from_start"]["nanosec"] for point in points]
    states = np.array([[point[name] for point in points] for name in ("positions", "velocities", "accelerations")])
    return Points(np.array(stamps, np.int64), states, tuple(message["joint_names"]))


def whole(seconds: Array) -> NDArray[np.int64]:
    """Return times in whole nanoseconds."""
    return np.rint(seconds * NANOSECONDS).astype(np.int64)


def quintics(points: Points) -> tuple[Array, Array]:
    """Return the quintic between each two points, and how long it takes.

    Returns:
        Coefficients of the powers of the share s = t / h of the interval, shape (6, N - 1, joints), and the lengths of
        the intervals h, shape (N - 1, 1) [s].

    Raises:
        ValueError: Times that do not increase.
    """
    steps = np.diff(points.nanoseconds)
    if len(steps) == 0 or steps.min() <= 0:
        raise ValueError("the times do not increase")
    h = steps[:, None] / NANOSECONDS
    (q0, q1), (v0, v1), (a0, a1) = ((values[:-1], values[1:]) for values in points.states)
    v0, v1, a0, a1, d = v0 * h, v1 * h, a0 * h**2, a1 * h**2, q1 - q0
    powers = [
        q0, v0, a0 / 2.0,
        10.0 * d - 6.0 * v0 - 4.0 * v1 - (3.0 * a0 - a1) / 2.0,
        -15.0 * d + 8.0 * v0 + 7.0 * v1 + (3.0 * a0 - 2.0 * a1) / 2.0,
        6.0 * d - 3.0 * (v0 + v1) - (a0 - a1) / 2.0,
    ]  # fmt: skip
    return np.array(powers), h


def evaluated(coefficients: Array, h: Array, shares: Array, order: int) -> Array:
    """Return positions or their derivatives at shares of all intervals, shape (N - 1, shares, joints)."""
    powers = np.arange(6)
    factors = np.array([np.prod(np.arange(p, p - order, -1)) if p >= order else 0.0 for p in powers])
    weights = factors * shares[:, None] ** np.maximum(powers - order, 0)
    values: Array = np.einsum("sp,pnj->nsj", weights, coefficients) / h[:, None] ** order
    return values


def largest(points: Points) -> Array:
    """Return the largest velocity, acceleration and jerk of each joint while a controller follows, shape (3, joints).

    Velocities are those at ``SHARES`` of each interval; extremes of the acceleration, a cubic, and of the jerk, a
    parabola, are exact.
    """
    c, h = quintics(points)
    velocity = np.abs(evaluated(c, h, SHARES, 1)).max(axis=(0, 1))
    a, b, d = 60.0 * c[5], 24.0 * c[4], 6.0 * c[3]  # h^3 times the jerk: a s^2 + b s + d
    with np.errstate(divide="ignore", invalid="ignore"):
        root = np.sqrt(b**2 - 4.0 * a * d)
        q = -0.5 * (b + np.where(b < 0.0, -1.0, 1.0) * root)
        turns = np.stack([np.zeros_like(a), np.ones_like(a), q / a, d / q])
        middle = np.stack([np.zeros_like(a), np.ones_like(a), -b / (2.0 * a)])
    turns, middle = (np.clip(np.nan_to_num(s, posinf=0.0, neginf=0.0), 0.0, 1.0) for s in (turns, middle))
    acceleration = np.abs(2.0 * c[2] + turns * (d + turns * (b / 2.0 + turns * a / 3.0))) / h**2
    jerk = np.abs(d + middle * (b + middle * a)) / h**3
    return np.stack([velocity, acceleration.max(axis=(0, 1)), jerk.max(axis=(0, 1))])


def followed(points: Points, spacing: float) -> Array:
    """Return states of the motion that a controller makes, at most a spacing apart [rad, max-norm]."""
    c, h = quintics(points)
    speed = np.abs(evaluated(c, h, SHARES, 1)).max(axis=(1, 2))
    counts = np.maximum(1, np.ceil(1.05 * speed * h[:, 0] / spacing)).astype(int)
    states = []
    for count in np.unique(counts):
        which = np.flatnonzero(counts == count)
        rows = evaluated(c[:, which], h[which], np.arange(count) / count, 0)
        states += list(zip(which.tolist(), rows, strict=True))
    order = [rows for _, rows in sorted(states, key=lambda pair: pair[0])]
    return np.concatenate([*order, points.states[0, -1:]])
