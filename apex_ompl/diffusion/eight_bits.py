"""Matrices of weights in eight bits: whole numbers, and a scale for each row.

Symmetric linear quantization by rows (Jacob et al., CVPR 2018, with a zero point of 0). Weights take a byte in files;
they are expanded when they are read, and computed with as before.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

SUFFIX = ".scale"
LEAST = 2**12  # numbers of a matrix that is worth it
MOST = 127


def quantized(weights: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return weights whose large matrices of layers are int8, with scales of their rows as ``NAME.scale``."""
    found = {}
    for name, values in weights.items():
        if (
            not name.endswith("weight")
            or values.ndim != 2
            or values.size < LEAST
            or not np.issubdtype(values.dtype, np.floating)
        ):
            found[name] = values
            continue
        wide = values.astype(np.float32)
        scale = np.maximum(np.abs(wide).max(axis=1), np.finfo(np.float32).tiny) / MOST
        found[name] = np.round(wide / scale[:, None]).astype(np.int8)
        found[name + SUFFIX] = scale
    return found


def expanded(weights: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return weights with the matrices that are int8 as float32, without their scales.

    Raises:
        ValueError: Scales are missing, or are not one for each row.
    """
    found = {}
    for name, values in weights.items():
        if name.endswith(SUFFIX) and weights.get(name.removesuffix(SUFFIX), values).dtype == np.int8:
            continue
        if values.dtype != np.int8:
            found[name] = values
            continue
        scale = weights.get(name + SUFFIX)
        if scale is None or scale.shape != values.shape[:1]:
            raise ValueError(f"{name}: expected a scale for each row of a matrix in eight bits")
        found[name] = values.astype(np.float32) * scale.astype(np.float32)[:, None]
    return found
