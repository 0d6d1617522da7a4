"""Binomial confidence intervals."""

from __future__ import annotations

from math import sqrt
from statistics import NormalDist

from apex_ompl.util.validation import check_integer, check_number


def share_interval(count: int, of: int, confidence: float = 0.95) -> tuple[float, float]:
    """Return Wilson's confidence interval of a binomial proportion, ``count`` of ``of`` (Wilson 1927).

    Args:
        count: Number of successes.
        of: Number of trials.
        confidence: Coverage of the interval, 0 to 0.999999.

    Raises:
        ParameterError: ``count`` is not from 0 to ``of``, ``of`` is 0, or another confidence.
    """
    check_integer(count, "count", 0, check_integer(of, "tasks", 1))
    check_number(confidence, "confidence", 0.0, 0.999999)
    share, z = count / of, NormalDist().inv_cdf(0.5 + 0.5 * confidence)
    middle = share + z * z / (2 * of)
    half = z * sqrt(share * (1.0 - share) / of + (z / (2 * of)) ** 2)
    low, high = ((middle + side) / (1.0 + z * z / of) for side in (-half, half))
    return (low if count > 0 else 0.0), (high if count < of else 1.0)
