"""Trained models evaluated by torch: any architecture, on any device; their checkpoints are read and written here."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.numpy import save as save_arrays
from torch import Tensor

from apex_ompl.errors import MissingFileError, ParameterError
from apex_ompl.kernel import Kernel
from apex_ompl.model.array_model import expanded, quantized
from apex_ompl.model.checkpoint import CONFIG, SCHEMA, WEIGHTS, CheckpointConfig, check_shapes, read_checkpoint
from apex_ompl.model.config import ModelConfig, key_shapes
from apex_ompl.model.guidance import Guidance, collision_cost
from apex_ompl.model.proposals import TrajectoryModel
from apex_ompl.model.query import Probes, Query
from apex_ompl.training.autoencoder import Autoencoder
from apex_ompl.training.conditions import batch_queries
from apex_ompl.training.latent_diffusion import LatentDiffusion
from apex_ompl.types import Array
from apex_ompl.util.files import is_file
from apex_ompl.util.process import one_torch_thread

CARD = "README.md"
PART = ".part"


def with_slopes(paths: Tensor, cost: Tensor, slopes: Tensor) -> Tensor:
    """Return costs of paths that were computed outside of torch as functions of the paths, with known gradients.

    Args:
        paths: Shape (B, N, dof) [rad].
        cost: Shape (B,).
        slopes: Gradients of the costs, shape (B, N, dof).
    """
    return cost + (slopes * (paths - paths.detach())).sum(dim=(1, 2))


def log_likelihood(
    autoencoder: Autoencoder, kernel: Kernel, latent: Tensor, ends: tuple[Tensor, Tensor], guidance: Guidance
) -> Tensor:
    """Return log p(g | z) of latent vectors up to a constant, shape (B,): minus the collision cost of their paths.

    Args:
        autoencoder: Decoder of the latent vectors.
        kernel: The robot among its obstacles.
        latent: Latent vectors z, shape (B, *latent).
        ends: Starts and goals, each of shape (B, dof) [rad].
        guidance: Margin of the cost, and number of states.
    """
    paths = autoencoder.decode(latent, *ends)[:, guidance.states(autoencoder.spline.states)]
    found = collision_cost(kernel, paths.detach().cpu().double().numpy(), guidance.margin)
    return -with_slopes(paths, *(torch.from_numpy(values).to(paths) for values in found))


def gradient(function: Callable[[Tensor], Tensor], at: Tensor) -> Tensor:
    """Return the gradient, of the shape of ``at``, of a function from (B, ...) to one number a row, (B,)."""
    with torch.enable_grad():
        inside = at.detach().requires_grad_()
        found: Tensor = torch.autograd.grad(function(inside).sum(), inside)[0]
    return found


class TorchModel(TrajectoryModel):
    """Trained model whose networks torch evaluates.

    Attributes:
        network: The networks.
    """

    def __init__(self, network: LatentDiffusion, about: Mapping[str, Any]) -> None:
        """Use a network with its present weights; they are frozen."""
        joint, offset = network.probe_joint.cpu().numpy(), network.probe_offset.cpu().double().numpy()
        keys = {name: getattr(network, name).cpu().numpy() for name in key_shapes(network.config)}
        super().__init__(network.config, about, Probes(joint, offset, network.config.condition.along), keys)
        self.network = network.eval().requires_grad_(False)

    @property
    def device(self) -> torch.device:
        """Where it runs."""
        return self.network.probe_offset.device

    def one_thread(self) -> AbstractContextManager[None]:
        """Limit torch to one thread inside a block."""
        return one_torch_thread()

    def zeros(self, count: int) -> Tensor:
        """Return ``count`` latent vectors of zeros."""
        return torch.zeros(count, *self.network.latent, device=self.device)

    @torch.no_grad()
    def encode(self, control: Array) -> Tensor:
        """Return the latent vectors of control points, shape (B, points, dof) [rad]."""
        return self.network.autoencoder.encode(self._tensor(control))

    @torch.no_grad()
    def condition(self, queries: Sequence[Query], kernel: Kernel) -> Tensor:
        """Return the encoded conditions of Q queries, shape (Q, out)."""
        found: Tensor = self.network.encoder(
            batch_queries(queries, self.scene_encoding or self.probes, kernel).to(self.device)
        )
        return found

    @torch.no_grad()
    def refine(self, condition: Tensor, along: NDArray[np.float32]) -> Tensor:
        """Return encoded conditions refined by features along estimated paths, shape (B, F)."""
        return self.network.encoder.refine(condition, self._tensor(along))

    @torch.no_grad()
    def denoise(self, latent: Tensor, t: int, condition: Tensor) -> Tensor:
        """Return the denoiser's output for latent vectors at a step, each with its condition, or one for all."""
        return self.network.denoise(latent, torch.full((1,), t, device=latent.device), condition)

    def score(self, latent: Tensor, kernel: Kernel, ends: tuple[Array, Array], guidance: Guidance) -> Tensor:
        """Return the gradient of log p(g | z) at latent vectors z, see :meth:`TrajectoryModel.score`."""
        start, goal = map(self._tensor, ends)

        def log_p(clean: Tensor) -> Tensor:
            return log_likelihood(self.network.autoencoder, kernel, clean, (start, goal), guidance)

        return gradient(log_p, latent)

    @torch.no_grad()
    def control(self, latent: Tensor, ends: tuple[Array, Array]) -> Array:
        """Return control points, shape (B, points, dof) [rad], of latent vectors between starts and goals."""
        return self.network.autoencoder.control(latent, *map(self._tensor, ends)).cpu().double().numpy()

    def _tensor(self, values: NDArray[Any]) -> Tensor:
        return torch.tensor(np.asarray(values), dtype=torch.float32, device=self.device)


