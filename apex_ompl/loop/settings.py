"""Parameters of the closed loop."""

from __future__ import annotations

from dataclasses import dataclass

from apex_ompl.errors import ParameterError
from apex_ompl.util.validation import check_name, check_number

PREDICTIONS = ("still", "cv", "truth")
"""How obstacles are predicted: where they were seen (the paper), at constant velocity, or as they truly move."""

RANGES = {
    "watched": (0.0, 60.0), "period": (1e-3, 0.1), "budget": (1e-3, 10.0), "hold": (0.0, 10.0),
    "rest_hold": (0.0, 10.0), "margin": (0.0, 0.1), "berth": (0.0, 0.5), "error": (0.0, 0.5), "fastest": (0.0, 5.0),
    "trigger": (0.0, 1.0), "timeout": (0.1, 600.0), "stuck": (0.1, 600.0), "latency": (-1.0, 10.0),
}  # fmt: skip


@dataclass(frozen=True)
class LoopSettings:
    """Parameters of the closed loop.

    Attributes:
        watched: Time for which obstacles were observed before the run begins [s].
        period: Time between two looks at the world [s].
        budget: Time that a replan may take; what it finds begins this long after it was asked for [s].
        latency: Time after which the answer of a replan is known [s]; -1 charges what the replan did by the table of
            costs.
        prediction: One of ``PREDICTIONS``: what plans are proved against.
        guarded: Whether the robot only goes on while a stop behind the next step is proved.
        monitored: Whether the motion is looked at again while it is followed; without, it is followed blindly.
        verified: Whether motions are taken only where they are proved.
        from_rest: Whether the robot stops where its motion is blocked, and plans anew only where it stands.
        by_distance: Whether a motion counts as blocked where an obstacle is nearer than ``trigger``, instead of where a
            conflict is predicted; once motion began nearer than that, where one comes nearer still.
        trigger: That distance, lambda_obs of the paper's Algorithm 1 [m].
        hastens: Whether a faster motion is looked for while one without a conflict is followed.
        hold: Time for which the goal must stay clear from the arrival on [s].
        rest_hold: Time for which a robot that stands elsewhere looks ahead [s].
        margin: Distance that is kept from obstacles that move [m].
        berth: Distance beyond it at which motions are optimised to pass by, where there is room [m].
        error: Largest error of an observed place, for the guarantee [m].
        fastest: Largest speed of any obstacle, for the guarantee [m/s].
        timeout: Time after which a run ends [s]; a robot that moves then stops first.
        stuck: Time of rest after which a run ends [s].
    """

    watched: float = 0.3
    period: float = 0.01
    budget: float = 0.05
    latency: float = -1.0
    prediction: str = "cv"
    guarded: bool = True
    monitored: bool = True
    verified: bool = True
    from_rest: bool = False
    by_distance: bool = False
    trigger: float = 0.05
    hastens: bool = True
    hold: float = 0.1
    rest_hold: float = 1.5
    margin: float = 0.005
    berth: float = 0.05
    error: float = 0.024
    fastest: float = 0.4
    timeout: float = 30.0
    stuck: float = 30.0

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ParameterError: A number is out of its range, or the budget is no multiple of the period.
            UnknownNameError: No such prediction.
        """
        check_name(self.prediction, "prediction", PREDICTIONS)
        for name, (low, high) in RANGES.items():
            check_number(getattr(self, name), name, low, high)
        steps = self.budget / self.period
        if abs(steps - round(steps)) > 1e-6:
            raise ParameterError("budget", self.budget, f"a multiple of the period, {self.period:g} s")
