"""Named tuples of arrays that lie in buffers, as code of LLVM that numba puts where a view is asked for.

The same slices, written in Python, take numba a second for a robot and its workspace in each function that asks. Arrays
are not counted (``_nrt=False``), so that those of a view may be used in compiled code alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from llvmlite import ir
from numba import float32, float64, int64
from numba.core import cgutils
from numba.core.errors import TypingError
from numba.core.types import Array, NamedTuple  # type: ignore[attr-defined]
from numba.extending import intrinsic
from numba.np.arrayobj import make_array, populate_array

INT = ir.IntType(64)


def table_code(cls: Any, fields: Sequence[Any]) -> Callable[..., Any]:
    """Return the compiled ``view(integers, floats[, singles])`` of a table, see :func:`.layout.table_view`."""
    if any(field.single for field in fields[:-1]):
        raise ValueError(f"singles of {cls.__name__} are not its last field")

    def typed(*buffers: Any) -> Any:
        signature = _arrays(cls, fields, buffers)(*buffers)

        def code(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
            sources = _sources(context, builder, signature, arguments)
            places, values = sources[0].data, []
            for k, field in enumerate(fields):
                if field.single:
                    values.append(arguments[2])
                    continue
                first, last = (builder.load(builder.gep(places, [INT(2 * k + n)])) for n in (0, 1))
                row = math.prod(field.shape)
                sizes = [builder.sdiv(builder.sub(last, first), INT(row)), *map(INT, field.shape)]
                array = signature.return_type.types[k]
                values.append(_slice(context, builder, array, sources[not field.integer], first, sizes))
            return context.make_tuple(builder, signature.return_type, values)

        return signature, code

    @intrinsic  # type: ignore[untyped-decorator]
    def view(typing: Any, integers: Any, floats: Any) -> Any:
        del typing
        return typed(integers, floats)

    @intrinsic  # type: ignore[untyped-decorator]
    def view_with_singles(typing: Any, integers: Any, floats: Any, singles: Any) -> Any:
        del typing
        return typed(integers, floats, singles)

    return view_with_singles if any(field.single for field in fields) else view  # type: ignore[no-any-return]


def buffer_code(cls: Any, fields: Sequence[Any], dimensions: Sequence[str]) -> Callable[..., Any]:
    """Return the compiled ``view(integers, floats, sizes)`` of buffers, see :func:`.layout.buffer_view`."""

    @intrinsic  # type: ignore[untyped-decorator]
    def view(typing: Any, integers: Any, floats: Any, sizes: Any) -> Any:
        del typing
        signature = _arrays(cls, fields, (integers, floats), whole=True)(integers, floats, sizes)

        def code(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
            sources = _sources(context, builder, signature, arguments)
            known = dict(zip(dimensions, cgutils.unpack_tuple(builder, arguments[2], len(dimensions)), strict=True))
            ends, values = [INT(0), INT(0)], []
            for k, field in enumerate(fields):
                sizes = [known[n] if isinstance(n, str) else INT(n) for n in field.shape]
                buffer, array = int(not field.integer), signature.return_type.types[k]
                values.append(_slice(context, builder, array, sources[buffer], ends[buffer], sizes))
                ends[buffer] = builder.add(ends[buffer], _product(builder, sizes))
            return context.make_tuple(builder, signature.return_type, values)

        return signature, code

    return view  # type: ignore[no-any-return]


def _arrays(cls: Any, fields: Sequence[Any], buffers: Sequence[Any], whole: bool = False) -> Any:
    """Return numba's type of the named tuple; ``whole`` where shapes are those of arrays and not of rows."""
    numbers = int64, float64, float32
    wanted = [Array(n, 1, "C", readonly=not buffer.mutable) for n, buffer in zip(numbers, buffers, strict=False)]
    if list(buffers) != wanted:
        raise TypingError(f"buffers of {cls.__name__} are {buffers}, expected {wanted}")
    types = []
    for field in fields:
        source = buffers[2 if field.single else not field.integer]
        axes = 1 if field.single else len(field.shape) + (not whole)
        types.append(Array(source.dtype, axes, "C", readonly=not source.mutable))
    return NamedTuple(types, cls)


def _sources(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> list[Any]:
    """Return the buffers of integers and of floats."""
    return [make_array(signature.args[k])(context, builder, arguments[k]) for k in (0, 1)]


def _slice(context: Any, builder: Any, array: Any, source: Any, first: Any, sizes: Sequence[Any]) -> Any:
    """Return the array of a shape that starts at one of the numbers of a buffer."""
    found, step = make_array(array)(context, builder), INT(8)  # bytes of a number
    strides = [step]
    for size in reversed(sizes[1:]):
        strides.insert(0, builder.mul(strides[0], size))
    populate_array(
        found, data=builder.gep(source.data, [first]), shape=cgutils.pack_array(builder, sizes),
        strides=cgutils.pack_array(builder, strides), itemsize=step, meminfo=None,
    )  # fmt: skip
    return found._getvalue()


def _product(builder: Any, sizes: Sequence[Any]) -> Any:
    found = INT(1)
    for size in sizes:
        found = builder.mul(found, size)
    return found
