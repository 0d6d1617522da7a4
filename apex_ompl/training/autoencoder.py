"""Latent spaces of paths: whitened principal components of the free control points, or a variational autoencoder.

Both encode the residual of a path from the straight line between its ends, so that decoded paths meet start and goal
exactly for every latent vector.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from apex_ompl.errors import ParameterError
from apex_ompl.paths.spline import Spline
from apex_ompl.util.validation import check_integer

GROUPS = 8  # groups of the group normalization
MIN_DEVIATION = 1e-3  # smallest standard deviation that is whitened to one, relative to the largest


class Autoencoder(nn.Module, ABC):
    """Encoder and decoder of a path's residual from the straight line.

    Attributes:
        spline: Spline of the control points.
        dof: Number of joints.
        latent: Shape of a latent vector.
    """

    latent: tuple[int, ...]
    line_shares: Tensor
    basis: Tensor
    fit_matrix: Tensor

    def __init__(self, spline: Spline, dof: int) -> None:
        """Encode paths of ``dof`` joints."""
        super().__init__()
        self.spline, self.dof = spline, dof
        shares = spline.line(np.zeros(1), np.ones(1))[:, 0]
        basis = spline.basis(spline.parameters)
        inner = basis[:, spline.inner]
        self.register_buffer("line_shares", torch.tensor(shares, dtype=torch.float32), persistent=False)
        self.register_buffer("basis", torch.tensor(basis, dtype=torch.float32), persistent=False)
        self.register_buffer("fit_matrix", torch.tensor(np.linalg.pinv(inner), dtype=torch.float32), persistent=False)

    @abstractmethod
    def encode(self, control: Tensor) -> Tensor:
        """Return latent vectors (B, *latent) of control points (B, points, dof)."""

    @abstractmethod
    def control(self, latent: Tensor, start: Tensor, goal: Tensor) -> Tensor:
        """Return control points (B, points, dof) of latent vectors, between ends of shape (B, dof)."""

    def decode(self, latent: Tensor, start: Tensor, goal: Tensor) -> Tensor:
        """Return paths (B, states, dof) of latent vectors; their first and last states are the given ends, (B, dof)."""
        return self.path(self.control(latent, start, goal))

    def path(self, control: Tensor) -> Tensor:
        """Return the paths (B, states, dof) of control points (B, points, dof)."""
        inner = self.basis[1:-1] @ control
        return torch.cat([control[:, :1], inner, control[:, -1:]], dim=1)

    def line(self, start: Tensor, goal: Tensor) -> Tensor:
        """Return the control points of straight lines, shape (B, points, dof)."""
        pinned, points = self.spline.pinned, self.spline.points
        shares = self.line_shares[pinned : points - pinned, None]
        inner = start[:, None] + shares * (goal - start)[:, None]
        return torch.cat([start[:, None].expand(-1, pinned, -1), inner, goal[:, None].expand(-1, pinned, -1)], dim=1)

    def with_inner(self, inner: Tensor, start: Tensor, goal: Tensor) -> Tensor:
        """Return the straight line's control points with ``inner``, (B, free, dof), added to the free ones."""
        line = self.line(start, goal)
        pinned = self.spline.pinned
        return torch.cat([line[:, :pinned], line[:, self.spline.inner] + inner, line[:, -pinned:]], dim=1)

    def residual(self, control: Tensor) -> Tensor:
        """Return the free control points minus those of the straight line, shape (B, free, dof)."""
        return (control - self.line(control[:, 0], control[:, -1]))[:, self.spline.inner]


