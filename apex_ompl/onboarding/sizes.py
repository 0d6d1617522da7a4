"""Sizes of networks and steps for the time that a training has."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from apex_ompl.paths.spline import Spline
from apex_ompl.problems.robot_cells import Cell
from apex_ompl.training.config import TrainingConfig
from apex_ompl.training.training import DistributedProcess, Trainer

LATENT = 4  # components of the latent space for each joint; the two Pandas, of 16 joints, have 64
WORKSPACE = (0.4, 0.0, 0.6)  # its middle in the frame of a cell
UNITS = 4  # units of the data set that the steps are measured on
WARM, MEASURED = 2, 4  # steps before the measurement, and in it
MARGIN = 0.85  # share of the time that is planned with: the machine may be busier than in the measurement
LEAST_STEPS = 20
SAVE_EVERY = 60.0  # [s]


@dataclass(frozen=True)
class NetworkSize:
    """Sizes of the networks of a model.

    Attributes:
        seconds: Time of a training from which on they are taken [s].
        width: Width of the denoiser.
        blocks: Blocks of the denoiser.
        encoder: Width of the encoder's layers.
        out: Size of an encoded condition.
        keys: Number of key states.
        along: States of the straight line at which probe points are placed.
        batch: Paths in a step.
    """

    seconds: float
    width: int
    blocks: int
    encoder: int
    out: int
    keys: int
    along: int
    batch: int


SIZES = (
    NetworkSize(1200.0, 768, 4, 384, 512, 512, 12, 1024),
    NetworkSize(120.0, 256, 3, 192, 256, 128, 12, 256),
    NetworkSize(0.0, 64, 2, 32, 64, 16, 4, 64),
)
"""From the largest to the smallest."""


def training_config(
    cell: Cell, paths: Path, seconds: float, *, seed: int, mirror: dict[str, Sequence[float]] | None
) -> dict[str, Any]:
    """Return the configuration of a training as plain data, without the number of steps.

    Args:
        cell: The robot's cell.
        paths: Folder of the data set, with the tables of the robot.
        seconds: Time that the training has [s].
        seed: Seed of all random choices.
        mirror: Fields of the mirror symmetry of the robot, if any.
    """
    size = next(one for one in SIZES if seconds >= one.seconds)
    hands = [cell.robot.hands[arm.hand].palm for arm in cell.arms if arm.hand is not None]
    center = (
        WORKSPACE if cell.pose is None else cell.pose[:3, :3] @ (cell.size * np.array(WORKSPACE)) + cell.pose[:3, 3]
    )
    return {
        "schema": "apex-ompl/training/1", "data": str(paths), "robot": str(paths / "robot.npz"), "seed": seed,
        "latent": {"kind": "linear", "dim": min(LATENT * cell.robot.dof, Spline().free * cell.robot.dof)},
        "condition": {
            "scene": "clearances", "width": size.encoder, "out": size.out, "along": size.along, "keys": size.keys,
            "hands": hands, "center": [round(float(v), 4) for v in center], "reach": round(cell.size, 4),
            "refined": True,
        },
        "denoiser": {"kind": "mlp", "width": size.width, "blocks": size.blocks},
        "noise": {"schedule": "cosine", "prediction": "velocity"},
        "batch": size.batch, "rate": 1e-3, "decay": 0.1, "sampling": {"temperature": 1.3}, "parts": 0.5, "mixed": 0.8,
        "collision": 2.0, "mirror": mirror, "save_every": SAVE_EVERY,
    }  # fmt: skip


def with_steps(config: dict[str, Any], seconds: float) -> dict[str, Any]:
    """Return a configuration with as many steps as fit into a time, by a measurement on a part of the data.

    Args:
        config: The configuration.
        seconds: Time that is left for the training, the measurement included [s].

    Raises:
        ApexError: The data cannot be read.
    """
    started = time.monotonic()
    probe = TrainingConfig.model_validate({**config, "steps": LEAST_STEPS, "units": UNITS})
    with tempfile.TemporaryDirectory(prefix="apex_ompl_") as folder:
        trainer = Trainer(probe, Path(folder), DistributedProcess.current())
        for _ in range(WARM):
            trainer.advance()
        before = trainer.seconds
        for _ in range(MEASURED):
            trainer.advance()
        step = (trainer.seconds - before) / MEASURED
    left = MARGIN * (seconds - (time.monotonic() - started))
    steps = max(LEAST_STEPS, math.floor(left / step))
    return {**config, "steps": steps, "warmup": max(1, min(500, steps // 10)), "log_every": max(1, steps // 20)}
