"""Encoder of conditions: the MLP phi of the paper, with or without features of all obstacles.

Names of layers are keys of the checkpoints' weights.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from apex_ompl.model.config import OBSTACLE_SCENES
from apex_ompl.model.geometry import SHAPES
from apex_ompl.model.query import MAX_DISTANCE, WORKSPACE_CENTER
from apex_ompl.training.conditions import Conditions, pad_obstacles

PADDING = -1e4  # below every feature, for the maximum over obstacles


class ConditionEncoder(nn.Module):
    """Encoder of start, goal and obstacles into one vector.

    With ``scene="none"`` it is the paper's phi: an MLP over the vector g of start, goal and obstacle point. ``set``
    adds the obstacles, each through an MLP and then pooled by mean and maximum, so that their order does not matter
    (Zaheer et al. 2017). ``distances`` adds the positions of the robot's probe points along the straight line
    from start to goal, and their signed distances to each obstacle and to the nearest one. ``clearances`` sees no
    obstacles but features of distances, see :mod:`apex_ompl.model.scene_encoding`.
    """

    lower: Tensor
    upper: Tensor
    center: Tensor

    def __init__(
        self, dof: int, *, out: int, width: int, scene: str, point: bool, probes: int, along: int, seen: int = 0,
        refined: int = 0,
    ) -> None:  # fmt: skip
        """Make an encoder.

        Args:
            dof: Number of joints.
            out: Size of the vector.
            width: Width of the hidden layers.
            scene: ``none``, ``set``, ``distances`` or ``clearances``.
            point: Whether the obstacle point is an input.
            probes: Number P of probe points.
            along: Number L of states of the straight line at which they are placed.
            seen: Number of features of ``clearances``.
            refined: Number of features along an estimate that :meth:`refine` sees; 0 where there are none.
        """
        super().__init__()
        self.scene, self.point, self.along = scene, point, along
        self.register_buffer("lower", torch.full((dof,), -1.0))
        self.register_buffer("upper", torch.full((dof,), 1.0))
        self.register_buffer("center", torch.tensor(WORKSPACE_CENTER), persistent=False)
        size = 2 * dof + 3 * point
        if scene in OBSTACLE_SCENES:
            features = len(SHAPES) + 15 + (3 * probes if scene == "distances" else 0)
            self.thing = nn.Sequential(
                nn.Linear(features, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width)
            )
            size += 2 * width
        if scene == "distances":
            size += 4 * along * probes
        inner: list[nn.Module] = []
        if scene == "clearances":
            size += seen
            inner = [nn.Linear(2 * width, 2 * width), nn.SiLU()]
        self.phi = nn.Sequential(nn.Linear(size, 2 * width), nn.SiLU(), *inner, nn.Linear(2 * width, out))
        if refined:
            layers = nn.Linear(refined, 2 * width), nn.SiLU(), nn.Linear(2 * width, 2 * width), nn.SiLU()
            self.psi = nn.Sequential(*layers, nn.Linear(2 * width, out))

    def refine(self, encoded: Tensor, along: Tensor) -> Tensor:
        """Return encoded conditions, (B, out) or (1, out), with what lies along estimates, features (B, refined)."""
        refined: Tensor = encoded + self.psi(along)
        return refined

    def set_limits(self, lower: Tensor, upper: Tensor) -> None:
        """Set the robot's limits, shape (dof,) [rad], by which states are scaled to -1..1."""
        self.lower.copy_(lower)
        self.upper.copy_(upper)

    def forward(self, conditions: Conditions) -> Tensor:
        """Return encoded conditions, shape (B, out)."""
        span = self.upper - self.lower
        parts = [2.0 * (q - self.lower) / span - 1.0 for q in (conditions.start, conditions.goal)]
        if self.point:
            parts.append(conditions.point - self.center)
        if self.scene in OBSTACLE_SCENES:
            parts += self._obstacle_features(conditions)
        parts.append(conditions.seen)
        encoded: Tensor = self.phi(torch.cat(parts, dim=1))
        return encoded

    def _obstacle_features(self, conditions: Conditions) -> list[Tensor]:
        """Return features of the obstacles, tensors of shape (B, features)."""
        mask = conditions.mask
        o = conditions.obstacles()
        kinds = nn.functional.one_hot(o.shape, len(SHAPES)).to(o.position)
        inputs = [kinds, o.position - self.center, o.rotation.flatten(1), o.size]
        parts: list[Tensor] = []
        if self.scene == "distances":
            along, probes = conditions.probes.shape[1:3]
            with torch.autocast(mask.device.type, enabled=False):  # half precision is some millimeters off
                distances = conditions.probe_distances().clamp(-MAX_DISTANCE, MAX_DISTANCE) / MAX_DISTANCE
            parts += [(conditions.probes - self.center).flatten(1), pad_obstacles(distances, mask, 1.0).amin(dim=1)]
            inputs.append(distances.reshape(-1, along, probes)[:, [0, along // 2, -1]].flatten(1))
        tokens = self.thing(torch.cat(inputs, dim=1))
        mean = pad_obstacles(tokens, mask, 0.0).sum(dim=1) / mask.sum(dim=1, keepdim=True).clamp(min=1)
        return [*parts, mean, pad_obstacles(tokens, mask, PADDING).amax(dim=1).clamp(min=0.0)]
