"""Configurations of trainings: what is faulty or does not fit is named."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml
from support import ROOT
from trainings import CLEARANCES, HERE, SMALL, config

from apex_ompl.errors import ApexError, FileFormatError, ParameterError
from apex_ompl.training.config import TrainingConfig
from apex_ompl.training.training import Trainer


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"schema": "apex-ompl/training/2"}, "schema: expected 'apex-ompl/training/1', got 'apex-ompl/training/2'"),
        ({"stepz": 3}, "stepz: unknown key, did you mean 'steps'?"),
        ({"steps": 0}, "steps: input should be greater than or equal to 1, got 0"),
        ({"latent": {"kind": "quadratic"}}, "latent.kind: input should be 'linear' or 'variational'"),
        ({"rate": float("nan")}, "rate: input should be a finite number"),
        ({"initial": "apex", "latent": {"kind": "variational"}}, "expected a linear latent space with initial"),
        ({"collision": -1.0}, "collision: input should be greater than or equal to 0"),
        ({"collision": 1.0}, "expected parts, mixed and collision for the scene 'clearances'"),
        ({"mirror": {"order": [0, 0], "sign": [1, 1], "shift": [0, 0]}}, "mirror: expected every joint's number once"),
    ],
)
def test_faulty_configurations_are_named(change: dict[str, Any], message: str, few: Path, tmp_path: Path) -> None:
    file = tmp_path / "faulty.yaml"
    file.write_text(yaml.safe_dump({**SMALL, "data": str(few), **change}))
    with pytest.raises(FileFormatError, match="faulty.yaml") as caught:
        TrainingConfig.read(file)
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"data": "/no/such"}, "manifest of a data set '/no/such/manifest.json': no such file"),
        ({"robot": "/no/such.npz"}, "file of kernel tables '/no/such.npz': no such file"),
        ({"latent": {"dim": 500}}, "dimension of the latent space: expected a whole number from 1 to 192, got 500"),
        ({"mirror": {"order": [0], "sign": [1], "shift": [0]}}, "mirror: expected 16 joints, got 1"),
        ({"initial": "apix"}, "unknown checkpoint 'apix', did you mean 'apex'? known: apex, apex-paper"),
    ],
)
def test_what_does_not_fit_is_named(change: dict[str, Any], message: str, few: Path, tmp_path: Path) -> None:
    with pytest.raises(ApexError) as caught:
        Trainer(config(**{"data": few, **change}), tmp_path, HERE)
    assert str(caught.value) == message


def test_a_checkpoint_of_another_architecture_is_named(few: Path, tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match=r"initial: expected a checkpoint with the latent of this run, .*dim=32"):
        Trainer(config(few, initial="apex", condition={**CLEARANCES, "along": 12, "keys": 512}), tmp_path, HERE)


def test_dotted_keys_change_a_configuration() -> None:
    read = TrainingConfig.read(ROOT / "scripts" / "configs" / "apex.yaml", {"latent.dim": 7, "steps": 3})
    assert read.latent.dim == 7 and read.steps == 3
    for name in ("apex", "apex-paper"):
        TrainingConfig.read(ROOT / "scripts" / "configs" / f"{name}.yaml")
    with pytest.raises(FileFormatError, match="expected 'steps' to hold keys"):
        TrainingConfig.read(ROOT / "scripts" / "configs" / "apex.yaml", {"steps.more": 3})
