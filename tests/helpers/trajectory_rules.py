"""The rules of messages to ROS 2's joint_trajectory_controller, with NumPy alone: nothing here knows the package.

They are those by which the controller refuses a ``trajectory_msgs/JointTrajectory``
(``JointTrajectoryController::validate_trajectory_msg``), and those of a robot of two arms: its messages start at the
same time, name each joint once, and what a controller makes of them keeps the limits.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

AT_REST = float(np.finfo(np.float32).eps)  # below which the controller takes the last velocity to be zero
SHARES = np.linspace(0.0, 1.0, 21)
ROOM = 1e-3  # by which limits may be exceeded, as a share


def nanoseconds(stamp: Any) -> int:
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def faults(message: Any, known: Sequence[str], now: int) -> list[str]:
    """What is wrong with a message, for a controller of some joints, at a time [ns]."""
    names, points = list(message.joint_names), list(message.points)
    found = []
    if sorted(names) != sorted(known):
        found.append(f"joints {names}, expected {sorted(known)}")
    if not points:
        return [*found, "no points"]
    times = [nanoseconds(point.time_from_start) for point in points]
    start = nanoseconds(message.header.stamp)
    if start and start + times[-1] < now:
        found.append("it ended before it was sent")
    if start and start < now:
        found.append("it started before it was sent")
    if times[0] < 0 or any(later <= earlier for earlier, later in zip(times[:-1], times[1:], strict=True)):
        found.append("times do not increase")
    for k, point in enumerate(points):
        for name in ("positions", "velocities", "accelerations"):
            values = np.asarray(getattr(point, name), float)
            if values.shape != (len(names),):
                found.append(f"point {k}: {name} of shape {values.shape}")
            elif not np.isfinite(values).all():
                found.append(f"point {k}: {name} that are not finite")
        if len(point.effort):
            found.append(f"point {k}: efforts, which the controller does not take")
    last = np.asarray(points[-1].velocities, float)
    if last.size and (np.abs(last) > AT_REST).any():
        found.append("the last velocity is not zero")
    return found


def limit_faults(message: Any, limits: Mapping[str, tuple[float, float, float, float]]) -> list[str]:
    """Where the quintics between the points exceed limits: lowest and highest position, velocity, acceleration."""
    found = []
    times = np.array([nanoseconds(point.time_from_start) for point in message.points]) / 1e9
    for k, name in enumerate(message.joint_names):
        low, high, velocity, acceleration = limits[name]
        rows = [[getattr(p, what)[k] for p in message.points] for what in ("positions", "velocities", "accelerations")]
        q, v, a = np.array(rows)
        if len(times) > 1:
            q, v, a = _quintic(times, q, v, a)
        if q.min() < low - 1e-6 or q.max() > high + 1e-6:
            found.append(f"{name}: positions {q.min():.4f} to {q.max():.4f}")
        for what, values, most in (("velocity", v, velocity), ("acceleration", a, acceleration)):
            if np.abs(values).max() > most * (1.0 + ROOM):
                found.append(f"{name}: {what} {np.abs(values).max():.4f} of {most}")
    return found


def robot_faults(messages: Sequence[Any], joints: Sequence[str]) -> list[str]:
    """What is wrong with the messages of a motion to all controllers of a robot."""
    named = [name for message in messages for name in message.joint_names]
    found = [] if sorted(named) == sorted(joints) else [f"joints {named}, expected each of {list(joints)} once"]
    if len({nanoseconds(message.header.stamp) for message in messages}) != 1:
        found.append("the messages do not start at the same time")
    if len({nanoseconds(message.points[-1].time_from_start) for message in messages}) != 1:
        found.append("the messages do not end at the same time")
    return found


def _quintic(times: Any, q: Any, v: Any, a: Any) -> tuple[Any, Any, Any]:
    """Positions, velocities and accelerations on the polynomials between points, by solving for their coefficients."""
    found: tuple[list[Any], list[Any], list[Any]] = ([], [], [])
    for k, h in enumerate(np.diff(times)):
        rows = [[0**p for p in range(6)], [float(p == 1) for p in range(6)], [2.0 * (p == 2) for p in range(6)]]
        rows += [[1.0] * 6, [float(p) for p in range(6)], [float(p * (p - 1)) for p in range(6)]]
        ends = [q[k], v[k] * h, a[k] * h**2, q[k + 1], v[k + 1] * h, a[k + 1] * h**2]
        c = np.polynomial.Polynomial(np.linalg.solve(np.array(rows, float), ends))
        for values, order in zip(found, range(3), strict=True):
            values.append(c.deriv(order)(SHARES) / h**order if order else c(SHARES))
    return tuple(np.concatenate(values) for values in found)  # type: ignore[return-value]
