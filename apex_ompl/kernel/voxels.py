"""Voxels that depth images show to be free or occupied, over flat arrays."""

from __future__ import annotations

from typing import NamedTuple, Self

import numpy as np

from apex_ompl.kernel.compiled.layout import Bytes, Integers, Singles
from apex_ompl.kernel.compiled.perception import depth_windows, voxels
from apex_ompl.types import Array, Flags
from apex_ompl.util.arrays import compact

SPREAD = 2.507  # extent of a normal distribution whose density is that of its middle [standard deviations]
LEAST_NOISE = 1e-9
FREE, UNKNOWN = voxels.FREE, voxels.UNKNOWN  # evidence of voxels; larger numbers are those of occupied ones
ENOUGH = voxels.ENOUGH


class ImageBlocks(NamedTuple):
    """The pixels of a camera in the order of square blocks of the plane z = 1 m of the optical frame.

    Attributes:
        order: Numbers of the pixels, row by row, in the order of blocks, shape (P,).
        rays: Their points of the plane, shape (P, 2) [m].
        first: First pixel of each block, and P, shape (rows columns + 1,).
        whole: Whether the image holds the block as a whole, shape (rows columns,).
        plane: Corner of the first block, and sides of a block, shape (2, 2) [m].
        shape: Rows and columns of blocks.
        size: Rows and columns of pixels.
        half: Half of the largest distance between neighboring pixels [blocks].
        density: Pixels of a unit of the plane [1/m^2].
    """

    order: Integers
    rays: Singles
    first: Integers
    whole: Bytes
    plane: Array
    shape: tuple[int, int]
    size: tuple[int, int]
    half: float
    density: float

    @classmethod
    def of(cls, rays: Array, focal: tuple[float, float], size: int) -> Self:
        """Return the blocks of an image.

        Args:
            rays: Points of the plane that the pixels see, shape (height, width, 2) [m].
            focal: Focal lengths [pixels].
            size: Side of a block [pixels].
        """
        height, width = rays.shape[:2]
        pixel = 1.0 / np.asarray(focal, float)
        flat = rays.reshape(-1, 2)
        low, side = flat.min(axis=0) - 0.5 * pixel, size * pixel
        place = np.floor((flat - low) / side + 1e-9).astype(np.int64)
        columns, rows = (place.max(axis=0) + 1).tolist()
        steps = [np.abs(np.diff(rays, axis=k)).max(axis=(0, 1), initial=0.0) / side for k in range(2)]
        half = 0.5 * float(np.max(steps))
        block = place[:, 1] * columns + place[:, 0]
        order = np.argsort(block, kind="stable").astype(np.int64)
        counts = np.bincount(block, minlength=rows * columns)
        border = np.zeros((height, width), bool)
        border[[0, -1]] = border[:, [0, -1]] = True
        cut = np.bincount(block[border.ravel()], minlength=rows * columns) > 0
        cut &= counts != size * size
        whole = (counts > 0) & ~cut | _enclosed((counts > 0).reshape(rows, columns), cut.reshape(rows, columns)).ravel()
        first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        singles = np.ascontiguousarray(flat[order], np.float32)
        plane, density = np.stack([low, side]), float(focal[0] * focal[1])
        return cls(order, singles, first, whole.astype(np.int8), plane, (rows, columns), (height, width), half, density)

    def depths(self, image: Array | Singles) -> Singles:
        """Return the depths of an image, shape (height, width), in the order of the pixels, shape (P,) [m]."""
        return image.astype(np.float32, copy=False).ravel()[self.order]


def _enclosed(filled: Flags, cut: Flags) -> Flags:
    """Return the cells without a pixel that have some in all four directions and none at the image's border around."""
    sides = [np.logical_or.accumulate(part, axis=k) for k in range(2) for part in (filled, np.flip(filled, k))]
    inside = ~filled & sides[0] & np.flip(sides[1], 0) & sides[2] & np.flip(sides[3], 1)
    near = np.pad(cut, 1)
    rows, columns = cut.shape
    return np.asarray(
        inside & ~np.any([near[a : a + rows, b : b + columns] for a in range(3) for b in range(3)], axis=0)
    )


