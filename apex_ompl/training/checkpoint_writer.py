"""Writing of checkpoints with their model cards."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from numpy.typing import NDArray
from safetensors.numpy import save as save_arrays

from apex_ompl.errors import MissingFileError
from apex_ompl.model.checkpoint import CONFIG, SCHEMA, WEIGHTS
from apex_ompl.model.config import ModelConfig
from apex_ompl.model.quantization import quantized
from apex_ompl.training.latent_diffusion import LatentDiffusion
from apex_ompl.util.files import is_file

CARD = "README.md"
PART = ".part"


def save_model(
    folder: str | os.PathLike[str],
    network: LatentDiffusion,
    trained: Mapping[str, Any],
    *,
    bits: Literal[8, 16, 32] = 16,
) -> None:
    """Write a checkpoint with its model card, completely or not at all; an existing one is replaced.

    Args:
        folder: Folder of the checkpoint.
        network: The model.
        trained: Record of its training, ready for JSON.
        bits: Size of a stored weight; 8 is for large matrices, with all others in half precision.

    Raises:
        MissingFileError: The folder cannot be written, or is not a checkpoint's.
    """
    kept: dict[str, NDArray[Any]] = {
        name: (tensor.half() if bits < 32 and tensor.is_floating_point() else tensor).cpu().contiguous().numpy()
        for name, tensor in network.state_dict().items()
    }
    weights = save_arrays(quantized(kept) if bits == 8 else kept)
    config = {
        "schema": SCHEMA, "model": network.config.model_dump(mode="json"),
        "digest": hashlib.sha256(weights).hexdigest(), "trained": dict(trained),
    }  # fmt: skip
    card = model_card(network.config, trained, sum(p.numel() for p in network.parameters()))
    write_checkpoint(Path(folder), config, weights, card)


def write_checkpoint(folder: Path, config: Mapping[str, Any], weights: bytes, card: str) -> None:
    """Write the files of a checkpoint, all of them or none; those of an existing one are replaced.

    Args:
        folder: Folder of the checkpoint.
        config: Its configuration, ready for JSON.
        weights: Content of the file of weights.
        card: Its model card, Markdown.

    Raises:
        MissingFileError: The folder cannot be written, or is not a checkpoint's.
    """
    if folder.exists() and not is_file(folder / CONFIG):
        raise MissingFileError(str(folder), "folder for a checkpoint", "something else is there")
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
