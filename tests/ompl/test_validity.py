from __future__ import annotations

import gc
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ompl import base as ob
from ompl import geometric as og
from support import states_around_home

from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.discretization import bit_reversed, sample_path, states_between
from apex_ompl.errors import ParameterError
from apex_ompl.ompl.setup import assemble
from apex_ompl.ompl.space import array_to_path, path_to_array, state_space, to_array, to_state
from apex_ompl.ompl.validity import MotionCheck, StateValidityChecker, full_check
from apex_ompl.paths.path import path_length
from apex_ompl.robot import Robot
from apex_ompl.scene.problem import Problem


@pytest.mark.parametrize("n", [0, 1, 2, 3, 5, 8, 13, 100, 257])
def test_bit_reversed_is_a_spread_out_permutation(n: int) -> None:
    order = bit_reversed(n)
    assert sorted(order) == list(range(n))
    if n >= 100:
        for prefix in (4, 8, 16, 32):
            gaps = np.diff(np.sort(np.concatenate([[0, n - 1], order[:prefix]])))
            assert gaps.max() <= 2.1 * n / prefix
    assert list(bit_reversed(8)) == [0, 4, 2, 6, 1, 5, 3, 7]


motions = st.lists(st.floats(-2, 2), min_size=3, max_size=3).map(np.array)


@settings(max_examples=100)
@given(motions, motions, st.floats(0.01, 0.5))
def test_states_between_are_even_and_close(a: np.ndarray, b: np.ndarray, resolution: float) -> None:
    all_states = np.concatenate([a[None], states_between(a, b, resolution), b[None]])
    steps = np.diff(all_states, axis=0)
    assert np.abs(steps).max(initial=0.0) <= resolution + 1e-12
    np.testing.assert_allclose(steps, np.broadcast_to((b - a) / len(steps), steps.shape), atol=1e-12)
    if len(steps) > 1:  # not finer than asked for
        assert np.abs(b - a).max() / (len(steps) - 1) > resolution * (1.0 - 1e-9)


def test_sampling_a_path_keeps_its_states_bit_for_bit() -> None:
    rng = np.random.default_rng(0)
    path = rng.normal(size=(6, 4))
    path[3] = path[2]  # a state given twice
    states, segments = sample_path(path, 0.05)
    assert len(states) == len(segments)
    for k, q in enumerate(path):
        assert any(np.array_equal(q, s) for s in states), k
    assert np.abs(np.diff(states, axis=0)).max() <= 0.05 + 1e-12
    for s, k in zip(states[1:], segments[1:], strict=True):
        a, b = path[k], path[k + 1]
        assert np.all(s >= np.minimum(a, b) - 1e-12) and np.all(s <= np.maximum(a, b) + 1e-12)


def test_space_has_the_limits_names_and_euclidean_metric(robot: Robot, baxter: Robot) -> None:
    rng = np.random.default_rng(1)
    for some in (robot, baxter):
        space = state_space(some)
        si = ob.SpaceInformation(space)
        assert space.getDimension() == some.dof
        assert [space.getDimensionName(k) for k in range(some.dof)] == list(some.joint_names)
        a, b = some.random_state(rng, 2)
        assert space.distance(to_state(si, a), to_state(si, b)) == pytest.approx(np.linalg.norm(a - b))
        assert np.array_equal(to_array(to_state(si, a), some.dof), a)
        space.setup()
        assert space.getLongestValidSegmentLength() == pytest.approx(0.031)
        low = to_state(si, some.limits.lower - 1e-3)
        assert not space.satisfiesBounds(low)


def test_paths_go_to_ompl_and_back_bit_for_bit(problem: Problem) -> None:
    ready = assemble(problem)
    states = ready.robot.random_state(np.random.default_rng(2), 5)
    path = array_to_path(ready.simple_setup.getSpaceInformation(), states)
    assert np.array_equal(path_to_array(path, ready.robot.dof), states)
    assert path.length() == pytest.approx(path_length(states))


def test_ompl_checks_as_the_checker_does(problem: Problem) -> None:
    ready = assemble(problem)
    si = ready.simple_setup.getSpaceInformation()
    rng = np.random.default_rng(3)
    states = states_around_home(ready.robot, rng, 60, 0.6)
    states[1::2] = states[::2] + rng.normal(0.0, 0.1, states[::2].shape)
    states = np.clip(states, ready.robot.limits.lower, ready.robot.limits.upper)
    ompl_states = [to_state(si, q) for q in states]
    free = [ready.checker.is_free(q) for q in states]
    assert [si.isValid(s) for s in ompl_states] == free and 0.1 < np.mean(free) < 0.95
    good = [k for k, f in enumerate(free) if f]
    seen = set()
    for i, j in zip(good, good[1:], strict=False):
        dense = np.concatenate([states_between(states[i], states[j], 0.031), states[j : j + 1]])
        expected = all(ready.checker.is_free(q) for q in dense)
        assert si.checkMotion(ompl_states[i], ompl_states[j]) == expected
        seen.add(expected)
    assert seen == {True, False}
    clear = ready.validity_checker.clearance(ompl_states[good[0]])
    assert clear == pytest.approx(ready.checker.clearance(states[good[0]]))


