"""Point clouds: ``.npy``, ``.ply`` and ``.pcd`` files, and depth images; meshes in PLY files."""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apex_ompl.errors import FileFormatError, ParameterError
from apex_ompl.scene.bodies import PointFile
from apex_ompl.types import Array
from apex_ompl.util.files import BROKEN
from apex_ompl.util.validation import check_array, check_integer, check_positive, finite_array, number_array, rigid_pose

LARGEST = 1e4  # larger coordinates are errors [m]
MILLIMETER = 1e-3  # unit of depth images of whole numbers [m]
FEW, MANY = 50, 50.0  # depths of whole numbers are larger [mm], medians of others are not [m]
SAMPLED = 10_000  # pixels by which the unit of an image is checked
PCD_TYPES = {"F": "f", "I": "i", "U": "u"}
PLY_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
PLY_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
PLY_LISTS = ("vertex_indices", "vertex_index")  # names of the corners of a face


def parse_points(file: str, content: bytes) -> Array:
    """Return the points of a ``.npy``, ``.ply`` or ``.pcd`` file, shape (N, 3) [m].

    Raises:
        FileFormatError: The file holds no points, or some that are not finite.
    """
    try:
        if not content:
            raise ValueError("an empty file")
        points = number_array(READERS[Path(file).suffix.lower()](content), "the array")
    except (*BROKEN, AttributeError, IndexError, ParameterError) as error:
        raise FileFormatError(file, "", str(error)[:80], "expected a cloud of points") from error
    if points.ndim != 2 or points.shape[1] < 3 or not len(points):
        raise FileFormatError(file, "", f"an array of shape {points.shape}", "expected one point or more, shape (N, 3)")
    points = np.ascontiguousarray(points[:, :3])
    if not np.abs(points).max() < LARGEST:  # nor where one is no number
        k = int(np.argmin(np.isfinite(points).all(axis=1) & (np.abs(points).max(axis=1) < LARGEST)))
        raise FileFormatError(file, f"point {k}", points[k].tolist(), f"expected finite numbers below {LARGEST:g} m")
    return points


def _read_npy(content: bytes) -> Array:
    return np.asarray(np.load(io.BytesIO(content), allow_pickle=False))


def _read_ply(content: bytes) -> Array:
    return parse_ply(content)[0]


