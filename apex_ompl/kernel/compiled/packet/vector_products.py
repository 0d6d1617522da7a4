"""Products of few rows by few rows, several numbers at a time, as code of LLVM that numba puts where it is called.

(The same for factors of matrices gained nothing.)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from llvmlite import ir
from numba import float32
from numba.core import cgutils
from numba.core.types import UniTuple  # type: ignore[attr-defined]
from numba.extending import intrinsic

BYTE, WORD, SINGLE = ir.IntType(8), ir.IntType(32), ir.FloatType()


def row_products(weights: int, rows: int, lanes: int) -> Callable[..., Any]:
    """Return a compiled function of some rows of weights, in eight bits, by some rows of numbers.

    ``products(weight, i, x, b)``, with matrices of shapes (N, K) and (B, K), gives the sums of
    ``weight[i + m, k] * x[b + n, k]`` over k, the last K % lanes left out, at ``rows * m + n``. For rows after the
    last one of a matrix that one is taken.
    """

    @intrinsic  # type: ignore[untyped-decorator]
    def products(typing: Any, weight: Any, i: Any, x: Any, b: Any) -> Any:
        del typing
        signature = UniTuple(float32, weights * rows)(weight, i, x, b)

        def code(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
            first, second = (context.make_array(signature.args[k])(context, builder, arguments[k]) for k in (0, 2))
            width = cgutils.unpack_tuple(builder, first.shape, 2)[1]
            some = _addresses(builder, first, arguments[1], weights)
            others = _addresses(builder, second, arguments[3], rows)
            whole = builder.sub(width, builder.srem(width, width.type(lanes)))
            sums = _sums(builder, some, others, whole, lanes)
            return context.make_tuple(builder, signature.return_type, sums)

        return signature, code

    return products  # type: ignore[no-any-return]


def _addresses(builder: Any, matrix: Any, first: Any, count: int) -> list[Any]:
    """Return where some rows of a matrix start; after the last row it is that one."""
    rows, width = cgutils.unpack_tuple(builder, matrix.shape, 2)
    last, found = builder.sub(rows, rows.type(1)), []
    for k in range(count):
        row = builder.add(first, rows.type(k))
        row = builder.select(builder.icmp_signed("<", row, last), row, last)
        found.append(builder.gep(matrix.data, [builder.mul(row, width)]))
    return found


def _sums(builder: Any, weights: list[Any], rows: list[Any], count: Any, lanes: int) -> list[Any]:
    """Return the sums of products of bytes and numbers at some addresses, the number of which ``lanes`` divides."""
    vector, bytes_, words = _kind(SINGLE, lanes), _kind(BYTE, lanes), _kind(WORD, lanes)
    zero = ir.Constant(vector, [0.0] * lanes)
    sums = [cgutils.alloca_once_value(builder, zero) for _ in range(len(weights) * len(rows))]
    with cgutils.for_range_slice(builder, count.type(0), count, count.type(lanes)) as (k, _):
        numbers = [_load(builder, _place(builder, row, k, vector)) for row in rows]
        for m, weight in enumerate(weights):
            whole = builder.sext(_load(builder, _place(builder, weight, k, bytes_)), words)
            factor = builder.sitofp(whole, vector)
            for n, number in enumerate(numbers):
                place = sums[len(rows) * m + n]
                builder.store(_multiply_add(builder, factor, number, builder.load(place)), place)
    return _added_up(builder, [builder.load(place) for place in sums])


def _added_up(builder: Any, vectors: list[Any]) -> list[Any]:
    """Return the sums of the numbers of vectors, the number of which is a power of 2 and at most their lanes."""
    count = len(vectors)
    while len(vectors) > 1:
        vectors = [_pairs_added(builder, a, b) for a, b in zip(vectors[::2], vectors[1::2], strict=True)]
    found = vectors[0]
    while found.type.count > count:
        found = _pairs_added(builder, found, None)
    return [builder.extract_element(found, WORD(k)) for k in range(count)]


def _pairs_added(builder: Any, first: Any, second: Any) -> Any:
    """Return the sums of neighbors in a vector, and after them those in another one, if there is one."""
    other = ir.Constant(first.type, ir.Undefined) if second is None else second
    width = first.type.count * (1 if second is None else 2)
    halves = []
    for start in (0, 1):
        chosen = list(range(start, width, 2))
        halves.append(builder.shuffle_vector(first, other, ir.Constant(_kind(WORD, len(chosen)), chosen)))
    return builder.fadd(*halves)


def _kind(of: Any, lanes: int) -> Any:
    """Return the type of a vector."""
    return ir.VectorType(of, lanes)


def _place(builder: Any, address: Any, k: Any, kind: Any) -> Any:
    """Return the address of a value of a type that starts at the k-th number after an address."""
    return builder.bitcast(builder.gep(address, [k]), kind.as_pointer())


def _load(builder: Any, place: Any) -> Any:
    """Return what is at an address, however that is aligned."""
    return builder.load(place, align=1)


def _multiply_add(builder: Any, a: Any, b: Any, c: Any) -> Any:
    """Return a * b + c, rounded once where the processor can do that."""
    fused = ir.FunctionType(a.type, [a.type] * 3)
    name = f"llvm.fmuladd.v{a.type.count}f32"
    return builder.call(cgutils.get_or_insert_function(builder.module, fused, name), [a, b, c])
