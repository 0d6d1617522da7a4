"""The Gaussian-process prior, against integrals, a dense Gaussian regression, a Hermite spline and GTSAM."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from apex_ompl.baselines.gpmp.gaussian_process import BlockTridiagonal, GaussianProcess
from apex_ompl.baselines.gpmp.optimizer import CostFunctional, FactorGraph
from apex_ompl.errors import ParameterError
from apex_ompl.kernel.path import ClearanceCosts

EPS, CENTER, RADIUS = 0.3, np.array([0.5, 0.45]), 0.25


def dense_covariance(process: GaussianProcess, times: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Covariance of (q, v) at times [s] of a process that begins with covariance ``first``, in closed form."""
    found = np.empty((len(times), 2, len(times), 2))
    for a, s in enumerate(times):
        for b, t in enumerate(times):
            low = min(s, t)
            mine = process.transition(low) @ first @ process.transition(low).T + process.covariance(low)
            found[a, :, b] = process.transition(s - low) @ mine @ process.transition(t - low).T
    return found.reshape(2 * len(times), 2 * len(times))


def random_supports(process: GaussianProcess, dof: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(process.intervals + 1, 2, dof))


def disc(q: np.ndarray, times: np.ndarray) -> ClearanceCosts:
    """Clearance costs of points of the plane that keep away from a disc."""
    away = q - CENTER
    distance = np.linalg.norm(away, axis=1)
    normal = away / distance[:, None]
    violation = np.maximum((EPS - (distance - RADIUS)) / EPS, 0.0)
    rows = np.where(violation[:, None] > 0.0, normal / EPS, 0.0)
    clearance = np.stack([np.minimum(distance - RADIUS, EPS), np.full(len(q), EPS)], axis=1)
    return ClearanceCosts(
        0.5 * violation**2, -violation[:, None] * rows, np.einsum("ka,kb->kab", rows, rows), clearance
    )


def crossing(process: GaussianProcess) -> np.ndarray:
    """Supports of the line across the disc, from rest to rest."""
    supports = process.constant_velocity(np.zeros(2), np.ones(2))
    supports[[0, -1], 1] = 0.0
    return supports


@given(st.floats(0.01, 3.0), st.floats(0.1, 50.0))
def test_transition_and_covariance_are_those_of_the_equation(time: float, power: float) -> None:
    """Phi = exp(F t), and Q the integral of Phi L Q_C L^T Phi^T, by Gauss-Legendre."""
    process = GaussianProcess(4, 4.0 * time, power)
    rate = np.array([[0.0, 1.0], [0.0, 0.0]])
    np.testing.assert_allclose(process.transition(time), np.eye(2) + rate * time)  # the series ends here
    nodes, weights = np.polynomial.legendre.leggauss(3)
    columns = [process.transition(time - 0.5 * time * (1.0 + x)) @ np.array([0.0, 1.0]) for x in nodes]
    wanted = 0.5 * time * power * sum(w * np.outer(c, c) for w, c in zip(weights, columns, strict=True))
    np.testing.assert_allclose(process.covariance(time), wanted, rtol=1e-12, atol=1e-15)
    assert process.spacing == pytest.approx(time)
    np.testing.assert_allclose(process.precision @ process.covariance(process.spacing), np.eye(2), atol=1e-9)


def test_interpolation_is_the_mean_of_a_dense_regression() -> None:
    """Conditioned on all supports, the process has the mean that two of them give."""
    process, count = GaussianProcess(5, 2.0, 0.7), 4
    supports = random_supports(process, 3, 0)
    fine = np.linspace(0.0, 2.0, 5 * count + 1)
    covariance = dense_covariance(process, fine, np.diag([0.5, 0.8]))
    known = np.concatenate([[2 * k, 2 * k + 1] for k in range(0, len(fine), count)])
    mean = covariance[:, known] @ np.linalg.solve(covariance[np.ix_(known, known)], supports.reshape(-1, 3))
    np.testing.assert_allclose(process.states(supports, count), mean.reshape(-1, 2, 3), atol=1e-8)


