"""Files of triangle meshes: ``.stl``, ``.obj``, ``.ply``, ``.dae``, ``.glb`` and ``.off``, in meters and with z up.

Most formats give neither unit nor direction: their numbers are meters in the frame of the body. COLLADA gives both,
``<unit>`` and ``<up_axis>`` of its first ``<asset>``, one meter and y by default; glTF is in meters with y up. Meshes
of both are scaled to meters, and turned so that z is up.

Each format but ``.obj`` states the size of its content; a file with less content is cut off, and an error. PLY (the
Stanford format, 1.0) also holds point clouds.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any
from xml.etree import ElementTree

import coal
import numpy as np
from numpy.typing import NDArray

from apex_ompl.scene.meshes import numbered
from apex_ompl.types import Array

TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
LISTS = ("vertex_indices", "vertex_index")  # names of the corners of a face
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


@dataclass(frozen=True)
class Property:
    """A property of an element: its name, its type, and for a list the type of its length."""

    name: str
    kind: str
    length: str = ""


@dataclass(frozen=True)
class Element:
    """An element of a head, such as ``vertex``: how many there are by the head, and their properties."""

    name: str
    count: int
    properties: list[Property]


def parse_ply(content: bytes) -> tuple[Array, NDArray[np.int64]]:
    """Return the vertices, shape (V, 3), and the triangles, shape (T, 3), of a file; without faces it has no triangles.

    Faces of more corners are split into triangles around their first corner.

    Raises:
        ValueError: The content is something else, or is cut off: it holds fewer elements than its head names.
    """
    order, elements, at = _head(content)
    vertices, triangles = np.empty((0, 3)), [np.empty((0, 3), np.int64)]
    body: Any = content[at:].split() if not order else content[at:]
    for element in elements:
        columns, body = _ascii(element, body) if not order else _binary(element, body, order)
        if element.name == "vertex":
            vertices = np.stack([np.asarray(columns[axis], float) for axis in "xyz"], axis=1)
        elif element.name == "face":
            corners = next((columns[name] for name in LISTS if name in columns), None)
            if corners is None:
                raise ValueError(f"faces without a list {' or '.join(LISTS)}")
            triangles += [fans(np.asarray(some, np.int64)) for some in corners]
    return vertices, np.concatenate(triangles)


def fans(faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the triangles of faces of as many corners each, shape (F, n), around their first ones, shape (T, 3)."""
    ends = range(1, faces.shape[1] - 1)
    return np.stack([faces[:, [0, k, k + 1]] for k in ends], axis=1).reshape(-1, 3) if ends else np.empty((0, 3), int)


def _head(content: bytes) -> tuple[str, list[Element], int]:
    """Return the byte order, empty for text, the elements, and the place after the head of a file."""
    order, elements, at = None, list[Element](), 0
    if not content.startswith(b"ply"):
        raise ValueError("no line 'ply' at the beginning")
    while True:
        end = content.find(b"\n", at)
        if end < 0:
            raise ValueError("a head that is cut off")
        words = content[at:end].decode("ascii", "replace").split()
        at = end + 1
        match words:
            case ["end_header"]:
                break
            case ["format", name, *_]:
                order = ORDERS[name]
            case ["element", name, count]:
                elements.append(Element(name, int(count), []))
            case ["property", "list", length, kind, name]:
                elements[-1].properties.append(Property(name, TYPES[kind], TYPES[length]))
            case ["property", kind, name]:
                elements[-1].properties.append(Property(name, TYPES[kind]))
    if order is None:
        raise ValueError("no line 'format' in the head")
    return order, elements, at


def _cut_off(element: Element, found: int) -> ValueError:
    return ValueError(f"{found} of the {element.count} elements {element.name!r} of its head: it is cut off")


def _ascii(element: Element, words: list[bytes]) -> tuple[dict[str, Any], list[bytes]]:
    """Return the columns of an element of a text, and the words after it."""
    if not any(one.length for one in element.properties):
        width = len(element.properties)
        if len(words) < element.count * width:
            raise _cut_off(element, len(words) // width)
        table = np.array(words[: element.count * width], float).reshape(element.count, width)
        names = [one.name for one in element.properties]
        return dict(zip(names, table.T, strict=True)), words[element.count * width :]
    lists: dict[str, dict[int, list[list[float]]]] = {one.name: {} for one in element.properties if one.length}
    at = 0
    for row in range(element.count):
        for one in element.properties:
            count = int(words[at]) if one.length and at < len(words) else 0
            end = at + 1 + count
            if end > len(words):
                raise _cut_off(element, row)
            if one.length:
                lists[one.name].setdefault(count, []).append([*map(float, words[at + 1 : end])])
            at = end
    return {name: [*map(np.array, some.values())] for name, some in lists.items()}, words[at:]


def _binary(element: Element, body: bytes, order: str) -> tuple[dict[str, Any], bytes]:
    """Return the columns of an element of binary data, and what comes after it; lists by their lengths.

    Rows whose lists are as long as those of the row before are read at once, twice as many each time.
    """
    lists: dict[str, list[NDArray[Any]]] = {one.name: [] for one in element.properties if one.length}
    columns: dict[str, Any] = dict(lists)
    done, at, ahead = 0, 0, element.count if not lists else 64
    while done < element.count:
        fields, lengths = _row(element, body, at, order)
        if fields is None:
            raise _cut_off(element, done)
        many = min(element.count - done, ahead, (len(body) - at) // fields.itemsize)
        rows = np.frombuffer(body, fields, many, at)
        same = np.ones(len(rows), bool)
        for name, length in lengths.items():
            same &= rows[f"length of {name}"] == length
        many, ahead = (len(rows), 2 * ahead) if same.all() else (int(np.argmin(same)), 64)
        for one in element.properties:
            if one.length:
                lists[one.name].append(rows[one.name][:many])
            elif not lists:
                columns[one.name] = rows[one.name]
        done, at = done + many, at + many * fields.itemsize
        if not lists and done < element.count:
            raise _cut_off(element, done)
    return columns, body[at:]


def _row(element: Element, body: bytes, at: int, order: str) -> tuple[np.dtype[Any] | None, dict[str, int]]:
    """Return the type of the row at a place, None where the data end before it does, and the lengths of its lists."""
    fields: list[Any] = []
    lengths: dict[str, int] = {}
    size = 0
    for one in element.properties:
        kind, count = np.dtype(order + one.kind), 1
        if one.length:
            head = np.dtype(order + one.length)
            if at + size + head.itemsize > len(body):
                return None, lengths
            count = lengths[one.name] = int(np.frombuffer(body, head, 1, at + size)[0])
            fields.append((f"length of {one.name}", head))
            size += head.itemsize
        fields.append((one.name, kind, (count,)) if one.length else (one.name, kind))
        size += count * kind.itemsize
    return (np.dtype(fields), lengths) if at + size <= len(body) else (None, lengths)


Triangles = tuple[Array, NDArray[np.int64]]
"""Vertices, shape (V, 3) [m], and the vertices of each triangle, shape (T, 3)."""


def read_mesh(file: str, content: bytes) -> Triangles:
    """Return the triangles of a file, of all meshes that it holds.

    Args:
        file: Its name, whose suffix tells the format; an ``.obj`` is read from that path.
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


def read_obj(file: str, content: bytes) -> Triangles:
    """Return the triangles of a Wavefront OBJ file, by Coal's importer."""
    # Trees of oriented boxes, which collisions need, are made of sound vertices only: Coal prints many lines else.
    try:
        mesh = coal.MeshLoader(coal.BV_AABB).load(file, np.ones(3))
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
