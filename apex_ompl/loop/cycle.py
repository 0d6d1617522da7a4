"""A run in an environment step by step: advance it, take observations, and decide what the robot does."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from apex_ompl.loop.control import Control, RunRecord
from apex_ompl.loop.environment import Environment, Observation, ObservationSource
from apex_ompl.loop.replanning import Replanning
from apex_ompl.loop.tracking import Tracker, true_motions
from apex_ompl.moving.context import RunContext
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.scripts import obstacle_at
from apex_ompl.types import Array


class Cycle(Control):
    """One run in an environment, on any clock."""

    def __init__(
        self, environment: Environment, context: RunContext, replanning: Replanning, sensor: ObservationSource,
        seed: int, *, lead: float = 0.0, named: bool = True,
    ) -> None:  # fmt: skip
        """Set up a run with the robot at rest at the start.

        Args:
            environment: What truly happens.
            context: The robot among static obstacles, and the settings of the run.
            replanning: Answers requests for replans.
            sensor: Observes the environment.
            seed: Seed of random choices.
            lead: How long before a step it is decided [s].
            named: Whether the sensor gives obstacles the names that they have in the environment.
        """
        self._named = named
        self._environment, self._sensor = environment, sensor
        self._present: tuple[Obstacle, ...] = tuple(environment.present(0.0))
        super().__init__(context, replanning, seed, awaited={o.name for o in self._present if named}, lead=lead)
        self._waiting: list[Observation] = []
        self._started, self._broken, self._present_time = False, 0, 0.0

    def advance(self, now: float, q: Array | None = None) -> None:
        """Advance the environment to a time, and collect the observations until then.

        Args:
            now: The time [s].
            q: The robot's state then, shape (dof,), by default the one that it should be in.
        """
        self._environment.advance(now, self.executor.state(now) if q is None else q)
        if not self.aborted:
            try:
                self._waiting += self._sensor.observations(now)
            except Exception as error:  # whatever a sensor raises, the robot stops and the run is returned
                self.abort(f"the sensor failed, {type(error).__name__}: {error}")
        self._present, self._present_time = tuple(self._environment.present(now)), now

    def observe(self, now: float) -> None:
        """Take the observations that were received by a time [s], to which the environment was advanced."""
        later = []
        for observation in self._waiting:
            if observation.received > now + 1e-9:
                later.append(observation)
            else:
                self.take(observation, now)
        self._waiting = later
        self._broken += unexpected(self.tracker, self._present, now, named=self._named)

    def step(self, now: float) -> RunRecord | None:
        """Decide what the robot does from a time on [s], and return the record of the run where it is over."""
        if self.context.settings.prediction == "truth":
            allowed = tuple(self.context.setup.problem.allowed)
            predicted = true_motions(self.context.kernel, self._present, self._present_time, allowed)
            ended = self.decide(
                now, predicted, lambda: tuple(obstacle_at(o, now - self._present_time) for o in self._present)
            )
        else:
            ended = super().step(now)
        return None if ended is None else replace(ended, broken=self._broken)

    def announce_start(self, now: float) -> None:
        """Tell the environment of the first motion to a goal, once; the time is that of the last step [s]."""
        route = self.executor.route
        if not self._started and route is not None:
            self._environment.start(route.motion, max(route.start_time, now))
            self._started = True


def unexpected(tracker: Tracker, present: Iterable[Obstacle], now: float, *, named: bool = True) -> bool:
    """Whether an obstacle violates the assumptions of the guarantee: unseen, or outside its reachable set.

    Args:
        tracker: The estimates.
        present: The obstacles.
        now: The time [s].
        named: Whether estimates have the names of obstacles; otherwise any may be that of an obstacle.
    """
    tracks = (*tracker.tracks.values(), *tracker.doubted)
    for o in present:
        known = [track for track in tracks if track.shape.name == o.name or not named]
        if not any(tracker.may_contain(track, o, now) for track in known):
            return True
    return False
