"""Whether a robot is the same as another one: a digest of what plans depend on."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path
from weakref import WeakKeyDictionary

from apex_ompl.errors import RobotError
from apex_ompl.robot.model import Robot, load_robot
from apex_ompl.util.schema import StrictModel

FILE_NAME = re.compile(r'filename="([^"]*)"')
PIECE = 2**17  # of a file that is read at once [bytes]

_digests: WeakKeyDictionary[Robot, str] = WeakKeyDictionary()


def digest(robot: Robot) -> str:
    """Return a digest of what plans depend on: kinematics, meshes, limits, checked pairs and fixtures."""
    if robot not in _digests:
        found = hashlib.sha256(FILE_NAME.sub(lambda match: Path(match[1]).name, robot.urdf).encode())
        for file in sorted(set(FILE_NAME.findall(robot.urdf)), key=lambda file: Path(file).name):
            path = Path(file.removeprefix("file://"))
            if path.is_file():
                _update(found, path)
            else:
                found.update(file.encode())
        pairs = [(pair.first, pair.second) for pair in robot.geometry.collisionPairs]
        found.update(_spelled((robot.name, robot.joint_names, pairs, robot.fixtures)).encode())
        for array in vars(robot.limits).values():
            found.update(array.tobytes())
        _digests[robot] = found.hexdigest()[:16]
    return _digests[robot]


def _spelled(value: object) -> str:
    """Return ``repr`` of plain data with records in full, all of their fields: digests are stored in results."""
    if isinstance(value, StrictModel):
        return f"{type(value).__name__}({', '.join(f'{name}={_spelled(inner)}' for name, inner in value)})"
    if type(value) is tuple:
        return f"({', '.join(map(_spelled, value))}{',' * (len(value) == 1)})"
    return repr(value)


def _update(digest: hashlib._Hash, path: Path) -> None:
    """Add the content of a file, piece by piece: the memory for a whole one takes longer than the digest."""
    buffer = memoryview(bytearray(PIECE))
    with path.open("rb", buffering=0) as file:
        while count := file.readinto(buffer):
            digest.update(buffer[:count])


def load_same_robot(name_or_path: str, wanted: str) -> Robot:
    """Load the robot of a result.

    Args:
        name_or_path: Its name, or its file.
        wanted: The digest that it had; empty for results that have none.

    Raises:
        RobotError: It has changed since.
        ApexError: It cannot be loaded.
    """
    robot = load_robot(name_or_path)
    if wanted and digest(robot) != wanted:
        raise RobotError(f"the robot {name_or_path!r} has changed since the result was made")
    return robot
