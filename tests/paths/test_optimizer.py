from __future__ import annotations

import numpy as np
import pytest

from apex_ompl import problems
from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ParameterError
from apex_ompl.kernel import Kernel, scene_tables
from apex_ompl.ompl.setup import PlanningSetup, assemble
from apex_ompl.ompl.validity import full_check
from apex_ompl.paths.candidates import Candidate, CandidatePool, first_valid
from apex_ompl.paths.optimizer import Optimizer, OptimizerSettings
from apex_ompl.paths.path import path_length
from apex_ompl.paths.spline import Spline
from apex_ompl.robot import Robot
from apex_ompl.util.resolution import FINE_RESOLUTION


@pytest.fixture(scope="module")
def ready(robot: Robot) -> PlanningSetup:
    return assemble(problems.load("wall/easy/5"), robot)


def random_paths(ready: PlanningSetup, spline: Spline, count: int, size: float = 0.3) -> np.ndarray:
    limits, rng = ready.robot.limits, np.random.default_rng(4)
    control = spline.line(ready.start, ready.goals[0]) + rng.normal(0.0, size, (count, spline.points, ready.robot.dof))
    return spline.with_ends(np.clip(control, limits.lower + 1e-3, limits.upper - 1e-3), ready.start, ready.goals[0])


@pytest.mark.parametrize("spline", [Spline(), Spline(12, 3), Spline(9, 2, 64, 3)])
@pytest.mark.parametrize("name", ["wall/easy/5", "vertical/large/3"])
def test_the_gradient_is_that_of_finite_differences(robot: Robot, spline: Spline, name: str) -> None:
    ready = assemble(problems.load(name), robot)
    optimizer = Optimizer(spline, OptimizerSettings(samples=40, stiffness=2e-3))
    kernel = ready.checker.kernel
    for control in random_paths(ready, spline, 2):
        about, gradient = optimizer.evaluate(kernel, control)
        assert about.clearance_cost[0] > 0.01  # there is something to differentiate
        rng, step = np.random.default_rng(5), 1e-6
        for _ in range(20):
            way = np.zeros_like(control)
            way[spline.inner] = rng.normal(size=(spline.free, robot.dof))
            sides = [optimizer.evaluate(kernel, control + s * step * way)[0].cost[0] for s in (1.0, -1.0)]
            slope = float((gradient[0] * way[spline.inner]).sum())
            assert (sides[0] - sides[1]) / (2 * step) == pytest.approx(slope, rel=1e-4, abs=1e-5)


def test_the_cost_is_what_it_says(robot: Robot) -> None:
    """Without obstacles near, half the squared length of a straight line; the clearances are the kernel's."""
    spline = Spline()
    free = assemble(problems.load("vertical/free/3"), robot)
    line = spline.line(free.start, free.goals[0])
    tight = Optimizer(spline, OptimizerSettings(scene_margin=1e-6, own_margin=1e-6, stiffness=1.0))
    about, _ = tight.evaluate(free.checker.kernel, line)
    length = path_length(spline.path(line))
    assert about.cost[0] - about.clearance_cost[0] == pytest.approx(0.5 * length**2, rel=1e-6)
    wide = Optimizer(spline, OptimizerSettings(samples=50, scene_margin=5.0, own_margin=5.0))
    about, _ = wide.evaluate(free.checker.kernel, line)
    states = spline.basis((np.arange(50) + 0.5) / 50) @ line
    np.testing.assert_allclose(about.clearance[0], free.checker.kernel.clearance(states, 5.0).min(axis=0), atol=1e-9)


def test_steps_lower_the_cost_and_keep_ends_and_limits(ready: PlanningSetup) -> None:
    optimizer, limits = Optimizer(), ready.robot.limits
    kernel = ready.checker.kernel
    paths = random_paths(ready, optimizer.spline, 4)
    paths[0, 5, 0] = 40.0  # far out of its limits
    kept = paths.copy()
    costs = [optimizer.improve(kernel, paths, steps=n).cost for n in (0, 2, 6, 20)]
    assert all((after <= before).all() for before, after in zip(costs, costs[1:], strict=False))
    assert (costs[-1] < 0.5 * costs[0]).all()
    improved = optimizer.improve(kernel, paths)
    assert np.array_equal(paths, kept), "the caller's array is left alone"
    assert (improved.control >= limits.lower).all() and (improved.control <= limits.upper).all()
    states = optimizer.spline.path(improved.control)
    assert (states[:, 0] == ready.start).all() and (states[:, -1] == ready.goals[0]).all()
    again = optimizer.improve(kernel, paths)
    assert np.array_equal(improved.control, again.control)
    alone = optimizer.improve(kernel, paths[2])
    assert np.array_equal(alone.control[0], improved.control[2]), "paths of a batch do not depend on each other"


