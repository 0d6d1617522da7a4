"""Model at the start of a training run."""

from __future__ import annotations

import torch

from apex_ompl.diffusion.autoencoder import LinearLatent
from apex_ompl.diffusion.config import TrainingConfig
from apex_ompl.diffusion.data import TrainingData
from apex_ompl.diffusion.model import LatentDiffusion
from apex_ompl.diffusion.model_config import ModelConfig, SplineConfig, key_shapes
from apex_ompl.kernel import RobotTables


def initial_network(config: TrainingConfig, data: TrainingData, robot: RobotTables) -> LatentDiffusion:
    """Return a model with random weights, with the robot's limits and probe points, and a fitted linear latent space.

    Args:
        config: Configuration of the run; the same seed gives the same weights.
        data: Training data.
        robot: Kernel tables of the robot.
    """
    probes, sight = data.probes, data.sight
    arms = (0, 0) if sight is None else sight.keys.joint.shape
    model = ModelConfig(
        robot=robot.name, joints=robot.joint_names, probes=len(probes.joint), arms=arms,
        spline=SplineConfig(**data.spline), latent=config.latent, condition=config.condition, denoiser=config.denoiser,
        noise=config.noise, sampling=config.sampling,
    )  # fmt: skip
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
