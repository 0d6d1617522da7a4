"""Model at the start of a training run."""

from __future__ import annotations

import torch

from apex_ompl.errors import ParameterError
from apex_ompl.kernel import RobotTables
from apex_ompl.model.config import ModelConfig, SplineConfig, key_shapes
from apex_ompl.training.autoencoder import LinearLatent
from apex_ompl.training.config import TrainingConfig
from apex_ompl.training.data import TrainingData
from apex_ompl.training.latent_diffusion import LatentDiffusion
from apex_ompl.training.torch_model import load_torch_model

NETWORKS = ("latent", "condition", "denoiser", "noise")  # parts of a model that a configuration sets


def initial_network(config: TrainingConfig, data: TrainingData, robot: RobotTables) -> LatentDiffusion:
    """Return a model with random weights, with the robot's limits and probe points, and a fitted linear latent space.

    Where the configuration names a checkpoint, all is that of the checkpoint.

    Args:
        config: Configuration of the run; the same seed gives the same weights.
        data: Training data.
        robot: Kernel tables of the robot.

    Raises:
        ApexError: The checkpoint that the run begins with cannot be read, or is of another architecture.
    """
    probes, sight = data.probes, data.sight
    arms = (0, 0) if sight is None else sight.keys.joint.shape
    model = ModelConfig(
        robot=robot.name, joints=robot.joint_names, probes=len(probes.joint), arms=arms,
        spline=SplineConfig(**data.spline), latent=config.latent, condition=config.condition, denoiser=config.denoiser,
        noise=config.noise, sampling=config.sampling,
    )  # fmt: skip
    if config.initial is not None:
        return _of_checkpoint(config.initial, model)
    with torch.random.fork_rng(devices=[]):  # torch's layers initialize their weights from the global generator
        torch.manual_seed(config.seed)
        network = LatentDiffusion(model)
    network.probe_joint.copy_(torch.from_numpy(probes.joint))
    network.probe_offset.copy_(torch.from_numpy(probes.offset))
    if sight is not None:
        for name, values in zip(key_shapes(model), (sight.keys.state, sight.keys.joint, sight.keys.ball), strict=True):
            getattr(network, name).copy_(torch.from_numpy(values))
    limits = (torch.tensor(v, dtype=torch.float32) for v in (robot.arrays.lower, robot.arrays.upper))
    network.encoder.set_limits(*limits)
    if isinstance(network.autoencoder, LinearLatent):
        network.autoencoder.fit(data.statistics_sample())
    return network


def _of_checkpoint(name: str, wanted: ModelConfig) -> LatentDiffusion:
    """Return the model of a checkpoint, ready to be trained on.

    Raises:
        ApexError: It cannot be read.
        ParameterError: It is of another architecture, the first difference of which is named.
    """
    network = load_torch_model(name, robot=wanted.robot).network
    found = network.config
    for field in (*NETWORKS, *(name for name in ModelConfig.model_fields if name not in (*NETWORKS, "sampling"))):
        theirs, ours = getattr(found, field), getattr(wanted, field)
        if theirs != ours:
            expected = f"a checkpoint with the {field} of this run, {ours!r}, not {theirs!r}"
            raise ParameterError("initial", name, expected)
    network.config = wanted
    return network.train().requires_grad_(True)
