"""Point clouds as obstacles, against Coal point by point."""

from __future__ import annotations

import gc
import os
from pathlib import Path

import coal
import numpy as np
import pinocchio as pin
import pytest
import trimesh
from geometry_files import bumpy_sphere
from hypothesis import given, settings
from hypothesis import strategies as st
from support import ROOT, states_around_home

from apex_ompl import MotionPlanner, filter_points, points_from_depth, scene
from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.cloud_contact import signed_distances, touches
from apex_ompl.collision.cover.spheres import shape_key
from apex_ompl.collision.shapes import PointCloud, cloud_geometry, is_shell, is_surface, mesh_geometry
from apex_ompl.errors import ApexError, FileFormatError, MissingFileError, ParameterError, SceneError
from apex_ompl.planning.cloud_files import CloudFiles
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject, Obstacle
from apex_ompl.scene.meshes import triangles, winding_number
from apex_ompl.scene.points import parse_points


def cloud_file(folder: Path, points: np.ndarray) -> str:
    np.save(folder / "cloud.npy", points)
    return str(folder / "cloud.npy")


def touched(robot: Robot, q: np.ndarray, points: np.ndarray, radius: float) -> bool:
    """By Coal, ball by ball, and by winding numbers of the balls' centers."""
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, robot.to_pinocchio(q))
    for item in robot.geometry.geometryObjects:
        if item.parentJoint == 0:
            continue
        at = data.oMi[item.parentJoint] * item.placement
        item.geometry.computeLocalAABB()
        local = (points - at.translation) @ at.rotation
        box = item.geometry.aabb_local
        near = local[((local >= box.min_ - radius) & (local <= box.max_ + radius)).all(axis=1)]
        corners = np.empty((0, 3, 3))
        if is_shell(item.geometry):
            vertices, faces = triangles(item.geometry)
            corners = vertices[faces]
        for point in near:
            ball = coal.Transform3s(np.eye(3), point)
            result = coal.CollisionResult()
            if coal.collide(
                item.geometry, coal.Transform3s(), coal.Sphere(radius), ball, coal.CollisionRequest(), result
            ):
                return True
            if len(corners) and abs(winding_number(point, corners)) > 0.5:
                return True
    return False


@settings(max_examples=6)
@given(seed=st.integers(0, 10**6), radius=st.sampled_from([0.002, 0.01, 0.03]))
def test_states_touch_a_cloud_where_a_ball_touches_a_link(
    robot: Robot, tmp_path_factory: pytest.TempPathFactory, seed: int, radius: float
) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform([0.1, -0.5, 0.3], [0.7, 0.5, 0.9], (int(rng.integers(1, 120)), 3))
    file = cloud_file(tmp_path_factory.mktemp("cloud"), points)
    cloud = Obstacle(name="cloud", points={"file": file, "radius": radius})
    checker, bare = CollisionChecker(robot, [cloud]), CollisionChecker(robot)
    states = [q for q in states_around_home(robot, rng, 25) if bare.is_free(q)]
    expected = [touched(robot, q, points, radius) for q in states]
    assert checker.are_free(np.array(states)).tolist() == [not hit for hit in expected]
    assert [not checker.contacts(q) for q in states] == [not hit for hit in expected]
    for q, hit in zip(states, expected, strict=True):
        assert (checker.clearance(q) > 0.0) == (not hit)


