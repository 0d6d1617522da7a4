"""Training data: paths of a store as tensors, with their mirror images, sampled by weight."""

from __future__ import annotations

import fnmatch
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from apex_ompl.errors import ParameterError
from apex_ompl.kernel import Kernel, RobotTables
from apex_ompl.kernel.scene_builder import scene_tables
from apex_ompl.model.config import key_shapes
from apex_ompl.model.query import Probes
from apex_ompl.model.scene_encoding import KeyStates, SceneEncoding, encoding_of, key_states
from apex_ompl.training.conditions import Augmentation, Conditions, ConditionTable, EncodedPaths
from apex_ompl.training.config import TrainingConfig
from apex_ompl.training.records import SPLINE, Paths, to_half, to_micro
from apex_ompl.training.scene_encoding import KernelSceneEncoding, TorchSceneEncoding
from apex_ompl.training.store import Store, load
from apex_ompl.training.torch_model import load_torch_model, with_slopes
from apex_ompl.types import Array
from apex_ompl.util.files import is_file

EMPTY_HANDS = "[]"  # JSON of the held objects
STRIDE, SELF_CLEARANCE_RANGE = 8, 0.01  # of the states of an image that are checked; range of the check [m]
KEY_PATHS = 5_000  # paths of whose states key states are chosen
STATISTICS_PATHS = 100_000  # most paths from which the statistics of the latent space are computed
VALIDATION_SHARE = 0.02  # most of all problems on which the validation loss is taken
CPU = torch.device("cpu")
MARGIN = 0.02  # distance from which the collision cost is positive [m]
COSTLY = 2  # one of so many paths in a batch has its collision cost computed
PASSES, UNLIMITED = 4, 2**40  # passes over a shard before the next; steps where there is only one shard


@dataclass(frozen=True)
class Mirror:
    """Mirror symmetry of a robot in the plane y = 0.

    The image of state q is ``sign * q[order] + shift``.

    Attributes:
        order: Index of the joint whose value each joint takes.
        sign: 1 or -1 for each joint.
        shift: Offset of each joint [rad].
    """

    order: Sequence[int]
    sign: Sequence[float]
    shift: Sequence[float]

    def states(self, q: Array) -> Array:
        """Return the images of states, shape (..., dof)."""
        return np.asarray(q[..., list(self.order)] * np.array(self.sign) + np.array(self.shift))

    def paths(self, paths: Paths, kernel: Kernel) -> Paths:
        """Return the images of all paths of problems with empty hands.

        No robot is exactly symmetric: images that leave the joint limits, or in which the robot's sphere cover
        collides with itself, are left out.
        """
        a = dict(paths.arrays)
        spline, lower, upper = paths.spline, kernel.robot.arrays.lower, kernel.robot.arrays.upper
        control = self.states(paths.control())
        inside = ((control >= lower) & (control <= upper)).all(axis=(1, 2))
        held = np.array(paths.names["held"], object)[a["held"][a["problem"]]] if len(control) else np.zeros(0, object)
        kept = inside & (held == EMPTY_HANDS)
        for k in np.flatnonzero(kept):
            kept[k] = kernel.clearance(spline.path(control[k])[::STRIDE], SELF_CLEARANCE_RANGE)[:, 1].min() >= 0.0
        flip = np.array([1.0, -1.0, 1.0])
        a["position"] = (a["position"] * flip).astype(np.float32)
        a["orientation"] = (a["orientation"] * np.array([-1.0, 1.0, -1.0, 1.0])).astype(np.float32)
        for name in ("problem", "clearance", "length", "source", "homotopy"):
            a[name] = a[name][kept]
        a["point"] = (a["point"][kept] * flip).astype(np.float32)
        a["start"], a["goal"] = to_micro(control[kept, 0]), to_micro(control[kept, -1])
        a["control"] = to_half(control[kept][:, spline.inner], lower, upper).astype(np.float16)
        return Paths(a, paths.names, paths.about)


def is_held_out(name: str, share: float) -> bool:
    """Whether a problem, by its name, is excluded from training; the same in every run."""
    number = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big")
    return number < share * 2**64


