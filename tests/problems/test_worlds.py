"""Worlds of obstacles that move: their names and splits, what they tell, and what each kind promises."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from apex_ompl import problems
from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ApexError, ParameterError, UnknownNameError
from apex_ompl.problems import world_wanderers, worlds
from apex_ompl.problems.alignment import SIZES
from apex_ompl.problems.suite_robot import COLUMNS, robot
from apex_ompl.problems.world_robot import RobotPlaces, cube, surroundings
from apex_ompl.robot import load_robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Problem
from apex_ompl.scene.scripts import obstacle_at, place_at
from apex_ompl.timing import Timing, time_path
from tests.helpers.worlds import (
    check_consistency,
    exact,
    first_motion,
    paces,
    run,
    seeds,
    several,
    sizes,
    straight,
    suites,
)

BASES, BASE_REACH = COLUMNS[0], COLUMNS[1][0, 0]


@several
@given(st.sampled_from(worlds.GENERATED), suites, sizes, seeds, paces)
def test_scripts_say_what_was_there(kind: str, suite: str, size: str, seed: int, pace: float) -> None:
    name = f"{kind}/{suite}/{size}/{seed}"
    world, again = worlds.load(name), worlds.load(name)
    assert world.name == name and world.problem == problems.load(f"{suite}/free/{seed}")
    motion = first_motion(world, pace)
    seconds = motion.duration + 3.0
    seen = run(world, motion, seconds)
    check_consistency(world, seen)
    assert seen == run(again, motion, seconds) and world.script() == again.script()
    assert all(o.box == (SIZES[size],) * 3 for _, present in seen for o in present)
    for time, present in seen[::7]:  # as told before, up to rounding
        for now, before in zip(world.present(time), present, strict=True):
            np.testing.assert_allclose([now.position, now.velocity], [before.position, before.velocity], atol=1e-9)


def test_speeds_are_as_said_and_reached() -> None:
    for kind in ("interceptor", "turning", "crowd"):
        for seed in range(5):
            world = worlds.load(f"{kind}/vertical/small/{seed}")
            seen = run(world, first_motion(world), 1.0)
            speeds = [np.linalg.norm(o.velocity) for _, present in seen for o in present]
            assert 0.1 <= min(speeds) and max(speeds) == pytest.approx(world.fastest) and world.fastest <= 0.4


def test_frozen_problems_are_worlds() -> None:
    name = "vertical/moving-large-0.2/900003"
    problem, world = problems.load(name), worlds.load(name)
    assert world.name == name and world.problem == problem.still and world.fastest == pytest.approx(0.2, abs=1e-4)
    seen = run(world, straight("vertical/free/3", 1.0), 1.0)
    check_consistency(world, seen)
    for time, present in seen[::10]:
        assert present == tuple(obstacle_at(o, time) for o in problem.scene if o.moving)
    assert world.present(1000.0)[0].position == obstacle_at(problem.scene[0], 1000.0).position


def test_problem_files_with_scripts_are_worlds(problem: Problem, tmp_path: Path) -> None:
    script = ((0, 2, 0, 0.5), (0.5, 2, 0.2, 0.5), (0.6, 2, 0.2, 0.8))
    turns = Obstacle(name="turns", box=(0.1, 0.1, 0.1), trajectory=script, appears=0.1)
    late = Obstacle(name="late", sphere={"radius": 0.1}, position=(2, 1, 1), appears=5.0)
    made = problem.model_copy(update={"scene": (*problem.scene, turns, late)})
    made.save(tmp_path / "p.yaml")
    world = worlds.load(str(tmp_path / "p.yaml"))
    assert world.problem == problem and world.fastest == pytest.approx(3.0)
    seen = run(world, straight("vertical/free/3", 1.0), 1.0)
    check_consistency(world, seen)
    assert world.script() == (turns,) and seen[0][1] == () and len(seen[20][1]) == 1
    touching = made.model_copy(update={"allowed": (("turns", "post"),)})
    touching.save(tmp_path / "q.yaml")
    with pytest.raises(ParameterError, match="allowed.*'turns'"):
        worlds.load(str(tmp_path / "q.yaml"))


def test_names_and_splits() -> None:
    assert worlds.kinds() == ("moving", *worlds.GENERATED)
    everything: set[str] = set()
    for kind in worlds.kinds():
        for split, least in (("train", 0), ("validation", 800_000), ("test", 900_000)):
            found = worlds.ids(kind, split, 70)
            assert len(set(found)) == 70 and not everything & set(found)
            everything |= set(found)
            assert {int(name.rpartition("/")[2]) for name in found} == {
                least + k for k in range(3 if kind == "moving" else 7)
            }
            if kind == "moving":
                assert {problems.is_id(name) for name in found} == {True}
            else:
                assert all(str(worlds.WorldId.parse(name)) == name for name in found)
                assert {worlds.WorldId.parse(name).problem.split for name in found} == {split}
    assert worlds.ids("popup", "test", 0) == ()


@pytest.mark.parametrize(
    ("name", "error", "words"),
    [
        ("popop/vertical/large/12", UnknownNameError, "kind of worlds 'popop', did you mean 'popup'"),
        ("popup/vertica/large/12", UnknownNameError, "suite of worlds 'vertica'"),
        ("popup/shelf/large/12", UnknownNameError, "suite of worlds 'shelf'.*horizontal, vertical"),
        ("popup/vertical/larg/12", UnknownNameError, "size of cubes 'larg'.*did you mean 'large'"),
        ("popup/vertical/large/1000000", ParameterError, "seed"),
        ("popup/vertical/large/012", ParameterError, "a name such as popup/vertical/large/12"),
        ("popup/vertical/12", ParameterError, "a name such as popup/vertical/large/12"),
        ("popup", UnknownNameError, "world 'popup'"),
        ("vertical/moving-larg-0.2/3", UnknownNameError, "level of vertical"),
        ("nothing", UnknownNameError, "world 'nothing'.*ball_in_cup"),
        ("no/such/file.yaml", ApexError, "no/such/file.yaml"),
    ],
)  # fmt: skip
def test_unknown_worlds_are_named(name: str, error: type[ApexError], words: str) -> None:
    with pytest.raises(error, match=words):
        worlds.load(name)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [(("popop", "test", 3), "kind of worlds"), (("popup", "tests", 3), "split"), (("popup", "test", -1), "count"),
     (("popup", "test", 10**9), "count")],
)  # fmt: skip
def test_wrong_requests_for_names_are_named(arguments: tuple[str, str, int], words: str) -> None:
    with pytest.raises(ApexError, match=words):
        worlds.ids(*arguments)


@pytest.mark.parametrize("kind", worlds.GENERATED)
def test_time_does_not_go_back(kind: str) -> None:
    world = worlds.load(f"{kind}/vertical/small/1")
    motion = first_motion(world)
    world.advance(1.0, motion(0.0))
    for call in (lambda: world.advance(0.9, motion(0.0)), lambda: world.start(motion, 0.9)):
        with pytest.raises(ParameterError, match="time"):
            call()


def test_before_the_beginning_obstacles_of_constant_velocity_move_and_others_stand() -> None:
    name = "vertical/moving-large-0.2/800001"
    (cube,) = worlds.load(name).present(-0.3)
    (given,) = (o for o in problems.load(name).scene if o.moving)
    assert np.allclose(cube.position, np.subtract(given.position, np.multiply(given.velocity, 0.3)), atol=1e-12)
    for kind in ("turning", "crowd", "pusher"):
        world = worlds.load(f"{kind}/vertical/small/1")
        before, first = ([o.position for o in world.present(t)] for t in (-0.3, 0.0))
        assert np.allclose(before, first, atol=1e-12), kind


@several
@given(st.sampled_from(["turning", "crowd"]), suites, sizes, seeds)
def test_wanderers_stay_before_the_robot(kind: str, suite: str, size: str, seed: int) -> None:
    world, edge = worlds.load(f"{kind}/{suite}/{size}/{seed}"), SIZES[size]
    start = world.present(0.0)
    assert len(start) == (1 if kind == "turning" else 3)
    q = world.problem.start_state(robot().joint_names)
    for one in start:
        assert exact(world, one).obstacle_distance(q[None]) >= world_wanderers.START_CLEARANCE
    world.advance(120.0, q)
    low, high = surroundings(robot()).box(edge)
    for o in world.script():
        rows = np.array(o.trajectory)
        lengths, speeds = (
            np.diff(rows[:, 0]),
            np.linalg.norm(np.diff(rows[:, 1:], axis=0), axis=1) / np.diff(rows[:, 0]),
        )
        np.testing.assert_allclose(speeds, speeds[0], rtol=1e-6)
        assert (rows[:, 1:] >= low - 1e-9).all() and (rows[:, 1:] <= high + 1e-9).all()
        dense = np.array([place_at(o, t) for t in np.linspace(0.0, 120.0, 6000)])
        for base in BASES:
            assert np.abs(dense[:, :2] - base).max(axis=1).min() >= BASE_REACH + edge / 2 - 1e-6
        assert dense[:, 2].min() >= edge / 2
        if kind == "turning":
            assert lengths.max() <= 2.0 + 1e-9 and len(rows) > 60
        else:
            turns = rows[1:-1, 1:]
            on_wall = np.minimum(np.abs(turns - low), np.abs(turns - high)).min(axis=1) < 1e-6
            sides = [np.abs(np.abs(turns[:, :2] - base) - BASE_REACH - edge / 2).min(axis=1) < 1e-6 for base in BASES]
            assert (on_wall | sides[0] | sides[1]).all()


def test_wanderers_do_not_depend_on_when_they_are_asked() -> None:
    first, second = (worlds.load("crowd/horizontal/large/5") for _ in range(2))
    late = first.present(200.0)
    for time in np.linspace(0.0, 200.0, 300):
        now = second.present(float(time))
    assert now == late


@given(
    st.tuples(*[st.floats(-1.5, 1.5)] * 3), st.tuples(*[st.floats(-0.5, 0.5)] * 3), st.sampled_from([0.06, 0.3])
)  # fmt: skip
def test_columns_above_the_bases_are_entered_when_samples_say(place: tuple, velocity: tuple, edge: float) -> None:
    place, velocity = np.array(place), np.round(np.array(velocity), 3)
    time, axis = surroundings(robot()).entry(place, velocity, edge)
    half = BASE_REACH + edge / 2

    def depth(t: float) -> float:
        return max(half - np.abs((place + t * velocity)[:2] - base).max() for base in BASES)

    before = np.linspace(0.0, min(time, 30.0), 400)
    if time > 0.0:
        assert max(map(depth, before)) < 1e-6
    if np.isfinite(time):
        assert depth(time + 1e-6) > -1e-9
        if time > 0.0:
            sides = [abs(abs((place + time * velocity)[axis] - base[axis]) - half) for base in BASES]
            assert min(sides) < 1e-6 and velocity[axis] != 0.0


def post_problem() -> Problem:
    """A problem of another robot, without held objects: a turn of its first joint."""
    arm = load_robot("panda")
    start, goal = (dict(zip(arm.joint_names, (turn, *arm.home[1:]), strict=True)) for turn in (-1.2, 1.2))
    return Problem(name="post", robot="panda", start=start, goal={"joints": [goal]})


def test_another_robot_has_columns_that_contain_what_cannot_evade() -> None:
    arm, places = load_robot("panda"), RobotPlaces(post_problem())
    around = surroundings(arm)
    assert places.hands == ("panda_hand",) and {"panda_link0_0", "panda_link1_0"} <= set(around.staying)
    assert "panda_link4_0" not in around.staying
    middles, halves = around.columns
    for q in arm.random_state(np.random.default_rng(5), 20):
        every, evading = places.balls(q), {tuple(c) for c in places.balls(q, evading=True).centers}
        stays = np.array([tuple(c) not in evading for c in every.centers])
        beyond = np.abs(every.centers[stays, None, :2] - middles) + every.radii[stays, None, None] - halves
        assert beyond.max(axis=2).min(axis=1).max() < 0.02
        hand = places.hand(q, "panda_hand")
        assert np.linalg.norm(hand - arm.link_pose(q, "panda_hand")[:3, 3]) == 0.0


@pytest.mark.parametrize("kind", worlds.GENERATED)
def test_worlds_of_all_kinds_are_made_for_another_robot(kind: str) -> None:
    size = "small" if kind == "interceptor" else "large"  # with room for a cube
    first, again = (worlds.around(kind, post_problem(), size, 3) for _ in range(2))
    arm, problem = load_robot("panda"), post_problem()
    line = np.stack([problem.start_state(arm.joint_names), problem.goal_states(arm.joint_names)[0]])
    motion = time_path(line, arm.limits, arm.joint_names, Timing(velocity_scale=0.25)).trajectory
    assert motion is not None
    seen, same = run(first, motion, 3.0, 0.05), run(again, motion, 3.0, 0.05)
    assert seen == same and first.name == f"{kind}/post/{size}/3"
    assert any(present for _, present in seen)
    check_consistency(first, seen)
    with pytest.raises(UnknownNameError):
        worlds.around("rain", post_problem())


def test_balls_contain_the_robot_and_columns_what_cannot_evade() -> None:
    problem = problems.load("horizontal/free/3")
    places, rng = RobotPlaces(problem), np.random.default_rng(0)
    assert places.hands == ("left_hand_palm", "right_hand_palm")
    for q in robot().random_state(rng, 20):
        place, edge = rng.uniform([0.1, -0.6, 0.1], [0.8, 0.6, 0.9]), 0.1
        checker = CollisionChecker(robot(), [cube("cube", edge, place)], problem.attached)
        bound, distance = places.balls(q).clearance(place, edge), checker.obstacle_distance(q[None])
        assert bound <= distance + 1e-6 and (distance < 0.02 or bound > distance - 0.02)
        every, evading = places.balls(q), places.balls(q, evading=True)
        kept = {tuple(c) for c in evading.centers}
        stays = np.array([tuple(c) not in kept for c in every.centers])
        assert 0 < stays.sum() < len(stays)
        reach = np.abs(every.centers[stays, None, :2] - np.array(BASES)).max(axis=2).min(axis=1) + every.radii[stays]
        assert reach.max() <= BASE_REACH
