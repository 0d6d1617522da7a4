"""A trained imitation policy, rolled out into paths."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from apex_ompl.baselines import weights_folder
from apex_ompl.baselines.imitation.checkpoint import PolicyConfig, load_policy_network
from apex_ompl.baselines.imitation.data import NO_PROBES
from apex_ompl.baselines.imitation.network import PolicyNetwork
from apex_ompl.errors import MissingFileError
from apex_ompl.kernel import Kernel
from apex_ompl.model.checkpoint import CONFIG, FolderCache
from apex_ompl.model.query import Query
from apex_ompl.training.conditions import batch_queries
from apex_ompl.types import Array
from apex_ompl.util.files import is_file
from apex_ompl.util.process import one_torch_thread

EXECUTED = 8  # states of a chunk that are followed before the policy is asked again
SHIPPED = ("il", "il-paper")


class ImitationPolicy:
    """Trained policy, which is deterministic.

    Attributes:
        network: Its network.
        config: Its configuration.
    """

    def __init__(self, network: PolicyNetwork, config: PolicyConfig) -> None:
        """Use a network that is frozen."""
        self.network, self.config = network, config

    @property
    def clock(self) -> int:
        """Number of states of a path."""
        return self.network.config.clock

    @property
    def executed(self) -> int:
        """Number of states of a chunk that are followed by default."""
        return min(EXECUTED, self.network.config.chunk)

    @property
    def sees_point(self) -> bool:
        """Whether the obstacle point is an input."""
        return self.network.config.obstacles == "point"

    def roll_out(
        self, queries: Sequence[Query], kernel: Kernel, *, executed: int | None = None, blend: bool = True,
        first_step: int = 0, steps: int | None = None, stop: Callable[[], bool] = lambda: False,
    ) -> Array | None:  # fmt: skip
        """Return the paths of the policy from the starts of Q queries on, shape (Q, states, dof) [rad].

        The policy is asked for a chunk of states; of these the first ``executed`` are followed, and it is asked again
        from the last of them (action chunking, Zhao et al. 2023). The path is kept inside the joint limits, as a
        controller would, and by nothing else: it may collide, and end elsewhere than at the goal.

        Args:
            queries: The queries.
            kernel: The robot; its limits and kinematics are used, its scene is not.
            executed: Number of states of a chunk that are followed, at most all; 8 by default.
            blend: Whether the states that follow are averages of the new chunk and of the rest of the one before,
                weighted from the latter to the former (temporal ensembling).
            first_step: Step of the clock at which the starts are.
            steps: Number of steps; by default until the end of the clock.
            stop: Asked before each chunk whether to give up.

        Returns:
            The paths, whose first states are the starts bit for bit; None where it was stopped.
        """
        executed = self.executed if executed is None else executed
        last = self.clock - 1 if steps is None else min(first_step + steps, self.clock - 1)
        start = np.stack([query.start for query in queries])
        limits = kernel.robot.arrays
        lower, upper = (torch.tensor(v, dtype=torch.float32) for v in (limits.lower, limits.upper))
        with one_torch_thread(), torch.inference_mode():
            conditions = batch_queries(queries, NO_PROBES, kernel)
            now, before = conditions.start, None
            states, at = [now[:, None]], first_step
            while at < last:
                if stop():
                    return None
                time = torch.full((len(queries), 1), at)
                chunk = self.network(conditions, now[:, None], time)[:, 0]  # (Q, chunk, dof)
                count = min(executed, chunk.shape[1], last - at)
                taken = _blended(chunk, before if blend else None)[:, :count].clamp(lower, upper)
                before, now, at = chunk[:, count:], taken[:, -1], at + count
                states.append(taken)
        found = torch.cat(states, dim=1).double().numpy()
        found = np.clip(found, limits.lower, limits.upper)
        found[:, 0] = start
        return np.asarray(found)


def _blended(chunk: Tensor, before: Tensor | None) -> Tensor:
    """Return a chunk, (Q, H, dof), blended with what is left of the one before, (Q, n, dof)."""
    if before is None or not before.shape[1]:
        return chunk
    count = before.shape[1]
    share = (torch.arange(1, count + 1) / (count + 1))[:, None]
    return torch.cat([before + share * (chunk[:, :count] - before), chunk[:, count:]], dim=1)


def policy_folder(name: str | os.PathLike[str]) -> Path:
    """Return the folder of a policy, given by a name of :data:`SHIPPED`, or as a folder.

    Raises:
        MissingFileError: There is no policy.
    """
    text = os.fspath(name)
    folder = weights_folder(text) if text in SHIPPED else Path(text)
    if not is_file(folder / CONFIG):
        made = f"python scripts/train_il.py scripts/configs/{text if text in SHIPPED else 'il'}.yaml --save"
        raise MissingFileError(str(folder), "imitation policy", f"no such folder of one; in a clone, {made} makes it")
    return folder


def shared_policy(name: str | os.PathLike[str], *, robot: str | None = None) -> ImitationPolicy:
    """Return a policy from a cache; it is read again when its files change.

    Args:
        name: ``il`` or ``il-paper``, which lie in a clone of the repository, or a folder.
        robot: Name of the robot that the policy must be for; by default any.

    Raises:
        MissingFileError: There is no policy, or a file of it is missing.
        FileFormatError: It is damaged, of another version, or for another robot.
    """
    return _shared(policy_folder(name), robot=robot)


_shared = FolderCache(lambda folder, robot: ImitationPolicy(*load_policy_network(folder, robot=robot)))
