"""Collision checks by several threads at once."""

from __future__ import annotations

import sys
import threading

import numpy as np
import pytest

from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ParameterError
from apex_ompl.problems import load
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import Obstacle


def test_first_questions_from_several_threads_leave_one_scene(robot: Robot) -> None:
    palm = robot.link_pose(robot.home, "left_hand_palm")[:3, 3]
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        for _ in range(5):
            checker = CollisionChecker(robot, [Obstacle(name="box", box=(0.1, 0.1, 0.1), position=(2.0, 0.0, 0.5))])
            threads = [threading.Thread(target=checker.is_free, args=(robot.home,)) for _ in range(3)]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
            checker.move("box", tuple(palm))
            assert not checker.is_free(robot.home)
    finally:
        sys.setswitchinterval(interval)


def test_batches_by_several_threads_get_the_same_answers(robot: Robot) -> None:
    problem = load("shelf/medium/800001")
    checker = CollisionChecker(robot, problem.scene, problem.attached)
    rng = np.random.default_rng(1)
    states = rng.uniform(robot.limits.lower, robot.limits.upper, (1111, robot.dof))
    kernel = checker.kernel
    assert np.array_equal(checker.are_free(states), checker.are_free(states, threads=3))
    assert np.array_equal(kernel.clearance(states, 0.2), kernel.clearance(states, 0.2, threads=3))
    for one, other in zip(kernel.clearance_gradient(states), kernel.clearance_gradient(states, threads=2), strict=True):
        assert np.array_equal(one, other)
    (pairs, counts), (others, same) = kernel.unproved(states), kernel.unproved(states, threads=2)
    assert np.array_equal(counts, same) and (counts > 0).any() and (counts == 0).any()
    for one, other, count in zip(pairs, others, counts, strict=True):
        assert np.array_equal(one[: max(count, 0)], other[: max(count, 0)])
    with pytest.raises(ParameterError, match="threads"):
        checker.are_free(states, threads=0)


def test_threads_that_ask_for_all_pairs_and_for_some_do_not_mix(robot: Robot) -> None:
    palm = robot.link_pose(robot.home, "left_hand_palm")[:3, 3]
    checker = CollisionChecker(robot, [Obstacle(name="box", box=(0.05, 0.05, 0.05), position=tuple(palm))])
    away = robot.home.copy()
    away[0], away[-1] = 1.5, 1.0 + 1e-7  # the hand is beyond its limits, so that all pairs are looked at
    assert checker.is_free(away) and not checker.is_free(robot.home)
    wrong: list[int] = []
    stop = threading.Event()

    def disturb() -> None:
        while not stop.is_set():
            checker.is_free(away)

    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    thread = threading.Thread(target=disturb)
    thread.start()
    try:
        wrong += [k for k in range(8000) if checker.is_free(robot.home)]
    finally:
        stop.set()
        thread.join()
        sys.setswitchinterval(interval)
    assert not wrong
