"""Dense layers of neural networks for a few rows at a time, with weights in eight bits.

A few proposals cost what reading the weights costs; BLAS would spend most of its time packing them, and in single
precision they would be four times as many bytes.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from apex_ompl.kernel.compiled.compilation import Deferred, entry_point, inlined
from apex_ompl.kernel.compiled.layout import Bytes, Singles

LANES = 8  # numbers that are added side by side; the same for all processors, so that results are
TILE = 2  # rows of weights by four others, whose sums stay in registers
ALONE = 8  # rows of weights by one other


def _products(weights: int, rows: int) -> Any:
    def make() -> Any:
        from apex_ompl.kernel.compiled.packet.vector_products import row_products

        return row_products(weights, rows, LANES)

    return Deferred(make)


_by_four, _by_one = _products(TILE, 4), _products(ALONE, 1)


@inlined
def _rest(weight: Bytes, i: int, rows: Singles, b: int) -> float:
    """Return the part of the sum of products of two rows that remains after whole vectors."""
    found = np.float32(0.0)
    for k in range(weight.shape[1] - weight.shape[1] % LANES, weight.shape[1]):
        found += np.float32(weight[i, k]) * rows[b, k]
    return float(found)


@entry_point
def dense_layer(weight: Bytes, scale: Singles, bias: Singles, rows: Singles, out: Singles) -> None:
    """Put rows (scale W)^T + bias into ``out``; up to four rows at a time pass over the weights together.

    Args:
        weight: W, shape (after, before).
        scale: Of its rows, shape (after,).
        bias: Shape (after,).
        rows: Shape (B, before).
        out: Shape (B, after).
    """
    after, whole = len(weight), weight.shape[1] % LANES == 0
    for b in range(0, len(rows), 4):
        together = min(4, len(rows) - b)
        if together > 1:
            for i in range(0, after, TILE):
                sums = _by_four(weight, i, rows, b)
                for m in range(min(TILE, after - i)):
                    for n in range(together):
                        out[b + n, i + m] = sums[4 * m + n] * scale[i + m] + bias[i + m]
        else:
            for i in range(0, after, ALONE):
                sums = _by_one(weight, i, rows, b)
                for m in range(min(ALONE, after - i)):
                    out[b, i + m] = sums[m] * scale[i + m] + bias[i + m]
        if not whole:
            for n in range(b, b + together):
                for i in range(after):
                    out[n, i] += _rest(weight, i, rows, n) * scale[i]
