"""Metrics of sets of runs and paths: failure ratio, intervals, FID, KID, diversity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike

from apex_ompl.errors import ParameterError
from apex_ompl.paths.path import resample
from apex_ompl.types import Array
from apex_ompl.util.validation import check_array, check_path

STEPS = 128  # segments of a path that is resampled for distances between paths
BLOCK = 2048  # rows of a kernel matrix at a time
RESAMPLINGS = 200


def failure_ratio(solved: ArrayLike) -> float:
    """Return R_f, the share of tasks that failed, in percent (section III-E of the paper).

    Raises:
        ParameterError: No task is given.
    """
    outcomes = np.asarray(solved, dtype=bool)
    if not outcomes.size:
        raise ParameterError("tasks", 0, "one or more")
    return float(100.0 * np.mean(~outcomes))


def next_percentile(values: ArrayLike, percentile: float) -> float:
    """Return a percentile without interpolation, the next larger value, so that values may be infinite.

    Raises:
        ParameterError: No value is given.
    """
    given = np.sort(np.asarray(values, dtype=float))
    if not given.size:
        raise ParameterError("values", 0, "one or more")
    return float(given[_rank(len(given), percentile)])


def _rank(count: int, percentile: float) -> int:
    return max(min(count - 1, int(np.ceil(percentile / 100.0 * count)) - 1), 0)


def percentile_interval(
    values: ArrayLike, percentile: float, seed: int = 0, confidence: float = 0.95
) -> tuple[float, float]:
    """Return the bootstrap interval of a percentile; values may be infinite, the ends are values then.

    Raises:
        ParameterError: No value is given.
    """
    given = np.sort(np.asarray(values, dtype=float))
    if not given.size:
        raise ParameterError("values", 0, "one or more")
    rng = np.random.default_rng(seed)
    drawn = np.sort(rng.integers(len(given), size=(5 * RESAMPLINGS, len(given))), axis=1)  # ranks: inf - inf is nan
    found = np.sort(drawn[:, _rank(len(given), percentile)])
    tail = (1.0 - confidence) / 2.0
    low, high = found[int(tail * len(found))], found[int((1.0 - tail) * len(found))]
    return float(given[low]), float(given[high])


def diversity(paths: Sequence[ArrayLike]) -> float:
    """Return the mean distance between paths of one problem, 0 for a single one [rad].

    The distance of two paths is the root mean square of that of their states at even shares of their lengths.

    Args:
        paths: Valid paths, each of shape (N, dof).

    Raises:
        ParameterError: No path is given, or one has not two states or more.
    """
    if not len(paths):
        raise ParameterError("paths", 0, "one or more")
    even = [resample(check_path(path), STEPS + 1) for path in paths]
    apart = [np.sqrt(((a - b) ** 2).sum(axis=1).mean()) for a, b in combinations(even, 2)]
    return float(np.mean(apart)) if apart else 0.0


def frechet_distance(real: ArrayLike, made: ArrayLike) -> float:
    """Return the squared Frechet distance between normal distributions fitted to two sets of features.

    That is FID (Heusel et al. 2017; section III-E of the paper). It is too large for small sets.

    Args:
        real: Features, shape (N, d).
        made: Features, shape (M, d).

    Raises:
        ParameterError: The sets have not two features or more of the same length.
    """
    a, b = _features(real, made)
    mean = float(((a.mean(axis=0) - b.mean(axis=0)) ** 2).sum())
    first, second = (np.atleast_2d(np.cov(x, rowvar=False)) for x in (a, b))
    # The trace of the root of a product is the sum of the singular values of the product of the roots.
    roots = [_root(covariance) for covariance in (first, second)]
    shared = np.linalg.svd(roots[0] @ roots[1], compute_uv=False).sum()
    return max(0.0, mean + float(np.trace(first) + np.trace(second) - 2.0 * shared))


def kernel_distance(real: ArrayLike, made: ArrayLike) -> float:
    """Return the squared maximum mean discrepancy of two sets of features, without bias; it may come out below 0.

    The kernel is the cube of x.y/d + 1, which makes it KID (Binkowski et al. 2018).

    Args:
        real: Features, shape (N, d).
        made: Features, shape (M, d).

    Raises:
        ParameterError: The sets have not two features or more of the same length.
    """
    a, b = _features(real, made)

    def total(x: Array, y: Array) -> float:
        blocks = (x[k : k + BLOCK] for k in range(0, len(x), BLOCK))
        return float(sum(((block @ y.T / x.shape[1] + 1.0) ** 3).sum() for block in blocks))

    def alone(x: Array) -> float:
        own = (((x * x).sum(axis=1) / x.shape[1] + 1.0) ** 3).sum()
        return (total(x, x) - float(own)) / (len(x) * (len(x) - 1))

    return alone(a) + alone(b) - 2.0 * total(a, b) / (len(a) * len(b))


@dataclass(frozen=True)
class Realism:
    """How far a set of features is from a real one.

    Attributes:
        fid: The squared Frechet distance.
        interval: Its bootstrap interval, 95 %, of the spread alone: the bias of small sets is in both.
        floor: That between two halves of the real set, as many features each as ``made`` has where there are enough.
        kid: The squared maximum mean discrepancy.
        real: Number of real features.
        made: Number of the others.
        dimension: Their length.
    """

    fid: float
    interval: tuple[float, float]
    floor: float
    kid: float
    real: int
    made: int
    dimension: int


def realism(real: ArrayLike, made: ArrayLike, seed: int = 0) -> Realism:
    """Return FID and KID of a set of features, with an interval and a floor to compare them with.

    Args:
        real: Features, shape (N, d).
        made: Features, shape (M, d).
        seed: Of the bootstrap and of the halves.

    Raises:
        ParameterError: The sets have not four features or more of the same length.
    """
    a, b = _features(real, made)
    if min(len(a), len(b)) < 4:
        raise ParameterError("features", (a.shape, b.shape), "four or more in each set")
    rng = np.random.default_rng(seed)
    drawn = [
        frechet_distance(a[rng.integers(len(a), size=len(a))], b[rng.integers(len(b), size=len(b))])
        for _ in range(RESAMPLINGS)
    ]
    order, half = rng.permutation(len(a)), min(len(a) // 2, len(b))
    floor = frechet_distance(a[order[:half]], a[order[half : 2 * half]])
    fid, kid = frechet_distance(a, b), kernel_distance(a, b)
    # Drawn anew, sets are smaller in effect, and further apart: their spread counts, not their mean.
    low, high = fid + np.percentile(np.array(drawn) - np.mean(drawn), [2.5, 97.5])
    return Realism(fid, (float(low), float(high)), floor, kid, len(a), len(b), a.shape[1])


def _features(real: ArrayLike, made: ArrayLike) -> tuple[Array, Array]:
    a, b = np.asarray(real, dtype=float), np.asarray(made, dtype=float)
    check_array(a, ("N", "d"), "features", finite=True, least=2)
    check_array(b, ("N", a.shape[1]), "features", finite=True, least=2)
    return a, b


def _root(covariance: Array) -> Array:
    """Return the root of a covariance."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray((vectors * np.sqrt(np.clip(values, 0.0, None))) @ vectors.T)
