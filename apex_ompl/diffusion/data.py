"""Training data: paths of a store as tensors, mirrored where the robot allows it, and drawn by weight."""

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

from apex_ompl.datasets.records import SPLINE, Paths, rounded, to_micro
from apex_ompl.datasets.store import Store, load
from apex_ompl.diffusion.conditions import Conditions, Probes, Table
from apex_ompl.diffusion.config import TrainingConfig
from apex_ompl.errors import ParameterError
from apex_ompl.kernel import Kernel, RobotTables
from apex_ompl.kernel.scene_builder import scene_tables
from apex_ompl.types import Array
from apex_ompl.util.files import is_file

NOTHING_HELD = "[]"
MEASURED = 100_000  # paths that the latent space is measured on, at most
WATCHED_SHARE = 0.02  # of all problems, at most, that the validation loss is taken on
PASSES, FOREVER = 4, 2**40  # over a window before the next, and steps where there is only one window
EVERY, CLOSE = 8, 0.01  # states of an image that are looked at, and clearances that are told apart [m]


@dataclass(frozen=True)
class Mirror:
    """A symmetry of a robot: its image in the plane y = 0.

    State q becomes ``sign * q[order] + shift``.

    Attributes:
        order: Which joint takes the place of each.
        sign: 1 or -1 for each.
        shift: What is added [rad].
    """

    order: Sequence[int]
    sign: Sequence[float]
    shift: Sequence[float]

    def states(self, q: Array) -> Array:
        """Return the images of states, shape (..., dof)."""
        return np.asarray(q[..., list(self.order)] * np.array(self.sign) + np.array(self.shift))

    def paths(self, paths: Paths, kernel: Kernel) -> Paths:
        """Return the images of all paths whose problem has nothing held.

        Those are left out that leave the limits, or whose links touch each other by the kernel: no robot is quite
        symmetric.
        """
        a = dict(paths.arrays)
        spline, lower, upper = paths.spline, kernel.robot.arrays.lower, kernel.robot.arrays.upper
        control = self.states(paths.control())
        inside = ((control >= lower) & (control <= upper)).all(axis=(1, 2))
        held = np.array(paths.names["held"], object)[a["held"][a["problem"]]] if len(control) else np.zeros(0, object)
        kept = inside & (held == NOTHING_HELD)
        for k in np.flatnonzero(kept):
            kept[k] = kernel.clearance(spline.path(control[k])[::EVERY], CLOSE)[:, 1].min() >= 0.0
        flip = np.array([1.0, -1.0, 1.0])
        a["position"] = (a["position"] * flip).astype(np.float32)
        a["orientation"] = (a["orientation"] * np.array([-1.0, 1.0, -1.0, 1.0])).astype(np.float32)
        for name in ("problem", "clearance", "length", "source", "homotopy"):
            a[name] = a[name][kept]
        a["point"] = (a["point"][kept] * flip).astype(np.float32)
        a["start"], a["goal"] = to_micro(control[kept, 0]), to_micro(control[kept, -1])
        a["control"] = rounded(control[kept][:, spline.inner], lower, upper).astype(np.float16)
        return Paths(a, paths.names, paths.about)


def held_out(name: str, share: float) -> bool:
    """Whether a problem, by its name, is kept from training; the same in every run."""
    number = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big")
    return number < share * 2**64


class Window:
    """Paths in memory, to draw batches from."""

    def __init__(self, parts: Sequence[Paths], probes: Probes, kernel: Kernel, weights: Mapping[str, float]) -> None:
        """Take in paths, drawn in proportion to the weight that the first fitting pattern gives their level.

        Raises:
            ParameterError: There are no paths, or all weigh nothing.
        """
        self._tables = [Table(part, probes, kernel) for part in parts if len(part)]
        parts = [part for part in parts if len(part)]
        self.control = torch.cat([torch.tensor(part.control(), dtype=torch.float32) for part in parts] or [_NONE])
        found = [_weights(part, weights) for part in parts]
        self._ends = np.cumsum([len(part) for part in parts])
        self.cumulated = np.cumsum(np.concatenate(found or [np.zeros(0)]))
        if not len(self.cumulated) or not self.cumulated[-1] > 0.0:
            raise ParameterError("training data", len(self.cumulated), "paths, some of them with a positive weight")

    def __len__(self) -> int:
        """Return the number of paths."""
        return len(self.control)

    def drawn(self, count: int, generator: torch.Generator) -> NDArray[np.int64]:
        """Return the numbers of paths drawn with replacement, sorted."""
        uniform = torch.rand(count, generator=generator, dtype=torch.float64).numpy()
        found = np.searchsorted(self.cumulated, uniform * self.cumulated[-1], side="right")
        return np.sort(np.minimum(found, len(self) - 1))

    def batch(self, which: NDArray[np.int64]) -> tuple[Tensor, Conditions]:
        """Return control points (B, points, dof) and conditions of paths by their numbers, which are sorted."""
        places = np.searchsorted(which, np.concatenate([[0], self._ends]))
        pieces = [
            table.batch(torch.from_numpy(which[a:b] - (end - len(table.start))))
            for table, a, b, end in zip(self._tables, places[:-1], places[1:], self._ends, strict=True)
            if b > a
        ]
        return self.control[torch.from_numpy(which)], Conditions.joined(pieces)


