"""Named tuples of arrays in two flat buffers, one of integers and one of floats.

Passing two arrays to compiled code costs a tenth of passing thirty. A layout is the list of fields of a named tuple:
each is annotated ``Integers`` or ``Floats``, or with these and a shape, ``Annotated[Floats, "joints", 3]``. From it
come the sizes of the buffers and the compiled function that slices them. A last field of ``Singles``,
which may be long, is passed as it is.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import Annotated, Any, NamedTuple, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from apex_ompl.kernel.compiled.compilation import Deferred

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Bytes = NDArray[np.int8]
Integers = NDArray[np.int64]


class Field(NamedTuple):
    """A field of a layout.

    Attributes:
        name: Name of the field.
        integer: Whether its numbers are integers.
        single: Whether they are floats of single precision.
        shape: Declared shape: of one row for tables, else of the whole array; names stand for dimensions.
    """

    name: str
    integer: bool
    single: bool
    shape: tuple[int | str, ...]

    @property
    def dtype(self) -> type[np.int64 | np.float64 | np.float32]:
        """Type of its numbers."""
        return np.int64 if self.integer else np.float32 if self.single else np.float64

    def sized(self, dimensions: dict[str, int]) -> tuple[int, ...]:
        """Return the shape with numbers for the names."""
        return tuple(dimensions[n] if isinstance(n, str) else n for n in self.shape)


@cache
def layout(cls: Any) -> tuple[Field, ...]:
    """Return the fields of a named tuple of arrays."""
    found = []
    for name, hint in get_type_hints(cls, include_extras=True).items():
        array, *shape = get_args(hint) if get_origin(hint) is Annotated else (hint,)
        found.append(Field(name, array == Integers, array == Singles, tuple(shape)))
    return tuple(found)


def pack(table: Any, *more: Any) -> tuple[Any, ...]:
    """Return the arrays of a table one after the other: integers and floats, and singles where there are any.

    The integers start with the first and last place of every field, see :func:`table_view`. Of several tables of one
    kind, without singles, each field is that of the first followed by those of the others.
    """
    places: list[int] = []
    parts: dict[bool, list[NDArray[Any]]] = {True: [], False: []}
    fields = layout(table.__class__)
    ends = {True: 2 * sum(not field.single for field in fields), False: 0}
    for field, *arrays in zip(fields, table, *more, strict=True):
        if field.single:
            continue
        places.append(ends[field.integer])
        ends[field.integer] += sum(array.size for array in arrays)
        places.append(ends[field.integer])
        parts[field.integer] += [array.ravel() for array in arrays]
    singles = (array for field, array in zip(fields, table, strict=True) if field.single)
    return np.concatenate([np.array(places, np.int64), *parts[True]]), np.concatenate(parts[False]), *singles


def unpack(cls: Any, integers: Any, floats: Any, *singles: Any) -> Any:
    """Return the inverse of :func:`pack` for Python: a ``cls`` of slices."""
    places, rest, values = iter(integers.tolist()), iter(singles), []
    for field in layout(cls):
        if field.single:
            values.append(next(rest))
            continue
        array = (integers if field.integer else floats)[next(places) : next(places)]
        values.append(array.reshape(-1, *field.shape) if field.shape else array)
    return cls(*values)


def table_view(cls: Any) -> Callable[..., Any]:
    """Return :func:`unpack` for compiled code: ``view(integers, floats[, singles])`` gives a ``cls`` of slices."""

    def make() -> Any:
        from apex_ompl.kernel.compiled.views import table_code

        return table_code(cls, layout(cls))

    return Deferred(make)


def buffer_view(cls: Any, dimensions: Sequence[str]) -> Callable[..., Any]:
    """Return the compiled ``view(integers, floats, sizes)`` that gives a ``cls`` of slices of buffers.

    ``sizes`` is a tuple of the numbers that the names in ``dimensions`` stand for.
    """

    def make() -> Any:
        from apex_ompl.kernel.compiled.views import buffer_code

        return buffer_code(cls, layout(cls), dimensions)

    return Deferred(make)


@cache
def buffer_sizes(cls: Any, **dimensions: int) -> tuple[int, int]:
    """Return how many integers and floats the arrays of a ``cls`` have together."""
    sizes = {True: 0, False: 0}
    for field in layout(cls):
        sizes[field.integer] += math.prod(field.sized(dimensions))
    return sizes[True], sizes[False]


def new_buffers(cls: Any, **dimensions: int) -> tuple[Integers, Floats, Any]:
    """Return new buffers, of zeros, for the arrays of a ``cls``, and the ``cls`` of views of them for Python."""
    integers, floats = (np.zeros(n, t) for n, t in zip(buffer_sizes(cls, **dimensions), (np.int64, float), strict=True))
    views, ends = [], {True: 0, False: 0}
    for field in layout(cls):
        start = ends[field.integer]
        ends[field.integer] += math.prod(field.sized(dimensions))
        buffer = integers if field.integer else floats
        views.append(buffer[start : ends[field.integer]].reshape(field.sized(dimensions)))
    return integers, floats, cls(*views)