class LinearLatent(Autoencoder):
    """Whitened principal components of the free control points' residuals r.

    z = S^-1 V^T (r - mean) and r = mean + V S z, with the leading eigenvectors V of the data's covariance and the
    diagonal matrix S of their standard deviations, so that the data's latent vectors have unit covariance.
    """

    mean: Tensor
    components: Tensor
    deviations: Tensor

    def __init__(self, spline: Spline, dof: int, dim: int) -> None:
        """Keep ``dim`` components.

        Raises:
            ParameterError: There are fewer.
        """
        super().__init__(spline, dof)
        check_integer(dim, "dimension of the latent space", 1, spline.free * dof)
        self.latent = (dim,)
        self.register_buffer("mean", torch.zeros(spline.free * dof))
        self.register_buffer("components", torch.tensor(np.eye(spline.free * dof, dim), dtype=torch.float32))
        self.register_buffer("deviations", torch.ones(dim))

    def fit(self, control: Tensor) -> None:
        """Compute mean, components and deviations of data, control points of shape (N, points, dof)."""
        rows = self.residual(control).flatten(1).double()
        mean = rows.mean(dim=0)
        values, vectors = torch.linalg.eigh((rows - mean).T @ (rows - mean) / len(rows))
        order = torch.argsort(values, descending=True)[: self.latent[0]]
        vectors = vectors[:, order]
        signs = torch.sign(
            vectors[vectors.abs().argmax(dim=0), torch.arange(len(order))]
        )  # eigenvectors are unique up to sign
        self.mean.copy_(mean)
        self.components.copy_(vectors * signs)
        self.deviations.copy_(values[order].clamp(min=float(MIN_DEVIATION**2 * values.max().clamp(min=1e-12))).sqrt())

    def encode(self, control: Tensor) -> Tensor:
        """Return latent vectors (B, dim) of control points (B, points, dof)."""
        return (self.residual(control).flatten(1) - self.mean) @ self.components / self.deviations

    def control(self, latent: Tensor, start: Tensor, goal: Tensor) -> Tensor:
        """Return control points (B, points, dof)."""
        rows = self.mean + (latent * self.deviations) @ self.components.T
        return self.with_inner(rows.reshape(-1, self.spline.free, self.dof), start, goal)


class Moments(NamedTuple):
    """Normal distribution q(z | x) of an encoder: mean and logarithm of the variance, each (B, *latent)."""

    mean: Tensor
    log_variance: Tensor


