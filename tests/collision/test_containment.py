"""Meshes as solids, and what is wholly inside of something."""

from __future__ import annotations

import coal
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull
from support import CUBE_OBJ, states_around_home

from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.containment import Extent
from apex_ompl.kernel.compiled.geometry.triangles import encloses
from apex_ompl.robot import Robot
from apex_ompl.robot.geometry import link_of
from apex_ompl.scene.bodies import AttachedObject, Obstacle
from apex_ompl.scene.meshes import triangles, winding_number


@pytest.mark.parametrize(
    "shape",
    [{"box": (0.02, 0.02, 0.02)}, {"sphere": {"radius": 0.02}}, {"cylinder": {"radius": 0.02, "length": 0.04}},
     {"capsule": {"radius": 0.02, "length": 0.02}}],
)  # fmt: skip
def test_an_obstacle_wholly_inside_a_link_is_a_collision(robot: Robot, shape: dict) -> None:
    for link in (f"{side}_link{k}" for side in ("left", "right") for k in range(1, 6)):
        item = next(g for g in robot.geometry.geometryObjects if link_of(robot.model, g) == link)
        vertices, _ = triangles(item.geometry)
        center = robot.link_pose(robot.home, link) @ item.placement.homogeneous @ [*vertices.mean(axis=0), 1.0]
        checker = CollisionChecker(robot, [Obstacle(name="seed", position=tuple(center[:3]), **shape)])
        # Nothing touches the surface ...
        assert surface_contacts(checker, robot.home) == []
        # ... and still the state is not free, also after the obstacle was moved away and back.
        assert not checker.is_free(robot.home)
        assert "seed" in (c.second for c in checker.contacts(robot.home))
        checker.move("seed", (0.0, 0.0, 3.0))
        assert checker.is_free(robot.home)
        checker.move("seed", tuple(center[:3]))
        assert not checker.is_free(robot.home)


def surface_contacts(checker: CollisionChecker, q: np.ndarray) -> list[tuple[str, str]]:
    """The pairs that overlap by meshes and primitives alone, without the cases of containment."""
    model, solids = checker.robot.model, checker.meshes.solids
    data, found = model.createData(), []
    pin.forwardKinematics(model, data, checker.robot.to_pinocchio(q))
    for a, b in checker.meshes.pairs:
        sides = []
        for solid in (solids[a], solids[b]):
            pose = data.oMi[solid.joint] * solid.placement
            sides += [solid.shape, coal.Transform3s(pose.rotation, pose.translation)]
        if coal.collide(*sides, coal.CollisionRequest(), coal.CollisionResult()):
            found.append((solids[a].name, solids[b].name))
    return found


def u_shape_obj(scale: float) -> str:
    """A solid U of 3 x 3 x 3 units: legs and bottom 1 unit wide, the notch open towards +y."""
    outline = [(0, 0), (3, 0), (3, 3), (2, 3), (2, 1), (1, 1), (1, 3), (0, 3)]
    lines = [f"v {x * scale} {y * scale} {z * scale}" for z in (0, 3) for x, y in outline]
    n = len(outline)
    cap = [(0, 1, 4), (0, 4, 5), (1, 2, 3), (1, 3, 4), (0, 5, 6), (0, 6, 7)]
    faces = [(c, b, a) for a, b, c in cap] + [(a + n, b + n, c + n) for a, b, c in cap]
    for k in range(n):
        j = (k + 1) % n
        faces += [(k, j, j + n), (k, j + n, k + n)]
    return "\n".join([*lines, *(f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces)]) + "\n"


def test_a_link_inside_a_hollow_mesh_obstacle_is_a_collision_and_its_notch_is_not(robot: Robot, tmp_path) -> None:
    file = tmp_path / "u.obj"
    file.write_text(u_shape_obj(4.0))
    u = Obstacle(name="u", mesh={"file": str(file)}, position=(-6.0, -2.0, -6.0))
    checker = CollisionChecker(robot, [u])  # all of the robot in the solid bottom of the U
    assert not surface_contacts(checker, robot.home)
    assert not checker.is_free(robot.home)
    assert {c.second for c in checker.contacts(robot.home)} == {"u"}
    checker.move("u", (-6.0, -8.0, -6.0))  # all of it in the notch, inside the mesh's convex hull
    assert not surface_contacts(checker, robot.home)
    assert checker.is_free(robot.home)
    assert checker.contacts(robot.home) == []


