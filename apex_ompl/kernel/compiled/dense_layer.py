"""Dense layers of neural networks for a few rows at a time, with weights in eight bits.

A few proposals cost what reading the weights costs; BLAS would spend most of its time packing them, and in single
precision they would be four times as many bytes.
"""

from __future__ import annotations

import numpy as np

from apex_ompl.kernel.compiled.compilation import inlined, reassociating_entry_point
from apex_ompl.kernel.compiled.layout import Bytes, Singles


@inlined
def _four_rows(weight: Bytes, scale: Singles, bias: Singles, rows: Singles, b: int, out: Singles) -> None:
    """Put four rows from ``b`` on into place, by two rows of weights at a time: eight sums stay in registers."""
    zero = np.float32(0.0)
    x0, x1, x2, x3 = rows[b], rows[b + 1], rows[b + 2], rows[b + 3]
    for first in range(0, len(weight), 2):
        i, j = first, min(first + 1, len(weight) - 1)  # the last row is done twice where their number is odd
        v, w = weight[i], weight[j]
        s0, s1, s2, s3, t0, t1, t2, t3 = zero, zero, zero, zero, zero, zero, zero, zero
        for k in range(len(v)):
            a, c = np.float32(v[k]), np.float32(w[k])
            s0 += a * x0[k]
            s1 += a * x1[k]
            s2 += a * x2[k]
            s3 += a * x3[k]
            t0 += c * x0[k]
            t1 += c * x1[k]
            t2 += c * x2[k]
            t3 += c * x3[k]
        a, c = scale[i], scale[j]
        out[b, i], out[b + 1, i], out[b + 2, i], out[b + 3, i] = s0 * a, s1 * a, s2 * a, s3 * a
        out[b, j], out[b + 1, j], out[b + 2, j], out[b + 3, j] = t0 * c, t1 * c, t2 * c, t3 * c
    for r in range(b, b + 4):
        for i in range(len(bias)):
            out[r, i] += bias[i]


@inlined
def _row(weight: Bytes, scale: Singles, bias: Singles, x: Singles, out: Singles) -> None:
    """Put one row into place."""
    zero = np.float32(0.0)
    for first in range(0, len(weight), 2):
        i, j = first, min(first + 1, len(weight) - 1)
        v, w = weight[i], weight[j]
        s, t = zero, zero
        for k in range(len(v)):
            s += np.float32(v[k]) * x[k]
            t += np.float32(w[k]) * x[k]
        out[i], out[j] = s * scale[i] + bias[i], t * scale[j] + bias[j]


@reassociating_entry_point
def dense_layer(weight: Bytes, scale: Singles, bias: Singles, rows: Singles, out: Singles) -> None:
    """Put rows (scale W)^T + bias into ``out``; four rows at a time pass over the weights together.

    Args:
        weight: W, shape (after, before).
        scale: Of its rows, shape (after,).
        bias: Shape (after,).
        rows: Shape (B, before).
        out: Shape (B, after).
    """
    fours = len(rows) - len(rows) % 4
    for b in range(0, fours, 4):
        _four_rows(weight, scale, bias, rows, b, out)
    for b in range(fours, len(rows)):
        _row(weight, scale, bias, rows[b], out[b])
