"""Free, occupied and unknown space from depth frames, and obstacles made of it.

A voxel is free once a frame shows that it is in front of all surfaces where it appears in the image, with the errors of
the camera's pose; it is occupied where points of surfaces are in it. All others, those behind surfaces and those
outside of the image among them, are unknown. Voxels are looked up in the image, in the least depths of windows of it;
no ray is followed.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apex_ompl.errors import FileFormatError, ParameterError
from apex_ompl.kernel.voxels import FREE, UNKNOWN, DepthWindows, ImageBlocks, SeenPoints, VoxelUpdate
from apex_ompl.perception.camera import Camera
from apex_ompl.perception.frames import Frame
from apex_ompl.perception.occupancy_contact import RobotContact
from apex_ompl.perception.occupancy_settings import OccupancySettings, settings_of
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject, Obstacle
from apex_ompl.scene.grids import voxels_of
from apex_ompl.scene.points import points_of
from apex_ompl.types import Array, Flags, Indices
from apex_ompl.util.display import one_line
from apex_ompl.util.files import pack_archive, path_text, read_archive, write_atomically
from apex_ompl.util.schema import check_version
from apex_ompl.util.validation import (
    check_array,
    check_integer,
    check_name,
    check_positive,
    finite_array,
    rigid_pose,
)

SCHEMA, ROLE, KEY = "apex-ompl/occupancy/1", "occupancy map", "map"
MOST_VOXELS = 50_000_000
SAMPLED = 4  # side of the blocks in which pixels are tested against the robot [pixels]
POLICIES, SHAPES = ("free", "blocked"), ("points", "voxels")

Unknown = Literal["free", "blocked"]
Shape = Literal["points", "voxels"]


class OccupancyMap:
    """Voxels of a box in the world that are free, occupied or unknown, kept from depth images of one camera or several.

    A voxel that was seen free stays free until a surface is seen there; an occupied voxel is freed when images see
    through it. The robot and its held objects are left out of the map: their pixels free the voxels in front of them,
    and occupy none. One thread at a time may use a map.

        seen = OccupancyMap(((-0.5, -1.0, 0.0), (1.5, 1.0, 1.5)), 0.02, robot)
        seen.integrate(frame, held=planner.world.held.values())
        planner.world.add(*seen.world(unknown="blocked", start=q))

    Attributes:
        origin: Outer corner of the first voxel, shape (3,) [m].
        resolution: Side of a voxel [m].
        robot: The robot, or None.
        settings: How images change the map.
        evidence: -1 for free voxels, 0 for unknown ones, more for occupied ones, shape (nx, ny, nz), of type int8.
    """

    def __init__(
        self, bounds: ArrayLike, resolution: float = 0.02, robot: Robot | None = None,
        settings: OccupancySettings | None = None,
    ) -> None:  # fmt: skip
        """Make a map in which all is unknown.

        Args:
            bounds: Least and largest corner of the box, shape (2, 3) [m]; the largest is rounded up to whole voxels.
            resolution: Side of a voxel [m].
            robot: The robot that is left out of the map; without one, nothing is.
            settings: How images change the map.

        Raises:
            ParameterError: The bounds have another shape, the box is empty, or has more than 50 million voxels.
        """
        box = finite_array(bounds, "bounds")
        check_array(box, (2, 3), "bounds")
        check_positive(resolution, "resolution", "a positive number of meters")
        if not (box[0] < box[1]).all():
            raise ParameterError("bounds", box.tolist(), "a largest corner above the least")
        counts = np.ceil((box[1] - box[0]) / resolution - 1e-6)
        if counts.prod() > MOST_VOXELS:
            raise ParameterError("resolution", resolution, f"a side that gives at most {MOST_VOXELS} voxels")
        self.origin, self.resolution, self.robot = box[0].copy(), float(resolution), robot
        self.settings = settings or OccupancySettings()
        self.evidence: NDArray[np.int8] = np.zeros(tuple(np.maximum(counts, 1).astype(int).tolist()), np.int8)
        self._hits = np.zeros_like(self.evidence)  # of the image at hand
        self._blocks: tuple[Camera, tuple[ImageBlocks, ImageBlocks]] | None = None  # of the last camera

    def __repr__(self) -> str:
        """Return the number of voxels, their side, and the shares of the three kinds."""
        count = " x ".join(map(str, self.evidence.shape))
        kinds = {"free": self.free, "occupied": self.occupied, "unknown": self.unknown}
        shares = (f"{100.0 * flags.mean():.1f} % {name}" for name, flags in kinds.items())
        return one_line("OccupancyMap", f"{count} voxels of {1e3 * self.resolution:g} mm", *shares)

    @property
    def bounds(self) -> Array:
        """Least and largest corner of the box, shape (2, 3) [m]."""
        return np.stack([self.origin, self.origin + self.resolution * np.array(self.evidence.shape)])

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

    def integrate(
        self, seen: Frame | ArrayLike, camera: Camera | None = None, pose: ArrayLike | None = None,
        state: ArrayLike | None = None, held: Iterable[AttachedObject] = (),
    ) -> None:  # fmt: skip
        """Change the map by a depth image.

        Args:
            seen: A frame; or depths, shape (height, width): whole numbers [mm], or floats [m].
            camera: The camera; by default that of the frame.
            pose: Pose of its optical frame in the world, shape (4, 4) [m]; by default as the camera says.
            state: State of the robot, shape (dof,); by default by the joints of the frame.
            held: Objects that the robot holds then, such as ``planner.world.held.values()``.

        Raises:
            ParameterError: The image has another shape than the camera's, or is not in its unit; there is no camera, or
                no state of the robot; the pose is not rigid.
            UnknownNameError: The robot has no link that carries the camera, or one that holds an object.
        """
        if isinstance(seen, Frame):
            frame = seen if camera is None else replace(seen, camera=camera)
        elif camera is None:
            raise ParameterError("camera", None, "the camera of the depth image")
        else:
            frame = Frame(camera, np.asarray(seen))
        camera = frame.camera
        q = self._state(frame, state)
        placed = self._pose(camera, q) if pose is None else rigid_pose(pose, "pose")
        spheres = self._own_spheres(q, held, placed, camera.depth.noise)
        self._update(frame, placed, spheres)

    def _state(self, frame: Frame, state: ArrayLike | None) -> Array | None:
        """Return the state of the robot, shape (dof,), or None without a robot."""
        if self.robot is None:
            return None
        if state is None:
            return frame.state(self.robot.joint_names)
        q = finite_array(state, "state")
        check_array(q, (self.robot.dof,), "state")
        return q

    def _pose(self, camera: Camera, q: Array | None) -> Array:
        """Return the pose of a camera's optical frame in the world, shape (4, 4) [m]."""
        if self.robot is not None and q is not None:
            return camera.pose_at(self.robot, q)
        if camera.link is not None:
            raise ParameterError("pose", None, f"a pose, or a map with the robot whose {camera.link!r} has the camera")
        return camera.pose

    def _update(self, frame: Frame, pose: Array, spheres: Array) -> None:
        """Change the map by a frame of a camera at a pose, without what is in spheres of the optical frame."""
        camera, settings = frame.camera, self.settings
        depth, (blocks, _) = camera.depth, self._blocks_of(camera)
        image = (frame.depth * depth.scale).astype(np.float32)
        windows = DepthWindows.of(blocks, image, (depth.nearest, depth.farthest), settings.missing)
        self._change(camera, pose).apply(self.evidence, self._hits, windows, self._points(camera, image, spheres))

    def _points(self, camera: Camera, image: NDArray[Any], spheres: Array) -> SeenPoints:
        """Return the points of an image, shape (height, width) [m], that are not in spheres of the optical frame."""
        settings = self.settings
        alike = settings.spreads * camera.depth.noise, self.resolution
        return SeenPoints.of(self._blocks_of(camera)[1], image, spheres, alike, settings.support)

    def _change(self, camera: Camera, pose: Array) -> VoxelUpdate:
        """Return how images of a camera at a pose change the evidence."""
        settings, depth, spreads = self.settings, camera.depth, self.settings.spreads
        return VoxelUpdate(
            self.origin, self.resolution, pose, settings.share, settings.least, settings.persistence,
            settings.longest, depth.noise, spreads * depth.scale_spread, spreads * camera.angle_spread,
            spreads * camera.position_spread,
        )  # fmt: skip

    @cached_property
    def _contact(self) -> RobotContact:
        if self.robot is None:
            raise ParameterError("robot", None, "a map with a robot")
        return RobotContact(self.robot)

    def _own_spheres(self, q: Array | None, held: Iterable[AttachedObject], pose: Array, noise: float) -> Array:
        """Return padded spheres around robot and held objects in the optical frame, shape (S, 4) [m]."""
        if q is None:
            return np.empty((0, 4))
        return self._contact.own_spheres(q, held, pose, self.settings.padding, self.settings.spreads * noise)

    def _blocks_of(self, camera: Camera) -> tuple[ImageBlocks, ImageBlocks]:
        """Return the blocks of all pixels of a camera, and of those whose points occupy voxels."""
        if self._blocks is None or self._blocks[0] != camera:
            size, stride = self.settings.block, self.settings.stride
            coarse = camera.focal[0] / stride, camera.focal[1] / stride
            blocks = ImageBlocks.of(camera.grid, camera.focal, size)
            self._blocks = camera, (blocks, ImageBlocks.of(camera.grid[::stride, ::stride], coarse, SAMPLED))
        return self._blocks[1]

    def decay(self, steps: int = 1) -> None:
        """Lower the evidence of all occupied voxels, as that many images do that see through them; down to unknown.

        Call it at regular times, where objects may have moved out of the camera's sight.

        Raises:
            ParameterError: ``steps`` is not a whole number from 1 on.
        """
        check_integer(steps, "steps", 1)
        self.evidence[:] = np.where(
            self.evidence > UNKNOWN, np.maximum(self.evidence - min(steps, 127), UNKNOWN), self.evidence
        )

    def clear(self, bounds: ArrayLike | None = None) -> None:
        """Make voxels unknown: all, or those that a box reaches into.

        Args:
            bounds: Least and largest corner of the box, shape (2, 3) [m].

        Raises:
            ParameterError: The bounds have another shape, or the box is empty.
        """
        if bounds is None:
            self.evidence[:] = UNKNOWN
            return
        box = finite_array(bounds, "bounds")
        check_array(box, (2, 3), "bounds")
        if not (box[0] < box[1]).all():
            raise ParameterError("bounds", box.tolist(), "a largest corner above the least")
        cells = (box - self.origin) / self.resolution
        first = np.clip(np.floor(cells[0] + 1e-9), 0, self.evidence.shape).astype(int)
        last = np.clip(np.ceil(cells[1] - 1e-9), 0, self.evidence.shape).astype(int)
        self.evidence[tuple(map(slice, first, last))] = UNKNOWN

    def look_up(self, points: ArrayLike) -> NDArray[np.int8]:
        """Return the evidence at points in the world, shape (N, 3) [m], of shape (N,); outside of the box 0.

        Raises:
            ParameterError: The points have another shape, or are not finite.
        """
        given = finite_array(points, "points")
        check_array(given, ("N", 3), "points")
        cells = np.floor((given - self.origin) / self.resolution)
        inside = ((cells >= 0) & (cells < self.evidence.shape)).all(axis=1)
        found = np.zeros(len(given), np.int8)
        found[inside] = self.evidence[tuple(cells[inside].astype(int).T)]
        return found

    def blocked(
        self, unknown: Unknown = "free", start: ArrayLike | None = None, *, goal: ArrayLike | None = None,
        held: Iterable[AttachedObject] = (), margin: float = 0.01, assume_free: ArrayLike = (),
    ) -> Flags:  # fmt: skip
        """Return the voxels that count as obstacles, shape (nx, ny, nz).

        Args:
            unknown: ``free``: occupied voxels. ``blocked``: unknown ones, too, but for those that start and goal touch.
            start: Start of the robot, shape (dof,), from which it must be able to move; needed with ``blocked``.
            goal: States that the user knows to be free, shape (dof,) or (G, dof), such as the goals of a plan.
            held: Objects that it holds there.
            margin: Distance from robot and held objects within which unknown voxels do not count [m].
            assume_free: Boxes in the world whose unknown voxels do not count, as the user knows them to be empty: least
                and largest corners, shape (B, 2, 3) [m]. Voxels with their centers in a box are meant.

        Raises:
            ParameterError: An argument is faulty, or there is no start where unknown space is blocked.
            UnknownNameError: ``unknown`` is neither.
        """
        check_name(unknown, "policy of unknown space", POLICIES)
        if unknown == "free":
            return self.occupied
        if start is None:
            raise ParameterError("start", None, "the start of the plan, whose unknown voxels do not count as obstacles")
        doubtful, kept = self.unknown & ~self._within(assume_free), tuple(held)
        for q in self._known(start, goal):
            doubtful &= ~self._touched(q, kept, margin, doubtful)
        return np.asarray(self.occupied | doubtful)

    def _within(self, boxes: ArrayLike) -> Flags:
        """Return the voxels with their centers in boxes in the world, shape (B, 2, 3) [m]."""
        given, found = finite_array(boxes, "assume_free"), np.zeros(self.evidence.shape, bool)
        if not given.size:
            return found
        check_array(given, ("B", 2, 3), "assume_free")
        if not (given[:, 0] <= given[:, 1]).all():
            raise ParameterError("assume_free", given.tolist(), "boxes with a largest corner above the least")
        cells = (given - self.origin) / self.resolution - 0.5
        first = np.clip(np.ceil(cells[:, 0] - 1e-9), 0, self.evidence.shape).astype(int)
        last = np.clip(np.floor(cells[:, 1] + 1e-9) + 1, 0, self.evidence.shape).astype(int)
        for low, high in zip(first, last, strict=True):
            found[tuple(map(slice, low, high))] = True
        return found

    def touched(self, state: ArrayLike, held: Iterable[AttachedObject] = (), margin: float = 0.01) -> Flags:
        """Return the voxels that are within a margin of the robot and its held objects, shape (nx, ny, nz).

        Voxels that are up to half their diagonal farther away may be among them.

        Args:
            state: State of the robot, shape (dof,).
            held: Objects that it holds.
            margin: The distance [m].

        Raises:
            ParameterError: The state has another shape, the margin is out of range, or the map has no robot.
        """
        return self._touched(self._contact.state(state), held, margin, np.ones(self.evidence.shape, bool))

    def _touched(self, q: Array, held: Iterable[AttachedObject], margin: float, among: Flags) -> Flags:
        """Return the voxels of :meth:`touched` among some, shape (nx, ny, nz)."""
        return self._contact.touched(q, held, margin, among, origin=self.origin, side=self.resolution)

    def _known(self, start: ArrayLike | None, goal: ArrayLike | None) -> Array:
        """Return the states in which the robot is known to be free, shape (M, dof)."""
        states = [] if start is None else [self._contact.state(start, "start")]
        if goal is not None:
            given = np.atleast_2d(finite_array(goal, "goal"))
            check_array(given, ("N", self._contact.robot.dof), "goal")
            states += [*given]
        return np.array(states)

    def _centers(self, cells: Indices) -> Array:
        return np.asarray(self.origin + (cells + 0.5) * self.resolution)

    def points(
        self, unknown: Unknown = "free", start: ArrayLike | None = None, *, goal: ArrayLike | None = None,
        held: Iterable[AttachedObject] = (), margin: float = 0.01, assume_free: ArrayLike = (),
    ) -> Array:  # fmt: skip
        """Return the centers of the voxels of :meth:`blocked`, whose arguments it has, shape (N, 3) [m].

        Balls of the radius ``ball_radius`` around them contain the voxels:
        ``world.set_points("map", seen.points(), seen.ball_radius)``. Where start and goal are given, in which the
        robot is free, balls that reach into it there are moved out of it: noise has put them there. Those with their
        centers more than ``padding`` inside stay.

        Raises:
            ParameterError, UnknownNameError: As :meth:`blocked`.
        """
        kept = tuple(held)
        flags = self.blocked(unknown, start, goal=goal, held=kept, margin=margin, assume_free=assume_free)
        found, states = self._centers(np.argwhere(flags)), self._known(start, goal)
        return (
            self._contact.moved_out(found, self.ball_radius, states, kept, self.settings.padding)
            if len(states)
            else found
        )

    @property
    def ball_radius(self) -> float:
        """Radius of the ball that contains a voxel [m]."""
        return 0.5 * float(np.sqrt(3.0)) * self.resolution

    def world(
        self, unknown: Unknown = "free", start: ArrayLike | None = None, *, goal: ArrayLike | None = None,
        held: Iterable[AttachedObject] = (), margin: float = 0.01, assume_free: ArrayLike = (), name: str = "map",
        shape: Shape = "points",
    ) -> tuple[Obstacle, ...]:  # fmt: skip
        """Return the voxels of :meth:`blocked`, whose other arguments it has, as an obstacle that needs no file.

        Plans among the points take less time than among the voxels themselves.

        Args:
            unknown: As there.
            start: As there.
            goal: As there.
            held: As there.
            margin: As there.
            assume_free: As there.
            name: Name of the obstacle.
            shape: ``points``: the balls of :meth:`points` and ``ball_radius``, which contain the voxels, but for those
                that are moved out of the robot. ``voxels``: the cubes themselves, also where they touch the robot.

        Returns:
            One obstacle, or none where no voxel counts as one.

        Raises:
            ParameterError, UnknownNameError: As :meth:`blocked`.
        """
        check_name(shape, "shape of a map", SHAPES)
        about: dict[str, Any] = {"goal": goal, "held": tuple(held), "margin": margin, "assume_free": assume_free}
        if shape == "points":
            points = self.points(unknown, start, **about)
            return (Obstacle(name=name, points=points_of(points, self.ball_radius)),) if len(points) else ()
        flags = self.blocked(unknown, start, **about)
        return (Obstacle(name=name, voxels=voxels_of(flags, self.resolution, self.origin)),) if flags.any() else ()

    def save(self, path: str | Path) -> None:
        """Write the map (``.npz``, ``schema: apex-ompl/occupancy/1``), without the robot.

        Raises:
            MissingFileError: The file cannot be written.
        """
        about = {
            "schema": SCHEMA, "origin": self.origin.tolist(), "resolution": self.resolution,
            "settings": asdict(self.settings),
        }  # fmt: skip
        write_atomically(Path(path_text(path)), pack_archive(KEY, about, {"evidence": self.evidence}, compressed=True))

    @classmethod
    def load(cls, path: str | Path, robot: Robot | None = None) -> Self:
        """Read a map.

        Args:
            path: The file.
            robot: The robot that is left out of the map.

        Raises:
            MissingFileError: The file cannot be read.
            FileFormatError: It is no map, or its parts do not fit together.
        """
        file = Path(path_text(path))
        about, arrays = read_archive(file, KEY, ROLE)
        check_version(about, SCHEMA, file)
        evidence = arrays.get("evidence")
        if evidence is None or evidence.dtype != np.int8 or evidence.ndim != 3 or not evidence.size:
            found = "none" if evidence is None else f"{evidence.dtype} of shape {evidence.shape}"
            raise FileFormatError(str(file), "evidence", found, "expected int8 of shape (nx, ny, nz)")
        try:
            settings = settings_of(about.get("settings"))
            origin = finite_array(about.get("origin", ()), "origin")
            check_array(origin, (3,), "origin")
            side = about.get("resolution", np.nan)
            check_positive(side, "resolution", "a positive number of meters")
            if evidence.min() < FREE or evidence.max() > settings.longest:
                worst = int(evidence.max() if evidence.max() > settings.longest else evidence.min())
                raise ParameterError("evidence", worst, f"from {FREE} to {settings.longest}")
            made = cls(np.stack([origin, origin + side * np.array(evidence.shape)]), side, robot, settings)
        except ParameterError as error:
            raise FileFormatError(str(file), error.name, error.value, f"expected {error.expected}") from error
        made.evidence[:] = evidence
        return made