def test_a_held_object_inside_the_other_arm_is_a_collision(robot: Robot) -> None:
    held = AttachedObject(name="pill", link="left_hand_palm", sphere={"radius": 0.01})
    item = next(g for g in robot.geometry.geometryObjects if link_of(robot.model, g) == "right_link4")
    vertices, _ = triangles(item.geometry)
    inside = robot.link_pose(robot.home, "right_link4") @ item.placement.homogeneous @ [*vertices.mean(axis=0), 1.0]
    local = np.linalg.inv(robot.link_pose(robot.home, "left_hand_palm")) @ inside
    checker = CollisionChecker(robot, (), [held.model_copy(update={"position": tuple(local[:3])})])
    assert not checker.is_free(robot.home)
    assert [(c.first, c.second) for c in checker.contacts(robot.home)] == [("right_link4", "pill")]


def test_links_never_hide_in_each_other(robot: Robot) -> None:
    """The reason why links are no guests of each other: where one is inside another, the checker knows."""
    checker = CollisionChecker(robot)
    items = list(robot.geometry.geometryObjects)
    meshes = {
        i: np.array(triangles(g.geometry)[0])[triangles(g.geometry)[1]]
        for i, g in enumerate(items)
        if g.meshPath.endswith("stl")
    }
    data = robot.model.createData()
    rng = np.random.default_rng(5)
    for q in robot.random_state(rng, 25):
        pin.forwardKinematics(robot.model, data, robot.to_pinocchio(q))
        poses = [data.oMi[g.parentJoint] * g.placement for g in items]
        inside = False
        for pair in robot.geometry.collisionPairs:
            for outer, inner in ((pair.first, pair.second), (pair.second, pair.first)):
                if outer in meshes and inner not in meshes:
                    point = poses[outer].actInv(poses[inner].translation)
                    inside |= abs(winding_number(point, meshes[outer])) > 0.5
        assert not (inside and checker.is_free(q))


@settings(max_examples=60)
@given(st.lists(st.floats(-1.5, 1.5), min_size=3, max_size=3))
def test_winding_number_tells_inside_from_outside_of_a_convex_mesh(point: list[float]) -> None:
    cloud = np.random.default_rng(1).normal(size=(40, 3))
    hull = ConvexHull(cloud)
    a, b, c = np.moveaxis(cloud[hull.simplices], 1, 0)
    outward = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) > 0
    faces = np.where(outward[:, None], hull.simplices, hull.simplices[:, ::-1])
    heights = hull.equations[:, :3] @ point + hull.equations[:, 3]
    if np.abs(heights).min() < 1e-6:
        return
    winding = winding_number(np.array(point), cloud[faces])
    assert winding == pytest.approx(1.0 if heights.max() < 0 else 0.0, abs=1e-6)


def parse_obj(text: str) -> np.ndarray:
    """Corners of the triangles of OBJ text, shape (T, 3, 3)."""
    rows = [line.split() for line in text.splitlines()]
    vertices = np.array([row[1:] for row in rows if row[0] == "v"], float)
    return vertices[np.array([row[1:] for row in rows if row[0] == "f"], int) - 1]


def enclosed(corners: np.ndarray, point: np.ndarray, watertight: bool) -> bool:
    box = np.stack([corners.min(axis=(0, 1)), corners.max(axis=(0, 1))])
    return bool(encloses(np.ascontiguousarray(corners), box, watertight, *point.tolist()))


@settings(max_examples=80, deadline=None)
@given(seed=st.integers(0, 10_000), hole=st.booleans(), inside_out=st.booleans())
def test_compiled_containment_decides_as_the_winding_number_does(seed: int, hole: bool, inside_out: bool) -> None:
    """Rays through corners and along faces among it: half of the points have coordinates of corners."""
    rng = np.random.default_rng(seed)
    corners = parse_obj(u_shape_obj(1.0))
    if rng.random() < 0.5:
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        corners = corners @ (turn * np.sign(np.linalg.det(turn))).T * rng.uniform(0.01, 10.0)
    corners = corners[:, ::-1] if inside_out else corners
    corners = np.delete(corners, rng.integers(len(corners)), axis=0) if hole else corners
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    points = rng.uniform(low - 0.1, high + 0.1, (60, 3))
    exact = rng.random(points.shape) < 0.5
    points[exact] = corners.reshape(-1, 3)[rng.integers(3 * len(corners), size=60)][exact]
    inside, surface = 0, surface_of(corners)
    for point in points:
        if distance_to(surface, point) < 1e-6:
            continue  # on the surface nothing is promised
        turns = abs(winding_number(point, corners))
        if abs(turns - 0.5) < 1e-9:
            continue  # in the plane of the hole, whose border is that of the solid
        expected = turns > 0.5
        assert enclosed(corners, point, watertight=False) == expected
        assert hole or enclosed(corners, point, watertight=True) == expected
        inside += expected
    assert inside > 0 or hole


