"""Metrics of a run of the closed loop, and the failure ratio of many runs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from apex_ompl.errors import ParameterError
from apex_ompl.loop.result import GOING, Event, Outcome, RunResult
from apex_ompl.robot.model import Limits
from apex_ompl.timing import Trajectory
from apex_ompl.timing.rests import rests
from apex_ompl.util.statistics import share_interval
from apex_ompl.util.validation import check_number

NEAR = 0.5  # time before a conflict below which it counts as near [s]
COUNTED = {
    "replans_asked": "request", "replans_accepted": "accepted", "replans_rejected": "rejected",
    "improvements_asked": "improve", "improvements": "improved",
    "conflicts": "conflict", "broken_assumptions": "broken assumption",
}  # fmt: skip
"""Metrics that are numbers of events of a kind."""


def run_metrics(
    trajectory: Trajectory, events: Sequence[Event], limits: Limits, *, clearance: float = float("inf")
) -> dict[str, float]:
    """Return the metrics of a run by name; undefined ones are left out.

    - ``time_to_goal``: time of the first ``goal`` event [s], if there is one.
    - ``rest_time``: how long the robot was at rest [s], and ``stops``: how often it came to rest. Where the goal was
      reached, the rest at the end of the motion counts for neither; rest at the start is no stop.
    - ``replans_asked``, ``replans_accepted``, ``replans_rejected``, ``improvements_asked``, ``improvements``,
      ``conflicts``, ``evasions`` and ``broken_assumptions``: numbers of events.
    - ``reaction_p50`` and ``reaction_p95``: percentiles of ``seconds`` of the ``reaction`` events [s]: time from the
      first prediction of a conflict, anywhere on the remaining motion, to the change of the command.
    - ``near_reaction_p50`` and ``near_reaction_p95``: those of conflicts less than half a second ahead of a moving
      robot. Where it brakes already the command has changed before, and a robot at rest needs a plan.
    - ``clearance``: the given one, if it is finite [m].
    - ``duration`` [s], ``spectral_arc_length``, and ``jerk``, root mean square over time [rad/s^3], of the motion.
    - ``position_use``, ``velocity_use``, ``acceleration_use`` and ``jerk_use``: largest shares of the limits, and
      ``limit_use``, the largest of these.

    Args:
        trajectory: The executed motion from time 0 on.
        events: What happened.
        limits: Those of the robot.
        clearance: Least distance to dynamic obstacles [m]; infinite without one.

    Raises:
        ParameterError: A ``reaction`` event without a number of seconds, or the limits are those of other joints.
    """
    kinds = Counter(event.kind for event in events)
    goal = next((event.time for event in events if event.kind == "goal"), None)
    stood = rests(trajectory)
    if goal is not None and len(stood) and stood[-1, 1] == trajectory.duration:
        stood = stood[:-1]
    use = trajectory.use(limits)
    return {
        **({} if goal is None else {"time_to_goal": goal}),
        "rest_time": float((stood[:, 1] - stood[:, 0]).sum()),
        "stops": float((stood[:, 0] > 0.0).sum()),
        **{name: float(kinds[kind]) for name, kind in COUNTED.items()},
        "evasions": float(sum(e.kind == "accepted" and e.data.get("part") == "evade" for e in events)),
        **_reactions(events),
        **({"clearance": float(clearance)} if np.isfinite(clearance) else {}),
        "duration": trajectory.duration,
        "spectral_arc_length": trajectory.spectral_arc_length,
        "jerk": trajectory.jerk,
        **{f"{name}_use": share for name, share in use.items()},
        "limit_use": max(use.values()),
    }


def _reactions(events: Iterable[Event]) -> dict[str, float]:
    seconds, near = [], []
    for event in events:
        if event.kind == "reaction":
            check_number(event.data.get("seconds", float("nan")), "reaction.seconds", 0.0)
            seconds.append(float(event.data["seconds"]))
            if event.data.get("ahead", np.inf) < NEAR and event.data.get("doing") == GOING:
                near.append(seconds[-1])
    found = {}
    for name, some in (("reaction", seconds), ("near_reaction", near)):
        if some:
            found[f"{name}_p50"], found[f"{name}_p95"] = np.percentile(some, [50.0, 95.0]).tolist()
    return found


@dataclass(frozen=True)
class FailureRatio:
    """Failed runs among many: R_f of the paper.

    Attributes:
        failed: Number of runs that failed.
        total: Number of runs.
        low: Lower end of the Wilson confidence interval of the ratio.
        high: Upper end.
        by_outcome: Numbers of runs by outcome, the most frequent first.
    """

    failed: int
    total: int
    low: float
    high: float
    by_outcome: Mapping[Outcome, int]

    @property
    def ratio(self) -> float:
        """Share of the runs that failed."""
        return self.failed / self.total

    def __str__(self) -> str:
        """Return ``3.0 % of 100 (95 %: 1.0 to 8.5 %): 97 reached, 2 timeout, 1 hit-at-rest``."""
        causes = ", ".join(f"{count} {outcome}" for outcome, count in self.by_outcome.items())
        return (
            f"{100 * self.ratio:.1f} % of {self.total} "
            f"(95 %: {100 * self.low:.1f} to {100 * self.high:.1f} %): {causes}"
        )


def failure_ratio(results: Iterable[RunResult | Outcome], confidence: float = 0.95) -> FailureRatio:
    """Return the share of failed runs, with its binomial confidence interval, and the numbers by outcome.

    Args:
        results: The runs, or their outcomes.
        confidence: Of the interval.

    Raises:
        ParameterError: No run is given, or another confidence.
    """
    counts = Counter(one if isinstance(one, Outcome) else one.outcome for one in results)
    total = counts.total()
    if total == 0:
        raise ParameterError("results", 0, "one run or more")
    failed = total - counts[Outcome.REACHED]
    counts = Counter({outcome: count for outcome, count in counts.items() if count})
    return FailureRatio(failed, total, *share_interval(failed, total, confidence), dict(counts.most_common()))
