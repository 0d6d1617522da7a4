"""Dense layers of neural networks for a few rows at a time, where BLAS spends most of its time packing the weights."""

from __future__ import annotations

import numpy as np

from apex_ompl.kernel.compiled.compilation import reassociating_entry_point
from apex_ompl.kernel.compiled.layout import Singles


@reassociating_entry_point
def dense_layer(weight: Singles, bias: Singles, rows: Singles, out: Singles) -> None:
    """Put rows W^T + bias into ``out``; four rows at a time pass over the weights together.

    Args:
        weight: W, shape (after, before).
        bias: Shape (after,).
        rows: Shape (B, before).
        out: Shape (B, after).
    """
    zero = np.float32(0.0)
    count, fours = len(rows), len(rows) - len(rows) % 4
    for b in range(0, fours, 4):
        x0, x1, x2, x3 = rows[b], rows[b + 1], rows[b + 2], rows[b + 3]
        for i in range(len(weight)):
            w = weight[i]
            s0, s1, s2, s3 = zero, zero, zero, zero
            for k in range(len(w)):
                s0 += w[k] * x0[k]
                s1 += w[k] * x1[k]
                s2 += w[k] * x2[k]
                s3 += w[k] * x3[k]
            out[b, i], out[b + 1, i] = s0 + bias[i], s1 + bias[i]
            out[b + 2, i], out[b + 3, i] = s2 + bias[i], s3 + bias[i]
    for b in range(fours, count):
        x0 = rows[b]
        for i in range(len(weight)):
            w = weight[i]
            s0 = zero
            for k in range(len(w)):
                s0 += w[k] * x0[k]
            out[b, i] = s0 + bias[i]
