"""Free, occupied and unknown space from depth frames, and obstacles made of it.

A voxel is free once a frame shows that it is in front of all surfaces where it appears in the image, with the errors of
the camera's pose; it is occupied where points of surfaces are in it. All others, those behind surfaces and those
outside of the image among them, are unknown. Voxels are looked up in the image, in the least depths of blocks of
pixels; no ray is followed.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.cloud_contact import on_robot
from apex_ompl.errors import ParameterError
from apex_ompl.kernel.voxels import FREE, UNKNOWN, DepthWindows, ImageBlocks, SeenPoints, VoxelUpdate, mark_near
from apex_ompl.perception.camera import Camera
from apex_ompl.perception.frames import Frame
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject, Obstacle
from apex_ompl.scene.grids import voxels_of
from apex_ompl.types import Array, Flags
from apex_ompl.util.display import one_line
from apex_ompl.util.validation import check_array, check_integer, check_name, check_number, check_positive, finite_array

MOST_VOXELS = 50_000_000
LEVELS = 16  # sizes of windows of blocks; nearer voxels, whose images are larger, are not cleared
POLICIES = ("free", "blocked")

Unknown = Literal["free", "blocked"]


@dataclass(frozen=True)
class OccupancySettings:
    """How frames change a map.

    Attributes:
        spreads: Standard deviations of the camera's pose and depth scale within which nothing occupied becomes free.
        missing: Largest share of pixels without a depth in a block of the image that counts as seen.
        block: Side of such a block [pixels].
        stride: Stride of rows and columns of the pixels whose points make voxels occupied.
        enough: How many of these points in a voxel make it occupied.
        persistence: Frames that must see through an occupied voxel, after one that saw it occupied, to free it.
        longest: The largest number of such frames, after many that saw it occupied.
        padding: Margin around robot and held objects inside of which points belong to them [m]; the noise of depths is
            added.
    """

    spreads: float = 2.0
    missing: float = 0.25
    block: int = 4
    stride: int = 2
    enough: int = 2
    persistence: int = 3
    longest: int = 9
    padding: float = 0.015

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ParameterError: A value is out of its range.
        """
        check_number(self.spreads, "spreads", 0.0, 10.0)
        check_number(self.missing, "missing", 0.0, 0.99)
        check_integer(self.block, "block", 1, 64)
        check_integer(self.stride, "stride", 1, 64)
        check_integer(self.enough, "enough", 1, 100)
        check_integer(self.persistence, "persistence", 1, 100)
        check_integer(self.longest, "longest", self.persistence, 100)
        check_number(self.padding, "padding", 0.0, 0.5)


