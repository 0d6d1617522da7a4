"""Obstacles and held objects of a robot's scene, which can be added, moved and removed."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import coal

from apex_ompl.collision.shapes import coal_geometry, world_geometry
from apex_ompl.errors import SceneError
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject, Body, Obstacle
from apex_ompl.types import Array
from apex_ompl.util.schema import validate


class SceneBodies:
    """Obstacles, the robot's fixtures and what it holds, with their geometry."""

    def __init__(self, robot: Robot, scene: Iterable[Obstacle], attached: Iterable[AttachedObject]) -> None:
        """Hold the fixtures of ``robot``, the obstacles of ``scene`` and the held objects.

        Raises:
            SceneError, UnknownNameError, MissingFileError, FileFormatError: As :meth:`add` and :meth:`attach`.
        """
        self.robot = robot
        self._obstacles: dict[str, Body] = {}
        self._attached: dict[str, AttachedObject] = {}
        self._placed: dict[str, tuple[coal.CollisionGeometry, Array]] = {}
        self._fixtures = frozenset(body.name for body in robot.fixtures)
        for body in (*robot.fixtures, *scene):
            self.add(body)
        for held in attached:
            self.attach(held)

    def _moved(self, name: str) -> None:
        """Take note that an obstacle was moved; overridden."""

    def _changed(self) -> None:
        """Take note that bodies were added or removed; overridden."""

    @property
    def obstacle_names(self) -> tuple[str, ...]:
        """Names of the obstacles, without the robot's fixtures."""
        return tuple(name for name in self._obstacles if name not in self._fixtures)

    def add(self, obstacle: Body) -> None:
        """Add an obstacle.

        Raises:
            SceneError: The name is taken already.
            MissingFileError, FileFormatError: Its mesh file is missing, or holds no triangles.
        """
        self._claim(obstacle.name)
        self._placed[obstacle.name] = world_geometry(obstacle)
        self._obstacles[obstacle.name] = obstacle
        self._changed()

    def move(self, name: str, position: Sequence[float], orientation: Sequence[float] | None = None) -> None:
        """Move an obstacle to a pose in the world [m, quaternion xyzw]; the orientation is kept by default.

        Raises:
            SceneError: There is no such obstacle.
            FileFormatError: The position or the orientation is not valid.
        """
        old = self._find(self._obstacles, name, "obstacle")
        turn = old.orientation if orientation is None else orientation
        fields = {**old.model_dump(), "position": tuple(position), "orientation": tuple(turn)}
        new = validate(type(old), fields, f"obstacle {name!r}")
        self._obstacles[name] = new
        if new.half_space is not None:  # its pose is part of its geometry
            self._placed[name] = world_geometry(new)
            self._changed()
            return
        self._placed[name] = (self._placed[name][0], new.pose)
        self._moved(name)

    def remove(self, name: str) -> None:
        """Remove an obstacle.

        Raises:
            SceneError: There is no such obstacle.
        """
        self._find(self._obstacles, name, "obstacle")
        del self._obstacles[name], self._placed[name]
        self._changed()

    def attach(self, held: AttachedObject) -> None:
        """Attach an object to the link that holds it; it then collides like a part of the robot.

        Raises:
            SceneError: The name is taken already.
            UnknownNameError: An unknown link holds it or may touch it.
            MissingFileError: Its mesh file is missing.
            FileFormatError: Its mesh file holds no triangles.
        """
        self._claim(held.name)
        for link in (held.link, *(held.touch_links or ())):
            self.robot.link_frame(link)
        self._placed[held.name] = (coal_geometry(held), held.pose)
        self._attached[held.name] = held
        self._changed()

    def detach(self, name: str) -> None:
        """Remove a held object.

        Raises:
            SceneError: There is no such held object.
        """
        self._find(self._attached, name, "held object")
        del self._attached[name], self._placed[name]
        self._changed()

    def _claim(self, name: str) -> None:
        if name in self._obstacles or name in self._attached or self.robot.model.existBodyName(name):
            raise SceneError(f"the name {name!r} is taken by an obstacle, a held object, a fixture or a link")

    @staticmethod
    def _find(bodies: dict[str, Any], name: str, kind: str) -> Any:
        if name not in bodies:
            raise SceneError(f"no {kind} {name!r}; there are: {', '.join(bodies) or 'none'}")
        return bodies[name]
