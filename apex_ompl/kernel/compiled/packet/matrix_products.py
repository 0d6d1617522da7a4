"""Products of matrices whose bits are those of any processor: BLAS adds in an order that depends on the processor."""

from __future__ import annotations

from apex_ompl.kernel.compiled.compilation import entry_point
from apex_ompl.kernel.compiled.layout import Floats


@entry_point
def matrix_products(a: Floats, b: Floats, out: Floats) -> None:
    """Put the products of matrices into ``out``; of one matrix by many the one is given once.

    Args:
        a: Shape (S, n, k), or (1, n, k).
        b: Shape (S, k, m), or (1, k, m).
        out: Gets the products, shape (S, n, m).
    """
    for s in range(len(out)):
        first, second, found = a[s % len(a)], b[s % len(b)], out[s]
        for i in range(found.shape[0]):
            row = found[i]
            for j in range(len(row)):
                row[j] = 0.0
            for k in range(first.shape[1]):
                factor, other = first[i, k], second[k]
                for j in range(len(row)):
                    row[j] += factor * other[j]


@entry_point
def solve_factored(factor: Floats, right: Floats) -> None:
    """Replace the columns of ``right``, shape (n, m), by the solutions x of L L^T x = right.

    Args:
        factor: Lower triangular L, shape (n, n).
        right: Right-hand sides.
    """
    n, m = right.shape
    for i in range(n):
        for k in range(i):
            for j in range(m):
                right[i, j] -= factor[i, k] * right[k, j]
        for j in range(m):
            right[i, j] /= factor[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            for j in range(m):
                right[i, j] -= factor[k, i] * right[k, j]
        for j in range(m):
            right[i, j] /= factor[i, i]


@entry_point
def factorize(matrix: Floats, factor: Floats) -> None:
    """Put the lower Cholesky factor of a symmetric, positive definite matrix (n, n) into ``factor``."""
    n = len(matrix)
    for i in range(n):
        for j in range(n):
            total = matrix[i, j] if j <= i else 0.0
            for k in range(min(i, j)):
                total -= factor[i, k] * factor[j, k]
            factor[i, j] = 0.0 if j > i else total**0.5 if i == j else total / factor[j, j]
