"""Trajectories as latent vectors: whitened principal components of a spline's free points, or a variational network.

Both describe a path by what it differs in from the straight line between its ends, so that the ends are exact whatever
the latent vector is.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from apex_ompl.errors import ParameterError
from apex_ompl.trajopt.spline import Spline
from apex_ompl.util.validation import check_integer

MOST_GROUPS = 8  # of channels that are normalised together
FLAT = 1e-3  # deviations below this share of the largest are not blown up to one


class Autoencoder(nn.Module, ABC):
    """What encodes residuals from the straight line.

    Attributes:
        spline: The spline of the control points.
        dof: Number of joints.
        latent: Shape of a latent vector.
    """

    latent: tuple[int, ...]
    line_shares: Tensor
    basis: Tensor
    fit_matrix: Tensor

    def __init__(self, spline: Spline, dof: int) -> None:
        """Work on paths of ``dof`` joints."""
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
        """Return paths (B, states, dof) of latent vectors, between ends of shape (B, dof), which are exact."""
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
        """Return control points whose free ones are the straight line's and ``inner``, (B, free, dof), added."""
        line = self.line(start, goal)
        pinned = self.spline.pinned
        return torch.cat([line[:, :pinned], line[:, self.spline.inner] + inner, line[:, -pinned:]], dim=1)

    def residual(self, control: Tensor) -> Tensor:
        """Return what free control points differ in from those of the straight line, shape (B, free, dof)."""
        return (control - self.line(control[:, 0], control[:, -1]))[:, self.spline.inner]


class LinearLatent(Autoencoder):
    """Whitened principal components of the free control points' residuals."""

    mean: Tensor
    components: Tensor
    deviations: Tensor

    def __init__(self, spline: Spline, dof: int, dim: int) -> None:
        """Keep ``dim`` components.

        Raises:
            ParameterError: There are not as many.
        """
        super().__init__(spline, dof)
        check_integer(dim, "dimension of the latent space", 1, spline.free * dof)
        self.latent = (dim,)
        self.register_buffer("mean", torch.zeros(spline.free * dof))
        self.register_buffer("components", torch.eye(spline.free * dof)[:, :dim].clone())
        self.register_buffer("deviations", torch.ones(dim))

    def fit(self, control: Tensor) -> None:
        """Take mean, components and deviations from data, control points of shape (N, points, dof)."""
        rows = self.residual(control).flatten(1).double()
        mean = rows.mean(dim=0)
        values, vectors = torch.linalg.eigh((rows - mean).T @ (rows - mean) / len(rows))
        order = torch.argsort(values, descending=True)[: self.latent[0]]
        vectors = vectors[:, order]
        signs = torch.sign(vectors[vectors.abs().argmax(dim=0), torch.arange(len(order))])  # the same everywhere
        self.mean.copy_(mean)
        self.components.copy_(vectors * signs)
        self.deviations.copy_(values[order].clamp(min=float(FLAT**2 * values.max().clamp(min=1e-12))).sqrt())

    def encode(self, control: Tensor) -> Tensor:
        """Return latent vectors (B, dim) of control points (B, points, dof)."""
        return (self.residual(control).flatten(1) - self.mean) @ self.components / self.deviations

    def control(self, latent: Tensor, start: Tensor, goal: Tensor) -> Tensor:
        """Return control points (B, points, dof)."""
        rows = self.mean + (latent * self.deviations) @ self.components.T
        return self.with_inner(rows.reshape(-1, self.spline.free, self.dof), start, goal)


class Moments(NamedTuple):
    """The distribution of latent vectors that an encoder gives: mean and logarithm of the variance, (B, *latent)."""

    mean: Tensor
    log_variance: Tensor


