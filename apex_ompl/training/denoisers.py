"""Denoisers: networks that predict the noise (or velocity, or clean sample) of noisy latent vectors.

Names of layers are keys of the checkpoints' weights.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from apex_ompl.errors import ParameterError

GROUPS = 8


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
    """Residual block: two layers behind a layer normalization, scaled and shifted by step and condition."""

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
