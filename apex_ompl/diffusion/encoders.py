"""Encoders of conditions: the MLP phi of the paper, and one that sees the obstacles."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from apex_ompl.datasets.records import SHAPES
from apex_ompl.diffusion.conditions import Conditions, pooled

MIDDLE = (0.4, 0.0, 0.6)  # about where the robot works, from which points are counted [m]
NEAR = 0.4  # distances are told apart up to here [m]
LARGE = 1e4


class ConditionEncoder(nn.Module):
    """Turns conditions into one vector.

    With ``scene="none"`` it is the paper's phi: an MLP over the vector g of start, goal and obstacle point. ``set``
    adds the obstacles, each through an MLP and then pooled by mean and maximum, so that their order does not matter
    (Zaheer et al. 2017). ``distances`` adds what the obstacles mean to the robot: where its probes are along the
    straight line, and how far they are from each obstacle, and from the nearest one.
    """

    lower: Tensor
    upper: Tensor
    middle: Tensor

    def __init__(self, dof: int, *, out: int, width: int, scene: str, point: bool, probes: int, along: int) -> None:
        """Make an encoder.

        Args:
            dof: Number of joints.
            out: Size of the vector.
            width: Width inside.
            scene: ``none``, ``set`` or ``distances``.
            point: Whether it sees the obstacle point.
            probes: Number of probes.
            along: Number of states of the straight line at which they are.
        """
        super().__init__()
        self.scene, self.point, self.along = scene, point, along
        self.register_buffer("lower", torch.full((dof,), -1.0))
        self.register_buffer("upper", torch.full((dof,), 1.0))
        self.register_buffer("middle", torch.tensor(MIDDLE), persistent=False)
        size = 2 * dof + 3 * point
        if scene != "none":
            seen = len(SHAPES) + 15 + (3 * probes if scene == "distances" else 0)
            self.thing = nn.Sequential(
                nn.Linear(seen, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width)
            )
            size += 2 * width
        if scene == "distances":
            size += 4 * along * probes
        self.phi = nn.Sequential(nn.Linear(size, 2 * width), nn.SiLU(), nn.Linear(2 * width, out))

    def set_limits(self, lower: Tensor, upper: Tensor) -> None:
        """Scale states by the robot's limits, shape (dof,) [rad]."""
        self.lower.copy_(lower)
        self.upper.copy_(upper)

    def forward(self, given: Conditions) -> Tensor:
        """Return vectors, shape (B, out)."""
        span = self.upper - self.lower
        parts = [2.0 * (q - self.lower) / span - 1.0 for q in (given.start, given.goal)]
        if self.point:
            parts.append(given.point - self.middle)
        if self.scene != "none":
            parts += self._seen(given)
        encoded: Tensor = self.phi(torch.cat(parts, dim=1))
        return encoded

    def _seen(self, given: Conditions) -> list[Tensor]:
        """Return what is seen of the obstacles, tensors of shape (B, ...)."""
        there = given.there
        shape, position, turn, size = given.things()
        kinds = nn.functional.one_hot(shape, len(SHAPES)).to(position)
        things = [kinds, position - self.middle, turn.flatten(1), size]
        parts: list[Tensor] = []
        if self.scene == "distances":
            along, probes = given.probes.shape[1:3]
            with torch.autocast(there.device.type, enabled=False):  # half precision is some millimetres off
                apart = given.apart().clamp(-NEAR, NEAR) / NEAR
            parts += [(given.probes - self.middle).flatten(1), pooled(apart, there, 1.0).amin(dim=1)]
            things.append(apart.reshape(-1, along, probes)[:, [0, along // 2, -1]].flatten(1))
        tokens = self.thing(torch.cat(things, dim=1))
        mean = pooled(tokens, there, 0.0).sum(dim=1) / there.sum(dim=1, keepdim=True).clamp(min=1)
        return [*parts, mean, pooled(tokens, there, -LARGE).amax(dim=1).clamp(min=0.0)]
