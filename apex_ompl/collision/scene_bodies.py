"""Obstacles and held objects of a robot's scene, which can be added, moved and removed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

from apex_ompl.collision.mesh_stage import MeshStage
from apex_ompl.collision.shapes import body_note, coal_geometry, extent_in_link, with_file_read, world_geometry
from apex_ompl.errors import SceneError, UnknownNameError
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject, Body, Obstacle, file_shape, given_fields, same_solid
from apex_ompl.scene.scripts import moved_to, standing
from apex_ompl.types import Array
from apex_ompl.util.display import counted, one_line, progress
from apex_ompl.util.forking import unforked
from apex_ompl.util.schema import validate

SHOWN_AFTER = 1.0  # of a progress bar [s]


class SceneBodies:
    """Obstacles, the robot's fixtures and held objects, with their geometry."""

    def __init__(self, robot: Robot) -> None:
        """Hold nothing yet; :meth:`fill` adds the fixtures of ``robot``, among others."""
        self.robot = robot
        self.meshes = MeshStage(robot)
        self._obstacles: dict[str, Body] = {}
        self._changing: set[str] = set()  # dynamic obstacles and obstacles that appear later
        self._notes: dict[str, str] = {}
        self._listed: dict[str, Obstacle] | None = None  # the obstacles without fixtures, made when they are asked for
        self._attached: dict[str, AttachedObject] = {}
        self._extents: dict[str, tuple[str, Array]] = {}
        self._fixtures = frozenset(body.name for body in robot.fixtures)

    def __repr__(self) -> str:
        """Return the robot, and how many obstacles and held objects there are."""
        held = f"{len(self._attached)} attached" if self._attached else ""
        obstacles = counted(len(self.obstacles), "obstacle")
        return one_line(type(self).__name__, repr(self.robot.name), obstacles, held)

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
        for body in progress(bodies, "obstacles", SHOWN_AFTER):
            self.add(body)
        for held in attached:
            self.attach(held)
        self._allow_all(allowed, True)

    def become(
        self, scene: Mapping[str, Obstacle], held: Mapping[str, AttachedObject], allowed: Iterable[tuple[str, str]]
    ) -> None:
        """Change the scene to these obstacles and held objects, by name, and pairs that may touch.

        Obstacles of the same solid move in place; new obstacles become the last ones.

        Raises:
            SceneError, UnknownNameError, MissingFileError, FileFormatError: As :meth:`fill`.
        """
        for name in [name for name, body in self._attached.items() if held.get(name) is not body]:
            self.detach(name)
        for name, body in self.obstacles.items():
            other = scene.get(name)
            if other is None or not (same_solid(body, other) and file_shape(body) is file_shape(other)):
                self.remove(name)
            elif other is not body:
                self._move_to(other)
        new = [body for name, body in held.items() if name not in self._attached]
        self.fill([body for name, body in scene.items() if name not in self._obstacles], new, fixtures=False)
        self._set_allowed(frozenset(frozenset(pair) for pair in allowed))

    def _obstacle_moved(self, number: int) -> None:
        """Note that an obstacle was moved, by its number in ``meshes``; overridden."""

    def _obstacles_changed(self) -> None:
        """Note that obstacles were added or removed; overridden."""

    def _held_changed(self) -> None:
        """Note that objects were attached or detached; overridden."""

    @property
    def obstacle_names(self) -> tuple[str, ...]:
        """Names of the obstacles, without the robot's fixtures."""
        return tuple(name for name in self._obstacles if name not in self._fixtures)

    @property
    def obstacles(self) -> Mapping[str, Obstacle]:
        """The obstacles by name, without the robot's fixtures; later edits do not change the mapping."""
        if self._listed is None:
            self._listed = {name: body for name, body in self._obstacles.items() if isinstance(body, Obstacle)}
        return MappingProxyType(self._listed)

    @property
    def changing_obstacles(self) -> tuple[Obstacle, ...]:
        """Dynamic obstacles, and obstacles that appear after time 0, in the order in which they were added."""
        found = (self._obstacles[name] for name in sorted(self._changing, key=self.meshes.scene.__getitem__))
        return tuple(one for one in found if isinstance(one, Obstacle))

    @property
    def mesh_notes(self) -> tuple[str, ...]:
        """Sentences on meshes that are no proper solids, and how they are interpreted, and on very long bodies."""
        return tuple(self._notes.values())

    def obstacle(self, name: str) -> Obstacle:
        """Return an obstacle, which is not a fixture of the robot's.

        Raises:
            SceneError: There is no such obstacle, or it is a fixture of the robot.
        """
        found = self._obstacles.get(name) if isinstance(name, str) else None
        if found is not None and name in self._fixtures:
            what = "it is a fixture of the robot, where it stays"
            instead = "world.allow lets bodies touch it, and a step 'remove' of a sequence takes it away"
            raise SceneError(f"no obstacle {name!r}; {what}: {instead}")
        if not isinstance(found, Obstacle):
            raise SceneError(f"no obstacle {name!r}; there are: {', '.join(self.obstacles) or 'none'}")
        return found

    def is_obstacle(self, name: str) -> bool:
        """Whether there is an obstacle of that name, which is not a fixture of the robot's."""
        return isinstance(name, str) and name in self._obstacles and name not in self._fixtures

    @property
    def held(self) -> Mapping[str, AttachedObject]:
        """The held objects by name; later edits do not change the mapping."""
        return MappingProxyType(dict(self._attached))

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
        obstacle = with_file_read(obstacle)
        self.meshes.add(obstacle.name, *world_geometry(obstacle))
        self._put(obstacle)
        if note := body_note(obstacle):
            self._notes[obstacle.name] = note
        self._obstacles_changed()

    def _put(self, body: Body) -> None:
        """Keep the record of a new obstacle, or replace its earlier record."""
        self._obstacles[body.name] = body
        self._listed = None
        changes = isinstance(body, Obstacle) and (body.moving or body.appears > 0.0)
        (self._changing.add if changes else self._changing.discard)(body.name)

    def move(self, name: str, position: Sequence[float], orientation: Sequence[float] | None = None) -> None:
        """Move an obstacle to a pose in the world [m, quaternion xyzw]; the orientation is kept by default.

        The places of a script move by as much.

        Raises:
            SceneError: There is no such obstacle.
            FileFormatError: The position or the orientation is not valid.
        """
        old = self._find(self._obstacles, name, "obstacle")
        turn = old.orientation if orientation is None else orientation
        kept = given_fields(old, ("trajectory",))
        new = validate(
            type(old), {**kept, "position": _sequence(position), "orientation": _sequence(turn)}, f"obstacle {name!r}"
        )
        if isinstance(old, Obstacle) and old.trajectory is not None:
            new = moved_to(old, new.position).model_copy(update={"orientation": new.orientation})
        self._move_to(new)

    def _move_to(self, body: Body) -> None:
        """Replace the record of an obstacle by one that differs in pose and motion alone."""
        self._put(body)
        if body.half_space is not None:  # its pose is part of its geometry
            self.meshes.remove(body.name)
            self.meshes.add(body.name, *world_geometry(body))
            self._obstacles_changed()
            return
        self.meshes.move(body.name, body.pose)
        self._obstacle_moved(self.meshes.scene[body.name])

    def set_velocity(self, name: str, velocity: Sequence[float] | None) -> None:
        """Give an obstacle a constant velocity [m/s], or none, in place of a script; it is checked where it stands.

        Raises:
            SceneError: There is no such obstacle.
            FileFormatError: The velocity is not valid.
        """
        fields = given_fields(standing(self.obstacle(name)))
        if velocity is not None:
            fields["velocity"] = _sequence(velocity)
        self._put(validate(Obstacle, fields, f"obstacle {name!r}"))

    def remove(self, name: str) -> None:
        """Remove an obstacle.

        Raises:
            SceneError: There is no such obstacle.
        """
        self._find(self._obstacles, name, "obstacle")
        self._forget_allowed(name)
        del self._obstacles[name]
        self._listed = None
        self._changing.discard(name)
        self._notes.pop(name, None)
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
        for link in (*held.holders, *(held.touch_links or ())):
            self.robot.link_frame(link)
        held = with_file_read(held)
        geometry = coal_geometry(held)
        self.meshes.attach(held, geometry, held.pose)
        self._attached[held.name] = held
        self._extents[held.name] = held.link, extent_in_link(geometry, held.pose)
        if note := body_note(held):
            self._notes[held.name] = note
        self._held_changed()

    def detach(self, name: str) -> None:
        """Remove a held object.

        Raises:
            SceneError: There is no such held object.
        """
        self._find(self._attached, name, "held object")
        del self._attached[name], self._extents[name]
        self._notes.pop(name, None)
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
        self._allow_all([(first, second)], allowed)

    def _allow_all(self, pairs: Iterable[tuple[str, str]], allowed: bool) -> None:
        """Let the bodies of pairs touch, or no longer."""
        links = {self.meshes.solids[k].name for k in range(self.meshes.links)}
        changed = set[frozenset[str]]()
        for pair in pairs:
            for name in pair:
                if not isinstance(name, str) or not any(
                    name in known for known in (self._obstacles, self._attached, links)
                ):
                    raise UnknownNameError("body", name, (*self._obstacles, *self._attached, *sorted(links)))
            if len(set(pair)) == 1:
                raise SceneError(f"the body {pair[0]!r} is not checked against itself, expected two bodies")
            changed.add(frozenset(pair))
        self._set_allowed(self.meshes.allowed | changed if allowed else self.meshes.allowed - changed)

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
        if not isinstance(name, str) or name not in bodies:
            raise SceneError(f"no {kind} {name!r}; there are: {', '.join(bodies) or 'none'}")
        return bodies[name]


def _sequence(given: Any) -> Any:
    """Return a sequence as a tuple, and anything else unchanged, which the validation refuses."""
    return tuple(given) if isinstance(given, Iterable) else given
