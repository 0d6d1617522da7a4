"""Smoothness of paths and motions: root mean square jerk, pulses of the acceleration, and spectral arc length.

The smoothness S_r of the paper, the sum of joint-space steps, is :func:`apex_ompl.paths.path.path_length`.
"""

from __future__ import annotations

from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apex_ompl.errors import ParameterError
from apex_ompl.paths.path import resample
from apex_ompl.robot.model import Limits
from apex_ompl.types import Array
from apex_ompl.util.validation import check_array, check_path, check_positive, number_array

PULSE_SHARE = 0.3  # of the acceleration limit, above which there is a pulse
SHORTEST = 1e-9  # duration that a motion counts for at least [s]
STEPS = 128  # of even length that a path is resampled to for its jerk


def jerk(path: ArrayLike, duration: float = 1.0) -> float:
    """Return the root mean square jerk of a path that is followed at constant speed [rad/s^3].

    The jerk is the third difference of 129 states at even distances, d3q (128 / duration)^3, so that a corner of a
    polyline counts as if it were rounded over about a hundredth of the path's length.

    Args:
        path: States, shape (N, dof).
        duration: Duration of the motion [s].

    Raises:
        ParameterError: ``path`` has fewer than two states, or ``duration`` is not positive.
    """
    states = check_path(path)
    check_positive(duration, "duration", "a positive number of seconds")
    third = np.diff(resample(states, STEPS + 1), 3, axis=0) * (STEPS / duration) ** 3
    return float(np.sqrt((third**2).sum(axis=1).mean()))


class Smoothness(NamedTuple):
    """How restless the joints of a motion are.

    Attributes:
        pulses: Pulses of the acceleration a second, shape (dof,) [1/s].
        jerk: Root mean square over time of the jerk, as a share of its limit, shape (dof,).
    """

    pulses: Array
    jerk: Array

    @classmethod
    def of(cls, times: Array, accelerations: Array, limits: Limits, share: float = PULSE_SHARE) -> Self:
        """Return that of a motion with constant jerk between knots.

        Args:
            times: Of the knots, shape (K,) [s].
            accelerations: At the knots, shape (K, dof) [rad/s^2].
            limits: Limits of the joints.
            share: Share of the acceleration limit above which there is a pulse.
        """
        gaps, changes = np.diff(times), np.diff(accelerations, axis=0)
        duration = max(float(times[-1]), SHORTEST)
        squares = (changes**2 / gaps[:, None]).sum(axis=0)
        pulses = count_pulses(accelerations, share * limits.acceleration) / duration
        return cls(pulses, np.sqrt(squares / duration) / limits.jerk)


def count_pulses(accelerations: Array, thresholds: Array) -> NDArray[np.intp]:
    """Return how often the acceleration of each joint is over a threshold, shape (dof,).

    A pulse is a maximal interval in which |a| is over it.

    Args:
        accelerations: At the knots of a motion, linear in between, shape (K, dof) [rad/s^2].
        thresholds: Shape (dof,) [rad/s^2].
    """
    side = np.where(np.abs(accelerations) > thresholds, np.sign(accelerations), 0.0)
    before = np.concatenate([np.zeros_like(side[:1]), side[:-1]])
    found: NDArray[np.intp] = np.count_nonzero((side != 0.0) & (side != before), axis=0)
    return found


def spectral_arc_length(
    speed: ArrayLike, spacing: float, *, cutoff: float = 10.0, threshold: float = 0.05, padding: int = 4
) -> float:
    """Return the spectral arc length of a speed profile (SPARC), at most 0 and nearer to 0 for smoother motions.

    It is -sum_k sqrt((df_k / f_c)^2 + (dV_k)^2) over the normalized amplitude spectrum V(f), up to f_c: ``cutoff``, or
    the last frequency below it at which V reaches ``threshold`` (Balasubramanian et al. 2015).

    Args:
        speed: Speeds at even times, shape (N,).
        spacing: Time between them [s].
        cutoff: Highest frequency [Hz].
        threshold: Least amplitude, as a share of the largest.
        padding: The profile is padded with zeros to 2^padding times the next power of two of N.

    Raises:
        ParameterError: There is no movement, or ``spacing`` is not positive.
    """
    speeds = number_array(speed, "speed")
    check_array(speeds, ("N",), "speed", finite=True, least=2)
    if not speeds.any():
        raise ParameterError("speed", 0.0, "speeds that are not all 0")
    check_positive(spacing, "spacing", "a positive number of seconds")
    count = 2 ** (int(np.ceil(np.log2(len(speeds)))) + padding)
    amplitude = np.abs(np.fft.rfft(speeds, count))
    frequency = np.fft.rfftfreq(count, spacing)
    amplitude, frequency = amplitude[frequency <= cutoff] / amplitude.max(), frequency[frequency <= cutoff]
    last = int(np.flatnonzero(amplitude >= threshold)[-1])
    if last == 0:
        return 0.0
    amplitude, frequency = amplitude[: last + 1], frequency[: last + 1]
    steps = np.diff(frequency) / (frequency[-1] - frequency[0])
    return float(-np.hypot(steps, np.diff(amplitude)).sum())
