"""Problems as the model sees them, against what data sets hold of the same problems."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from apex_ompl import load_problem
from apex_ompl.apex.models import make_query
from apex_ompl.collision import CollisionChecker
from apex_ompl.model.geometry import signed_distances
from apex_ompl.model.query import ObstacleSet
from apex_ompl.ompl.setup import assemble
from apex_ompl.problems.suite_robot import robot
from apex_ompl.scene.bodies import HalfSpace, Obstacle
from apex_ompl.training.units import problem_record


def sorted_rows(obstacles: ObstacleSet) -> np.ndarray:
    """Shape, position, half sizes of boxes in the world, and so on, in an order of their own."""
    rows = np.column_stack([obstacles.shape, obstacles.position, obstacles.size, obstacles.rotation.reshape(-1, 9)])
    return rows[np.lexsort(np.round(rows[:, ::-1], 5).T)]


@pytest.mark.parametrize("name", ["shelf/hard/800000", "clutter/medium/800001", "posts/easy/800002"])
def test_queries_are_what_data_sets_hold(name: str) -> None:
    ready = assemble(load_problem(name), robot())
    query = make_query(ready.checker, ready.start, ready.goals[0])
    stored = ObstacleSet.from_rows(problem_record(ready.problem, 0).obstacles)
    assert len(query.obstacles) == len(stored) > 0
    np.testing.assert_allclose(sorted_rows(query.obstacles), sorted_rows(stored), atol=1e-5)
    assert (query.start == ready.start).all() and (query.goal == ready.goals[0]).all()
    nearest = ready.checker.distance(ready.start)
    near = [abs(_distance(stored, query.point)[k]) for k in range(len(stored))]
    assert min(near) < 1e-3 and nearest.value > 0


def _distance(obstacles: ObstacleSet, point: np.ndarray) -> np.ndarray:
    arrays = [torch.tensor(v).float() for v in (obstacles.position, obstacles.rotation, obstacles.size)]
    points = torch.tensor(point).float().expand(len(obstacles), 1, 3)
    return signed_distances(torch.tensor(obstacles.shape), *arrays, points)[:, 0].numpy()


def test_without_obstacles_nothing_is_seen() -> None:
    checker = CollisionChecker(robot())
    query = make_query(checker, robot().home, robot().home)
    assert len(query.obstacles) == 0 and query.point.tolist() == [0.0, 0.0, -1.0]


def test_half_spaces_are_seen_as_large_boxes() -> None:
    normal = np.array([0.6, 0.0, 0.8])
    plane = Obstacle(name="plane", half_space=HalfSpace(normal=tuple(normal), offset=-0.7))
    checker = CollisionChecker(robot(), [plane])
    query = make_query(checker, robot().home, robot().home)
    points = np.random.default_rng(0).uniform([-0.3, -0.8, 0.0], [1.2, 0.8, 1.2], (50, 3))
    for point in points:
        assert _distance(query.obstacles, point)[0] == pytest.approx(normal @ point + 0.7, abs=1e-4)
