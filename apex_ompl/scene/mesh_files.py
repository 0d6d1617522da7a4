"""Files of triangle meshes: ``.stl``, ``.obj``, ``.ply``, ``.dae``, ``.glb`` and ``.off``, in meters and with z up.

Most formats give neither unit nor direction: their numbers are meters in the frame of the body. COLLADA gives both,
``<unit>`` and ``<up_axis>`` of its first ``<asset>``, one meter and y by default; glTF is in meters with y up. Meshes
of both are scaled to meters, and turned so that z is up.

Each format but ``.obj`` states the size of its content; a file with less content is cut off, and an error.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO
from xml.etree import ElementTree

import coal
import numpy as np
from numpy.typing import NDArray

from apex_ompl.scene.meshes import numbered
from apex_ompl.scene.points import fans, parse_ply
from apex_ompl.types import Array

STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
STL_HEAD = 84  # bytes before the triangles of a binary file
STL_LINE = r"(?mi)^[^\S\n]*{}\b"
STL_VERTEX = re.compile(rb"(?mi)^[^\S\n]*vertex[^\S\n]+(\S+)[^\S\n]+(\S+)[^\S\n]+(\S+)[^\S\n]*$")
UPRIGHT = {
    "Z_UP": np.eye(3),
    "Y_UP": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "X_UP": np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]),
}
"""Rotations that turn the up axis to z; the right axis stays x, and is -y for X_UP (COLLADA 1.4.1, up_axis)."""


Triangles = tuple[Array, NDArray[np.int64]]
"""Vertices, shape (V, 3) [m], and the vertices of each triangle, shape (T, 3)."""


def read_mesh(file: str, content: bytes) -> Triangles:
    """Return the triangles of a file, of all meshes that it holds.

    Args:
        file: Its name, whose suffix tells the format.
        content: Its content.

    Raises:
        ValueError: The content is something else, or is cut off; others of libraries that read it.
    """
    if not content.strip():
        raise ValueError("an empty file")
    vertices, faces = READERS[Path(file).suffix.lower()](file, content)
    if len(faces) and not 0 <= faces.min() <= faces.max() < len(vertices):
        raise ValueError("a face that names a vertex that is not there")
    return vertices, faces


def read_stl(_: str, content: bytes) -> Triangles:
    """Return the triangles of an STL file, as text or binary; corners at the same position become one vertex."""
    count = int.from_bytes(content[STL_HEAD - 4 : STL_HEAD], "little")
    size = STL_HEAD + STL_TRIANGLE.itemsize * count
    text = re.match(rb"\s*solid\b", content, re.I) and re.search(STL_LINE.format("(end)?facet").encode(), content)
    if text and len(content) != size:
        return _indexed(_stl_text(content))
    if len(content) < STL_HEAD:
        raise ValueError(f"{len(content)} bytes that are no STL")
    if len(content) < size:
        found = (len(content) - STL_HEAD) // STL_TRIANGLE.itemsize
        raise ValueError(f"{found} of the {count} triangles of its head: it is cut off")
    return _indexed(np.frombuffer(content, STL_TRIANGLE, count, STL_HEAD)["corners"].astype(float))


def _stl_text(content: bytes) -> Array:
    """Return the corners of the triangles of an STL file that is a text, shape (T, 3, 3)."""
    names = ("solid", "endsolid", "facet", "endfacet")
    solids, ended, facets, closed = (len(re.findall(STL_LINE.format(name).encode(), content)) for name in names)
    corners = STL_VERTEX.findall(content)
    if closed != facets or len(corners) != 3 * facets:
        raise ValueError(f"{facets} facets with {closed} ends and {len(corners)} corners: it is cut off or damaged")
    if ended != solids:
        raise ValueError(f"{facets} facets, but no 'endsolid' after the last: it is cut off")
    return np.array(corners, float).reshape(-1, 3, 3)


def _indexed(corners: Array) -> Triangles:
    """Return triangles given by their corners, shape (T, 3, 3); corners at the same position become one vertex."""
    corners = corners.reshape(-1, 3)
    if not len(corners):
        return corners, np.empty((0, 3), np.int64)
    numbers = numbered(corners)
    vertices = np.empty((int(numbers.max()) + 1, 3))
    vertices[numbers] = corners
    return vertices, numbers.reshape(-1, 3)


def read_off(_: str, content: bytes) -> Triangles:
    """Return the triangles of an OFF file of Geomview, as a text; colors and normals are left out."""
    lines = [line for line in (line.split(b"#")[0].split() for line in content.splitlines()) if line]
    head = re.fullmatch(rb"(ST)?C?N?OFF", lines[0][0])
    if head is None:
        raise ValueError("no word 'OFF' at the beginning")
    lines[0] = lines[0][1:]
    lines = lines if lines[0] else lines[1:]
    if not lines or len(lines[0]) < 2:
        raise ValueError("no numbers of vertices and faces")
    count, faces = int(lines[0][0]), int(lines[0][1])
    points, rows = lines[1 : 1 + count], lines[1 + count : 1 + count + faces]
    if len(points) < count or len(rows) < faces:
        found = f"{len(points)} of {count} vertices and {len(rows)} of {faces} faces of its head"
        raise ValueError(f"{found}: it is cut off")
    by_size: dict[int, list[list[int]]] = {}
    for row in rows:
        size = int(row[0])
        if len(row) <= size:
            raise ValueError(f"a face of {size} corners that names {len(row) - 1}: it is cut off")
        by_size.setdefault(size, []).append([int(word) for word in row[1 : 1 + size]])
    triangles = [fans(np.array(some, np.int64).reshape(-1, size)) for size, some in by_size.items()]
    return np.array([point[:3] for point in points], float), np.concatenate([np.empty((0, 3), np.int64), *triangles])


def read_obj(_: str, content: bytes) -> Triangles:
    """Return the triangles of a Wavefront OBJ file, by Coal's importer, which reads files alone."""
    # Trees of oriented boxes, which collisions need, are made of sound vertices only: Coal prints many lines else.
    try:
        with TemporaryDirectory() as folder:
            file = Path(folder, "mesh.obj")
            file.write_bytes(content)
            mesh = coal.MeshLoader(coal.BV_AABB).load(str(file), np.ones(3))
    except Exception as error:
        raise ValueError(content[:60].decode(errors="replace")) from error
    rows = [(t[0], t[1], t[2]) for t in map(mesh.tri_indices, range(mesh.num_tris))]
    return np.array(mesh.vertices()), np.array(rows, np.int64).reshape(-1, 3)


