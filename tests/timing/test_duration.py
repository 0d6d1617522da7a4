"""Motions made fast or calm: optima of linear programs and least squares, bounds, proofs, and joints that stay."""

from __future__ import annotations

import numpy as np
import pytest
from planning import cached_problem
from scipy.interpolate import BSpline
from scipy.optimize import linprog

from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ParameterError
from apex_ompl.kernel.duration import DurationSettings, TimeGrid, lower_duration
from apex_ompl.ompl.setup import assemble
from apex_ompl.ompl.validity import full_check
from apex_ompl.robot import Robot
from apex_ompl.robot.rest_to_rest import direct_durations
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.timing import duration as duration_module
from apex_ompl.timing import time_path
from apex_ompl.timing.duration import LEVELS, DurationOptimizer
from apex_ompl.timing.spline_method import least_knot_spacing
from apex_ompl.timing.timed_spline import PINNED, Start, TimedSpline, basis
from apex_ompl.types import Array


@pytest.fixture(scope="module")
def free(robot: Robot) -> DurationOptimizer:
    return DurationOptimizer(CollisionChecker(robot).kernel, robot.limits)


def ends(robot: Robot) -> Array:
    """Two states between which a straight line meets nothing."""
    start, goal = robot.home.copy(), robot.home.copy()
    start[[0, 3, 7, 10]], goal[[0, 3, 7, 10]] = (0.3, -1.9, -0.2, -2.2), (-0.6, -2.4, 0.5, -2.0)
    return np.stack([start, goal])


def differences(points: int, order: int) -> Array:
    return np.diff(np.eye(points), order, axis=0)


def least_spacing(points: int, start: float, goal: float, limits: Array) -> float:
    """Least knot spacing of one joint, by bisection over linear programs in its control points."""
    rows = [differences(points, order) for order in (1, 2, 3)]
    bounds = [(start, start)] * PINNED + [(None, None)] * (points - 2 * PINNED) + [(goal, goal)] * PINNED

    def feasible(h: float) -> bool:
        matrix = np.vstack([row / (limit * h**k) for k, (row, limit) in enumerate(zip(rows, limits, strict=True), 1)])
        both, ones = np.vstack([matrix, -matrix]), np.ones(2 * len(matrix))
        return bool(linprog(np.zeros(points), both, ones, bounds=bounds).status == 0)

    low, high = 0.0, 1.0
    while high - low > 1e-6:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if feasible(middle) else (middle, high)
    return high


def test_the_fastest_free_motion_is_that_of_linear_programs(free: DurationOptimizer, robot: Robot) -> None:
    """Without obstacles the joints are independent, and each has a linear program."""
    start, goal = ends(robot)
    found = free.fastest(np.stack([start, goal]))
    assert found is not None
    limits = robot.limits
    least = [
        least_spacing(
            len(found.control), start[k], goal[k], (limits.velocity[k], limits.acceleration[k], limits.jerk[k])
        )
        for k in np.flatnonzero(start != goal)
    ]
    assert max(least) * (1.0 - 1e-4) <= found.spacing <= 1.005 * max(least)


def test_a_free_motion_is_near_the_lower_bound(free: DurationOptimizer, robot: Robot) -> None:
    states = ends(robot)
    found = free.fastest(states)
    assert found is not None
    motion, bound = found.trajectory(robot.joint_names), float(direct_durations(states[0], states[1:], robot.limits)[0])
    assert bound <= motion.duration <= bound + 1.2 / LEVELS[-1].rate
    assert max(motion.use(robot.limits).values()) <= 1.0 + 1e-9
    assert len(motion.times) <= 60.0 * motion.duration + 2.0


def test_a_calm_motion_is_the_least_squares_solution(free: DurationOptimizer, robot: Robot) -> None:
    """In three times the time no limit is reached: the squared jerk alone decides."""
    start, goal = ends(robot)
    fastest = free.fastest(np.stack([start, goal]))
    assert fastest is not None
    calm = free.calmest(fastest.lasting(3.0 * fastest.spacing))
    assert calm.spacing == pytest.approx(3.0 * fastest.spacing)
    jerk = differences(len(calm.control), PINNED)
    pinned = calm.control.copy()
    pinned[PINNED:-PINNED] = 0.0
    best = np.linalg.lstsq(jerk[:, PINNED:-PINNED], -jerk @ pinned, rcond=None)[0]
    for k in np.flatnonzero(start != goal):
        before = np.abs(fastest.control[PINNED:-PINNED, k] - best[:, k]).max()
        assert np.abs(calm.control[PINNED:-PINNED, k] - best[:, k]).max() < 0.1 * before
    cost = [float(((jerk @ control / robot.limits.jerk) ** 2).sum()) for control in (calm.control, fastest.control)]
    pinned[PINNED:-PINNED] = best
    assert float(((jerk @ pinned / robot.limits.jerk) ** 2).sum()) <= cost[0] * (1.0 + 1e-9) < 0.2 * cost[1]


