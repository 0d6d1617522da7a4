"""Paths: splines against SciPy, polylines against closed forms, and the one that goes from planner to timing."""

from __future__ import annotations

import pathlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from planning import HARD, cached_problem
from scipy.interpolate import BSpline

from apex_ompl import PlanResult, Timing, plan
from apex_ompl.apex.parameters import ApexParameters
from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.path_proof import Curve
from apex_ompl.errors import ParameterError
from apex_ompl.ompl.setup import assemble
from apex_ompl.paths.path import Path
from apex_ompl.paths.spline import Spline
from apex_ompl.planners import APEX
from apex_ompl.planning import steps


@pytest.mark.parametrize("spline", [Spline(), Spline(22, 3, 100), Spline(8, 2, 33, 3)])
def test_a_spline_is_scipys(spline: Spline) -> None:
    control = spline.with_ends(np.random.default_rng(0).normal(size=(spline.points, 3)), np.zeros(3), np.ones(3))
    path, theirs = Path.on(spline, control), BSpline(spline.knots, control, spline.degree)
    s = np.linspace(0.0, 1.0, 50)
    for order in range(spline.degree):
        wanted = theirs.derivative(order)(s) if order else theirs(s)
        np.testing.assert_allclose(path(s, order), wanted, atol=1e-10 * max(1.0, np.abs(wanted).max()))
    assert path(0.0).tolist() == [0.0] * 3 and path(1.0).tolist() == [1.0] * 3, "the ends are exact"
    np.testing.assert_allclose(path(spline.parameters), path.states, atol=1e-12)


def test_a_polyline_goes_by_its_length() -> None:
    path = Path(np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 0.0], [3.0, 1.0]]))
    assert path.length == 4.0 and path.dof == 2 and len(path) == 4
    np.testing.assert_allclose(path([0.0, 0.375, 0.75, 0.875, 1.0]), [[0, 0], [1.5, 0], [3, 0], [3, 0.5], [3, 1]])
    np.testing.assert_allclose(path([0.1, 0.75, 1.0], 1), [[4, 0], [0, 4], [0, 4]])
    assert not path(0.3, 2).any() and not Path(np.zeros((3, 2)))(0.5, 1).any()


@given(st.integers(0, 1000), st.floats(0.01, 2.0))
def test_samples_are_no_further_apart_than_asked(seed: int, spacing: float) -> None:
    states = np.random.default_rng(seed).normal(size=(5, 3))
    dense = Path(states).sample(spacing)
    assert np.abs(np.diff(dense, axis=0)).max() <= spacing * (1.0 + 1e-9)
    assert all((dense == q).all(axis=1).any() for q in states), "the waypoints are among them"
    assert Path(dense).length == pytest.approx(Path(states).length)
    assert np.array_equal(np.asarray(Path(states)), states) and np.array_equal(Path(states)[1:3], states[1:3])


def test_faulty_paths_and_parameters_are_named() -> None:
    for states in (np.zeros(3), np.zeros((0, 3))):
        with pytest.raises(ParameterError, match="path"):
            Path(states)
    with pytest.raises(ParameterError, match="both or none"):
        Path(np.zeros((2, 3)), Spline())
    path = Path(np.zeros((2, 3)))
    for s, order in ((1.5, 0), (float("nan"), 0), (0.5, -1), (0.5, True)):
        with pytest.raises(ParameterError):
            path(s, order)
    with pytest.raises(ParameterError, match="spacing"):
        path.sample(0.0)


def test_the_spline_of_the_planner_comes_out_of_plan_and_out_of_files(tmp_path: pathlib.Path) -> None:
    result = plan(cached_problem(HARD), timeout=20.0, timing=Timing(method="spline"), objective="length")
    assert result and result.path is not None and result.path.spline is not None
    np.testing.assert_array_equal(result.path.spline.path(result.path.control), result.path.states)
    tree = plan(cached_problem(HARD), "rrtconnect", timeout=20.0, objective="length")
    assert tree and tree.path is not None and tree.path.spline is None
    for one in (result, tree):
        for suffix in (".npz", ".json", ".yaml"):
            one.save(tmp_path / f"r{suffix}")
            again = PlanResult.load(tmp_path / f"r{suffix}").path
            assert again is not None and again.spline == one.path.spline
            np.testing.assert_array_equal(again.states, one.path.states)
            np.testing.assert_array_equal(again(0.3, 1), one.path(0.3, 1))


def test_the_straight_line_is_tried_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before ``solve`` in a plan, inside of it for users of OMPL."""
    ready = assemble(cached_problem(HARD))
    line, lines = np.stack([ready.start, ready.goals[0]]), 0
    prove, collides_along = CollisionChecker.prove, CollisionChecker.collides_along

    def counting(self: CollisionChecker, path: np.ndarray | Curve, **options: object) -> object:
        nonlocal lines
        lines += np.array_equal(path.states if isinstance(path, Curve) else path, line)
        return prove(self, path, **options)  # type: ignore[arg-type]

    def counting_quick(self: CollisionChecker, path: np.ndarray) -> bool:
        nonlocal lines
        lines += np.array_equal(path, line)
        return collides_along(self, path)

    monkeypatch.setattr(CollisionChecker, "prove", counting)
    monkeypatch.setattr(CollisionChecker, "collides_along", counting_quick)
    query = steps.check(ready, ApexParameters(sprint=0, seed=0), timeout=20.0)
    assert steps.straight_line(query) is None and lines == 1
    assert steps.prove(steps.solve(query, lines=False)) and lines == 1
    setup = assemble(cached_problem(HARD)).simple_setup
    setup.setPlanner(APEX(setup.getSpaceInformation(), ApexParameters(sprint=0, seed=0)))
    assert setup.solve(20.0) and lines == 2
