"""Arrays as compiled code takes them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from apex_ompl.types import Array


def compact(values: ArrayLike) -> Array:
    """Return numbers as compiled code takes them, the same array where it is like that: in C order, and writeable.

    Code would be compiled anew for arrays that are read-only, or laid out otherwise.
    """
    if isinstance(values, np.ndarray) and values.dtype == float and values.flags.carray:
        return values
    found: Array = np.require(values, float, ["C", "W"])
    return found
