"""GPMP and GPMP2: trajectory optimization on a Gaussian-process prior, the baselines of the paper's comparison."""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from ompl import base as ob
from ompl import util as ou

from apex_ompl.apex.path_validator import NOT_ACCEPTED, PathValidator
from apex_ompl.baselines.gpmp.gaussian_process import GaussianProcess
from apex_ompl.baselines.gpmp.optimizer import CostFunctional, Evaluation, FactorGraph, Factors, Optimum
from apex_ompl.collision.path_proof import PathProof
from apex_ompl.kernel import Kernel
from apex_ompl.kernel.path import NO_DYNAMIC_OBSTACLES, ClearanceCosts, clearance_costs
from apex_ompl.ompl.own_planner import OwnPlanner, nearest_pairs
from apex_ompl.ompl.parameters import Parameters, bounded, register
from apex_ompl.ompl.space import bounds_of
from apex_ompl.ompl.tuned import TUNED
from apex_ompl.paths.path import Path
from apex_ompl.types import Array

Status = ob.PlannerStatus
STATES = 256  # of a path, at least


@dataclass(frozen=True)
class GaussianProcessParameters(Parameters):
    """What GPMP and GPMP2 share.

    A motion lasts 1 s here: paths are timed later, and another duration T is the same as another power, Q_C T^3.

    Attributes:
        intervals: Number of intervals between supports.
        checked: States of an interval whose clearance counts, its first support among them.
        safety_distance: Clearance eps to obstacles below which a state costs [m].
        own_distance: The same between the robot's links [m]; its sigma is in the same ratio to it.
        obstacle_sigma: Standard deviation sigma of the clearance below eps [m].
        power: Power spectral density Q_C of the prior's acceleration, the same for all joints [rad^2/s^3].
        iterations: Most motions that are tried from one initial motion.
        tolerance: A step that lowers the cost by less than this share is the last.
        restarts: Number of further initial motions, drawn from the prior, for each pair of start and goal.
        restart_size: Largest standard deviation of their positions [rad].
        seed: Seed of these; -1 takes OMPL's.
    """

    smooth: ClassVar[bool] = True
    name: ClassVar[str]
    kind: ClassVar[type[Factors]]
    intervals: int = bounded(12, 2, 200)
    checked: int = bounded(6, 1, 100)
    safety_distance: float = bounded(0.08, 1e-4, 1.0, unit="m")
    own_distance: float = bounded(0.03, 1e-4, 1.0, unit="m")
    obstacle_sigma: float = bounded(0.004, 1e-6, 10.0, unit="m")
    power: float = bounded(1.0, 1e-9, 1e9, unit="rad^2/s^3")
    iterations: int = bounded(100, 1)
    tolerance: float = bounded(1e-4, 0.0, 1.0)
    restarts: int = bounded(0, 0)
    restart_size: float = bounded(0.5, 1e-6, 10.0, unit="rad")
    seed: int = bounded(-1, -1)

    @abstractmethod
    def optimum(
        self, problem: Any, supports: Array, stop: Callable[[], bool], is_valid: Callable[[Array], bool] | None = None
    ) -> Optimum:
        """Return what the method makes of initial supports.

        Args:
            problem: What :meth:`problem` returned.
            supports: Initial supports, shape (intervals + 1, 2, dof).
            stop: Asked before each step whether to end.
            is_valid: Whether a path without a contact ends the iterations of GPMP; by default each does.
        """

    def problem(
        self, process: GaussianProcess, kernel: Kernel, lower: Array, upper: Array, *, start_time: float = 0.0,
        dynamic: tuple[Any, ...] = NO_DYNAMIC_OBSTACLES,
    ) -> Factors:  # fmt: skip
        """Return what is optimized.

        Args:
            process: The prior.
            kernel: The robot among static obstacles.
            lower: Lowest positions, shape (dof,).
            upper: Highest positions, shape (dof,).
            start_time: When the motion starts [s].
            dynamic: Dynamic obstacles, packed as :class:`apex_ompl.kernel.arrays.DynamicArrays`.
        """

        def clearances(states: Array, times: Array) -> ClearanceCosts:
            return clearance_costs(kernel, states, self.safety_distance, self.own_distance, start_time + times, dynamic)

        weight = (self.safety_distance / self.obstacle_sigma) ** 2
        return self.kind(process, clearances, lower, upper, self.checked, weight)

    def build(self, si: ob.SpaceInformation) -> ob.Planner:
        """Return the planner.

        Raises:
            ParameterError: ``si`` has neither a validity checker of this project nor is it of ``apex_ompl.setup``.
        """
        return GaussianProcessPlanner(si, PathValidator.of_setup(si, self.name), self)


