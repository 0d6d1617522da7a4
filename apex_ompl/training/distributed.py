"""The process of a training run among those that train one model together."""

from __future__ import annotations

import os
from dataclasses import dataclass

import torch
from torch import distributed


@dataclass(frozen=True)
class DistributedProcess:
    """One of the processes that train a model together (``torch.distributed``).

    Attributes:
        rank: Its rank, 0 to ``world_size - 1``.
        world_size: Number of processes.
        device: Device that it computes on.
    """

    rank: int
    world_size: int
    device: torch.device

    @classmethod
    def current(cls) -> DistributedProcess:
        """Return this process; where ``torchrun`` started it, join the process group."""
        rank, world_size, local = (
            int(os.environ.get(k, d)) for k, d in (("RANK", 0), ("WORLD_SIZE", 1), ("LOCAL_RANK", 0))
        )
        cuda = torch.cuda.is_available()
        device = torch.device("cuda", local) if cuda else torch.device("cpu")
        if cuda:
            torch.cuda.set_device(device)
        if world_size > 1 and not distributed.is_initialized():
            distributed.init_process_group("nccl" if cuda else "gloo")
        return cls(rank, world_size, device)

    def any(self, flag: bool) -> bool:
        """Return whether a flag is set in any of the processes; the same answer in all of them."""
        if self.world_size == 1:
            return flag
        value = torch.tensor(float(flag), device=self.device)
        distributed.all_reduce(value, distributed.ReduceOp.MAX)
        return bool(value > 0)

    def close(self) -> None:
        """Leave the process group."""
        if self.world_size > 1 and distributed.is_initialized():
            distributed.destroy_process_group()
