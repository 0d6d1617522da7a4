"""Small imitation policies, for the tests of their training and of their planners."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from support import DATA

from apex_ompl.baselines.imitation.config import ImitationConfig, NetworkConfig
from apex_ompl.baselines.imitation.network import PolicyNetwork
from apex_ompl.baselines.imitation.training import ImitationTrainer

GROUPS = [list(range(7)), list(range(7, 14)), [14, 15]]
NETWORK = {"groups": GROUPS, "width": 32, "layers": 2, "heads": 4, "chunk": 8, "clock": 64}
SMALL = {
    "schema": "apex-ompl/imitation-training/1", "robot": str(DATA / "robot.npz"), "network": NETWORK, "steps": 12,
    "batch": 8, "windows": 4, "warmup": 2, "cooldown": 4, "held_out": 0.0, "log_every": 5,
}  # fmt: skip


def config(data: Path, *, obstacles: str = "set", **changes: Any) -> ImitationConfig:
    network = {**NETWORK, "obstacles": obstacles}
    return ImitationConfig.model_validate({**SMALL, "network": network, "data": str(data), **changes})


def weights(trainer: ImitationTrainer) -> dict[str, torch.Tensor]:
    return {**trainer.network.state_dict(), **{f"averaged.{k}": v for k, v in trainer.averaged.items()}}


def trained(folder: Path, data: Path, **changes: Any) -> Path:
    """The checkpoint of a training run of a few steps."""
    folder.mkdir()
    ImitationTrainer(config(data, **changes), folder).run()
    return folder / "checkpoint"


def lively(obstacles: str = "set") -> PolicyNetwork:
    """A network all of whose weights are random, the last layer's, too."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        network = PolicyNetwork(NetworkConfig.model_validate({**NETWORK, "obstacles": obstacles}))
        for parameter in network.parameters():
            torch.nn.init.normal_(parameter, std=0.2)
    return network.eval().requires_grad_(False)
