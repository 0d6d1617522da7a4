"""Trees in compiled code: what they return is what the kernel proves, and what OMPL's RRTConnect would return."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from apex_ompl import problems
from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.discretization import sample_path
from apex_ompl.kernel import search
from apex_ompl.kernel.search import TreePair
from apex_ompl.problems.suite_robot import robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.types import Array

LONGEST, RESOLUTION = 0.7, 0.031
PIECE = 300  # iterations, no whole number of which are made at once
BLOCKED = "shelf/hard/800003"


def of_problem(name: str) -> tuple[CollisionChecker, Array, Array]:
    """The checker of a problem, its start and its goals."""
    problem = problems.load(name)
    checker = CollisionChecker(robot(), problem.scene, problem.attached)
    return checker, problem.start_state(robot().joint_names)[None], problem.goal_states(robot().joint_names)


def grown(name: str, seed: int, iterations: int = 20_000) -> tuple[CollisionChecker, TreePair, Array | None]:
    """The trees of a problem after some iterations, and their path."""
    checker, start, goals = of_problem(name)
    pair = TreePair(checker.kernel, start, goals, LONGEST, RESOLUTION, np.random.default_rng(seed))
    return checker, pair, pair.grow(iterations)


@pytest.mark.parametrize("name", [BLOCKED, "cage/hard/800001", "clutter/medium/800002"])
def test_a_path_joins_start_and_goal_by_short_steps_whose_states_are_all_proved(name: str) -> None:
    checker, start, goals = of_problem(name)
    for seed in range(3):
        _, pair, path = grown(name, seed)
        assert path is not None
        assert np.array_equal(path[0], start[0]) and (path[-1] == goals).all(axis=1).any()
        steps = np.diff(path, axis=0)
        assert np.linalg.norm(steps, axis=1).max() <= LONGEST * (1.0 + 1e-12)
        looked_at, _ = sample_path(path, RESOLUTION)
        assert (checker.kernel.unproved(looked_at[1:-1])[1] == 0).all()  # each alone, without intervals
        assert checker.are_free(looked_at).all()
        limits = robot().limits
        assert (path >= limits.lower).all() and (path <= limits.upper).all()
        again = grown(name, seed)[2]
        assert again is not None and np.array_equal(path, again)
        assert pair.size >= len(path)


def test_trees_go_on_where_they_stopped() -> None:
    """Growing in pieces gives the same path as growing at once, whatever room there is."""
    whole = grown(BLOCKED, 5)[2]
    checker, start, goals = of_problem(BLOCKED)
    rng, path, sizes = np.random.default_rng(5), None, [0]
    pair = TreePair(checker.kernel, start, goals, LONGEST, RESOLUTION, rng)
    while path is None:
        path = pair.grow(PIECE)
        sizes.append(pair.size)
    assert whole is not None and np.array_equal(path, whole)
    assert all(a < b for a, b in zip(sizes, sizes[1:], strict=False)) and len(sizes) > 3


def test_guides_show_the_way(monkeypatch: pytest.MonkeyPatch) -> None:
    """States of a path that other trees found; random states are the same however many are drawn at once."""
    name = "posts/hard/800004"
    checker, start, goals = of_problem(name)
    _, _, path = grown(name, 1, 200_000)
    assert path is not None

    def pair(seed: int) -> TreePair:
        return TreePair(checker.kernel, start, goals, LONGEST, RESOLUTION, np.random.default_rng(seed))

    guides, most = sample_path(path, 0.2)[0], 12_000
    for seed in range(3):
        alone, guided, pieces = (pair(seed) for _ in range(3))
        guided.guide(guides)
        pieces.guide(guides)
        assert alone.grow(most) is None
        whole, part = guided.grow(most), None
        while part is None:
            part = pieces.grow(PIECE)
        assert whole is not None and np.array_equal(whole, part)
    monkeypatch.setattr(search, "GUIDED", 1.0)
    monkeypatch.setattr(search, "GUIDE_SPREAD", 0.0)
    only = pair(0)
    only.guide(guides[5:7])
    states = only._random_states(200)
    assert all((states == guide).all(axis=1).sum() > 50 for guide in guides[5:7]), "and all are one of the two"
    assert np.isin(states, guides[5:7]).all()


def test_trees_that_are_full_get_more_room(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(search, "ROOM", 4)
    checker, pair, path = grown("cage/hard/800001", 0)
    assert path is not None and pair.size > 64
    assert checker.are_free(sample_path(path, RESOLUTION)[0]).all()


def test_several_starts_and_goals_are_joined_by_any_two_of_them() -> None:
    checker, start, goals = of_problem(BLOCKED)
    rng = np.random.default_rng(3)
    near = np.concatenate([goals, *(goals + 0.02 * rng.normal(size=goals.shape) for _ in range(20))])
    near = np.clip(near, robot().limits.lower, robot().limits.upper)
    near = near[checker.are_free(near)]
    pair = TreePair(checker.kernel, np.repeat(start, 2, axis=0), near, LONGEST, RESOLUTION, rng)
    path = pair.grow(20_000)
    assert path is not None and (path[-1] == near).all(axis=1).any() and np.array_equal(path[0], start[0])


def test_nothing_is_found_where_the_goal_is_walled_in_or_time_is_up() -> None:
    """Balls around both hands at the goal leave them no way out."""
    checker, start, goals = of_problem("vertical/free/1")
    palms = [robot().link_pose(goals[0], f"{side}_hand_palm")[:3, 3] for side in ("left", "right")]
    balls = [
        Obstacle(name=f"ball_{k}", sphere={"radius": 0.2}, position=tuple(p.tolist())) for k, p in enumerate(palms)
    ]
    walled = CollisionChecker(robot(), balls)
    pair = TreePair(walled.kernel, start, goals, LONGEST, RESOLUTION, np.random.default_rng(0))
    assert pair.grow(200) is None and pair.steps == pair.size - 2 + 200  # nodes, and one that fails for each state
    free = TreePair(checker.kernel, start, goals, LONGEST, RESOLUTION, np.random.default_rng(0))
    assert free.grow(10_000, lambda: True) is None and free.size == 2 and free.steps == 0
    assert free.grow(10_000) is not None


@pytest.mark.parametrize("longest", [0.0, 1e-300, 1e-17, 1e-3])
def test_the_shortest_steps_end_too_and_ask_for_the_time(longest: float) -> None:
    checker, start, goals = of_problem(BLOCKED)
    pair, asked = TreePair(checker.kernel, start, goals, longest, RESOLUTION, np.random.default_rng(0)), []
    assert pair.grow(40, lambda: bool(asked.append(pair.size))) is None
    assert len(asked) >= 20 and 2 < pair.size < 40 * 4000
    left = iter([False, False, False])
    before = pair.size
    assert pair.grow(1_000, lambda: next(left, True)) is None and before <= pair.size < before + 3 * 4000


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([0.1, 0.7, 3.0, 1e9]), st.sampled_from([0.01, 0.1, 5.0]))
def test_paths_in_the_open_are_found_whatever_the_steps(seed: int, longest: float, resolution: float) -> None:
    checker, start, goals = of_problem("vertical/free/1")
    pair = TreePair(checker.kernel, start, goals, longest, resolution, np.random.default_rng(seed))
    path = pair.grow(20_000)
    assert path is not None
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() <= longest * (1.0 + 1e-12)