@register("gpmp")
@dataclass(frozen=True)
class GPMP(GaussianProcessParameters):
    """Functional gradient steps on a Gaussian-process prior (Mukadam, Yan and Boots, ICRA 2016, "GPMP").

    The update is theta <- theta - (1 / eta) (theta - mu + K M^T g): mu and K are mean and covariance of the prior given
    start and goal at rest, M the interpolation from the supports to the states whose clearance counts, and g the
    gradient of the obstacle cost there. lambda, the weight of the prior, is part of Q_C here.

    Left open by the paper, or done otherwise: the order of the prior (here white noise on acceleration, as in GPMP2);
    eta (here ``1 / rate``, with steps of at most ``largest_step`` that are halved while the cost grows); what ends the
    iterations (here the first motion that is proved free, a relative tolerance, or their number). The obstacle cost is
    half the squared violation of the safety distance, of every cluster of spheres to every obstacle by the nearest
    sphere, instead of CHOMP's cost of every sphere; it is integrated over the length of the path in joint space instead
    of that of each sphere in the workspace. Joint limits are kept by CHOMP's smooth projection.

    Attributes:
        rate: Largest length of a step, as a multiple of the functional gradient.
        largest_step: Largest change of a position in a step [rad].
    """

    name: ClassVar[str] = "gpmp"
    kind: ClassVar[type[Factors]] = CostFunctional
    safety_distance: float = bounded(TUNED["gpmp"]["safety_distance"], 1e-4, 1.0, unit="m")
    obstacle_sigma: float = bounded(TUNED["gpmp"]["obstacle_sigma"], 1e-6, 10.0, unit="m")
    intervals: int = bounded(TUNED["gpmp"]["intervals"], 2, 200)
    power: float = bounded(TUNED["gpmp"]["power"], 1e-9, 1e9, unit="rad^2/s^3")
    iterations: int = bounded(200, 1)
    rate: float = bounded(1.0, 1e-9, 1.0)
    largest_step: float = bounded(0.3, 1e-6, 10.0, unit="rad")

    def optimum(
        self, problem: Any, supports: Array, stop: Callable[[], bool], is_valid: Callable[[Array], bool] | None = None
    ) -> Optimum:
        """Return what steps along the functional gradient come to."""

        def accepts(supports: Array, found: Evaluation) -> bool:
            free = bool(found.clearance.min() > 0.0)
            return free and (is_valid is None or is_valid(problem.path(supports, STATES)))

        optimum: Optimum = problem.minimum(
            supports, self.iterations, self.tolerance, rate=self.rate, largest=self.largest_step, accepts=accepts,
            stop=stop,
        )  # fmt: skip
        return optimum


@register("gpmp2")
@dataclass(frozen=True)
class GPMP2(GaussianProcessParameters):
    """Maximum a posteriori on a Gaussian-process prior, a factor graph (Dong, Mukadam, Dellaert and Boots, RSS 2016).

    The longer account is Mukadam, Dong, Yan, Dellaert and Boots, "Continuous-time Gaussian process motion planning via
    probabilistic inference", IJRR 2018. Levenberg-Marquardt steps, whose normal equations are block-tridiagonal, start
    at the straight line at constant velocity, and go on until they converge; what comes out is a solution if the whole
    path is proved free.

    Left open by the papers, or done otherwise: start and goal are fixed, at rest, which is the limit of their factors
    of sigma 1e-4; obstacle factors are those of pairs of a cluster of spheres and an obstacle, by the nearest sphere,
    instead of each sphere alone; there are such factors between links, too; joint limits count at the interpolated
    states, too, with sigma 1e-3, and the path is clamped to them in the end. The damping is a share of the diagonal.
    Several goals are tried in turn, the nearest first. Restarts are not part of the method, and off.
    """

    name: ClassVar[str] = "gpmp2"
    kind: ClassVar[type[Factors]] = FactorGraph
    safety_distance: float = bounded(TUNED["gpmp2"]["safety_distance"], 1e-4, 1.0, unit="m")
    obstacle_sigma: float = bounded(TUNED["gpmp2"]["obstacle_sigma"], 1e-6, 10.0, unit="m")
    intervals: int = bounded(TUNED["gpmp2"]["intervals"], 2, 200)
    power: float = bounded(TUNED["gpmp2"]["power"], 1e-9, 1e9, unit="rad^2/s^3")

    def optimum(
        self, problem: Any, supports: Array, stop: Callable[[], bool], is_valid: Callable[[Array], bool] | None = None
    ) -> Optimum:
        """Return the maximum of the posterior."""
        optimum: Optimum = problem.maximum(supports, self.iterations, self.tolerance, stop=stop)
        return optimum


