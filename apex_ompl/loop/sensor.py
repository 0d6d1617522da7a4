"""The model of a sensor: its rate, latency, noise and dropouts.

Its numbers are those of a depth camera with an obstacle detector, and this project's own choice.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np

from apex_ompl.errors import ParameterError
from apex_ompl.loop.environment import Environment, Observation
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.scripts import standing, vector
from apex_ompl.util.display import fields_line, one_line
from apex_ompl.util.validation import check_number, check_positive, check_seed

EARLIEST = 2**20  # largest number of observations before time 0
LONGEST = 3600.0  # longest time of observation before a run [s]
CUT = 3.0  # largest error, in standard deviations of one axis


@dataclass(frozen=True)
class Sensor:
    """A sensor that observes all dynamic obstacles.

    An ideal one is ``Sensor(rate=100.0, age=0.0, noise=0.0, dropout=0.0)``.

    Attributes:
        rate: Observations a second [1/s], at the times k / rate.
        age: Latency of an observation [s].
        noise: Standard deviation of the error of each coordinate [m]. Errors longer than 3 of these are shortened.
        dropout: Probability that an obstacle is missed in an observation, from 0 to 1, independent for each obstacle.
        seed: Seed of errors and dropouts.
    """

    rate: float = 30.0
    age: float = 0.05
    noise: float = 0.008
    dropout: float = 0.02
    seed: int = 0

    __repr__ = fields_line

    def __post_init__(self) -> None:
        """Check all numbers.

        Raises:
            ParameterError: One is outside its range.
        """
        check_positive(self.rate, "rate", "a positive number of observations a second")
        check_number(self.age, "age", 0.0)
        check_number(self.noise, "noise", 0.0)
        check_number(self.dropout, "dropout", 0.0, 1.0)
        check_seed(self.seed)

    @property
    def largest_error(self) -> float:
        """Largest distance between the true and the observed place of an obstacle [m]."""
        return CUT * self.noise

    def observe(self, environment: Environment, number: int) -> Observation:
        """Return the observation of a number, negative before time 0; the environment must have come to that time.

        It does not depend on other observations, nor do the errors of one obstacle on the other obstacles.
        """
        stamp = number / self.rate
        seen = [self._seen(obstacle, number) for obstacle in environment.present(stamp)]
        return Observation(stamp, stamp + self.age, tuple(obstacle for obstacle in seen if obstacle is not None))

    def _seen(self, obstacle: Obstacle, number: int) -> Obstacle | None:
        rng = np.random.default_rng([self.seed, number + EARLIEST, zlib.crc32(obstacle.name.encode())])
        if rng.random() < self.dropout:
            return None
        error = self.noise * rng.normal(size=3)
        length = float(np.linalg.norm(error))
        if length > self.largest_error:
            error *= self.largest_error / length
        return standing(obstacle).model_copy(update={"position": vector(np.add(obstacle.position, error))})


class SensorStream:
    """The observations of one environment by a sensor, in order, each returned once."""

    def __init__(self, sensor: Sensor, environment: Environment, watched: float = 0.0) -> None:
        """Start with the observation at time 0, or some time before [s].

        Raises:
            ParameterError: That time is not from 0 to an hour, or to that of a million observations.
        """
        check_number(watched, "watched", 0.0, min(LONGEST, EARLIEST / sensor.rate))
        self.sensor, self._environment = sensor, environment
        self._number, self._until = -int(watched * sensor.rate + 1e-9), -watched

    def __repr__(self) -> str:
        """Return the sensor and the environment."""
        return one_line("SensorStream", repr(self.sensor), repr(self._environment))

    def observations(self, until: float) -> tuple[Observation, ...]:
        """Return the observations with a stamp up to a time [s] that were not returned yet, in order of stamp.

        The environment is not asked about times after ``until``. An observation may be used from ``received`` on.

        Raises:
            ParameterError: The time is before the one of the last call.
        """
        check_number(until, "until")
        if until < self._until:
            raise ParameterError("until", until, f"at least {self._until:g}, as in the last call")
        self._until = until
        found = []
        while self._number / self.sensor.rate <= until:
            found.append(self.sensor.observe(self._environment, self._number))
            self._number += 1
        return tuple(found)
