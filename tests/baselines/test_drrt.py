"""Dynamic RRT: its tree, and the planner that keeps it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ompl import base as ob
from planning import solved

from apex_ompl import plan, planners
from apex_ompl.baselines.drrt.dynamic_rrt import DynamicRRT, GoalTree
from apex_ompl.baselines.drrt.planner import DRRT
from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.discretization import sample_path
from apex_ompl.collision.path_proof import may_have_become_blocked
from apex_ompl.ompl.setup import PlanningSetup, assemble
from apex_ompl.ompl.space import to_state
from apex_ompl.paths.path import SEARCH_RESOLUTION
from apex_ompl.problems import load as load_problem
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Problem
from apex_ompl.types import Array, Flags

STEP = 0.2
EASY = "vertical/small/800001"


def along(first: Array, last: Array, count: int = 8) -> Array:
    """States along straight motions, shape (N, count, dof), without their first ones."""
    shares = np.linspace(0.0, 1.0, count + 1)[1:, None]
    return first[:, None] + shares * (last - first)[:, None]


def outside(center: Array, radius: float) -> Callable[[Array, Array], Flags]:
    """Whether motions keep out of a disc, by states along them."""

    def free(first: Array, last: Array) -> Flags:
        return np.asarray((np.linalg.norm(along(first, last) - center, axis=2) > radius).all(axis=1))

    return free


@settings(max_examples=15)
@given(seed=st.integers(0, 10_000), radius=st.floats(0.05, 0.5))
def test_a_trimmed_tree_keeps_what_is_free_and_nothing_else(seed: int, radius: float) -> None:
    rng = np.random.default_rng(seed)
    tree = GoalTree(np.array([[0.0, 0.0], [1.0, 1.0]]), STEP, 300)
    for _ in range(300):
        q = rng.uniform(-1.0, 2.0, 2)
        assert tree.nearest(q) == np.argmin(np.linalg.norm(tree.states - q, axis=1))
        tree.extend(tree.nearest(q), q, lambda first, last: np.ones(len(first), bool))
    assert len(tree) == 302 and tree.full
    states, parents = tree.states.copy(), tree.parents.copy()
    free = outside(np.array([0.7, 0.3]), radius)

    def connected(k: int) -> bool:
        while parents[k] >= 0:
            if not free(states[parents[k], None], states[k, None])[0]:
                return False
            k = int(parents[k])
        return True

    wanted = np.array([connected(k) for k in range(302)])
    assert tree.trim(free) == 302 - wanted.sum() and np.array_equal(tree.states, states[wanted])
    assert free(*tree.edges).all()
    for k in range(len(tree)):
        path = tree.path(k)
        assert np.array_equal(path[0], tree.states[k]) and tree.at(path[-1]) in (0, 1)
        assert np.abs(np.diff(path, axis=0)).max(initial=0.0) <= STEP + 1e-12


def test_a_tree_without_bound_grows_beyond_its_first_room() -> None:
    rng, tree = np.random.default_rng(0), GoalTree(np.zeros((1, 3)), 0.5)
    for _ in range(3000):
        q = rng.uniform(-1.0, 1.0, 3)
        tree.extend(tree.nearest(q), q, lambda first, last: np.ones(len(first), bool))
    assert len(tree) == 3001 and not tree.full
    assert (tree.parents[1:] < np.arange(1, 3001)).all() and np.abs(tree.states).max() <= 1.0
    assert np.abs(np.subtract(*tree.edges)).max() <= 0.5 + 1e-12


def test_without_a_last_path_it_is_rrt() -> None:
    """The same draws in RRT from the goal, written down once more (LaValle 1998), give the same path."""
    start, goal, free = np.array([-0.9, -0.9]), np.array([0.9, 0.9]), outside(np.zeros(2), 0.5)
    search, rng = DynamicRRT(STEP, 0.1, 0.6), np.random.default_rng(4)
    found = search.grow(
        search.rooted_at(goal[None]), start[None], lambda: rng.uniform(-1.0, 1.0, 2), rng=rng, free=free,
        stop=lambda: False,
    )  # fmt: skip
    rng, nodes, parents = np.random.default_rng(4), [goal], [-1]

    def step_from(k: int, target: Array) -> bool:
        way = target - nodes[k]
        new = target if np.abs(way).max() <= STEP else nodes[k] + STEP / np.abs(way).max() * way
        if free(nodes[k][None], new[None])[0]:
            nodes.append(new)
            parents.append(k)
            return True
        return False

    while not np.array_equal(nodes[-1], start):
        to_start, q = rng.random() < 0.1, rng.uniform(-1.0, 1.0, 2)
        q = start if to_start else q
        if step_from(int(np.argmin([np.linalg.norm(node - q) for node in nodes])), q):
            if 0.0 < np.abs(start - nodes[-1]).max() <= STEP:
                step_from(len(nodes) - 1, start)
    path, k = [], len(nodes) - 1
    while k >= 0:
        path, k = [*path, nodes[k]], parents[k]
    assert found is not None and np.array_equal(found, path)
    assert np.array_equal(found[0], start) and np.array_equal(found[-1], goal)


def planner_of(setup: PlanningSetup, **values: float) -> DRRT:
    planner = planners.make("drrt", setup.simple_setup.getSpaceInformation(), **{"seed": 1, "range": 0.3, **values})
    setup.simple_setup.setPlanner(planner)
    return planner


def free_by_meshes(setup: PlanningSetup, moved: Obstacle, first: Array, last: Array) -> bool:
    """Whether motions are free by exact shapes alone, in a checker made anew, at the resolution of the search."""
    problem = setup.problem
    scene = [moved if one.name == moved.name else one for one in problem.scene]
    meshes = CollisionChecker(setup.robot, scene, problem.attached, problem.allowed, proofs=False)
    states = [sample_path(np.stack(ends), SEARCH_RESOLUTION)[0] for ends in zip(first, last, strict=True)]
    return bool(meshes.are_free(np.concatenate(states)).all())


def put_in_the_way(setup: PlanningSetup, path: Array) -> Obstacle:
    """Move the cube of a problem to where a hand is along a path, and return it."""
    cube = next(one for one in setup.problem.scene if one.box is not None)
    for q in path[len(path) // 2 : 0 : -1]:
        for hand in ("left_hand_palm", "right_hand_palm"):
            place = tuple(setup.robot.link_pose(q, hand)[:3, 3].tolist())
            setup.checker.move(cube.name, place)
            if setup.checker.is_free(setup.start) and setup.checker.is_free(setup.valid_goals[0]):
                return cube.model_copy(update={"position": place})
    pytest.fail("a place that leaves start and goal free was to be found")


def test_the_tree_is_kept_where_it_is_still_free() -> None:
    setup = assemble(load_problem(EASY))
    planner = planner_of(setup)
    first = solved(setup, planner)
    tree = planner.search.tree
    assert first is not None and tree is not None and planner.removed == 0
    assert np.array_equal(first[0], setup.start) and np.array_equal(first[-1], setup.valid_goals[0])
    before, states = len(tree), {row.tobytes() for row in tree.states}
    moved = put_in_the_way(setup, first)
    assert not free_by_meshes(setup, moved, first[:-1], first[1:])
    second = solved(setup, planner)
    assert planner.search.tree is tree and 0 < planner.removed < before
    left = before - planner.removed
    assert left > tree.roots and {row.tobytes() for row in tree.states[:left]} <= states
    assert second is not None and np.array_equal(second[0], setup.start) and not np.array_equal(first, second)
    assert free_by_meshes(setup, moved, *tree.edges)
    assert free_by_meshes(setup, moved, second[:-1], second[1:])
    planner.clear()
    assert planner.search.tree is None and planner.search.waypoints is None


def test_nodes_that_the_tree_has_already_are_no_new_search() -> None:
    """The robot is on its way along the path: what is kept holds the rest of it."""
    setup = assemble(load_problem(EASY))
    planner = planner_of(setup)
    first = solved(setup, planner)
    assert first is not None and planner.search.tree is not None
    size = len(planner.search.tree)
    pdef = setup.simple_setup.getProblemDefinition()
    pdef.clearStartStates()
    pdef.addStartState(to_state(setup.simple_setup.getSpaceInformation(), first[1]))
    planner.clearQuery()
    assert (
        np.array_equal(solved(setup, planner), first[1:]) and len(planner.search.tree) == size and planner.removed == 0
    )


def test_what_is_proved_clear_of_a_change_is_free(robot: Robot, post: Obstacle) -> None:
    """Of random motions, those that a moved post blocks by exact shapes are all among the suspects; many are not."""
    rng, checker = np.random.default_rng(0), CollisionChecker(robot, [post])
    first = np.clip(robot.home + rng.normal(0.0, 0.5, (60, robot.dof)), robot.limits.lower, robot.limits.upper)
    last = np.clip(first + rng.uniform(-0.3, 0.3, first.shape), robot.limits.lower, robot.limits.upper)
    before = checker.kernel
    assert not may_have_become_blocked(before, checker.kernel, first, last).any()
    moved = post.model_copy(update={"position": (0.55, 0.25, 0.5)})
    checker.move(post.name, moved.position)
    suspect = may_have_become_blocked(before, checker.kernel, first, last)
    alone = CollisionChecker(robot, [moved], proofs=False)
    alone_without = CollisionChecker(robot, [], proofs=False)
    states = along(first, last, 20)
    blocked = [not alone.are_free(s).all() and bool(alone_without.are_free(s).all()) for s in states]
    assert (suspect | ~np.array(blocked)).all() and 0 < sum(blocked) and suspect.sum() < 60


@pytest.mark.parametrize("name", ["vertical/free/800000", EASY])
def test_it_solves_what_is_easy(name: str) -> None:
    found = plan(name, "drrt", timeout=20.0, seed=1)
    again = plan(name, "drrt", timeout=20.0, seed=1)
    assert found and found.solved_by == "drrt" and np.array_equal(found.path, again.path)


def test_it_stops_with_its_condition(problem: Problem) -> None:
    setup = assemble(problem)
    planner = planner_of(setup)
    calls = 0

    def soon() -> bool:
        nonlocal calls
        calls += 1
        return calls > 20

    setup.simple_setup.getSpaceInformation().setup()
    planner.setProblemDefinition(setup.simple_setup.getProblemDefinition())
    status = planner.solve(ob.PlannerTerminationCondition(soon))
    assert status.getStatus() == ob.PlannerStatus.TIMEOUT and "nodes in the time given" in planner.report.reason
    assert planner.search.tree is not None and len(planner.search.tree) <= 22
