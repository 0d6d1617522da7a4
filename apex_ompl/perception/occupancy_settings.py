"""Settings of occupancy maps."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from apex_ompl.errors import ParameterError
from apex_ompl.util.validation import check_integer, check_number


@dataclass(frozen=True)
class OccupancySettings:
    """How frames change a map.

    Attributes:
        spreads: Standard deviations of the camera's pose and depth scale within which nothing occupied becomes free.
        missing: Largest share of pixels without a depth in a cell of the image that counts as seen, or in the 3x3 cells
            around one, whose least depth it has then.
        block: Side of the cells of the image in which least depths are taken [pixels].
        stride: Stride of rows and columns of the pixels whose points make voxels occupied.
        share: Share of the points that a surface across the line of sight leaves in a voxel, at its depth and with the
            noise of depths, which makes the voxel occupied.
        least: How many of these points are the least; fewer are enough where hardly as many are to be expected.
        support: Pixels around one, of 8, that must have about its depth for its point to count: depths at edges are
            often those of no surface.
        persistence: Frames that must see through an occupied voxel, after one that saw it occupied, to free it.
        longest: The largest number of such frames, after many that saw it occupied.
        padding: Margin around robot and held objects inside of which points belong to them [m]; the noise of depths is
            added.
    """

    spreads: float = 2.0
    missing: float = 0.5
    block: int = 2
    stride: int = 2
    share: float = 0.15
    least: int = 2
    support: int = 3
    persistence: int = 3
    longest: int = 9
    padding: float = 0.015

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ParameterError: A value is out of its range.
        """
        check_number(self.spreads, "spreads", 0.0, 10.0)
        check_number(self.missing, "missing", 0.0, 0.99)
        check_integer(self.block, "block", 1, 64)
        check_integer(self.stride, "stride", 1, 64)
        check_number(self.share, "share", 0.0, 1.0)
        check_integer(self.least, "least", 1, 100)
        check_integer(self.support, "support", 0, 8)
        check_integer(self.persistence, "persistence", 1, 100)
        check_integer(self.longest, "longest", self.persistence, 100)
        check_number(self.padding, "padding", 0.0, 0.5)


def settings_of(given: Any) -> OccupancySettings:
    """Return settings by their names.

    Raises:
        ParameterError: They are no mapping, or one is unknown or out of its range.
    """
    known = tuple(asdict(OccupancySettings()))
    if not isinstance(given, dict) or not {*given} <= {*known}:
        raise ParameterError("settings", given, f"a mapping of {', '.join(known)}")
    return OccupancySettings(**given)
