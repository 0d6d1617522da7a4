"""Matrices of weights in eight bits: whole numbers, and a scale for each row.

Symmetric linear quantization by rows (Jacob et al., CVPR 2018, with a zero point of 0). Reading weights from memory
takes most of the time of a few proposals: NumPy's models compute with the bytes
(:func:`apex_ompl.kernel.products.dense_layer`), torch's with what they are expanded to.
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
    """Return weights whose large matrices of layers are int8, with scales of their rows as ``NAME.scale``.

    Those that are in eight bits already stay as they are.
    """
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


def is_scale(name: str, weights: Mapping[str, NDArray[Any]]) -> bool:
    """Whether a name is that of the scales of a matrix in eight bits."""
    matrix = weights.get(name.removesuffix(SUFFIX)) if name.endswith(SUFFIX) else None
    return matrix is not None and matrix.dtype == np.int8


def check_scales(weights: Mapping[str, NDArray[Any]]) -> None:
    """Check that there is a scale for each row of the matrices in eight bits.

    Raises:
        ValueError: Scales are missing, or are not one for each row.
    """
    for name, values in weights.items():
        scale = weights.get(name + SUFFIX)
        if values.dtype == np.int8 and (scale is None or scale.shape != values.shape[:1]):
            raise ValueError(f"{name}: expected a scale for each row of a matrix in eight bits")


def expanded(weights: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return weights with the matrices that are int8 as float32, without their scales.

    Raises:
        ValueError: Scales are missing, or are not one for each row.
    """
    check_scales(weights)
    found = {name: values for name, values in weights.items() if not is_scale(name, weights)}
    for name, values in found.items():
        if values.dtype == np.int8:
            found[name] = values.astype(np.float32) * weights[name + SUFFIX].astype(np.float32)[:, None]
    return found
