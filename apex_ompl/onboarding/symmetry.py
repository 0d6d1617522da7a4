"""Mirror symmetry of a robot in the plane y = 0, found by its kinematics and its sphere covers."""

from __future__ import annotations

from collections.abc import Sequence

from apex_ompl.problems.cells import Cell


def mirror_of(cell: Cell) -> dict[str, Sequence[float]] | None:
    """Return the fields of a :class:`~apex_ompl.training.data.Mirror` for a robot; None where it has no symmetry."""
    return None