def test_a_batch_may_be_of_several_problems(robot: Robot, ready: PlanningSetup) -> None:
    other = assemble(problems.load("posts/easy/5"), robot)
    optimizer = Optimizer()
    lines = np.stack([optimizer.spline.line(r.start, r.goals[0]) for r in (ready, other)])
    both = optimizer.improve([ready.checker.kernel, other.checker.kernel], lines, steps=5)
    for k, r in enumerate((ready, other)):
        assert np.array_equal(both.control[k], optimizer.improve(r.checker.kernel, lines[k], steps=5).control[0])
    with pytest.raises(ParameterError, match="kernels"):
        optimizer.improve([ready.checker.kernel], lines)


def test_work_ends_where_it_is_enough(ready: PlanningSetup) -> None:
    optimizer = Optimizer()
    start = optimizer.starts(ready.start, ready.goals[0], 8, np.random.default_rng(0), 0.6)
    improved = optimizer.improve(ready.checker.kernel, start, enough=0.001, steps=60)
    done = improved.clearance.min(axis=1) >= 0.001
    assert done.any() and (improved.steps[done] < 60).any()
    still = optimizer.improve(ready.checker.kernel, improved.control[done], enough=0.001)
    assert (still.steps == 0).all()


def test_valid_paths_are_found_where_the_line_is_not_one(robot: Robot) -> None:
    """The full check, meshes and all, decides; what it is asked with is what comes out."""
    solved = 0
    for name in [f"{level}/{seed}" for level in ("wall/easy", "vertical/medium", "shelf/easy") for seed in (1, 2, 3)]:
        ready = assemble(problems.load(name), robot)
        optimizer, asked = Optimizer(), []

        def is_valid(path: np.ndarray, ready: PlanningSetup = ready, asked: list = asked) -> bool:
            asked.append(path)
            return bool(full_check(ready.checker, path, ready.start, ready.goals))

        starts = optimizer.starts(ready.start, ready.goals[0], 8, np.random.default_rng(1))
        found = first_valid(optimizer, ready.checker.kernel, starts, is_valid)
        if found is None:
            continue
        solved += 1
        path = optimizer.spline.path(found)
        assert np.array_equal(path, asked[-1]) and is_valid(path)
        shorter = optimizer.shorten(ready.checker.kernel, found, is_valid)
        assert shorter is not None and is_valid(optimizer.spline.path(shorter))
        assert path_length(optimizer.spline.path(shorter)) < 1.05 * path_length(path)
    assert solved >= 8


def test_valid_paths_are_taken_as_they_are(robot: Robot) -> None:
    """Spheres reach out of what they cover: a path may be valid by the meshes where they are in each other."""
    ready = assemble(problems.load("vertical/free/800005"), robot)
    optimizer, kernel = Optimizer(), ready.checker.kernel
    line = optimizer.spline.line(ready.start, ready.goals[0])
    assert full_check(ready.checker, optimizer.spline.path(line), ready.start, ready.goals)
    assert optimizer.improve(kernel, line[None], steps=0).clearance.min() < -0.01
    pool = CandidatePool(optimizer, kernel, lambda path: ready.checker.first_collision(path, FINE_RESOLUTION) is None)
    found = pool.add(line[None], "line")
    assert found is not None and np.array_equal(found.control, line) and pool.steps == 0


@pytest.mark.parametrize("alike", [True, False])
def test_repair_begins_among_what_looks_like_the_obstacles(ready: PlanningSetup, alike: bool) -> None:
    """The first rounds are among other obstacles; whatever these are, the full check decides, and repair goes on."""
    optimizer, kernel, asked = Optimizer(), ready.checker.kernel, []
    other = Kernel(kernel.robot, kernel.scene if alike else scene_tables([]))

    def rough() -> Kernel:
        asked.append(1)
        return other

    def is_valid(path: np.ndarray) -> bool:
        return bool(full_check(ready.checker, path, ready.start, ready.goals))

    pools = CandidatePool(optimizer, kernel, is_valid), CandidatePool(optimizer, kernel, is_valid, rough=rough)
    assert not asked
    starts = optimizer.starts(ready.start, ready.goals[0], 4, np.random.default_rng(1))
    found = [pool.add(starts) or pool.improve(200) for pool in pools]
    assert len(asked) == 1 and found[0] is not None and found[1] is not None
    assert is_valid(optimizer.spline.path(found[1].control))
    if alike:
        assert np.array_equal(found[0].control, found[1].control)
    else:
        assert found[1].exact and not found[0].exact


