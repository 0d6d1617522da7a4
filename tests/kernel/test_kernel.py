"""The kernel against Pinocchio, Coal, finite differences and brute force."""

from __future__ import annotations

import threading
from typing import Any

import coal
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_robots import frames, pose, random_hand, random_robot, unit
from support import states_around_home

from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.tables import primitives
from apex_ompl.errors import ParameterError
from apex_ompl.kernel import Kernel, robot_builder
from apex_ompl.kernel.compiled.arrays import PRISMATIC
from apex_ompl.kernel.compiled.check import motion_proof, queries
from apex_ompl.kernel.joint_tree import JointTree
from apex_ompl.kernel.library import is_used
from apex_ompl.kernel.scene_builder import scene_tables
from apex_ompl.kernel.tables import BodySpec, JointSpec, RobotTables
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import Obstacle

SHAPES = {
    "box": lambda r: coal.Box(*r.uniform(0.05, 0.5, 3)),
    "sphere": lambda r: coal.Sphere(r.uniform(0.03, 0.3)),
    "cylinder": lambda r: coal.Cylinder(r.uniform(0.03, 0.3), r.uniform(0.05, 0.6)),
    "capsule": lambda r: coal.Capsule(r.uniform(0.03, 0.2), r.uniform(0.05, 0.6)),
    "half-space": lambda r: coal.Halfspace(unit(r), r.uniform(-0.3, 0.3)),
}


