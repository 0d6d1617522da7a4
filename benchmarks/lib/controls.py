"""Controls of the model in comparisons: random weights, another problem's conditions.

:mod:`control_planners` makes planners of them.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import torch

from apex_ompl import problems
from apex_ompl.apex.models import make_query
from apex_ompl.model.array_model import ArrayModel
from apex_ompl.model.proposals import Proposals
from apex_ompl.model.query import Query
from apex_ompl.ompl.setup import assemble
from apex_ompl.problems.suite_robot import robot
from apex_ompl.training.latent_diffusion import LatentDiffusion


class Shuffled(ArrayModel):
    """Proposals for the problem next to the one at hand, put on its ends."""

    other: Query

    def propose(self, query: Any, kernel: Any, count: int, **options: Any) -> Proposals:
        """Return proposals for another problem."""
        queries = [query] if isinstance(query, Query) else list(query)
        found = super().propose(self.other, kernel, count * len(queries), **options)
        start, goal = (np.repeat([getattr(q, end) for q in queries], count, axis=0) for end in ("start", "goal"))
        line, limits = self.spline.line, kernel.robot.arrays
        moved = found.control - line(self.other.start, self.other.goal) + line(start, goal)
        control = self.spline.with_ends(np.clip(moved, limits.lower, limits.upper), start, goal)
        return Proposals(control, found.latent, found.seconds)

    def renoise(self, query: Query, kernel: Any, control: Any, step: int, **options: Any) -> Proposals:
        """Return paths near given ones, denoised for the other problem."""
        line, limits = self.spline.line, kernel.robot.arrays
        ends = line(query.start, query.goal) - line(self.other.start, self.other.goal)
        there = np.clip(control - ends, limits.lower, limits.upper)
        found = super().renoise(self.other, kernel, there, step, **options)
        moved = np.clip(found.control + ends, limits.lower, limits.upper)
        start, goal = (np.repeat(q[None], len(control), axis=0) for q in (query.start, query.goal))
        return Proposals(self.spline.with_ends(moved, start, goal), found.latent, found.seconds)


def drawn(trained: LatentDiffusion) -> ArrayModel:
    """Return a model like a trained one with random weights; latent space, limits and what it sees are the same."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        network = LatentDiffusion(trained.config)
        torch.nn.init.kaiming_uniform_(network.denoiser.leave.weight)  # it would begin at zero
    kept = {k: v for k, v in trained.state_dict().items() if k.startswith(("autoencoder", "probe", "key_"))}
    kept |= {k: v for k, v in trained.state_dict().items() if k in ("encoder.lower", "encoder.upper")}
    return ArrayModel(trained.config, {k: v.numpy() for k, v in (network.state_dict() | kept).items()}, {})


def digest(*files: Path) -> str:
    """Return a digest of the contents of files."""
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:12]


def checkpoint_digest(folder: Path) -> str:
    """Return a digest of a checkpoint."""
    return digest(folder / "config.json", folder / "model.safetensors")


def next_query(name: str) -> Query:
    """Return the query of the next problem of a level."""
    level, number = name.rsplit("/", 1)
    setup = assemble(problems.load(f"{level}/{int(number) + 1}"), robot())
    return make_query(setup.checker, setup.start, setup.goals[0])
