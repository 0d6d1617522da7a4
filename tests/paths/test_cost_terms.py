from __future__ import annotations

import numpy as np
import pytest
from support import ROOT

from apex_ompl import problems
from apex_ompl.apex.planner import APEX
from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ParameterError
from apex_ompl.ompl.setup import PlanningSetup, assemble
from apex_ompl.paths.candidates import first_valid
from apex_ompl.paths.optimizer import Optimizer, OptimizerSettings
from apex_ompl.paths.spline import Spline
from apex_ompl.robot import Robot

ELBOWS = [3, 10]


@pytest.fixture(scope="module")
def ready(robot: Robot) -> PlanningSetup:
    return assemble(problems.load("wall/easy/5"), robot)


def bends(states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return residuals sin(q_e) + 0.3 q_0 of both elbows e, with their Jacobians."""
    jacobian = np.zeros((len(states), 2, states.shape[1]))
    jacobian[:, :, 0] = 0.3
    for row, joint in enumerate(ELBOWS):
        jacobian[:, row, joint] = np.cos(states[:, joint])
    return np.sin(states[:, ELBOWS]) + 0.3 * states[:, :1], jacobian


def nothing(states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.zeros((len(states), 1)), np.zeros((len(states), 1, states.shape[1]))


def perturbed(ready: PlanningSetup, count: int) -> np.ndarray:
    limits = ready.robot.limits
    control = Optimizer().starts(ready.start, ready.goals[0], count, np.random.default_rng(3), 0.4)
    return Spline().with_ends(control.clip(limits.lower + 1e-3, limits.upper - 1e-3), ready.start, ready.goals[0])


def test_the_gradient_of_the_whole_cost_is_that_of_finite_differences(ready: PlanningSetup) -> None:
    optimizer, kernel, step = Optimizer(costs=[bends]), ready.checker.kernel, 1e-6
    spline, rng = optimizer.spline, np.random.default_rng(5)
    for control in perturbed(ready, 3):
        _, gradient = optimizer.evaluate(kernel, control)
        for _ in range(20):
            direction = np.zeros_like(control)
            direction[spline.inner] = rng.normal(size=(spline.free, kernel.robot.dof))
            after, before = (optimizer.evaluate(kernel, control + s * step * direction)[0].cost[0] for s in (1.0, -1.0))
            slope = float((gradient[0] * direction[spline.inner]).sum())
            assert (after - before) / (2 * step) == pytest.approx(slope, rel=1e-4, abs=1e-5)


def test_a_term_adds_half_its_mean_square(ready: PlanningSetup) -> None:
    kernel, control = ready.checker.kernel, perturbed(ready, 2)
    plain, _ = Optimizer().evaluate(kernel, control)
    with_terms, _ = Optimizer(costs=[bends, bends]).evaluate(kernel, control)
    for k, points in enumerate(control):
        states = Spline().basis((np.arange(64) + 0.5) / 64) @ points
        squares = (np.sin(states[:, ELBOWS]) + 0.3 * states[:, :1]) ** 2
        assert with_terms.cost[k] - plain.cost[k] == pytest.approx(squares.sum(axis=1).mean())
    assert np.array_equal(plain.clearance_cost, with_terms.clearance_cost)


def test_a_term_of_zeros_leaves_the_compiled_steps(ready: PlanningSetup) -> None:
    """The steps in NumPy are those of the compiled code, up to rounding."""
    kernel, control = ready.checker.kernel, perturbed(ready, 4)
    control[0, 5, 0] = 40.0  # far out of its limits
    for steps in (0, 1, 4):
        compiled = Optimizer().improve(kernel, control, steps=steps)
        ours = Optimizer(costs=[nothing]).improve(kernel, control, steps=steps)
        np.testing.assert_allclose(ours.control, compiled.control, atol=1e-7)
        np.testing.assert_allclose(ours.cost, compiled.cost, rtol=1e-7)
        assert np.array_equal(ours.steps, compiled.steps) and np.array_equal(ours.damping, compiled.damping)


def test_the_minimum_is_that_of_the_normal_equations(robot: Robot) -> None:
    """Far from obstacles the cost is quadratic, and its minimum solves a linear system."""
    kernel, goal = CollisionChecker(robot).kernel, robot.home.copy()
    goal[:7] += 0.3
    joint, weight, wanted, count = 3, 0.5, float(robot.home[3]) - 0.2, 40

    def near(states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        jacobian = np.zeros((len(states), 1, states.shape[1]))
        jacobian[:, 0, joint] = weight
        return weight * (states[:, [joint]] - wanted), jacobian

    settings = OptimizerSettings(
        samples=count, scene_margin=1e-6, own_margin=1e-6, stiffness=0.1, steps=60, tolerance=0.0
    )
    optimizer = Optimizer(settings=settings, costs=[near])
    spline = optimizer.spline
    line = spline.line(robot.home, goal)
    found = optimizer.improve(kernel, line)
    assert found.clearance_cost[0] == 0.0
    basis, gram = spline.basis((np.arange(count) + 0.5) / count), 0.1 * spline.gram(1)
    matrix = gram + weight**2 * basis.T @ basis / count
    right = weight**2 * wanted * basis.sum(axis=0) / count - matrix[:, [0, -1]] @ line[[0, -1], joint]
    expected = np.linalg.solve(matrix[spline.inner, spline.inner], right[spline.inner])
    np.testing.assert_allclose(found.control[0, spline.inner, joint], expected, atol=1e-6)


def test_paths_are_valid_and_follow_the_term(ready: PlanningSetup) -> None:
    """The term bends what is repaired and what is shortened."""
    kernel, checker, sums = ready.checker.kernel, ready.checker, []
    free = lambda path: checker.first_collision(path, 0.01) is None  # noqa: E731
    for costs in ([], [bends]):
        optimizer = Optimizer(costs=costs)
        found = first_valid(optimizer, kernel, perturbed(ready, 4), free)
        assert found is not None
        shorter = optimizer.shorten(kernel, found, free)
        assert shorter is not None and free(optimizer.spline.path(shorter))
        sums.append(float((bends(optimizer.spline.path(shorter))[0] ** 2).sum()))
    assert sums[1] < sums[0]


def test_apex_takes_an_optimizer_with_a_term(ready: PlanningSetup) -> None:
    asked = []

    def watched(states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        asked.append(states)
        return bends(states)

    setup = ready.simple_setup
    setup.clear()
    planner = APEX(setup.getSpaceInformation(), seed=0)
    planner.optimizer = Optimizer(planner.model.spline, costs=[watched])
    setup.setPlanner(planner)
    assert setup.solve(30.0).getStatus().name == "EXACT_SOLUTION" and asked


@pytest.mark.parametrize(
    ("residual", "jacobian", "message"),
    [((64,), (64, 1, 16), "residuals"), ((64, 2), (64, 1, 16), "Jacobians"), ((64, 1), (64, 1, 15), "Jacobians")],
)
def test_arrays_of_another_shape_are_refused(
    ready: PlanningSetup, residual: tuple[int, ...], jacobian: tuple[int, ...], message: str
) -> None:
    optimizer = Optimizer(costs=[lambda states: (np.zeros(residual), np.zeros(jacobian))])
    with pytest.raises(ParameterError, match=message):
        optimizer.improve(ready.checker.kernel, perturbed(ready, 1))
    with pytest.raises(ParameterError, match="residuals"):
        Optimizer(costs=[lambda states: (np.full((64, 1), np.nan), nothing(states)[1])]).improve(
            ready.checker.kernel, perturbed(ready, 1)
        )


def test_the_example_runs(capsys: pytest.CaptureFixture[str]) -> None:
    text = (ROOT / "examples" / "04_own_cost.py").read_text()
    assert text.count("\n") < 40
    exec(compile(text, "04_own_cost.py", "exec"), {"__name__": "__main__"})  # noqa: S102
    without, with_term = (float(line.split()[-2]) for line in capsys.readouterr().out.splitlines())
    assert with_term < without
