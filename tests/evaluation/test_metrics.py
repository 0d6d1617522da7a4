from __future__ import annotations

import cmath
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import linalg

from apex_ompl.errors import ParameterError
from apex_ompl.evaluation import metrics
from apex_ompl.timing import smoothness
from apex_ompl.util.statistics import share_interval


def test_failure_ratio_is_a_percentage() -> None:
    assert metrics.failure_ratio([True, False, True, True]) == 25.0
    assert metrics.failure_ratio([True]) == 0.0
    with pytest.raises(ParameterError, match="tasks: expected one or more"):
        metrics.failure_ratio([])


@given(st.integers(1, 300), st.floats(0.0, 1.0))
def test_share_interval_is_wilsons(of: int, share: float) -> None:
    count, z = round(share * of), 1.959963984540054
    p = count / of
    middle = (p + z * z / (2 * of)) / (1 + z * z / of)
    half = z / (1 + z * z / of) * math.sqrt(p * (1 - p) / of + z * z / (4 * of * of))
    low, high = share_interval(count, of)
    assert low == pytest.approx(max(0.0, middle - half), abs=1e-9)
    assert high == pytest.approx(min(1.0, middle + half), abs=1e-9)


def test_percentile_interval_covers_and_takes_what_never_ends() -> None:
    rng, covered = np.random.default_rng(0), 0
    for k in range(200):
        low, high = metrics.percentile_interval(rng.exponential(size=60), 50.0, seed=k)
        covered += low <= math.log(2.0) <= high
    assert 180 <= covered <= 199  # 95 %
    low, high = metrics.percentile_interval([1.0] * 8 + [math.inf] * 2, 50.0)
    assert low == 1.0 and high in (1.0, math.inf)
    assert metrics.percentile_interval([math.inf] * 5, 50.0) == (math.inf, math.inf)
    with pytest.raises(ParameterError, match="values"):
        metrics.percentile_interval([], 50.0)