@given(st.floats(0.0, 1.0), st.integers(0, 100))
def test_interpolation_is_a_cubic_hermite_spline(share: float, seed: int) -> None:
    process = GaussianProcess(2, 1.4, 3.0)
    h, s = process.spacing, share
    (p, m), (q, n) = np.random.default_rng(seed).normal(size=(2, 2))
    wanted = (2 * s**3 - 3 * s**2 + 1) * p + (s**3 - 2 * s**2 + s) * h * m
    wanted += (-2 * s**3 + 3 * s**2) * q + (s**3 - s**2) * h * n
    before, behind = process.interpolation(share * h)
    assert (before @ [p, m] + behind @ [q, n])[0] == pytest.approx(wanted, abs=1e-9)


def test_the_covariance_of_inner_supports_is_that_of_a_dense_regression() -> None:
    process = GaussianProcess(6, 1.5, 2.0)
    times = np.linspace(0.0, 1.5, 7)
    covariance = dense_covariance(process, times, np.diag([3.0, 2.0]))
    ends, inner = np.array([0, 1, 12, 13]), np.arange(2, 12)
    gain = np.linalg.solve(covariance[np.ix_(ends, ends)], covariance[np.ix_(ends, inner)])
    conditional = covariance[np.ix_(inner, inner)] - covariance[np.ix_(inner, ends)] @ gain
    np.testing.assert_allclose(process.inner_covariance, conditional, atol=1e-9)
    given_ends = np.random.default_rng(3).normal(size=(2, 2, 4))
    wanted = gain.T @ given_ends.reshape(4, 4)
    np.testing.assert_allclose(process.mean(*given_ends)[1:-1].reshape(10, 4), wanted, atol=1e-9)


def test_the_mean_from_rest_to_rest_is_on_the_line_and_no_cost_is_less() -> None:
    process, (start, goal) = GaussianProcess(8), np.array([[0.0, 1.0, -1.0], [2.0, 1.0, 0.5]])
    still = np.zeros(3)
    mean = process.mean(np.stack([start, still]), np.stack([goal, still]))
    shares = (mean[:, 0] - start)[:, [0, 2]] / (goal - start)[[0, 2]]
    np.testing.assert_allclose(shares[:, 0], shares[:, 1], atol=1e-9)
    assert (mean[:, 0, 1] == pytest.approx(1.0)) and np.abs(process.gradient(mean)[1:-1]).max() < 1e-6
    line = process.constant_velocity(start, goal)
    assert process.cost(line) == pytest.approx(0.0, abs=1e-12) and process.cost(mean) > 1.0
    line[[0, -1], 1] = 0.0
    assert process.cost(mean) < process.cost(line)


def test_the_gradient_of_the_prior_is_that_of_finite_differences() -> None:
    process = GaussianProcess(5, 1.3, 0.4)
    supports, rng = random_supports(process, 2, 1), np.random.default_rng(2)
    for _ in range(10):
        way = rng.normal(size=supports.shape)
        slope = (process.cost(supports + 1e-5 * way) - process.cost(supports - 1e-5 * way)) / 2e-5
        assert slope == pytest.approx(float((process.gradient(supports) * way).sum()), rel=1e-6)


def test_samples_have_the_spread_that_is_asked_for_and_keep_the_ends() -> None:
    process, rng = GaussianProcess(10), np.random.default_rng(4)
    mean = process.constant_velocity(np.zeros(3), np.ones(3))
    drawn = np.stack([process.sample(mean, rng, 0.5) for _ in range(2000)])
    assert (drawn[:, [0, -1]] == mean[[0, -1]]).all()
    spread = drawn[:, :, 0].std(axis=0)
    assert spread.max() == pytest.approx(0.5, rel=0.05) and spread[1].max() < 0.2


