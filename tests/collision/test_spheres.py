from __future__ import annotations

import json
from pathlib import Path

import coal
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull, Delaunay

from apex_ompl.collision.cover.solids import solid_of
from apex_ompl.collision.cover.spheres import Cover, make_cover, quality, read_covers, shape_key, unproved, write_covers
from apex_ompl.errors import FileFormatError, MissingFileError, ParameterError
from apex_ompl.robot import load_robot
from apex_ompl.robot.config import DATA
from apex_ompl.scene.meshes import triangles, winding_number

NAMES = ("dual_panda_softhand", "baxter")
CASES = [(name, key) for name in NAMES for key in read_covers(DATA / f"{name}.spheres.json")]


@pytest.fixture(scope="module")
def shapes() -> dict[str, dict[str, coal.CollisionGeometry]]:
    return {
        name: {shape_key(item.geometry): item.geometry for item in load_robot(name).geometry.geometryObjects}
        for name in NAMES
    }


def held(cover: Cover, points: np.ndarray) -> np.ndarray:
    """Which points lie in a leaf and in every ball above it."""
    inside = np.linalg.norm(points[:, None] - cover.centers, axis=2) <= cover.radii
    for k in range(1, len(cover.radii)):
        inside[:, k] &= inside[:, cover.parents[k]]
    return inside[:, cover.count == 0].any(axis=1)


def inner_points(geometry: coal.CollisionGeometry, rng: np.random.Generator, count: int = 4000) -> np.ndarray:
    """Points of a solid, found without any code of the covers; those of its surface are among them."""
    kind = geometry.getNodeType()
    if geometry.getObjectType() == coal.OT_BVH:
        vertices, faces = triangles(geometry)
        weights = rng.dirichlet(np.ones(3), (count, 1))
        surface = (vertices[faces[rng.integers(len(faces), size=count)]] * weights.swapaxes(1, 2)).sum(axis=1)
        hull = ConvexHull(vertices)
        points = rng.uniform(vertices.min(axis=0), vertices.max(axis=0), (count, 3))
        if hull.volume < 1.001 * geometry.computeVolume():
            solid = points[Delaunay(vertices).find_simplex(points) >= 0]
        else:
            solid = np.array([p for p in points[:200] if abs(winding_number(p, vertices[faces])) > 0.9])
        return np.concatenate([vertices, surface, solid])
    half = geometry.halfSide if kind == coal.GEOM_BOX else np.ones(3) * geometry.radius
    if kind in (coal.GEOM_CYLINDER, coal.GEOM_CAPSULE):
        half = half + [0, 0, geometry.halfLength]
    points = rng.uniform(-1.0, 1.0, (count, 3)) * half
    if kind == coal.GEOM_BOX:
        return np.concatenate([points, np.sign(points) * half])
    across = np.hypot(points[:, 0], points[:, 1])
    if kind == coal.GEOM_CYLINDER:
        turn = rng.uniform(0, 2 * np.pi, count)
        rim = np.stack([geometry.radius * np.cos(turn), geometry.radius * np.sin(turn), 0 * turn], axis=1)
        rim[:, 2] = np.where(turn > np.pi, 1, -1) * geometry.halfLength
        return np.concatenate([points[(across <= geometry.radius) & (abs(points[:, 2]) <= geometry.halfLength)], rim])
    length = geometry.halfLength if kind == coal.GEOM_CAPSULE else 0.0
    return points[np.hypot(across, np.maximum(abs(points[:, 2]) - length, 0.0)) <= geometry.radius]


def changed(cover: Cover, **columns: np.ndarray) -> Cover:
    fields = {"centers": cover.centers, "radii": cover.radii, "first": cover.first, "count": cover.count}
    return Cover(**fields | columns)


def moved_away(cover: Cover, ball: int) -> Cover:
    centers = cover.centers.copy()
    centers[ball] += 100.0
    return changed(cover, centers=centers)


def extruded(outline: list[tuple[float, float]], height: float) -> coal.BVHModelOBBRSS:
    """A prism over an outline that is star-shaped from its first corner, counter-clockwise."""
    n = len(outline)
    vertices = [np.array([x, y, z]) for z in (0.0, height) for x, y in outline]
    faces = []
    for k in range(1, n - 1):
        faces += [(0, k + 1, k), (n, n + k, n + k + 1)]
    for k in range(n):
        j = (k + 1) % n
        faces += [(k, j, n + j), (k, n + j, n + k)]
    model = coal.BVHModelOBBRSS()
    model.beginModel(len(faces), len(vertices))
    model.addSubModel(coal_points(vertices), coal_triangles(faces))
    model.endModel()
    return model


def coal_points(points: list[np.ndarray]) -> coal.StdVec_Vec3s:
    vector = coal.StdVec_Vec3s()
    vector.extend(points)
    return vector


