"""The world of a kept planner: obstacles and held objects, edited in place."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.shapes import coal_geometry, with_file_read, with_file_unread
from apex_ompl.errors import FileFormatError, SceneError
from apex_ompl.planning.cloud_files import CloudFiles, cloud_of
from apex_ompl.planning.query import State, check_problem, state_array
from apex_ompl.robot import load_robot
from apex_ompl.scene.bodies import HOLDING, MOTION, AttachedObject, Obstacle, given_fields, pose_fields
from apex_ompl.scene.problem import Problem
from apex_ompl.types import Array
from apex_ompl.util.display import counted, one_line
from apex_ompl.util.forking import ProcessLock
from apex_ompl.util.schema import validate
from apex_ompl.util.validation import check_flag

if TYPE_CHECKING:
    from apex_ompl.scene.bodies import (
        ContactFace,
        GridFile,
        HalfSpace,
        HandGrasp,
        MeshFile,
        PointFile,
        RoundBar,
        Sphere,
        VoxelFile,
    )


class ObstacleFields(TypedDict, total=False):
    """Fields of :class:`apex_ompl.Obstacle` as keywords of :meth:`World.add`, for editors and type checkers."""

    name: str
    box: Sequence[float]
    sphere: Sphere | Mapping[str, Any]
    cylinder: RoundBar | Mapping[str, Any]
    capsule: RoundBar | Mapping[str, Any]
    mesh: MeshFile | Mapping[str, Any]
    points: PointFile | Mapping[str, Any]
    voxels: VoxelFile | Mapping[str, Any]
    distance_grid: GridFile | Mapping[str, Any]
    half_space: HalfSpace | Mapping[str, Any]
    position: Sequence[float]
    orientation: Sequence[float]
    mass: float | None
    center_of_mass: Sequence[float] | None
    inertia: Sequence[float] | None
    velocity: Sequence[float] | None
    trajectory: Sequence[Sequence[float]] | None
    appears: float
    contact: ContactFace | Mapping[str, Any] | None
    grasps: Sequence[HandGrasp | Mapping[str, Any]]


class World:
    """Obstacles around a robot and objects that it holds.

    Edits change the collision checker in place. They are safe from any thread: an edit waits until a plan of the same
    planner has ended. An edit that fails changes nothing. Files of meshes, points and grids are read once, when their
    body is added: later they may change or be gone.

    A copy has a checker of its own, and so has a world that was sent to another process, which reads the files anew.

    Attributes:
        checker: The collision checker; it is changed by edits alone.
        lock: Held during an edit.
        robot_file: Name or file of the robot.
    """

    def __init__(self, checker: CollisionChecker, lock: ProcessLock, robot_file: str = "") -> None:
        """Edit the scene of ``checker`` while ``lock`` is held.

        Args:
            checker: The checker.
            lock: The lock.
            robot_file: What other processes find the robot by; its name by default.
        """
        self.checker, self.lock = checker, lock
        self.robot_file = robot_file or checker.robot.name
        self._clouds = CloudFiles()

    def __getstate__(self) -> dict[str, Any]:
        """Return what another process needs to make the same world; it reads the files of meshes and points anew."""
        return {"robot": self.robot_file, "bodies": self._bodies()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Make the world anew."""
        checker = CollisionChecker(load_robot(state["robot"]), *state["bodies"])
        self.__init__(checker, ProcessLock(), state["robot"])  # type: ignore[misc]

    def __deepcopy__(self, memo: dict[int, Any]) -> World:
        """Return a world of its own with the same bodies, whose records do not change; no file is read."""
        return World(CollisionChecker(self.checker.robot, *self._bodies()), ProcessLock(), self.robot_file)

    def _bodies(self) -> tuple[tuple[Obstacle, ...], tuple[AttachedObject, ...], tuple[tuple[str, str], ...]]:
        with self.lock:
            return tuple(self.obstacles.values()), tuple(self.held.values()), self.allowed

    def __repr__(self) -> str:
        """Return how many obstacles, held objects and allowed pairs there are."""
        return one_line("World", self.contents)

    @property
    def contents(self) -> str:
        """How many obstacles, held objects and allowed pairs there are, in words."""
        counts = [counted(len(self.obstacles), "obstacle")]
        counts += [f"{len(self.held)} attached"] if self.held else []
        counts += [counted(len(self.allowed), "allowed pair")] if self.allowed else []
        return ", ".join(counts)

    @property
    def obstacles(self) -> Mapping[str, Obstacle]:
        """Obstacles by name, without the robot's own fixtures."""
        return self.checker.obstacles

    @property
    def held(self) -> Mapping[str, AttachedObject]:
        """Held objects by name."""
        return self.checker.held

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other threads from planning and from editing, so that several edits are one."""
        with self.lock:
            yield

    def add(self, *obstacles: Obstacle | Mapping[str, Any], **fields: Unpack[ObstacleFields]) -> None:
        """Add obstacles, given as records, as the entries of a problem file, or one by its fields.

            world.add(name="post", box=(0.1, 0.1, 0.6), position=(0.5, 0.0, 0.3))

        Raises:
            FileFormatError: A field is unknown or faulty, or a mesh file holds no solid.
            MissingFileError: A mesh file is missing.
            SceneError: A name is taken already.
        """
        wanted = [self._read(Obstacle, one, "obstacle") for one in (*obstacles, *([fields] if fields else []))]
        with self.lock:
            self._add([with_file_unread(one) for one in wanted])

    def set_points(
        self, name: str, points: ArrayLike, radius: float, file: str | os.PathLike[str] | None = None
    ) -> None:
        """Put balls of a radius [m] around points in the world in place of the cloud of that name, if there is one.

        Results name the file that points come from. Without one that is given, it is temporary: the files of the last
        clouds are kept as long as the planner.

        Args:
            name: Name of the obstacle; its allowed pairs are kept.
            points: Shape (N, 3) [m].
            radius: Radius of the balls [m].
            file: A ``.npy`` file that the points are written to.

        Raises:
            ParameterError: The points have another shape, or are not finite.
            SceneError: The name is that of something else.
            FileFormatError: The radius is not positive, or there are no points.
            MissingFileError: The file cannot be written.
        """
        cloud = cloud_of(points)
        with self.lock:
            path = self._clouds.path(file)
            wanted = self._read(Obstacle, {"name": name, "points": {"file": str(path), "radius": radius}}, "obstacle")
            old = self.obstacles.get(name)
            if old is None:
                self.checker.check_name(name)
            elif old.points is None:
                raise SceneError(f"the name {name!r} is taken by an obstacle that is no cloud of points")
            if not len(cloud):
                raise FileFormatError(str(path), "points", "none", "expected one point or more")
            self._clouds.write(cloud, path, {o.points.file for o in self.obstacles.values() if o.points is not None})
            if old is None:
                self._add([wanted])
                return
            coal_geometry(wanted)  # raises on a faulty cloud before anything is changed
            allowed = [pair for pair in self.allowed if name in pair]
            self.checker.remove(name)
            self.checker.add(wanted)
            for pair in allowed:
                self.checker.allow(*pair)

    def move(self, name: str, position: Sequence[float], orientation: Sequence[float] | None = None) -> None:
        """Move an obstacle to a pose in the world [m, quaternion xyzw]; the orientation is kept by default.

        The places of a script move by as much.

        Raises:
            SceneError: There is no such obstacle, or it is a fixture of the robot.
            FileFormatError: The position or the orientation is not valid.
        """
        with self.lock:
            self.checker.obstacle(name)
            self.checker.move(name, position, orientation)

    def set_velocity(self, name: str, velocity: Sequence[float] | None) -> None:
        """Give an obstacle a constant velocity [m/s], or none, in place of a script that it may have.

        Raises:
            SceneError: There is no such obstacle, or it is a fixture of the robot.
            FileFormatError: The velocity is not valid.
        """
        with self.lock:
            self.checker.obstacle(name)
            self.checker.set_velocity(name, velocity)

    def remove(self, name: str) -> None:
        """Remove an obstacle.

        Fixtures belong to the robot: :meth:`allow` lets bodies touch them, and a step ``remove`` of a sequence takes
        them away.

        Raises:
            SceneError: There is no such obstacle, or it is a fixture of the robot.
        """
        with self.lock:
            self.checker.obstacle(name)
            self.checker.remove(name)

    def attach(
        self, held: AttachedObject | Mapping[str, Any] | str, link: str | None = None,
        touch_links: Sequence[str] | None = None, *, links: Sequence[str] | None = None, at: State | None = None,
    ) -> None:  # fmt: skip
        """Attach an object to a link; it then collides like a part of the robot.

        Args:
            held: The object, as a record or as the entry of a problem file; or the name of an obstacle, which is taken
                where it stands.
            link: Link that holds it; must be given for an obstacle.
            touch_links: Links that it may touch; by default those of the hand.
            links: Two links that hold it together, in place of ``link``: the second keeps its pose in the first along
                every path.
            at: State at which it is taken; must be given for an obstacle. The object must not overlap anything there.

        Raises:
            SceneError: The name is taken, there is no such obstacle, or the object overlaps something.
            UnknownNameError: An unknown link.
            FileFormatError: A field is unknown or faulty.
            ParameterError: ``at`` has not the robot's joints.
        """
        q = None if at is None else state_array(self.checker.robot, at, "at")
        with self.lock:
            taken = None
            if links is not None:
                if link is not None or isinstance(links, str):
                    raise SceneError("give either one link or links, a list of two, not both")
                link = next(iter(links), None)
            if isinstance(held, str):
                if link is None or q is None:
                    raise SceneError(
                        f"to attach the obstacle {held!r}, give the link and the state at which it is taken"
                    )
                taken = self.checker.obstacle(held)
                held = self._as_held(taken, link, q)
            wanted = self._read(AttachedObject, held, "held object")
            wanted = with_file_unread(wanted) if taken is None else wanted
            changes = {"link": link, "links": links, "touch_links": touch_links}
            if given := {key: value for key, value in changes.items() if value is not None}:
                wanted = validate(AttachedObject, given_fields(wanted) | given, "held object")
            wanted = with_file_read(wanted)
            pairs = [] if taken is None else [pair for pair in self.allowed if taken.name in pair]
            if taken is not None:
                self.checker.remove(taken.name)
            try:
                self.checker.attach(wanted)
                if q is not None:
                    self._check_grasp(wanted.name, q)
            except Exception:
                if wanted.name in self.held and (taken is not None or self.held[wanted.name] is wanted):
                    self.checker.detach(wanted.name)
                if taken is not None:
                    self.checker.add(taken)
                for pair in pairs:
                    self.checker.allow(*pair)
                raise

    def detach(self, name: str, *, at: State | None = None) -> None:
        """Remove a held object; with a state ``at`` it stays in the world where it is then.

        Raises:
            SceneError: There is no such held object.
            ParameterError: The state has not the robot's joints.
        """
        q = None if at is None else state_array(self.checker.robot, at, "at")
        with self.lock:
            held, left = self.held.get(name) if isinstance(name, str) else None, list[Obstacle]()
            if q is not None and held is not None:
                pose = self.checker.robot.link_pose(q, held.link) @ held.pose
                shape = given_fields(held, HOLDING)
                left = [self._read(Obstacle, {**shape, **pose_fields(pose)}, "obstacle")]
            self.checker.detach(name)
            self._add(left)

    @property
    def allowed(self) -> tuple[tuple[str, str], ...]:
        """Pairs of bodies that may touch, as :meth:`allow` was told."""
        return self.checker.allowed

    def allow(self, first: str, second: str, allowed: bool = True) -> None:
        """Let two bodies touch and overlap, as an entry of MoveIt's allowed collision matrix does; or no longer.

        The pair is forgotten when one of the two is removed or detached.

        Args:
            first: Name of a link, a held object, an obstacle or a fixture.
            second: Another one.
            allowed: Whether they may.

        Raises:
            UnknownNameError: There is no such body.
            ParameterError: ``allowed`` is no truth value.
            SceneError: Both names are of the same body.
        """
        check_flag(allowed, "allowed")
        with self.lock:
            self.checker.allow(first, second, allowed)

    def clear(self) -> None:
        """Remove all obstacles, held objects and allowed pairs; the robot's fixtures stay."""
        with self.lock:
            for pair in self.allowed:
                self.checker.allow(*pair, allowed=False)
            for name in tuple(self.held):
                self.checker.detach(name)
            for name in tuple(self.obstacles):
                self.checker.remove(name)

    def load(self, problem: Problem) -> None:
        """Replace all obstacles, held objects and allowed pairs by those of a problem.

        Raises:
            ParameterError: It is no problem.
            ApexError: A body of the problem is faulty; the world is then empty.
        """
        check_problem(problem)
        with self.lock:
            self.clear()
            try:
                scene, held = map(with_file_unread, problem.scene), map(with_file_unread, problem.attached)
                self.checker.fill(scene, held, problem.allowed, fixtures=False)
            except Exception:
                self.clear()
                raise

    def _add(self, obstacles: Sequence[Obstacle]) -> None:
        added: list[str] = []
        try:
            for obstacle in obstacles:
                self.checker.add(obstacle)
                added.append(obstacle.name)
        except Exception:
            for name in added:
                self.checker.remove(name)
            raise

    def _check_grasp(self, name: str, q: Array) -> None:
        contacts = [contact for contact in self.checker.contacts(q) if name in (contact.first, contact.second)]
        if contacts:
            raise SceneError(f"the object {name!r} would overlap where it is taken: {contacts[0]}")

    def _as_held(self, obstacle: Obstacle, link: str, q: Array) -> dict[str, Any]:
        pose = np.linalg.inv(self.checker.robot.link_pose(q, link)) @ obstacle.pose
        shape = given_fields(obstacle, MOTION)
        return {**shape, "link": link, **pose_fields(pose)}

    @staticmethod
    def _read(kind: Any, given: Any, role: str) -> Any:
        plain = dict(given) if isinstance(given, Mapping) else given
        return given if isinstance(given, kind) else validate(kind, plain, role)
