"""Paths and scenes of a data set as a model of scene ``clearances`` learns from them, augmented at every batch.

All that a batch needs is computed where the tables are, on a GPU or a CPU.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from apex_ompl.model.geometry import rotation_matrices
from apex_ompl.model.query import HALVES
from apex_ompl.training.conditions import Conditions, conditions_of_features
from apex_ompl.training.obstacles import Obstacles
from apex_ompl.training.records import Paths, held_extents
from apex_ompl.training.torch_scene_encoding import TorchSight

PART_LENGTHS = (0.25, 0.9)  # range of the length of a part of a path, as a share of it
RESTS = 0.5  # share of the parts that begin or end where their path does
BENT = 0.1  # parts whose states are all nearer to a straight line are not taken [rad, max-norm]
PART_STATES = 64  # of a part, from which its control points are computed
STRANGERS = 24  # obstacles of another scene that are tried
CHECKED_STATES = 24  # of a path, at which it is checked against them


@dataclass(frozen=True)
class Augmentation:
    """How paths are varied.

    Attributes:
        parts: Share of the paths of which a part is taken.
        mixed: Share of the paths among whose obstacles are put some of another scene that leave it free.
    """

    parts: float = 0.0
    mixed: float = 0.0


class SightTable:
    """Paths of a data set and their scenes as tensors.

    A path is turned round in one of two cases. What is left of a free path's parts is free, and so is a path among more
    obstacles, where these are apart from balls around the arms; paths among obstacles drawn and rejected like this have
    the distribution of paths given that all of them are free.

    Attributes:
        control: Control points, shape (N, points, dof), float32 [rad].
    """

    def __init__(self, paths: Paths, eyes: TorchSight, augmentation: Augmentation | None) -> None:
        """Put paths where ``eyes`` compute; without an augmentation they stay as they are.

        Raises:
            DatasetError: Held objects have no extents.
        """
        a, device = paths.arrays, eyes.balls.device
        self._eyes, self._augmentation, spline = eyes, augmentation, paths.spline
        self.control = torch.tensor(paths.control(), dtype=torch.float32, device=device)
        self._point = torch.tensor(np.asarray(a["point"], np.float32), device=device)
        self._problem = torch.tensor(a["problem"].astype(np.int64), device=device)
        held = np.array([eyes.sight.held(held_extents(text)) for text in paths.names["held"]], np.float32)
        self._held = torch.tensor(held[a["held"]], device=device)
        shape = a["shape"].astype(np.int64)
        self._count = torch.tensor(a["things"].astype(np.int64), device=device)
        self._first = torch.cumsum(self._count, 0) - self._count
        owner = torch.repeat_interleave(torch.arange(paths.problems, device=device), self._count)
        rotation, size = rotation_matrices(a["orientation"]), a["size"] * HALVES[shape]
        places = (eyes.tensor(values) for values in (a["position"], rotation, size))
        self._obstacles = Obstacles(torch.tensor(shape, device=device), *[*places, owner])
        mixes = augmentation is not None and augmentation.mixed > 0.0
        self._at_keys, self._keys = self._clearances(paths.problems, keep=mixes)
        u = np.linspace(0.0, 1.0, PART_STATES)
        self._basis = eyes.tensor(spline.basis(spline.parameters))
        self._few = eyes.tensor(spline.basis(np.linspace(0.0, 1.0, CHECKED_STATES)))
        self._fit = eyes.tensor(np.linalg.pinv(spline.basis(u)[:, spline.inner]))
        self._inner, self._even = spline.inner, eyes.tensor(u)
        self._line = eyes.tensor(spline.line(np.zeros(1), np.ones(1)))
        self._along = eyes.tensor(eyes.sight.probes.shares)

    def _clearances(self, problems: int, *, keep: bool) -> tuple[Tensor, Tensor]:
        """Return the features of key states of each scene, and of each obstacle where they are kept."""
        obstacles, features = self._obstacles, len(self._eyes.balls)
        count = len(obstacles.owner)
        found = torch.ones(problems, features, device=self.control.device)
        kept = torch.empty(count if keep else 0, features, dtype=torch.half, device=self.control.device)
        step = 4096
        for k in range(0, count, step):
            some = obstacles.part(slice(k, k + step))
            seen = self._eyes.at_keys(some)
            found.scatter_reduce_(0, some.owner[:, None].expand_as(seen), seen.float(), "amin")
            if keep:
                kept[k : k + step] = seen
        return found.half(), kept

    def batch(self, which: Tensor, generator: torch.Generator) -> tuple[Tensor, Conditions]:
        """Return control points (B, points, dof) and conditions of paths by their indices, augmented.

        Args:
            which: Shape (B,).
            generator: Source of the augmentation, on the CPU, so that it is the same on all devices.
        """
        device, eyes = self.control.device, self._eyes
        which = which.to(device)
        control, problem = self.control[which], self._problem[which]
        held, at_keys = self._held[problem], self._at_keys[problem].float()
        count, first = self._count[problem], self._first[problem]
        index = torch.arange(int(count.max()) if len(which) else 0, device=device)
        mask = index < count[:, None]
        index = torch.where(mask, first[:, None] + index, 0)
        if self._augmentation is not None:
            control = self._varied(control, generator)
            strangers, free = self._strangers(control, held, generator)
            if self._augmentation.mixed > 0.0:
                for one in range(STRANGERS):  # few of them leave a path free
                    rows = free[:, one].nonzero()[:, 0]
                    others = self._keys[strangers[rows, one]].float()
                    at_keys[rows] = torch.minimum(at_keys[rows], others)
            mask, index = torch.cat([mask, free], dim=1), torch.cat([index, strangers], dim=1)
        start, goal = control[:, 0], control[:, -1]
        line = start[:, None] + self._along[:, None] * (goal - start)[:, None]
        owner, place = mask.nonzero(as_tuple=True)
        among = self._obstacles.chosen(index[owner, place], owner)
        seen = torch.cat([at_keys, eyes.along(line, among), held], dim=1)
        return control, conditions_of_features(seen, start, goal, self._point[which], among=among)

    def _uniform(self, generator: torch.Generator, *shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator).to(self.control.device)

    def _varied(self, control: Tensor, generator: torch.Generator) -> Tensor:
        """Return paths, some of them turned round, and of some a part."""
        assert self._augmentation is not None
        count = len(control)
        turned, taken, length, first, rests = self._uniform(generator, 5, count)
        control = torch.where((turned < 0.5)[:, None, None], control.flip(1), control)
        length = PART_LENGTHS[0] + (PART_LENGTHS[1] - PART_LENGTHS[0]) * length
        first = torch.where(rests < RESTS / 2, 0.0, torch.where(rests < RESTS, 1.0, first)) * (1.0 - length)
        at = (first[:, None] + length[:, None] * self._even) * (len(self._basis) - 1)
        low = at.long().clamp(max=len(self._basis) - 2)
        share = (at - low)[..., None]
        states = (self._basis[low] * (1.0 - share) + self._basis[low + 1] * share) @ control
        start, goal = states[:, :1], states[:, -1:]
        rest = states - start - self._even[:, None] * (goal - start)
        part = start + self._line * (goal - start)
        part[:, self._inner] += self._fit @ rest
        bent = rest.abs().amax(dim=(1, 2)) > BENT
        return torch.where(((taken < self._augmentation.parts) & bent)[:, None, None], part, control)

    def _strangers(self, control: Tensor, held: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Return indices of obstacles of other scenes, shape (B, STRANGERS), and which of them leave the paths free."""
        assert self._augmentation is not None
        count, obstacles = len(control), self._obstacles
        shares = self._uniform(generator, count, STRANGERS + 3)
        other = (shares[:, 0] * len(self._count)).long().clamp(max=len(self._count) - 1)
        number = self._count[other][:, None]
        index = self._first[other][:, None] + (shares[:, 3:] * number).long()
        index = torch.where(number > 0, index.clamp(max=max(0, len(obstacles.owner) - 1)), 0)
        chosen = self._uniform(generator, count, STRANGERS) < shares[:, 1:2]
        chosen &= (number > 0) & (shares[:, 2:3] < self._augmentation.mixed) & ~held.any(dim=1, keepdim=True)
        owner, place = chosen.nonzero(as_tuple=True)
        centers, radii = self._eyes.arm_balls(self._few @ control)
        some = obstacles.chosen(index[owner, place], owner)
        free = torch.zeros_like(chosen)
        free[owner, place] = self._eyes.least(some, centers, radii) > 0.0
        return index, free