def test_clearance_to_a_cloud_is_the_least_distance_of_its_balls(robot: Robot, tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    points = rng.uniform([0.5, -0.2, 0.2], [0.8, 0.2, 0.5], (40, 3))
    file = cloud_file(tmp_path, points)
    cloud = CollisionChecker(robot, [Obstacle(name="c", points={"file": file, "radius": 0.01})])
    balls = [Obstacle(name=f"b{k}", sphere={"radius": 0.01}, position=tuple(p)) for k, p in enumerate(points)]
    checker = CollisionChecker(robot, balls)
    states = [q for q in states_around_home(robot, rng, 12) if checker.is_free(q)]
    for q in states:
        assert cloud.clearance(q) == pytest.approx(checker.clearance(q), abs=2e-6)
        assert cloud.obstacle_distance(q[None]) == pytest.approx(checker.obstacle_distance(q[None]), abs=2e-6)
        assert cloud.distance(q).value == pytest.approx(checker.distance(q).value, abs=1e-6)
        assert cloud.obstacle_point(q) == pytest.approx(checker.obstacle_point(q), abs=1e-4)
    for a, b in zip(states, states[1:], strict=False):
        path = np.stack([a, b])
        assert bool(cloud.prove(path)) == bool(checker.prove(path))
        if cloud.prove(path):
            assert cloud.prove(path).clearance == pytest.approx(checker.prove(path).clearance, abs=2e-3)
            assert all(cloud.is_free(q) for q in np.linspace(a, b, 200))


def test_a_ball_inside_of_a_link_is_found(robot: Robot, tmp_path: Path) -> None:
    q = robot.home
    middle = robot.link_pose(q, "left_link5") @ np.array([0.0, 0.05, -0.15, 1.0])
    free = CollisionChecker(robot).is_free(q)
    points = middle[:3] + np.zeros((1, 3))
    checker = CollisionChecker(
        robot, [Obstacle(name="c", points={"file": cloud_file(tmp_path, points), "radius": 1e-4})]
    )
    assert free and checker.is_free(q) == (not touched(robot, q, points, 1e-4))


@settings(max_examples=20)
@given(seed=st.integers(0, 10**6))
def test_distances_of_points_from_solids(seed: int) -> None:
    rng = np.random.default_rng(seed)
    sizes = rng.uniform(0.02, 0.3, 3)
    vertices, faces = bumpy_sphere(8, 0.15, float(rng.uniform(0.0, 0.4)))
    shapes = [
        coal.Box(*sizes), coal.Sphere(sizes[0]), coal.Cylinder(sizes[0], sizes[1]), coal.Capsule(sizes[0], sizes[1]),
        mesh_geometry(vertices, faces),
    ]  # fmt: skip
    points = rng.uniform(-0.4, 0.4, (30, 3))
    for shape in shapes:
        found = signed_distances(shape, points, np.inf)
        for point, distance in zip(points, found, strict=True):
            at = coal.Transform3s(np.eye(3), point)
            apart = coal.distance(
                shape, coal.Transform3s(), coal.Sphere(1e-9), at, coal.DistanceRequest(), coal.DistanceResult()
            )
            if distance > 1e-6:
                assert apart == pytest.approx(distance, abs=1e-6)
            elif isinstance(shape, coal.Cylinder):
                assert apart <= 1e-6, "Coal's depths of cylinders are too large"
            elif shape is not shapes[-1]:
                assert apart == pytest.approx(distance, abs=1e-3)
            else:
                assert abs(winding_number(point, vertices[faces])) > 0.5


def test_a_surface_has_no_inside() -> None:
    vertices, faces = bumpy_sphere(8, 0.15, 0.2)
    solid, alone = mesh_geometry(vertices, faces), mesh_geometry(vertices.copy(), faces.copy())
    is_surface.keep(alone, True)
    cloud = cloud_geometry(PointCloud(np.zeros((1, 3)), 0.01))
    assert signed_distances(solid, np.zeros((1, 3)), np.inf) == -signed_distances(alone, np.zeros((1, 3)), np.inf) < 0.0
    assert touches(cloud, solid, pin.SE3.Identity()) and not touches(cloud, alone, pin.SE3.Identity())
    assert touches(cloud, alone, pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.155]))), "near the pole"
    assert shape_key(solid) != shape_key(alone)


def test_files_of_points(tmp_path: Path) -> None:
    points = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    single = points.astype(float)
    np.save(tmp_path / "a.npy", points)
    trimesh.PointCloud(points).export(tmp_path / "a.ply")
    head = "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
    head += "WIDTH 50\nHEIGHT 1\n"
    head += "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 50\nDATA "
    rows = np.concatenate([points, np.ones((50, 1), np.float32)], axis=1)
    text = "\n".join(" ".join(map(repr, row)) for row in rows.astype(float).tolist())
    (tmp_path / "a.pcd").write_text(head + "ascii\n" + text + "\n")
    (tmp_path / "b.pcd").write_bytes((head + "binary\n").encode() + rows.tobytes())
    for name in ("a.npy", "a.ply", "a.pcd", "b.pcd"):
        assert parse_points(name, (tmp_path / name).read_bytes()) == pytest.approx(single, abs=1e-6)


