"""Checkpoints: folders of ``config.json``, ``model.safetensors`` and a model card; nothing in them is executed."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
import threading
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import torch
from pydantic import Field
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors

from apex_ompl.diffusion.model import LatentDiffusion, ModelConfig
from apex_ompl.diffusion.proposals import TrajectoryModel
from apex_ompl.errors import FileFormatError, MissingFileError, ParameterError, UnknownNameError
from apex_ompl.util.files import BROKEN, is_file, read_file, read_text
from apex_ompl.util.schema import StrictModel, validate

SCHEMA = "apex-ompl/model/1"
SHIPPED = Path(__file__).parent / "checkpoints"
CONFIG, WEIGHTS, CARD = "config.json", "model.safetensors", "README.md"
PART = ".part"
PICKLES = (".pt", ".pth", ".ckpt", ".bin", ".pkl", ".pickle")


class CheckpointConfig(StrictModel):
    """Content of ``config.json``.

    Attributes:
        schema_: Version of the format.
        model: Configuration of the model.
        digest: SHA-256 of the file of weights.
        trained: Record of the training.
    """

    schema_: Literal["apex-ompl/model/1"] = Field(alias="schema")
    model: ModelConfig
    digest: str
    trained: dict[str, Any] = {}


def save_model(
    folder: str | os.PathLike[str], network: LatentDiffusion, trained: Mapping[str, Any], *, half: bool = True
) -> None:
    """Write a checkpoint with its model card, completely or not at all; an existing one is replaced.

    Args:
        folder: Folder of the checkpoint.
        network: The model.
        trained: Record of its training, ready for JSON.
        half: Whether weights are stored in half precision.

    Raises:
        MissingFileError: The folder cannot be written, or is not a checkpoint's.
    """
    folder = Path(folder)
    if folder.exists() and not is_file(folder / CONFIG):
        raise MissingFileError(str(folder), "folder for a checkpoint", "something else is there")
    kept = {
        name: (tensor.half() if half and tensor.is_floating_point() else tensor).cpu().contiguous()
        for name, tensor in network.state_dict().items()
    }
    weights = save_tensors(kept)
    config = {
        "schema": SCHEMA, "model": network.config.model_dump(mode="json"),
        "digest": hashlib.sha256(weights).hexdigest(), "trained": dict(trained),
    }  # fmt: skip
    card = model_card(network.config, trained, sum(p.numel() for p in network.parameters()))
    content = {WEIGHTS: weights, CARD: card.encode(), CONFIG: (json.dumps(config, indent=1) + "\n").encode()}
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        for left in folder.parent.glob(f".{folder.name}.*{PART}"):  # left by a process that was killed
            shutil.rmtree(left, ignore_errors=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", suffix=PART, dir=folder.parent))
    except (OSError, ValueError) as error:
        why = (getattr(error, "strerror", None) or str(error)).lower()
        raise MissingFileError(str(folder), "folder for a checkpoint", why) from error
    new, old = temporary / "new", temporary / "old"
    try:
        new.mkdir()
        for name, data in content.items():
            (new / name).write_bytes(data)
        if folder.exists():
            os.replace(folder, old)
        os.replace(new, folder)
    except OSError as error:
        if old.exists() and not folder.exists():
            os.replace(old, folder)
        raise MissingFileError(str(folder), "folder for a checkpoint", str(error.strerror).lower()) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def model_card(config: ModelConfig, trained: Mapping[str, Any], weights: int) -> str:
    """Return a model card, Markdown.

    Args:
        config: Configuration of the model.
        trained: Record of its training.
        weights: Number of weights.
    """
    latent, condition, noise = config.latent, config.condition, config.noise
    size = f"{latent.dim} components" if latent.kind == "linear" else f"{latent.channels} channels"
    lines = [
        f"# A latent diffusion model of paths for {config.robot}",
        "",
        f"{weights / 1e6:.2f} million weights: a {latent.kind} latent space of {size}, a denoiser of kind "
        f"{config.denoiser.kind}, scene {condition.scene!r}, {noise.prediction} prediction over {noise.steps} steps.",
    ]
    if {"phase", "step", "seconds", "paths"} <= trained.keys():
        lines += [
            "",
            f"Trained by `scripts/train.py`: {trained['phase']}, step {trained['step']}, {trained['seconds'] / 60:.0f} "
            f"min, {trained['paths']} paths in memory (mirror images counted). The configuration is in `config.json`.",
        ]
    lines += ["", "It proposes paths; they are not valid until they are checked. `apex_ompl.load_model` reads it.", ""]
    return "\n".join(lines)


def load_model(
    name: str | os.PathLike[str] = "apex", *, device: str | torch.device = "cpu", robot: str | None = None
) -> TrajectoryModel:
    """Return a trained model.

    Args:
        name: Name of a checkpoint that ships, ``apex`` or ``apex-paper``, or a folder.
        device: Device that it computes on.
        robot: Name of the robot that the model must be for; by default any.

    Raises:
        UnknownNameError: No checkpoint of that name ships, and there is no such folder.
        MissingFileError: A file of the checkpoint is missing.
        FileFormatError: The checkpoint is damaged, a pickle, of another version, or for another robot.
        ParameterError: There is no such device.
    """
    folder = _folder(name)
    for file in (CONFIG, WEIGHTS):
        if not is_file(folder / file):
            raise MissingFileError(str(folder / file), "file of a checkpoint")
    config, weights = read_config(folder), read_file(folder / WEIGHTS, "file of a checkpoint")
    source = str(folder / WEIGHTS)
    if robot is not None and config.model.robot != robot:
        raise FileFormatError(str(folder / CONFIG), "model.robot", config.model.robot, f"expected {robot!r}")
    found = hashlib.sha256(weights).hexdigest()
    if found != config.digest:
        raise FileFormatError(source, "", f"SHA-256 {found[:12]}...", f"expected {config.digest[:12]}...: damaged")
    try:
        tensors = load_tensors(weights)
    except (SafetensorError, ValueError) as error:
        raise FileFormatError(source, "", str(error), "expected safetensors") from error
    wanted = _shapes(config.model, folder)
    shapes = {key: tuple(value.shape) for key, value in tensors.items()}
    wrong = sorted(set(wanted.items()) ^ set(shapes.items()))
    if wrong:
        expected = f"expected weights that fit {CONFIG}"
        raise FileFormatError(source, wrong[0][0], shapes.get(wrong[0][0], "nothing"), expected)
    for key, tensor in tensors.items():
        if not torch.isfinite(tensor).all():
            raise FileFormatError(source, key, "numbers that are not finite", "expected finite weights")
    with torch.random.fork_rng(devices=[]):
        network = LatentDiffusion(config.model)
    state = network.state_dict()
    network.load_state_dict({key: tensor.to(state[key].dtype) for key, tensor in tensors.items()})
    try:
        network.to(device)
    except (RuntimeError, AssertionError) as error:
        raise ParameterError("device", str(device), "a device of torch's that is there") from error
    return TrajectoryModel(network, config.trained)


def _shapes(config: ModelConfig, folder: Path) -> dict[str, tuple[int, ...]]:
    """Return the shapes of a model's weights, without memory for them.

    Raises:
        FileFormatError: There is no such model.
    """
    try:
        with torch.device("meta"):
            return {key: tuple(value.shape) for key, value in LatentDiffusion(config).state_dict().items()}
    except (*BROKEN, ParameterError) as error:
        expected = "expected the configuration of a model that can be made"
        raise FileFormatError(str(folder / CONFIG), "model", str(error), expected) from error


def shared_model(name: str | os.PathLike[str], *, device: str = "cpu", robot: str | None = None) -> TrajectoryModel:
    """Return a trained model from a cache; it is read again when its files change.

    Raises:
        ApexError: As :func:`load_model` does.
    """
    folder = _folder(name)
    files = [folder / file for file in (CONFIG, WEIGHTS)]
    stamp = tuple(file.stat().st_mtime_ns for file in files if is_file(file))
    with _loading:
        return _shared(str(folder.absolute()), stamp, device, robot)


_loading = threading.Lock()


@lru_cache(maxsize=4)
def _shared(folder: str, stamp: tuple[int, ...], device: str, robot: str | None) -> TrajectoryModel:
    del stamp
    return load_model(folder, device=device, robot=robot)


def read_config(folder: Path) -> CheckpointConfig:
    """Read the configuration of a checkpoint.

    Raises:
        FileFormatError: The file is not one.
    """
    path = folder / CONFIG
    try:
        data = json.loads(read_text(path, "file of a checkpoint"))
        if not isinstance(data, dict):
            raise ValueError
    except (ValueError, RecursionError) as error:
        raise FileFormatError(
            str(path), "", type(error).__name__, "expected the configuration of a checkpoint"
        ) from error
    if data.get("schema") != SCHEMA:
        raise FileFormatError(str(path), "schema", data.get("schema"), f"expected {SCHEMA!r}")
    return validate(CheckpointConfig, data, str(path))


def shipped() -> tuple[str, ...]:
    """Names of the checkpoints that ship."""
    return tuple(sorted(path.parent.name for path in SHIPPED.glob(f"*/{CONFIG}")))


def _folder(name: str | os.PathLike[str]) -> Path:
    text = os.fspath(name)
    if text in shipped():
        return SHIPPED / text
    folder = Path(text)
    try:
        if folder.is_dir():
            return folder
        if folder.suffix in PICKLES:
            expected = f"expected a checkpoint's folder ({CONFIG}, {WEIGHTS}); pickles are not read"
            raise FileFormatError(text, "", folder.suffix, expected)
    except (OSError, ValueError) as error:
        raise MissingFileError(text, "checkpoint", "no folder can have this name") from error
    if os.sep in text or folder.exists():
        raise MissingFileError(text, "checkpoint", "no such folder")
    raise UnknownNameError("checkpoint", text, shipped())
