"""Lower bounds of the distance of two bodies over boxes of joint values, by their exact shapes."""

from __future__ import annotations

import numpy as np

from apex_ompl.kernel.arrays import Floats, Integers
from apex_ompl.kernel.compiled.check import box_bound
from apex_ompl.kernel.compiled.geometry.shapes import PairBuffers
from apex_ompl.kernel.compiled.layout import new_buffers
from apex_ompl.kernel.kernel import Kernel
from apex_ompl.types import Array
from apex_ompl.util.arrays import compact


class BoxBounds:
    """Bounds for the bodies of a kernel."""

    def __init__(self, kernel: Kernel, shapes: tuple[Integers, Floats]) -> None:
        """Allocate memory.

        Args:
            kernel: The kernel.
            shapes: Packed :class:`apex_ompl.kernel.arrays.ShapeArrays` of its bodies.
        """
        buffers = *kernel.workspace(), *new_buffers(PairBuffers)[:2], *new_buffers(box_bound.BoxBuffers)[:2]
        self._arrays = (*kernel.robot.packed, *shapes, *buffers)

    def over(
        self, first: int, second: int, middles: Array, half: Array, *, least: float, need: float, most: int = 4096
    ) -> Array:
        """Return lower bounds of the distance of two bodies over boxes of states, shape (N,) [m].

        The formula is that of :mod:`apex_ompl.kernel.compiled.check.box_bound`.

        Args:
            first: A body.
            second: Another body.
            middles: Middles of the boxes, shape (N, dof).
            half: Half widths of all of them, shape (dof,).
            least: Bounds that are not larger may be given as minus infinity [m].
            need: Bounds that are larger may be given as smaller ones, which are not smaller than this [m].
            most: Pairs of convex pieces that are examined for a box at most; beyond it is minus infinity.
        """
        found = np.empty(len(middles))
        box_bound.box_bounds(*self._arrays, first, second, compact(middles), compact(half), least, need, most, found)
        return found
