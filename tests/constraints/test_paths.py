"""Paths and motions on constraints: trees, shortcuts, optimized control points, exact states, lowered durations."""

from __future__ import annotations

import numpy as np
import pytest
from planning import cached_problem

from apex_ompl.constraints.constraint_set import ConstraintSet
from apex_ompl.constraints.paths import ConstrainedPaths, ConstraintCost
from apex_ompl.constraints.proof import prove_motion, prove_path
from apex_ompl.kernel.constraints import optimize_constrained_path
from apex_ompl.kernel.path import CostSettings, optimization_buffers
from apex_ompl.ompl.setup import PlanningSetup, assemble
from apex_ompl.paths.optimizer import Optimizer, path_grid
from apex_ompl.paths.path import path_length
from apex_ompl.timing import time_path
from apex_ompl.timing.duration import DurationOptimizer
from apex_ompl.timing.trajectory import Trajectory
from apex_ompl.types import Array


@pytest.fixture(scope="module")
def ready() -> PlanningSetup:
    """A tray in two hands, kept level."""
    return assemble(cached_problem("carry_tray"))


@pytest.fixture(scope="module")
def constraints(ready: PlanningSetup) -> ConstraintSet:
    """Its constraints."""
    assert ready.constraints is not None
    return ready.constraints


@pytest.fixture(scope="module")
def paths(ready: PlanningSetup, constraints: ConstraintSet) -> ConstrainedPaths:
    """Paths on them."""
    kernel = ready.checker.kernel.within(*ready.bounds)
    return ConstrainedPaths(kernel, constraints, Optimizer(), lambda path: bool(ready.checker.prove(path)))


@pytest.fixture(scope="module")
def nodes(ready: PlanningSetup, paths: ConstrainedPaths) -> Array:
    """Nodes of a path of trees."""
    trees = paths.trees(ready.start[None], ready.goals, np.random.default_rng(0))
    assert trees is not None
    found = trees.grow(4000)
    assert found is not None
    return found


def test_trees_meet_on_the_constraints(ready: PlanningSetup, constraints: ConstraintSet, nodes: Array) -> None:
    assert np.array_equal(nodes[0], ready.start) and np.array_equal(nodes[-1], ready.goals[0])
    tilts, offsets = constraints.violations(nodes[1:-1]).T
    assert offsets.max() <= 1e-6 and tilts.max() <= 0.0081  # inside the dead zone of the tilt
    assert ready.checker.are_free(nodes).all()


def test_hands_stay_where_start_and_goal_agree(ready: PlanningSetup, nodes: Array) -> None:
    fixed = [ready.robot.joint_names.index(name) for name in ("left_hand_synergy", "right_hand_synergy")]
    assert (nodes[:, fixed] == ready.start[fixed]).all()


def test_exact_states_are_proved_between_each_other(
    ready: PlanningSetup, constraints: ConstraintSet, paths: ConstrainedPaths, nodes: Array
) -> None:
    states = paths.along(nodes)
    assert states is not None and prove_path(constraints, states) and ready.checker.prove(states)
    share = np.linspace(0.0, 1.0, 20)[:, None]
    dense = np.concatenate([a + share * (b - a) for a, b in zip(states, states[1:], strict=False)])
    assert (constraints.violations(dense) <= constraints.tolerances).all()
    assert (constraints.violations(nodes[:1] + share * (nodes[-1:] - nodes[:1])) > constraints.tolerances).any()


def test_shortcuts_are_shorter_and_keep_the_ends(paths: ConstrainedPaths, nodes: Array) -> None:
    short = paths.shortcut(nodes, 40, np.random.default_rng(1))
    assert path_length(short) < path_length(nodes)
    assert np.array_equal(short[[0, -1]], nodes[[0, -1]])


def test_optimized_control_points_are_near_the_constraints(
    constraints: ConstraintSet, paths: ConstrainedPaths, nodes: Array
) -> None:
    control = paths.fit(paths.shortcut(nodes, 40, np.random.default_rng(1)))
    better = paths.improved(control)
    assert better is not None
    before, after = (constraints.violations(paths.optimizer.spline.path(c)).max(axis=0) for c in (control, better))
    assert after[1] < 0.5 * before[1] and (after < constraints.tolerances).all()


