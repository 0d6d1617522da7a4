"""Random perturbations of straight lines, for robots without a trained trajectory model."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext

import numpy as np

from apex_ompl.kernel import Kernel
from apex_ompl.model.diffusion import Callback, NoiseSchedule
from apex_ompl.model.proposals import Proposals, Sampling
from apex_ompl.model.query import Query
from apex_ompl.paths.optimizer import PERTURBATION_SIZE, Optimizer
from apex_ompl.types import Array


class PerturbationModel:
    """Proposes random perturbations of straight lines, for any robot, by the interface of a trajectory model.

    Attributes:
        spline: Spline of the control points.
        schedule: Noise schedule of one step: a path is not resampled, but drawn anew.
        sampling: Default sampling; the temperature is a factor on the size of the perturbations.
        sees_point: Whether it looks at the obstacle point of a query: it does not.
    """

    def __init__(self) -> None:
        """Propose paths of the optimizer's default spline."""
        self.spline, self.schedule = Optimizer().spline, NoiseSchedule(1)
        self.sampling, self.sees_point = Sampling(steps=1), False

    def one_thread(self) -> AbstractContextManager[None]:
        """Do nothing: there is no network."""
        return nullcontext()

    def propose(
        self, query: Query | Sequence[Query], kernel: Kernel, count: int, *, sampling: Sampling | None = None,
        generator: np.random.Generator | None = None, callback: Callback | None = None,
    ) -> Proposals:  # fmt: skip
        """Return perturbed straight lines for a query, or for several; see ``TrajectoryModel.propose``."""
        queries = [query] if isinstance(query, Query) else list(query)
        rng, size = generator or np.random.default_rng(0), (sampling or self.sampling).temperature * PERTURBATION_SIZE
        optimizer, limits = Optimizer(self.spline), kernel.robot.arrays
        some = [optimizer.starts(q.start, q.goal, count + 1, rng, size)[1:] for q in queries]
        control = np.clip(np.concatenate(some), limits.lower, limits.upper)
        start, goal = (np.repeat([getattr(q, end) for q in queries], count, axis=0) for end in ("start", "goal"))
        return Proposals(self.spline.with_ends(control, start, goal), np.empty(0), {})

    def renoise(
        self, query: Query, kernel: Kernel, control: Array, step: int, *, sampling: Sampling | None = None,
        generator: np.random.Generator | None = None, callback: Callback | None = None,
    ) -> Proposals:  # fmt: skip
        """Return other perturbed lines in place of given paths; see ``TrajectoryModel.renoise``."""
        return self.propose(query, kernel, len(control), sampling=sampling, generator=generator)