class VariationalLatent(Autoencoder):
    """A convolutional variational autoencoder of all states of a path (section III-B of the paper).

    It takes and emits the residuals of all states from the straight line; a window that vanishes at both ends makes
    them exact. Latent vectors are scaled to unit variance, as Rombach et al. (2022) do it.
    """

    scale: Tensor
    shift: Tensor
    window: Tensor
    even: Tensor

    def __init__(self, spline: Spline, dof: int, channels: int = 8, width: int = 64, halvings: int = 4) -> None:
        """Make an encoder and a decoder.

        Args:
            spline: What paths are fitted by; its number of states is what the network sees.
            dof: Number of joints.
            channels: Channels of a latent vector.
            width: Channels inside.
            halvings: How often the length is halved.

        Raises:
            ParameterError: The number of states cannot be halved as often.
        """
        super().__init__(spline, dof)
        if spline.states % 2**halvings or width % MOST_GROUPS:
            expected = f"{2**halvings} times a whole number of states, and a width of {MOST_GROUPS} times one"
            raise ParameterError("states, width", (spline.states, width), expected)
        self.latent = (channels, spline.states // 2**halvings)
        u = torch.linspace(0.0, 1.0, spline.states)
        self.register_buffer("window", (8.0 * torch.minimum(u, 1.0 - u)).clamp(max=1.0)[:, None], persistent=False)
        self.register_buffer("even", u[:, None], persistent=False)
        self.register_buffer("scale", torch.ones(channels, 1))
        self.register_buffer("shift", torch.zeros(channels, 1))
        down: list[nn.Module] = [nn.Conv1d(dof, width, 5, padding=2)]
        up: list[nn.Module] = [nn.Conv1d(channels, width, 3, padding=1), Mix(width)]
        for _ in range(halvings):
            down += [Mix(width), nn.Conv1d(width, width, 4, stride=2, padding=1)]
            up += [nn.Upsample(scale_factor=2.0), nn.Conv1d(width, width, 3, padding=1), Mix(width)]
        self.encoder = nn.Sequential(*down, Mix(width), nn.SiLU(), nn.Conv1d(width, 2 * channels, 3, padding=1))
        self.decoder = nn.Sequential(*up, nn.SiLU(), nn.Conv1d(width, dof, 5, padding=2))

    def moments(self, control: Tensor) -> Moments:
        """Return the distribution of the encoder, before it is scaled; control points (B, points, dof)."""
        return self._moments(self._rest(control))

    def _rest(self, control: Tensor) -> Tensor:
        path = self.path(control)
        return path - self._even_line(path[:, 0], path[:, -1])

    def _moments(self, rest: Tensor) -> Moments:
        mean, log_variance = self.encoder(rest.transpose(1, 2)).chunk(2, dim=1)
        return Moments(mean, log_variance.clamp(-20.0, 10.0))

    def residuals(self, raw: Tensor) -> Tensor:
        """Return residuals from the straight line, (B, states, dof), of latent vectors that are not scaled."""
        found: Tensor = self.decoder(raw)
        return self.window * found.transpose(1, 2)

    def loss(self, control: Tensor, noise: Tensor, weight: float) -> tuple[Tensor, Tensor]:
        """Return the loss, and the error of reconstruction in it.

        The loss is the negative evidence lower bound (Kingma and Welling 2014): the mean square error of the states
        [rad^2], and ``weight`` times the divergence from the standard normal distribution, per number of the latent.

        Args:
            control: Control points, shape (B, points, dof).
            noise: Standard normal, shape (B, *latent).
            weight: Weight of the divergence.
        """
        with torch.autocast(control.device.type, enabled=False):  # half precision would blur the path
            rest = self._rest(control)
        mean, log_variance = self._moments(rest)
        found = self.residuals(mean + (0.5 * log_variance).exp() * noise)
        error = functional.mse_loss(found.float(), rest)
        apart = 0.5 * (mean**2 + log_variance.exp() - 1.0 - log_variance)
        return error + weight * apart.mean(), error

    def measure(self, control: Tensor) -> None:
        """Take scale and shift of latent vectors from data, control points (N, points, dof)."""
        with torch.no_grad():
            means = torch.cat([self.moments(control[k : k + 4096]).mean for k in range(0, len(control), 4096)])
            self.shift.copy_(means.mean(dim=(0, 2))[:, None])
            self.scale.copy_(means.std(dim=(0, 2))[:, None].clamp(min=1e-6))

    def encode(self, control: Tensor) -> Tensor:
        """Return latent vectors (B, channels, length) of control points (B, points, dof)."""
        return (self.moments(control).mean - self.shift) / self.scale

    def decode(self, latent: Tensor, start: Tensor, goal: Tensor) -> Tensor:
        """Return paths (B, states, dof)."""
        path = self._even_line(start, goal) + self.residuals(latent * self.scale + self.shift)
        return torch.cat([start[:, None], path[:, 1:-1], goal[:, None]], dim=1)

    def control(self, latent: Tensor, start: Tensor, goal: Tensor) -> Tensor:
        """Return the control points (B, points, dof) of the splines nearest to the paths."""
        line = self.line(start, goal)
        rest = self.decode(latent, start, goal) - self.path(line)
        return self.with_inner(self.fit_matrix @ rest, start, goal)

    def _even_line(self, start: Tensor, goal: Tensor) -> Tensor:
        line: Tensor = start[:, None] + self.even * (goal - start)[:, None]
        return line


class Mix(nn.Module):
    """A residual block of one convolution."""

    def __init__(self, width: int) -> None:
        """Work on ``width`` channels."""
        super().__init__()
        self.norm = nn.GroupNorm(MOST_GROUPS, width)
        self.conv = nn.Conv1d(width, width, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, width, length) to the same shape."""
        out: Tensor = x + self.conv(functional.silu(self.norm(x)))
        return out