def test_compressed_points() -> None:
    """The file was packed by LibLZF."""
    points = np.random.default_rng(0).normal(size=(400, 3)).astype(np.float32)
    points[:, 2] = np.repeat(points[:40, 2], 10)
    content = (ROOT / "tests" / "data" / "compressed.pcd").read_bytes()
    assert np.array_equal(parse_points("a.pcd", content), points)
    at = content.index(b"binary_compressed\n") + 26
    for broken in (content[:-5], content[:at] + b"\xff\xff\xff" + content[at:]):
        with pytest.raises(FileFormatError, match="expected a cloud of points"):
            parse_points("a.pcd", broken)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.npy", b"", "an empty file"),
        ("a.npy", b"hello", "expected a cloud of points"),
        ("a.ply", b"hello", "expected a cloud of points"),
        ("a.pcd", b"FIELDS x y z\nDATA binary_compressed\n", "expected a cloud of points"),
    ],
)
def test_faulty_files_of_points(name: str, content: bytes, words: str) -> None:
    with pytest.raises(FileFormatError, match=words):
        parse_points(name, content)


@pytest.mark.parametrize(
    ("points", "words"),
    [
        (np.empty((0, 3)), "expected one point or more"),
        (np.ones((4, 2)), "expected one point or more"),
        (np.array([[0.0, 0.0, 0.0], [0.0, np.nan, 0.0]]), "point 1"),
        (np.array([[1e9, 0.0, 0.0]]), "point 0"),
    ],
)
def test_faulty_points(robot: Robot, tmp_path: Path, points: np.ndarray, words: str) -> None:
    body = Obstacle(name="c", points={"file": cloud_file(tmp_path, points), "radius": 0.01})
    with pytest.raises(FileFormatError, match=words):
        CollisionChecker(robot, [body])


def test_clouds_are_files_with_a_radius_and_are_not_held(robot: Robot, tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="file of points ending in"):
        Obstacle(name="c", points={"file": "a.xyz", "radius": 0.01})
    with pytest.raises(FileFormatError, match="points cannot be held"):
        AttachedObject(name="c", points={"file": "a.npy", "radius": 0.01}, link="left_hand_palm")
    with pytest.raises(MissingFileError, match="nowhere"):
        CollisionChecker(robot, [Obstacle(name="c", points={"file": str(tmp_path / "nowhere.npy"), "radius": 0.01})])


def test_clouds_of_a_world_are_replaced(robot: Robot, tmp_path: Path) -> None:
    rng, q = np.random.default_rng(0), robot.home
    palm = robot.link_pose(q, "left_hand_palm")[:3, 3]
    with MotionPlanner() as planner:
        world = planner.world
        for k in range(12):
            world.set_points("seen", palm + rng.normal(0.0, 0.01, (50, 3)) + [0.0, 0.0, 2.0 * (k % 2)], 0.002)
            assert bool(planner.check(q)) == (k % 2 == 1)
        assert len(list(Path(world.obstacles["seen"].points.file).parent.iterdir())) == 10
        world.set_points("seen", palm[None], 0.01)
        hit = {contact.first for contact in planner.check(q).contacts}
        for link in hit:
            world.allow(link, "seen")
        world.set_points("seen", palm[None] + 1e-4, 0.01, file=tmp_path / "kept.npy")
        assert planner.check(q) and (tmp_path / "kept.npy").is_file(), "allowed pairs are kept"
        world.add(name="post", sphere={"radius": 0.1}, position=(0.0, 0.0, 3.0))
        before = world.obstacles["seen"]
        for arguments, error, words in (
            (("post", palm[None], 0.01), SceneError, "no cloud of points"),
            (("seen", palm, 0.01), ParameterError, r"shape \(N, 3\)"),
            (("seen", palm[None], -1.0), FileFormatError, "radius"),
            (("seen", np.empty((0, 3)), 0.01), FileFormatError, "one point or more"),
            (("seen", palm[None] * np.nan, 0.01), ParameterError, "finite"),
            (("seen", palm[None], 0.01, "a.txt"), ParameterError, "npy"),
        ):
            with pytest.raises(error, match=words):
                world.set_points(*arguments)
        assert world.obstacles["seen"] is before
        folder = Path(world._clouds.path(None)).parent
    del planner, world
    gc.collect()
    assert not folder.exists()


def test_a_forked_process_leaves_the_clouds_of_its_parent() -> None:
    files, point = CloudFiles(), np.zeros((1, 3))
    first = files.path(None)
    files.write(point, first, ())
    read, write = os.pipe()
    if (child := os.fork()) == 0:
        try:
            own = files.path(None)
            files.write(point, own, ())
            os.write(write, f"{own} {own.exists()}".encode())
            del files  # as at the end of the process
            gc.collect()
        finally:
            os._exit(0)
    os.waitpid(child, 0)
    own, written = os.read(read, 1000).decode().split()
    assert written == "True" and Path(own).parent != first.parent and not Path(own).parent.exists()
    assert first.exists()
    files.write(point, files.path(None), ())
    del files
    gc.collect()
    assert not first.parent.exists()


