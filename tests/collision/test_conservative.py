"""The two stages of the checker against the meshes alone, and proofs of motions against dense samples."""

from __future__ import annotations

import threading
from pathlib import Path

import coal
import numpy as np
import pytest
from support import STEP, states_around_home

from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.discretization import sample_path
from apex_ompl.errors import ParameterError
from apex_ompl.kernel.compiled.check.separation import COLLIDES
from apex_ompl.ompl.validity import full_check
from apex_ompl.paths.path import FINE_RESOLUTION
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject, MeshFile, Obstacle


def clutter(rng: np.random.Generator, mesh: Path) -> list[Obstacle]:
    """One obstacle of each kind and a few boxes, in front of the arms."""

    def place() -> dict[str, tuple[float, ...]]:
        turn = rng.normal(size=4)
        where = rng.uniform([0.25, -0.8, 0.1], [0.9, 0.8, 0.9])
        return {"position": tuple(where), "orientation": tuple(turn / np.linalg.norm(turn))}

    mesh.write_text(STEP)
    return [
        Obstacle(name="ball", sphere={"radius": 0.06}, **place()),
        Obstacle(name="bar", cylinder={"radius": 0.04, "length": 0.5}, **place()),
        Obstacle(name="pill", capsule={"radius": 0.05, "length": 0.3}, **place()),
        Obstacle(name="step", mesh=MeshFile(file=str(mesh)), **place()),
        Obstacle(name="ceiling", half_space={"normal": (0.1, 0.0, -1.0), "offset": -1.2}),
        *(Obstacle(name=f"box{k}", box=tuple(rng.uniform(0.04, 0.25, 3)), **place()) for k in range(3)),
    ]


def held(robot: Robot) -> list[AttachedObject]:
    palms = [hand.palm for hand in robot.hands.values()]
    return [
        AttachedObject(name="cup", link=palms[0], cylinder={"radius": 0.035, "length": 0.12}, position=(0, 0, 0.1)),
        AttachedObject(name="block", link=palms[1], box=(0.05, 0.08, 0.2), position=(0, 0, 0.12)),
    ]


def checkers(
    robot: Robot, scene: list[Obstacle], hands: list[AttachedObject]
) -> tuple[CollisionChecker, CollisionChecker]:
    return CollisionChecker(robot, scene, hands), CollisionChecker(robot, scene, hands, proofs=False)


def towards_contact(meshes: CollisionChecker, states: np.ndarray, steps: int = 9) -> np.ndarray:
    """States on both sides of the border of collision."""
    free = meshes.are_free(states)
    found = []
    for a, b in zip(states[free], states[~free], strict=False):
        low, high = a, b
        for _ in range(steps):
            middle = (low + high) / 2
            low, high = (middle, high) if meshes.is_free(middle) else (low, middle)
        found += [low, high]
    return np.array(found)


