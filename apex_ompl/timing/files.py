"""Trajectory files: NumPy archives, CSV, and messages of ROS 2."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from apex_ompl.errors import FileFormatError, ParameterError
from apex_ompl.types import Array
from apex_ompl.util.files import BROKEN, read_file, read_text, suffix_of
from apex_ompl.util.schema import read_json, read_yaml
from apex_ompl.util.validation import check_integer, number_array

MESSAGES = (".traj.yaml", ".traj.json")
SUFFIXES = (".npz", ".csv", *MESSAGES)
ROLE = "trajectory"
STATES = ("positions", "velocities", "accelerations")
KNOTS = ("times", *STATES)
COLUMN_SUFFIXES = ("", "_velocity", "_acceleration")  # after the name of a joint
NANOSECONDS = 1_000_000_000  # in a second


def encode(
    suffix: str, times: Array, states: Mapping[str, Array], names: Sequence[str],
    controllers: Mapping[str, Sequence[str]] | None,
) -> bytes:  # fmt: skip
    """Return the content of a trajectory file.

    Args:
        suffix: One of ``SUFFIXES``.
        times: Times of the knots, shape (K,) [s].
        states: Positions, velocities and accelerations by name, each of shape (K, dof).
        names: Names of the joints.
        controllers: Joints by the name of their controller, for messages only; by default one message holds all.

    Raises:
        ParameterError: ``controllers`` for a file that holds no messages, an unknown joint, or a joint that has no
            controller or two.
    """
    if controllers is not None:
        _check_controllers(controllers, names, suffix)
    if suffix == ".npz":
        buffer = io.BytesIO()
        arrays: dict[str, Any] = {"times": times, "joint_names": np.array(names), **states}
        np.savez(buffer, **arrays)
        return buffer.getvalue()
    if suffix == ".csv":
        header = ["time", *(f"{name}{more}" for more in COLUMN_SUFFIXES for name in names)]
        table = np.hstack([times[:, None], *(states[name] for name in STATES)])
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows([header, *([repr(v) for v in row] for row in table.tolist())])
        return text.getvalue().encode()
    message: dict[str, Any]
    if controllers is None:
        message = _message(times, states, names, range(len(names)))
    else:
        columns = {name: [list(names).index(joint) for joint in joints] for name, joints in controllers.items()}
        message = {name: _message(times, states, names, chosen) for name, chosen in columns.items()}
    if suffix == ".traj.json":
        return (json.dumps(message) + "\n").encode()
    dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
    content: str = yaml.dump(message, Dumper=dumper, default_flow_style=None, sort_keys=False, width=1_000_000)
    return content.encode()


def decode(path: Path) -> tuple[Array, list[Array], tuple[str, ...]]:
    """Return times, states in the order of ``STATES``, and joint names of a file.

    Raises:
        MissingFileError: The file cannot be read.
        FileFormatError: It holds no trajectory.
        ParameterError: It has another suffix.
    """
    suffix = suffix_of(path, SUFFIXES)
    try:
        if suffix == ".npz":
            with np.load(io.BytesIO(read_file(path, ROLE)), allow_pickle=False) as archive:
                times, *states = (number_array(archive[name], name) for name in ("times", *STATES))
                return times, states, tuple(str(name) for name in archive["joint_names"])
        if suffix == ".csv":
            return _from_table(read_text(path, ROLE))
        return _from_messages((read_json if suffix == ".traj.json" else read_yaml)(path, ROLE))
    except (OSError, *BROKEN, AttributeError, IndexError, csv.Error, ParameterError) as error:
        raise FileFormatError(str(path), "", str(error), "expected a saved trajectory") from error


def _message(times: Array, states: Mapping[str, Array], names: Sequence[str], columns: Sequence[int]) -> dict[str, Any]:
    """Return a ``trajectory_msgs/JointTrajectory``."""
    rounded = [round(time * NANOSECONDS) for time in times.tolist()]
    if len(set(rounded)) < len(rounded):
        raise ParameterError(
            "times", float(np.diff(times).min()), "knots at least a nanosecond apart, the resolution of ROS 2"
        )
    stamps = [divmod(time, NANOSECONDS) for time in rounded]
    chosen = {name: states[name][:, list(columns)].tolist() for name in STATES}
    points = [
        {**{name: chosen[name][k] for name in STATES}, "effort": [], "time_from_start": {"sec": sec, "nanosec": nano}}
        for k, (sec, nano) in enumerate(stamps)
    ]
    header = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}
    return {"header": header, "joint_names": [names[c] for c in columns], "points": points}


def _from_messages(data: Mapping[str, Any]) -> tuple[Array, list[Array], tuple[str, ...]]:
    messages = [data] if "points" in data and "joint_names" in data else list(data.values())
    parsed = []
    for message in messages:
        points = message["points"]
        ends = [point["time_from_start"] for point in points]
        stamps = [
            check_integer(at["sec"], "sec") * NANOSECONDS + check_integer(at["nanosec"], "nanosec") for at in ends
        ]
        states = [number_array([point[name] for point in points], name) for name in STATES]
        parsed.append((np.array(stamps) / NANOSECONDS, states, [str(name) for name in message["joint_names"]]))
    if not parsed or any(not np.array_equal(times, parsed[0][0]) for times, _, _ in parsed):
        raise ValueError("messages of different times")
    states = [np.hstack([parts[k] for _, parts, _ in parsed]) for k in range(len(STATES))]
    return parsed[0][0], states, tuple(name for _, _, names in parsed for name in names)


def _from_table(text: str) -> tuple[Array, list[Array], tuple[str, ...]]:
    header, *rows = (row for row in csv.reader(io.StringIO(text)) if row)
    table = np.array(rows, dtype=float)
    dof = (len(header) - 1) // len(COLUMN_SUFFIXES)
    names = tuple(header[1 : 1 + dof])
    if header != ["time", *(f"{name}{more}" for more in COLUMN_SUFFIXES for name in names)] or table.ndim != 2:
        raise ValueError("columns " + ", ".join(header)[:60])
    return table[:, 0], [table[:, 1 + k * dof : 1 + (k + 1) * dof] for k in range(len(STATES))], names


def _check_controllers(controllers: Mapping[str, Sequence[str]], names: Sequence[str], suffix: str) -> None:
    if suffix not in MESSAGES:
        raise ParameterError("controllers", suffix, f"a file name ending in {' or '.join(MESSAGES)}")
    if not isinstance(controllers, Mapping) or any(isinstance(joints, str) for joints in controllers.values()):
        raise ParameterError("controllers", controllers, "lists of joints by the names of controllers")
    try:
        given = [str(joint) for joints in controllers.values() for joint in joints]
    except TypeError as error:
        raise ParameterError("controllers", controllers, "lists of joints by the names of controllers") from error
    if sorted(given) != sorted(names):
        wrong = sorted(set(given) ^ set(names)) or sorted({joint for joint in given if given.count(joint) > 1})
        raise ParameterError("controllers", ", ".join(wrong), "each joint of the trajectory once")