def test_the_penalty_is_half_the_weighted_mean_square(
    ready: PlanningSetup, constraints: ConstraintSet, paths: ConstrainedPaths
) -> None:
    spline, samples, weight = paths.optimizer.spline, 16, 100.0
    control = spline.line(ready.start, ready.goals[0])
    rows = constraints.rows
    assert rows is not None
    grid, buffers = path_grid(spline, samples), optimization_buffers(spline.pinned, *control.shape)
    costs = []
    for one in (0.0, weight):
        settings = CostSettings(0.04, 0.02, 1e-3, 0.0, np.inf, 0.0, 0)
        report = optimize_constrained_path(
            paths.kernel, rows, grid, spline.pinned, control.copy(), settings, one, buffers
        )  # fmt: skip
        costs.append(report.cost)
    states = spline.basis((np.arange(samples) + 0.5) / samples) @ control
    squares = [float((rows.residual(q, 1.0)[0] ** 2).sum()) for q in states]
    assert costs[1] - costs[0] == pytest.approx(0.5 * weight * np.mean(squares), rel=1e-9)


def test_steps_in_python_agree_with_compiled_ones(
    ready: PlanningSetup, constraints: ConstraintSet, paths: ConstrainedPaths
) -> None:
    control = paths.optimizer.spline.line(ready.start, ready.goals[0])
    weight = 100.0
    term = Optimizer(paths.optimizer.spline, paths.optimizer.settings, costs=[ConstraintCost(constraints, weight)])
    slow = term.improve(paths.kernel, control, steps=3).control[0]
    rows, settings, spline = constraints.rows, paths.optimizer.settings, paths.optimizer.spline
    assert rows is not None
    fast = control.copy()
    numbers = CostSettings(
        settings.scene_margin, settings.own_margin, settings.stiffness, settings.damping, np.inf, settings.tolerance, 3
    )
    grid, buffers = path_grid(spline, settings.samples), optimization_buffers(spline.pinned, *control.shape)
    optimize_constrained_path(paths.kernel, rows, grid, spline.pinned, fast, numbers, weight, buffers)
    assert np.abs(fast - control).max() > 1e-3
    np.testing.assert_allclose(fast, slow, atol=1e-8)


def test_durations_are_lowered_within_limits_and_constraints(
    ready: PlanningSetup, constraints: ConstraintSet, paths: ConstrainedPaths, nodes: Array
) -> None:
    found = paths.shortened(paths.fit(paths.shortcut(nodes, 40, np.random.default_rng(1))))
    assert found is not None
    limits = ready.robot.limits
    optimizer = DurationOptimizer(ready.checker.kernel, limits, constraints=constraints.rows)
    with_rows = optimizer.fastest(found[1])
    for turn in range(1, 3):
        assert with_rows is not None
        if prove_motion(constraints, with_rows.trajectory(ready.robot.joint_names)):
            break
        with_rows = optimizer.cleared(with_rows, turn)
    without = DurationOptimizer(ready.checker.kernel, limits).fastest(found[1])
    assert with_rows is not None and without is not None

    def worst(motion: Trajectory) -> float:
        states = motion(np.linspace(0.0, motion.duration, 500))
        return float((constraints.violations(states) / constraints.tolerances).max())

    kept = with_rows.trajectory(ready.robot.joint_names)
    assert prove_motion(constraints, kept) and worst(kept) <= 1.0
    assert max(kept.use(limits).values()) <= 1.0 + 1e-9
    free = without.trajectory(ready.robot.joint_names)
    assert worst(free) > 5.0, "or the penalty shows nothing"
    assert free.duration <= (1.0 + 1e-4) * kept.duration  # each is a local optimum


def test_a_motion_beyond_a_constraint_is_named(ready: PlanningSetup, constraints: ConstraintSet) -> None:
    line = time_path(np.stack([ready.start, ready.goals[0]]), ready.robot.limits, ready.robot.joint_names)
    found = prove_motion(constraints, line.trajectory)
    assert not found and "of tray is violated" in found.fault
