"""Reading bags of ROS 2 by rosbags."""

from __future__ import annotations

from pathlib import Path
from typing import Any


def read(folder: Path) -> dict[str, list[tuple[int, Any]]]:
    """The messages of each topic, with the times in the bag [ns]."""
    from rosbags.rosbag2 import Reader
    from rosbags.typesys import Stores, get_typestore

    types, found = get_typestore(Stores.ROS2_JAZZY), dict[str, list[tuple[int, Any]]]()
    with Reader(folder) as reader:
        for connection, time, data in reader.messages():
            found.setdefault(connection.topic, []).append((time, types.deserialize_cdr(data, connection.msgtype)))
    return found
