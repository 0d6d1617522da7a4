"""Networks of a model in torch: the encoder of conditions, and the denoisers.

Names of layers are keys of the checkpoints' weights.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from apex_ompl.errors import ParameterError
from apex_ompl.model.config import OBSTACLE_SCENES, WORKSPACE_CENTER
from apex_ompl.model.geometry import SHAPES
from apex_ompl.model.query import MAX_DISTANCE
from apex_ompl.training.conditions import Conditions, pad_obstacles

PADDING = -1e4  # below every feature, for the maximum over obstacles
GROUPS = 8


class ConditionEncoder(nn.Module):
    """Encoder of start, goal and obstacles into one vector.

    With ``scene="none"`` it is the paper's phi: an MLP over the vector g of start, goal and obstacle point. ``set``
    adds the obstacles, each through an MLP and then pooled by mean and maximum, so that their order does not matter
    (Zaheer et al. 2017). ``distances`` adds the positions of the robot's probe points along the straight line
    from start to goal, and their signed distances to each obstacle and to the nearest one. ``clearances`` takes
    features of distances instead of obstacles, see :mod:`apex_ompl.model.scene_encoding`.
    """

    lower: Tensor
    upper: Tensor
    center: Tensor

    def __init__(
        self, dof: int, *, out: int, width: int, scene: str, point: bool, probes: int, along: int,
        scene_features: int = 0, refined: int = 0, center: Sequence[float] = WORKSPACE_CENTER, reach: float = 1.0,
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
            scene_features: Number of features of ``clearances``.
            refined: Number of features along an estimate that :meth:`refine` sees; 0 where there are none.
            center: Origin of the points among the features [m].
            reach: Length by which positions relative to it are divided [m].
        """
        super().__init__()
        self.scene, self.point, self.along, self.reach = scene, point, along, reach
        self.register_buffer("lower", torch.full((dof,), -1.0))
        self.register_buffer("upper", torch.full((dof,), 1.0))
        self.register_buffer("center", torch.tensor(center), persistent=False)
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
            size += scene_features
            inner = [nn.Linear(2 * width, 2 * width), nn.SiLU()]
        self.phi = nn.Sequential(nn.Linear(size, 2 * width), nn.SiLU(), *inner, nn.Linear(2 * width, out))
        if refined:
            layers = nn.Linear(refined, 2 * width), nn.SiLU(), nn.Linear(2 * width, 2 * width), nn.SiLU()
            self.psi = nn.Sequential(*layers, nn.Linear(2 * width, out))

    def refine(self, encoded: Tensor, along: Tensor) -> Tensor:
        """Return encoded conditions, (B, out) or (1, out), refined by features along estimates, (B, refined)."""
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
            parts.append(self._centered(conditions.point))
        if self.scene in OBSTACLE_SCENES:
            parts += self._obstacle_features(conditions)
        parts.append(conditions.features)
        encoded: Tensor = self.phi(torch.cat(parts, dim=1))
        return encoded

    def _centered(self, points: Tensor) -> Tensor:
        """Return points relative to the middle of the workspace, shape (..., 3)."""
        return (points - self.center) / self.reach

    def _obstacle_features(self, conditions: Conditions) -> list[Tensor]:
        """Return features of the obstacles, tensors of shape (B, features)."""
        mask = conditions.mask
        o = conditions.obstacles()
        kinds = nn.functional.one_hot(o.shape, len(SHAPES)).to(o.position)
        inputs = [kinds, self._centered(o.position), o.rotation.flatten(1), o.size]
        parts: list[Tensor] = []
        if self.scene == "distances":
            along, probes = conditions.probes.shape[1:3]
            with torch.autocast(mask.device.type, enabled=False):  # half precision is some millimeters off
                distances = conditions.probe_distances().clamp(-MAX_DISTANCE, MAX_DISTANCE) / MAX_DISTANCE
            parts += [self._centered(conditions.probes).flatten(1), pad_obstacles(distances, mask, 1.0).amin(dim=1)]
            inputs.append(distances.reshape(-1, along, probes)[:, [0, along // 2, -1]].flatten(1))
        tokens = self.thing(torch.cat(inputs, dim=1))
        mean = pad_obstacles(tokens, mask, 0.0).sum(dim=1) / mask.sum(dim=1, keepdim=True).clamp(min=1)
        return [*parts, mean, pad_obstacles(tokens, mask, PADDING).amax(dim=1).clamp(min=0.0)]


class StepEmbedding(nn.Module):
    """Sinusoidal embedding of denoising steps (Vaswani et al. 2017), as Ho et al. (2020) use it."""

    frequencies: Tensor

    def __init__(self, size: int) -> None:
        """Embed into ``size`` numbers, an even number."""
        super().__init__()
        rates = torch.exp(-math.log(10_000.0) * torch.arange(size // 2) / (size // 2))
        self.register_buffer("frequencies", rates, persistent=False)

    def forward(self, t: Tensor) -> Tensor:
        """Return embeddings (B, size) of steps (B,)."""
        angles = t[:, None].to(self.frequencies) * self.frequencies
        return torch.cat([angles.sin(), angles.cos()], dim=1)


class MLPDenoiser(nn.Module):
    """A residual MLP for flat latent vectors, scaled and shifted by step and condition in every block.

    The modulation is that of Peebles and Xie (2023); the last layers are zero at the start of training.
    """

    def __init__(self, dim: int, condition: int, width: int, blocks: int, step_size: int = 128) -> None:
        """Make a network.

        Args:
            dim: Size of a latent vector.
            condition: Size of the condition's vector.
            width: Width of the hidden layers.
            blocks: Number of blocks, of two layers each.
            step_size: Size of the embedding of a step.
        """
        super().__init__()
        self.step = nn.Sequential(StepEmbedding(step_size), nn.Linear(step_size, condition))
        self.enter = nn.Linear(dim, width)
        self.blocks = nn.ModuleList(ModulatedBlock(width, condition) for _ in range(blocks))
        self.leave = nn.Linear(width, dim)
        nn.init.zeros_(self.leave.weight)
        nn.init.zeros_(self.leave.bias)

    def forward(self, latent: Tensor, t: Tensor, condition: Tensor) -> Tensor:
        """Map latent vectors (B, dim) to (B, dim); steps (B,) and conditions (B, condition), or one for all."""
        embedding = functional.silu(self.step(t) + condition)
        x = self.enter(latent)
        for block in self.blocks:
            x = block(x, embedding)
        out: Tensor = self.leave(functional.layer_norm(x, x.shape[-1:]))
        return out


class ModulatedBlock(nn.Module):
    """Residual block: two layers after a layer normalization, scaled and shifted by step and condition."""

    def __init__(self, width: int, condition: int) -> None:
        """Map ``width`` features to as many."""
        super().__init__()
        self.modulation = nn.Linear(condition, 2 * width)
        self.first = nn.Linear(width, width)
        self.second = nn.Linear(width, width)
        nn.init.zeros_(self.second.weight)
        nn.init.zeros_(self.second.bias)

    def forward(self, x: Tensor, embedding: Tensor) -> Tensor:
        """Map (B, width) to the same shape, modulated by an embedding (B, condition)."""
        scale, shift = self.modulation(embedding).chunk(2, dim=-1)
        y = functional.layer_norm(x, x.shape[-1:]) * (1.0 + scale) + shift
        out: Tensor = x + self.second(functional.silu(self.first(y)))
        return out


class UNetDenoiser(nn.Module):
    """The 1-D U-Net of the paper (section III-B).

    The embedding of the step is concatenated with phi(g), and an MLP of both is added inside every convolution block
    (Algorithm 1).
    """

    def __init__(
        self, channels: int, condition: int, width: int, multipliers: Sequence[int] = (1, 2, 4), step_size: int = 128
    ) -> None:
        """Make a network.

        Args:
            channels: Channels of a latent vector.
            condition: Size of phi(g).
            width: Channels of the first resolution.
            multipliers: Channels of each resolution, in widths; from one to the next the length is halved.
            step_size: Size of the embedding of a step.
        """
        super().__init__()
        self.step = StepEmbedding(step_size)
        embedding_size = 4 * width
        self.mood = nn.Sequential(
            nn.Linear(step_size + condition, embedding_size),
            nn.SiLU(),
            nn.Linear(embedding_size, embedding_size),
            nn.SiLU(),
        )
        sizes = [width * m for m in multipliers]
        self.divisor = 2 ** (len(sizes) - 1)
        self.enter = nn.Conv1d(channels, width, 3, padding=1)
        self.down, self.up = nn.ModuleList(), nn.ModuleList()
        now, skips = width, [width]
        for k, size in enumerate(sizes):
            self.down += [ConvBlock(now, size, embedding_size), ConvBlock(size, size, embedding_size)]
            skips += [size, size]
            now = size
            if k + 1 < len(sizes):
                self.down.append(nn.Conv1d(size, size, 3, stride=2, padding=1))
                skips.append(size)
        self.middle = nn.ModuleList([ConvBlock(now, now, embedding_size), ConvBlock(now, now, embedding_size)])
        for k, size in reversed(list(enumerate(sizes))):
            self.up += [ConvBlock(n + skips.pop(), size, embedding_size) for n in (now, size, size)]
            now = size
            if k > 0:
                self.up.append(nn.ConvTranspose1d(size, size, 4, stride=2, padding=1))
        self.leave = nn.Sequential(nn.GroupNorm(GROUPS, now), nn.SiLU(), nn.Conv1d(now, channels, 3, padding=1))

    def forward(self, latent: Tensor, t: Tensor, condition: Tensor) -> Tensor:
        """Map latent vectors (B, channels, length) to the same shape.

        Steps have shape (B,) and conditions (B, condition), or are one for all.

        Raises:
            ParameterError: The length cannot be halved as often as there are resolutions.
        """
        if latent.shape[-1] % self.divisor:
            raise ParameterError("length of the latent space", latent.shape[-1], f"{self.divisor} times a whole number")
        embedding = self.mood(torch.cat([self.step(t), condition], dim=1))
        x = self.enter(latent)
        kept = [x]
        for block in self.down:
            x = block(x, embedding) if isinstance(block, ConvBlock) else block(x)
            kept.append(x)
        for block in self.middle:
            x = block(x, embedding)
        for block in self.up:
            x = block(torch.cat([x, kept.pop()], dim=1), embedding) if isinstance(block, ConvBlock) else block(x)
        out: Tensor = self.leave(x)
        return out


class ConvBlock(nn.Module):
    """Residual block of two convolutions, between which a projection of step and condition is added."""

    def __init__(self, before: int, after: int, embedding: int) -> None:
        """Map ``before`` channels to ``after``."""
        super().__init__()
        self.first = nn.Sequential(nn.GroupNorm(GROUPS, before), nn.SiLU(), nn.Conv1d(before, after, 3, padding=1))
        self.mood = nn.Linear(embedding, after)
        self.second = nn.Sequential(nn.GroupNorm(GROUPS, after), nn.SiLU(), nn.Conv1d(after, after, 3, padding=1))
        self.past = nn.Conv1d(before, after, 1) if before != after else nn.Identity()

    def forward(self, x: Tensor, embedding: Tensor) -> Tensor:
        """Map (B, before, length) to (B, after, length), given an embedding of step and condition."""
        out: Tensor = self.past(x) + self.second(self.first(x) + self.mood(embedding)[:, :, None])
        return out
