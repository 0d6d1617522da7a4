"""The world of a kept planner: obstacles and held objects, edited in place."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.shapes import coal_geometry
from apex_ompl.errors import FileFormatError, SceneError
from apex_ompl.scene.bodies import MOTION, AttachedObject, Obstacle, pose_fields
from apex_ompl.scene.problem import Problem
from apex_ompl.session.cloud_files import CloudFiles, cloud_of
from apex_ompl.types import Array
from apex_ompl.util.forking import ProcessLock
from apex_ompl.util.schema import validate
from apex_ompl.util.validation import finite_array


class World:
    """Obstacles around a robot and objects that it holds.

    Edits change the collision checker in place. They are safe from any thread: an edit waits until a plan of the same
    planner has ended. An edit that fails changes nothing.
    """

    def __init__(self, checker: CollisionChecker, lock: ProcessLock) -> None:
        """Edit the scene of ``checker`` while ``lock`` is held."""
        self._checker = checker
        self._lock = lock
        self._clouds = CloudFiles()

    @property
    def obstacles(self) -> Mapping[str, Obstacle]:
        """Obstacles by name, without the robot's own fixtures."""
        return MappingProxyType(self._checker.obstacles)

    @property
    def held(self) -> Mapping[str, AttachedObject]:
        """Held objects by name."""
        return MappingProxyType(self._checker.held)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other threads from planning and from editing, so that several edits are one."""
        with self._lock:
            yield

    def add(self, *obstacles: Obstacle | Mapping[str, Any], **fields: Any) -> None:
        """Add obstacles, given as records, as the entries of a problem file, or one by its fields.

            world.add(name="post", box=(0.1, 0.1, 0.6), position=(0.5, 0.0, 0.3))

        Raises:
            FileFormatError: A field is unknown or faulty, or a mesh file holds no solid.
            MissingFileError: A mesh file is missing.
            SceneError: A name is taken already.
        """
        wanted = [self._read(Obstacle, one, "obstacle") for one in (*obstacles, *([fields] if fields else []))]
        with self._lock:
            self._add(wanted)

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
        with self._lock:
            path = self._clouds.path(file)
            wanted = self._read(Obstacle, {"name": name, "points": {"file": str(path), "radius": radius}}, "obstacle")
            old = self.obstacles.get(name)
            if old is None:
                self._checker.check_name(name)
            elif old.points is None:
                raise SceneError(f"the name {name!r} is taken by an obstacle that is no cloud of points")
            if not len(cloud):
                raise FileFormatError(str(path), "points", "none", "expected one point or more")
            self._clouds.write(cloud, path, {o.points.file for o in self.obstacles.values() if o.points is not None})
            if old is None:
                self._add([wanted])
                return
            coal_geometry(wanted)  # what is wrong with it shows before anything is changed
            allowed = [pair for pair in self.allowed if name in pair]
            self._checker.remove(name)
            self._checker.add(wanted)
            for pair in allowed:
                self._checker.allow(*pair)

    def move(self, name: str, position: Sequence[float], orientation: Sequence[float] | None = None) -> None:
        """Move an obstacle to a pose in the world [m, quaternion xyzw]; the orientation is kept by default.

        The places of a script move by as much.

        Raises:
            SceneError: There is no such obstacle.
            FileFormatError: The position or the orientation is not valid.
        """
        with self._lock:
            self._obstacle(name)
            self._checker.move(name, position, orientation)

    def set_velocity(self, name: str, velocity: Sequence[float] | None) -> None:
        """Give an obstacle a constant velocity [m/s], or none, in place of a script that it may have.

        Raises:
            SceneError: There is no such obstacle.
            FileFormatError: The velocity is not valid.
        """
        with self._lock:
            self._obstacle(name)
            self._checker.set_velocity(name, velocity)

    def remove(self, name: str) -> None:
        """Remove an obstacle.

        Raises:
            SceneError: There is no such obstacle, or it is a fixture of the robot.
        """
        with self._lock:
            self._obstacle(name)
            self._checker.remove(name)

    def attach(
        self, held: AttachedObject | Mapping[str, Any] | str, link: str | None = None,
        touch_links: Sequence[str] | None = None, *, at: ArrayLike | None = None,
    ) -> None:  # fmt: skip
        """Attach an object to a link; it then collides like a part of the robot.

        Args:
            held: The object, as a record or as the entry of a problem file; or the name of an obstacle, which is taken
                where it stands.
            link: Link that holds it; must be given for an obstacle.
            touch_links: Links that it may touch; by default those of the hand.
            at: State at which it is taken, shape (dof,); must be given for an obstacle. The object must not overlap
                anything there.

        Raises:
            SceneError: The name is taken, there is no such obstacle, or the object overlaps something.
            UnknownNameError: An unknown link.
            FileFormatError: A field is unknown or faulty.
        """
        with self._lock:
            taken = None
            if isinstance(held, str):
                if link is None or at is None:
                    raise SceneError(
                        f"to attach the obstacle {held!r}, give the link and the state at which it is taken"
                    )
                taken = self._obstacle(held)
                held = self._as_held(taken, link, finite_array(at, "at"))
            wanted = self._read(AttachedObject, held, "held object")
            changes = {"link": link, "touch_links": None if touch_links is None else tuple(touch_links)}
            wanted = wanted.model_copy(update={key: value for key, value in changes.items() if value is not None})
            pairs = [] if taken is None else [pair for pair in self.allowed if taken.name in pair]
            if taken is not None:
                self._checker.remove(taken.name)
            try:
                self._checker.attach(wanted)
                if at is not None:
                    self._check_grasp(wanted.name, finite_array(at, "at"))
            except Exception:
                if wanted.name in self.held and (taken is not None or self.held[wanted.name] is wanted):
                    self._checker.detach(wanted.name)
                if taken is not None:
                    self._checker.add(taken)
                for pair in pairs:
                    self._checker.allow(*pair)
                raise

    def detach(self, name: str, *, at: ArrayLike | None = None) -> None:
        """Remove a held object; with a state ``at``, shape (dof,), it stays in the world where it is then.

        Raises:
            SceneError: There is no such held object.
        """
        with self._lock:
            held, left = self.held.get(name), []
            if at is not None and held is not None:
                pose = self._checker.robot.link_pose(finite_array(at, "at"), held.link) @ held.pose
                shape = held.model_dump(exclude_none=True, exclude={"link", "touch_links", "contact"})
                left = [self._read(Obstacle, {**shape, **pose_fields(pose)}, "obstacle")]
            self._checker.detach(name)
            self._add(left)

    @property
    def allowed(self) -> tuple[tuple[str, str], ...]:
        """Pairs of bodies that may touch, as :meth:`allow` was told."""
        return self._checker.allowed

    def allow(self, first: str, second: str, allowed: bool = True) -> None:
        """Let two bodies touch and overlap, as an entry of MoveIt's allowed collision matrix does; or no longer.

        The pair is forgotten when one of the two is removed or detached.

        Args:
            first: Name of a link, a held object, an obstacle or a fixture.
            second: Another one.
            allowed: Whether they may.

        Raises:
            UnknownNameError: There is no such body.
            SceneError: Both names are of the same body.
        """
        with self._lock:
            self._checker.allow(first, second, allowed)

    def clear(self) -> None:
        """Remove all obstacles, held objects and allowed pairs; the robot's fixtures stay."""
        with self._lock:
            for pair in self.allowed:
                self._checker.allow(*pair, allowed=False)
            for name in tuple(self.held):
                self._checker.detach(name)
            for name in tuple(self.obstacles):
                self._checker.remove(name)

    def load(self, problem: Problem) -> None:
        """Replace all obstacles, held objects and allowed pairs by those of a problem.

        Raises:
            ApexError: A body of the problem is faulty; the world is then empty.
        """
        with self._lock:
            self.clear()
            try:
                self._checker.fill(problem.scene, problem.attached, problem.allowed, fixtures=False)
            except Exception:
                self.clear()
                raise

    def _add(self, obstacles: Sequence[Obstacle]) -> None:
        added: list[str] = []
        try:
            for obstacle in obstacles:
                self._checker.add(obstacle)
                added.append(obstacle.name)
        except Exception:
            for name in added:
                self._checker.remove(name)
            raise

    def _obstacle(self, name: str) -> Obstacle:
        if not self._checker.is_obstacle(name):
            raise SceneError(f"no obstacle {name!r}; there are: {', '.join(self.obstacles) or 'none'}")
        return self.obstacles[name]

    def _check_grasp(self, name: str, q: Array) -> None:
        contacts = [contact for contact in self._checker.contacts(q) if name in (contact.first, contact.second)]
        if contacts:
            raise SceneError(f"the object {name!r} would overlap where it is taken: {contacts[0]}")

    def _as_held(self, obstacle: Obstacle, link: str, q: Array) -> dict[str, Any]:
        pose = np.linalg.inv(self._checker.robot.link_pose(q, link)) @ obstacle.pose
        shape = obstacle.model_dump(exclude_none=True, exclude={*MOTION})
        return {**shape, "link": link, **pose_fields(pose)}

    @staticmethod
    def _read(kind: Any, given: Any, role: str) -> Any:
        plain = dict(given) if isinstance(given, Mapping) else given
        return given if isinstance(given, kind) else validate(kind, plain, role)
