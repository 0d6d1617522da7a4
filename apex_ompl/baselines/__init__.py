"""The rivals that APEX is compared with: GPMP, DAMON, dynamic RRT, imitation learning, and reactive control.

Their weights are no part of the wheel: the source tree has them under ``benchmarks/baselines``, and scripts make them.
"""

from __future__ import annotations

from pathlib import Path

_WEIGHTS = Path(__file__).resolve().parents[2] / "benchmarks" / "baselines"


def weights_folder(name: str = "") -> Path:
    """Return the folder in which the source tree has the weights of a baseline; it need not be there."""
    return _WEIGHTS / name
