"""Proofs of whole paths: against Coal's distances pair by pair, dense states, and closed forms."""

from __future__ import annotations

import time
from pathlib import Path
from types import ModuleType

import coal
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from support import benchmark_script, states_around_home

from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.exact_shapes import mesh_of
from apex_ompl.collision.path_proof import TOLERANCE, Curve
from apex_ompl.kernel.geometry import BallTree
from apex_ompl.ompl.validity import full_check
from apex_ompl.robot import Robot, load_robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.timing import time_path


@pytest.fixture(scope="module")
def grazing() -> ModuleType:
    return benchmark_script("collision.grazing")


@pytest.fixture(scope="module", params=["dual_panda_softhand", "baxter"])
def robot(request: pytest.FixtureRequest) -> Robot:
    return load_robot(request.param)


def scenes(grazing: ModuleType, robot: Robot, folder: Path, seed: int) -> tuple[CollisionChecker, np.random.Generator]:
    """Obstacles of each kind, held objects in every second scene."""
    rng = np.random.default_rng(seed)
    grazing.write_tray(folder / "tray.obj")
    held = grazing.held_objects(robot, folder / "tray.obj") if seed % 2 else []
    return CollisionChecker(robot, grazing.obstacles(rng, folder / "tray.obj"), held), rng


def test_clearance_of_a_state_is_that_of_coal(grazing: ModuleType, robot: Robot, tmp_path: Path) -> None:
    compared = 0
    for seed in range(4):
        checker, rng = scenes(grazing, robot, tmp_path, seed)
        distances = grazing.PairDistances(checker)
        for q in states_around_home(robot, rng, 12):
            if checker.is_free(q):
                proof, truth = checker.prove(q[None]), distances(q, distances.scene.pairs)
                assert truth.min() - 1e-7 <= proof.clearance <= truth.min() + TOLERANCE
                assert proof.clearance_bound <= truth.min() and proof.clearance_bound >= proof.clearance - TOLERANCE
                compared += 1
            else:
                assert not checker.prove(q[None])
    assert compared > 10


def test_clearance_of_a_path_holds_at_dense_states(grazing: ModuleType, robot: Robot, tmp_path: Path) -> None:
    proved = 0
    for seed in range(2):
        checker, rng = scenes(grazing, robot, tmp_path, seed)
        distances = grazing.PairDistances(checker)
        for q in states_around_home(robot, rng, 10):
            path = np.clip(q + np.cumsum(rng.normal(0, 0.1, (3, robot.dof)), axis=0), *limits(robot))
            proof = checker.prove(path)
            if not proof:
                continue
            proved += 1
            dense = np.concatenate(
                [a + np.linspace(0, 1, 13)[:, None] * (b - a) for a, b in zip(path, path[1:], strict=False)]
            )
            least = min(distances.nearest(q)[0] for q in dense)
            assert proof.clearance_bound <= least + 1e-7
            assert proof.clearance_bound >= proof.clearance - TOLERANCE
            for share in (0.05, 0.3):
                rough = checker.prove(path, share=share)
                assert rough.intervals <= proof.intervals
                assert rough.clearance_bound <= proof.clearance <= rough.clearance + 1e-9
                assert rough.clearance_bound >= rough.clearance - max(TOLERANCE, share * rough.clearance) - 1e-9
            at = Curve.polyline(path)
            state = np.array([np.interp(proof.parameter, at.knots, column) for column in at.states.T])
            there = distances(state, distances.scene.pairs)
            assert there.min() == pytest.approx(proof.clearance, abs=1e-7)
            worst = distances.scene.pairs[int(there.argmin())]
            assert {distances.scene.solids[k].name for k in worst} == set(proof.pair)
    assert proved > 3


