"""PLY files (the Stanford format, 1.0): their elements as arrays, of meshes and of clouds of points alike."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apex_ompl.types import Array

TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
LISTS = ("vertex_indices", "vertex_index")  # names of the corners of a face


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
