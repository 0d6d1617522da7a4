"""Obstacles of generated scenes, their numbers rounded to a tenth of a millimeter."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from apex_ompl.scene.bodies import Obstacle
from apex_ompl.types import Array


def box(name: str, size: Sequence[float], position: Sequence[float]) -> Obstacle:
    """Return an upright box of edges ``size`` [m] centerd at ``position`` [m]."""
    return _obstacle(name=name, box=_rounded(size), position=_rounded(position))


def bar(name: str, radius: float, length: float, position: Sequence[float]) -> Obstacle:
    """Return an upright cylinder centerd at ``position`` [m]; ``length`` is not rounded."""
    cylinder = {"radius": _rounded([radius])[0], "length": length}
    return _obstacle(name=name, cylinder=cylinder, position=_rounded(position))


def _obstacle(**fields: Any) -> Obstacle:
    return Obstacle.model_validate(fields)


def _rounded(numbers: Iterable[float]) -> tuple[float, ...]:
    return tuple(round(float(v), 4) for v in numbers)


def primitive(name: str, kind: int, size: Array, position: Array, quaternion: Array) -> Obstacle:
    """Return a box, a ball, a cylinder or a capsule.

    Args:
        name: Name of the obstacle.
        kind: 0 to 3, in the order above.
        size: Edges of a box; the first one is the diameter of the others, the third one their length, shape (3,) [m].
        position: Center, shape (3,) [m].
        quaternion: Orientation as xyzw, of any norm but 0, shape (4,).
    """
    width, _, length = _rounded(size)
    shapes: tuple[dict[str, Any], ...] = (
        {"box": _rounded(size)}, {"sphere": {"radius": width / 2}},
        {"cylinder": {"radius": width / 2, "length": length}}, {"capsule": {"radius": width / 2, "length": length}},
    )  # fmt: skip
    unit = np.round(quaternion / np.linalg.norm(quaternion), 6)
    return _obstacle(name=name, **shapes[kind], position=_rounded(position), orientation=tuple(float(v) for v in unit))