@pytest.mark.parametrize("alike", [True, False])
def test_what_is_valid_and_not_wanted_is_given_up_for_good(ready: PlanningSetup, alike: bool) -> None:
    optimizer, kernel, refused = Optimizer(), ready.checker.kernel, []
    other = Kernel(kernel.robot, kernel.scene if alike else scene_tables([]))

    def is_wanted(candidate: Candidate, path: np.ndarray) -> bool:
        refused.append((candidate, candidate.control.copy()))
        return False

    pool = CandidatePool(optimizer, kernel, lambda path: True, is_wanted, rough=lambda: other)
    starts = optimizer.starts(ready.start, ready.goals[0], 4, np.random.default_rng(1))
    assert pool.add(starts) is None and pool.improve(400) is None
    assert len(refused) == len({id(candidate) for candidate, _ in refused}) > 0
    assert all(one.given_up and np.array_equal(one.control, control) for one, control in refused)


def test_it_gives_up_when_told(ready: PlanningSetup) -> None:
    optimizer = Optimizer()
    starts = optimizer.starts(ready.start, ready.goals[0], 4, np.random.default_rng(1))
    left = iter([False] * 7)
    told = lambda: next(left, True)  # noqa: E731
    assert first_valid(optimizer, ready.checker.kernel, starts, lambda _: False, told) is None
    assert next(left, "none") == "none"
    assert optimizer.shorten(ready.checker.kernel, starts[0], lambda _: True, lambda: True) is None
    assert optimizer.shorten(ready.checker.kernel, starts[0], lambda _: False) is None


def test_witnesses_become_shorter(robot: Robot) -> None:
    """Polish of frozen validation problems: valid by the full check, and shorter than what was fitted."""
    optimizer, gains = Optimizer(), []
    for name in ("shelf/medium/800002", "swap/hard/800001", "cage/medium/800003", "bins/hard/800004"):
        ready, witness = assemble(problems.load(name), robot), problems.witness(name).path
        checker: CollisionChecker = ready.checker
        control = optimizer.spline.fit(witness, robot.limits.lower, robot.limits.upper).control
        free = lambda path, v=checker: v.first_collision(path, FINE_RESOLUTION) is None  # noqa: E731
        found = optimizer.shorten(checker.kernel, control, free)
        assert found is not None, name
        path = optimizer.spline.path(found)
        assert full_check(checker, path, ready.start, ready.goals)
        gains.append(path_length(path) / path_length(witness))
    assert max(gains) < 1.0


def test_starts_begin_with_the_line_and_stray_as_asked(ready: PlanningSetup) -> None:
    spline = Spline()
    optimizer = Optimizer(spline)
    paths = optimizer.starts(ready.start, ready.goals[0], 400, np.random.default_rng(2), 0.7)
    line = spline.path(spline.line(ready.start, ready.goals[0]))
    assert np.allclose(spline.path(paths[0]), line)
    strayed = np.abs(spline.path(paths[1:]) - line)
    assert np.sqrt((strayed**2).mean(axis=(0, 2))).max() == pytest.approx(0.7, rel=0.1)
    same = optimizer.starts(ready.start, ready.goals[0], 400, np.random.default_rng(2), 0.7)
    assert np.array_equal(paths, same)


@pytest.mark.parametrize(
    ("name", "value"),
    [("samples", 0), ("samples", 2.5), ("scene_margin", 0.0), ("own_margin", -0.1), ("stiffness", float("nan")),
     ("steps", True), ("tolerance", float("inf"))],
)  # fmt: skip
def test_settings_out_of_range_are_named(name: str, value: object) -> None:
    with pytest.raises(ParameterError, match=name):
        OptimizerSettings(**{name: value})


def test_faults_of_control_points_are_named(ready: PlanningSetup) -> None:
    optimizer, kernel = Optimizer(), ready.checker.kernel
    for wrong in (np.zeros((2, 13, 16)), np.zeros((2, 14, 15)), np.full((14, 16), np.nan)):
        with pytest.raises(ParameterError, match="control points"):
            optimizer.improve(kernel, wrong)
    with pytest.raises(ParameterError, match="count"):
        optimizer.starts(ready.start, ready.goals[0], 0, np.random.default_rng(0))
    assert len(optimizer.improve(kernel, np.zeros((0, 14, 16))).control) == 0
