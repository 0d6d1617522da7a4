"""The polynomial of fifth degree that a joint trajectory controller follows between two points."""

from __future__ import annotations

import numpy as np


def quintic(span: float, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the coefficients through two states, rows of position, velocity and acceleration: shape (6, joints).

    Args:
        span: Time between them [s].
        before: The first state, shape (3, joints).
        after: The second one, shape (3, joints).
    """
    t = span ** np.arange(6)
    rows = np.zeros((6, 6))
    rows[0, 0], rows[1, 1], rows[2, 2] = 1.0, 1.0, 2.0
    rows[3] = t
    rows[4, 1:] = np.arange(1, 6) * t[:5]
    rows[5, 2:] = np.arange(2, 6) * np.arange(1, 5) * t[:4]
    return np.linalg.solve(rows, np.concatenate([before, after]))
