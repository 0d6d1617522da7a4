"""Whether a state is free: the judgement that every planner, benchmark and test of this package shares."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from apex_ompl.collision.broadphase import CompiledScene, Contact
from apex_ompl.collision.distance import Distance
from apex_ompl.collision.shapes import coal_geometry, world_geometry
from apex_ompl.errors import SceneError
from apex_ompl.problem import AttachedObject, Body, Obstacle
from apex_ompl.robot import Robot
from apex_ompl.schema import validate

Array = NDArray[np.float64]


class Verdict:
    """Judges states of a robot in a scene by Coal's meshes under Pinocchio's AABB-tree broadphase.

    Meshes collide by their triangles, primitives as solids, and one solid wholly inside a mesh counts as a
    collision. What never moves, such as a robot's base, is not judged against what never moves. A state with a number
    that is not finite is never free. Limits are not judged here. Queries may come from several threads, as they do
    from planners that run threads; scene changes may not, and each plan should have a verdict of its own.
    """

    def __init__(
        self,
        robot: Robot,
        scene: Iterable[Obstacle] = (),
        attached: Iterable[AttachedObject] = (),
    ) -> None:
        """Judge ``robot`` with its fixtures, the obstacles of ``scene`` and what it holds.

        Raises:
            SceneError: A name is taken already.
            UnknownNameError: A held object names an unknown link.
            MissingFileError: A mesh file is missing.
            FileFormatError: A mesh file holds no triangles.
        """
        self.robot = robot
        self.calls = 0
        self._obstacles: dict[str, Body] = {}
        self._attached: dict[str, AttachedObject] = {}
        self._placed: dict[str, tuple[coal.CollisionGeometry, Array]] = {}
        self._compiled: CompiledScene | None = None
        self._fixtures = frozenset(body.name for body in robot.fixtures)
        for body in (*robot.fixtures, *scene):
            self.add(body)
        for held in attached:
            self.attach(held)

    @property
    def obstacle_names(self) -> tuple[str, ...]:
        """Names of the obstacles, without the robot's fixtures."""
        return tuple(name for name in self._obstacles if name not in self._fixtures)

    def add(self, obstacle: Body) -> None:
        """Add an obstacle.

        Raises:
            SceneError: The name is taken already.
            MissingFileError: Its mesh file is missing.
            FileFormatError: Its mesh file holds no triangles.
        """
        self._claim(obstacle.name)
        self._placed[obstacle.name] = world_geometry(obstacle)
        self._obstacles[obstacle.name] = obstacle
        self._compiled = None

    def move(self, name: str, position: Sequence[float], orientation: Sequence[float] | None = None) -> None:
        """Place an obstacle anew, in the world [m, quaternion xyzw]; without orientation it keeps its own.

        Raises:
            SceneError: There is no such obstacle.
            FileFormatError: The position or the orientation is none.
        """
        old = self._find(self._obstacles, name, "obstacle")
        turn = old.orientation if orientation is None else orientation
        fields = {**old.model_dump(), "position": tuple(position), "orientation": tuple(turn)}
        new = validate(type(old), fields, f"obstacle {name!r}")
        self._obstacles[name] = new
        if new.half_space is not None:  # its pose is part of its geometry
            self._placed[name] = world_geometry(new)
            self._compiled = None
            return
        self._placed[name] = (self._placed[name][0], new.pose)
        if self._compiled is not None:
            self._compiled.place(name, pin.SE3(new.pose))

    def remove(self, name: str) -> None:
        """Remove an obstacle.

        Raises:
            SceneError: There is no such obstacle.
        """
        self._find(self._obstacles, name, "obstacle")
        del self._obstacles[name], self._placed[name]
        self._compiled = None

    def attach(self, held: AttachedObject) -> None:
        """Fix an object to the link that holds it; from now on it collides like a part of the robot.

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
        self._compiled = None

    def detach(self, name: str) -> None:
        """Take a held object away.

        Raises:
            SceneError: There is no such held object.
        """
        self._find(self._attached, name, "held object")
        del self._attached[name], self._placed[name]
        self._compiled = None

    def is_free(self, q: Array) -> bool:
        """Whether the state ``q``, shape (dof,), collides with nothing."""
        self.calls += 1
        order = self.robot.to_pinocchio(q)
        if not np.isfinite(order).all():
            return False
        return not self._scene().collides(order)

    def contacts(self, q: Array) -> list[Contact]:
        """Return all overlapping pairs at ``q``, shape (dof,), the deepest first."""
        return self._scene().contacts(self.robot.to_pinocchio(q))

    def distance(self, q: Array, fixtures: bool = False) -> Distance:
        """Return the least distance from robot and held objects to obstacles, d_obs of the paper.

        GJK on convex shapes; meshes that are not convex count by their hull.

        Args:
            q: State, shape (dof,).
            fixtures: Whether the robot's fixtures count as obstacles.
        """
        return self._scene().distances("all" if fixtures else "scene").closest(self.robot.to_pinocchio(q))

    def clearance(self, q: Array) -> float:
        """Return the least distance of all pairs that are checked, links against each other included [m]."""
        return self._scene().distances("pairs").closest(self.robot.to_pinocchio(q)).value

    def _claim(self, name: str) -> None:
        taken = name in self._obstacles or name in self._attached or self.robot.model.existBodyName(name)
        if taken:
            raise SceneError(f"the name {name!r} is taken by an obstacle, a held object, a fixture or a link")

    @staticmethod
    def _find(where: dict[str, Any], name: str, kind: str) -> Any:
        if name not in where:
            listing = ", ".join(where) or "none"
            raise SceneError(f"no {kind} {name!r}; there are: {listing}")
        return where[name]

    def _scene(self) -> CompiledScene:
        compiled = self._compiled
        if compiled is None:
            compiled = CompiledScene(self.robot, self._obstacles, self._attached, self._placed)
            self._compiled = compiled
        return compiled
