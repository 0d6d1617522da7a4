from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.interpolate import BSpline

from apex_ompl.errors import ParameterError
from apex_ompl.paths.spline import Spline

SPLINES = [Spline(), Spline(14, 3), Spline(22, 3, 100), Spline(6, 1, 64), Spline(8, 2, 33, 3), Spline(3, 1, 5, 1)]


@pytest.mark.parametrize("spline", SPLINES)
def test_states_and_derivatives_are_scipys(spline: Spline) -> None:
    control = np.random.default_rng(0).normal(size=(spline.points, 4))
    theirs = BSpline(spline.knots, control, spline.degree)
    np.testing.assert_allclose(spline.path(control), theirs(spline.parameters), atol=1e-13)
    for order in range(1, spline.degree + 1):
        wanted = theirs.derivative(order)(spline.parameters)
        np.testing.assert_allclose(spline.derivative(control, order), wanted, atol=1e-12 * np.abs(wanted).max())
    assert not spline.derivative(control, spline.degree + 1).any()


@pytest.mark.parametrize("spline", SPLINES[:5])
def test_the_gram_matrix_is_an_integral(spline: Spline) -> None:
    control = np.random.default_rng(1).normal(size=spline.points)
    curve = BSpline(spline.knots, control, spline.degree)
    for order in (0, 1, 2):
        derivative = curve.derivative(order) if order else curve
        value = quad(lambda u, f=derivative: float(f(u)) ** 2, 0.0, 1.0, points=np.unique(spline.knots), limit=200)[0]
        assert control @ spline.gram(order) @ control == pytest.approx(value, rel=1e-7)


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1), st.sampled_from(SPLINES), st.integers(1, 16), st.floats(1e-6, 1e3), st.booleans())
def test_ends_are_exact_and_limits_are_kept(seed: int, spline: Spline, dof: int, scale: float, batch: bool) -> None:
    rng = np.random.default_rng(seed)
    shape = (3,) if batch else ()
    start, goal = (scale * rng.uniform(-1.0, 1.0, (*shape, dof)) for _ in range(2))
    control = spline.with_ends(scale * rng.uniform(-1.0, 1.0, (*shape, spline.points, dof)), start, goal)
    path = spline.path(control)
    assert path.shape == (*shape, spline.states, dof)
    assert np.array_equal(path[..., 0, :], start) and np.array_equal(path[..., -1, :], goal)
    assert np.abs(path).max() <= scale  # to the last bit, as limits ask for
    pinned = spline.pinned - 1
    for order in range(1, min(pinned, spline.degree) + 1):
        speed = spline.derivative(control, order)
        assert np.abs(speed[..., [0, -1], :]).max() <= 1e-9 * max(1e-300, np.abs(speed).max())


@pytest.mark.parametrize("spline", SPLINES)
def test_the_line_is_straight(spline: Spline) -> None:
    start, goal = np.random.default_rng(2).normal(size=(2, 7))
    control = spline.line(start, goal)
    path = spline.path(control)
    along = (path - start) @ (goal - start) / ((goal - start) @ (goal - start))
    np.testing.assert_allclose(path, start + along[:, None] * (goal - start), atol=1e-12)
    assert (np.diff(along) > -1e-12).all()
    if spline.pinned == 1:
        np.testing.assert_allclose(along, spline.parameters, atol=1e-12)


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1), st.integers(2, 12), st.sampled_from(SPLINES))
def test_the_bound_of_a_fit_holds(seed: int, count: int, spline: Spline) -> None:
    rng = np.random.default_rng(seed)
    line = np.cumsum(rng.normal(size=(count, 5)), axis=0)
    fit = spline.fit(line)
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    u = np.sort(rng.uniform(0.0, 1.0, 500))
    wanted = np.stack([np.interp(u * along[-1], along, c) for c in line.T], axis=1)
    assert np.abs(spline.basis(u) @ fit.control - wanted).max() <= fit.error
    assert np.array_equal(fit.control[0], line[0]) and np.array_equal(fit.control[-1], line[-1])


def test_a_fit_gives_a_curve_back_and_keeps_limits() -> None:
    spline = Spline(14, 1, 256)
    rng = np.random.default_rng(3)
    control = spline.line(np.zeros(4), np.ones(4))
    assert spline.fit(spline.path(control)).error < 0.01
    np.testing.assert_allclose(spline.fit(spline.path(control)).control, control, atol=1e-6)
    rough = np.clip(np.cumsum(rng.normal(size=(8, 4)), axis=0), -0.5, 0.5)
    fit = spline.fit(rough, -0.5, 0.5)
    assert np.abs(fit.control).max() <= 0.5
    assert spline.fit(np.ones((3, 4))).error == 0.0
    finer = Spline(40, 1).fit(rough)
    assert finer.error < spline.fit(rough).error


@pytest.mark.parametrize(
    ("numbers", "word"),
    [((5, 1), "points"), ((14, 0), "pinned"), ((14, 7), "pinned"), ((14, 1, 1), "states"), ((14, 1, 256, 0), "degree")],
)
def test_numbers_out_of_range_are_named(numbers: tuple[int, ...], word: str) -> None:
    with pytest.raises(ParameterError, match=word):
        Spline(*numbers)


def test_faults_of_arrays_are_named() -> None:
    spline = Spline()
    with pytest.raises(ParameterError, match="control points"):
        spline.path(np.zeros((13, 16)))
    with pytest.raises(ParameterError, match="polyline"):
        spline.fit(np.full((3, 2), np.nan))
    with pytest.raises(ParameterError, match="u"):
        spline.basis([1.5])