@pytest.mark.parametrize("name", ["shelf/hard/800021", "cage/hard/800020", "wall/hard/800020"])
def test_motions_among_obstacles_are_faster_than_along_the_path_and_free(name: str) -> None:
    from apex_ompl import plan

    problem = cached_problem(name)
    path = plan(problem, seed=1, timeout=20.0, timing=False).path
    setup = assemble(problem)
    limits, names = setup.robot.limits, setup.robot.joint_names
    optimizer = DurationOptimizer(setup.checker.kernel, limits)
    assert path is not None
    found = optimizer.fastest(path.states)
    assert found is not None
    along = time_path(path, limits, names).trajectory
    wider = optimizer.cleared(found, 2)
    assert wider.duration >= 0.99 * found.duration
    motion = wider.trajectory(names)
    assert motion.duration < 0.97 * along.duration
    assert full_check(setup.checker, motion, setup.start, setup.goals)
    assert max(motion.use(limits).values()) <= 1.0 + 1e-9


@pytest.mark.parametrize(("turn", "middle"), [(0.2, -0.001), (0.5, -0.00325), (1.4, -0.004)])
def test_the_margin_of_a_near_end_grows_back_away_from_it(robot: Robot, turn: float, middle: float) -> None:
    """A turn 1 mm below a ceiling: least clearance over a margin of 5 mm, which is 0.5 mm at the ends."""
    start, goal = robot.home.copy(), robot.home.copy()
    start[0], goal[0] = -0.5 * turn, 0.5 * turn
    height = 0.8
    for _ in range(2):
        ceiling = Obstacle(name="ceiling", box=(4.0, 4.0, 0.1), position=(0.0, 0.0, height + 0.05))
        kernel = CollisionChecker(robot, [ceiling]).kernel
        height -= float(kernel.clearance(start)[0, 0]) - 0.001
    control = np.repeat(np.stack([start, goal]), PINNED, axis=0)
    control = np.concatenate([control[:PINNED], np.linspace(start, goal, 30)[1:-1], control[PINNED:]])
    limits = np.stack([robot.limits.velocity, robot.limits.acceleration, robot.limits.jerk])
    settings = DurationSettings(0.005, 0.02, 1e-3, 1e-5, 0.3, 0.25, 1e-3, 1.0, 0.0, 1)
    grid = TimeGrid.of(len(control), 4, basis((np.arange(4) + 0.5) / 4))
    states = np.array([w @ control[k : k + 4] for w, k in zip(grid.weights, grid.first, strict=True)])
    np.testing.assert_allclose(kernel.clearance(states)[:, 0], 0.001, atol=1e-6)
    spacing = 1.05 * least_knot_spacing(control, robot.limits)
    report = lower_duration(kernel, grid, limits, PINNED, control, spacing, settings)
    assert report.steps == 1
    assert report.clearance == pytest.approx(middle, abs=1e-4)


def test_joints_that_stay_do_so_bit_for_bit(robot: Robot) -> None:
    states, held = ends(robot), np.zeros(robot.dof, bool)
    held[7:14] = True
    states[:, held] = robot.home[held] + 0.1 / 3.0
    found = DurationOptimizer(CollisionChecker(robot).kernel, robot.limits, held).fastest(states)
    assert found is not None
    assert (found.control[:, held] == states[0, held]).all()
    assert (found.trajectory(robot.joint_names).positions[:, held] == states[0, held]).all()


def test_what_there_is_no_motion_of_and_faulty_paths(free: DurationOptimizer, robot: Robot) -> None:
    states = ends(robot)
    assert free.fastest(np.repeat(states[:1], 3, axis=0)) is None
    assert free.fastest(states, lambda: True) is None
    assert free.fastest(states, most=0.1) is None, "far slower than what it is to undercut"
    with pytest.raises(ParameterError, match="path"):
        free.fastest(states[:, :5])
    with pytest.raises(ParameterError, match="limits"):
        DurationOptimizer(free.kernel, duration_module.Limits(*(np.ones(3),) * 5))


def test_a_refitted_spline_is_nearly_the_same_motion(free: DurationOptimizer, robot: Robot) -> None:
    found = free.fastest(ends(robot))
    assert found is not None
    fine = found.refitted(3 * found.spans)
    times = np.linspace(0.0, found.duration, 500)
    values = []
    for one in (found, fine):  # by SciPy
        knots = np.arange(-PINNED, one.spans + PINNED + 1) * one.spacing
        values.append(BSpline(knots, one.control, 3)(times))
    assert np.abs(values[0] - values[1]).max() < 2e-3
    assert np.abs(values[0] - found.trajectory(robot.joint_names)(times)).max() < 1e-9
    coarse = TimedSpline.along(ends(robot), 2.0, Start.at_rest(ends(robot)[0]), ends(robot)[1], 12)
    assert coarse.spans == 14 and least_knot_spacing(coarse.control, robot.limits) > 0.0
