"""Proofs that whole curves are free, by spheres and exact shapes; see ``compiled/check/curve_proof.py``."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np

from apex_ompl.kernel.compiled.check import curve_proof
from apex_ompl.kernel.compiled.check.curve_proof import MORE, OUTSIDE, PROVED, TOUCHING
from apex_ompl.kernel.compiled.geometry.shapes import PairBuffers
from apex_ompl.kernel.compiled.layout import new_buffers
from apex_ompl.kernel.kernel import Kernel
from apex_ompl.types import Array

__all__ = ["MORE", "OUTSIDE", "PROVED", "TOUCHING", "CurveArrays", "CurveProof"]


class CurveArrays(Protocol):
    """A curve through the joint space: straight lines between states, or cubic pieces over time.

    Attributes:
        knots: Increasing parameters of the states, shape (K,): lengths [rad], or times [s].
        states: Shape (K, dof).
        rates: Velocities and accelerations side by side, shape (K, 2 dof); (0, 2 dof) for straight lines.
        slack: Sum of the gaps between the pieces, by rounding [rad].
    """

    @property
    def knots(self) -> Array: ...  # noqa: D102
    @property
    def states(self) -> Array: ...  # noqa: D102
    @property
    def rates(self) -> Array: ...  # noqa: D102
    @property
    def slack(self) -> float: ...  # noqa: D102


class ProofFigures(NamedTuple):
    """What a proof of a curve has found.

    Attributes:
        margin: Lower bound of the clearance, by which distances are compared [m].
        least: Least distance found [m].
        where: Parameter of the curve at which it was found.
        by_spheres: Length of the curve that the sphere covers proved alone.
    """

    margin: float
    least: float
    where: float
    by_spheres: float


class CurveProof:
    """One thread's proof of a curve, between calls and after its end; a next one may be started.

    Attributes:
        robot: The robot that it was made for.
    """

    def __init__(self, kernel: Kernel) -> None:
        """Allocate buffers for proofs of a kernel's robot."""
        self.robot = kernel.robot
        self._state: curve_proof.ProofBuffers
        integers, floats, self._state = new_buffers(curve_proof.ProofBuffers, dof=kernel.robot.dof)
        self._buffers = (*kernel.workspace(), *new_buffers(PairBuffers)[:2], integers, floats)

    def start(self, kernel: Kernel, shapes: tuple[Any, ...], curve: CurveArrays, limit: float) -> None:
        """Start the proof of a curve.

        Args:
            kernel: The robot among its obstacles.
            shapes: Packed :class:`apex_ompl.kernel.arrays.ShapeArrays` of bodies and obstacles, and the rows of the
                obstacles by number.
            curve: The curve.
            limit: Clearance above which none is looked for [m]; 0 for a bare proof.
        """
        p = self._state
        self._arrays = (*kernel.packed, *shapes, *self._buffers, curve.knots, curve.states, curve.rates, curve.slack)
        p.places[:] = 0, 1, 0
        p.pairs[0], p.intervals[0] = curve_proof.ALL, (curve.knots[0], curve.knots[-1])
        p.worst[:] = -1
        p.figures[:] = limit, np.inf, curve.knots[0], 0.0

    def advance(self, touch: float, tolerance: float, share: float, budget: int) -> int:
        """Go on with the proof; return MORE where it is not at its end, else PROVED, TOUCHING, OUTSIDE or another.

        Args:
            touch: Distance of a pair that counts as contact [m].
            tolerance: Tolerance of the least clearance [m]; 0 asks for the proof alone.
            share: The same as a share of the clearance; the larger one counts.
            budget: Most intervals to look at.
        """
        return int(curve_proof.prove_curve(*self._arrays, touch, tolerance, share, budget))

    @property
    def figures(self) -> ProofFigures:
        """What is known so far."""
        return ProofFigures(*self._state.figures.tolist())

    @property
    def pair(self) -> tuple[int, int]:
        """Rows of the pair with the least distance found: a body, and another or -1 - obstacle; (-1, -1) for none."""
        first, second = self._state.worst.tolist()
        return first, second

    @property
    def middle(self) -> float:
        """Parameter in the middle of the last interval."""
        return float(self._state.where[0])

    @property
    def state(self) -> Array:
        """State in the middle of the last interval, shape (dof,)."""
        return self._state.state.copy()

    @property
    def intervals(self) -> int:
        """Number of intervals examined."""
        return int(self._state.places[2])