def limits(robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    return robot.limits.lower, robot.limits.upper


def test_grazing_paths_are_proved_only_where_coal_finds_them_free(
    grazing: ModuleType, robot: Robot, tmp_path: Path
) -> None:
    count = grazing.grazing_paths(robot, np.random.default_rng(7), 16, tmp_path, per_scene=4)
    assert count.paths == 16 and count.false_free == count.refused == count.off == 0
    assert count.colliding > 3 and count.clear > 2 and len(count.pairs) > 2


def test_clearance_along_a_path_has_a_closed_form() -> None:
    robot = load_robot("dual_panda_softhand")
    name, states = "left_link7", robot.home + np.linspace(-0.3, 0.3, 2)[:, None] * np.eye(robot.dof)[0]
    center = robot.link_pose(robot.home, name)[:3, 3] + [0.6, 0.0, 0.0]
    ball = CollisionChecker(robot, [Obstacle(name="ball", sphere={"radius": 0.05}, position=tuple(center))])
    small = CollisionChecker(robot, [Obstacle(name="ball", sphere={"radius": 0.01}, position=tuple(center))])
    # the distance to a ball grows by what its radius shrinks
    first, second = ball.obstacle_distance(states), small.obstacle_distance(states)
    assert second - first == pytest.approx(0.04, abs=2 * TOLERANCE)


def test_motions_are_proved_along_their_cubic_pieces(tmp_path: Path, grazing: ModuleType) -> None:
    robot, proved = load_robot("dual_panda_softhand"), 0
    for seed in range(2):
        checker, rng = scenes(grazing, robot, tmp_path, seed)
        distances = grazing.PairDistances(checker)
        for q in states_around_home(robot, rng, 5, 0.3):
            path = np.clip(q + np.cumsum(rng.normal(0, 0.15, (4, robot.dof)), axis=0), *limits(robot))
            motion = time_path(path, robot.limits, robot.joint_names).trajectory
            check = full_check(checker, motion)
            states = motion.sample(motion.duration / 50).position
            if check:
                proved += 1
                least = min(distances.nearest(q)[0] for q in states)
                assert check.proof is not None and check.proof.clearance_bound <= least + 1e-7
                assert check.proof.clearance <= least + 5e-3
            else:
                assert check.reason
                free = checker.are_free(states)
                assert not free.all() or check.proof.clearance < 1e-4
    assert proved > 1


def test_a_motion_that_leaves_its_knots_is_seen(grazing: ModuleType, tmp_path: Path) -> None:
    """Two knots with the same position and opposite speeds: the curve between them swings out."""
    robot = load_robot("dual_panda_softhand")
    q, speed = robot.home, 2.0 * np.eye(robot.dof)[3]
    t = np.array([0.0, 1.0])
    # a cubic with q(0) = q(1), q'(0) = speed, q'(1) = -speed has q'' = -2 speed, and is a parabola
    curve = Curve.cubic(t, np.stack([q, q]), np.stack([speed, -speed]), np.stack([-2 * speed, -2 * speed]))
    farthest = q + speed / 4.0
    palm = robot.link_pose(farthest, "left_link7")[:3, 3]
    checker = CollisionChecker(robot, [Obstacle(name="ball", sphere={"radius": 0.02}, position=tuple(palm))])
    assert checker.is_free(q) and not checker.is_free(farthest)
    proof = checker.prove(curve)
    assert not proof and "ball" in proof.reason and 0.1 < proof.parameter < 0.9
    assert not checker.is_free(proof.state)


def test_contact_begins_at_touch() -> None:
    """A state is refused 5 um below a ceiling and accepted 30 um below it; is_free takes both."""
    robot = load_robot("dual_panda_softhand")
    ceiling = [Obstacle(name="ceiling", half_space={"normal": (0.0, 0.0, -1.0), "offset": -3.0})]
    height = 3.0 - CollisionChecker(robot, ceiling).obstacle_distance(robot.home[None])
    for above, free in ((5e-6, False), (3e-5, True)):
        near = Obstacle(name="ceiling", half_space={"normal": (0.0, 0.0, -1.0), "offset": -height - above})
        checker = CollisionChecker(robot, [near])
        proof = checker.prove(robot.home[None])
        assert checker.is_free(robot.home) and bool(proof) == free
        assert free or ("apart" in proof.reason and "ceiling" in proof.reason)


def test_obstacle_inside_a_link_is_found_at_the_start() -> None:
    robot = load_robot("dual_panda_softhand")
    item = next(g for g in robot.geometry.geometryObjects if g.name.startswith("left_link5"))
    item.geometry.computeLocalAABB()
    at = robot.link_pose(robot.home, "left_link5") @ np.append(item.geometry.aabb_local.center(), 1.0)
    seed = Obstacle(name="seed", sphere={"radius": 0.002}, position=tuple(at[:3]))
    checker = CollisionChecker(robot, [seed])
    assert not checker.is_free(robot.home)
    assert not checker.prove(robot.home[None]) and not full_check(checker, robot.home[None])


def test_a_deadline_ends_a_proof(grazing: ModuleType, tmp_path: Path) -> None:
    robot = load_robot("dual_panda_softhand")
    checker, _ = scenes(grazing, robot, tmp_path, 1)
    bare, q = CollisionChecker(robot), robot.home
    there_and_back = np.clip([q + 0.05 * np.sin(k) for k in range(4000)], *limits(robot))
    proof = bare.prove(there_and_back, deadline=time.perf_counter())
    assert proof.timed_out and not proof and proof.reason == "not proved in time"
    check = full_check(checker, there_and_back, deadline=time.perf_counter() - 1.0)
    assert check.timed_out and not check


def test_states_that_are_not_finite_are_refused() -> None:
    checker = CollisionChecker(load_robot("dual_panda_softhand"))
    path = np.stack([checker.robot.home] * 3)
    path[1, 2] = np.nan
    assert not checker.prove(path) and "not finite" in checker.prove(path).reason


def test_hands_at_their_limits_are_proved_as_whole_intervals() -> None:
    """Open hands stand at their limit exactly; rounding must not keep the spheres from proving motions there."""
    robot = load_robot("dual_panda_softhand")
    checker, path = CollisionChecker(robot), np.stack([robot.home, robot.home + 0.05 * np.eye(robot.dof)[0]])
    path[:, robot.groups["hands"]] = 0.0
    assert checker.first_collision(path, 0.0031) is None
    assert checker.check_counts.proved_intervals > 0


@settings(max_examples=30, deadline=None)
@given(st.integers(2, 200), st.integers(0, 2**32 - 1))
def test_tree_of_balls_holds_its_triangles(count: int, seed: int) -> None:
    corners = np.random.default_rng(seed).normal(size=(count, 3, 3))
    _, balls, halves, child, leaf = BallTree.over(corners)
    assert len(balls) == 2 * count - 1 and sorted(leaf[leaf >= 0]) == list(range(count))
    below: dict[int, list[int]] = {}
    for k in reversed(range(len(balls))):
        below[k] = [int(leaf[k])] if child[k] < 0 else below[int(child[k])] + below[int(child[k]) + 1]
        away = corners[below[k]] - balls[k, :3]
        assert np.linalg.norm(away, axis=2).max() <= balls[k, 3]
        assert (np.abs(away).max(axis=(0, 1)) <= halves[k]).all()
    assert sorted(below[0]) == list(range(count))


def test_convex_meshes_are_their_hulls(tmp_path: Path, grazing: ModuleType) -> None:
    grazing.write_tray(tmp_path / "tray.obj")
    tray = coal.MeshLoader().load(str(tmp_path / "tray.obj"), np.ones(3))
    assert len(mesh_of(tray).tree.corners) == tray.num_tris
    (tmp_path / "wedge.obj").write_text(
        "v 0 0 0\nv 0.3 0 0\nv 0 0.3 0\nv 0 0 0.3\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"
    )
    wedge = coal.MeshLoader().load(str(tmp_path / "wedge.obj"), np.ones(3))
    assert len(mesh_of(wedge).tree.corners) == 0 and len(mesh_of(wedge).points) == 4


@settings(max_examples=30, deadline=None)
@given(st.integers(30, 400), st.integers(0, 2**32 - 1))
def test_corners_of_a_hull_whose_neighbors_are_nearer_are_the_farthest(count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    found = coal.StdVec_Vec3s()
    found.extend(list(rng.normal(size=(count, 3)) ** 3))
    hull = mesh_of(coal.Convex.convexHull(found, True, "Qt"))
    if not len(hull.edge_first):
        return
    for direction in rng.normal(size=(50, 3)):
        along = hull.points @ direction
        highest = [
            k
            for k in range(len(along))
            if (along[hull.edge_end[hull.edge_first[k] : hull.edge_first[k + 1]]] <= along[k]).all()
        ]
        assert along[highest] == pytest.approx(along.max(), abs=1e-12)


def test_clearance_to_a_hull_of_many_corners(grazing: ModuleType, robot: Robot, tmp_path: Path) -> None:
    trimesh.creation.icosphere(3, 0.15).export(tmp_path / "ball.stl")
    mesh = {"file": str(tmp_path / "ball.stl")}
    checker = CollisionChecker(robot, [Obstacle(name="ball", mesh=mesh, position=(0.4, 0.0, 0.45))])
    distances, pairs = grazing.PairDistances(checker), []
    for q in states_around_home(robot, np.random.default_rng(0), 100, 0.5):
        if checker.is_free(q):
            proof = checker.prove(q[None])
            assert proof.clearance == pytest.approx(distances.nearest(q)[0], abs=TOLERANCE)
            pairs.append(proof.pair[1])
    assert pairs.count("ball") > 3