def distance_to(surface: coal.BVHModelBase, point: np.ndarray) -> float:
    at, request = coal.Transform3s(np.eye(3), point), coal.DistanceRequest()
    ball, result = coal.Sphere(1e-9), coal.DistanceResult()
    return coal.distance(surface, coal.Transform3s.Identity(), ball, at, request, result)


def surface_of(corners: np.ndarray) -> coal.BVHModelBase:
    surface = coal.BVHModelOBBRSS()
    surface.beginModel(len(corners), 3 * len(corners))
    surface.addVertices(corners.reshape(-1, 3))
    surface.addTriangles(np.arange(3 * len(corners)).reshape(-1, 3))
    surface.endModel()
    return surface


def test_sizes_that_cannot_fit_are_not_looked_at(robot: Robot) -> None:
    link = next(g.geometry for g in robot.geometry.geometryObjects if g.name.startswith("left_link5"))
    size = Extent.of(link)
    assert size.may_contain(Extent.of(coal.Box(0.05, 0.05, 0.05)))
    assert not size.may_contain(Extent.of(coal.Box(0.4, 0.4, 0.4)))
    assert not size.may_contain(Extent.of(coal.Halfspace(np.array([0.0, 0.0, 1.0]), 0.0)))


def test_meshes_in_stl_and_obj_collide_like_the_box_they_are(robot: Robot, tmp_path) -> None:
    obj = tmp_path / "cube.obj"
    obj.write_text(CUBE_OBJ)
    stl = tmp_path / "cube.stl"
    vertices, faces = triangles(coal.MeshLoader().load(str(obj), np.ones(3)))
    facets = []
    for a, b, c in vertices[faces]:
        n = np.cross(b - a, c - a)
        points = "\n".join(f"vertex {p[0]} {p[1]} {p[2]}" for p in (a, b, c))
        facets.append(f"facet normal {n[0]} {n[1]} {n[2]}\nouter loop\n{points}\nendloop\nendfacet")
    stl.write_text("solid cube\n" + "\n".join(facets) + "\nendsolid cube\n")
    rng = np.random.default_rng(2)
    size, corner = (0.3, 0.2, 0.5), np.array([0.35, -0.1, 0.1])
    box = CollisionChecker(robot, [Obstacle(name="b", box=size, position=tuple(corner + np.array(size) / 2))])
    states = states_around_home(robot, rng, 150, 0.7)
    expected = [box.is_free(q) for q in states]
    assert 0.1 < np.mean(expected) < 0.9
    for file in (obj, stl):
        mesh = CollisionChecker(
            robot, [Obstacle(name="m", mesh={"file": str(file), "scale": size}, position=tuple(corner))]
        )
        assert [mesh.is_free(q) for q in states] == expected


def cube(at: tuple[float, float, float], edge: float, first: int) -> tuple[list[str], list[str]]:
    """Vertices and faces of a cube as OBJ lines; ``first`` is the number of its first vertex."""
    lines = CUBE_OBJ.splitlines()
    points = [[float(v) * edge + c for v, c in zip(x.split()[1:], at, strict=True)] for x in lines if x[0] == "v"]
    faces = [[int(v) + first - 1 for v in x.split()[1:]] for x in lines if x[0] == "f"]
    return [f"v {x} {y} {z}" for x, y, z in points], [f"f {a} {b} {c}" for a, b, c in faces]


@pytest.mark.parametrize("swapped", [False, True])
def test_each_piece_of_a_mesh_is_looked_for_inside_links(robot: Robot, tmp_path, swapped: bool) -> None:
    item = next(g for g in robot.geometry.geometryObjects if link_of(robot.model, g) == "left_link4")
    vertices, _ = triangles(item.geometry)
    inside = robot.link_pose(robot.home, "left_link4") @ item.placement.homogeneous @ [*vertices.mean(axis=0), 1.0]
    places = [tuple(inside[:3] - 0.01), (3.0, 3.0, 3.0)]
    pieces = [cube(at, 0.02, 1 + 8 * k) for k, at in enumerate(places[::-1] if swapped else places)]
    file = tmp_path / "two.obj"
    file.write_text("\n".join([*(x for p in pieces for x in p[0]), *(x for p in pieces for x in p[1])]) + "\n")
    checker = CollisionChecker(robot, [Obstacle(name="two", mesh={"file": str(file)})])
    assert surface_contacts(checker, robot.home) == []
    assert not checker.is_free(robot.home)
