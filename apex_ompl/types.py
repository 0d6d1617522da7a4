"""Array types shared by all packages; docstrings give shapes and units."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Real numbers."""

Flags = NDArray[np.bool_]
"""One answer, yes or no, for each row of another array."""

Indices = NDArray[np.int64]
"""Integers that number rows of other arrays."""
