"""Cholesky factors of matrices with a band."""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.compilation import reassociating_inlined
from apex_ompl.kernel.compiled.layout import Floats


@reassociating_inlined
def factorize(gram: Floats) -> bool:
    """Replace the band of a matrix by that of its upper Cholesky factor."""
    n, band = gram.shape
    for k in range(n):
        row = gram[k]
        if not row[0] > 0.0:
            return False
        root = 1.0 / math.sqrt(row[0])
        for j in range(band):
            row[j] *= root
        for m in range(1, min(band, n - k)):
            f = row[m]
            if f == 0.0:
                continue
            target, source = gram[k + m, : band - m], row[m:]
            for j in range(len(target)):
                target[j] -= f * source[j]
    return True


@reassociating_inlined
def solve_transposed(factor: Floats, x: Floats) -> None:
    """Multiply by the inverse of the transpose of a factor of :func:`factorize` in place."""
    n, band = factor.shape
    for k in range(n):
        x[k] /= factor[k, 0]
        f, most = x[k], min(band, n - k)
        row, rest = factor[k, 1:most], x[k + 1 : k + most]
        for j in range(len(rest)):
            rest[j] -= f * row[j]


@reassociating_inlined
def solve_factor(factor: Floats, x: Floats) -> None:
    """Multiply by the inverse of a factor of :func:`factorize` in place."""
    n, band = factor.shape
    for k in range(n - 1, -1, -1):
        total, most = x[k], min(band, n - k)
        row, rest = factor[k, 1:most], x[k + 1 : k + most]
        for j in range(len(rest)):
            total -= row[j] * rest[j]
        x[k] = total / factor[k, 0]
