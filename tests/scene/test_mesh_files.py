"""Files of meshes: what each format says of units and axes, how much it holds, and what is refused."""

from __future__ import annotations

import itertools
import struct
from pathlib import Path

import coal
import numpy as np
import pytest
import trimesh

from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.shapes import coal_geometry
from apex_ompl.errors import FileFormatError
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.mesh_files import collada_asset, read_mesh, read_stl
from apex_ompl.scene.meshes import triangles
from apex_ompl.scene.ply import parse_ply
from apex_ompl.scene.points import parse_points

SIZE = np.array([0.1, 0.2, 0.3])
VERTICES = np.array(list(itertools.product((0.0, 1.0), repeat=3))) * SIZE
QUADS = np.array([(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)])
FACES = np.concatenate([QUADS[:, [0, 1, 2]], QUADS[:, [0, 2, 3]]])


def stl(trailing: bytes = b"", count: int = 12) -> bytes:
    rows = (struct.pack("<12fH", 0, 0, 0, *VERTICES[face].ravel(), 0) for face in FACES)
    return b"solid facet".ljust(80) + struct.pack("<I", count) + b"".join(rows) + trailing


def stl_text() -> str:
    corners = ("".join(f"  vertex {x:g} {y:g} {z:g}\n" for x, y, z in VERTICES[face].tolist()) for face in FACES)
    return "solid a vertex\n" + "".join(
        f"facet normal 0 0 0\n outer loop\n{three} endloop\nendfacet\n" for three in corners
    ) + "endsolid a vertex\n"  # fmt: skip


def off() -> str:
    rows = [f"{x:g} {y:g} {z:g}" for x, y, z in VERTICES] + [f"4 {a} {b} {c} {d}  0.5 0.5 0.5" for a, b, c, d in QUADS]
    return "# a comment\nOFF\n8 6 0\n\n" + "\n".join(rows) + "\n"


def ply(order: str = "ascii", text: bool = True) -> bytes:
    """Quads and triangles, between other elements and properties."""
    mixed = [*QUADS[:1].tolist(), *FACES[[1, 7]].tolist(), *QUADS[2:].tolist()]
    head = f"""ply
format {order} 1.0
comment by hand
element camera 1
property float fov
element vertex 8
property uchar red
property double x
property double y
property double z
element face {len(mixed)}
property list uchar int vertex_indices
property list uchar float texcoord
property short flags
end_header
"""
    if order == "ascii":
        lines = ["60", *(f"9 {x:g} {y:g} {z:g}" for x, y, z in VERTICES)]
        lines += [f"{len(f)} {' '.join(map(str, f))} 2 0.5 0.25 -1" for f in mixed]
        return head.encode() + "\n".join(lines).encode() + b"\n"
    at = "<" if "little" in order else ">"
    body = struct.pack(at + "f", 60.0) + b"".join(struct.pack(at + "B3d", 9, *v) for v in VERTICES)
    body += b"".join(struct.pack(f"{at}B{len(f)}iB2fh", len(f), *f, 2, 0.5, 0.25, -1) for f in mixed)
    return head.encode() + body


def dae(unit: str = "", up: str = "") -> str:
    numbers, faces = " ".join(map(str, VERTICES.ravel())), " ".join(map(str, FACES.ravel()))
    axes = "".join(f'<param name="{axis}" type="float"/>' for axis in "XYZ")
    return f"""<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1"><asset>{unit}{up}</asset>
<library_geometries><geometry id="g"><mesh><source id="p"><float_array id="a" count="24">{numbers}</float_array>
<technique_common><accessor source="#a" count="8" stride="3">{axes}</accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="12"><input semantic="VERTEX" source="#v" offset="0"/><p>{faces}</p></triangles></mesh></geometry>
</library_geometries><library_visual_scenes><visual_scene id="s"><node id="n"><instance_geometry url="#g"/></node>
</visual_scene></library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>"""


