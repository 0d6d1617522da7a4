"""The network of the detector of objects: convolutions down to cells of 16 pixels and up again to cells of 4."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple, cast

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.fusion import fuse_conv_bn_eval

CHANNELS = 6  # red, green, blue, depth relative to its surroundings, depth, whether there is one
FINE_CHANNELS = 12  # of cells: the upward direction, depth, and differences of depth to 8 other cells
NEIGHBORS = ((0, 1), (0, -1), (1, 0), (-1, 0), (0, 2), (0, -2), (2, 0), (-2, 0))  # rows and columns to them
STEP = 0.05  # unit of these differences [m]
SURROUNDINGS = 9  # side of the square of cells of which depths are relative to the mean
RELIEF, FAR, NEAREST = 0.08, 1.3, 0.05  # unit of relative depth, mean depth, and least one [m]


class Votes(NamedTuple):
    """What each cell says, shapes (N, C, h, w).

    Attributes:
        kinds: Logits: none, and each kind.
        center: Center of the object from the cell's measured point, in the frame of the cell's ray [0.1 m].
        spread: Logarithm of the mean absolute error of the center [0.1 m].
        axis: Products of the components of the axis there: xx, yy, zz, xy, xz, yz.
        sign: The axis, of kinds whose ends differ.
        size: Logarithms of radius and half length over those of its kind, in units of 0.1.
    """

    kinds: Tensor
    center: Tensor
    spread: Tensor
    axis: Tensor
    sign: Tensor
    size: Tensor


def network_input(color: Tensor, depth: Tensor) -> Tensor:
    """Return the input of the network, shape (N, 6, H, W).

    Args:
        color: 0 to 1, shape (N, 3, H, W).
        depth: 0 where there is none, shape (N, 1, H, W) [m].
    """
    there = (depth > 0.0).to(depth.dtype)
    small = [functional.avg_pool2d(one, 4) for one in (depth, there)]
    total, count = (functional.avg_pool2d(one, SURROUNDINGS, 1, SURROUNDINGS // 2) for one in small)
    mean = functional.interpolate(total / count.clamp(min=1e-3), scale_factor=4.0)
    relief = ((depth - mean) / RELIEF).clamp(-3.0, 3.0) * there
    return torch.cat([color - 0.5, relief, (depth - FAR) * there, there], dim=1)


def with_neighbors(fine: Tensor) -> Tensor:
    """Return the input of cells, shape (N, 4, h, w), with differences of depth to others, 0 where one has none."""
    depth = fine[:, 3:] + FAR
    height, width = depth.shape[2:]
    padded = functional.pad(depth, (2, 2, 2, 2))
    others = [padded[:, :, 2 + i : 2 + i + height, 2 + j : 2 + j + width] for i, j in NEIGHBORS]
    there = depth > NEAREST
    away = [((one - depth) / STEP).clamp(-2.0, 2.0) * (there & (one > NEAREST)) for one in others]
    return torch.cat([fine, *away], dim=1)


class Block(nn.Sequential):
    """A convolution, batch normalization in trainings, and rectification."""

    def __init__(self, inside: int, outside: int, stride: int = 1, side: int = 3, *, normalized: bool) -> None:
        """Make the layers, for numbers of channels before and after."""
        layers: list[nn.Module] = [nn.Conv2d(inside, outside, side, stride, side // 2, bias=not normalized)]
        if normalized:
            layers.append(nn.BatchNorm2d(outside))
        super().__init__(*layers, nn.ReLU(inplace=True))

    def folded(self) -> nn.Conv2d:
        """Return a convolution that does the same as it and its normalization, as trained."""
        return fuse_conv_bn_eval(cast(nn.Conv2d, self[0]), cast(nn.BatchNorm2d, self[1]))


def folded(network: DetectorNetwork) -> DetectorNetwork:
    """Return a network without batch normalization that does the same as a trained one."""
    found = DetectorNetwork(network.sizes[0] - 1, network.widths, normalized=False)
    found.head.load_state_dict(network.head.state_dict())
    blocks = [[one for one in each.modules() if isinstance(one, Block)] for each in (network.eval(), found)]
    for before, after in zip(*blocks, strict=True):
        after[0].load_state_dict(before.folded().state_dict())
    return found.eval()


class DetectorNetwork(nn.Module):
    """Votes of cells."""

    def __init__(self, kinds: int, widths: tuple[int, ...] = (16, 24, 48, 96, 32), *, normalized: bool = True) -> None:
        """Make the layers.

        Args:
            kinds: Number of kinds of objects.
            widths: Channels at a half, a fourth, an eighth and a sixteenth of the image's size, and of the last layers.
            normalized: Whether there is batch normalization, as in trainings.
        """
        super().__init__()
        self.widths, block = widths, partial(Block, normalized=normalized)
        a, b, c, d, e = widths
        self.sizes = (1 + kinds, 3, 1, 6, 3, 2)
        self.stem = block(CHANNELS, a, 2)
        self.fourth = nn.Sequential(block(a, b, 2), block(b, b))
        self.eighth = nn.Sequential(block(b + FINE_CHANNELS, c, 2), block(c, c), block(c, c))
        self.sixteenth = nn.Sequential(block(c, d, 2), block(d, d), block(d, d))
        self.up = block(c + d, c)
        self.fine = nn.Sequential(block(b + FINE_CHANNELS + c, e, side=1), block(e, e))
        self.head = nn.Conv2d(e, sum(self.sizes), 1)

    def forward(self, image: Tensor, fine: Tensor) -> Votes:
        """Return the votes of all cells.

        Args:
            image: Input, shape (N, 6, H, W).
            fine: Upward direction in the frames of the cells' rays, and their depth, shape (N, 4, H / 4, W / 4).
        """
        fourth = torch.cat([self.fourth(self.stem(image)), with_neighbors(fine)], dim=1)
        eighth = self.eighth(fourth)
        sixteenth = functional.interpolate(self.sixteenth(eighth), scale_factor=2.0)
        up = functional.interpolate(self.up(torch.cat([eighth, sixteenth], dim=1)), scale_factor=2.0)
        return Votes(*self.head(self.fine(torch.cat([fourth, up], dim=1))).split(self.sizes, dim=1))
