"""Cubes that answer to the robot: what each kind of them promises."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given

from apex_ompl.errors import ParameterError
from apex_ompl.problems import worlds
from apex_ompl.problems.alignment import SIZES
from apex_ompl.problems.suite_robot import robot
from apex_ompl.problems.world_ambushes import moment_of
from apex_ompl.problems.world_robot import RobotPlaces, cube
from apex_ompl.scene.scripts import place_at
from apex_ompl.timing import Trajectory
from tests.helpers.worlds import (
    BEGIN,
    STEP,
    check_consistency,
    exact,
    first_motion,
    paces,
    run,
    seeds,
    several,
    sizes,
    state,
    suites,
)


@pytest.mark.parametrize("kind", ["popup", "imposed", "interceptor", "pusher"])
def test_what_is_not_decided_is_not_told(kind: str) -> None:
    world = worlds.load(f"{kind}/vertical/small/1")
    world.advance(0.1, first_motion(world)(0.0))
    world.present(0.1)
    with pytest.raises(ParameterError, match="time"):
        world.present(0.2)


@several
@given(suites, sizes, seeds, paces)
def test_popups_appear_before_a_hand_and_clear_of_the_robot(suite: str, size: str, seed: int, pace: float) -> None:
    world = worlds.load(f"popup/{suite}/{size}/{seed}")
    motion = first_motion(world, pace)
    seen = run(world, motion, motion.duration + BEGIN)
    if not world.script():
        return
    appears, (made,) = next((time, present) for time, present in seen if present)
    share = [moment_of(motion, s) + BEGIN for s in (0.2, 0.7)]
    assert share[0] <= appears <= share[1] + STEP
    q = state(motion, appears)
    # The straight line may be in collision by itself, and is not by the cube.
    assert exact(world, made).is_free(q) == exact(world).is_free(q)
    assert exact(world, made).obstacle_distance(q[None]) >= 0.04
    links = [held.link for held in world.problem.attached]
    fronts = []
    for link in links:
        now, before = (robot().link_pose(state(motion, t), link)[:3, 3] for t in (appears, appears - 2 * STEP))
        ahead = np.dot(np.subtract(made.position, now), now - before) > 0.0
        fronts.append(np.linalg.norm(np.subtract(made.position, now)) - SIZES[size] / 2 if ahead else np.inf)
    # A cube on the tables is lifted, and hands go on between two steps; the other hand may be nearer.
    assert any(0.15 < front < 0.7 for front in fronts)
    if not any(made.velocity or ()):
        assert exact(world, made).obstacle_distance(motion.positions[-1:]) >= 0.03


def test_most_popups_are_in_the_way() -> None:
    met = []
    for name in worlds.ids("popup", "train", 10):
        world = worlds.load(name)
        motion = first_motion(world)
        seen = run(world, motion, motion.duration + BEGIN, 0.05)
        met.append(any(present and not exact(world, *present).is_free(state(motion, t)) for t, present in seen))
    assert np.mean(met) > 0.6


def test_popups_wait_until_there_is_room() -> None:
    world = worlds.load("popup/vertical/medium/3")
    motion = first_motion(world)
    run(world, motion, motion.duration)
    (made,) = world.script()
    again, place = worlds.load("popup/vertical/medium/3"), made.position
    again.start(motion, BEGIN)
    away = robot().home
    places = RobotPlaces(again.problem)
    inside = next(
        q for q in robot().random_state(np.random.default_rng(0), 4000)
        if places.balls(q).clearance(np.array(place), SIZES["medium"]) < 0.0
    )  # fmt: skip
    again.advance(made.appears + 0.1, inside)
    assert again.script() == ()
    again.advance(made.appears + 0.2, away)
    assert again.script()[0].appears == made.appears + 0.2


@several
@given(suites, sizes, seeds, paces)
def test_interceptors_meet_the_motion_that_is_followed(suite: str, size: str, seed: int, pace: float) -> None:
    world = worlds.load(f"interceptor/{suite}/{size}/{seed}")
    motion = first_motion(world, pace)
    seen = run(world, motion, BEGIN + 1.7)
    if not world.script():
        return
    assert all(bool(present) == (time >= BEGIN) for time, present in seen)
    begin = world.present(BEGIN)[0]
    checker, touch = exact(world, begin), []
    assert checker.obstacle_distance(motion.positions[:1]) >= 0.04
    for time, present in seen[int(BEGIN / STEP) + 1 :: 2]:
        checker.move("cube_0", present[0].position)
        touch += [] if checker.is_free(state(motion, time)) else [time]
    assert touch and touch[0] <= BEGIN + 1.5


@several
@given(suites, sizes, seeds)
def test_imposed_cubes_come_into_the_way_in_time_and_stand(suite: str, size: str, seed: int) -> None:
    world = worlds.load(f"imposed/{suite}/{size}/{seed}")
    motion = first_motion(world)
    end = BEGIN + motion.duration
    seen = run(world, motion, end + 9.0)
    check_consistency(world, seen)
    if not world.script():
        return
    (made,) = world.script()
    assert made.trajectory is not None
    (_, *outside), (begins, *first), (stands, *there) = made.trajectory[:3]
    assert outside == first and made.appears == begins and BEGIN < made.appears < stands <= made.appears + 1.0
    assert 0.1 <= np.linalg.norm(np.subtract(there, first)) / (stands - made.appears) <= 0.4
    assert first[2] == there[2]
    checker, touched = exact(world, cube("cube_0", SIZES[size], np.array(there))), []
    for goal in world.problem.goal_states(robot().joint_names):
        assert checker.obstacle_distance(goal[None]) >= 0.03 - 1e-6
    for time, present in seen[::2]:
        if present and time <= end:
            checker.move("cube_0", present[0].position)
            touched += [] if checker.obstacle_distance(state(motion, time)[None]) > 0.0 else [time]
    assert touched and touched[0] >= made.appears + 0.5 - STEP
    for time in np.linspace(begins, stands, 20):
        checker.move("cube_0", place_at(made, time))
        assert checker.obstacle_distance(state(motion, begins)[None]) >= 0.12 - 1e-6
    if len(made.trajectory) > 3:
        (again, *here), (rests, *last) = made.trajectory[3:]
        assert stands + 2.0 <= again <= stands + 5.0 + STEP and np.allclose(here, there)
        assert 0.2 <= np.linalg.norm(np.subtract(last, here)) <= 0.5 + 1e-9
        for time in np.linspace(again, rests, 20):
            checker.move("cube_0", place_at(made, time))
            assert checker.obstacle_distance(state(motion, again)[None]) >= 0.12 - 1e-6


def test_most_imposed_cubes_are_there_before_slow_motions_and_half_are_moved_again() -> None:
    there, again = [], []
    for name in worlds.ids("imposed", "train", 30):
        if name.split("/")[2] in ("small", "medium", "large"):
            world = worlds.load(name)
            motion = first_motion(world)
            run(world, motion, BEGIN + motion.duration)
            for time in (100.0, 110.0):
                world.advance(time, motion.positions[0])
            there.append(len(world.script()))
            again += [len(one.trajectory or ()) == 5 for one in world.script()]
    assert np.mean(there) > 0.8 and 0.2 < np.mean(again) < 0.8


def test_imposed_cubes_do_not_come_where_the_robot_is_in_their_way() -> None:
    world = worlds.load("imposed/horizontal/small/1")
    motion = first_motion(world)
    run(world, motion, BEGIN + motion.duration)
    (made,) = world.script()
    assert made.trajectory is not None and made.appears is not None
    there, again = made.trajectory[2], worlds.load(world.name)
    checker = exact(world, cube("cube_0", SIZES["small"], np.array(there[1:])))
    again.start(motion, BEGIN)
    again.advance(made.appears - STEP, motion.positions[0])
    blocked = [q for q in motion(np.linspace(0.0, motion.duration, 100)) if checker.obstacle_distance(q[None]) < 0.1]
    for time in (made.appears, made.appears + 10.0):
        again.advance(time, blocked[0])
    assert not again.script()


def test_few_interceptors_find_no_way() -> None:
    made = []
    for name in worlds.ids("interceptor", "train", 40):
        world = worlds.load(name)
        world.start(first_motion(world), 0.0)
        made.append(len(world.present(0.0)))
    assert np.mean(made) > 0.8


@several
@given(suites, sizes, seeds)
def test_pushers_come_and_leave(suite: str, size: str, seed: int) -> None:
    world, edge = worlds.load(f"pusher/{suite}/{size}/{seed}"), SIZES[size]
    q = world.problem.start_state(robot().joint_names)
    rest = Trajectory(np.zeros(1), q[None], np.zeros((1, 16)), np.zeros((1, 16)), robot().joint_names)
    seen = run(world, rest, 9.0)
    check_consistency(world, seen)
    places = np.array([present[0].position for _, present in seen])
    times = np.array([time for time, _ in seen])
    balls = RobotPlaces(world.problem).balls(q)
    gaps = np.array([balls.clearance(place, edge) for place in places])
    assert 0.25 <= gaps[0] < 0.45 and exact(world, *seen[0][1]).is_free(q)
    moves = np.linalg.norm(np.diff(places, axis=0), axis=1) > 1e-9
    out = times[np.argmax(moves)]
    assert moves.any() and BEGIN <= out <= BEGIN + 1.0 + 0.02
    coming = (times >= out) & (times <= out + 1.0)
    assert gaps[coming][-1] < gaps[0] - 0.05 and (np.diff(gaps[coming]) < 1e-3).all()
    farthest = np.argmax(np.linalg.norm(places - places[0], axis=1))
    assert times[farthest] <= out + 3.0 + 0.03
    np.testing.assert_allclose(places[-1], places[0], atol=1e-9)
    script = np.array(world.script()[0].trajectory)
    back = script[:, 0] > out + 3.0 + STEP
    assert (np.diff(script[~back, 0]) >= 0.1 - 1e-6)[1:-1].all()
    again = np.array([place_at(world.script()[0], 2 * (out + 3.0) - t) for t in times[coming]])
    assert np.linalg.norm(again - places[coming], axis=1).max() < 0.15 * 4 * STEP  # the way back is the way it came


def test_pushers_answer_to_the_robot() -> None:
    here, there = (worlds.load("pusher/vertical/small/4") for _ in range(2))
    motion = first_motion(here, 1.0)
    still = Trajectory(np.zeros(1), motion.positions[:1], np.zeros((1, 16)), np.zeros((1, 16)), robot().joint_names)
    first, second = run(here, motion, 4.0), run(there, still, 4.0)
    assert first[0] == second[0] and first[-1] != second[-1]
