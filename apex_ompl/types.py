"""Array types shared by all packages."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Floating-point array; docstrings give its shape and unit."""
