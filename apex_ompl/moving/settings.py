"""Parameters of the closed loop."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from apex_ompl.errors import ParameterError
from apex_ompl.util.display import fields_line
from apex_ompl.util.validation import check_name, check_number

PREDICTIONS = ("still", "cv", "truth")
"""How obstacles are predicted: where they were seen (the paper), at constant velocity, or as they truly move."""

EVADE = ("never", "proved", "risk")
"""What a robot at rest does when an obstacle is about to touch it, see :class:`LoopSettings`."""

FOLLOWED = 2e-3
"""Distance from static obstacles and own parts that a robot keeps that follows motions by a driver [m]."""

RANGES = {
    "watched": (0.0, 60.0), "period": (1e-3, 0.1), "budget": (1e-3, 10.0), "hold": (0.0, 10.0),
    "rest_hold": (0.0, 10.0), "margin": (0.0, 0.1), "still_margin": (0.0, 0.1), "clearance_margin": (0.0, 0.5),
    "error": (0.0, 0.5), "fastest": (0.0, 5.0), "trigger": (0.0, 1.0), "timeout": (0.1, 600.0), "stuck": (0.1, 600.0),
    "latency": (-1.0, 10.0), "memory": (0.1, 600.0), "silence": (0.01, 60.0),
}  # fmt: skip


@dataclass(frozen=True)
class LoopSettings:
    """Parameters of the closed loop.

    Attributes:
        watched: Time for which obstacles were observed before the run starts [s].
        period: Time between two steps of the loop [s].
        budget: Time that a replan may take; its motion starts this long after the request [s].
        latency: Time after which the answer of a replan is available [s]; -1 takes it from the compute-cost model.
        prediction: One of ``PREDICTIONS``: the prediction that plans are proved against.
        guarded: Whether the robot continues only while a stop after the next step is proved.
        evade: What a robot at rest does when an obstacle is about to touch it. ``proved``: it steps aside only along a
            motion that is proved clear of all reachable sets until it is at rest again, so that it is at rest whenever
            it is touched. ``risk``: also along one that is only predicted to be clear; the steps without a fail-safe
            stop are counted (``unguarded_steps``). ``never``: it stays.
        monitored: Whether the motion is checked again at every step; otherwise it is followed to its end.
        verified: Whether motions are taken only where they are proved.
        from_rest: Whether the robot stops where its motion is blocked, and replans only at rest.
        by_distance: Whether a motion counts as blocked where an obstacle is nearer than ``trigger``, instead of where a
            conflict is predicted; where it started nearer than that, where one comes nearer still.
        trigger: That distance, lambda_obs of the paper's Algorithm 1 [m].
        hastens: Whether a faster motion is sought while the robot follows one without a conflict.
        hold: Time for which the goal must stay clear from the arrival on [s].
        rest_hold: Time for which a state of rest elsewhere must stay clear [s].
        margin: Distance that is kept from dynamic obstacles [m].
        still_margin: Distance that motions keep from static obstacles, and that parts of the robot and held objects
            keep from each other, unless they start or end nearer [m]. None takes 2 mm where a driver moves the robot,
            which does not follow exactly; elsewhere 0.1 mm, as far as states show it.
        clearance_margin: Distance beyond the margin that optimized motions keep where there is room [m].
        error: Largest error of an observed place, for the guarantee [m]; None takes the sensor's.
        fastest: Largest speed of any obstacle, for the guarantee [m/s]; None takes the environment's.
        memory: Longest time between two observations of an obstacle, for the guarantee [s]; one that the sensor does
            not see for longer is forgotten.
        silence: Time without a usable observation after which the robot stops, and does not start [s].
        timeout: Time after which a run ends [s]; a moving robot then stops first.
        stuck: Time of rest after which a run ends [s].
    """

    watched: float = 0.3
    period: float = 0.01
    budget: float = 0.05
    latency: float = -1.0
    prediction: str = "cv"
    guarded: bool = True
    evade: str = "proved"
    monitored: bool = True
    verified: bool = True
    from_rest: bool = False
    by_distance: bool = False
    trigger: float = 0.05
    hastens: bool = True
    hold: float = 0.1
    rest_hold: float = 1.5
    margin: float = 0.005
    still_margin: float | None = None
    clearance_margin: float = 0.05
    error: float | None = None
    fastest: float | None = None
    memory: float = 3.0
    silence: float = 1.0
    timeout: float = 30.0
    stuck: float = 30.0

    __repr__ = fields_line

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ParameterError: A number is out of its range, or the budget is no multiple of the period.
            UnknownNameError: No such prediction, or way to evade.
        """
        check_name(self.prediction, "prediction", PREDICTIONS)
        check_name(self.evade, "way to evade", EVADE)
        for name, (low, high) in RANGES.items():
            if getattr(self, name) is not None or name not in ("error", "fastest", "still_margin"):
                check_number(getattr(self, name), name, low, high)
        steps = self.budget / self.period
        if abs(steps - round(steps)) > 1e-6:
            raise ParameterError("budget", self.budget, f"a multiple of the period, {self.period:g} s")

    def completed(self, **missing: float) -> LoopSettings:
        """Return the settings with given values of those that are None."""
        values: dict[str, Any] = {name: value for name, value in missing.items() if getattr(self, name) is None}
        return replace(self, **values)

    @property
    def assumed(self) -> tuple[float, float]:
        """Largest error of an observed place [m], and largest speed of any obstacle [m/s].

        Raises:
            ParameterError: The settings were not completed.
        """
        if self.error is None or self.fastest is None:
            raise ParameterError("settings", "no error or no fastest", "both, as LoopSettings.completed fills in")
        return self.error, self.fastest
