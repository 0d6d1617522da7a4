"""Shortcuts in compiled code: never longer, proved at the resolution, the same for the same seed."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from apex_ompl import problems
from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.discretization import sample_path
from apex_ompl.kernel.search import TreePair, shortcut
from apex_ompl.paths.path import path_length
from apex_ompl.problems.suite_robot import robot
from apex_ompl.types import Array

RESOLUTION = 0.02


@cache
def tree_path(name: str, seed: int) -> tuple[CollisionChecker, Array]:
    """A checker, and a path of trees, which is far from straight."""
    problem = problems.load(name)
    checker = CollisionChecker(robot(), problem.scene, problem.attached)
    ends = problem.start_state(robot().joint_names)[None], problem.goal_states(robot().joint_names)
    pair = TreePair(checker.kernel, *ends, 0.7, RESOLUTION, np.random.default_rng(seed))
    path = pair.grow(50_000)
    assert path is not None
    return checker, path


def longest_blocked(checker: CollisionChecker, path: Array) -> float:
    """Return the longest stretch of a path whose states collide [rad, max-norm].

    What is left of a motion in which a shortcut begins or ends was checked at other states than are sampled here, and
    where it begins the states on both sides were: an obstacle may reach in between them.
    """
    states, _ = sample_path(path, RESOLUTION)
    free = checker.are_free(states)
    assert free[0] and free[-1]
    last = np.maximum.accumulate(np.where(free, np.arange(len(states)), 0))
    return float(np.abs(states - states[np.minimum(last + 1, len(states) - 1)]).max(axis=1)[~free].max(initial=0.0))


@settings(max_examples=25, deadline=None)
@given(
    st.sampled_from(["shelf/hard/800003", "cage/hard/800001", "bins/hard/800001"]), st.integers(0, 3),
    st.integers(0, 200), st.integers(0, 10**6),
)  # fmt: skip
def test_a_path_is_no_longer_and_as_free(name: str, tree: int, draws: int, seed: int) -> None:
    checker, path = tree_path(name, tree)
    before = path.copy()
    short, looked = shortcut(checker.kernel, path, draws, RESOLUTION, np.random.default_rng(seed))
    assert np.array_equal(path, before), "the caller's array is left alone"
    assert np.array_equal(short[0], path[0]) and np.array_equal(short[-1], path[-1])
    assert path_length(short) <= path_length(path) + 1e-9 and len(short) <= len(path) + 16
    assert longest_blocked(checker, short) < 2 * RESOLUTION
    assert looked.proved > 0 and min(looked) >= 0 and looked.proved_intervals <= looked.intervals
    again, _ = shortcut(checker.kernel, path, draws, RESOLUTION, np.random.default_rng(seed))
    assert np.array_equal(short, again)


def test_paths_of_trees_get_much_shorter() -> None:
    ratios = []
    for seed in range(4):
        checker, path = tree_path("shelf/hard/800003", seed)
        short, _ = shortcut(checker.kernel, path, 100, RESOLUTION, np.random.default_rng(0))
        ratios.append(path_length(short) / path_length(path))
    assert max(ratios) < 0.9 and np.mean(ratios) < 0.7


def test_corners_in_the_open_are_left_out() -> None:
    problem = problems.load("vertical/free/1")
    checker = CollisionChecker(robot(), problem.scene)
    ends = [problem.start_state(robot().joint_names), problem.goal_states(robot().joint_names)[0]]
    rng = np.random.default_rng(0)
    middle = [ends[0] + share * (ends[1] - ends[0]) + 0.03 * rng.normal(size=robot().dof) for share in (0.2, 0.5, 0.7)]
    path = np.clip(np.array([ends[0], *middle, ends[1]]), robot().limits.lower, robot().limits.upper)
    assert checker.prove(path) and checker.prove(np.array(ends))
    short, _ = shortcut(checker.kernel, path, 0, RESOLUTION, rng)
    assert np.array_equal(short, np.array(ends))


def test_what_is_cut_so_far_is_returned_when_time_is_up() -> None:
    checker, path = tree_path("bins/hard/800001", 1)
    dense, _ = sample_path(path, 0.1)  # many corners
    lengths = []
    for times in (0, 1, 3, 10, 10_000):
        left = iter([False] * times)
        stop = lambda left=left: next(left, True)  # noqa: E731
        short, _ = shortcut(checker.kernel, dense, 50, RESOLUTION, np.random.default_rng(0), stop)
        assert np.array_equal(short[[0, -1]], dense[[0, -1]]) and longest_blocked(checker, short) < 2 * RESOLUTION
        lengths.append(path_length(short))
    whole, _ = shortcut(checker.kernel, dense, 50, RESOLUTION, np.random.default_rng(0))
    assert lengths[0] == path_length(dense) and lengths == sorted(lengths, reverse=True)
    assert lengths[-1] == path_length(whole) < lengths[1] < lengths[0]


@pytest.mark.parametrize("count", [1, 2])
def test_there_is_nothing_to_cut_in_a_state_or_a_motion(count: int) -> None:
    checker, path = tree_path("shelf/hard/800003", 0)
    short, looked = shortcut(checker.kernel, path[:count], 10, RESOLUTION, np.random.default_rng(0))
    assert np.array_equal(short, path[:count]) and looked.proved == 0