def _read_pcd(content: bytes) -> Array:
    """Return the points of a PCD file (the format of the Point Cloud Library, version 0.7)."""
    head: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in head:
        end = content.index(b"\n", at)
        words = content[at:end].decode("ascii").split()
        at = end + 1
        if words and not words[0].startswith("#"):
            head[words[0]] = words[1:]
    names, count = head["FIELDS"], int(head["POINTS"][0])
    wide, high = (int(head.get(side, [size])[0]) for side, size in (("WIDTH", str(count)), ("HEIGHT", "1")))
    if wide * high != count:
        raise ValueError(f"POINTS {count} in a head of WIDTH {wide} and HEIGHT {high}")
    repeats = [int(n) for n in head.get("COUNT", ["1"] * len(names))]
    kind = head["DATA"][0]
    if kind == "ascii":
        rows = [words for words in (line.split() for line in content[at:].splitlines()) if words][:count]
        _check_count(sum(len(words) == sum(repeats) for words in rows), count)
        table, columns = np.array(rows, float), np.cumsum([0, *repeats])
        return np.stack([table[:, columns[names.index(axis)]] for axis in "xyz"], axis=1)
    formats = [np.dtype(f"<{PCD_TYPES[kind]}{size}") for kind, size in zip(head["TYPE"], head["SIZE"], strict=True)]
    if kind == "binary_compressed":  # field by field
        packed, size = np.frombuffer(content, "<u4", 2, at).tolist()
        if len(content) < at + 8 + packed:
            raise ValueError(f"{len(content) - at - 8} of {packed} compressed bytes: it is cut off")
        data, at = _decompressed(content[at + 8 : at + 8 + packed], size), 0
        fields: list[Array] = []
        for form, n in zip(formats, repeats, strict=True):
            fields.append(np.frombuffer(data, form, count * n, at).reshape(count, n)[:, 0])
            at += count * n * form.itemsize
        return np.stack([fields[names.index(axis)] for axis in "xyz"], axis=1)
    if kind != "binary":
        raise ValueError(f"PCD data {kind!r}, expected ascii, binary or binary_compressed")
    row = np.dtype([(f"{k}", form, (n,)) for k, (form, n) in enumerate(zip(formats, repeats, strict=True))])
    _check_count((len(content) - at) // row.itemsize, count)
    records: Any = np.frombuffer(content, row, count, at)
    return np.stack([records[str(names.index(axis))][:, 0] for axis in "xyz"], axis=1)


def _check_count(found: int, count: int) -> None:
    if found < count:
        raise ValueError(f"{found} of the {count} points of its head: it is cut off")


def _decompressed(packed: bytes, size: int) -> bytes:
    """Return what LZF packed (the format of Marc Lehmann's LibLZF), of ``size`` bytes.

    A byte n below 32 is followed by n + 1 literal bytes. Any other byte, with the next one, gives length and distance
    of a run of earlier bytes to repeat.
    """
    found, at = bytearray(), 0
    while at < len(packed):
        control = packed[at]
        at += 1
        if control < 32:
            found += packed[at : at + control + 1]
            at += control + 1
            continue
        long, back = control >> 5, (control & 31) << 8
        if long == 7:
            long += packed[at]
            at += 1
        start, long = len(found) - back - packed[at] - 1, long + 2
        at += 1
        if start < 0:
            raise ValueError("compressed data that is damaged")
        run = found[start : start + long]
        found += (run * (long // len(run) + 1))[:long]
    if len(found) != size:
        raise ValueError(f"compressed data of {len(found)} bytes, expected {size}")
    return bytes(found)


READERS = {".npy": _read_npy, ".ply": _read_ply, ".pcd": _read_pcd}


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
    order, elements, at = _ply_head(content)
    vertices, triangles = np.empty((0, 3)), [np.empty((0, 3), np.int64)]
    body: Any = content[at:].split() if not order else content[at:]
    for element in elements:
        columns, body = _ply_text(element, body) if not order else _ply_binary(element, body, order)
        if element.name == "vertex":
            vertices = np.stack([np.asarray(columns[axis], float) for axis in "xyz"], axis=1)
        elif element.name == "face":
            corners = next((columns[name] for name in PLY_LISTS if name in columns), None)
            if corners is None:
                raise ValueError(f"faces without a list {' or '.join(PLY_LISTS)}")
            triangles += [fans(np.asarray(some, np.int64)) for some in corners]
    return vertices, np.concatenate(triangles)


def fans(faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the triangles of faces of as many corners each, shape (F, n), around their first ones, shape (T, 3)."""
    ends = range(1, faces.shape[1] - 1)
    return np.stack([faces[:, [0, k, k + 1]] for k in ends], axis=1).reshape(-1, 3) if ends else np.empty((0, 3), int)


def _ply_head(content: bytes) -> tuple[str, list[Element], int]:
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
                order = PLY_ORDERS[name]
            case ["element", name, count]:
                elements.append(Element(name, int(count), []))
            case ["property", "list", length, kind, name]:
                elements[-1].properties.append(Property(name, PLY_TYPES[kind], PLY_TYPES[length]))
            case ["property", kind, name]:
                elements[-1].properties.append(Property(name, PLY_TYPES[kind]))
    if order is None:
        raise ValueError("no line 'format' in the head")
    return order, elements, at


def _cut_off(element: Element, found: int) -> ValueError:
    return ValueError(f"{found} of the {element.count} elements {element.name!r} of its head: it is cut off")


def _ply_text(element: Element, words: list[bytes]) -> tuple[dict[str, Any], list[bytes]]:
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


def _ply_binary(element: Element, body: bytes, order: str) -> tuple[dict[str, Any], bytes]:
    """Return the columns of an element of binary data, and what comes after it; lists by their lengths.

    Rows whose lists are as long as those of the row before are read at once, twice as many each time.
    """
    lists: dict[str, list[NDArray[Any]]] = {one.name: [] for one in element.properties if one.length}
    columns: dict[str, Any] = dict(lists)
    done, at, ahead = 0, 0, element.count if not lists else 64
    while done < element.count:
        fields, lengths = _ply_row(element, body, at, order)
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


def _ply_row(element: Element, body: bytes, at: int, order: str) -> tuple[np.dtype[Any] | None, dict[str, int]]:
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


def depth_in_meters(depth: ArrayLike) -> Array:
    """Return a depth image in meters, shape (rows, columns).

    Whole numbers are millimeters, others meters, as ROS has it (REP 118).

    Raises:
        ParameterError: It is not an image, has masked numbers, or its numbers are not of that unit.
    """
    image = number_array(depth, "depth")
    if image.ndim != 2:
        raise ParameterError("depth", image.shape, "an image of shape (rows, columns)")
    if np.asarray(depth).dtype.kind in "iu":
        largest = image.max(initial=0.0)
        if 0.0 < largest <= FEW:
            raise ParameterError("depth", f"whole numbers up to {largest:g}", "millimeters, or floats in meters")
        return image * MILLIMETER
    pixels = image.ravel()
    seen = _depths(pixels[:: 1 + pixels.size // SAMPLED])
    if not len(seen):
        seen = _depths(pixels)
    if len(seen) and np.median(seen) > MANY:
        raise ParameterError("depth", f"floats around {np.median(seen):g}", "meters, or whole numbers in millimeters")
    return image


def _depths(pixels: Array) -> Array:
    """Return the numbers that are depths."""
    with np.errstate(invalid="ignore"):
        return pixels[np.isfinite(pixels) & (pixels > 0.0)]


def points_of(points: ArrayLike, radius: float) -> PointFile:
    """Return balls in memory as the ``points`` of an obstacle, which no file is needed for.

    Args:
        points: Their centers, shape (N, 3) [m].
        radius: Their radius [m].

    Raises:
        ParameterError: The points have another shape or are not finite, there are none, or the radius is not positive.
    """
    cloud = finite_array(points, "points")
    check_array(cloud, ("N", 3), "points", least=1)
    check_positive(radius, "radius", "a positive number of meters")
    content = io.BytesIO()
    np.save(content, cloud.astype(np.float32))
    return PointFile(file="memory.npy", radius=radius, content=base64.b64encode(content.getvalue()).decode())


def points_from_depth(
    depth: ArrayLike, intrinsics: tuple[float, float, float, float], pose: ArrayLike, stride: int = 1,
    range: tuple[float, float] = (0.1, 5.0),
) -> Array:  # fmt: skip
    """Return the points that a depth image sees, in the world, shape (N, 3) [m].

    Pixel (column u, row v) with the depth d along the optical axis is at ((u - cx) d / fx, (v - cy) d / fy, d) in the
    camera's optical frame, z forward, x right, y down. Pixels that are not finite or out of range are left out.

    Args:
        depth: Depths, shape (rows, columns): whole numbers [mm], or floats [m].
        intrinsics: Focal lengths fx, fy and principal point cx, cy [pixels].
        pose: Pose of the optical frame in the world, shape (4, 4) [m]: a rotation and a translation.
        stride: Stride of rows and columns.
        range: Least and largest depth that is taken [m].

    Raises:
        ParameterError: An argument has another shape, another unit, is out of its range, or has masked numbers, which
            a NaN can stand for; the pose is not rigid.
    """
    image = depth_in_meters(depth)
    camera, placement = finite_array(intrinsics, "intrinsics"), rigid_pose(pose, "pose")
    check_array(camera, (4,), "intrinsics")
    focal_x, focal_y, center_x, center_y = camera.tolist()
    if not (focal_x > 0.0 and focal_y > 0.0):
        raise ParameterError("intrinsics", (focal_x, focal_y), "positive focal lengths")
    check_integer(stride, "stride", 1)
    ends = finite_array(range, "range")
    check_array(ends, (2,), "range")
    near, far = ends.tolist()
    if not 0.0 < near < far:
        raise ParameterError("range", range, "two positive depths, the least first")
    rows, columns = np.mgrid[0 : image.shape[0] : stride, 0 : image.shape[1] : stride]
    seen = image[::stride, ::stride]
    with np.errstate(invalid="ignore"):
        kept = (seen >= near) & (seen <= far)
    d = seen[kept]
    local = np.stack([(columns[kept] - center_x) * d / focal_x, (rows[kept] - center_y) * d / focal_y, d], axis=1)
    return np.asarray(local @ placement[:3, :3].T + placement[:3, 3])
