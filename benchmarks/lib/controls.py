"""Controls of the model in comparisons: random weights, another problem's conditions, nearest training paths.

:mod:`control_planners` makes planners of them.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from apex_ompl import problems
from apex_ompl.apex.models import make_query
from apex_ompl.errors import ParameterError
from apex_ompl.kernel import Kernel, RobotTables
from apex_ompl.kernel.scene_builder import scene_tables
from apex_ompl.model.array_model import ArrayModel
from apex_ompl.model.proposals import Proposals
from apex_ompl.model.query import Probes, Query
from apex_ompl.ompl.setup import assemble
from apex_ompl.problems.suite_robot import robot
from apex_ompl.training.conditions import Conditions, ConditionTable, batch_queries, pad_obstacles
from apex_ompl.training.latent_diffusion import LatentDiffusion
from apex_ompl.training.records import Paths
from apex_ompl.types import Array


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


ALONG = 7  # states of the straight line at which clearances are compared
NEAR = 0.3  # clearances are clipped here [m]
PER_METRE = 3.0  # weight of clearances beside joint angles [rad/m]


class Neighbors:
    """Training paths by start, goal, and the clearances of the robot's probes along the straight line between them."""

    def __init__(self, several: Sequence[Paths], robot: RobotTables) -> None:
        """Look for neighbors among paths of ``robot``, all of the same spline."""
        self._probes, self.spline = Probes.from_robot(robot, ALONG), several[0].spline
        kernel, rows, rests = Kernel(robot, scene_tables([])), [], []
        for paths in several:
            table = ConditionTable(paths, self._probes, kernel)
            parts = (torch.arange(k, min(k + 2048, len(paths))) for k in range(0, len(paths), 2048))
            rows += [features(table.conditions(part)) for part in parts]
            control = paths.control()
            rests.append((control - self.spline.line(control[:, 0], control[:, -1])).astype(np.float32))
        self._features, self._residual = np.concatenate(rows), np.concatenate(rests)

    def refitted(self, query: Query, kernel: Kernel, count: int) -> Array:
        """Return the nearest paths' residuals from their straight lines, added to the straight line of a query.

        Args:
            query: The problem.
            kernel: The robot.
            count: How many paths.

        Returns:
            Control points, shape (count, points, dof) [rad], inside the limits.

        Raises:
            ParameterError: There are not as many paths.
        """
        if not 1 <= count <= len(self._residual):
            raise ParameterError("count", count, f"1 to {len(self._residual)}, as many as there are paths")
        mine = features(batch_queries([query], self._probes, kernel))
        apart = ((self._features - mine) ** 2).sum(axis=1)
        nearest = np.argpartition(apart, count - 1)[:count]
        nearest = nearest[np.argsort(apart[nearest], kind="stable")]
        limits = kernel.robot.arrays
        control = self.spline.line(query.start, query.goal) + self._residual[nearest]
        return self.spline.with_ends(np.clip(control, limits.lower, limits.upper), query.start, query.goal)


def features(conditions: Conditions) -> NDArray[np.float32]:
    """Return the features by which neighbors are compared, shape (B, features) [rad]."""
    least = pad_obstacles(conditions.probe_distances().clamp(-NEAR, NEAR), conditions.mask, NEAR).amin(dim=1)
    rows = torch.cat([conditions.start, conditions.goal, PER_METRE * least / least.shape[1] ** 0.5], dim=1)
    return np.asarray(rows.numpy(), np.float32)
