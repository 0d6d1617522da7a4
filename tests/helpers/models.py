"""Small models, robots among obstacles, and queries, for the tests of the model."""

from __future__ import annotations

from functools import cache

import numpy as np
import torch
from support import DATA

from apex_ompl.kernel import Kernel, RobotTables
from apex_ompl.kernel.arrays import BOX, CAPSULE, CYLINDER, SPHERE
from apex_ompl.kernel.scene_builder import Primitive, scene_tables
from apex_ompl.model.config import (
    ConditionConfig,
    DenoiserConfig,
    LatentConfig,
    ModelConfig,
    NoiseConfig,
    key_shapes,
)
from apex_ompl.model.query import ObstacleSet, Probes, Query
from apex_ompl.model.scene_encoding import KeyStates, key_states
from apex_ompl.training.autoencoder import LinearLatent
from apex_ompl.training.latent_diffusion import LatentDiffusion
from apex_ompl.training.records import Paths
from apex_ompl.training.store import load

DOF = 16
KINDS = {"box": BOX, "sphere": SPHERE, "cylinder": CYLINDER, "capsule": CAPSULE}


@cache
def some_paths() -> Paths:
    """Paths of a few problems of every level."""
    return load(DATA / "paths.zip")


@cache
def kernel(*obstacles: tuple[str, tuple[float, ...], tuple[float, ...]]) -> Kernel:
    """The robot among obstacles that are given by shape, position and size; kernels keep radii and half lengths."""
    solids = []
    for k, (shape, position, size) in enumerate(obstacles):
        pose = np.eye(4)
        pose[:3, 3] = position
        solids.append((k, Primitive(KINDS[shape], pose, size)))
    return Kernel(RobotTables.load(DATA / "robot.npz"), scene_tables(solids))


def config(**parts: object) -> ModelConfig:
    robot = kernel().robot
    count = len(Probes.from_robot(robot, 3).joint)
    small = {
        "latent": LatentConfig(dim=24, width=16), "condition": ConditionConfig(width=16, out=32, along=3),
        "denoiser": DenoiserConfig(width=32, blocks=2), "noise": NoiseConfig(),
    }  # fmt: skip
    parts = small | parts
    arms = (2, 7) if parts["condition"].scene == "clearances" else (0, 0)
    return ModelConfig(robot=robot.name, joints=robot.joint_names, probes=count, arms=arms, **parts)


@cache
def keys(count: int = 24) -> KeyStates:
    """Key states of the robot among the states of some paths."""
    paths = some_paths()
    states = paths.spline.path(paths.control(slice(0, 200))).reshape(-1, DOF)
    return key_states(kernel().robot, states, count, np.random.default_rng(0))


def network(seed: int = 0, **parts: object) -> LatentDiffusion:
    """A small model, its last layer not zero as at the beginning of a training."""
    torch.manual_seed(seed)
    model = LatentDiffusion(config(**parts))
    probes = Probes.from_robot(kernel().robot, 3)
    model.probe_joint.copy_(torch.from_numpy(probes.joint))
    model.probe_offset.copy_(torch.from_numpy(probes.offset))
    if model.config.condition.scene == "clearances":
        for name, values in zip(key_shapes(model.config), (keys().state, keys().joint, keys().ball), strict=True):
            getattr(model, name).copy_(torch.from_numpy(values))
    if isinstance(model.autoencoder, LinearLatent):
        model.autoencoder.fit(torch.tensor(some_paths().control(), dtype=torch.float32))
    for parameter in model.denoiser.parameters():
        if not parameter.detach().any():
            torch.nn.init.normal_(parameter, std=0.05)
    return model


VARIATIONAL = {
    "latent": LatentConfig(kind="variational", width=16, channels=4),
    "denoiser": DenoiserConfig(kind="unet", width=8, multipliers=(1, 2)),
    "condition": ConditionConfig(scene="none", point=True, width=16, out=32, along=2),
}
REGRESSION = {"denoiser": DenoiserConfig(kind="regression", width=32, blocks=2)}
HANDS = ("left_hand_palm", "right_hand_palm")
CLEARANCES = {"condition": ConditionConfig(scene="clearances", width=16, out=32, along=3, keys=24, hands=HANDS)}
REFINED = {"condition": CLEARANCES["condition"].model_copy(update={"refined": True})}
WALL = ("box", (0.45, 0.0, 0.6), (0.05, 0.4, 0.3))
POST = ("cylinder", (0.4, 0.3, 0.5), (0.05, 0.3))


def query(seed: int = 0) -> Query:
    rng = np.random.default_rng(seed)
    limits = kernel().robot.arrays
    middle, span = (limits.lower + limits.upper) / 2, limits.upper - limits.lower
    ends = middle + 0.3 * span * rng.uniform(-0.5, 0.5, (2, DOF))
    rows = [(0, WALL[1], (0, 0, 0, 1), (0.1, 0.8, 0.6)), (2, POST[1], (0, 0, 0, 1), (0.05, 0.6, 0.0))]
    held = [(HANDS[1], rng.uniform(-0.1, 0.1, (1, 3)) + np.array([[-0.05], [0.05]]))]
    return Query(ends[0], ends[1], np.array([0.4, 0.0, 0.5]), ObstacleSet.from_rows(rows), held=held)