class Shard:
    """Paths in memory, from which batches are sampled.

    Attributes:
        cumulated: Cumulated sampling weights, shape (N,).
    """

    def __init__(
        self, sets: Sequence[Paths], encoding: Probes | TorchSceneEncoding, kernel: Kernel,
        weights: Mapping[str, float], augmentation: Augmentation | None = None,
    ) -> None:  # fmt: skip
        """Compute the tensors of paths.

        Args:
            sets: The paths.
            encoding: Probe points of the robot, or the features of a scene ``clearances``.
            kernel: The robot.
            weights: Sampling weight of each path, by patterns of ``suite/level``; the first that matches counts.
            augmentation: How paths are varied, for a scene ``clearances``; not at all by default.

        Raises:
            ParameterError: There are no paths, or all weights are 0.
        """
        sets = [paths for paths in sets if len(paths)]
        found = [_weights(paths, weights) for paths in sets]
        self.cumulated = np.cumsum(np.concatenate(found or [np.zeros(0)]))
        if not len(self.cumulated) or not self.cumulated[-1] > 0.0:
            raise ParameterError("training data", len(self.cumulated), "paths, some of them with a positive weight")
        self._tables: list[ConditionTable | EncodedPaths]
        if isinstance(encoding, TorchSceneEncoding):
            self._tables = [EncodedPaths(Paths.concatenate(sets), encoding, augmentation)]
            self._ends = np.array([len(self.cumulated)])
            return
        self._tables = [ConditionTable(paths, encoding, kernel) for paths in sets]
        self._ends = np.cumsum([len(paths) for paths in sets])

    def __len__(self) -> int:
        """Return the number of paths."""
        return len(self.cumulated)

    @property
    def control(self) -> Tensor:
        """Control points of all paths, shape (N, points, dof), float32 [rad]."""
        controls = [table.control for table in self._tables]
        return controls[0] if len(controls) == 1 else torch.cat(controls)

    def sample(self, count: int, generator: torch.Generator) -> NDArray[np.int64]:
        """Return sorted indices of paths, sampled with replacement in proportion to their weights."""
        uniform = torch.rand(count, generator=generator, dtype=torch.float64).numpy()
        found = np.searchsorted(self.cumulated, uniform * self.cumulated[-1], side="right")
        return np.sort(np.minimum(found, len(self) - 1))

    def batch(self, which: NDArray[np.int64], generator: torch.Generator) -> tuple[Tensor, Conditions]:
        """Return control points (B, points, dof) and conditions of paths by their sorted indices.

        Args:
            which: Shape (B,).
            generator: Source of the augmentation.
        """
        bounds = np.searchsorted(which, np.concatenate([[0], self._ends]))
        pieces = [
            table.batch(torch.from_numpy(which[a:b] - (end - len(table.control))), generator)
            for table, a, b, end in zip(self._tables, bounds[:-1], bounds[1:], self._ends, strict=True)
            if b > a
        ]
        controls, conditions = zip(*pieces, strict=True)
        return torch.cat(controls), Conditions.concatenate(conditions)


def _weights(paths: Paths, weights: Mapping[str, float]) -> Array:
    """Return the weight of each path, by the first pattern that matches its level; 1 where none does."""
    levels = [
        f"{paths.names['suite'][s]}/{paths.names['level'][v]}"
        for s, v in zip(paths.arrays["suite"], paths.arrays["level"], strict=True)
    ]
    known: dict[str, float] = {}
    for level in set(levels):
        known[level] = next((w for pattern, w in weights.items() if fnmatch.fnmatch(level, pattern)), 1.0)
    return np.asarray(np.array([known[level] for level in levels])[paths.arrays["problem"]])


