"""Objects of known kinds in a frame, found by a small network, wherever they are.

The frame is resampled to a pinhole of a standard focal length. The network looks at colors and depths, and each cell
of 4 x 4 pixels that shows an object votes for the place of its center relative to the cell's own measured depth, for
its axis, its size and its kind. Votes are relative to the cell's ray, so that they do not depend on where in the image
the object is. Votes that agree are an object.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from apex_ompl.perception.camera import Camera
from apex_ompl.perception.frames import Frame
from apex_ompl.types import Array, Indices

FOCAL = 232.5  # of the images that the network sees [pixels]
CELL = 4  # side of a cell [pixels]
MULTIPLE = 16  # of which width and height are
KINDS = ("box", "can", "cup", "ball", "block", "peg")
OPEN = ("cup", "block")  # whose two ends differ


class Cells(NamedTuple):
    """What cells of an image measure.

    Attributes:
        depth: Median of their depths, 0 where there is none, shape (h, w) [m].
        pixel: Which of the 16 pixels has it, shape (h, w).
    """

    depth: Array
    pixel: Indices


def cells_of(depth: Array) -> Cells:
    """Return the cells of a depth image, shape (height, width) [m], whose sides are multiples of 4."""
    height, width = depth.shape
    blocks = depth.reshape(height // CELL, CELL, width // CELL, CELL).swapaxes(1, 2)
    blocks = blocks.reshape(height // CELL, width // CELL, CELL * CELL)
    order = np.argsort(np.where(blocks > 0.0, blocks, np.inf), axis=-1, kind="stable")
    count = (blocks > 0.0).sum(axis=-1)
    pixel = np.take_along_axis(order, np.maximum(count - 1, 0)[..., None] // 2, axis=-1)
    return Cells(np.take_along_axis(blocks, pixel, axis=-1)[..., 0], pixel[..., 0])


def in_cells(image: NDArray, pixel: Indices) -> NDArray:
    """Return the values of an image, shape (height, width), at the pixels of its cells, shape (h, w)."""
    h, w = pixel.shape
    blocks = image.reshape(h, CELL, w, CELL).swapaxes(1, 2).reshape(h, w, CELL * CELL)
    return np.take_along_axis(blocks, pixel[..., None], axis=-1)[..., 0]


def cell_rays(lens: Array, shape: tuple[int, int], corner: tuple[int, int] = (0, 0)) -> Array:
    """Return the points of the plane z = 1 m that the middles of cells see, shape (h, w, 3) [m].

    Args:
        lens: Focal lengths and principal point of the image, shape (4,) [pixels].
        shape: Rows and columns of cells.
        corner: First row and column [pixels].
    """
    middle = (CELL - 1) / 2.0
    rows = (corner[0] + CELL * np.arange(shape[0]) + middle - lens[3]) / lens[1]
    columns = (corner[1] + CELL * np.arange(shape[1]) + middle - lens[2]) / lens[0]
    return np.stack([*np.meshgrid(columns, rows), np.ones(shape)], axis=-1)


def ray_frames(rays: Array) -> Array:
    """Return the smallest rotations that take the optical axis to rays, shape (..., 3); of shape (..., 3, 3)."""
    x, y, w = np.moveaxis(rays / np.linalg.norm(rays, axis=-1, keepdims=True), -1, 0)
    k = 1.0 / (1.0 + w)
    rows = [[1.0 - k * x * x, -k * x * y, x], [-k * x * y, 1.0 - k * y * y, y], [-x, -y, w]]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))
