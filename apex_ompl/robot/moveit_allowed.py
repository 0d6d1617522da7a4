"""Allowed collision matrices of MoveIt's planning scenes (``moveit_msgs/AllowedCollisionMatrix``)."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from typing import Any

from apex_ompl.robot import Robot
from apex_ompl.robot.geometry import link_of
from apex_ompl.robot.moveit_messages import MessageReader

MATRIX = "allowed_collision_matrix"
Pair = tuple[str, str]


def allowed_pairs(
    reader: MessageReader, matrix: Mapping[str, Any], robot: Robot, bodies: Sequence[str], names: Mapping[str, str]
) -> tuple[list[Pair], list[str]]:
    """Return the pairs that a matrix lets touch and that are checked here, and names that are no link or object.

    An object of several shapes stands for all of them. A name with a default that allows may touch whatever no entry
    keeps it from.

    Args:
        reader: Reader of the scene's file.
        matrix: The matrix; may be empty.
        robot: The robot.
        bodies: Names of the obstacles and held objects.
        names: Link in the file -> link of ``robot``.

    Raises:
        FileFormatError: The matrix is not square, or has other faults; a value that is neither true nor false is named
            with its two entries.
    """
    entries = [str(name) for name in reader.entries(matrix, "entry_names", MATRIX)]
    given = reader.entries(matrix, "entry_values", MATRIX)
    if given and all(isinstance(row, list) for row in given):  # as MotionBenchMaker writes them
        rows = given
    else:
        rows = [
            reader.entries(row, "enabled", f"{MATRIX}.entry_values.{k}")
            for k, row in enumerate(reader.messages(matrix, "entry_values", MATRIX))
        ]
    if [len(row) for row in rows] != [len(entries)] * len(entries):
        expected = f"expected {len(entries)} rows of {len(entries)} values, one for each of entry_names"
        raise reader.fail(f"{MATRIX}.entry_values", len(rows), expected)
    flags = [
        [
            reader.flag(value, f"{MATRIX}.entry_values.{k}.{j} ({entries[k]}, {entries[j]})")
            for j, value in enumerate(row)
        ]
        for k, row in enumerate(rows)
    ]
    defaults = [str(name) for name in reader.entries(matrix, "default_entry_names", MATRIX)]
    values = reader.entries(matrix, "default_entry_values", MATRIX)
    if len(values) != len(defaults):
        raise reader.fail(f"{MATRIX}.default_entry_values", len(values), f"expected {len(defaults)} values")
    usual = [
        reader.flag(value, f"{MATRIX}.default_entry_values.{k} ({name})")
        for k, (name, value) in enumerate(zip(defaults, values, strict=True))
    ]
    known = (*dict.fromkeys((*robot.link_names, *bodies)),)
    ours = {name: _bodies_of(names.get(name, name), known) for name in (*entries, *defaults)}
    unknown = sorted(name for name, found in ours.items() if not found)
    allowed, kept_apart = set[Pair](), set[Pair]()
    for i, j in product(range(len(entries)), repeat=2):
        if i != j:
            pairs = set(map(_sorted, product(ours[entries[i]], ours[entries[j]])))
            allowed, kept_apart = (allowed | pairs, kept_apart) if flags[i][j] else (allowed, kept_apart | pairs)
    for name, value in zip(defaults, usual, strict=True):
        if value:
            allowed |= set(map(_sorted, product(ours[name], known))) - kept_apart
    links = set(robot.link_names)
    checked = _pairs_of_links(robot)
    return sorted(p for p in allowed if p[0] != p[1] and (p in checked or not links.issuperset(p))), unknown


def _sorted(pair: Iterable[str]) -> Pair:
    first, second = sorted(pair)
    return first, second


def _bodies_of(name: str, known: Iterable[str]) -> list[str]:
    """Return the bodies that an object or link of a file stands for; several where it has several shapes."""
    label = re.sub(r"[^A-Za-z0-9_.-]+", "_", name.strip()).strip("_.-")
    return [body for body in known if body in (name, label) or re.fullmatch(rf"{re.escape(label)}/\d+", body)]


def _pairs_of_links(robot: Robot) -> set[Pair]:
    """Return the pairs of links that the robot checks against each other."""
    links = [link_of(robot.model, item) for item in robot.geometry.geometryObjects]
    return {_sorted((links[p.first], links[p.second])) for p in robot.geometry.collisionPairs}