@given(st.integers(1, 9), st.integers(1, 6), st.integers(0, 1000))
def test_block_elimination_is_the_dense_solution(n: int, b: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    factors = rng.normal(size=(n, b, b))
    matrix = BlockTridiagonal(
        factors @ factors.transpose(0, 2, 1) + 6.0 * b * np.eye(b), rng.normal(size=(n - 1, b, b))
    )
    dense, right = matrix.dense(), rng.normal(size=(n, b))
    assert np.array_equal(dense, dense.T)
    np.testing.assert_allclose(
        matrix.solve(right).ravel(), np.linalg.solve(dense, right.ravel()), rtol=1e-8, atol=1e-10
    )
    damped = matrix.damped(0.25).dense()
    np.testing.assert_allclose(np.diag(damped), 1.25 * np.diag(dense))
    np.testing.assert_allclose(damped - np.diag(np.diag(damped)), dense - np.diag(np.diag(dense)))


@pytest.mark.parametrize("kind", [FactorGraph, CostFunctional])
def test_gradients_of_both_costs_are_those_of_finite_differences(kind: type) -> None:
    process = GaussianProcess(6, 1.0, 2.0)
    problem = kind(process, disc, np.full(2, -0.2), np.full(2, 0.9), 5, 30.0, 0.1)
    rng, checked = np.random.default_rng(5), 0
    for _ in range(10):
        supports = crossing(process)
        supports[1:-1] += 0.1 * rng.normal(size=supports[1:-1].shape)
        found, way = problem.evaluate(supports), np.zeros_like(supports)
        way[1:-1] = rng.normal(size=supports[1:-1].shape)
        sides = [problem.evaluate(supports + s * 1e-6 * way).cost for s in (1.0, -1.0)]
        slope = float((found.gradient * way[1:-1]).sum())
        assert (sides[0] - sides[1]) / 2e-6 == pytest.approx(slope, rel=1e-5, abs=1e-4)
        checked += found.clearance[0] < EPS
    assert checked == 10


def test_the_matrix_of_the_graph_is_that_of_its_residuals() -> None:
    """J^T J of prior, violations and limits, each differentiated on its own."""
    process = GaussianProcess(5, 1.0, 2.0)
    graph = FactorGraph(process, disc, np.full(2, -0.2), np.full(2, 0.9), 4, 30.0, 0.1)
    supports = crossing(process)
    supports[1:-1] += 0.05 * np.random.default_rng(6).normal(size=supports[1:-1].shape)
    root = np.linalg.cholesky(process.precision).T

    def residuals(inner: np.ndarray) -> np.ndarray:
        mine = np.concatenate([supports[:1], inner.reshape(-1, 2, 2), supports[-1:]])
        q = process.states(mine, 4)[:-1, 0]
        beyond = (q - np.clip(q, graph.lower, graph.upper)) / 0.1
        violation = np.sqrt(2.0 * 30.0 * disc(np.clip(q, graph.lower, graph.upper), graph.times).cost)
        whitened = np.einsum("pv,ivd->ipd", root, process.errors(mine))
        return np.concatenate([whitened.ravel(), violation, beyond.ravel()])

    x = supports[1:-1].ravel()
    columns = [(residuals(x + 1e-6 * e) - residuals(x - 1e-6 * e)) / 2e-6 for e in np.eye(len(x))]
    jacobian, found = np.stack(columns, axis=1), graph.evaluate(supports)
    assert found.cost == pytest.approx(0.5 * float((residuals(x) ** 2).sum()), rel=1e-12)
    np.testing.assert_allclose(found.gradient.ravel(), jacobian.T @ residuals(x), rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(found.matrix.dense(), jacobian.T @ jacobian, rtol=1e-5, atol=1e-3)


def test_the_limits_are_kept_by_smooth_projection() -> None:
    process = GaussianProcess(10)
    problem = CostFunctional(process, disc, np.full(2, -0.1), np.full(2, 0.4), 5, 1.0)
    supports = process.constant_velocity(np.zeros(2), np.full(2, 0.3))
    supports[4:6, 0, 0] = 0.7
    found = problem.within_limits(supports)
    assert found[1:-1, 0].max() <= 0.4 + 1e-9 and found[1:-1, 0].min() >= -0.1 - 1e-9
    assert np.array_equal(found[:, :, 1], supports[:, :, 1]) and np.array_equal(found[[0, -1]], supports[[0, -1]])
    assert np.array_equal(problem.within_limits(found), found)


def test_both_get_around_a_disc() -> None:
    process = GaussianProcess(10)
    line = crossing(process)
    line[1:-1, 0] += [[0.02, -0.02]]  # the line itself is a saddle
    limits = np.full(2, -1.0), np.full(2, 2.0)
    best = FactorGraph(process, disc, *limits, 6, 1e4).maximum(line, 100, 1e-6)
    assert best.converged and best.evaluation.clearance[0] > 0.0 and best.evaluation.cost < best.first_cost
    gradient = CostFunctional(process, disc, *limits, 6, 1e5)
    found = gradient.minimum(line, 400, 1e-7)
    assert found.evaluation.clearance[0] > 0.0 and found.evaluation.cost < 0.1 * found.first_cost
    first = gradient.minimum(line, 400, 1e-7, accepts=lambda supports, about: bool(about.clearance[0] > 0.0))
    assert first.iterations < found.iterations and not first.converged and first.evaluation.clearance[0] > 0.0
    assert gradient.minimum(line, 400, 1e-7, stop=lambda: True).iterations == 0
    assert FactorGraph(process, disc, *limits, 6, 1e4).maximum(line, 100, 1e-6, stop=lambda: True).iterations == 0


def test_bad_numbers_are_named() -> None:
    for values, name in (((1, 1.0, 1.0), "intervals"), ((4, 0.0, 1.0), "duration"), ((4, 1.0, -1.0), "power")):
        with pytest.raises(ParameterError, match=name):
            GaussianProcess(*values)
    with pytest.raises(ParameterError, match="supports"):
        GaussianProcess(4).states(np.zeros((4, 2, 3)), 2)


def test_gtsam_finds_the_same_optimum() -> None:
    """GTSAM's white-noise-on-acceleration factors, ends by tight priors, and the disc as factors of its own."""
    gtsam = pytest.importorskip("gtsam")
    process, checked, weight = GaussianProcess(8, 2.0, 0.5), 4, 100.0
    line = crossing(process)
    line[1:-1, 0] += [[0.02, -0.02]]
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    keys = [(gtsam.symbol("x", i), gtsam.symbol("v", i)) for i in range(9)]
    data = [gtsam.StateData(x, v, i * process.spacing) for i, (x, v) in enumerate(keys)]
    for i in range(8):
        graph.push_back(gtsam.WnoaMotionFactorPoint2(data[i], data[i + 1], np.full(2, process.power)))
    for i in (0, 8):
        for key, value in zip(keys[i], line[i], strict=True):
            graph.push_back(gtsam.PriorFactorPoint2(key, value, gtsam.noiseModel.Isotropic.Sigma(2, 1e-7)))
    noise = gtsam.noiseModel.Isotropic.Sigma(1, weight**-0.5)
    for i in range(8):
        for k in range(checked):
            s, h = k / checked, process.spacing  # cubic Hermite polynomials
            w = [2 * s**3 - 3 * s**2 + 1, (s**3 - 2 * s**2 + s) * h, -2 * s**3 + 3 * s**2, (s**3 - s**2) * h]

            def error(factor: object, now: object, jacobians: list | None, w: list = w) -> np.ndarray:
                q = sum(c * now.atPoint2(key) for c, key in zip(w, factor.keys(), strict=True))
                away = q - CENTER
                distance = np.linalg.norm(away)
                violation = max((EPS - (distance - RADIUS)) / EPS, 0.0)
                if jacobians is not None:
                    for m, c in enumerate(w):
                        jacobians[m] = -c * (violation > 0.0) * (away / distance / EPS)[None]
                return np.array([violation])

            graph.push_back(gtsam.CustomFactor(noise, [*keys[i], *keys[i + 1]], error))
    for i, (x, v) in enumerate(keys):
        values.insert(x, line[i, 0])
        values.insert(v, line[i, 1])
    settings = gtsam.LevenbergMarquardtParams()
    settings.setRelativeErrorTol(1e-14)
    settings.setAbsoluteErrorTol(1e-14)
    settings.setMaxIterations(300)
    theirs = gtsam.LevenbergMarquardtOptimizer(graph, values, settings).optimize()
    mine = FactorGraph(process, disc, np.full(2, -9.0), np.full(2, 9.0), checked, weight).maximum(line, 300, 1e-14)
    assert mine.evaluation.clearance[0] < EPS and mine.iterations > 3
    assert mine.evaluation.cost == pytest.approx(graph.error(theirs), rel=1e-6)
    found = np.array([[theirs.atPoint2(key) for key in pair] for pair in keys])
    np.testing.assert_allclose(mine.supports, found, atol=2e-5)
    assert mine.first_cost == pytest.approx(graph.error(values), rel=1e-9)
