"""The world of a kept planner: edits in place against checkers that are built anew."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest
from support import CUBE_OBJ, states_around_home

from apex_ompl import MotionPlanner
from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ApexError, FileFormatError, MissingFileError, SceneError, UnknownNameError
from apex_ompl.planning.world import World
from apex_ompl.robot import Robot

SHAPES = (
    {"box": (0.1, 0.15, 0.2)}, {"sphere": {"radius": 0.08}}, {"cylinder": {"radius": 0.05, "length": 0.3}},
    {"capsule": {"radius": 0.04, "length": 0.2}}, {"half_space": {"normal": (0.0, 0.0, 1.0), "offset": -0.05}},
)  # fmt: skip
BAR = {"name": "bar", "link": "left_hand_palm", "cylinder": {"radius": 0.02, "length": 0.12}}


def world_of(robot: Robot) -> tuple[World, CollisionChecker]:
    checker = CollisionChecker(robot)
    return World(checker, threading.RLock()), checker


def random_edit(world: World, rng: np.random.Generator, folder: Path) -> None:
    """Add, move, remove, attach, detach or allow something."""
    names, held = list(world.obstacles), list(world.held)
    turn = rng.normal(size=4)
    place = {
        "position": tuple(rng.uniform([0.2, -0.8, 0.05], [0.9, 0.8, 0.9])),
        "orientation": tuple(turn / np.linalg.norm(turn)),
    }
    kind = rng.integers(7)
    if kind == 0 and names:
        world.remove(str(rng.choice(names)))
    elif kind == 1 and names:
        world.move(str(rng.choice(names)), **place)
    elif kind == 2 and held:
        world.detach(str(rng.choice(held)))
    elif kind == 3 and len(held) < 2:
        side = "right" if "bar_left" in held else "left"
        world.attach({**BAR, "name": f"bar_{side}", "link": f"{side}_hand_palm", "position": (0.0, 0.02, -0.03)})
    elif kind == 4:
        mesh = {"file": str(folder / "cube.obj"), "scale": (0.1, 0.12, 0.14)}
        world.add(name=f"mesh{rng.integers(10**9)}", mesh=mesh, **place)
    elif kind == 5 and names:
        first = str(rng.choice([*held, "left_hand_palm", "right_link6"]))
        world.allow(first, str(rng.choice(names)), allowed=bool(rng.integers(3)))
    else:
        world.add(name=f"o{rng.integers(10**9)}", **SHAPES[int(rng.integers(len(SHAPES)))], **place)


@pytest.mark.parametrize("seed", range(8))
def test_after_edits_the_answers_are_those_of_a_checker_built_anew(seed: int, robot: Robot, tmp_path: Path) -> None:
    (tmp_path / "cube.obj").write_text(CUBE_OBJ)
    rng = np.random.default_rng(seed)
    world, checker = world_of(robot)
    for _ in range(3):
        for _ in range(int(rng.integers(1, 12))):
            random_edit(world, rng, tmp_path)
        anew = CollisionChecker(robot, world.obstacles.values(), world.held.values(), world.allowed)
        states = states_around_home(robot, rng, 60, 0.6)
        assert np.array_equal(checker.are_free(states), anew.are_free(states))
        for q in states[:4]:
            assert checker.clearance(q) == pytest.approx(anew.clearance(q), abs=2e-5)
            assert {(c.first, c.second) for c in checker.contacts(q)} == {(c.first, c.second) for c in anew.contacts(q)}
        path = states[:2]
        assert bool(checker.prove(path)) == bool(anew.prove(path))
        there = checker.kernel.clearance(states[:8], 0.3)
        np.testing.assert_allclose(np.asarray(there[0]), np.asarray(anew.kernel.clearance(states[:8], 0.3)[0]))


def test_an_obstacle_is_taken_and_put_down_where_it_is(robot: Robot) -> None:
    world, checker = world_of(robot)
    palm = robot.link_pose(robot.home, "left_hand_palm")
    world.add(name="can", cylinder={"radius": 0.02, "length": 0.1}, position=tuple(palm[:3, 3] + palm[:3, 2] * 0.15))
    before = world.obstacles["can"]
    world.attach("can", "left_hand_palm", at=robot.home)
    assert not world.obstacles and tuple(world.held) == ("can",)
    moved = robot.home.copy()
    moved[0] += 0.5
    world.detach("can", at=robot.home)
    np.testing.assert_allclose(world.obstacles["can"].pose, before.pose, atol=1e-12)
    world.attach("can", "left_hand_palm", at=robot.home)
    world.detach("can", at=moved)
    expected = robot.link_pose(moved, "left_hand_palm") @ np.linalg.inv(palm) @ before.pose
    np.testing.assert_allclose(world.obstacles["can"].pose, expected, atol=1e-12)
    assert checker.obstacle_names == ("can",)


def test_an_edit_that_fails_changes_nothing(robot: Robot, tmp_path: Path) -> None:
    world, _ = world_of(robot)
    world.add(name="post", box=(0.1, 0.1, 0.6), position=(0.5, 0.0, 0.3))
    palm = robot.link_pose(robot.home, "left_hand_palm")
    world.add(name="wall", box=(0.4, 0.4, 0.02), position=tuple(palm[:3, 3]))
    known = dict(world.obstacles)
    faulty: tuple[tuple[type[ApexError], str, object], ...] = (
        (SceneError, "no obstacle 'pots'", lambda: world.move("pots", (0, 0, 1))),
        (SceneError, "no obstacle 'pots'", lambda: world.remove("pots")),
        (SceneError, "no obstacle 'pots'", lambda: world.set_velocity("pots", (0, 0, 1))),
        (SceneError, "fixture of the robot.*world.allow.*'remove'", lambda: world.remove(robot.fixtures[0].name)),
        (SceneError, "fixture of the robot", lambda: world.move(robot.fixtures[0].name, (0.0, 0.0, 1.0))),
        (SceneError, "fixture of the robot", lambda: world.attach(robot.fixtures[0].name, "torso", at=robot.home)),
        (SceneError, "no held object 'post'", lambda: world.detach("post")),
        (SceneError, "'post' is taken", lambda: world.add(name="post", sphere={"radius": 0.1})),
        (FileFormatError, "boks", lambda: world.add(name="b", boks=(1, 1, 1))),
        (FileFormatError, "position", lambda: world.move("post", (0.0, float("nan"), 1.0))),
        (FileFormatError, "position", lambda: world.move("post", (0.0, 1.0))),  # type: ignore[arg-type]
        (FileFormatError, "velocity", lambda: world.set_velocity("post", (float("inf"), 0, 0))),
        (MissingFileError, "nowhere.obj", lambda: world.add(name="m", mesh={"file": str(tmp_path / "nowhere.obj")})),
        (UnknownNameError, "unknown link 'left_palm'", lambda: world.attach({**BAR, "link": "left_palm"})),
        (UnknownNameError, "unknown link", lambda: world.attach(BAR, touch_links=("thumb",))),
        (SceneError, "give the link and the state", lambda: world.attach("post")),
        (SceneError, "no obstacle 'pots'", lambda: world.attach("pots", "left_hand_palm", at=robot.home)),
        (SceneError, "'bar' would overlap.*wall", lambda: world.attach(BAR, at=robot.home)),
        (SceneError, "'post' is taken", lambda: world.attach({**BAR, "name": "post"})),
        (SceneError, "is taken", lambda: world.add(*[{"name": "new", "box": (1, 1, 1)}] * 2)),
    )  # fmt: skip
    for error, said, edit in faulty:
        with pytest.raises(error, match=said):
            edit()  # type: ignore[operator]
        assert dict(world.obstacles) == known and not world.held, said


def test_what_was_allowed_and_held_stays_where_an_edit_fails(robot: Robot) -> None:
    world, _ = world_of(robot)
    palm = robot.link_pose(robot.home, "left_hand_palm")
    world.add(name="wall", box=(0.4, 0.4, 0.02), position=tuple(palm[:3, 3]))
    world.add(name="table", box=(0.4, 0.4, 0.02), position=(0.5, 0.0, 0.3))
    world.allow("wall", "table")
    with pytest.raises(ApexError):
        world.attach("wall", "left_hand_palm", at=robot.home, touch_links=("thumb",))
    assert [set(pair) for pair in world.allowed] == [{"wall", "table"}]
    world.attach({**BAR, "position": (0.0, 0.02, -0.03)})
    for state in (robot.home[:-1], np.full(robot.dof, np.nan)):
        with pytest.raises(ApexError):
            world.detach("bar", at=state)
        assert list(world.held) == ["bar"] and "bar" not in world.obstacles


def test_views_are_read_only_and_clear_leaves_the_fixtures(robot: Robot) -> None:
    world, checker = world_of(robot)
    fixtures = {name for name in checker.meshes.scene}
    world.add({"name": "a", "box": (0.1, 0.1, 0.1)}, {"name": "b", "box": (0.1, 0.1, 0.1), "position": (1, 0, 0)})
    world.attach(BAR)
    with pytest.raises(TypeError):
        world.obstacles["c"] = world.obstacles["a"]  # type: ignore[index]
    world.clear()
    assert not world.obstacles and not world.held and set(checker.meshes.scene) == fixtures


def test_an_edit_waits_until_a_plan_has_ended() -> None:
    with MotionPlanner() as planner:
        started, done = threading.Event(), threading.Event()

        def edit() -> None:
            started.set()
            planner.world.add(name="late", box=(0.1, 0.1, 0.1), position=(0.0, 0.0, 3.0))
            done.set()

        thread = threading.Thread(target=edit)
        with planner.world.locked():
            thread.start()
            assert started.wait(10.0) and not done.wait(0.2) and not planner.world.obstacles
        assert done.wait(10.0) and tuple(planner.world.obstacles) == ("late",)
        thread.join()


def test_files_are_paths_or_content_from_memory_and_long_bodies_are_noted(robot: Robot, tmp_path: Path) -> None:
    file = tmp_path / "cube.obj"
    file.write_text(CUBE_OBJ)
    with MotionPlanner(robot) as planner:
        far = (1.5, 0.0, 1.5)
        planner.world.add(name="path", mesh={"file": file}, position=far)
        planner.world.add(name="text", mesh=str(file), position=far)
        planner.world.add(name="bytes", mesh={"file": "cube.obj", "content": file.read_bytes()}, position=far)
        free = CollisionChecker(robot, planner.world.obstacles.values())
        distances = [
            CollisionChecker(robot, [one]).obstacle_distance(robot.home[None]) for one in free.obstacles.values()
        ]
        assert distances[0] == distances[1] == distances[2] > 0.0
        planner.world.add(name="floor", box=(100.0, 100.0, 0.1), position=(0.0, 0.0, -0.5))
        result = planner.plan("home", {**dict(zip(robot.joint_names, robot.home, strict=True)), "left_joint1": 0.1})
        assert "floor is 100 m long; lengths are meters" in result.notes
        unread = {"file": "no_file.obj", "content": file.read_bytes(), "scale": (80.0, 80.0, 80.0)}
        planner.world.add(name="far", mesh=unread, position=far)
        planner.world.move("far", (0.0, 0.0, -200.0))
        assert "far is 80 m long; lengths are meters" in planner.plan("home", "home").notes
    with pytest.raises(FileFormatError, match="mesh file ending in"):
        planner.world.add(name="odd", mesh=tmp_path / "cube.txt")


def test_a_state_at_which_an_object_is_taken_may_be_a_pose_by_name(robot: Robot) -> None:
    by_name, by_numbers = (world_of(robot)[0] for _ in range(2))
    for world, at in ((by_name, "home"), (by_numbers, robot.home)):
        world.add(name="far", box=(0.1, 0.1, 0.1), position=(2.0, 0.0, 0.5))
        world.attach("far", "left_hand_palm", at=at)
    assert by_name.held == by_numbers.held
    for world, at in ((by_name, "home"), (by_numbers, robot.home)):
        world.detach("far", at=at)
    assert by_name.obstacles == by_numbers.obstacles and "far" in by_name.obstacles


def test_what_an_edit_cannot_use_is_named_and_changes_nothing(robot: Robot) -> None:
    world, _ = world_of(robot)
    world.add(name="far", box=(0.1, 0.1, 0.1), position=(2.0, 0.0, 0.5))
    before = dict(world.obstacles)
    for call, words in (
        (lambda: world.load(None), "problem: expected a Problem"),
        (lambda: world.load("ball_in_cup"), "problem: expected a Problem"),
        (lambda: world.allow("far", "left_link5", "no"), "allowed: expected True or False, got 'no'"),
        (lambda: world.attach("far", "left_hand_palm", at=[0.0, 1.0]), "at: expected a state of shape"),
        (lambda: world.attach("far", "left_hand_palm", at="hme"), "unknown pose of .* as at 'hme'"),
        (lambda: world.attach("far", links="left_hand_palm", at="home"), "links, a list of two"),
    ):
        with pytest.raises(ApexError, match=words):
            call()
        assert dict(world.obstacles) == before and not world.held and not world.allowed