class GaussianProcessPlanner(OwnPlanner):
    """OMPL planner GPMP or GPMP2: one initial motion after the other is optimized, until one is proved free.

    A local method: it ends without a solution when it has nothing left to start from, and says what is in the way.

    Attributes:
        parameters: Its parameters.
        validator: Decides what is valid.
        report: What the last call of ``solve`` did; ``steps`` counts motions that were tried.
        optima: What the initial motions came to in it.
    """

    def __init__(
        self, si: ob.SpaceInformation, validator: PathValidator, parameters: GaussianProcessParameters
    ) -> None:
        """Optimize by the clearances of the validator's checker."""
        super().__init__(si, parameters.name)
        self.validator = validator
        self.parameters = parameters
        self.optima = list[Optimum]()

    def setup(self) -> None:
        """Load or compile what the first call of ``solve`` needs."""
        super().setup()
        checker = self.validator.checker
        clearance_costs(checker.kernel, checker.robot.home, 0.01, 0.01)

    def _solve(self, ptc: ob.PlannerTerminationCondition) -> Any:
        self.validator, self.optima = self.validator.current(), []
        validator, checker = self.validator, self.validator.checker
        started, report = time.perf_counter(), self.report
        lower, upper = bounds_of(self.getSpaceInformation(), checker.robot)
        starts, goals, status = self._ends(ptc)
        if status is not None:
            return status
        process = GaussianProcess(self.parameters.intervals, power=self.parameters.power)
        problem = self.parameters.problem(process, checker.kernel, lower, upper)
        for supports in self._initial(process, nearest_pairs(starts, goals)):
            if ptc():
                break
            report.candidates += 1
            with report.timed("optimize"):
                optimum = self.parameters.optimum(problem, supports, lambda: bool(ptc()), validator.is_valid)
            self.optima.append(optimum)
            report.steps += optimum.evaluations
            path = Path(problem.path(optimum.supports, STATES))
            with report.timed("prove"):
                proof = checker.prove(path.states, tolerance=0.0) if validator.knows_obstacles else None
                proved = proof is None or bool(proof)
                valid = proved and validator.accepts(path.states, lambda: bool(ptc()))
            if valid:
                report.solved_by, report.first_verified, report.reason = self.parameters.name, True, ""
                report.add_solution(self, path, time.perf_counter() - started)
                return Status.EXACT_SOLUTION
            report.reason = report.reason or (
                NOT_ACCEPTED if proof is None or proved else self._fault(path, proof, optimum)
            )
        report.reason = report.reason or "time was up before the first motion was optimized"
        return Status.TIMEOUT

    def _initial(self, process: GaussianProcess, pairs: list[tuple[Array, Array]]) -> Iterator[Array]:
        """Yield initial supports: straight lines at constant velocity, at rest at both ends, and then random ones."""
        rest, drawn = [], self.parameters.restarts
        for start, goal in pairs:
            line = process.constant_velocity(start, goal)
            line[[0, -1], 1] = 0.0
            rest.append(line)
            yield line
        if drawn:
            seed = self.parameters.seed
            rng = np.random.default_rng(seed if seed >= 0 else int(ou.RNG().uniformInt(0, 2**31 - 2)))
            for _ in range(drawn):
                for line in rest:
                    yield process.sample(line, rng, self.parameters.restart_size)

    def _fault(self, path: Path, proof: PathProof, optimum: Optimum) -> str:
        """Return which constraint the path violates, where and how deep, and how the optimization ended."""
        where = int(np.argmin(np.abs(path.states - proof.state).max(axis=1))) / (len(path.states) - 1)
        depth = -self.validator.checker.clearance(proof.state)
        deep = f", {1e3 * depth:.0f} mm deep there" if depth >= 5e-4 else ""
        ended = "converged" if optimum.converged else "had not converged"
        return (
            f"{proof.reason}{deep}, at {100.0 * where:.0f} % of the motion to the nearest goal, "
            f"which {ended} after {optimum.iterations} steps"
        )