def is_the_block(vertices: np.ndarray, faces: np.ndarray, corner: np.ndarray | None = None) -> bool:
    """Whether triangles bound the block from the origin to a corner, ``SIZE`` by default, oriented outwards."""
    corner = SIZE if corner is None else corner
    low, high = np.minimum(corner, 0.0), np.maximum(corner, 0.0)
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    volume = float(np.einsum("ij,ij->", a, np.cross(b, c))) / 6.0
    found = [vertices[faces].min(axis=(0, 1)), vertices[faces].max(axis=(0, 1))]
    return np.allclose(found, [low, high], atol=1e-6) and volume == pytest.approx(float(np.prod(high - low)), rel=1e-5)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.stl", stl()),
        ("a.STL", stl(b"\0\0")),
        ("a.stl", stl_text().encode()),
        ("a.stl", stl_text().upper().encode()),
        ("a.stl", stl_text().replace("\n", "\r\n").encode()),
        ("a.stl", (stl_text() * 2).encode()),  # of two solids, here the same
        ("a.off", off().encode()),
        ("a.off", off().replace("OFF\n8", "OFF 8").encode()),
        ("a.ply", ply()),
        ("a.ply", ply().replace(b"\n", b"\r\n")),
        ("a.ply", ply("binary_little_endian") + b"\0"),
        ("a.ply", ply("binary_big_endian")),
        ("a.dae", dae(up="<up_axis>Z_UP</up_axis>").encode()),
    ],
)
def test_meshes_of_every_format_are_the_same(name: str, content: bytes) -> None:
    vertices, faces = read_mesh(name, content)
    if content.count(b"endsolid") == 2:
        faces = faces[: len(faces) // 2]
    assert vertices.dtype == float and len(faces) == 12 and is_the_block(vertices, faces)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.stl", stl()[:-30], "11 of the 12 triangles of its head: it is cut off"),
        ("a.stl", stl(count=2**31), "12 of the 2147483648 triangles"),
        ("a.stl", stl()[:60], "60 bytes that are no STL"),
        ("a.stl", stl_text()[:-19].encode(), "12 facets, but no 'endsolid'"),
        ("a.stl", "\n".join(stl_text().splitlines()[:-12]).encode(), "11 facets with 10 ends and 31 corners"),
        (
            "a.stl",
            stl_text().replace("vertex 0 0 0", "vertex 0 0", 1).encode(),
            "12 facets with 12 ends and 35 corners",
        ),
        ("a.off", "\n".join(off().splitlines()[:-2]).encode(), "8 of 8 vertices and 4 of 6 faces of its head"),
        ("a.off", "\n".join(off().splitlines()[:-8]).encode(), "6 of 8 vertices and 0 of 6 faces"),
        ("a.off", off().rsplit(" ", 6)[0].encode(), "a face of 4 corners that names 2"),
        ("a.off", b"hello", "no word 'OFF'"),
        ("a.off", b"OFF\n8", "no numbers of vertices and faces"),
        ("a.ply", ply().rsplit(b"\n", 3)[0], "5 of the 7 elements 'face' of its head: it is cut off"),
        ("a.ply", ply()[:-4], "6 of the 7 elements 'face'"),
        ("a.ply", ply("binary_little_endian")[:-1], "6 of the 7 elements 'face'"),
        ("a.ply", ply("binary_big_endian")[:-170], "0 of the 7 elements 'face'"),
        ("a.ply", ply("binary_big_endian")[:-250], "5 of the 8 elements 'vertex'"),
        ("a.ply", ply()[:60], "a head that is cut off"),
        ("a.ply", ply().replace(b"vertex_indices", b"neighbors"), "faces without a list vertex_indices"),
        ("a.dae", dae()[:-30].encode(), "unclosed token|mismatched|no element"),
        ("a.dae", dae(unit='<unit meter="0"/>').encode(), "a unit of 0 m with Y_UP"),
        ("a.dae", dae(up="<up_axis>UP</up_axis>").encode(), "a unit of 1 m with UP"),
        ("a.glb", trimesh.creation.box().export(file_type="glb")[:-5], "chunk was not expected length"),
        ("a.stl", b" ", "an empty file"),
    ],
)
def test_what_is_cut_off_or_something_else_is_refused(tmp_path: Path, name: str, content: bytes, words: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(
        FileFormatError, match=rf"{name}: expected a mesh of triangles \(mesh of 'm'\), got .*({words})"
    ):
        coal_geometry(Obstacle(name="m", mesh={"file": str(tmp_path / name)}))


def test_clouds_that_are_cut_off_are_refused() -> None:
    points = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    head = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 50\nHEIGHT 1\nPOINTS 50\nDATA "
    text = (head + "ascii\n" + "\n".join(f"{x!r} {y!r} {z!r}" for x, y, z in points.tolist())).encode()
    binary = (head + "binary\n").encode() + points.tobytes()
    assert np.allclose(parse_points("a.pcd", text), points) and np.array_equal(parse_points("a.pcd", binary), points)
    for content, words in (
        (text.rsplit(b"\n", 3)[0], "47 of the 50 points of its head: it is cut off"),
        (text.rsplit(b" ", 1)[0], "49 of the 50 points"),
        (binary[:-13], "48 of the 50 points"),
        (text.replace(b"WIDTH 50", b"WIDTH 60"), "POINTS 50 in a head of WIDTH 60 and HEIGHT 1"),
        (ply("binary_little_endian")[:-250], "5 of the 8 elements 'vertex'"),
    ):
        name = "a.ply" if content.startswith(b"ply") else "a.pcd"
        with pytest.raises(FileFormatError, match=f"{name}: expected a cloud of points, got .*{words}"):
            parse_points(name, content)


@pytest.mark.parametrize("count", [1, 3000])
def test_binary_ply_of_other_programs_is_read(count: int) -> None:
    """As trimesh writes it, and with as many alternations of quads and triangles as there are faces."""
    mesh = trimesh.creation.icosphere(3)
    vertices, faces = parse_ply(mesh.export(file_type="ply"))
    assert np.allclose(vertices, mesh.vertices) and np.array_equal(faces, mesh.faces)
    head = b"ply\nformat binary_little_endian 1.0\nelement vertex 4\n"
    head += b"property float x\nproperty float y\nproperty float z\n"
    head += f"element face {2 * count}\nproperty list uint8 int32 vertex_index\nend_header\n".encode()
    body = np.eye(4, 3, dtype="<f4").tobytes() + struct.pack("<B4iB3i", 4, 0, 1, 2, 3, 3, 2, 1, 0) * count
    vertices, faces = parse_ply(head + body)
    rows, counts = np.unique(faces, axis=0, return_counts=True)
    assert rows.tolist() == [[0, 1, 2], [0, 2, 3], [2, 1, 0]] and (counts == count).all()


def test_binary_stl_is_read_as_by_coal_and_trimesh(tmp_path: Path) -> None:
    mesh = trimesh.creation.annulus(0.1, 0.2, 0.3, sections=16)
    mesh.export(tmp_path / "ring.stl")
    loaded = coal.MeshLoader(coal.BV_AABB).load(str(tmp_path / "ring.stl"), np.ones(3))
    for content in ((tmp_path / "ring.stl").read_bytes(), mesh.export(file_type="stl_ascii").encode()):
        vertices, faces = read_stl("", content)
        assert (len(vertices), len(faces)) == (loaded.num_vertices, loaded.num_tris)
        assert (len(vertices), len(faces)) == (len(mesh.vertices), len(mesh.faces))
        assert vertices[faces] == pytest.approx(mesh.triangles, abs=1e-6)
        assert trimesh.Trimesh(vertices, faces, process=False).is_watertight


@pytest.mark.parametrize(
    ("up", "corner"),  # right, up and towards the viewer: -y, x, z of X_UP; x, y, z of Y_UP; x, z, -y of Z_UP
    [
        ("X_UP", (-SIZE[1], -SIZE[2], SIZE[0])),
        ("Y_UP", (SIZE[0], -SIZE[2], SIZE[1])),
        ("Z_UP", tuple(SIZE)),
        ("", (SIZE[0], -SIZE[2], SIZE[1])),  # y by the specification
    ],
)
@pytest.mark.parametrize("meters", [1.0, 0.001, 0.0254])
def test_collada_is_scaled_to_metres_and_stands_upright(tmp_path: Path, up: str, corner: tuple, meters: float) -> None:
    unit = "" if meters == 1.0 else f'<unit name="u" meter="{meters}"/>'
    (tmp_path / "a.dae").write_text(dae(unit, f"<up_axis>{up}</up_axis>" if up else ""))
    scaled = {"file": str(tmp_path / "a.dae"), "scale": (1.0 / meters, 2.0 / meters, 3.0 / meters)}
    vertices, faces = triangles(coal_geometry(Obstacle(name="m", mesh=scaled)))
    assert is_the_block(vertices, faces, np.array(corner) * (1.0, 2.0, 3.0)), "the scale is along the body's axes"
    assert collada_asset((tmp_path / "a.dae").open("rb")) == (meters, up or "Y_UP")


def test_gltf_stands_upright(robot: Robot, tmp_path: Path) -> None:
    mesh = trimesh.Trimesh(VERTICES, FACES, process=False)
    mesh.export(tmp_path / "a.glb")
    block = Obstacle(name="m", mesh={"file": str(tmp_path / "a.glb")}, position=(1.0, 0.0, 0.0))
    vertices, faces = triangles(coal_geometry(block))
    assert is_the_block(vertices, faces, np.array([SIZE[0], -SIZE[2], SIZE[1]]))
    assert CollisionChecker(robot, [block]).is_free(robot.home)