def coal_triangles(faces: list[tuple[int, int, int]]) -> coal.StdVec_Triangle:
    vector = coal.StdVec_Triangle()
    vector.extend([coal.Triangle(*face) for face in faces])
    return vector


def ell() -> coal.BVHModelOBBRSS:
    return extruded([(0.0, 0.0), (0.2, 0.0), (0.2, 0.05), (0.05, 0.05), (0.05, 0.2), (0.0, 0.2)], 0.06)


@pytest.mark.parametrize(("name", "key"), CASES)
def test_shipped_covers_are_proved(name: str, key: str, shapes: dict) -> None:
    geometry, cover = shapes[name][key], read_covers(DATA / f"{name}.spheres.json")[key]
    assert len(unproved(geometry, cover)) == 0
    assert held(cover, inner_points(geometry, np.random.default_rng(1))).all()


@pytest.mark.parametrize("name", NAMES)
def test_shipped_covers_are_those_of_the_robot(name: str, shapes: dict) -> None:
    assert set(read_covers(DATA / f"{name}.spheres.json")) == set(shapes[name])


@pytest.mark.parametrize("name", NAMES)
def test_no_proof_without_a_leaf_or_with_a_smaller_ball(name: str, shapes: dict) -> None:
    for key, cover in list(read_covers(DATA / f"{name}.spheres.json").items())[:3]:
        geometry = shapes[name][key]
        if len(solid_of(geometry).parts) > 1:
            continue
        for ball in (0, int(cover.leaves[0]), int(cover.leaves[-1])):
            assert len(unproved(geometry, moved_away(cover, ball))) > 0
        less = cover.radii.copy()
        less[cover.count == 0] -= 1e-3
        if (less > 0).all():
            assert len(unproved(geometry, changed(cover, radii=less))) > 0


def test_inner_balls_are_proved_too() -> None:
    box = coal.Box(0.1, 0.1, 0.1)
    cover = make_cover(box)
    inner = np.flatnonzero((cover.count > 0) & (cover.levels == 1))
    assert len(inner) > 1
    radii = cover.radii.copy()
    radii[inner] *= 0.5
    assert len(unproved(box, changed(cover, radii=radii))) > 0


SIZE = st.floats(0.005, 0.5)
SHAPES = st.one_of(
    st.builds(coal.Box, SIZE, SIZE, SIZE),
    st.builds(coal.Cylinder, SIZE, SIZE),
    st.builds(coal.Capsule, SIZE, SIZE),
    st.builds(coal.Sphere, SIZE),
)


@given(SHAPES, st.integers(0, 1000))
@settings(max_examples=12)
def test_covers_of_simple_shapes_are_proved(geometry: coal.CollisionGeometry, seed: int) -> None:
    cover = make_cover(geometry)
    assert len(unproved(geometry, cover)) == 0
    assert held(cover, inner_points(geometry, np.random.default_rng(seed), 1000)).all()
    children = np.concatenate([np.arange(f, f + n) for f, n in zip(cover.first, cover.count, strict=True)])
    assert sorted(children) == list(range(1, len(cover.radii)))
    assert (cover.parents[1:] < np.arange(1, len(cover.radii))).all() and not (cover.count == 1).any()


def test_mesh_that_is_not_convex() -> None:
    geometry = ell()
    cover = make_cover(geometry, effort=1)
    assert len(unproved(geometry, cover)) == 0
    points = np.random.default_rng(0).uniform([0, 0, 0], [0.2, 0.2, 0.06], (4_000, 3))
    inside = (points[:, 0] <= 0.05) | (points[:, 1] <= 0.05)
    assert held(cover, points[inside]).all()
    notch = points[(points[:, :2] > 0.13).all(axis=1)]
    assert not held(cover, notch).any()  # the hull would fill it
    assert len(unproved(geometry, moved_away(cover, int(cover.leaves[3])))) > 0


def test_convex_mesh_and_convex_body_agree() -> None:
    geometry = extruded([(0.0, 0.0), (0.1, 0.0), (0.0, 0.1)], 0.05)
    cover = make_cover(geometry, effort=1)
    geometry.buildConvexHull(True, "Qt")
    assert len(unproved(geometry.convex, cover)) == 0
    assert shape_key(geometry.convex) != shape_key(geometry)


def test_quality_of_known_covers() -> None:
    one, none = np.array([0]), np.array([0])
    box = coal.Box(0.1, 0.1, 0.1)
    ball = Cover(np.zeros((1, 3)), np.array([0.05 * 3**0.5 + 1e-5]), one, none)
    assert len(unproved(box, changed(ball, radii=ball.radii + 1e-3))) == 0
    ratio, mean, largest = quality(box, ball, np.random.default_rng(0))
    assert ratio == pytest.approx(np.pi * 3**0.5 / 2, rel=0.03)
    assert largest == pytest.approx(0.05 * (3**0.5 - 1), rel=0.02)
    assert 0.5 * largest < mean < largest