def test_depth_images_become_points() -> None:
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.5, 3.0, (40, 60))
    depth[3, 4], depth[0, 0], depth[5, 5] = np.nan, 0.0, 9.0
    pose = np.eye(4)
    pose[:3, :3] = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    pose[:3, 3] = 0.1, 0.2, 1.5
    assert points_from_depth is scene.points_from_depth
    points = points_from_depth(depth, (50.0, 52.0, 29.5, 19.5), pose)
    assert points.shape == (40 * 60 - 3, 3)
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    columns, rows = local[:, 0] / local[:, 2] * 50.0 + 29.5, local[:, 1] / local[:, 2] * 52.0 + 19.5
    assert depth[rows.round().astype(int), columns.round().astype(int)] == pytest.approx(local[:, 2])
    assert len(points_from_depth(depth, (50.0, 52.0, 29.5, 19.5), pose, stride=4)) == 10 * 15 - 1
    assert np.allclose(points[:, 0], pose[0, 3] + local[:, 2]), "the camera looks along x"
    for change, words in (
        ({"depth": np.ones(3)}, "depth"), ({"intrinsics": (0.0, 1.0, 1.0, 1.0)}, "focal"), ({"stride": 0}, "stride"),
        ({"range": (2.0, 1.0)}, "range"), ({"pose": np.eye(3)}, "pose"),
    ):  # fmt: skip
        given = {"depth": depth, "intrinsics": (50.0, 52.0, 29.5, 19.5), "pose": pose, **change}
        with pytest.raises(ParameterError, match=words):
            points_from_depth(**given)  # type: ignore[arg-type]


def test_points_on_the_robot_are_left_out(robot: Robot) -> None:
    q, rng = robot.home, np.random.default_rng(0)
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, robot.to_pinocchio(q))
    on = []
    for item in robot.geometry.geometryObjects:
        if not is_shell(item.geometry):
            continue
        vertices, faces = triangles(item.geometry)
        at = data.oMi[item.parentJoint] * item.placement
        chosen = vertices[faces[rng.integers(len(faces), size=20)]].mean(axis=1) + rng.normal(size=(20, 3)) * 1e-3
        on.append(chosen @ at.rotation.T + at.translation)
    cup = AttachedObject(
        name="cup", link="left_hand_palm", cylinder={"radius": 0.03, "length": 0.1}, position=(0, 0, 0.3)
    )
    held = robot.link_pose(q, "left_hand_palm") @ cup.pose
    far = rng.uniform(-1.0, 1.0, (300, 3)) + [0.0, 0.0, 4.0]
    points = np.concatenate([*on, held[:3, 3][None], far])
    assert filter_points(points, robot, q, 0.01, [cup]).tolist() == far.tolist()
    assert len(filter_points(points, robot, q, 0.01)) == len(far) + 1
    with pytest.raises(ParameterError, match="margin"):
        filter_points(points, robot, q, -1.0)
    with pytest.raises(ParameterError, match="state"):
        filter_points(points, robot, q[:3])


def test_files_of_clouds_that_are_there_stay_and_faulty_clouds_write_none(robot: Robot, tmp_path: Path) -> None:
    with MotionPlanner(robot) as planner:
        world, far = planner.world, np.array([[0.0, 0.0, 3.0]])
        world.set_points("first", far, 0.01)
        for k in range(30):
            world.set_points("seen", far + 0.1 + 0.01 * k, 0.01)
        files = [Path(world.obstacles[name].points.file) for name in ("first", "seen")]
        assert all(file.is_file() for file in files) and len(list(files[0].parent.iterdir())) < 20
        kept = tmp_path / "scan.npy"
        world.set_points("scan", far, 0.01, file=kept)
        world.add(name="box", box=(0.1, 0.1, 0.1), position=(0.0, 0.0, 3.0))
        before = kept.read_bytes()
        wrong = ("scan", far, -1.0), ("scan", far[:0], 0.01), ("box", far + 1.0, 0.01), ("left_link3", far + 1.0, 0.01)
        for name, points, radius in wrong:
            with pytest.raises(ApexError):
                world.set_points(name, points, radius, file=kept)
            assert kept.read_bytes() == before
