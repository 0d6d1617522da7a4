"""Checkpoints of imitation policies: folders of ``config.json``, ``model.safetensors`` and a model card."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from pydantic import Field
from safetensors.numpy import save as save_arrays

from apex_ompl.baselines.imitation.config import NetworkConfig
from apex_ompl.baselines.imitation.network import PolicyNetwork
from apex_ompl.errors import FileFormatError, MissingFileError
from apex_ompl.model.checkpoint import CONFIG, WEIGHTS, check_shapes, read_weights
from apex_ompl.training.torch_model import write_checkpoint
from apex_ompl.util.files import is_file
from apex_ompl.util.schema import StrictModel, read_record

SCHEMA = "apex-ompl/imitation/1"
ROLE = "file of an imitation policy"


class PolicyConfig(StrictModel):
    """Content of ``config.json``.

    Attributes:
        schema_: Version of the format.
        robot: Name of the robot.
        joints: Its planned joints in state order.
        network: Configuration of the network.
        digest: SHA-256 of the file of weights.
        trained: Record of the training.
    """

    schema_: Literal["apex-ompl/imitation/1"] = Field(alias="schema")
    robot: str
    joints: Annotated[tuple[str, ...], Field(min_length=1)]
    network: NetworkConfig
    digest: str
    trained: dict[str, Any] = {}


def save_policy(
    folder: str | os.PathLike[str], network: PolicyNetwork, robot: str, joints: tuple[str, ...],
    trained: Mapping[str, Any], *, bits: Literal[16, 32] = 16,
) -> None:  # fmt: skip
    """Write a policy with its model card, completely or not at all; an existing one is replaced.

    Args:
        folder: Folder of the checkpoint.
        network: The network.
        robot: Name of the robot.
        joints: Names of its planned joints in state order.
        trained: Record of the training, ready for JSON.
        bits: Size of a stored weight.

    Raises:
        MissingFileError: The folder cannot be written, or is not a checkpoint's.
    """
    kept = {
        name: (tensor.half() if bits == 16 else tensor).detach().cpu().contiguous().numpy()
        for name, tensor in network.state_dict().items()
    }
    weights = save_arrays(kept)
    config = {
        "schema": SCHEMA, "robot": robot, "joints": list(joints), "network": network.config.model_dump(mode="json"),
        "digest": hashlib.sha256(weights).hexdigest(), "trained": dict(trained),
    }  # fmt: skip
    count = sum(p.numel() for p in network.parameters())
    write_checkpoint(Path(folder), config, weights, policy_card(network.config, robot, trained, count))


def load_policy_network(
    folder: str | os.PathLike[str], *, robot: str | None = None
) -> tuple[PolicyNetwork, PolicyConfig]:
    """Return the network of a policy, ready for use and frozen, and its configuration.

    Args:
        folder: Folder of the checkpoint.
        robot: Name of the robot that the policy must be for; by default any.

    Raises:
        MissingFileError: A file of the checkpoint is missing.
        FileFormatError: The checkpoint is damaged, of another version, or for another robot.
    """
    folder = Path(folder)
    for file in (CONFIG, WEIGHTS):
        if not is_file(folder / file):
            raise MissingFileError(str(folder / file), ROLE)
    source = folder / CONFIG
    config = read_record(source, PolicyConfig, ROLE)
    if robot is not None and config.robot != robot:
        raise FileFormatError(str(source), "robot", config.robot, f"expected {robot!r}")
    if len(config.joints) != config.network.dof:
        raise FileFormatError(str(source), "joints", len(config.joints), f"expected {config.network.dof} joints")
    weights = read_weights(folder / WEIGHTS, config.digest)

    def shapes() -> dict[str, tuple[int, ...]]:
        with torch.device("meta"):  # without memory for them
            return {key: tuple(value.shape) for key, value in PolicyNetwork(config.network).state_dict().items()}

    check_shapes(weights, shapes, folder / WEIGHTS)
    with torch.random.fork_rng(devices=[]):
        network = PolicyNetwork(config.network)
    network.load_state_dict({key: torch.from_numpy(values).float() for key, values in weights.items()})
    return network.eval().requires_grad_(False), config


def policy_card(config: NetworkConfig, robot: str, trained: Mapping[str, Any], weights: int) -> str:
    """Return a model card, Markdown.

    Args:
        config: Configuration of the network.
        robot: Name of the robot.
        trained: Record of its training.
        weights: Number of weights.
    """
    sees = "a token for each obstacle" if config.obstacles == "set" else "a token of the obstacle point"
    lines = [
        f"# An imitation policy for {robot}",
        "",
        f"{weights / 1e6:.2f} million weights: a transformer encoder of {config.layers} layers, width {config.width} "
        f"and {config.heads} heads over tokens of state and goal by groups of joints, and {sees}. It "
        f"predicts the next {config.chunk} states of a path of {config.clock}.",
    ]
    if {"step", "steps", "seconds", "paths", "windows", "held_out", "data", "commit"} <= trained.keys():
        lines += [
            "",
            f"Trained by `scripts/train_il.py` at commit {trained['commit']} on {', '.join(trained['data'])}, split by "
            f"problem: {trained['paths']} paths (mirror images counted), step {trained['step']} of {trained['steps']}, "
            f"{trained['windows']} windows, {trained['seconds'] / 60:.0f} min on {trained['hardware']}.",
            "",
            f"Loss on held-out problems: {trained['held_out']}, with the straight line "
            f"{trained['line']} (mean square error in standard deviations of the data, without noise).",
        ]
    if trained.get("config", {}).get("init"):
        lines[-1:] = [f"{lines[-1]} It began with the weights of `{trained['config']['init']}`."]
    lines += [
        "",
        "What it rolls out is not valid until it is checked. The planners `il` and `il-paper` use such policies; "
        "the configuration is in `config.json`.",
        "",
    ]
    return "\n".join(lines)