class OccupancyMap:
    """Voxels of a box in the world that are free, occupied or unknown, kept from depth frames of one camera or several.

    What the map saw free stays free until a surface is seen there; an occupied voxel is freed when frames see through
    it. The robot and its held objects, placed by the joints of a frame, are left out: their pixels free the voxels in
    front of them, and occupy none.

    Attributes:
        robot: The robot.
        origin: Outer corner of the first voxel, shape (3,) [m].
        resolution: Side of a voxel [m].
        settings: How frames change the map.
        evidence: -1 for free voxels, 0 for unknown ones, more for occupied ones, shape (nx, ny, nz), of type int8.
    """

    def __init__(
        self, robot: Robot, lower: ArrayLike, upper: ArrayLike, resolution: float = 0.02,
        settings: OccupancySettings | None = None,
    ) -> None:  # fmt: skip
        """Make a map in which all is unknown.

        Args:
            robot: The robot.
            lower: Least corner of the box, shape (3,) [m].
            upper: Its largest corner, shape (3,) [m]; rounded up to whole voxels.
            resolution: Side of a voxel [m].
            settings: How frames change the map.

        Raises:
            ParameterError: A corner has another shape, the box is empty, or has more than 50 million voxels.
        """
        low, high = finite_array(lower, "lower"), finite_array(upper, "upper")
        check_array(low, (3,), "lower")
        check_array(high, (3,), "upper")
        check_positive(resolution, "resolution", "a positive number of meters")
        if not (low < high).all():
            raise ParameterError("upper", high.tolist(), f"a corner above {low.tolist()}")
        counts = np.ceil((high - low) / resolution - 1e-6)
        if counts.prod() > MOST_VOXELS:
            raise ParameterError("resolution", resolution, f"a side that gives at most {MOST_VOXELS} voxels")
        self.robot, self.origin, self.resolution = robot, low, float(resolution)
        self.settings = settings or OccupancySettings()
        self.evidence: NDArray[np.int8] = np.zeros(tuple(counts.astype(int).tolist()), np.int8)
        self._checker = CollisionChecker(robot)
        self._blocks: tuple[Camera, tuple[ImageBlocks, ImageBlocks]] | None = None  # of the last camera

    def __repr__(self) -> str:
        """Return the number of voxels, their side, and the shares of the three kinds."""
        count = " x ".join(map(str, self.evidence.shape))
        shares = (f"{100.0 * flags.mean():.0f} % {name}" for name, flags in self._kinds().items())
        return one_line("OccupancyMap", f"{count} voxels of {1e3 * self.resolution:g} mm", *shares)

    def _kinds(self) -> dict[str, Flags]:
        return {"free": self.free, "occupied": self.occupied, "unknown": self.unknown}

    @property
    def free(self) -> Flags:
        """Which voxels are free, shape (nx, ny, nz)."""
        return np.asarray(self.evidence <= FREE)

    @property
    def occupied(self) -> Flags:
        """Which voxels are occupied, shape (nx, ny, nz)."""
        return np.asarray(self.evidence > UNKNOWN)

    @property
    def unknown(self) -> Flags:
        """Which voxels are unknown, shape (nx, ny, nz)."""
        return np.asarray(self.evidence == UNKNOWN)

    def clear(self) -> None:
        """Make all voxels unknown."""
        self.evidence[:] = UNKNOWN

    def add(self, frame: Frame, held: Iterable[AttachedObject] = ()) -> None:
        """Change the map by a frame.

        Args:
            frame: The frame, with the joints of the robot.
            held: Objects that the robot holds then, such as ``planner.world.held.values()``.

        Raises:
            ParameterError: The frame has not all joints of the robot.
            UnknownNameError: The robot has no link that carries the camera, or one that holds an object.
        """
        camera, settings = frame.camera, self.settings
        state = frame.state(self.robot.joint_names)
        pose, depth = camera.pose_at(self.robot, state), camera.depth
        blocks, samples = self._blocks_of(camera)
        image, stride = frame.depth * depth.scale, settings.stride
        windows = DepthWindows.of(blocks, image, (depth.nearest, depth.farthest), settings.missing, LEVELS)
        points = SeenPoints.of(
            samples, image[::stride, ::stride], self._own_spheres(state, held, pose, depth.noise)
        )  # fmt: skip
        VoxelUpdate(
            self.origin, self.resolution, pose, settings.enough, settings.persistence, settings.longest,
            settings.spreads * depth.scale_spread, settings.spreads * camera.angle_spread,
            settings.spreads * camera.position_spread,
        ).apply(self.evidence, windows, points)  # fmt: skip

    def _own_spheres(self, state: Array, held: Iterable[AttachedObject], pose: Array, noise: float) -> Array:
        """Return padded spheres around robot and held objects in the optical frame, shape (S, 4) [m]."""
        self._checker.become({}, {one.name: one for one in held}, ())
        spheres = self._checker.kernel.cover_spheres(state)
        spheres[:, :3] = (spheres[:, :3] - pose[:3, 3]) @ pose[:3, :3]
        far = np.maximum(spheres[:, 2], 0.0)
        spheres[:, 3] += self.settings.padding + self.settings.spreads * noise * far * far
        return spheres

    def _blocks_of(self, camera: Camera) -> tuple[ImageBlocks, ImageBlocks]:
        """Return the blocks of all pixels of a camera, and of those whose points occupy voxels."""
        if self._blocks is None or self._blocks[0] != camera:
            size, stride = self.settings.block, self.settings.stride
            coarse = camera.focal[0] / stride, camera.focal[1] / stride
            blocks = ImageBlocks.of(camera.grid, camera.focal, size)
            self._blocks = camera, (blocks, ImageBlocks.of(camera.grid[::stride, ::stride], coarse, size))
        return self._blocks[1]

    def blocked(
        self, unknown: Unknown = "free", start: ArrayLike | None = None, held: Iterable[AttachedObject] = (),
        margin: float = 0.01,
    ) -> Flags:  # fmt: skip
        """Return the voxels that count as obstacles, shape (nx, ny, nz).

        Args:
            unknown: ``free``: occupied voxels. ``blocked``: unknown ones, too, but for those that the start touches.
            start: Start of the robot, shape (dof,), from which it must be able to move; with ``blocked`` alone.
            held: Objects that it holds there.
            margin: Distance from robot and held objects within which unknown voxels are freed [m].

        Raises:
            ParameterError: An argument is faulty, or there is no start where unknown space is blocked.
            UnknownNameError: ``unknown`` is neither.
        """
        check_name(unknown, "policy of unknown space", POLICIES)
        if unknown == "free":
            return self.occupied
        if start is None:
            raise ParameterError("start", None, "the start of the plan, whose voxels are freed where they are unknown")
        return self.occupied | (self.unknown & ~self.touched(start, held, margin))

    def touched(self, state: ArrayLike, held: Iterable[AttachedObject] = (), margin: float = 0.01) -> Flags:
        """Return the voxels that are within a margin of the robot and its held objects, shape (nx, ny, nz).

        Voxels that are up to their own diagonal farther away may be among them.

        Args:
            state: State of the robot, shape (dof,).
            held: Objects that it holds.
            margin: The distance [m].

        Raises:
            ParameterError: The state has another shape, or the margin is out of range.
        """
        q, kept = finite_array(state, "state"), {one.name: one for one in held}
        check_array(q, (self.robot.dof,), "state")
        check_number(margin, "margin", 0.0, 0.5)
        within = margin + 0.5 * np.sqrt(3.0) * self.resolution
        self._checker.become({}, kept, ())
        spheres = self._checker.kernel.cover_spheres(q)
        spheres[:, 3] += within
        found = mark_near(self.evidence.shape, self.origin, self.resolution, spheres) != 0
        cells = np.argwhere(found)
        centers = self.origin + (cells + 0.5) * self.resolution
        found[tuple(cells.T)] = on_robot(centers, self.robot, q, within, kept.values())
        return found

    def obstacle(
        self, name: str = "map", unknown: Unknown = "free", start: ArrayLike | None = None,
        held: Iterable[AttachedObject] = (), margin: float = 0.01,
    ) -> Obstacle:  # fmt: skip
        """Return the voxels of :meth:`blocked`, whose other arguments it has, as an obstacle that needs no file.

        Args:
            name: Name of the obstacle.

        Raises:
            ParameterError: As :meth:`blocked`, or no voxel counts as an obstacle.
        """
        flags = self.blocked(unknown, start, held, margin)
        return Obstacle(name=name, voxels=voxels_of(flags, self.resolution, self.origin))
