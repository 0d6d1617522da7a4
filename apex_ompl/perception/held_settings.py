"""Settings of held objects that are found by their surfaces in depth images."""

from __future__ import annotations

from dataclasses import dataclass, field

from apex_ompl.perception.registration import RegistrationSettings
from apex_ompl.util.validation import check_array, check_integer, check_number, check_positive, finite_array


@dataclass(frozen=True)
class HeldSettings:
    """What is expected of grasps and sizes, and how much measurements say.

    Attributes:
        grasp_shift: Standard deviations of an object's place along the axes of the link that holds it [m].
        grasp_turn: Standard deviations of its orientation about them [degrees].
        size_spread: Standard deviation of the logarithms of its sizes; 0 where they are known.
        registration: Settings of the correction of the camera, or None to leave the camera as it is.
        thickness: Distance from the robot's surface within which points may be its own [m].
        floor: Standard deviation of the object's surface at a point [m].
        edge: Standard deviation of the contour [pixels].
        point_share: Independent measurements for each patch of pixels that share their noise.
        contour_share: Independent measurements for each pixel of the contour.
        starts: Turns about the axis of the grasp that varies most, from which fits start [degrees].
        most_points: Points that are used at most.
        first_points: Points that fits from the starts use at most.
        least_points: Pixels without which there is no answer.
        least_seen: Share of the expected outline without which there is no answer.
        most_misfit: Mean squared error of points over that of noise above which there is no answer.
    """

    grasp_shift: tuple[float, float, float] = (0.008, 0.008, 0.003)
    grasp_turn: tuple[float, float, float] = (4.0, 4.0, 10.0)
    size_spread: float = 0.0
    registration: RegistrationSettings | None = field(default_factory=RegistrationSettings)
    thickness: float = 0.005
    floor: float = 0.0005
    edge: float = 0.3
    point_share: float = 1.4
    contour_share: float = 0.15
    starts: tuple[float, ...] = (0.0, -18.0, 18.0)
    most_points: int = 450
    first_points: int = 150
    least_points: int = 60
    least_seen: float = 0.2
    most_misfit: float = 10.0

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ParameterError: A number is out of its range.
        """
        for name in ("grasp_shift", "grasp_turn"):
            spreads = finite_array(getattr(self, name), name)
            check_array(spreads, (3,), name)
            for value in spreads.tolist():
                check_positive(value, name)
        for name in ("thickness", "floor", "edge", "point_share", "contour_share", "most_misfit"):
            check_positive(getattr(self, name), name)
        for name in ("most_points", "first_points", "least_points"):
            check_integer(getattr(self, name), name, 1)
        check_number(self.size_spread, "size_spread", 0.0, 1.0)
        check_number(self.least_seen, "least_seen", 0.0, 1.0)
        check_array(finite_array(self.starts, "starts"), ("N",), "starts", least=1)
