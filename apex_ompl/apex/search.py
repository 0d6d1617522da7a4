"""The stages of APEX that need no tree: propose, judge, repair, resample (Algorithm 1 of the paper, execute)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

from apex_ompl.diffusion.conditions import Query
from apex_ompl.diffusion.proposals import Proposals, Sampling, TrajectoryModel
from apex_ompl.diffusion.schedule import Estimate
from apex_ompl.kernel import Kernel
from apex_ompl.ompl_adapter.report import Report
from apex_ompl.trajopt.candidates import PER_PATH, Candidate, CandidatePool
from apex_ompl.trajopt.optimizer import Check, Optimizer
from apex_ompl.types import Array

Stop = Callable[[], bool]

LINE, EXPERIENCE, PROPOSED, RESAMPLED = "line", "experience", "apex", "apex+resample"
"""Where candidates come from, as ``solved_by`` names them."""

AT_ONCE = 8  # proposals between two looks at the clock
LEAST_STEPS = 48  # of repair in a round
WORTH_RESAMPLING = 4  # candidates in a round
VARIED = 4  # variations of a path at a time


class OutOfTimeError(Exception):
    """Raised inside of a sampler to leave it; never leaves this module."""


@dataclass(frozen=True)
class SearchSettings:
    """How APEX searches before it grows trees.

    Attributes:
        line: Whether the straight line is a candidate.
        batches: Numbers of proposals for each pair of start and goal, one round behind the other.
        sampling: How they are denoised, guidance included.
        resample: How often colliding candidates are resampled in each round.
        noise: How far they are noised for that, as a share of the schedule.
        repair: Whether candidates are improved by the optimiser.
        lambda_obs: Valid paths that come nearer to an obstacle than this are resampled too [m].
    """

    line: bool = True
    batches: tuple[int, ...] = (4, 8, 24)
    sampling: Sampling = Sampling()
    resample: int = 1
    noise: float = 0.4
    repair: bool = True
    lambda_obs: float = 0.0


class Search:
    """A search for a valid path between some starts and goals in one scene.

    Attributes:
        pool: All candidates.
    """

    def __init__(
        self, model: TrajectoryModel, optimizer: Optimizer, kernel: Kernel, is_valid: Check,
        gap: Callable[[Array], float], *, settings: SearchSettings, generator: torch.Generator, report: Report,
    ) -> None:  # fmt: skip
        """Search with a model's proposals.

        Args:
            model: Proposes.
            optimizer: Repairs.
            kernel: The robot among its obstacles.
            is_valid: Decides; called with the states of a path.
            gap: Gives the distance of a path's states from the obstacles [m]; asked where ``lambda_obs`` is not 0.
            settings: How.
            generator: Source of all noise.
            report: Is told about times and numbers.
        """
        self._model, self._optimizer, self._kernel, self._is_valid = model, optimizer, kernel, is_valid
        self._gap, self._settings, self._generator, self._report = gap, settings, generator, report
        self.pool = self._pool()
        self._known: list[tuple[str, Array]] = []  # straight lines and earlier paths that are not valid
        self._close: list[tuple[float, Candidate]] = []  # valid, but nearer to an obstacle than lambda_obs

    def known(
        self, ends: Sequence[tuple[Array, Array]], experience: Sequence[Array], stop: Stop
    ) -> Candidate | None:  # fmt: skip
        """Return a valid path among those that cost nothing, straight lines and earlier paths put on other ends.

        Those that are not valid are candidates for repair.

        Args:
            ends: Pairs of start and goal, each of shape (dof,).
            experience: What earlier paths differed in from their straight lines, each of shape (points, dof).
            stop: Asked often whether to give up.
        """
        spline, limits = self._model.spline, self._kernel.robot.arrays
        with self._report.timed("known"):
            for start, goal in ends:
                line = spline.line(start, goal)
                mine = [(LINE, line)] if self._settings.line else []
                for residual in experience:
                    moved = np.clip(line + residual, limits.lower, limits.upper)
                    mine.append((EXPERIENCE, spline.with_ends(moved, start, goal)))
                for origin, control in mine:
                    if stop():
                        return None
                    self._report.candidates += 1
                    found = Candidate(control, origin, np.inf, np.inf, 0.0)
                    # A line that is not free is soon seen by its ends.
                    if origin == EXPERIENCE or self._is_valid(np.stack([start, goal])):
                        path = spline.path(control)
                        if self._is_valid(path) and self._keeps_distance(found, path):
                            return found
                    self._known.append((origin, control))
        return None

    @property
    def rounds(self) -> int:
        """How many rounds of proposals there are; one without any repairs what is known."""
        return len(self._settings.batches or (0,))

    def round(self, number: int, queries: Sequence[Query], stop: Stop) -> Candidate | None:
        """Return a valid path for one of several queries from a round of proposals, or None.

        Args:
            number: Of the round, from 0.
            queries: The problems, which differ in their starts and goals.
            stop: Asked often whether to give up.
        """
        known, self._known = self._known, []
        for origin in dict.fromkeys(origin for origin, _ in known):
            if not stop():
                with self._report.timed("judge"):
                    there = self.pool.add([control for mine, control in known if mine == origin], origin, stop)
                if there is not None:
                    return there
        batch = (self._settings.batches or (0,))[number]
        found = (stage() for stage in self._round(queries, batch, stop) if not stop())
        return next((one for one in found if one is not None), None)

    def again(self, queries: Sequence[Query], stop: Stop) -> Candidate | None:
        """Return a valid path for one of several queries from more rounds of proposals, until it is told to stop."""
        batch = max(self._settings.batches, default=0)
        while batch and not stop():
            self.pool = self._pool()
            for stage in self._round(queries, batch, stop):
                found = None if stop() else stage()
                if found is not None:
                    return found
        return self.farthest()

    def vary(self, control: Array, query: Query, noise: float, stop: Stop) -> Candidate | None:
        """Return a valid path that a given one becomes when it is noised and denoised again, or None.

        Args:
            control: Control points of the given path, shape (points, dof).
            query: Its start and goal.
            noise: How far it is noised, as a share of the schedule.
            stop: Asked often whether to give up.
        """
        pool = self._pool()
        found = self._renoised(np.repeat(control[None], VARIED, axis=0), query, noise, stop)
        if found is None:
            return None
        return pool.add(found, RESAMPLED, stop) or pool.work(PER_PATH * VARIED, stop)

    def fresh(self, query: Query, stop: Stop) -> Candidate | None:
        """Return a valid path that new proposals become, or None."""
        pool = self._pool()
        found = self._proposed([query], AT_ONCE, stop)
        if found is None:
            return None
        return pool.add(found, PROPOSED, stop) or pool.work(PER_PATH * AT_ONCE, stop)

    def _round(self, queries: Sequence[Query], batch: int, stop: Stop) -> Iterator[Callable[[], Candidate | None]]:
        settings, each = self._settings, max(1, AT_ONCE // len(queries))
        for k in range(0, batch, each):
            yield partial(self._propose, queries, min(each, batch - k), stop)
        if settings.repair:
            yield partial(self._repair, max(LEAST_STEPS, PER_PATH * batch * len(queries)), stop)
        for _ in range(settings.resample):
            yield partial(self._resample, queries, stop)
            if settings.repair:
                yield partial(self._repair, PER_PATH * WORTH_RESAMPLING, stop)

    def _propose(self, queries: Sequence[Query], count: int, stop: Stop) -> Candidate | None:
        with self._report.timed("propose"):
            control = self._proposed(queries, count, stop)
        with self._report.timed("judge"):
            return None if control is None else self._add(control, PROPOSED, stop)

    def _repair(self, steps: int, stop: Stop) -> Candidate | None:
        before = self.pool.steps
        with self._report.timed("repair"):
            found = self.pool.work(steps, stop)
        self._report.steps += self.pool.steps - before
        return found

    def _resample(self, queries: Sequence[Query], stop: Stop) -> Candidate | None:
        """Noise the candidates that come nearest to being valid, and denoise them again as proposals are."""
        with self._report.timed("resample"):
            best = sorted(self.pool.candidates, key=lambda one: one.clearance_cost)[:WORTH_RESAMPLING]
            for query in queries:
                mine = [one.control for one in best if _joins(one.control, query)]
                control = self._renoised(np.stack(mine), query, self._settings.noise, stop) if mine else None
                found = None if control is None else self._add(control, RESAMPLED, stop)
                if found is not None or stop():
                    return found
        return None

    def _add(self, control: Array, origin: str, stop: Stop) -> Candidate | None:
        self._report.candidates += len(control)
        self._report.proposed += len(control) if origin == PROPOSED else 0
        self._report.resampled += len(control) if origin == RESAMPLED else 0
        return self.pool.add(control, origin, stop)

    def _pool(self) -> CandidatePool:
        return CandidatePool(self._optimizer, self._kernel, self._is_valid, self._keeps_distance)

    def _keeps_distance(self, found: Candidate, path: Array) -> bool:
        """Whether a valid path is as far from obstacles as is wanted; one that is not is set aside."""
        wanted = self._settings.lambda_obs
        if wanted <= 0.0:
            return True
        with self._report.timed("distance"):
            gap = self._gap(path)
        if gap < wanted:
            self._close.append((gap, found))
        return gap >= wanted

    def farthest(self) -> Candidate | None:
        """Return the one of the valid paths that were set aside that keeps most distance, or None."""
        return max(self._close, key=lambda pair: pair[0])[1] if self._close else None

    def _proposed(self, queries: Sequence[Query], count: int, stop: Stop) -> Array | None:
        return self._sampled(
            lambda: self._model.propose(
                queries, self._kernel, count, sampling=self._settings.sampling, generator=self._generator,
                callback=_leaving(stop),
            )
        )  # fmt: skip

    def _renoised(self, control: Array, query: Query, noise: float, stop: Stop) -> Array | None:
        step = max(0, round(noise * self._model.network.schedule.steps) - 1)
        return self._sampled(
            lambda: self._model.renoise(
                query, self._kernel, control, step, sampling=self._settings.sampling, generator=self._generator,
                callback=_leaving(stop),
            )
        )  # fmt: skip

    def _sampled(self, sample: Callable[[], Proposals]) -> Array | None:
        """Return the control points of proposals, or None where time ended meanwhile; count the time of guidance."""
        try:
            made = sample()
        except OutOfTimeError:
            return None
        times, took = self._report.times, made.seconds.get("guidance", 0.0)
        if took:
            times["guidance"] = times.get("guidance", 0.0) + took
        return made.control


def _joins(control: Array, query: Query) -> bool:
    return np.array_equal(control[0], query.start) and np.array_equal(control[-1], query.goal)


def _leaving(stop: Stop) -> Callable[[int, Tensor, Estimate], None]:
    """Return a callback that leaves a sampler when time is up."""

    def callback(*_: object) -> None:
        if stop():
            raise OutOfTimeError

    return callback
