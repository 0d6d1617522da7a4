"""Settings of obstacles that are found by color and depth."""

from __future__ import annotations

from dataclasses import dataclass

from apex_ompl.errors import ParameterError
from apex_ompl.util.validation import check_array, check_integer, check_number, check_positive, finite_array


@dataclass(frozen=True)
class ObstacleSettings:
    """What an obstacle looks like, and how much measurements say.

    Attributes:
        hue: Hue of its color: 0 red, 120 green, 240 blue [degrees].
        hue_width: Largest difference from that hue [degrees].
        saturation: Least saturation.
        value: Least brightness.
        low: Lower corner of the space where obstacles are looked for [m].
        high: Upper corner.
        smallest: Smallest length of an obstacle [m].
        largest: Largest length; what is longer is a wall or a floor [m].
        least_points: Pixels with depth without which nothing is an obstacle.
        floor: Standard deviation of the surface at a point [m].
        edge: Standard deviation of the contour [pixels].
        point_share: Independent measurements for each patch of pixels that share their noise.
        contour_share: Independent measurements for each pixel of the contour.
        tempering: Factor of the variances of measurements where hypotheses are compared.
        inflation: The same in covariances.
        systematic: Standard deviation of each end that does not average out over pixels [m].
        most_misfit: Mean squared error of points over that of noise above which one solid does not explain them; the
            covariance grows to the size of the obstacle.
        most_points: Points that are used at most.
        cubes: Share of boxes that are cubes.
    """

    hue: float = 0.0
    hue_width: float = 18.0
    saturation: float = 0.55
    value: float = 0.08
    low: tuple[float, float, float] = (-0.3, -1.0, -0.05)
    high: tuple[float, float, float] = (1.3, 1.0, 1.5)
    smallest: float = 0.03
    largest: float = 0.6
    least_points: int = 60
    floor: float = 0.0005
    edge: float = 0.5
    point_share: float = 1.4
    contour_share: float = 0.3
    tempering: float = 3.2
    inflation: float = 0.75
    systematic: float = 0.0003
    most_misfit: float = 1.35
    most_points: int = 300
    cubes: float = 0.2

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ParameterError: A number is out of its range.
        """
        check_number(self.hue, "hue", 0.0, 360.0)
        check_number(self.hue_width, "hue_width", 1.0, 60.0)
        check_number(self.saturation, "saturation", 0.0, 1.0)
        check_number(self.value, "value", 0.0, 1.0)
        check_number(self.cubes, "cubes", 0.0, 0.999)
        for name in ("smallest", "floor", "edge", "point_share", "contour_share"):
            check_positive(getattr(self, name), name)
        for name in ("tempering", "inflation", "systematic", "most_misfit"):
            check_positive(getattr(self, name), name)
        for name in ("least_points", "most_points"):
            check_integer(getattr(self, name), name, 1)
        check_number(self.largest, "largest", self.smallest)
        low, high = finite_array(self.low, "low"), finite_array(self.high, "high")
        check_array(low, (3,), "low")
        check_array(high, (3,), "high")
        if not (low < high).all():
            raise ParameterError("high", self.high, f"numbers above those of low, {self.low}")