class DepthWindows(NamedTuple):
    """Least depths of windows of an image.

    Attributes:
        blocks: The cells of the image.
        near: Least depths of windows of 2^n x 2^n cells that begin at each, shape (levels, rows, columns) [m]; 0 where
            one of them is not known, or outside of the image.
        far: Largest depths of tiles [m].
        nearest: Smallest depth that counts [m].
        farthest: Depth up to which a larger one shows the space to be free [m].
    """

    blocks: ImageBlocks
    near: Singles
    far: Singles
    nearest: float
    farthest: float

    @classmethod
    def of(cls, blocks: ImageBlocks, image: Array | Singles, span: tuple[float, float], missing: float) -> Self:
        """Return the windows of an image.

        Args:
            blocks: The cells of its camera.
            image: Depths, 0 where there is none, shape (height, width) [m].
            span: Smallest and largest depth that count [m].
            missing: Largest share of pixels without a depth in a cell that is known, or in those around it.
        """
        rows, columns = blocks.shape
        near = np.empty((min(max(min(rows, columns).bit_length(), 3), depth_windows.LEVELS), rows, columns), np.float32)
        far = np.empty((-(-rows // depth_windows.TILE), -(-columns // depth_windows.TILE)), np.float32)
        depth_windows.cell_depths(blocks.depths(image), blocks.first, blocks.whole, *span, missing, near, far)
        return cls(blocks, near, far, *span)


class SeenPoints(NamedTuple):
    """Points that an image shows.

    Attributes:
        rays: The points of the plane z = 1 m of the optical frame at which they are seen, shape (P, 2) [m].
        depths: Their depths, 0 where there is none, shape (P,) [m].
        left_out: 1 for points on the robot or on what it holds, shape (P,).
        density: Points of a surface across the line of sight at a depth of 1 m [1/m^2].
    """

    rays: Singles
    depths: Singles
    left_out: Bytes
    density: float

    @classmethod
    def of(
        cls, blocks: ImageBlocks, image: Array | Singles, spheres: Array, alike: tuple[float, float], support: int
    ) -> Self:
        """Return the points of an image.

        Args:
            blocks: The blocks of some of the pixels of its camera, at a stride of rows and columns.
            image: Depths, 0 where there is none, shape (height, width) [m].
            spheres: Centers in the optical frame and radii of spheres whose points are left out, shape (S, 4) [m].
            alike: Factor of z^2 [1/m] and length [m] by which depths z of the same surface differ at most.
            support: How many of the 8 pixels around a pixel must be of the same surface for it to have a point.
        """
        found = np.empty(blocks.size, np.float32)
        depth_windows.supported_depths(np.ascontiguousarray(image, np.float32), *alike, support, found)
        depths = blocks.depths(found)
        inside, ranges = np.zeros(len(depths), np.int8), np.empty((len(blocks.first) - 1, 2), np.float32)
        depth_windows.mark_inside(
            depths, blocks.rays, blocks.first, blocks.plane, blocks.shape[1], compact(spheres), ranges, inside
        )
        return cls(blocks.rays, depths, inside, blocks.density)


class VoxelUpdate(NamedTuple):
    """How an image changes the evidence of voxels.

    Attributes:
        origin: Outer corner of the first voxel, shape (3,) [m].
        side: Side of a voxel [m].
        pose: Pose of the optical frame, shape (4, 4) [m].
        share: Share of the points that a surface leaves in a voxel which makes it occupied.
        least: How many points are the least, where more are to be expected.
        gain: What they add to its evidence.
        most: Largest evidence.
        noise: Standard deviation of a depth z is ``noise`` z^2 [1/m].
        scale: Relative error of depths.
        angle: Error of the orientation of the camera [rad].
        shift: Error of its position [m].
    """

    origin: Array
    side: float
    pose: Array
    share: float
    least: int
    gain: int
    most: int
    noise: float
    scale: float
    angle: float
    shift: float

    def fill(self, evidence: Bytes, hits: Bytes, points: SeenPoints, span: tuple[float, float]) -> Integers:
        """Raise the evidence of voxels that hold enough points.

        Args:
            evidence: The evidence, shape (nx, ny, nz).
            hits: Gets how many points each voxel holds, ENOUGH where they are enough; 0 at the start.
            points: The points.
            span: Smallest and largest depth that count [m].

        Returns:
            Numbers of the voxels that hold the points, -1 for none, shape (P,).
        """
        cells = np.empty(len(points.depths), np.int64)
        sharp = self.side / (SPREAD * max(self.noise, LEAST_NOISE))
        voxels.fill_voxels(
            evidence, hits, cells, points.depths, points.rays, points.left_out, *span, compact(self.pose), self.origin,
            self.side, points.density * self.side * self.side, sharp, self.share, float(self.least), self.gain,
            self.most,
        )  # fmt: skip
        return cells

    def apply(self, evidence: Bytes, hits: Bytes, windows: DepthWindows, points: SeenPoints) -> None:
        """Change the evidence of voxels, shape (nx, ny, nz); ``hits`` is 0 there before and after."""
        cells = self.fill(evidence, hits, points, (windows.nearest, windows.farthest))
        corner, side = windows.blocks.plane
        errors = self.scale, self.angle, self.shift, windows.blocks.half
        lens = [*corner, *(1.0 / side), windows.nearest, windows.farthest, *errors]
        voxels.clear_voxels(
            evidence, hits, windows.near, windows.far, compact(self.pose), np.append(self.origin, self.side),
            np.array(lens, float), np.empty(evidence.shape[2], np.int8), np.empty((8, voxels.PART**3), np.float32),
        )  # fmt: skip
        voxels.forget_hits(hits, cells)


def mark_near(shape: tuple[int, int, int], origin: Array, side: float, spheres: Array) -> Bytes:
    """Return which voxels have their centers inside of spheres.

    Args:
        shape: Numbers of voxels.
        origin: Outer corner of the first voxel, shape (3,) [m].
        side: Side of a voxel [m].
        spheres: Centers and radii, shape (S, 4) [m].
    """
    found = np.zeros(shape, np.int8)
    voxels.mark_near(found, compact(spheres), origin, side)
    return found
