"""Smoothness of paths and motions: jerk, spectral arc length.

S_r of the paper, the sum of joint-space steps, is :func:`apex_ompl.trajopt.path.path_length`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from apex_ompl.errors import ParameterError
from apex_ompl.trajopt.path import resample
from apex_ompl.util.validation import check_array, check_path, check_positive

STEPS = 128  # into which a path is cut for its jerk


def jerk(path: ArrayLike, duration: float = 1.0) -> float:
    """Return the root mean square of the jerk of a path that is run through at even speed [rad/s^3].

    It is that of third differences of states at even distances, 129 of them, so that the corners of a polyline count as
    if they were rounded over about a hundredth of its length.

    Args:
        path: States, shape (N, dof).
        duration: Time in which it is run through [s].

    Raises:
        ParameterError: ``path`` has not two states or more, or ``duration`` is not positive.
    """
    states = check_path(path)
    check_positive(duration, "duration", "a positive number of seconds")
    third = np.diff(resample(states, STEPS + 1), 3, axis=0) * (STEPS / duration) ** 3
    return float(np.sqrt((third**2).sum(axis=1).mean()))


def spectral_arc_length(
    speed: ArrayLike, spacing: float, *, cutoff: float = 10.0, threshold: float = 0.05, padding: int = 4
) -> float:
    """Return the spectral arc length of a profile of speed, 0 or less; smoother motions have one nearer to 0.

    The negative length of the normalised amplitude spectrum up to ``cutoff`` or to the last frequency at which it
    reaches ``threshold`` (SPARC, Balasubramanian et al. 2015).

    Args:
        speed: Speeds at even times, shape (N,).
        spacing: Time between them [s].
        cutoff: Highest frequency [Hz].
        threshold: Amplitude, as a share of that at 0 Hz.
        padding: Zeros are added up to two to the power of this, times the next power of two of N.

    Raises:
        ParameterError: There is no movement, or ``spacing`` is not positive.
    """
    speeds = np.asarray(speed, dtype=float)
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