def leaves_at(specs: list, bodies: list, q: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """World centers and radii of the leaves of each body."""
    poses, found = frames(specs, q), []
    for body in bodies:
        at = poses[body.joint] @ body.placement
        leaf = body.count == 0
        found.append((body.centers[leaf] @ at[:3, :3].T + at[:3, 3], body.radii[leaf]))
    return found


def coal_distance(shape: coal.CollisionGeometry, at: np.ndarray, point: np.ndarray, radius: float) -> float:
    return float(
        coal.distance(
            shape, coal.Transform3s(at[:3, :3], at[:3, 3]), coal.Sphere(radius), coal.Transform3s(np.eye(3), point),
            coal.DistanceRequest(True), coal.DistanceResult(),
        )
    )  # fmt: skip


@settings(max_examples=25)
@given(seed=st.integers(0, 10**6))
def test_pushes_of_random_trees_are_virtual_work(seed: int) -> None:
    """The rate of a joint times its push is the power of the forces: f . dp/dq, for joints of all kinds."""
    tables, rng = random_robot(seed)[0], np.random.default_rng(seed)
    kernel, reach, step = Kernel(tables, scene_tables([])), 0.2, 1e-6
    carriers, offsets = rng.integers(0, len(tables.arrays.joint_parent), 6), rng.normal(size=(6, 3))
    state = rng.uniform(-1.0, 1.0, tables.dof)

    def points(q: np.ndarray) -> np.ndarray:
        rotation, origin = (values[0][carriers] for values in kernel.joint_frames(q))
        return np.einsum("pij,pj->pi", rotation, offsets) + origin

    distances, gradients = rng.uniform(-0.1, 2 * reach, 6), rng.normal(size=(6, 3))
    near = distances[None], gradients[None]
    found = kernel.joint_pushes(kernel.joint_frames(state), carriers, points(state)[None], near, reach)[0]
    force = np.maximum(0.0, 1.0 - distances / reach)[:, None] * gradients
    wanted = [(force * (points(state + d) - points(state - d))).sum() / (2 * step) for d in step * np.eye(tables.dof)]
    np.testing.assert_allclose(found, wanted, atol=1e-6)


@settings(max_examples=50)
@given(seed=st.integers(0, 10**6), make=st.sampled_from([random_robot, random_hand]))
def test_clearance_of_random_trees_is_that_of_all_spheres(seed: int, make: Any) -> None:
    tables, specs, bodies, pairs = make(seed)
    rng = np.random.default_rng(seed)
    shapes = [(make(rng), pose(rng)) for make in SHAPES.values() for _ in range(2)]
    scene = scene_tables([(n, p) for n, (shape, at) in enumerate(shapes) for p in primitives(shape, at)])
    kernel = Kernel(tables, scene)
    states = rng.uniform(tables.arrays.lower, tables.arrays.upper, (3, tables.dof))
    values = kernel.clearance(states)
    for q, (near, own) in zip(states, values, strict=True):
        leaves = leaves_at(specs, bodies, q)
        alone = Kernel(single_ball(), scene)
        to_scene = min(
            (
                alone.clearance(c[None])[0, 0] - r + 0.01
                for body, (cs, rs) in zip(bodies, leaves, strict=True) if body.meets_scene
                for c, r in zip(cs, rs, strict=True)
            ),
            default=np.inf,
        )  # fmt: skip
        between = np.inf
        for a, b in pairs:
            (ca, ra), (cb, rb) = leaves[a], leaves[b]
            away = np.linalg.norm(ca[:, None] - cb[None], axis=2) - ra[:, None] - rb[None]
            between = min(between, float(away.min()))
        assert near == pytest.approx(to_scene, abs=1e-9)
        assert own == pytest.approx(between, abs=1e-9)
    capped = kernel.clearance(states, limit=0.02)
    assert capped == pytest.approx(np.minimum(values, 0.02), abs=1e-12)
    for narrow in (kernel, *(kernel.within(states.min(axis=0) - w, states.max(axis=0) + w) for w in (0.0, 1e-9, 0.1))):
        assert ((narrow.unproved(states)[1] == 0) == (values.min(axis=1) > 0.0)).all()
        np.testing.assert_array_equal(narrow.clearance(states, limit=0.02), capped)


def single_ball() -> RobotTables:
    """A ball of 1 cm on three sliders: its state is where it is."""
    specs = [JointSpec(0)]
    specs += [JointSpec(k, PRISMATIC, np.eye(4), np.eye(3)[k], k) for k in range(3)]
    cover = {
        "centers": np.zeros((1, 3)),
        "radii": np.array([0.01]),
        "first": np.zeros(1, int),
        "count": np.zeros(1, int),
    }
    body = BodySpec("ball", 3, np.eye(4), **cover)
    box = 10.0 * np.ones(3)
    return robot_builder.robot_tables(
        "ball", "xyz", lower=-box, upper=box, tree=JointTree(specs), bodies=[body], pairs=[]
    )


def cylinder_surface(shape: coal.Cylinder, at: np.ndarray) -> np.ndarray:
    """Points all over the surface, in the world."""
    turns, share = (grid.ravel() for grid in np.meshgrid(np.linspace(0.0, 2 * np.pi, 200), np.linspace(-1.0, 1.0, 161)))
    ring = np.stack([np.cos(turns), np.sin(turns)], axis=1) * shape.radius
    side = np.column_stack([ring, share * shape.halfLength])
    caps = [
        np.column_stack([ring * share[:, None], np.full(len(share), z)]) for z in (-shape.halfLength, shape.halfLength)
    ]
    return np.concatenate([side, *caps]) @ at[:3, :3].T + at[:3, 3]


@pytest.mark.parametrize("name", SHAPES)
def test_distances_are_those_of_coal(name: str) -> None:
    rng = np.random.default_rng(3)
    tables, inside = single_ball(), 0
    for _ in range(40):
        shape, at = SHAPES[name](rng), pose(rng)
        if name == "half-space":
            at = np.eye(4)
        kernel = Kernel(tables, scene_tables([(0, p) for p in primitives(shape, at)]))
        for point in at[:3, 3] + rng.normal(0.0, 0.2, (20, 3)):
            expected = coal_distance(shape, at, point, 0.01)
            found, slope = (v[0, 0] for v in kernel.clearance_gradient(point))
            inside += expected < -0.02
            if expected > 0.0 or name != "cylinder":
                assert found == pytest.approx(expected, abs=1e-5 if expected > 0.0 else 1e-3)
            else:  # EPA stops early inside a cylinder, with too large a depth
                away = np.linalg.norm(cylinder_surface(shape, at) - point, axis=1).min()
                local = at[:3, :3].T @ (point - at[:3, 3])
                within = np.hypot(*local[:2]) < shape.radius and abs(local[2]) < shape.halfLength
                assert found == pytest.approx((-away if within else away) - 0.01, abs=3e-3)
            assert np.linalg.norm(slope) == pytest.approx(1.0)
            back = kernel.clearance(point - slope * 1e-6)[0, 0]
            assert back == pytest.approx(found - 1e-6, abs=1e-10)
    assert inside > 20


@settings(max_examples=15)
@given(seed=st.integers(0, 10**6))
def test_gradients_are_finite_differences_on_random_trees(seed: int) -> None:
    tables, *_ = random_robot(seed)
    rng = np.random.default_rng(seed)
    shapes = [(make(rng), pose(rng)) for make in SHAPES.values()]
    kernel = Kernel(tables, scene_tables([(n, p) for n, (s, at) in enumerate(shapes) for p in primitives(s, at)]))
    check_gradients(kernel, rng.uniform(-0.9, 0.9, (6, tables.dof)))


def check_gradients(kernel: Kernel, states: np.ndarray) -> None:
    step, smooth = 1e-6, 0
    values, slopes = kernel.clearance_gradient(states)
    for q, value, slope in zip(states, values, slopes, strict=True):
        shifts = step * np.eye(len(q))
        ahead, behind = kernel.clearance(q + shifts), kernel.clearance(q - shifts)
        numeric = (ahead - behind) / (2 * step)
        improved = np.abs(ahead + behind - 2 * value) > 1e-8  # another sphere takes over between the two
        where = np.isfinite(value) & ~improved.any(axis=0)
        smooth += int(where.sum())
        assert np.abs(numeric - slope.T)[:, where] == pytest.approx(0.0, abs=1e-5)
    assert smooth >= len(states)


@pytest.mark.parametrize("which", ["robot", "baxter"])
def test_frames_and_gradients_of_real_robots(which: str, request: pytest.FixtureRequest, post: Obstacle) -> None:
    robot: Robot = request.getfixturevalue(which)
    kernel = CollisionChecker(robot, [post]).kernel
    states = states_around_home(robot, np.random.default_rng(0), 20)
    turn, origin = kernel.joint_frames(states)
    data = robot.model.createData()
    for k, q in enumerate(states):
        pin.forwardKinematics(robot.model, data, robot.to_pinocchio(q))
        assert origin[k] == pytest.approx(np.array([at.translation for at in data.oMi]), abs=1e-12)
        for j in range(1, robot.model.njoints):  # the axis, which turning about z leaves alone
            name = robot.model.joints[j].shortname()
            if name.endswith("RZ"):
                assert turn[k, j, :, 2] == pytest.approx(data.oMi[j].rotation[:, 2], abs=1e-12)
    check_gradients(kernel, states)


def test_read_only_arrays_are_taken_and_not_compiled_for_anew(robot: Robot) -> None:
    checker = CollisionChecker(robot)
    checker.prepare()
    functions = queries.check_states, motion_proof.prove_path, motion_proof.lay_grid
    path = np.tile(robot.home, (3, 1))
    path.flags.writeable = False
    assert checker.first_collision(path, 0.031) is None and checker.is_free(robot.home)
    checker.kernel.unproved(robot.home)
    if not is_used():
        assert [len(f.dispatcher.signatures) for f in functions] == [1, 1, 1]


@pytest.mark.parametrize("step", [0.0, 1e-320, 1e18, 1e300])
def test_grids_hold_no_more_steps_than_they_can_count(step: float) -> None:
    starts = np.empty(2, np.int64)
    path = np.array([[0.0], [step]])
    assert motion_proof.lay_grid(path, 0.03, starts) == (1 if step < 0.03 else -1)
    for resolution in (0.0, 1e-320, np.nan):
        assert motion_proof.lay_grid(np.array([[0.0], [1.0]]), resolution, starts) == -1
    assert motion_proof.lay_grid(np.array([[0.0], [1.0]]), 0.03, starts) == 34


def test_clearance_of_what_is_no_number_is_none(robot: Robot) -> None:
    kernel = CollisionChecker(robot).kernel
    for k in range(robot.dof):
        q = robot.home.copy()
        q[k] = np.nan
        assert np.isnan(kernel.clearance(q)).all()
    values, slopes = kernel.clearance_gradient(np.stack([robot.home, robot.home + 2.0]))
    assert np.isfinite(values[0]).all() and np.isfinite(slopes[0]).all() and np.isnan(slopes[1]).all()


def test_states_of_another_shape_are_refused(robot: Robot) -> None:
    kernel = CollisionChecker(robot).kernel
    with pytest.raises(ParameterError, match=r"\(N, 16\)"):
        kernel.clearance(np.zeros(7))


def test_what_is_no_number_is_never_proved(robot: Robot) -> None:
    kernel = CollisionChecker(robot).kernel
    assert kernel.unproved(robot.home)[1][0] == 0
    for k in range(robot.dof):
        for value in (np.nan, np.inf, -np.inf):
            q = robot.home.copy()
            q[k] = value
            assert kernel.unproved(q)[1][0] == -1
    q = robot.home.copy()
    q[-1] = 1.001  # beyond the limits the ball around the fingers does not hold
    assert kernel.unproved(q)[1][0] == -1


def test_threads_do_not_disturb_each_other(robot: Robot, post: Obstacle) -> None:
    kernel = CollisionChecker(robot, [post]).kernel
    rng = np.random.default_rng(2)
    batches = [states_around_home(robot, rng, 1500) for _ in range(4)]
    expected = [kernel.clearance(batch) for batch in batches]
    found: list[np.ndarray | None] = [None] * 4

    def work(k: int) -> None:
        for _ in range(3):
            found[k] = kernel.clearance(batches[k])

    threads = [threading.Thread(target=work, args=(k,)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(np.array_equal(a, b) for a, b in zip(expected, found, strict=True))
