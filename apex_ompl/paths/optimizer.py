"""Trajectory optimization on B-spline control points: paths made clear of obstacles, and then short.

One optimizer serves repair, shortening and data generation. It needs only NumPy and the compiled kernel; the caller
passes the full check as a function.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apex_ompl.errors import ParameterError
from apex_ompl.kernel import Kernel
from apex_ompl.kernel.path import CostSettings, PathGrid, PathReport, optimization_buffers, optimize_path, path_cost
from apex_ompl.kernel.products import cholesky, product, solve
from apex_ompl.paths.cost_terms import CostTerm, Evaluation, add_terms, descend
from apex_ompl.paths.spline import Spline
from apex_ompl.types import Array
from apex_ompl.util.arrays import compact
from apex_ompl.util.display import fields_line, values_line
from apex_ompl.util.validation import check_array, check_integer, check_nonnegative, check_number, check_positive

Check = Callable[[Array], bool]
"""Whether a path, shape (states, dof), is valid."""

STIFFNESSES = (25.0, 5.0, 1.0, 0.1)  # factors on the stiffness in shortening, in turn until a path is valid
STIFFEST = 125.0  # factor in the round after the first of these
PART = 4  # steps between two looks at the clock
FINER = 2  # factor on the number of samples for paths that are clear at the samples but not valid
COARSER = 2  # divisor of the number of samples by which fresh candidates are ranked
LAST_RESORT = 0.1  # factor on the stiffness where no path was valid before
PERTURBATION_SIZE = 0.6  # of the random perturbations of straight lines that planners start from [rad]


@dataclass(frozen=True)
class OptimizerSettings:
    """Cost of a path, and when its optimization ends.

    Attributes:
        samples: Number of states whose clearance counts: the middles of as many even intervals of the parameter, as
            dense as every fourth state of a path of 256.
        scene_margin: Clearance to obstacles below which a state costs [m].
        own_margin: Clearance between the robot's own links, its arms among them, below which a state costs [m].
        stiffness: Weight of half the integral of the speed squared, [1/rad^2]; for an even speed this is half the
            length squared. A clearance of 0 all along the path costs 1/2.
        damping: Weight of the speed of the change at the first step.
        steps: Largest number of steps of one call.
        tolerance: A step that lowers the cost by less than this share is the last.
    """

    samples: int = 64
    scene_margin: float = 0.04
    own_margin: float = 0.02
    stiffness: float = 1e-3
    damping: float = 1e-2
    steps: int = 30
    tolerance: float = 5e-3

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ParameterError: One is out of range.
        """
        check_integer(self.samples, "samples", 1)
        check_integer(self.steps, "steps")
        for name in ("scene_margin", "own_margin", "stiffness"):
            check_positive(getattr(self, name), name)
        for name in ("damping", "tolerance"):
            check_number(getattr(self, name), name, 0.0)


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
    :func:`apex_ompl.kernel.path.path_cost`, and the terms that are given. Limits are kept by the control points.
    """

    def __init__(
        self, spline: Spline | None = None, settings: OptimizerSettings | None = None, *, costs: Sequence[CostTerm] = ()
    ) -> None:
        """Optimize paths of a spline.

        Args:
            spline: Spline of the control points.
            settings: Weights of the cost, and when the steps end.
            costs: Further terms of the cost, see :class:`apex_ompl.paths.cost_terms.CostTerm`. With any of them the
                steps are taken in NumPy, which is slower.
        """
        self.spline = spline or Spline()
        self.settings = settings or OptimizerSettings()
        self.costs = tuple(costs)

    def __repr__(self) -> str:
        """Return the spline, the settings and the further terms of the cost."""
        defaults = {"spline": Spline(), "settings": OptimizerSettings(), "costs": ()}
        return values_line("Optimizer", vars(self), defaults)

    def prepare(self, kernel: Kernel) -> None:
        """Load or compile the code of the steps now, instead of at the first call in a process."""
        if self.spline not in _prepared:
            compiled = Optimizer(self.spline, self.settings)
            compiled.improve(kernel, np.zeros((1, self.spline.points, kernel.robot.dof)), steps=0)
            _prepared.add(self.spline)

    def finer(self) -> Optimizer:
        """Return an optimizer with more samples."""
        return self._sampled(FINER * self.settings.samples)

    def coarser(self) -> Optimizer:
        """Return an optimizer with fewer samples."""
        return self._sampled(max(1, self.settings.samples // COARSER))

    def _sampled(self, samples: int) -> Optimizer:
        return Optimizer(self.spline, replace(self.settings, samples=samples), costs=self.costs)

    def starts(
        self, start: Array, goal: Array, count: int, rng: np.random.Generator, size: ArrayLike = 1.0
    ) -> Array:  # fmt: skip
        """Return straight lines between two states, randomly perturbed: control points of shape (count, points, dof).

        The first is the line itself. The perturbations are normal, and their inverse covariance is the integral of
        the squared acceleration (the prior of STOMP, Kalakrishnan et al. 2011). ``size`` is the largest standard
        deviation of a joint along the path, or those of all, shape (dof,) [rad, m].

        Raises:
            ParameterError: ``count`` is not positive.
        """
        check_integer(count, "count", 1)
        line = self.spline.line(start, goal)
        normal = rng.normal(size=(count, self.spline.free, line.shape[1]))
        perturbations = product(_perturbation_factor(self.spline), normal)
        perturbations[0] = 0.0
        paths = np.repeat(line[None], count, axis=0)
        paths[:, self.spline.inner] += np.asarray(size) * perturbations
        return paths

    def evaluate(self, kernel: Kernel, control: ArrayLike) -> tuple[OptimizationResult, Array]:
        """Return the cost of paths, shape (B, points, dof), and its gradient, shape (B, free points, dof).

        Raises:
            ParameterError: Control points of another shape.
        """
        control = self._control(kernel, control)
        settings = self._cost_settings()
        evaluations = [self._evaluate(kernel, points, settings) for points in control]
        gradients = np.array([gradient for _, gradient, _ in evaluations])
        shape = len(control), self.spline.free, control.shape[2]
        return self._result(control, [report for report, _, _ in evaluations]), gradients.reshape(shape)

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
            control: Control points, shape (B, points, dof); free ones are clipped to the limits, pinned ones stay.
            steps: Largest number of steps, rejected ones included; by default the settings'.
            stiffness: By default the settings'.
            damping: Damping of the first step, one for all or one for each; by default the settings'.
            enough: The steps of a path end as soon as both of its clearances reach this [m].

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
        grid = path_grid(self.spline, self.settings.samples)
        settings = self._cost_settings(steps, stiffness, enough)
        dampings = np.broadcast_to(self.settings.damping if damping is None else damping, len(control))
        if self.costs:
            first = (settings._replace(damping=float(one)) for one in dampings)
            return self._result(control, list(map(self._descend, each, control, first)))
        buffers = optimization_buffers(self.spline.pinned, self.spline.points, control.shape[-1])
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
        """Return the control points, shape (points, dof), of a valid path shortened by a high stiffness, or None.

        Stiffer paths are shorter. The first stiffness is high, since most paths stay valid with it. Where the path
        fails the check, lower ones are tried in turn, the last with more samples. After a valid path at the first
        stiffness a higher one is tried.

        Args:
            kernel: The robot among its obstacles.
            control: Initial control points, shape (points, dof); the path need not be valid.
            is_valid: Full check; called with the states of a path.
            stop: Called every few steps; True ends the search.

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

    def _descend(self, kernel: Kernel, control: Array, settings: CostSettings) -> PathReport:
        """Take the steps on control points, shape (points, dof), in place, with the user's terms in the cost."""
        limits = kernel.robot.arrays.lower, kernel.robot.arrays.upper
        evaluate = partial(self._evaluate, kernel, settings=settings)
        return descend(evaluate, self.spline, limits, control, settings)

    def _evaluate(self, kernel: Kernel, control: Array, settings: CostSettings) -> Evaluation:
        """Return cost, gradient and Gauss-Newton matrix of control points, shape (points, dof), all terms included."""
        samples = self.settings.samples
        evaluation = path_cost(kernel, path_grid(self.spline, samples), self.spline.pinned, control, settings)
        if not self.costs:
            return evaluation
        weights = self.spline.basis((np.arange(samples) + 0.5) / samples)
        states = product(weights, control).clip(kernel.robot.arrays.lower, kernel.robot.arrays.upper)
        return add_terms(self.costs, self.spline, weights, states, evaluation)

    def _in_parts(self, kernel: Kernel, control: Array, stiffness: float, stop: Callable[[], bool]) -> Array | None:
        """Return a path, shape (1, points, dof), after all steps, or None when ``stop`` ends them early."""
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
def path_grid(spline: Spline, samples: int) -> PathGrid:
    """Return the nonzero weights at the samples, the first control point of each, and the Gram matrix of the speed."""
    weights = spline.basis((np.arange(samples) + 0.5) / samples)
    width = spline.degree + 1
    first = np.minimum(np.argmax(weights != 0.0, axis=1), spline.points - width).astype(np.int64)
    packed = np.take_along_axis(weights, first[:, None] + np.arange(width), axis=1)
    return PathGrid(np.ascontiguousarray(packed), first, np.ascontiguousarray(spline.gram(1)))


@lru_cache(maxsize=32)
def _perturbation_factor(spline: Spline) -> Array:
    """Return the matrix that maps normal numbers to smooth perturbations of the free control points, (free, free).

    It is a root of the covariance, scaled so that the largest standard deviation along the path is 1.
    """
    order = min(2, spline.degree)
    factor = cholesky(spline.gram(order)[spline.inner, spline.inner])
    root = product(factor.T, solve(factor, np.eye(len(factor)))).T  # the transpose of the factor's inverse
    weights = spline.basis(np.linspace(0.0, 1.0, 65))[:, spline.inner]
    spread = np.sqrt((product(weights, root) ** 2).sum(axis=1)).max()
    return np.asarray(root / spread)
