"""Tables of clearances between links that are at most three joints apart, made once for a robot.

The relative pose of two links depends on the planned joints between them. Where these are one to three, the set of
joint values at which the links are apart can be tabulated. The tables are in a file beside the robot's own, and are
named by digests of all that they depend on: both shapes, the joints between them and their limits. Arms of the same
kind share their tables, and a table of another robot is never used. :mod:`apex_ompl.collision.clearance_making` makes
them.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from apex_ompl.collision.exact_shapes import shape_digest
from apex_ompl.collision.solids import Solid
from apex_ompl.errors import FileFormatError
from apex_ompl.kernel.arrays import FIXED
from apex_ompl.kernel.clearance_table import ClearanceTable
from apex_ompl.kernel.joint_tree import JointTree
from apex_ompl.robot import Robot
from apex_ompl.types import Array
from apex_ompl.util.cache import weakly_cached
from apex_ompl.util.files import is_file, pack_archive, read_archive, write_atomically

SCHEMA = "apex-ompl/clearance-tables/1"
SUFFIX = ".clearances.npz"
MOST_JOINTS = 3  # between the links of a pair
BEYOND = 2e-3  # by which tables go beyond the limits [rad], [m]
Cells = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class NearPair:
    """Two links whose relative pose depends on one to three planned joints.

    Attributes:
        links: Their places among the robot's geometries.
        sources: Numbers of the planned joints.
        key: Digest of all that their table depends on.
    """

    links: tuple[int, int]
    sources: tuple[int, ...]
    key: str


def near_pairs(
    robot: Robot, tree: JointTree, solids: Sequence[Solid], pairs: Iterable[tuple[int, int]]
) -> list[NearPair]:
    """Return those of some pairs of links whose relative pose depends on one to three planned joints.

    Args:
        robot: The robot.
        tree: Its joints.
        solids: Its links.
        pairs: Pairs of them.
    """
    found = []
    for a, b in pairs:
        chains = [tree.chains[solids[k].joint] for k in (a, b)]
        sides = [[j for j in chain if j not in other] for chain, other in (chains, chains[::-1])]
        moving = [j for side in sides for j in side if tree.joints[j].kind != FIXED]
        sources = tuple(dict.fromkeys(tree.joints[j].source for j in moving))
        if not 1 <= len(sources) <= MOST_JOINTS:
            continue
        digest = hashlib.sha256(json.dumps([SCHEMA, BEYOND]).encode())
        for k, side in zip((a, b), sides, strict=True):
            digest.update(shape_digest(solids[k].shape) + solids[k].placement.homogeneous.tobytes())
            for j in side:
                joint = tree.joints[j]
                numbers = joint.kind, *np.ravel(np.eye(4) if joint.placement is None else joint.placement).tolist()
                axis = () if joint.axis is None else joint.axis.tolist()
                source = sources.index(joint.source) if joint.kind != FIXED else -1
                digest.update(json.dumps([numbers, *axis, source, joint.ratio, joint.shift]).encode())
        low, high = (limit[list(sources)].tolist() for limit in (robot.limits.lower, robot.limits.upper))
        digest.update(json.dumps([low, high]).encode())
        found.append(NearPair((a, b), sources, digest.hexdigest()[:32]))
    return found


def clearance_file(robot: Robot) -> Path:
    """Return the file of a robot's tables: beside its covers, or beside its own file."""
    beside = robot.covers or robot.files[0]
    return beside.with_name(beside.name.split(".")[0] + SUFFIX)


def read_clearances(path: Path) -> dict[str, Cells]:
    """Return the cells of the tables in a file, by the digests of their pairs.

    Raises:
        MissingFileError: The file cannot be read.
        FileFormatError: It holds something else.
    """
    about, arrays = read_archive(path, "about", "file of clearance tables")
    if about.get("schema") != SCHEMA:
        raise FileFormatError(str(path), "schema", about.get("schema"), f"expected {SCHEMA!r}")
    for key, cells in arrays.items():
        n = len(cells) if cells.ndim else 0
        cubic = 1 <= cells.ndim <= MOST_JOINTS and cells.shape == (n,) * cells.ndim
        if cells.dtype != np.uint8 or not cubic or n < 1 or n & (n - 1):
            expected = "expected bytes of shape (n,), (n, n) or (n, n, n), n a power of two"
            raise FileFormatError(str(path), key, f"{cells.dtype} {cells.shape}", expected)
    return arrays


def write_clearances(path: Path, cells: Mapping[str, Cells]) -> None:
    """Write the cells of tables by the digests of their pairs.

    Raises:
        MissingFileError: The folder is missing or cannot be written.
    """
    write_atomically(path, pack_archive("about", {"schema": SCHEMA}, cells))


def table_of(robot: Robot, pair: NearPair, cells: Cells) -> ClearanceTable:
    """Return the table of a pair."""
    lower, upper = table_range(robot, pair)
    return ClearanceTable(tuple(robot.joint_names[k] for k in pair.sources), lower, upper, cells)


def table_range(robot: Robot, pair: NearPair) -> tuple[Array, Array]:
    """Return the lowest and highest values of the joints in a pair's table, shape (1,) to (3,) each.

    They are a whole turn of continuous joints, after which cells repeat.
    """
    chosen, (low, high) = list(pair.sources), robot.range_around()
    beyond = np.where(robot.continuous[chosen], 0.0, BEYOND)
    return low[chosen] - beyond, high[chosen] + beyond


@weakly_cached
def _cells_in_file(robot: Robot) -> dict[str, Cells]:
    path = clearance_file(robot)
    return read_clearances(path) if is_file(path) else {}


def clearance_digests(robot: Robot) -> dict[str, str]:
    """Return a digest of each table in a robot's file, by the digests of their pairs; none without a file.

    Raises:
        FileFormatError: The file does not follow its schema.
    """
    return {key: hashlib.sha256(cells.tobytes()).hexdigest() for key, cells in _cells_in_file(robot).items()}


_tables: WeakKeyDictionary[Robot, dict[tuple[int, int], ClearanceTable]] = WeakKeyDictionary()


def clearances_of(
    robot: Robot, tree: JointTree, solids: Sequence[Solid], pairs: Iterable[tuple[int, int]]
) -> dict[tuple[int, int], ClearanceTable]:
    """Return the tables of a robot's file that hold for some pairs of its links; none without a file.

    Args:
        robot: The robot.
        tree: Its joints.
        solids: Its links, and held objects after them.
        pairs: Pairs of these.

    Raises:
        FileFormatError: The file does not follow its schema.
    """
    cells = _cells_in_file(robot)
    if not cells:
        return {}
    if robot not in _tables:
        near = near_pairs(robot, tree, solids, ((pair.first, pair.second) for pair in robot.geometry.collisionPairs))
        near = [pair for pair in near if pair.key in cells]
        for pair in near:
            if cells[pair.key].ndim != len(pair.sources):
                expected = f"expected {len(pair.sources)} axes, one for each joint"
                raise FileFormatError(str(clearance_file(robot)), pair.key, cells[pair.key].shape, expected)
        _tables[robot] = {pair.links: table_of(robot, pair, cells[pair.key]) for pair in near}
    known = _tables[robot]
    return {pair: known[pair] for pair in pairs if pair in known}