_NONE = torch.zeros(0, 1, 1)


def _weights(paths: Paths, weights: Mapping[str, float]) -> Array:
    """Return the weight of each path, by the first pattern that fits its level."""
    levels = [
        f"{paths.names['suite'][s]}/{paths.names['level'][v]}"
        for s, v in zip(paths.arrays["suite"], paths.arrays["level"], strict=True)
    ]
    known: dict[str, float] = {}
    for level in set(levels):
        known[level] = next((w for pattern, w in weights.items() if fnmatch.fnmatch(level, pattern)), 1.0)
    return np.asarray(np.array([known[level] for level in levels])[paths.arrays["problem"]])


def window_paths(data: Sequence[str], seed: int, units: int, number: int) -> tuple[Paths, int]:
    """Return the paths of one window of some data sets, and how many windows there are.

    Windows are some units each, in another order at every pass; a single file counts as one unit.

    Args:
        data: Folders of data sets, and files of paths.
        seed: Of the order.
        units: Units in a window.
        number: Counts the windows from 0, on over all passes.

    Raises:
        MissingFileError: There is no such data set.
        FileFormatError: It is damaged.
        DatasetError: The data sets are of different robots or splines.
        ParameterError: They are empty.
    """
    files: list[Path] = []
    for name in data:
        path = Path(name)
        files += [path] if is_file(path) else Store(path).files()
    if not files:
        raise ParameterError("data", ", ".join(data), "data sets with at least one unit")
    windows = -(-len(files) // units)
    turn, k = divmod(number, windows)
    order = np.random.default_rng([seed, turn]).permutation(len(files))[k * units : (k + 1) * units]
    return Paths.joined(load(files[j]) for j in sorted(order)), windows


def split(paths: Paths, share: float) -> tuple[Paths, Paths]:
    """Return the paths of problems to train on, and of those that are held out."""
    out = np.array([held_out(paths.problem_name(k), share) for k in range(paths.problems)], bool)
    return paths.chosen(np.flatnonzero(~out)), paths.chosen(np.flatnonzero(out))


class Supply:
    """What a training run draws its batches from: one window of its data at a time.

    Attributes:
        window: Paths to train on.
        watched: Paths of problems that are held out, the same ones all along, or None.
        spline: Fields of the paths' spline.
        number: Number of the window.
        left: Steps before the next one.
    """

    def __init__(self, config: TrainingConfig, robot: RobotTables) -> None:
        """Read the first window.

        Raises:
            ApexError: The data cannot be read, or are those of another robot.
        """
        self._config, self._kernel = config, Kernel(robot, scene_tables([]))
        self.probes = Probes.of(robot, config.condition.along)
        self._mirror: Mirror | None = None
        if config.mirror is not None:
            if len(config.mirror.order) != robot.dof:
                raise ParameterError("mirror", len(config.mirror.order), f"{robot.dof} joints")
            self._mirror = Mirror(**config.mirror.model_dump())
        self.watched: Window | None = None
        self.number = self.left = 0
        self.window = self._read(0)
        self._count()

    def measured(self) -> Tensor:
        """Return control points to measure a latent space on, drawn as training draws."""
        generator = torch.Generator().manual_seed(self._config.seed)
        count = min(MEASURED, 8 * len(self.window))  # so that few are left out
        return self.window.control[torch.from_numpy(self.window.drawn(count, generator))]

    def digest(self) -> str:
        """Return a digest of the data of the first window."""
        return hashlib.sha256(self.window.control.numpy().tobytes()).hexdigest()

    def spend(self) -> None:
        """Count a step, and read the next window when this one has had its turn."""
        if self.left == 0:
            self.go_to(self.number + 1)
        self.left -= 1

    def go_to(self, number: int, left: int | None = None) -> None:
        """Read another window, with so many steps left."""
        if number != self.number:
            del self.window  # two need not be in memory at once
            self.window, self.number = self._read(number), number
        self._count()
        self.left = self.left if left is None else left

    def _count(self) -> None:
        self.left = PASSES * max(1, len(self.window) // self._config.batch) if self._windows > 1 else FOREVER

    def _read(self, number: int) -> Window:
        config, robot = self._config, self._kernel.robot
        paths, self._windows = window_paths(config.sources, config.seed, config.units, number)
        if (paths.about["robot"], tuple(paths.about["joints"])) != (robot.name, robot.joint_names):
            raise ParameterError("data", paths.about["robot"], f"paths of {robot.name}, whose tables are given")
        self.spline = {k: paths.about[k] for k in SPLINE}
        train, out = split(paths, config.held_out)
        if self.watched is None:
            few = split(paths, min(config.held_out, WATCHED_SHARE))[1]  # the same problems for every share
            self.watched = Window([few], self.probes, self._kernel, {}) if len(few) else None
        parts = [train] if self._mirror is None else [train, self._mirror.paths(train, self._kernel)]
        return Window(parts, self.probes, self._kernel, config.weights)