def load_torch_model(
    name: str | os.PathLike[str] = "apex", *, device: str | torch.device = "cpu", robot: str | None = None
) -> TorchModel:
    """Return a trained model that torch evaluates, whose networks are modules.

    Arguments are those of :func:`~apex_ompl.model.load_model`.

    Raises:
        ApexError: As :func:`~apex_ompl.model.load_model` does.
    """
    return torch_model(*read_checkpoint(name, robot), device)


def torch_model(
    config: CheckpointConfig, weights: Mapping[str, NDArray[Any]], source: Path, device: str | torch.device
) -> TorchModel:
    """Return a trained model from what :func:`~apex_ompl.model.checkpoint.read_checkpoint` returns.

    Raises:
        FileFormatError: The weights do not fit the configuration.
        ParameterError: There is no such device.
    """

    def shapes() -> dict[str, tuple[int, ...]]:
        with torch.device("meta"):  # without memory for them
            return {key: tuple(value.shape) for key, value in LatentDiffusion(config.model).state_dict().items()}

    check_shapes(weights, shapes, source)
    with torch.random.fork_rng(devices=[]):
        network = LatentDiffusion(config.model)
    state, values = network.state_dict(), expanded(weights)
    network.load_state_dict({key: torch.from_numpy(values[key]).to(one.dtype) for key, one in state.items()})
    try:
        network.to(device)
    except (RuntimeError, AssertionError) as error:
        raise ParameterError("device", str(device), "a device of torch's that is there") from error
    return TorchModel(network, config.trained)


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
            f"Trained: {trained['phase']}, step {trained['step']}, {trained['seconds'] / 60:.0f} "
            f"min, {trained['paths']} paths in memory (mirror images counted). The configuration is in `config.json`.",
        ]
    if "validation" in trained:
        lines += ["", *_gain_lines(trained["validation"])]
    lines += ["", "It proposes paths; they are not valid until they are checked. `apex_ompl.load_model` reads it.", ""]
    return "\n".join(lines)


def _gain_lines(told: Mapping[str, Any]) -> list[str]:
    """Return what the plans of a validation with and without the model showed, Markdown."""
    rows = [("solved", "solved"), ("CPU time, p50 [s]", "p50"), ("CPU time, p95 [s]", "p95")]
    low, high = told["interval"]
    stages = ", ".join(f"{stage} {count}" for stage, count in told["stages"].items()) or "none"
    return [
        f"## {told['verdict'][0].upper()}{told['verdict'][1:]}", "",
        f"{told['problems']} validation problems whose straight line is not free, each planned by `apex` with this "
        f"model and with random perturbations in its place, at most {told['timeout']:g} s, untimed:", "",
        "| | with the model | without |", "|---|---:|---:|",
        *(f"| {label} | {told[key][0]} | {told[key][1]} |" for label, key in rows), "",
        f"Ratio of the CPU times, where both solve the problem: {told['ratio']} (95 %: {low} to {high}).",
        f"What found the paths with the model: {stages}.",
    ]  # fmt: skip
