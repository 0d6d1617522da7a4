"""Trajectory files: NumPy archives, CSV, and messages of ROS 2."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

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
NEAR, FAR = 5e-3, 6e-2
"""Times between knots below which positions need more decimals, and above which velocities and accelerations do [s]."""
DECIMALS = {"near": (12, 9, 6), "usual": (10, 8, 6), "far": (12, 12, 12)}
"""Decimals of positions, velocities and accelerations in texts, by the times between knots.

Half a unit in the last ones changes jerks by 0.06 rad/s^3 at most, and positions between knots by a nanoradian.
"""


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
        if suffix not in MESSAGES:
            raise ParameterError("controllers", suffix, f"a file name ending in {' or '.join(MESSAGES)}")
        check_controllers(controllers, names)
    if suffix == ".npz":
        buffer = io.BytesIO()
        arrays: dict[str, Any] = {"times": times, "joint_names": np.array(names), **states}
        np.savez(buffer, **arrays)
        return buffer.getvalue()
    gaps = np.diff(times)
    digits = DECIMALS["far" if gaps.max(initial=0.0) > FAR else "near" if gaps.min(initial=FAR) < NEAR else "usual"]
    rows = [_texts(states[name], decimals) for name, decimals in zip(STATES, digits, strict=True)]
    ticks = [round(time * NANOSECONDS) for time in times.tolist()]
    if suffix == ".csv":
        header = ["time", *(f"{name}{more}" for more in COLUMN_SUFFIXES for name in names)]
        text = io.StringIO()
        seconds = ("{}.{:09}".format(*divmod(tick, NANOSECONDS)) for tick in ticks)
        table = ([time, *q, *v, *a] for time, q, v, a in zip(seconds, *rows, strict=True))
        csv.writer(text, lineterminator="\n").writerows([header, *table])
        return text.getvalue().encode()
    write = _json_message if suffix == ".traj.json" else _yaml_message
    if controllers is None:
        return write(ticks, rows, names, range(len(names)), "").encode()
    columns = {name: [list(names).index(joint) for joint in joints] for name, joints in controllers.items()}
    if suffix == ".traj.json":
        messages = (f"{json.dumps(name)}: {write(ticks, rows, names, chosen, '')}" for name, chosen in columns.items())
        return ("{\n" + ",\n".join(message.rstrip("\n") for message in messages) + "\n}\n").encode()
    messages = (f"{json.dumps(name)}:\n{write(ticks, rows, names, chosen, '  ')}" for name, chosen in columns.items())
    return "".join(messages).encode()


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


def _texts(values: Array, decimals: int) -> list[list[str]]:
    """Return rounded numbers as texts that JSON and YAML read as floats, without exponents; the ends are not rounded.

    Args:
        values: Shape (K, dof).
        decimals: Number of decimals at most.
    """

    def text(value: float) -> str:
        head, _, tail = f"{value:.{decimals}f}".partition(".")
        tail = tail.rstrip("0") or "0"
        return "0.0" if tail == "0" and head == "-0" else f"{head}.{tail}"

    exact = {0, len(values) - 1}
    return [
        [np.format_float_positional(value, trim="0") for value in row] if k in exact else [text(value) for value in row]
        for k, row in enumerate(values.tolist())
    ]


def _points(ticks: Sequence[int], rows: Sequence[list[list[str]]], columns: Sequence[int]) -> Iterator[str]:
    """Return the points of a message one by one, as JSON, which YAML reads, too."""
    for k, tick in enumerate(ticks):
        lists = (
            f'"{name}": [{", ".join(values[k][c] for c in columns)}]' for name, values in zip(STATES, rows, strict=True)
        )
        sec, nanosec = divmod(tick, NANOSECONDS)
        stamp = f'"time_from_start": {{"sec": {sec}, "nanosec": {nanosec}}}'
        yield f'{{{", ".join(lists)}, "effort": [], {stamp}}}'


HEADER = '{"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}'


def _json_message(
    ticks: Sequence[int], rows: Sequence[list[list[str]]], names: Sequence[str], columns: Sequence[int], indent: str
) -> str:
    """Return a ``trajectory_msgs/JointTrajectory`` of some of the joints as JSON, a point a line."""
    points = f",\n{indent}".join(_points(ticks, rows, columns))
    joints = json.dumps([names[c] for c in columns])
    return f'{{"header": {HEADER}, "joint_names": {joints}, "points": [\n{indent}{points}\n{indent}]}}\n'


def _yaml_message(
    ticks: Sequence[int], rows: Sequence[list[list[str]]], names: Sequence[str], columns: Sequence[int], indent: str
) -> str:
    """Return a ``trajectory_msgs/JointTrajectory`` of some of the joints as YAML, a point a line."""
    head = f"header: {HEADER}", f"joint_names: {json.dumps([names[c] for c in columns])}", "points:"
    lines = [*head, *(f"- {point}" for point in _points(ticks, rows, columns))]
    return "".join(f"{indent}{line}\n" for line in lines)


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


def check_controllers(controllers: Mapping[str, Sequence[str]], names: Sequence[str]) -> None:
    """Check that controllers have lists of joints, together each of some names once.

    Raises:
        ParameterError: They have not.
    """
    if not isinstance(controllers, Mapping) or any(isinstance(joints, str) for joints in controllers.values()):
        raise ParameterError("controllers", controllers, "lists of joints by the names of controllers")
    try:
        given = [str(joint) for joints in controllers.values() for joint in joints]
    except TypeError as error:
        raise ParameterError("controllers", controllers, "lists of joints by the names of controllers") from error
    if sorted(given) != sorted(names):
        wrong = sorted(set(given) ^ set(names)) or sorted({joint for joint in given if given.count(joint) > 1})
        raise ParameterError("controllers", ", ".join(wrong), "each joint of the trajectory once")