def test_jerk_of_a_circle_is_known() -> None:
    radius, angle = 0.7, 2.0
    turn = np.linspace(0.0, angle, 4001)
    circle = radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    for duration in (1.0, 2.5):
        assert smoothness.jerk(circle, duration) == pytest.approx(radius * (angle / duration) ** 3, rel=1e-3)
    line = np.linspace([0.0, 0.0], [1.0, 2.0], 7)
    assert smoothness.jerk(line) < 1e-6 < smoothness.jerk([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    for path, duration in (([[0.0]], 1.0), ([[0.0], [math.nan]], 1.0), (line, 0.0)):
        with pytest.raises(ParameterError):
            smoothness.jerk(path, duration)


def by_sums(speed: np.ndarray, spacing: float, cutoff: float, threshold: float, padding: int) -> float:
    """The definition of the spectral arc length, without a fast transform."""
    count = 2 ** (math.ceil(math.log2(len(speed))) + padding)
    spectrum = []
    for k in range(count // 2 + 1):
        if k / (count * spacing) > cutoff:
            break
        spectrum.append(abs(sum(v * cmath.exp(-2j * math.pi * k * n / count) for n, v in enumerate(speed))))
    spectrum = [value / spectrum[0] for value in spectrum]
    last = max(k for k, value in enumerate(spectrum) if value >= threshold)
    steps = zip(spectrum[:last], spectrum[1 : last + 1], strict=True)
    return -sum(math.hypot(1.0 / last, b - a) for a, b in steps)


def test_spectral_arc_length_is_that_of_the_definition() -> None:
    time = np.linspace(0.0, 1.0, 51)
    smooth = 30.0 * time**2 * (1.0 - time) ** 2  # of least jerk
    found = smoothness.spectral_arc_length(smooth, 0.02)
    assert found == pytest.approx(by_sums(smooth, 0.02, 10.0, 0.05, 4), abs=1e-9)
    assert found == pytest.approx(-1.41, abs=0.02)  # as published for it
    rough = smooth * (1.0 + 0.5 * np.sin(40.0 * time))
    assert smoothness.spectral_arc_length(rough, 0.02) < found - 0.1
    assert smoothness.spectral_arc_length(3.0 * smooth, 0.02) == pytest.approx(found)
    for speed, spacing in (([0.0, 0.0], 0.1), ([1.0], 0.1), ([1.0, math.nan], 0.1), ([1.0, 2.0], 0.0)):
        with pytest.raises(ParameterError):
            smoothness.spectral_arc_length(speed, spacing)


def test_diversity_of_parallel_lines_is_their_mean_distance() -> None:
    line = np.linspace([0.0, 0.0], [2.0, 0.0], 5)
    lines = [line, line + [0.0, 1.0], (line + [0.0, 3.0])[[0, -1]]]
    assert metrics.diversity(lines) == pytest.approx((1.0 + 3.0 + 2.0) / 3.0)
    assert metrics.diversity(lines[:1]) == 0.0
    with pytest.raises(ParameterError):
        metrics.diversity([])


def with_moments(rng: np.random.Generator, mean: np.ndarray, covariance: np.ndarray, count: int) -> np.ndarray:
    """Features whose mean and covariance are exactly the given ones."""
    rows = rng.normal(size=(count, len(mean)))
    rows -= rows.mean(axis=0)
    rows = np.linalg.solve(np.linalg.cholesky(np.atleast_2d(np.cov(rows, rowvar=False))), rows.T).T
    return np.asarray(mean + rows @ np.linalg.cholesky(covariance).T)


@settings(max_examples=25)
@given(st.integers(0, 10_000), st.integers(1, 6))
def test_frechet_distance_is_that_of_the_formula(seed: int, size: int) -> None:
    rng = np.random.default_rng(seed)
    means = rng.normal(size=(2, size))
    roots = rng.normal(size=(2, size, size))
    first, second = (root @ root.T + 0.1 * np.eye(size) for root in roots)
    a, b = (with_moments(rng, m, c, 50) for m, c in zip(means, (first, second), strict=True))
    middle = np.atleast_2d(linalg.sqrtm(first @ second)).real  # section III-E of the paper, as it is written
    wanted = ((means[0] - means[1]) ** 2).sum() + np.trace(first + second - 2.0 * middle)
    assert metrics.frechet_distance(a, b) == pytest.approx(wanted, rel=1e-6, abs=1e-6)


def test_frechet_distance_of_what_is_alike_shrinks_with_the_number() -> None:
    rng = np.random.default_rng(3)
    few = metrics.frechet_distance(*rng.normal(size=(2, 100, 64)))
    many = metrics.frechet_distance(*rng.normal(size=(2, 10_000, 64)))
    assert few == pytest.approx(22.3, rel=0.1) and many == pytest.approx(0.22, rel=0.1)


def test_kernel_distance_is_the_mean_over_all_pairs() -> None:
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(9, 4)), rng.normal(0.5, size=(7, 4))

    def k(x: np.ndarray, y: np.ndarray) -> float:
        return (float(x @ y) / 4 + 1.0) ** 3

    same = np.mean([k(x, y) for n, x in enumerate(a) for m, y in enumerate(a) if n != m])
    same += np.mean([k(x, y) for n, x in enumerate(b) for m, y in enumerate(b) if n != m])
    cross = np.mean([k(x, y) for x in a for y in b])
    assert metrics.kernel_distance(a, b) == pytest.approx(same - 2.0 * cross)
    alike = [metrics.kernel_distance(*rng.normal(size=(2, 30, 3))) for _ in range(300)]
    assert abs(np.mean(alike)) < 4.0 * np.std(alike) / math.sqrt(300)  # without bias


def test_realism_says_what_is_needed_to_judge_it() -> None:
    rng = np.random.default_rng(2)
    real, made = rng.normal(size=(400, 5)), rng.normal(0.6, size=(200, 5))
    found = metrics.realism(real, made)
    assert found.interval[0] <= found.fid <= found.interval[1] and found.floor < 0.4 * found.fid and found.kid > 0.0
    assert (found.real, found.made, found.dimension) == (400, 200, 5)
    assert metrics.realism(real, made) == found
    for pair in ((real, made[:, :3]), (real, made[:1]), (real, np.full((9, 5), np.nan)), (real[:3], made)):
        with pytest.raises(ParameterError, match="features"):
            metrics.realism(*pair)
