"""Windows to train an imitation policy on: times of stored paths, their states, and the states that follow."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from apex_ompl.baselines.imitation.config import ImitationConfig
from apex_ompl.baselines.imitation.network import PolicyNetwork
from apex_ompl.errors import ParameterError
from apex_ompl.kernel import Kernel, RobotTables
from apex_ompl.kernel.scene_builder import scene_tables
from apex_ompl.model.query import Probes
from apex_ompl.paths.spline import Spline
from apex_ompl.training.conditions import Conditions
from apex_ompl.training.data import Mirror, Shard, shard_paths, split
from apex_ompl.training.records import Paths

NO_PROBES = Probes(np.zeros(0, np.int64), np.zeros((0, 3)), 1)
"""No probe points: the policy sees obstacles as they are."""

TURN = 8  # steps whose paths are drawn together and sorted by their number of obstacles, since batches are padded
STATISTICS_WINDOWS = 65_536
LEAST_SCALE = 1e-3  # [rad]
ALL_UNITS = 2**31


@dataclass(frozen=True, eq=False)
class Windows:
    """W windows of each of B paths.

    Attributes:
        conditions: Goals and obstacles of the paths.
        state: States as the policy is shown them, shape (B, W, dof) [rad].
        time: Their steps on the clock, shape (B, W).
        following: The true states that follow, the last of the path being kept at its end, (B, W, chunk, dof) [rad].
    """

    conditions: Conditions
    state: Tensor
    time: Tensor
    following: Tensor

    def to(self, device: torch.device) -> Windows:
        """Return a copy on a device."""
        state, time, following = (tensor.to(device) for tensor in (self.state, self.time, self.following))
        return Windows(self.conditions.to(device), state, time, following)


class WindowData:
    """Data of a training run, all in memory.

    Attributes:
        train: Paths to train on, mirror images among them.
        validation: Paths of held-out problems, or None.
        joints: Names of the planned joints.
    """

    def __init__(self, config: ImitationConfig, robot: RobotTables) -> None:
        """Read the data.

        Raises:
            ApexError: They cannot be read, or are those of another robot.
        """
        paths, _ = shard_paths(config.sources, config.seed, ALL_UNITS, 0)
        self.joints = robot.joint_names
        if (paths.about["robot"], tuple(paths.about["joints"])) != (robot.name, robot.joint_names):
            raise ParameterError("data", paths.about["robot"], f"paths of {robot.name}, whose tables are given")
        dof = len(self.joints)
        if config.network.dof != dof:
            raise ParameterError("network.groups", config.network.dof, f"{dof} joints")
        kernel = Kernel(robot, scene_tables([]))
        train, few = split(paths, config.held_out)
        sets = [train]
        if config.mirror is not None:
            if len(config.mirror.order) != dof:
                raise ParameterError("mirror", len(config.mirror.order), f"{dof} joints")
            sets.append(Mirror(**config.mirror.model_dump()).paths(train, kernel))
        self.train = Shard(sets, NO_PROBES, kernel, config.weights)
        self.validation = Shard([few], NO_PROBES, kernel, {}) if len(few) else None
        self._obstacles = np.concatenate([obstacle_counts(one) for one in sets if len(one)])
        self._config = config
        self._basis = basis_of(paths.spline, config.network.clock)

    def digest(self) -> str:
        """Return the SHA-256 digest of the control points of the paths to train on."""
        return hashlib.sha256(self.train.control.numpy().tobytes()).hexdigest()

    def batch(self, step: int) -> Windows:
        """Return the windows of a training step; the same in every run of a configuration."""
        config, (turn, part) = self._config, divmod(step, TURN)
        which = self.train.sample(TURN * config.batch, self._generator(0, turn))
        which = which[np.argsort(self._obstacles[which], kind="stable")].reshape(TURN, config.batch)
        order = torch.randperm(TURN, generator=self._generator(1, turn))
        return self.windows(self.train, np.sort(which[order[part]]), config.noise, self._generator(2, step))

    def held_out(self, count: int) -> Windows | None:
        """Return windows of at most ``count`` held-out paths, without noise, the same at all times; None if none."""
        if self.validation is None:
            return None
        generator = self._generator(3, 0)
        which = torch.randperm(len(self.validation), generator=generator)[:count].sort().values.numpy()
        return self.windows(self.validation, which, 0.0, generator)

    def windows(self, shard: Shard, which: NDArray[np.int64], noise: float, generator: torch.Generator) -> Windows:
        """Return windows of some paths, one in each of as many equal parts of the clock.

        Args:
            shard: The paths.
            which: Their sorted indices, shape (B,).
            noise: Standard deviation of the noise on the states that are shown [rad].
            generator: Source of the times and of the noise.
        """
        network, count = self._config.network, self._config.windows
        control, conditions = shard.batch(which, generator)
        uniform = torch.rand(len(which), count, generator=generator)
        time = ((torch.arange(count) + uniform) * ((network.clock - 1) / count)).long().clamp(max=network.clock - 2)
        states = self.states(control, time)
        shown = states[:, :, 0]
        if noise > 0.0:
            shown = shown + noise * torch.randn(shown.shape, generator=generator)
        return Windows(conditions, shown, time, states[:, :, 1:])

    def states(self, control: Tensor, time: Tensor) -> Tensor:
        """Return states of paths at times (B, W) and at the ``chunk`` steps after them, (B, W, 1 + chunk, dof)."""
        network = self._config.network
        at = (time[..., None] + torch.arange(network.chunk + 1)).clamp(max=network.clock - 1)
        return self._basis[at] @ control[:, None]

    def fit(self, network: PolicyNetwork) -> None:
        """Set the statistics of a network by the paths to train on, drawn as in training."""
        config = self._config
        generator = self._generator(4, 0)
        which = self.train.sample(max(1, min(STATISTICS_WINDOWS // config.windows, 8 * len(self.train))), generator)
        some = self.windows(self.train, which, 0.0, generator)
        flat = some.state.flatten(0, 1)
        network.mean.copy_(flat.mean(dim=0))
        network.deviation.copy_(flat.std(dim=0).clamp(min=LEAST_SCALE))
        rest = (some.following - network.line(some.conditions.goal, some.state, some.time)).flatten(0, 1)
        network.scale.copy_((rest.var(dim=0) + config.noise**2).sqrt().clamp(min=LEAST_SCALE))

    def _generator(self, purpose: int, number: int) -> torch.Generator:
        seed = np.random.SeedSequence([self._config.seed, purpose, number]).generate_state(1)[0]
        return torch.Generator().manual_seed(int(seed))


def obstacle_counts(paths: Paths) -> NDArray[np.int64]:
    """Return the number of obstacles of each path's problem, shape (N,)."""
    return np.asarray(paths.arrays["things"].astype(np.int64)[paths.arrays["problem"]])


def basis_of(spline: Spline, clock: int) -> Tensor:
    """Return the weights of the control points at the states of a clock, shape (clock, points)."""
    return torch.tensor(spline.basis(np.linspace(0.0, 1.0, clock)), dtype=torch.float32)
