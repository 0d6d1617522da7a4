"""Trajectory optimization on B-spline control points: paths made clear of obstacles, and then short.

One optimizer serves repair, shortening and data generation. It needs NumPy and the compiled kernel only; the full
check is handed in.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apex_ompl.errors import ParameterError
from apex_ompl.kernel import Kernel
from apex_ompl.kernel.path import CostSettings, PathGrid, PathReport, optimization_buffers, optimize_path, path_cost
from apex_ompl.kernel.products import cholesky, product, solve
from apex_ompl.paths.settings import OptimizerSettings
from apex_ompl.paths.spline import Spline
from apex_ompl.types import Array
from apex_ompl.util.arrays import compact
from apex_ompl.util.display import fields_line, values_line
from apex_ompl.util.validation import check_array, check_integer, check_nonnegative

Check = Callable[[Array], bool]
"""Whether a path, shape (states, dof), is valid."""

STIFFNESSES = (25.0, 5.0, 1.0, 0.1)  # factors on the stiffness in shortening, until a path comes out valid
STIFFEST = 125.0  # factor in the round after the first of these
PART = 4  # steps between two looks at the clock
FINER = 2  # factor on the number of samples for paths that are clear at them and yet not valid
COARSER = 2  # divisor of the number of samples by which fresh candidates are ranked
LAST_RESORT = 0.1  # factor on the stiffness where nothing came out valid


@dataclass(frozen=True, eq=False)
class OptimizationResult:
    """Paths after some optimizer steps.

    Attributes:
        control: Control points, shape (B, points, dof).
        cost: Total cost, shape (B,).
        clearance_cost: Part of the cost that is due to clearance, shape (B,).
        clearance: Smallest clearances of the sphere cover at the samples, to the scene and of the robot to itself,
            where they are below the margins, and else the margins; shape (B, 2) [m].
        steps: Number of steps taken, shape (B,).
        damping: Damping of the next step, shape (B,).
    """

    control: Array
    cost: Array
    clearance_cost: Array
    clearance: Array
    steps: NDArray[np.int64]
    damping: Array

    __repr__ = fields_line


_prepared: set[Spline] = set()  # for which code is loaded


class Optimizer:
    """Levenberg-Marquardt on control points of batches of paths; thread-safe, without random numbers of its own.

    The cost is the squared speed and the squared violations of the margins, see
    :func:`apex_ompl.kernel.path.path_cost`. Limits are kept by the control points.
    """

    def __init__(self, spline: Spline | None = None, settings: OptimizerSettings | None = None) -> None:
        """Work on control points of ``spline``."""
        self.spline = spline or Spline()
        self.settings = settings or OptimizerSettings()

    def __repr__(self) -> str:
        """Return the spline and the settings."""
        return values_line("Optimizer", vars(self), {"spline": Spline(), "settings": OptimizerSettings()})

    def prepare(self, kernel: Kernel) -> None:
        """Load or compile now what the first steps in a process need."""
        if self.spline not in _prepared:
            self.improve(kernel, np.zeros((1, self.spline.points, kernel.robot.dof)), steps=0)
            _prepared.add(self.spline)

    def finer(self) -> Optimizer:
        """Return an optimizer with more samples."""
        return Optimizer(self.spline, replace(self.settings, samples=FINER * self.settings.samples))

    def coarser(self) -> Optimizer:
        """Return an optimizer with fewer samples."""
        return Optimizer(self.spline, replace(self.settings, samples=max(1, self.settings.samples // COARSER)))

    def starts(self, start: Array, goal: Array, count: int, rng: np.random.Generator, size: float = 1.0) -> Array:
        """Return the straight line, and bumped ones: count paths from a state to another, shape (count, points, dof).

        Bumps are drawn from the normal distribution whose inverse covariance is the integral of the acceleration
        squared (the prior of STOMP, Kalakrishnan et al. 2011); each joint strays by about ``size`` [rad] at most.

        Raises:
            ParameterError: ``count`` is not positive.
        """
        check_integer(count, "count", 1)
        line = self.spline.line(start, goal)
        bumps = product(_bumps(self.spline), rng.normal(size=(count, self.spline.free, line.shape[1])))
        bumps[0] = 0.0
        paths = np.repeat(line[None], count, axis=0)
        paths[:, self.spline.inner] += size * bumps
        return paths

    def evaluate(self, kernel: Kernel, control: ArrayLike) -> tuple[OptimizationResult, Array]:
        """Return what paths, shape (B, points, dof), cost, and its gradient, shape (B, free points, dof).

        Raises:
            ParameterError: Control points of another shape.
        """
        control = self._control(kernel, control)
        grid, sizes = _grid(self.spline, self.settings.samples), (self.spline.free, control.shape[2])
        buffers, settings = self._buffers(control.shape[2]), self._cost_settings()
        gradients = np.empty((len(control), sizes[0] * sizes[1]))
        reports = [
            path_cost(kernel, grid, self.spline.pinned, points, settings, buffers, gradient)
            for points, gradient in zip(control, gradients, strict=True)
        ]
        return self._result(control, reports), gradients.reshape(-1, *sizes)

    def improve(
        self,
        kernels: Kernel | Sequence[Kernel],
        control: ArrayLike,
        *,
        steps: int | None = None,
        stiffness: float | None = None,
        damping: ArrayLike | None = None,
        enough: float = np.inf,
    ) -> OptimizationResult:
        """Return paths with lower costs.

        Args:
            kernels: The robot among its obstacles: one for all paths, or one for each, of the same number of joints.
            control: Control points, shape (B, points, dof); the pinned ones stay, the others are put inside limits.
            steps: Most steps, those that failed among them; by default the settings'.
            stiffness: By default the settings'.
            damping: Damping of the first step, one for all or one for each; by default the settings'.
            enough: A path is left alone as soon as both of its clearances reach this [m].

        Raises:
            ParameterError: Control points of another shape, or another number of kernels.
        """
        several = [kernels] if isinstance(kernels, Kernel) else list(kernels)
        control = self._control(several[0], control).copy() if several else np.asarray(control, float)
        each = several * len(control) if isinstance(kernels, Kernel) else several
        if len(each) != len(control) or any(k.robot.dof != control.shape[2] for k in each):
            raise ParameterError("kernels", len(each), f"{len(control)}, one for each path, or one alone")
        for name, number in (("steps", steps), ("stiffness", stiffness), ("damping", damping)):
            if len(control) and number is not None:
                check_nonnegative(number, name)
        grid = _grid(self.spline, self.settings.samples)
        settings = self._cost_settings(steps, stiffness, enough)
        dampings = np.broadcast_to(self.settings.damping if damping is None else damping, len(control))
        buffers = self._buffers(control.shape[-1])
        reports = [
            optimize_path(
                kernel, grid, self.spline.pinned, points, settings._replace(damping=float(first)), buffers
            )
            for kernel, points, first in zip(each, control, dampings, strict=True)
        ]  # fmt: skip
        return self._result(control, reports)

    def shorten(
        self, kernel: Kernel, control: ArrayLike, is_valid: Check, stop: Callable[[], bool] = lambda: False
    ) -> Array | None:
        """Return the last valid path of stiffer and stiffer ones, control points of shape (points, dof), or None.

        Stiffer paths are shorter. The first stiffness is high, since most paths go through with it; where the path
        fails the check, softer ones have their turn, the last with more samples. From a valid path on the stiffness
        grows once more.

        Args:
            kernel: The robot among its obstacles.
            control: Where to start from, shape (points, dof); it need not be valid.
            is_valid: Decides; called with the states of a path.
            stop: Asked between parts of rounds whether to end.

        Raises:
            ParameterError: Control points of another shape.
        """
        now = self._control(kernel, control)[:1]
        best: Array | None = None
        for factor in STIFFNESSES:
            optimizer = self.finer() if factor < 1.0 else self
            improved = None if stop() else optimizer._in_parts(kernel, now, factor * self.settings.stiffness, stop)
            if improved is None:
                return None
            now = improved
            if is_valid(self.spline.path(now[0])):
                best = now[0]
                break
        if best is None or factor < STIFFNESSES[0]:
            return best
        improved = None if stop() else self._in_parts(kernel, now, STIFFEST * self.settings.stiffness, stop)
        return improved[0] if improved is not None and is_valid(self.spline.path(improved[0])) else best

    def _in_parts(self, kernel: Kernel, control: Array, stiffness: float, stop: Callable[[], bool]) -> Array | None:
        """Return a path, shape (1, points, dof), improved as far as it goes, or None when told to stop meanwhile."""
        left, damping = self.settings.steps, None
        while True:
            steps = min(PART, left)
            improved = self.improve(kernel, control, steps=steps, stiffness=stiffness, damping=damping)
            control, damping, left = improved.control, improved.damping, left - steps
            if improved.steps[0] < steps or left == 0:
                return control
            if stop():
                return None

    def _control(self, kernel: Kernel, control: ArrayLike) -> Array:
        points = compact(control)
        if points.ndim == 2:
            points = points[None]
        check_array(points, ("B", self.spline.points, kernel.robot.dof), "control points", finite=True)
        return points

    def _cost_settings(
        self, steps: int | None = None, stiffness: float | None = None, enough: float = np.inf
    ) -> CostSettings:
        s = self.settings
        return CostSettings(
            scene_margin=float(s.scene_margin),
            own_margin=float(s.own_margin),
            stiffness=float(s.stiffness if stiffness is None else stiffness),
            damping=float(s.damping),
            enough=float(enough),
            tolerance=float(s.tolerance),
            steps=int(s.steps if steps is None else steps),
        )

    def _buffers(self, dof: int) -> tuple[NDArray[np.int64], Array]:
        return optimization_buffers(self.spline.pinned, self.spline.points, dof)

    @staticmethod
    def _result(control: Array, reports: Sequence[PathReport]) -> OptimizationResult:
        return OptimizationResult(
            control,
            cost=np.array([r.cost for r in reports], float),
            clearance_cost=np.array([r.clearance_cost for r in reports], float),
            clearance=np.array([(r.scene_clearance, r.own_clearance) for r in reports], float).reshape(-1, 2),
            steps=np.array([r.steps for r in reports], np.int64),
            damping=np.array([r.damping for r in reports], float),
        )


@lru_cache(maxsize=32)
def _grid(spline: Spline, samples: int) -> PathGrid:
    """Return weights at the samples without their zeros, where they begin, and the Gram matrix of the speed."""
    weights = spline.basis((np.arange(samples) + 0.5) / samples)
    width = spline.degree + 1
    first = np.minimum(np.argmax(weights != 0.0, axis=1), spline.points - width).astype(np.int64)
    packed = np.take_along_axis(weights, first[:, None] + np.arange(width), axis=1)
    return PathGrid(np.ascontiguousarray(packed), first, np.ascontiguousarray(spline.gram(1)))


@lru_cache(maxsize=32)
def _bumps(spline: Spline) -> Array:
    """Return what turns normal numbers for the free control points into smooth bumps, shape (free, free)."""
    order = min(2, spline.degree)
    factor = cholesky(spline.gram(order)[spline.inner, spline.inner])
    root = product(factor.T, solve(factor, np.eye(len(factor)))).T  # the transpose of the factor's inverse
    weights = spline.basis(np.linspace(0.0, 1.0, 65))[:, spline.inner]
    spread = np.sqrt((product(weights, root) ** 2).sum(axis=1)).max()
    return np.asarray(root / spread)