def read_dae(_: str, content: bytes) -> Triangles:
    """Return the triangles of a COLLADA file in meters, with z up."""
    vertices, faces = _by_trimesh(content, "dae")
    meters, up = collada_asset(io.BytesIO(content))
    return meters * vertices @ UPRIGHT[up].T, faces


def read_glb(_: str, content: bytes) -> Triangles:
    """Return the triangles of a binary glTF file, with z up."""
    vertices, faces = _by_trimesh(content, "glb")
    return vertices @ UPRIGHT["Y_UP"].T, faces


def _by_trimesh(content: bytes, kind: str) -> Triangles:
    import trimesh

    loaded = trimesh.load_mesh(io.BytesIO(content), file_type=kind, process=False)
    return np.array(loaded.vertices, float), np.array(loaded.faces, np.int64)


def collada_asset(file: IO[bytes]) -> tuple[float, str]:
    """Return the length of the unit of a COLLADA file [m], and the axis that is up, ``X_UP``, ``Y_UP`` or ``Z_UP``.

    It reads up to the first ``<asset>`` only, which is near the start.

    Raises:
        ValueError: It is not XML, or one of the two is none.
    """
    asset: ElementTree.Element | None = None
    try:
        for _, element in ElementTree.iterparse(file):
            if element.tag.endswith("}asset") or element.tag == "asset":
                asset = element
                break
    except ElementTree.ParseError as error:
        raise ValueError(f"XML that is cut off or broken: {error}") from error
    unit, axis = (None, None) if asset is None else (asset.find("{*}unit"), asset.find("{*}up_axis"))
    meters = float("1" if unit is None else unit.get("meter", "1"))
    up = "Y_UP" if axis is None or not axis.text else axis.text.strip()
    if not 0.0 < meters < np.inf or up not in UPRIGHT:
        raise ValueError(f"a unit of {meters:g} m with {up}")
    return meters, up


READERS: dict[str, Callable[[str, bytes], Triangles]] = {
    ".stl": read_stl, ".obj": read_obj, ".ply": lambda _, content: parse_ply(content), ".dae": read_dae,
    ".glb": read_glb, ".off": read_off,
}  # fmt: skip