class VariationalLatent(Autoencoder):
    """Convolutional variational autoencoder of all states of a path (section III-B of the paper).

    Input and output are the residuals of all states from the straight line. The output is multiplied by a window
    that vanishes at both ends, so that start and goal are exact. Latent vectors are shifted and scaled to zero mean
    and unit variance by channel, as in Rombach et al. (2022).
    """

    scale: Tensor
    shift: Tensor
    window: Tensor
    fractions: Tensor

    def __init__(self, spline: Spline, dof: int, channels: int = 8, width: int = 64, halvings: int = 4) -> None:
        """Make an encoder and a decoder.

        Args:
            spline: Spline of the control points; its number of states is the length of the network's input.
            dof: Number of joints.
            channels: Channels of a latent vector.
            width: Channels of the hidden layers.
            halvings: Number of layers that halve the length.

        Raises:
            ParameterError: The number of states is not divisible by 2**halvings, or the width by the groups.
        """
        super().__init__(spline, dof)
        if spline.states % 2**halvings or width % GROUPS:
            expected = f"{2**halvings} times a whole number of states, and a width of {GROUPS} times one"
            raise ParameterError("states, width", (spline.states, width), expected)
        self.latent = (channels, spline.states // 2**halvings)
        u = torch.linspace(0.0, 1.0, spline.states)
        self.register_buffer("window", (8.0 * torch.minimum(u, 1.0 - u)).clamp(max=1.0)[:, None], persistent=False)
        self.register_buffer("fractions", u[:, None], persistent=False)
        self.register_buffer("scale", torch.ones(channels, 1))
        self.register_buffer("shift", torch.zeros(channels, 1))
        down: list[nn.Module] = [nn.Conv1d(dof, width, 5, padding=2)]
        up: list[nn.Module] = [nn.Conv1d(channels, width, 3, padding=1), ResidualBlock(width)]
        for _ in range(halvings):
            down += [ResidualBlock(width), nn.Conv1d(width, width, 4, stride=2, padding=1)]
            up += [nn.Upsample(scale_factor=2.0), nn.Conv1d(width, width, 3, padding=1), ResidualBlock(width)]
        self.encoder = nn.Sequential(
            *down, ResidualBlock(width), nn.SiLU(), nn.Conv1d(width, 2 * channels, 3, padding=1)
        )
        self.decoder = nn.Sequential(*up, nn.SiLU(), nn.Conv1d(width, dof, 5, padding=2))

    def moments(self, control: Tensor) -> Moments:
        """Return q(z | x), before shift and scale, of control points (B, points, dof)."""
        return self._encode(self._path_residual(control))

    def _path_residual(self, control: Tensor) -> Tensor:
        path = self.path(control)
        return path - self._uniform_line(path[:, 0], path[:, -1])

    def _encode(self, residual: Tensor) -> Moments:
        mean, log_variance = self.encoder(residual.transpose(1, 2)).chunk(2, dim=1)
        return Moments(mean, log_variance.clamp(-20.0, 10.0))

    def residuals(self, raw: Tensor) -> Tensor:
        """Return residuals from the straight line, (B, states, dof), of latent vectors before shift and scale."""
        output: Tensor = self.decoder(raw)
        return self.window * output.transpose(1, 2)

    def loss(self, control: Tensor, noise: Tensor, weight: float) -> tuple[Tensor, Tensor]:
        """Return the negative evidence lower bound (Kingma and Welling 2014), and its reconstruction error.

        With mu and sigma of q(z | x) and z = mu + sigma noise, as means over all entries:

        loss = mean((decode(z) - x)^2) + weight * mean((mu^2 + sigma^2 - 1 - log sigma^2) / 2)

        The second mean is the Kullback-Leibler divergence of q(z | x) from N(0, I).

        Args:
            control: Control points, shape (B, points, dof).
            noise: Standard normal, shape (B, *latent).
            weight: Weight of the divergence.

        Returns:
            Loss, and mean square error of the states [rad^2].
        """
        with torch.autocast(control.device.type, enabled=False):  # half precision is too coarse for joint angles
            residual = self._path_residual(control)
        mean, log_variance = self._encode(residual)
        decoded = self.residuals(mean + (0.5 * log_variance).exp() * noise)
        error = functional.mse_loss(decoded.float(), residual)
        divergence = 0.5 * (mean**2 + log_variance.exp() - 1.0 - log_variance)
        return error + weight * divergence.mean(), error

    def fit_scale(self, control: Tensor) -> None:
        """Set shift and scale to mean and standard deviation of the data's latent vectors, by channel.

        Args:
            control: Control points, shape (N, points, dof).
        """
        with torch.no_grad():
            means = torch.cat([self.moments(control[k : k + 4096]).mean for k in range(0, len(control), 4096)])
            self.shift.copy_(means.mean(dim=(0, 2))[:, None])
            self.scale.copy_(means.std(dim=(0, 2))[:, None].clamp(min=1e-6))

    def encode(self, control: Tensor) -> Tensor:
        """Return latent vectors (B, channels, length) of control points (B, points, dof)."""
        return (self.moments(control).mean - self.shift) / self.scale

    def decode(self, latent: Tensor, start: Tensor, goal: Tensor) -> Tensor:
        """Return paths (B, states, dof)."""
        path = self._uniform_line(start, goal) + self.residuals(latent * self.scale + self.shift)
        return torch.cat([start[:, None], path[:, 1:-1], goal[:, None]], dim=1)

    def control(self, latent: Tensor, start: Tensor, goal: Tensor) -> Tensor:
        """Return the control points (B, points, dof) of the least-squares fits to the decoded paths."""
        line = self.line(start, goal)
        residual = self.decode(latent, start, goal) - self.path(line)
        return self.with_inner(self.fit_matrix @ residual, start, goal)

    def _uniform_line(self, start: Tensor, goal: Tensor) -> Tensor:
        line: Tensor = start[:, None] + self.fractions * (goal - start)[:, None]
        return line


class ResidualBlock(nn.Module):
    """Residual block of one convolution."""

    def __init__(self, width: int) -> None:
        """Work on ``width`` channels."""
        super().__init__()
        self.norm = nn.GroupNorm(GROUPS, width)
        self.conv = nn.Conv1d(width, width, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, width, length) to the same shape."""
        out: Tensor = x + self.conv(functional.silu(self.norm(x)))
        return out
