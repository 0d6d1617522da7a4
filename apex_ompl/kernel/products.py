"""Matrix products, solutions and dense layers: the same bits on all processors, so that seeds give the same paths.

BLAS and LAPACK choose their code, and with it the order of sums, by the processor that they find.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from apex_ompl.kernel.compiled.layout import Bytes, Singles
from apex_ompl.kernel.compiled.network import dense_layer as compiled_layer
from apex_ompl.kernel.compiled.packet.matrix_products import factorize, matrix_products, solve_factored
from apex_ompl.types import Array
from apex_ompl.util.arrays import compact


def product(a: ArrayLike, b: ArrayLike) -> Array:
    """Return a @ b in double precision, for matrices of shapes (..., n, k) and (..., k, m).

    Raises:
        ValueError: The shapes do not fit.
    """
    first, second = compact(np.asarray(a, float)), compact(np.asarray(b, float))
    if first.shape[-1] != second.shape[-2]:
        raise ValueError(f"matrices of shapes {first.shape} and {second.shape} have no product")
    if second.ndim == 2:  # one call for all rows
        rows = math.prod(first.shape[:-1])
        found = np.empty((1, rows, second.shape[1]))
        matrix_products(first.reshape(1, rows, len(second)), second[None], found)
        return found.reshape(*first.shape[:-1], second.shape[1])
    stack = np.broadcast_shapes(first.shape[:-2], second.shape[:-2])
    if first.ndim > 2 and first.shape[:-2] != stack:
        first = compact(np.broadcast_to(first, (*stack, *first.shape[-2:])))
    if second.shape[:-2] != stack:
        second = compact(np.broadcast_to(second, (*stack, *second.shape[-2:])))
    found = np.empty((math.prod(stack), first.shape[-2], second.shape[-1]))
    matrix_products(_stacked(first), _stacked(second), found)
    return found.reshape(*stack, *found.shape[1:])


def _stacked(matrices: Array) -> Array:
    return matrices.reshape(math.prod(matrices.shape[:-2]), *matrices.shape[-2:])


def cholesky(matrix: ArrayLike) -> Array:
    """Return the lower Cholesky factor of a symmetric, positive definite matrix, shape (n, n)."""
    given = compact(np.asarray(matrix, float))
    factor = np.empty_like(given)
    factorize(given, factor)
    return factor


def solve(factor: Array, right: ArrayLike) -> Array:
    """Return the solutions X of L L^T X = R, shape (n, m), for a factor of :func:`cholesky`."""
    found = np.array(right, float, order="C")
    solve_factored(compact(factor), found)
    return found


def dense_layer(weight: Bytes, scale: Singles, bias: Singles, rows: Singles) -> Singles:
    """Return rows (scale W)^T + bias, the output of a dense layer with weights in eight bits, shape (B, after).

    Args:
        weight: W, shape (after, before).
        scale: Factor on each of its rows, shape (after,).
        bias: Shape (after,).
        rows: Shape (B, before).
    """
    found = np.empty((len(rows), len(weight)), np.float32)
    compiled_layer.dense_layer(weight, scale, bias, rows, found)
    return found
