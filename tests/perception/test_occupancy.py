"""Occupancy maps against brute force on scenes of primitives, and plans among what they saw against the true scene."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from depth_images import Placed, free_by_rays, placed_bodies, placed_robot, true_depth
from small_arm import arm_problem, write_arm

from apex_ompl import MotionPlanner
from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ApexError, FileFormatError, ParameterError, SceneError
from apex_ompl.perception import Camera, Frame, OccupancyMap, OccupancySettings, look_at
from apex_ompl.robot import Robot, load_robot
from apex_ompl.scene.bodies import AttachedObject, Obstacle
from apex_ompl.scene.points import points_of
from apex_ompl.util.schema import validate

EXACT: dict[str, Any] = {"position_spread": 0.0, "angle_spread": 0.0, "depth": {"noise": 0.0, "farthest": 6.0}}
CAMERA = Camera(width=160, height=120, focal=(116.0, 120.0), center=(79.5, 59.5), **EXACT)
BENT = CAMERA.model_copy(update={"distortion": (0.05, -0.1, 1e-3, -5e-4, 0.0)})
ROOM = (
    Obstacle(name="back", box=(0.1, 4.0, 4.0), position=(-1.0, 0.0, 0.0)),
    Obstacle(name="floor", box=(4.0, 4.0, 0.1), position=(0.0, 0.0, -0.45)),
)
BOUNDS = ((-0.6, -0.8, -0.4), (0.8, 0.8, 0.8))
SIDE = 0.05
WALL = Obstacle(name="wall", box=(0.3, 0.3, 0.3), position=(0.1, 0.0, 0.1))


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    return load_robot(str(write_arm(tmp_path_factory.mktemp("arm"))))


def scene(seed: int) -> tuple[list[Placed], np.ndarray]:
    """A room with a few solids, and the pose of a camera that looks at them."""
    rng = np.random.default_rng(seed)
    turn = rng.normal(size=4)
    solids = [
        Obstacle(name="box", box=tuple(rng.uniform(0.1, 0.4, 3)), position=tuple(rng.uniform(-0.3, 0.3, 3)),
                 orientation=tuple(turn / np.linalg.norm(turn))),
        Obstacle(name="ball", sphere={"radius": 0.15}, position=tuple(rng.uniform(-0.4, 0.4, 3))),
        Obstacle(name="can", cylinder={"radius": 0.1, "length": 0.3}, position=tuple(rng.uniform(-0.4, 0.4, 3))),
    ]  # fmt: skip
    eye = (1.5, rng.uniform(-0.6, 0.6), rng.uniform(0.2, 1.0))
    return placed_bodies([*ROOM, *solids]), look_at(eye, (0.0, 0.0, 0.1), rng.uniform(-0.2, 0.2))


def map_of(*images: tuple[np.ndarray, np.ndarray], camera: Camera = CAMERA, **settings: Any) -> OccupancyMap:
    made = OccupancyMap(BOUNDS, SIDE, settings=OccupancySettings(**settings))
    for image, pose in images:
        made.integrate(image, camera, pose)
    return made


def centers(made: OccupancyMap) -> np.ndarray:
    return np.stack(np.indices(made.evidence.shape), axis=-1) * made.resolution + made.origin + 0.5 * made.resolution


def least_depths(
    made: OccupancyMap, image: np.ndarray, camera: Camera, pose: np.ndarray, margin: float
) -> tuple[np.ndarray, np.ndarray]:
    """Largest depth of each voxel, and the least depth of the rectangle of pixels around it and a margin; 0 outside."""
    signs = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), axis=-1).reshape(-1, 3)
    corners = centers(made)[..., None, :] + 0.5 * made.resolution * signs
    local = (corners - pose[:3, 3]) @ pose[:3, :3]
    pixels = camera.project(local)
    low, high = np.floor(pixels.min(axis=-2) - margin), np.ceil(pixels.max(axis=-2) + margin)
    found = np.zeros(made.evidence.shape)
    for cell in np.ndindex(found.shape):
        (u0, v0), (u1, v1) = low[cell], high[cell]
        if u0 >= 0 and v0 >= 0 and u1 < camera.width and v1 < camera.height:
            found[cell] = image[int(v0) : int(v1) + 1, int(u0) : int(u1) + 1].min()
    return local[..., 2].max(axis=-1), found


@pytest.mark.parametrize("seed", [0, 1])
def test_free_voxels_are_those_in_front_of_all_pixels_around_them(seed: int) -> None:
    (solids, pose), camera = scene(seed), CAMERA
    image = true_depth(solids, camera, pose)
    made = map_of((image, pose), camera=camera, missing=0.0)
    far, around = least_depths(made, image, camera, pose, 0.0)
    assert (far[made.free] <= around[made.free] + 1e-5).all()
    far, wide = least_depths(made, image, camera, pose, 7.0)  # pixels: two blocks, and what blocks are rounded up by
    certain = (far + 1e-5 < np.where(wide > 0.0, wide, 0.0)) & ~made.occupied
    assert certain.sum() > 1000 and made.free[certain].all()


def cells_of(image: np.ndarray, camera: Camera, size: int, missing: float) -> np.ndarray:
    """Least depths of cells of pixels, from the cells around where too many have none; 0 where that is not known."""
    rows, columns = camera.height // size, camera.width // size
    pixels = image[: rows * size, : columns * size].reshape(rows, size, columns, size)
    lost = np.pad((pixels <= 0.0).sum(axis=(1, 3)), 1)
    least = np.pad(np.where(pixels > 0.0, pixels, np.inf).min(axis=(1, 3)), 1, constant_values=np.inf)
    count = np.pad(np.full((rows, columns), size * size), 1)
    found = np.zeros((rows, columns))
    for i, j in np.ndindex(rows, columns):
        around = slice(i, i + 3), slice(j, j + 3)
        if lost[i + 1, j + 1] <= missing * size * size:
            found[i, j] = least[i + 1, j + 1]
        elif lost[around].sum() <= missing * count[around].sum():
            found[i, j] = least[around].min()
    return np.minimum(found, camera.depth.farthest)


@pytest.mark.parametrize("seed", [7, 8, 9])
def test_blocks_of_voxels_become_free_as_each_voxel_by_itself_does(seed: int) -> None:
    depth = CAMERA.depth.model_copy(update={"farthest": 1.9, "scale_spread": 0.002})
    camera = CAMERA.model_copy(update={"depth": depth, "position_spread": 0.003, "angle_spread": 0.002})
    rng, (solids, pose) = np.random.default_rng(seed), scene(seed)
    image = true_depth(solids, camera, pose) * (rng.random((120, 160)) > 0.02)
    image[30:40, 50:70] = 0.0
    side, (shift, turn) = 0.02, (0.006, 0.004)
    made = OccupancyMap(BOUNDS, side)
    made.integrate(image, camera, pose)
    near, axes = cells_of(image, camera, 2, made.settings.missing), np.abs(pose[:3, :3]).sum(axis=0)
    local, half = (centers(made) - pose[:3, 3]) @ pose[:3, :3], 0.5 * side * axes
    front, back = local[..., 2] - half[2], local[..., 2] + half[2]
    ends = []
    for k in range(2):  # the box around a voxel with the errors of place, seen from the center of the camera
        corners = local[..., k, None] + (half[k] + shift) * np.array([-1.0, -1.0, 1.0, 1.0])
        all_four = corners / np.stack([front - shift, back + shift] * 2, axis=-1)
        ends.append((all_four.min(axis=-1), all_four.max(axis=-1)))
    size = [np.maximum(np.abs(low), np.abs(high)) for low, high in ends]
    margin = turn * (1.0 + size[0] ** 2 + size[1] ** 2)
    reach = back * (1.0 + 0.004 + turn * (size[0] + size[1])) + shift
    first, last = (
        np.stack(
            [((ends[k][n] + (2 * n - 1) * margin) * camera.focal[k] + camera.center[k] + n) / 2.0 for k in range(2)]
        )
        for n in range(2)
    )  # cells, with half a pixel around
    expected = np.zeros(made.evidence.shape, bool)
    inside = (first >= 0.0).all(axis=0) & (last[0] < near.shape[1]) & (last[1] < near.shape[0])
    for cell in zip(*np.nonzero(inside & (front >= depth.nearest) & (back <= depth.farthest)), strict=True):
        (j0, i0), (j1, i1) = first[:, *cell].astype(int), last[:, *cell].astype(int)
        expected[cell] = reach[cell] < near[i0 : i1 + 1, j0 : j1 + 1].min()
    expected &= ~made.occupied
    assert (expected == made.free).mean() > 0.9999 and 5000 < expected.sum() < 0.9 * expected.size


@pytest.mark.parametrize(("seed", "camera"), [(3, CAMERA), (4, BENT)])
def test_no_voxel_is_free_that_rays_do_not_reach_or_that_is_in_a_solid(seed: int, camera: Camera) -> None:
    solids, pose = scene(seed)
    image = true_depth(solids, camera, pose)
    made = map_of((image, pose), camera=camera)
    rays = free_by_rays(made, image, camera, pose)
    assert not (made.free & ~rays).any() and made.free.sum() > 0.5 * rays.sum() > 1000
    for shape, at in solids:
        assert not (made.free & inside(shape, (centers(made) - at[:3, 3]) @ at[:3, :3])).any()


def inside(shape: Any, local: np.ndarray) -> np.ndarray:
    """Whether points are in a primitive."""
    if hasattr(shape, "halfSide"):
        return np.asarray((np.abs(local) <= shape.halfSide).all(axis=-1))
    if hasattr(shape, "halfLength"):
        near = np.hypot(local[..., 0], local[..., 1]) <= shape.radius
        return np.asarray(near & (np.abs(local[..., 2]) <= shape.halfLength))
    return np.asarray(np.linalg.norm(local, axis=-1) <= shape.radius)


@pytest.mark.parametrize(("stride", "least"), [(1, 1), (1, 3), (2, 1)])
def test_voxels_with_enough_points_are_occupied(stride: int, least: int) -> None:
    solids, pose = scene(5)
    image = true_depth(solids, CAMERA, pose)
    made = map_of((image, pose), stride=stride, least=least, share=0.0)
    points = CAMERA.points(image)[::stride, ::stride].reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)] @ pose[:3, :3].T + pose[:3, 3]
    cells = np.floor((points - made.origin) / SIDE)
    good = ((cells >= 0) & (cells < made.evidence.shape)).all(axis=1)
    rim = np.abs((points - made.origin) / SIDE - np.round((points - made.origin) / SIDE)).min(axis=1) < 1e-4
    counts, doubtful = np.zeros(made.evidence.shape, int), np.zeros(made.evidence.shape, int)
    np.add.at(counts, tuple(cells[good].astype(int).T), 1)
    np.add.at(doubtful, tuple(cells[good & rim].astype(int).T), 1)  # single precision may put them next door
    sure = doubtful == 0
    assert (made.occupied[sure] == (counts[sure] >= least)).mean() > 0.999
    assert made.occupied.sum() > 100


def test_far_and_noisy_surfaces_need_fewer_points() -> None:
    wall = placed_bodies([Obstacle(name="wall", box=(0.1, 3.0, 3.0), position=(0.0, 0.0, 0.0))])
    pose = look_at((1.5, 0.0, 0.0), (0.0, 0.0, 0.0))
    noisy = CAMERA.model_copy(update={"depth": CAMERA.depth.model_copy(update={"noise": 0.01})})
    image = true_depth(wall, CAMERA, pose)
    image = image + 0.01 * image**2 * np.random.default_rng(0).normal(size=image.shape)
    shares = []
    for share in (1.0, 0.3):
        made = OccupancyMap(((-0.2, -0.4, -0.4), (0.3, 0.4, 0.4)), 0.04, settings=OccupancySettings(share=share))
        made.integrate(image, noisy, pose)
        shares.append(made.occupied.any(axis=0).mean())
    assert shares[1] > 1.5 * shares[0]  # of the wall


def test_an_error_of_the_camera_within_its_spread_frees_no_solid() -> None:
    spread = CAMERA.model_copy(update={"position_spread": 0.01, "angle_spread": 0.01})
    rng = np.random.default_rng(1)
    freed = [0, 0]
    for seed in range(6):
        solids, pose = scene(seed)
        image = true_depth(solids, CAMERA, pose)
        shift, turn = (direction / np.linalg.norm(direction) for direction in rng.normal(size=(2, 3)))
        wrong = pose @ pin.SE3(pin.exp3(0.02 * turn), 0.02 * shift).homogeneous
        for k, spreads in enumerate((2.0, 0.0)):
            made = map_of((image, wrong), camera=spread, spreads=spreads)
            some = centers(made)[..., None, :] + 0.49 * SIDE * np.stack(np.meshgrid(*[(-1, 0, 1)] * 3), -1).reshape(
                -1, 3
            )
            for shape, at in solids:
                within = inside(shape, (some - at[:3, 3]) @ at[:3, :3]).any(axis=-1)
                freed[k] += int((made.free & within).sum())
    assert freed[0] == 0 < freed[1]


def test_what_is_gone_is_freed_after_as_many_images_as_settings_say() -> None:
    pose = look_at((1.5, 0.2, 0.5), (0.0, 0.0, 0.1))
    full, empty = (true_depth(placed_bodies(solids), CAMERA, pose) for solids in ((*ROOM, WALL), ROOM))
    made = map_of((full, pose))
    at = np.array([[0.24, 0.0, 0.1]])
    assert made.look_up(at) == 3
    for left in (2, 1, 0, -1):
        made.integrate(empty, CAMERA, pose)
        assert made.look_up(at) == left
    assert made.look_up([[9.0, 0.0, 0.0]]) == 0
    made.integrate(full, CAMERA, pose)
    for _ in range(9):
        made.integrate(full, CAMERA, pose)
    assert made.look_up(at) == made.settings.longest
    made.decay(2)
    assert made.look_up(at) == made.settings.longest - 2
    free = made.free.sum()
    made.decay(100)
    assert not made.occupied.any() and made.free.sum() == free
    made.integrate(full, CAMERA, pose)
    made.clear(((0.2, -0.1, 0.0), (0.3, 0.1, 0.2)))
    box = np.abs(centers(made) - (0.25, 0.0, 0.1)) < (0.05, 0.1, 0.1)
    assert (made.evidence[box.all(axis=-1)] == 0).all() and made.occupied.any()
    made.clear()
    assert made.unknown.all()


def test_pixels_without_depth_say_nothing() -> None:
    _, pose = scene(0)
    made = map_of((np.zeros((120, 160)), pose), (np.full((120, 160), np.nan), pose))
    assert made.unknown.all()


def test_depths_in_millimeters_are_those_in_meters() -> None:
    solids, pose = scene(6)
    image = np.round(true_depth(solids, CAMERA, pose) * 1e3)
    first = map_of((image.astype(np.uint16), pose))  # type: ignore[arg-type]
    frame = OccupancyMap(BOUNDS, SIDE)
    frame.integrate(Frame(CAMERA.placed(pose), image * 1e-3))
    assert (first.evidence == map_of((image * 1e-3, pose)).evidence).all()
    assert (first.evidence == frame.evidence).mean() > 0.999  # a quaternion of the pose between
    scaled = CAMERA.model_copy(update={"depth": CAMERA.depth.model_copy(update={"scale": 0.8})})
    longer = map_of((image * 1e-3 / 0.8, pose), camera=scaled)
    assert (first.evidence == longer.evidence).mean() > 0.999


HELD = AttachedObject(name="held", box=(0.1, 0.1, 0.2), position=(0.0, 0.0, 0.45), link="lower")
FRONT = look_at((1.7, 0.3, 0.8), (0.0, 0.0, 0.4))


def frames(arm: Robot, q: np.ndarray, bodies: tuple[Obstacle, ...], *poses: np.ndarray) -> list[Frame]:
    """Frames of an arm that holds a box."""
    solids = placed_bodies(bodies) + placed_robot(arm, q, [HELD])
    joints = dict(zip(arm.joint_names, q.tolist(), strict=True))
    return [Frame(CAMERA.placed(pose), true_depth(solids, CAMERA, pose), joints=joints) for pose in poses]


def test_robot_and_held_objects_are_left_out(arm: Robot) -> None:
    q = arm.home
    (frame,) = frames(arm, q, ROOM, FRONT)
    bounds = ((-0.6, -0.8, -0.3), (0.8, 0.8, 1.3))
    own, stranger, empty_handed = (OccupancyMap(bounds, 0.04, robot) for robot in (arm, None, arm))
    own.integrate(frame, held=[HELD])
    stranger.integrate(frame)
    empty_handed.integrate(frame)
    assert not own.occupied.any()  # the room is outside of the box
    assert stranger.occupied.sum() > empty_handed.occupied.sum() > 5
    on_arm = stranger.occupied
    assert (own.evidence[on_arm] == 0).all() and own.free.sum() > 0.8 * stranger.free.sum()
    moved = OccupancyMap(bounds, 0.04, arm)
    moved.integrate(frame.depth, frame.camera, state=q + 0.5, held=[HELD])
    assert moved.occupied.any()


def test_a_camera_on_a_link_sees_from_where_the_link_is(arm: Robot) -> None:
    q = arm.home
    (frame,) = frames(arm, q, (*ROOM, WALL), FRONT)
    mount = np.linalg.inv(arm.link_pose(q, "lower")) @ FRONT
    carried = CAMERA.model_copy(update={"link": "lower"}).placed(mount)
    first, second = OccupancyMap(BOUNDS, SIDE, arm), OccupancyMap(BOUNDS, SIDE, arm)
    first.integrate(frame, held=[HELD])
    second.integrate(frame, carried, held=[HELD])
    assert first.occupied.any() and (first.evidence == second.evidence).mean() > 0.999


def test_worlds_block_what_is_occupied_or_not_known(arm: Robot) -> None:
    q = arm.home
    bounds = ((-0.6, -0.8, -0.3), (0.8, 0.8, 1.3))
    made = OccupancyMap(bounds, 0.05, arm)
    assert made.world() == ()
    for frame in frames(arm, q, (*ROOM, WALL), FRONT):
        made.integrate(frame, held=[HELD])
    assert (made.blocked() == made.occupied).all()
    blocked = made.blocked("blocked", q, held=[HELD])
    touched = made.touched(q, [HELD])
    assert (blocked == (made.occupied | (made.unknown & ~touched))).all() and (made.unknown & touched).any()
    rng = np.random.default_rng(2)
    states = rng.uniform(arm.limits.lower, arm.limits.upper, (150, arm.dof))
    free = {}
    for shape in ("points", "voxels"):
        for unknown in ("free", "blocked"):
            world = made.world(unknown, q, held=[HELD], shape=shape)  # type: ignore[arg-type]
            checker = CollisionChecker(arm, world, [HELD])
            free[shape, unknown] = checker.are_free(states)
            assert checker.are_free(q[None]).all()
    for unknown in ("free", "blocked"):
        assert not (free["points", unknown] & ~free["voxels", unknown]).any()  # the balls contain the voxels
    assert free["voxels", "free"].sum() > free["voxels", "blocked"].sum()
    reached = made.points("blocked", q, held=[HELD])
    assert len(reached) == blocked.sum() and (made.look_up(reached) >= 0).all()


def test_unknown_voxels_in_boxes_that_are_assumed_free_do_not_count(arm: Robot) -> None:
    made, box = OccupancyMap(BOUNDS, SIDE, arm), np.array([[-0.2, -0.3, 0.0], [0.4, 0.5, 0.52]])
    made.evidence[15, 20, 10] = 1  # in the box
    blocked = made.blocked("blocked", arm.home)
    inside = ((centers(made) > box[0]) & (centers(made) < box[1])).all(axis=-1)
    assumed = made.blocked("blocked", arm.home, assume_free=[box, box + 9.0])
    assert (
        (assumed == (blocked & ~inside | made.occupied)).all() and inside[15, 20, 10] and assumed.sum() < blocked.sum()
    )
    assert len(made.points("blocked", arm.home, assume_free=[box])) == assumed.sum()


def test_points_that_no_pixel_around_supports_do_not_count() -> None:
    pose = look_at((1.5, 0.2, 0.5), (0.0, 0.0, 0.1))
    image = true_depth(placed_bodies(ROOM), CAMERA, pose)
    rng = np.random.default_rng(0)
    lone = rng.random(image.shape) < 0.02
    flying = np.where(lone & (image > 0.0), 0.4 + 1.4 * rng.random(image.shape), image)
    settings: dict[str, Any] = {"least": 1, "share": 0.0, "stride": 1}
    clean = map_of((image, pose), support=0, **settings).occupied
    wrong = [(map_of((flying, pose), support=k, **settings).occupied & ~clean).sum() for k in (0, 3)]
    assert wrong[0] > 100 and wrong[1] < 0.05 * wrong[0]
    assert (map_of((image, pose), support=3, **settings).occupied & clean).sum() > 0.9 * clean.sum()


def test_what_appears_is_occupied_by_the_first_image_and_what_vanishes_is_freed(arm: Robot) -> None:
    made, joints = OccupancyMap(((-0.6, -0.8, -0.3), (0.8, 0.8, 1.3)), 0.04, arm), [arm.home, arm.home + 0.3]
    mount = np.linalg.inv(arm.link_pose(arm.home, "lower")) @ FRONT  # a camera that goes along
    post = Obstacle(name="post", box=(0.2, 0.2, 0.2), position=(0.45, 0.45, 0.2))
    at, count = [[0.54, 0.45, 0.2]], 0
    views = [(q, pose) for q in joints for pose in (arm.link_pose(q, "lower") @ mount, FRONT)]
    for q, pose in views[:2]:
        (frame,) = frames(arm, q, ROOM, pose)
        made.integrate(frame, held=[HELD])
    assert made.look_up(at) < 0
    (frame,) = frames(arm, joints[0], (*ROOM, post), views[0][1])
    made.integrate(frame, held=[HELD])
    assert made.look_up(at) == made.settings.persistence
    while made.look_up(at) >= 0:
        q, pose = views[count % len(views)]
        (frame,) = frames(arm, q, ROOM, pose)
        made.integrate(frame, held=[HELD])
        count += 1
        assert count <= made.settings.persistence + 1


@pytest.mark.parametrize("unknown", ["free", "blocked"])
def test_a_plan_among_what_was_seen_is_free_in_the_true_scene(tmp_path: Path, unknown: Any) -> None:
    problem = arm_problem(tmp_path)
    arm = load_robot(problem.robot)
    start, goal = (np.array([-0.9, 0.4, 0.6]), np.array([0.9, 0.4, 0.6]))
    solids = placed_bodies([*ROOM, *problem.scene]) + placed_robot(arm, start)
    settings = OccupancySettings(block=1, stride=1)  # the image is coarse
    made = OccupancyMap(((-1.2, -1.3, -0.4), (1.3, 1.3, 1.5)), 0.04, arm, settings)
    eyes = ((2.2, -0.8, 1.0), (2.2, 0.9, 1.0), (0.3, 1.9, 1.6), (-0.9, 1.6, 1.0), (0.3, -1.9, 1.6), (0.8, 0.4, 2.6))
    for eye in eyes:
        pose = look_at(eye, (0.2, 0.0, 0.5))
        made.integrate(true_depth(solids, CAMERA, pose), CAMERA, pose, start)
    planner = MotionPlanner(arm)
    planner.world.add(*made.world(unknown, start, margin=0.05))
    result = planner.plan(start, goal, timeout=20.0, seed=1)
    assert result and result.path is not None, result
    truth = CollisionChecker(arm, problem.scene, proofs=False)
    assert truth.are_free(result.path.sample(0.01)).all()
    straight = start + np.linspace(0.0, 1.0, 50)[:, None] * (goal - start)
    assert not truth.are_free(straight).all()  # the wall is between


def test_maps_are_saved_and_loaded(tmp_path: Path, arm: Robot) -> None:
    solids, pose = scene(7)
    made = map_of((true_depth(solids, CAMERA, pose), pose), least=1, persistence=4)
    made.save(tmp_path / "map.npz")
    again = OccupancyMap.load(tmp_path / "map.npz", arm)
    assert (again.evidence == made.evidence).all() and again.settings == made.settings and again.robot is arm
    assert (again.origin == made.origin).all() and again.resolution == made.resolution
    assert repr(again) == repr(made) and "28 x 32 x 24 voxels of 50 mm" in repr(made)
    assert again.bounds == pytest.approx(np.array(BOUNDS))


def test_files_that_are_no_maps_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "map.npz"
    file.write_text("none")
    with pytest.raises(FileFormatError, match="occupancy map"):
        OccupancyMap.load(file)
    made = OccupancyMap(BOUNDS, SIDE)
    made.evidence[0, 0, 0] = 50
    made.save(file)
    with pytest.raises(FileFormatError, match="evidence.*from -1 to 9.*50"):
        OccupancyMap.load(file)
    Frame(CAMERA, np.ones((120, 160))).save(file)
    with pytest.raises(FileFormatError):
        OccupancyMap.load(file)
    with pytest.raises(ApexError, match="missing.npz"):
        OccupancyMap.load(tmp_path / "missing.npz")


def test_maps_in_records_need_no_file(arm: Robot) -> None:
    points = np.array([[0.2, 0.0, 0.6], [0.3, 0.1, 0.6]])
    record = Obstacle(name="map", points=points_of(points, 0.05))
    again = validate(Obstacle, record.model_dump(mode="json", exclude_none=True), "obstacle")
    assert again == record
    near, far = (Obstacle(name="ball", sphere={"radius": 0.05}, position=tuple(place)) for place in points)
    rng = np.random.default_rng(3)
    states = rng.uniform(arm.limits.lower, arm.limits.upper, (200, arm.dof))
    pair = CollisionChecker(arm, [near, far.model_copy(update={"name": "other"})]).are_free(states)
    assert (CollisionChecker(arm, [again]).are_free(states) == pair).all() and not pair.all()
    with pytest.raises(FileFormatError, match="base64"):
        validate(Obstacle, {"name": "m", "points": {"file": "a.npy", "radius": 0.1, "content": "?"}}, "obstacle")


IMAGE = np.ones((120, 160))
FAULTS: list[tuple[Callable[[OccupancyMap, Robot], Any], str]] = [
    (lambda m, r: OccupancyMap(((0, 0, 0), (1, 1))), "bounds"),  # type: ignore[arg-type]
    (lambda m, r: OccupancyMap(((0, 0, 0), (1, 0, 1))), "bounds.*above the least"),
    (lambda m, r: OccupancyMap(((0, 0, 0), (1, np.nan, 1))), "bounds"),
    (lambda m, r: OccupancyMap(BOUNDS, 0.0), "resolution"),
    (lambda m, r: OccupancyMap(BOUNDS, 1e-4), "resolution.*50000000 voxels"),
    (lambda m, r: OccupancySettings(persistence=5, longest=4), "longest"),
    (lambda m, r: OccupancySettings(share=np.nan), "share"),
    (lambda m, r: m.integrate(IMAGE), "camera.*the camera of the depth image"),
    (lambda m, r: m.integrate(IMAGE[1:], CAMERA), "depth"),
    (lambda m, r: m.integrate(-IMAGE, CAMERA), "depth.*0 or more"),
    (lambda m, r: m.integrate(1000.0 * IMAGE, CAMERA), "depth.*meters"),
    (lambda m, r: m.integrate(IMAGE, CAMERA, 2.0 * np.eye(4)), "pose"),
    (lambda m, r: m.integrate(IMAGE, CAMERA.model_copy(update={"link": "hand"})), "pose.*'hand'"),
    (lambda m, r: OccupancyMap(BOUNDS, SIDE, r).integrate(IMAGE, CAMERA), "joints"),
    (lambda m, r: OccupancyMap(BOUNDS, SIDE, r).integrate(IMAGE, CAMERA, state=[0.0]), "state"),
    (lambda m, r: OccupancyMap(BOUNDS, SIDE, r).integrate(IMAGE, CAMERA, state=[np.nan] * 3), "state"),
    (lambda m, r: m.world("unsafe"), "unsafe.*blocked, free"),  # type: ignore[arg-type]
    (lambda m, r: m.world(shape="mesh"), "mesh.*points, voxels"),  # type: ignore[arg-type]
    (lambda m, r: m.world("blocked"), "start"),
    (lambda m, r: m.world("blocked", [0.0, 0.4, 0.6]), "robot"),
    (lambda m, r: OccupancyMap(BOUNDS, SIDE, r).touched([0.0]), "state"),
    (lambda m, r: OccupancyMap(BOUNDS, SIDE, r).touched(r.home, margin=-1.0), "margin"),
    (lambda m, r: OccupancyMap(BOUNDS, SIDE, r).world(goal=[0.0]), "goal"),
    (lambda m, r: OccupancyMap(BOUNDS, SIDE, r).points(goal=[[np.nan] * 3]), "goal"),
    (lambda m, r: m.points(goal=[0.0, 0.4, 0.6]), "robot"),
    (lambda m, r: OccupancyMap(BOUNDS, SIDE, r).world("blocked", r.home, assume_free=[[1.0]]), "assume_free"),
    (
        lambda m, r: OccupancyMap(BOUNDS, SIDE, r).world("blocked", r.home, assume_free=[[[1.0] * 3, [0.0] * 3]]),
        "above",
    ),
    (lambda m, r: OccupancySettings(support=9), "support"),
    (lambda m, r: m.decay(0), "steps"),
    (lambda m, r: m.clear(((0, 0, 0), (0, 0, 0))), "bounds"),
    (lambda m, r: m.look_up([1.0, 2.0]), "points"),
    (lambda m, r: points_of(np.empty((0, 3)), 0.1), "points"),
    (lambda m, r: points_of(np.zeros((1, 3)), 0.0), "radius"),
]


@pytest.mark.parametrize(("call", "words"), FAULTS, ids=[words for _, words in FAULTS])
def test_bad_input_is_named(arm: Robot, call: Callable[[OccupancyMap, Robot], Any], words: str) -> None:
    made = OccupancyMap(BOUNDS, SIDE)
    with pytest.raises(ApexError, match=words):
        call(made, arm)
    assert made.unknown.all()


def test_a_held_object_of_an_unknown_link_is_named(arm: Robot) -> None:
    made = OccupancyMap(BOUNDS, SIDE, arm)
    stray = HELD.model_copy(update={"link": "finger"})
    with pytest.raises((ParameterError, SceneError, ApexError), match="finger"):
        made.integrate(IMAGE, CAMERA, state=arm.home, held=[stray])
    assert made.unknown.all()
    made.integrate(IMAGE, CAMERA, state=arm.home)  # and the map goes on
