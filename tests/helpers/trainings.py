"""Small trainings, for the tests of training and of checkpoints."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from support import DATA, ROOT

from apex_ompl.model.query import ObstacleSet, Query
from apex_ompl.training.config import TrainingConfig
from apex_ompl.training.records import Paths
from apex_ompl.training.training import DistributedProcess, Trainer

SCRIPT = ROOT / "scripts" / "train.py"
HERE = DistributedProcess(0, 1, torch.device("cpu"))
SMALL = {
    "schema": "apex-ompl/training/1", "robot": str(DATA / "robot.npz"), "latent": {"dim": 32},
    "condition": {"width": 32, "out": 64, "along": 3}, "denoiser": {"width": 64, "blocks": 2}, "steps": 12, "batch": 32,
    "warmup": 2, "held_out": 0.0, "log_every": 5,
}  # fmt: skip
CLEARANCES = {"scene": "clearances", "width": 32, "out": 64, "along": 3, "keys": 16, "refined": True}
VARIATIONAL = {
    "latent": {"kind": "variational", "width": 16, "channels": 4}, "autoencoder": {"steps": 5},
    "denoiser": {"kind": "unet", "width": 8, "multipliers": [1, 2]}, "condition": {"scene": "none", "point": True},
    "noise": {"prediction": "noise", "schedule": "linear"},
}  # fmt: skip


def config(data: Path, **changes: Any) -> TrainingConfig:
    return TrainingConfig.model_validate({**SMALL, "data": str(data), **changes})


def weights(trainer: Trainer) -> dict[str, torch.Tensor]:
    return {**trainer.network.state_dict(), **{f"averaged.{k}": v for k, v in trainer.averaged.items()}}


def assert_same(first: dict[str, torch.Tensor], second: dict[str, torch.Tensor]) -> None:
    assert first.keys() == second.keys()
    for name, tensor in first.items():
        assert torch.equal(tensor, second[name]), name


def query_from_path(paths: Paths, k: int) -> Query:
    a, p = paths.arrays, paths.arrays["problem"][k]
    first = int(a["things"][:p].sum())
    span = slice(first, first + int(a["things"][p]))
    columns = (a[name][span] for name in ("shape", "position", "orientation", "size"))
    obstacles = ObstacleSet.from_rows(list(zip(*columns, strict=True)))
    return Query(paths.start[k], paths.goal[k], a["point"][k], obstacles)
