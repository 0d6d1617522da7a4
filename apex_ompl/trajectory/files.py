"""Files of trajectories: NumPy archives, CSV, and messages of ROS 2."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from apex_ompl.errors import FileFormatError, MissingFileError, ParameterError
from apex_ompl.types import Array
from apex_ompl.util.files import BROKEN, suffix_of
from apex_ompl.util.schema import read_yaml

MESSAGES = (".traj.yaml", ".traj.json")
SUFFIXES = (".npz", ".csv", *MESSAGES)
ROLE = "trajectory"
STATES = ("positions", "velocities", "accelerations")
COLUMNS = ("", "_velocity", "_acceleration")  # behind the name of a joint
BILLION = 1_000_000_000


def encoded(
    suffix: str, times: Array, states: Mapping[str, Array], names: Sequence[str],
    controllers: Mapping[str, Sequence[str]] | None,
) -> bytes:  # fmt: skip
    """Return the content of a file.

    Args:
        suffix: One of ``SUFFIXES``.
        times: Of the knots, shape (K,) [s].
        states: Positions, velocities and accelerations by name, each of shape (K, dof).
        names: Of the joints.
        controllers: Joints by the name of their controller, for messages; by default one message holds all.

    Raises:
        ParameterError: ``controllers`` where they make no sense, an unknown joint, or one that has none or two.
    """
    if controllers is not None:
        _check_controllers(controllers, names, suffix)
    if suffix == ".npz":
        buffer = io.BytesIO()
        held: dict[str, Any] = {"times": times, "joint_names": np.array(names), **states}
        np.savez(buffer, **held)
        return buffer.getvalue()
    if suffix == ".csv":
        head = ["time", *(f"{name}{more}" for more in COLUMNS for name in names)]
        table = np.hstack([times[:, None], *(states[name] for name in STATES)])
        sheet = io.StringIO()
        csv.writer(sheet, lineterminator="\n").writerows([head, *([repr(v) for v in row] for row in table.tolist())])
        return sheet.getvalue().encode()
    message: dict[str, Any]
    if controllers is None:
        message = _message(times, states, names, range(len(names)))
    else:
        where = {name: [list(names).index(joint) for joint in joints] for name, joints in controllers.items()}
        message = {name: _message(times, states, names, columns) for name, columns in where.items()}
    if suffix == ".traj.json":
        return (json.dumps(message) + "\n").encode()
    dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
    text: str = yaml.dump(message, Dumper=dumper, default_flow_style=None, sort_keys=False, width=1_000_000)
    return text.encode()


def decoded(path: Path) -> tuple[Array, list[Array], tuple[str, ...]]:
    """Return times, states in the order of ``STATES``, and joint names of a file.

    Raises:
        MissingFileError: It cannot be read.
        FileFormatError: It holds no trajectory.
        ParameterError: It has another suffix.
    """
    suffix = suffix_of(path, SUFFIXES)
    try:
        if suffix == ".npz":
            with np.load(path, allow_pickle=False) as archive:
                states = [archive[name].astype(float) for name in STATES]
                return archive["times"].astype(float), states, tuple(str(name) for name in archive["joint_names"])
        if suffix == ".csv":
            return _of_table(path.read_text(encoding="utf-8-sig"))
        return _of_messages(read_yaml(path, ROLE))  # JSON is YAML
    except OSError as error:
        raise MissingFileError(str(path), ROLE, (error.strerror or "cannot be read").lower()) from error
    except (*BROKEN, AttributeError, IndexError, csv.Error) as error:
        raise FileFormatError(str(path), "", str(error), "expected a saved trajectory") from error


def _message(times: Array, states: Mapping[str, Array], names: Sequence[str], columns: Sequence[int]) -> dict[str, Any]:
    """Return a ``trajectory_msgs/JointTrajectory``."""
    moments = [round(time * BILLION) for time in times.tolist()]
    if len(set(moments)) < len(moments):
        raise ParameterError("times", float(np.diff(times).min()), "knots a nanosecond apart or more, as ROS 2 counts")
    stamps = [divmod(moment, BILLION) for moment in moments]
    chosen = {name: states[name][:, list(columns)].tolist() for name in STATES}
    points = [
        {**{name: chosen[name][k] for name in STATES}, "effort": [], "time_from_start": {"sec": sec, "nanosec": nano}}
        for k, (sec, nano) in enumerate(stamps)
    ]
    head = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}
    return {"header": head, "joint_names": [names[c] for c in columns], "points": points}


def _of_messages(data: Mapping[str, Any]) -> tuple[Array, list[Array], tuple[str, ...]]:
    messages = [data] if "points" in data and "joint_names" in data else list(data.values())
    read = []
    for message in messages:
        points = message["points"]
        stamps = [int(at["sec"]) * BILLION + int(at["nanosec"]) for at in (p["time_from_start"] for p in points)]
        states = [np.array([point[name] for point in points], dtype=float) for name in STATES]
        read.append((np.array(stamps) / BILLION, states, [str(name) for name in message["joint_names"]]))
    if not read or any(not np.array_equal(times, read[0][0]) for times, _, _ in read):
        raise ValueError("messages of different times")
    states = [np.hstack([parts[k] for _, parts, _ in read]) for k in range(len(STATES))]
    return read[0][0], states, tuple(name for _, _, names in read for name in names)


def _of_table(text: str) -> tuple[Array, list[Array], tuple[str, ...]]:
    head, *rows = (row for row in csv.reader(io.StringIO(text)) if row)
    table = np.array(rows, dtype=float)
    dof = (len(head) - 1) // len(COLUMNS)
    names = tuple(head[1 : 1 + dof])
    if head != ["time", *(f"{name}{more}" for more in COLUMNS for name in names)] or table.ndim != 2:
        raise ValueError("columns " + ", ".join(head)[:60])
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