def test_smaller_gaps_give_tighter_leaves() -> None:
    cylinder = coal.Cylinder(0.03, 0.12)
    means = [quality(cylinder, make_cover(cylinder, (gap,)), np.random.default_rng(0))[1] for gap in (0.02, 0.006)]
    assert means[1] < 0.7 * means[0]


@pytest.mark.parametrize("gaps", [(), (0.005, 0.02), (0.01, 0.0)])
def test_gaps_that_make_no_sense(gaps: tuple[float, ...]) -> None:
    with pytest.raises(ParameterError, match="gaps"):
        make_cover(coal.Box(1, 1, 1), gaps)


def test_no_cover_of_a_half_space() -> None:
    for act in (make_cover, shape_key):
        with pytest.raises(ParameterError, match="geometry"):
            act(coal.Halfspace(np.array([0.0, 0.0, 1.0]), 0.0))


def test_key_tells_shapes_apart() -> None:
    other = extruded([(0.0, 0.0), (0.1, 0.0), (0.0, 0.1)], 0.05)
    shapes = [coal.Box(1, 2, 3), coal.Box(1, 3, 2), coal.Sphere(1), coal.Cylinder(1, 2), coal.Capsule(1, 2)]
    shapes += [coal.Cylinder(1, 2.0000001), ell(), other]
    keys = [shape_key(shape) for shape in shapes]
    assert len(set(keys)) == len(keys) and all(len(key) == 16 for key in keys)
    assert shape_key(ell()) == shape_key(ell()) and shape_key(coal.Box(1, 2, 3)) == keys[0]


def test_round_trip(tmp_path: Path) -> None:
    box = coal.Box(0.0537, 0.11, 0.2)
    cover = make_cover(box)
    loose = changed(cover, centers=cover.centers + 3.3e-7, radii=cover.radii + 1e-6)
    write_covers(tmp_path / "a.json", {"made": cover, "loose": loose})
    back = read_covers(tmp_path / "a.json")
    for name in ("centers", "radii", "first", "count"):
        assert np.array_equal(getattr(back["made"], name), getattr(cover, name))
    assert len(unproved(box, back["loose"])) == 0
    shift = np.linalg.norm(back["loose"].centers - loose.centers, axis=1)
    assert (back["loose"].radii >= loose.radii + shift - 1e-9).all()
    write_covers(tmp_path / "b.json", back)
    assert (tmp_path / "b.json").read_bytes() == (tmp_path / "a.json").read_bytes()


ROOT = [0.0, 0.0, 0.0, 1.0, 1, 2]
LEAF = [0.0, 0.0, 0.0, 1.0, 0, 0]
FAULTS = {
    "schema": {"schema": "apex-ompl/spheres/9"},
    "columns": {"columns": ["x"]},
    "covers": {"covers": []},
    "covers.a": {"covers": {"a": []}},
    "covers.a.0": {"covers": {"a": [[0, 0, 0, "r", 0, 0]]}},
    "covers.a.1": {"covers": {"a": [ROOT, [0.0, 0.0, 0.0, 0.0, 0, 0], LEAF]}},
    "covers.a.0 ": {"covers": {"a": [ROOT, LEAF]}},
    "covers.a.0  ": {"covers": {"a": [[0.0, 0.0, 0.0, 1.0, 0, 1], LEAF]}},
    "covers.a ": {"covers": {"a": [ROOT, LEAF, LEAF, LEAF]}},
    "covers.a.2": {"covers": {"a": [ROOT, LEAF, [0.0, 0.0, float("nan"), 1.0, 0, 0]]}},
}


@pytest.mark.parametrize("field", FAULTS)
def test_bad_files(field: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.json"
    write_covers(path, {"a": Cover(np.zeros((1, 3)), np.ones(1), np.zeros(1, int), np.zeros(1, int))})
    assert len(read_covers(path)["a"].radii) == 1
    path.write_text(json.dumps(json.loads(path.read_text()) | FAULTS[field]))
    with pytest.raises(FileFormatError, match="bad.json") as caught:
        read_covers(path)
    assert caught.value.field == field.strip()


def test_files_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match="no such file"):
        read_covers(tmp_path / "none.json")
    for content in (b"{", b"\xff", b"[" * 100_000):
        (tmp_path / "bad.json").write_bytes(content)
        with pytest.raises(FileFormatError, match="JSON|UTF-8"):
            read_covers(tmp_path / "bad.json")
    with pytest.raises(MissingFileError):
        write_covers(tmp_path / "none" / "a.json", {})