def test_a_faulty_checker_never_raises_inside_ompl(problem: Problem, monkeypatch: pytest.MonkeyPatch) -> None:
    ready = assemble(problem)
    si = ready.simple_setup.getSpaceInformation()
    state = to_state(si, ready.start)

    def broken(*_: object, **__: object) -> bool:
        raise RuntimeError("broken on purpose")

    monkeypatch.setattr(ready.checker, "is_free", broken)
    monkeypatch.setattr(ready.checker, "first_collision", broken)
    users = sys.getrefcount(state)
    assert not si.isValid(state)
    assert not si.checkMotion(state, state)
    assert sys.getrefcount(state) == users, "a fault keeps a state of OMPL"
    assert "broken on purpose" in str(ready.validity_checker.fault) and "broken on purpose" in str(
        ready.motion_validator.fault
    )


def test_checkers_live_as_long_as_the_setup_that_uses_them(problem: Problem) -> None:
    simple_setup = assemble(problem).simple_setup
    gc.collect()
    simple_setup.setPlanner(og.RRTConnect(simple_setup.getSpaceInformation()))
    assert simple_setup.solve(10.0).getStatus() == ob.PlannerStatus.EXACT_SOLUTION
    gc.collect()
    assert simple_setup.getSolutionPath().check()


def test_full_check_accepts_a_free_path_and_names_each_fault(robot: Robot, checker: CollisionChecker) -> None:
    home = robot.home
    near = home.copy()
    near[0] += 0.2
    path = np.array([home, near])
    good = full_check(checker, path, home, [near])
    assert (
        good
        and good.reason == ""
        and good.segment is None
        and good.proof is not None
        and good.proof.clearance_bound > 0.0
    )
    assert "start" in full_check(checker, path, near).reason
    assert "goal" in full_check(checker, path, home, [home]).reason
    wild = near.copy()
    wild[3] = 0.0
    assert "state 2: left_joint4 = 0" in full_check(checker, np.array([home, near, wild])).reason
    wild[3] = np.nan
    assert not full_check(checker, np.array([home, near, wild]))
    sweep = home.copy()
    sweep[[0, 1, 3]] = -1.2, 0.5, -1.4
    bad = full_check(checker, np.array([near, home, sweep]))
    assert not bad and bad.segment == 1 and "post" in bad.reason and "mm deep" in bad.reason
    for shape in [(0, 16), (16,), (3, 15)]:
        with pytest.raises(ParameterError, match=r"path: expected an array of shape \(N, 16\)"):
            full_check(checker, np.zeros(shape))


def test_full_check_sees_what_the_search_resolution_steps_over(robot: Robot) -> None:
    """A speck that a finger passes within one coarse step: free at both ends, colliding between."""
    from apex_ompl.scene.bodies import Obstacle

    a = robot.home.copy()
    a[[0, 1, 3]] = 0.1, 0.4, -1.6  # stretched forward
    b = a.copy()
    b[0] += 0.03  # less than the search resolution
    tips = [robot.link_pose(q, "left_hand_middle_distal")[:3, 3] for q in (a, b)]
    middle = (tips[0] + tips[1]) / 2
    speck = Obstacle(name="speck", sphere={"radius": 0.0005}, position=tuple(middle))
    checker = CollisionChecker(robot, [speck])
    assert checker.is_free(a) and checker.is_free(b)
    assert MotionCheck(checker, 0.031)(a, b)
    assert not full_check(checker, np.array([a, b]))


def test_clearance_callback_survives_a_fault(problem: Problem, monkeypatch: pytest.MonkeyPatch) -> None:
    ready = assemble(problem)
    monkeypatch.setattr(CollisionChecker, "clearance", lambda *_: 1 / 0)
    validity_checker: StateValidityChecker = ready.validity_checker
    state = to_state(ready.simple_setup.getSpaceInformation(), ready.start)
    users = sys.getrefcount(state)
    assert validity_checker.clearance(state) == 0.0
    assert sys.getrefcount(state) == users, "a fault keeps a state of OMPL"
    assert isinstance(validity_checker.fault, ZeroDivisionError)