def shard_paths(data: Sequence[str], seed: int, units: int, number: int) -> tuple[Paths, int]:
    """Return the paths of one shard of some data sets, and the number of shards.

    A shard is ``units`` units of the data sets, in a new random order at every pass; a single file counts as one unit.

    Args:
        data: Folders of data sets, and files of paths.
        seed: Seed of the order.
        units: Number of units in a shard.
        number: Index of the shard, counted from 0 on over all passes.

    Raises:
        MissingFileError: There is no such data set.
        FileFormatError: A data set is damaged.
        DatasetError: The data sets are of different robots or splines.
        ParameterError: The data sets are empty.
    """
    files: list[Path] = []
    for name in data:
        path = Path(name)
        files += [path] if is_file(path) else Store(path).files()
    if not files:
        raise ParameterError("data", ", ".join(data), "data sets with at least one unit")
    shards = -(-len(files) // units)
    turn, k = divmod(number, shards)
    order = np.random.default_rng([seed, turn]).permutation(len(files))[k * units : (k + 1) * units]
    return Paths.concatenate(load(files[j]) for j in sorted(order)), shards


def split(paths: Paths, share: float) -> tuple[Paths, Paths]:
    """Return the paths of training problems, and those of held-out problems."""
    out = np.array([is_held_out(paths.problem_name(k), share) for k in range(paths.problems)], bool)
    return paths.subset(np.flatnonzero(~out)), paths.subset(np.flatnonzero(out))


class TrainingData:
    """Data of a training run, of which one shard is in memory at a time.

    Attributes:
        shard: Paths to train on.
        validation: Paths of held-out problems, the same during the whole run, or None.
        spline: Fields of the paths' spline.
        probes: Probe points of the robot.
        scene_encoding: Features of a scene ``clearances``; None for other scenes.
        number: Index of the shard.
        left: Number of steps before the next shard.
    """

    def __init__(self, config: TrainingConfig, robot: RobotTables, device: torch.device = CPU) -> None:
        """Read the first shard; features of a scene ``clearances`` are computed on ``device``.

        Raises:
            ApexError: The data cannot be read, or are those of another robot.
        """
        self._config, self._kernel, self._device = config, Kernel(robot, scene_tables([])), device
        self.probes = Probes.from_robot(robot, config.condition.along)
        self._mirror: Mirror | None = None
        if config.mirror is not None:
            if len(config.mirror.order) != robot.dof:
                raise ParameterError("mirror", len(config.mirror.order), f"{robot.dof} joints")
            self._mirror = Mirror(**config.mirror.model_dump())
        self.validation: Shard | None = None
        self.scene_encoding: SceneEncoding | None = None
        self._batch_encoding: TorchSceneEncoding | None = None
        self.number = self.left = 0
        self.shard = self._read(0)
        self._reset_steps()

    def statistics_sample(self) -> Tensor:
        """Return control points from which to compute the statistics of a latent space, sampled as in training."""
        generator = torch.Generator().manual_seed(self._config.seed)
        count = min(STATISTICS_PATHS, 8 * len(self.shard))  # with replacement: e^-8 of the paths are left out
        return self.shard.control[torch.from_numpy(self.shard.sample(count, generator))].cpu()

    def digest(self) -> str:
        """Return the SHA-256 digest of the first shard's control points."""
        return hashlib.sha256(self.shard.control.cpu().numpy().tobytes()).hexdigest()

    def count_step(self) -> None:
        """Count a training step; read the next shard when none are left for this one."""
        if self.left == 0:
            self.go_to(self.number + 1)
        self.left -= 1

    def go_to(self, number: int, left: int | None = None) -> None:
        """Read another shard, with ``left`` steps before the next; by default as many as a new shard has."""
        if number != self.number:
            del self.shard  # two need not be in memory at the same time
            self.shard, self.number = self._read(number), number
        self._reset_steps()
        self.left = self.left if left is None else left

    def _reset_steps(self) -> None:
        """Set the number of steps of a new shard."""
        self.left = PASSES * max(1, len(self.shard) // self._config.batch) if self._shards > 1 else UNLIMITED

    def _read(self, number: int) -> Shard:
        config, robot = self._config, self._kernel.robot
        paths, self._shards = shard_paths(config.sources, config.seed, config.units, number)
        if (paths.about["robot"], tuple(paths.about["joints"])) != (robot.name, robot.joint_names):
            raise ParameterError("data", paths.about["robot"], f"paths of {robot.name}, whose tables are given")
        self.spline = {k: paths.about[k] for k in SPLINE}
        train, _ = split(paths, config.held_out)
        if self.scene_encoding is None and config.condition.scene == "clearances":
            self.scene_encoding = encoding_of(config.condition, self._key_states(train), self.probes)
            kind = KernelSceneEncoding if self._device.type == "cpu" else TorchSceneEncoding
            self._batch_encoding = kind(self.scene_encoding, self._kernel, self._device)
            self._spline = train.spline
            self._along_basis = self._batch_encoding.tensor(self._spline.basis(self.probes.shares))
        encoding = self._batch_encoding or self.probes
        if self.validation is None:
            few = split(paths, min(config.held_out, VALIDATION_SHARE))[1]  # the same problems for every larger share
            self.validation = Shard([few], encoding, self._kernel, {}) if len(few) else None
        sets = [train] if self._mirror is None else [train, self._mirror.paths(train, self._kernel)]
        return Shard(sets, encoding, self._kernel, config.weights, Augmentation(config.parts, config.mixed))

    def _key_states(self, train: Paths) -> KeyStates:
        """Return states of paths that are far apart, or the key states of the checkpoint that the run starts with."""
        config, robot = self._config, self._kernel.robot
        if config.initial is not None:
            network = load_torch_model(config.initial, robot=robot.name).network
            if network.config.condition.scene == "clearances":  # others are refused with the rest of their architecture
                return KeyStates.of(*(getattr(network, name).numpy() for name in key_shapes(network.config)))
        rng = np.random.default_rng(config.seed)
        control = train.control(np.sort(rng.integers(len(train), size=min(KEY_PATHS, len(train)))))
        return key_states(robot, train.spline.path(control).reshape(-1, robot.dof), config.condition.keys, rng)

    def features_along(self, control: Tensor, conditions: Conditions) -> Tensor:
        """Return features of a scene ``clearances`` along paths of control points (B, points, dof): shape (B, F)."""
        assert self._batch_encoding is not None
        assert conditions.among is not None
        return self._batch_encoding.along(self._along_basis @ control, conditions.among)

    def collision_cost(self, control: Tensor, conditions: Conditions, places: Tensor) -> Tensor:
        """Return the mean :meth:`TorchSceneEncoding.collision_cost` of some of the paths [m].

        Args:
            control: Control points, shape (B, points, dof) [rad].
            conditions: Conditions of the paths.
            places: Where in each of L equal pieces of a path its state is sampled, shape (L,) in 0..1.
        """
        assert self._batch_encoding is not None
        assert conditions.among is not None
        mine = (conditions.among.owner % COSTLY == 0).nonzero()[:, 0]
        among = conditions.among.chosen(mine, conditions.among.owner[mine] // COSTLY)
        shares = (np.arange(len(places)) + places.cpu().numpy()) / len(places)
        paths = self._batch_encoding.tensor(self._spline.basis(shares)) @ control[::COSTLY]
        with torch.no_grad():
            cost, slopes = self._batch_encoding.collision_cost(paths, among, MARGIN)
        return with_slopes(paths, cost, slopes).mean()
