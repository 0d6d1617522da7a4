"""The curve along a path, and its time-optimal parameterization."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import linprog
from support import distance

from apex_ompl.kernel.compiled.timing.time_parameterization import max_distance, sample_times
from apex_ompl.kernel.timing import PathRows, max_path_speeds
from apex_ompl.timing.curve import Curve, Polyline

VELOCITY, ACCELERATION = np.array([2.0, 2.5, 1.5]), np.array([10.0, 15.0, 8.0])


@pytest.mark.parametrize("seed", [0, 1, 2, 5])
def test_path_speeds_are_those_of_a_linear_program(seed: int) -> None:
    """On a grid the greedy passes may be a little slower where all joints that turn stand still for a moment."""
    rng = np.random.default_rng(seed)
    path = np.cumsum(rng.normal(0.0, 0.3, (8, 3)), axis=0)
    curve = Curve.along(Polyline.through(path), 0.5)
    first, second = curve.derivatives(12)
    n, step = len(first), curve.spacing / 12
    x = max_path_speeds(first, second, VELOCITY, ACCELERATION, step)
    rows, bounds = [], []
    for i in range(n - 1):  # |q' u + q'' x| <= a with u = (x[i + 1] - x[i]) / (2 step)
        for j in range(3):
            row = np.zeros(n)
            row[i], row[i + 1] = second[i, j] - first[i, j] / (2 * step), first[i, j] / (2 * step)
            rows += [row, -row]
            bounds += [ACCELERATION[j]] * 2
    most = np.min((VELOCITY / np.maximum(np.abs(first), 1e-12)) ** 2, axis=1)
    most[[0, -1]] = 0.0
    assert np.all(np.array(rows) @ x <= np.array(bounds) + 1e-9) and np.all(x >= 0.0) and np.all(x <= most + 1e-9)
    found = linprog(-np.ones(n), np.array(rows), np.array(bounds), bounds=np.stack([np.zeros(n), most], 1))
    assert found.success
    duration, least = (np.sum(2.0 * step / (np.sqrt(y[1:]) + np.sqrt(y[:-1]))) for y in (x, np.maximum(found.x, 0.0)))
    assert sample_times(x, step, 0.0, np.empty(0)) == pytest.approx(duration) and duration < 1.01 * least
    if seed == 2:  # without such a place
        np.testing.assert_allclose(x, found.x, atol=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_path_speeds_keep_further_limits(seed: int) -> None:
    """Limits that are not symmetric, as those of torques under gravity, and bounds on the speed."""
    rng = np.random.default_rng(seed)
    curve = Curve.along(Polyline.through(np.cumsum(rng.normal(0.0, 0.3, (8, 3)), axis=0)), 0.5)
    first, second = curve.derivatives(12)
    n, step = len(first), curve.spacing / 12
    mix, offset = rng.normal(0.0, 1.0, (3, 2)), 0.5 * np.sin(np.linspace(0.0, 9.0, n))[:, None]
    most = rng.uniform(1.0, 3.0, n)
    rows = PathRows(first @ mix, second @ mix, np.tile(-5.0 - offset, 2), np.tile(5.0 - offset, 2), most)
    x = max_path_speeds(first, second, VELOCITY, ACCELERATION, step, rows)
    assert (x <= most).all() and x[1:-1].min() > 0.0
    u = np.diff(x) / (2.0 * step)
    value = rows.slope[:-1] * u[:, None] + rows.bend[:-1] * x[:-1, None]
    assert (value >= rows.low[:-1] - 1e-9).all() and (value <= rows.high[:-1] + 1e-9).all()
    matrix, bounds = [], []
    for slope, bend, low, high in (
        (first, second, np.tile(-ACCELERATION, (n, 1)), np.tile(ACCELERATION, (n, 1))), rows[:-1]
    ):  # fmt: skip
        for i in range(n - 1):
            for j in range(slope.shape[1]):
                row = np.zeros(n)
                row[i], row[i + 1] = bend[i, j] - slope[i, j] / (2 * step), slope[i, j] / (2 * step)
                matrix += [row, -row]
                bounds += [high[i, j], -low[i, j]]
    cap = np.minimum(most, np.min((VELOCITY / np.maximum(np.abs(first), 1e-12)) ** 2, axis=1))
    cap[[0, -1]] = 0.0
    found = linprog(-np.ones(n), np.array(matrix), np.array(bounds), bounds=np.stack([np.zeros(n), cap], 1))
    assert found.success
    duration, least = (np.sum(2.0 * step / (np.sqrt(y[1:]) + np.sqrt(y[:-1]))) for y in (x, np.maximum(found.x, 0.0)))
    assert duration < 1.01 * least


def test_places_at_even_times_follow_the_speeds() -> None:
    x = np.append(np.linspace(0.0, 4.0, 50), np.linspace(4.0, 0.0, 50)[1:])  # even acceleration, then the opposite
    step = 0.02
    duration = sample_times(x, step, 0.0, np.empty(0))
    place = np.empty(101)
    assert sample_times(x, step, duration / 100, place) == duration
    push, half = 4.0 / (2 * 49 * step), duration / 2
    times = np.linspace(0.0, duration, 101)
    rising = 0.5 * push * times**2
    falling = 98 * step - 0.5 * push * (duration - times) ** 2
    np.testing.assert_allclose(place, np.where(times < half, rising, falling), atol=1e-12)


def test_curves_have_their_derivatives_and_keep_to_straight_lines() -> None:
    path = np.array([[0.0, 0.0, 0.0], [1.0, 0.2, 0.0], [1.1, -0.9, 0.4], [0.0, 0.0, 2.0]])
    line = Polyline.through(path)
    curve = Curve.along(line, 0.2)
    first, second = curve.derivatives(10)
    places = np.linspace(0.0, line.length, len(first))
    h = 1e-5
    inside = places[1:-1]
    np.testing.assert_allclose(first[1:-1], (curve.points(inside + h) - curve.points(inside - h)) / (2 * h), atol=1e-6)
    curvature = (curve.points(inside + h) - 2 * curve.points(inside) + curve.points(inside - h)) / h**2
    np.testing.assert_allclose(second[1:-1], curvature, atol=2e-3)
    np.testing.assert_allclose(curve.points(places[[0, -1]]), path[[0, -1]], atol=1e-12)
    straight = (places > 0.7) & (places < 0.8)
    np.testing.assert_allclose(curve.points(places[straight]), line.at(places[straight]), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(first[straight], axis=1), 1.0)


def test_distances_from_a_polyline_are_those_from_all_segments() -> None:
    rng = np.random.default_rng(2)
    path = np.cumsum(rng.normal(0.0, 0.2, (30, 3)), axis=0)
    line = Polyline.through(path)
    places = np.sort(rng.uniform(0.0, line.length, 50))
    points = line.at(places) + rng.normal(0.0, 0.01, (50, 3))
    assert max_distance(points, places, line.states, line.arc, 99.0) == pytest.approx(distance(points, path), rel=1e-12)
    assert max_distance(points, places, line.states, line.arc, 0.1) >= distance(points, path) - 1e-12
