"""Settings of the trajectory optimizer."""

from __future__ import annotations

from dataclasses import dataclass

from apex_ompl.util.validation import check_integer, check_number, check_positive


@dataclass(frozen=True)
class OptimizerSettings:
    """Cost of a path, and when its optimization ends.

    Attributes:
        samples: Number of states whose clearance counts: the middles of as many even intervals of the parameter, as
            dense as every fourth state of a path of 256.
        scene_margin: Clearance to obstacles below which a state costs [m].
        own_margin: Clearance between the robot's own links, its arms among them, below which a state costs [m].
        stiffness: Weight of half the integral of the speed squared, [1/rad^2]; for an even speed this is half the
            length squared. A clearance of 0 all along the path costs 1/2.
        damping: Weight of the speed of the change at the first step.
        steps: Largest number of steps of one call.
        tolerance: A step that lowers the cost by less than this share is the last.
    """

    samples: int = 64
    scene_margin: float = 0.04
    own_margin: float = 0.02
    stiffness: float = 1e-3
    damping: float = 1e-2
    steps: int = 30
    tolerance: float = 5e-3

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ParameterError: One is out of range.
        """
        check_integer(self.samples, "samples", 1)
        check_integer(self.steps, "steps")
        for name in ("scene_margin", "own_margin", "stiffness"):
            check_positive(getattr(self, name), name)
        for name in ("damping", "tolerance"):
            check_number(getattr(self, name), name, 0.0)