@pytest.mark.parametrize("holding", [False, True])
@pytest.mark.parametrize("which", ["robot", "baxter"])
def test_both_stages_agree_with_the_meshes(
    which: str, holding: bool, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    robot: Robot = request.getfixturevalue(which)
    rng = np.random.default_rng(5)
    both, meshes = checkers(robot, clutter(rng, tmp_path / "step.obj"), held(robot) if holding else [])
    wide = states_around_home(robot, rng, 200, 0.6)
    states = np.concatenate([wide, robot.random_state(rng, 75), towards_contact(meshes, wide[:100])])
    expected = meshes.are_free(states)
    assert np.array_equal(both.are_free(states), expected)
    counts = both.kernel.unproved(states)[1]
    assert not expected[counts == COLLIDES].any()
    assert (counts == COLLIDES).sum() > 0.5 * (~meshes.are_free(wide)).sum()
    proved = both.kernel.unproved(states)[1] == 0
    assert not (proved & ~expected).any()
    assert 0.3 < expected.mean() < 0.9 and proved.sum() > 0.5 * expected.sum()
    assert both.check_counts.proved == proved.sum() and both.check_counts.states == len(states)


def test_an_obstacle_inside_a_link_is_never_proved_free(robot: Robot) -> None:
    rng = np.random.default_rng(8)
    inside = 0
    for k, item in enumerate(robot.geometry.geometryObjects):
        if item.parentJoint == 0 or item.geometry.getObjectType() != coal.OT_BVH:
            continue
        q = states_around_home(robot, rng, 1)[0]
        link = robot.model.frames[item.parentFrame].name
        at = robot.link_pose(q, link)
        middle = at[:3, :3] @ np.array(item.geometry.vertices()).mean(axis=0) + at[:3, 3]
        seed = Obstacle(name="seed", box=(0.02, 0.02, 0.02), position=tuple(middle))
        both, meshes = checkers(robot, [seed], [])
        assert both.kernel.unproved(q)[1][0] != 0, k
        assert both.is_free(q) == meshes.is_free(q)
        inside += not meshes.is_free(q)
    assert inside >= 14


def test_moved_added_and_removed_obstacles_are_followed(robot: Robot) -> None:
    rng = np.random.default_rng(3)
    states = states_around_home(robot, rng, 60)
    scene = [Obstacle(name="a", box=(0.3, 0.3, 0.3), position=(0.5, 0.3, 0.4))]
    both, meshes = checkers(robot, scene, [])
    seen = []
    for change in (
        lambda v: None,
        lambda v: v.move("a", (0.5, -0.3, 0.5)),
        lambda v: v.add(Obstacle(name="b", sphere={"radius": 0.15}, position=(0.45, 0.4, 0.5))),
        lambda v: v.remove("a"),
        lambda v: v.attach(AttachedObject(name="c", link="left_hand_palm", box=(0.3, 0.1, 0.1), position=(0, 0, 0.2))),
        lambda v: v.detach("c"),
    ):
        change(both)
        change(meshes)
        seen.append(meshes.are_free(states))
        assert np.array_equal(both.are_free(states), seen[-1])
    assert len({tuple(s) for s in seen}) >= 4


@pytest.mark.parametrize("which", ["robot", "baxter"])
def test_motions_and_paths_are_sampled_alike(which: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    robot: Robot = request.getfixturevalue(which)
    rng = np.random.default_rng(11)
    both, meshes = checkers(robot, clutter(rng, tmp_path / "step.obj"), held(robot))
    states = states_around_home(robot, rng, 40, 0.5)
    states = states[meshes.are_free(states)]
    outcomes = []
    for a, b, c in zip(states, states[1:], states[2:], strict=False):
        path = np.stack([a, (a + b) / 2, b, b, (b + c) / 2])
        hit, expected = (v.first_collision(path, 0.031) for v in (both, meshes))
        assert (hit is None) == (expected is None)
        outcomes.append(hit is None)
        if hit is not None:
            assert not meshes.is_free(hit.state)
            dense, segments = sample_path(path, 0.031)
            at = np.flatnonzero((dense == hit.state).all(axis=1))
            assert len(at) and hit.segment in segments[at]
    assert 3 < sum(outcomes) < len(outcomes) - 3
    assert both.check_counts.proved_steps > 0.3 * both.check_counts.steps


def test_proved_motions_hold_at_a_hundred_times_the_density(robot: Robot, tmp_path: Path) -> None:
    rng = np.random.default_rng(21)
    both, meshes = checkers(robot, clutter(rng, tmp_path / "step.obj"), held(robot))
    wide = states_around_home(robot, rng, 100, 0.5)
    edge = towards_contact(meshes, wide, steps=5)[::2]  # free, and near to a contact
    sampled = 0
    for a in edge[:12]:
        b = np.clip(a + rng.normal(0.0, 0.02, robot.dof), robot.limits.lower, robot.limits.upper)
        path = np.stack([a, b])
        before = both.check_counts.meshes
        if both.first_collision(path, 0.031) is None and both.check_counts.meshes == before:
            dense = sample_path(path, 0.031 / 100)[0]
            sampled += len(dense)
            assert meshes.are_free(dense).all()
    assert sampled > 300


def test_the_full_check_agrees_with_the_meshes_alone(robot: Robot, tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    both, meshes = checkers(robot, clutter(rng, tmp_path / "step.obj")[:4], [])
    states = states_around_home(robot, rng, 40, 0.3)
    states = states[meshes.are_free(states)]
    outcomes = []
    for a, b in zip(states, states[1:], strict=False):
        path = a + np.linspace(0.0, 1.0, 40)[:, None] * (b - a)
        one, other = full_check(both, path), full_check(meshes, path)
        assert one.ok == other.ok and bool(one.reason) == bool(other.reason)
        outcomes.append(one.ok)
    assert {True, False} == set(outcomes)


def test_several_threads_find_what_one_finds(robot: Robot, tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    both, meshes = checkers(robot, clutter(rng, tmp_path / "step.obj"), held(robot))
    states = states_around_home(robot, rng, 400)
    expected = meshes.are_free(states)
    found: list[np.ndarray | None] = [None] * 3

    def work(k: int) -> None:
        found[k] = np.array([both.is_free(q) for q in states])

    threads = [threading.Thread(target=work, args=(k,)) for k in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(np.array_equal(expected, one) for one in found)


@pytest.mark.parametrize("proofs", [True, False])
def test_paths_with_numbers_that_are_none_collide(robot: Robot, proofs: bool) -> None:
    checker = CollisionChecker(robot, proofs=proofs)
    path = np.tile(robot.home, (4, 1))
    assert checker.first_collision(path, 0.031) is None
    for value in (np.nan, np.inf):
        path[2, 3] = value
        hit = checker.first_collision(path, 0.031)
        assert hit is not None and hit.segment == 1
    with pytest.raises(ParameterError, match=r"\(N, 16\)"):
        checker.first_collision(path[:, :5], 0.031)


CUBE = "".join(f"v {x} {y} {z}\n" for x in (0, 0.3) for y in (0, 0.3) for z in (0, 0.3))
SIDES = "f 1 2 4\nf 1 4 3\nf 5 7 8\nf 5 8 6\nf 1 5 6\nf 1 6 2\nf 3 4 8\nf 3 8 7\nf 1 3 7\nf 1 7 5\n"
LID = "f 2 6 8\nf 2 8 4\n"


@pytest.mark.parametrize("lid", [True, False])
def test_the_inside_of_a_mesh_with_a_hole_is_inside(robot: Robot, tmp_path: Path, lid: bool) -> None:
    (tmp_path / "cube.obj").write_text(CUBE + SIDES + (LID if lid else ""))
    q = robot.home
    palm = robot.link_pose(q, "left_hand_palm")
    ball = AttachedObject(name="ball", link="left_hand_palm", sphere={"radius": 0.01}, position=(0, 0.9, 0.0))
    middle = palm[:3, :3] @ (0.0, 0.9, 0.0) + palm[:3, 3]
    for shift in ((0.0, 0.0, 0.0), (0.05, -0.05, 0.0), (0.0, 0.0, 0.08), (0.0, 0.0, -0.08)):
        corner = middle - 0.15 + shift
        cube = Obstacle(name="cube", mesh=MeshFile(file=str(tmp_path / "cube.obj")), position=tuple(corner))
        both, meshes = checkers(robot, [cube], [ball])
        assert not meshes.is_free(q) and not both.is_free(q)


def test_a_notch_in_a_mesh_is_outside(robot: Robot, tmp_path: Path) -> None:
    step = STEP.replace("0.3", "1.0").replace("0.1", "0.985")  # a cube with 15 mm cut from an edge
    (tmp_path / "notched.obj").write_text(step)
    palm = robot.link_pose(robot.home, "left_hand_palm")
    ball = AttachedObject(name="ball", link="left_hand_palm", sphere={"radius": 0.003}, position=(0, 3.0, 0.0))
    middle = palm[:3, :3] @ (0.0, 3.0, 0.0) + palm[:3, 3]
    corner = middle - (0.9925, 0.9925, 0.1)
    notched = Obstacle(name="n", mesh=MeshFile(file=str(tmp_path / "notched.obj")), position=tuple(corner))
    both, meshes = checkers(robot, [notched], [ball])
    assert meshes.is_free(robot.home) and both.is_free(robot.home)
    for checker in (both, meshes):
        checker.move("n", tuple(corner + (0.05, 0.05, 0.0)))
        assert not checker.is_free(robot.home)


@pytest.mark.parametrize("proofs", [True, False])
def test_bad_resolutions_and_endless_paths_are_refused(robot: Robot, proofs: bool) -> None:
    checker = CollisionChecker(robot, proofs=proofs)
    path = np.stack([robot.home, robot.home + 0.1])
    for resolution in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ParameterError, match="resolution"):
            checker.first_collision(path, resolution)
    with pytest.raises(ParameterError, match="path"):
        checker.first_collision(np.stack([robot.home, robot.home + 1e12]), 0.0031)


def test_the_kernel_alone_proves_what_the_spheres_prove(checker: CollisionChecker, robot: Robot) -> None:
    """What it proves no mesh denies; it proves most free motions, and none that collides."""
    rng, proved, free = np.random.default_rng(11), 0, 0
    for a, b in zip(states_around_home(robot, rng, 60), states_around_home(robot, rng, 60), strict=True):
        line = np.stack([a, 0.7 * a + 0.3 * b, b])
        by_kernel = checker.kernel.proves(line, FINE_RESOLUTION)
        by_all = checker.first_collision(line, FINE_RESOLUTION) is None
        assert by_all or not by_kernel
        proved, free = proved + by_kernel, free + by_all
    assert 0.5 * free <= proved < 60
    assert not checker.kernel.proves(np.full((2, robot.dof), np.nan), FINE_RESOLUTION)
    for path, resolution in ((robot.home[None], 0.01), (np.stack([robot.home] * 2), 0.0)):
        with pytest.raises(ParameterError, match="path|resolution"):
            checker.kernel.proves(path, resolution)


def test_boxes_leave_no_pair_out_that_touches(robot: Robot, tmp_path: Path) -> None:
    rng = np.random.default_rng(6)
    _, meshes = checkers(robot, clutter(rng, tmp_path / "step.obj"), held(robot))
    stage = meshes.meshes
    states = [robot.to_pinocchio(q) for q in states_around_home(robot, rng, 60, 0.5)]
    found = [stage.collides(q) for q in states]
    assert found == [stage.any_collides(q, stage.pairs) for q in states]
    assert 5 < sum(found) < 55
