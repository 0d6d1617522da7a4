"""A reader of motion files that knows nothing of the package, and the motion that a controller makes of them.

ROS 2's JointTrajectoryController joins two points with positions, velocities and accelerations by a polynomial of fifth
degree, at times in whole nanoseconds.
"""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

SUFFIXES = (".npz", ".csv", ".traj.yaml", ".traj.json")


class Points(NamedTuple):
    """Points of a file: joint names, times of shape (K,) [s], and positions, velocities, accelerations (3, K, dof)."""

    names: list[str]
    times: np.ndarray
    states: np.ndarray


def read(file: Path) -> Points:
    """Return the points of a file that holds one message."""
    if file.suffix == ".npz":
        with np.load(file) as archive:
            states = np.stack([archive[name] for name in ("positions", "velocities", "accelerations")])
            return Points([str(name) for name in archive["joint_names"]], archive["times"], states)
    if file.suffix == ".csv":
        header, *rows = csv.reader(file.read_text().splitlines())
        table, dof = np.array(rows, float), (len(header) - 1) // 3
        return Points(header[1 : 1 + dof], table[:, 0], table[:, 1:].reshape(len(table), 3, dof).transpose(1, 0, 2))
    text = file.read_text()
    return points_of(json.loads(text) if file.suffix == ".json" else yaml.load(text, Loader=yaml.CSafeLoader))


def points_of(message: dict[str, Any]) -> Points:
    """Return the points of a ``trajectory_msgs/JointTrajectory``."""
    stamps = [point["time_from_start"] for point in message["points"]]
    times = np.array([stamp["sec"] + stamp["nanosec"] * 1e-9 for stamp in stamps])
    keys = "positions", "velocities", "accelerations"
    states = np.array([[point[key] for point in message["points"]] for key in keys], float)
    return Points(message["joint_names"], times, states)


def follow(points: Points, per_span: int = 17) -> list[np.ndarray]:
    """Return positions and their three derivatives as the controller interpolates them, each (spans, per_span, dof)."""
    h = np.diff(points.times)[:, None, None]
    (q0, v0, a0), (q1, v1, a1) = points.states[:, :-1, None], points.states[:, 1:, None]
    u = np.linspace(0.0, 1.0, per_span)[None, :, None]
    v0, v1, a0, a1 = v0 * h, v1 * h, a0 * h * h, a1 * h * h
    step = q1 - q0
    coefficients = [
        q0, v0, a0 / 2.0, 10.0 * step - 6.0 * v0 - 4.0 * v1 - (3.0 * a0 - a1) / 2.0,
        -15.0 * step + 8.0 * v0 + 7.0 * v1 + (3.0 * a0 - 2.0 * a1) / 2.0,
        6.0 * step - 3.0 * (v0 + v1) - (a0 - a1) / 2.0,
    ]  # fmt: skip
    rows = []
    for order in range(4):
        factors = [np.prod(np.arange(k - order + 1, k + 1)) if k >= order else 0 for k in range(6)]
        value = sum(c * f * u ** max(k - order, 0) for k, (c, f) in enumerate(zip(coefficients, factors, strict=True)))
        rows.append(np.asarray(value) / h**order)
    return rows
