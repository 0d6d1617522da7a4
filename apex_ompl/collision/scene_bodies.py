"""Obstacles and held objects of a robot's scene, which can be added, moved and removed."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from tqdm import tqdm

from apex_ompl.collision.held_extent import extent_in_link
from apex_ompl.collision.mesh_stage import MeshStage
from apex_ompl.collision.shapes import coal_geometry, world_geometry
from apex_ompl.errors import SceneError, UnknownNameError
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject, Body, Obstacle
from apex_ompl.scene.scripts import moved_to, standing
from apex_ompl.types import Array
from apex_ompl.util.forking import unforked
from apex_ompl.util.schema import validate

SHOWN_AFTER = 1.0  # of a progress bar [s]


class SceneBodies:
    """Obstacles, the robot's fixtures and what it holds, with their geometry."""

    def __init__(self, robot: Robot) -> None:
        """Hold nothing yet; :meth:`fill` adds the fixtures of ``robot``, among others."""
        self.robot = robot
        self.meshes = MeshStage(robot)
        self._obstacles: dict[str, Body] = {}
        self._attached: dict[str, AttachedObject] = {}
        self._extents: dict[str, tuple[str, Array]] = {}
        self._fixtures = frozenset(body.name for body in robot.fixtures)

    @unforked()  # tqdm has a lock of its own
    def fill(
        self, scene: Iterable[Obstacle], attached: Iterable[AttachedObject],
        allowed: Iterable[tuple[str, str]] = (), *, fixtures: bool = True,
    ) -> None:  # fmt: skip
        """Add the robot's fixtures, unless they are there already, obstacles, held objects, and pairs that may touch.

        Raises:
            SceneError, UnknownNameError, MissingFileError, FileFormatError: As :meth:`add` and :meth:`attach`.
        """
        bodies = (*(self.robot.fixtures if fixtures else ()), *scene)
        for body in tqdm(bodies, desc="obstacles", delay=SHOWN_AFTER, leave=False, disable=None):
            self.add(body)
        for held in attached:
            self.attach(held)
        for pair in allowed:
            self.allow(*pair)

    def _obstacle_moved(self, number: int) -> None:
        """Take note that an obstacle was moved, by its number in ``meshes``; overridden."""

    def _obstacles_changed(self) -> None:
        """Take note that obstacles were added or removed; overridden."""

    def _held_changed(self) -> None:
        """Take note that objects were attached or detached; overridden."""

    @property
    def obstacle_names(self) -> tuple[str, ...]:
        """Names of the obstacles, without the robot's fixtures."""
        return tuple(name for name in self._obstacles if name not in self._fixtures)

    @property
    def obstacles(self) -> dict[str, Obstacle]:
        """The obstacles by name, without the robot's fixtures."""
        return {name: body for name, body in self._obstacles.items() if isinstance(body, Obstacle)}

    def is_obstacle(self, name: str) -> bool:
        """Whether there is an obstacle of that name, which is not a fixture of the robot's."""
        return name in self._obstacles and name not in self._fixtures

    @property
    def held(self) -> dict[str, AttachedObject]:
        """The held objects by name."""
        return dict(self._attached)

    @property
    def held_extents(self) -> tuple[tuple[str, Array], ...]:
        """The link that holds each held object, and the corners of a box around it in its frame, shape (2, 3) [m]."""
        return tuple(self._extents.values())

    def add(self, obstacle: Body) -> None:
        """Add an obstacle.

        Raises:
            SceneError: The name is taken already.
            MissingFileError, FileFormatError: Its mesh file is missing, or holds no triangles.
        """
        self.check_name(obstacle.name)
        self.meshes.add(obstacle.name, *world_geometry(obstacle))
        self._obstacles[obstacle.name] = obstacle
        self._obstacles_changed()

    def move(self, name: str, position: Sequence[float], orientation: Sequence[float] | None = None) -> None:
        """Move an obstacle to a pose in the world [m, quaternion xyzw]; the orientation is kept by default.

        The places of a script move by as much.

        Raises:
            SceneError: There is no such obstacle.
            FileFormatError: The position or the orientation is not valid.
        """
        old = self._find(self._obstacles, name, "obstacle")
        turn = old.orientation if orientation is None else orientation
        kept = {key: value for key, value in old.model_dump().items() if key != "trajectory"}
        new = validate(
            type(old), {**kept, "position": _sequence(position), "orientation": _sequence(turn)}, f"obstacle {name!r}"
        )
        if isinstance(old, Obstacle) and old.trajectory is not None:
            new = moved_to(old, new.position).model_copy(update={"orientation": new.orientation})
        self._obstacles[name] = new
        if new.half_space is not None:  # its pose is part of its geometry
            self.meshes.remove(name)
            self.meshes.add(name, *world_geometry(new))
            self._obstacles_changed()
            return
        self.meshes.move(name, new.pose)
        self._obstacle_moved(self.meshes.scene[name])

    def set_velocity(self, name: str, velocity: Sequence[float] | None) -> None:
        """Give an obstacle a constant velocity [m/s], or none, in place of a script; it is checked where it stands.

        Raises:
            SceneError: There is no such obstacle.
            FileFormatError: The velocity is not valid.
        """
        old = self._find(self.obstacles, name, "obstacle")
        fields = {**standing(old).model_dump(), "velocity": None if velocity is None else _sequence(velocity)}
        self._obstacles[name] = validate(Obstacle, fields, f"obstacle {name!r}")

    def remove(self, name: str) -> None:
        """Remove an obstacle.

        Raises:
            SceneError: There is no such obstacle.
        """
        self._find(self._obstacles, name, "obstacle")
        self._forget_allowed(name)
        del self._obstacles[name]
        self.meshes.remove(name)
        self._obstacles_changed()

    def attach(self, held: AttachedObject) -> None:
        """Attach an object to the link that holds it; it then collides like a part of the robot.

        Raises:
            SceneError: The name is taken already.
            UnknownNameError: An unknown link holds it or may touch it.
            MissingFileError: Its mesh file is missing.
            FileFormatError: Its mesh file holds no triangles.
        """
        self.check_name(held.name)
        for link in (held.link, *(held.touch_links or ())):
            self.robot.link_frame(link)
        geometry = coal_geometry(held)
        self.meshes.attach(held, geometry, held.pose)
        self._attached[held.name] = held
        self._extents[held.name] = held.link, extent_in_link(geometry, held.pose)
        self._held_changed()

    def detach(self, name: str) -> None:
        """Remove a held object.

        Raises:
            SceneError: There is no such held object.
        """
        self._find(self._attached, name, "held object")
        del self._attached[name], self._extents[name]
        self._forget_allowed(name)
        self.meshes.detach(name)
        self._held_changed()

    @property
    def allowed(self) -> tuple[tuple[str, str], ...]:
        """Pairs of bodies that may touch, besides those of the robot and of held objects and their hands."""
        return tuple(sorted((min(pair), max(pair)) for pair in self.meshes.allowed))

    def allow(self, first: str, second: str, allowed: bool = True) -> None:
        """Let two bodies touch and overlap, links, held objects or obstacles by their names; or no longer.

        Raises:
            UnknownNameError: There is no such body.
            SceneError: Both names are of the same body.
        """
        links = sorted({self.meshes.solids[k].name for k in range(self.meshes.links)})
        known = (*self._obstacles, *self._attached, *links)
        for name in (first, second):
            if name not in known:
                raise UnknownNameError("body", name, known)
        if first == second:
            raise SceneError(f"the body {first!r} is not checked against itself, expected two bodies")
        pair = {frozenset((first, second))}
        self._set_allowed(self.meshes.allowed | pair if allowed else self.meshes.allowed - pair)

    def _forget_allowed(self, name: str) -> None:
        """Remove the pairs of a body that is gone."""
        self._set_allowed(frozenset(pair for pair in self.meshes.allowed if name not in pair))

    def _set_allowed(self, allowed: frozenset[frozenset[str]]) -> None:
        changed = allowed ^ self.meshes.allowed
        if changed:
            self.meshes.allow(allowed)
            self._obstacles_changed()
            if any(not pair & self._obstacles.keys() for pair in changed):
                self._held_changed()

    def check_name(self, name: str) -> None:
        """Check that a body may get a name.

        Raises:
            SceneError: The name is taken already.
        """
        if name in self._obstacles or name in self._attached or self.robot.model.existBodyName(name):
            raise SceneError(f"the name {name!r} is taken by an obstacle, a held object, a fixture or a link")

    @staticmethod
    def _find(bodies: dict[str, Any], name: str, kind: str) -> Any:
        if name not in bodies:
            raise SceneError(f"no {kind} {name!r}; there are: {', '.join(bodies) or 'none'}")
        return bodies[name]


def _sequence(given: Any) -> Any:
    """Return a sequence as a tuple, and anything else as it is, which is refused behind it."""
    return tuple(given) if isinstance(given, Iterable) else given
