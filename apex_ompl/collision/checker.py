"""Whether a state is free: the judgement that every planner, benchmark and test of this package shares."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from apex_ompl.collision.broadphase import CompiledScene, Contact
from apex_ompl.collision.conservative import CheckCounts, ConservativeChecker, NoGridError, UnprovedPairs
from apex_ompl.collision.distance import Distance
from apex_ompl.collision.path_grid import bit_reversed, sample_path
from apex_ompl.collision.shapes import coal_geometry, world_geometry
from apex_ompl.errors import ParameterError, SceneError
from apex_ompl.kernel import Kernel
from apex_ompl.kernel.compiled.motion_proof import MOST_STEPS
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject, Body, Obstacle
from apex_ompl.types import Array
from apex_ompl.util.schema import validate


@dataclass(frozen=True)
class Collision:
    """Where a path collides.

    Attributes:
        state: A colliding state, shape (dof,).
        segment: It lies between states ``segment`` and ``segment + 1`` of the path.
    """

    state: Array
    segment: int


NO_POINT = (0.0, 0.0, -1.0)
"""The obstacle point where there is no obstacle: a metre under the tables' surface, further than any obstacle [m]."""


class CollisionChecker:
    """Judges states of a robot in a scene, in two stages that agree with the second alone.

    First covers of spheres that contain the solids prove most free states free, and whole stretches of motions. What
    they cannot prove goes to Coal's meshes under Pinocchio's AABB-tree broadphase, which alone say "colliding".

    Meshes collide by their triangles, primitives as solids, and one solid wholly inside a mesh counts as a
    collision. What never moves, such as a robot's base, is not judged against what never moves. A state with a number
    that is not finite is never free. Limits are not judged here. Queries may come from several threads, as they do
    from planners that run threads; scene changes may not, and each plan should have a checker of its own.
    """

    def __init__(
        self,
        robot: Robot,
        scene: Iterable[Obstacle] = (),
        attached: Iterable[AttachedObject] = (),
        *,
        proofs: bool = True,
    ) -> None:
        """Check ``robot`` with its fixtures, the obstacles of ``scene`` and what it holds.

        Args:
            robot: The robot.
            scene: Obstacles.
            attached: Held objects.
            proofs: Whether the spheres come first; without them every state goes to the meshes.

        Raises:
            SceneError: A name is taken already.
            UnknownNameError: A held object names an unknown link.
            MissingFileError: A mesh file is missing.
            FileFormatError: A mesh file holds no triangles.
        """
        self.robot = robot
        self.check_counts = CheckCounts()
        self._prove = proofs
        self._conservative: ConservativeChecker | None = None
        self._lock = threading.RLock()  # several threads may ask first
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
        self._forget()

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
            self._forget()
            return
        self._placed[name] = (self._placed[name][0], new.pose)
        if self._compiled is not None:
            self._compiled.place(name, pin.SE3(new.pose))
            if self._conservative is not None:
                self._conservative.obstacles_moved()

    def remove(self, name: str) -> None:
        """Remove an obstacle.

        Raises:
            SceneError: There is no such obstacle.
        """
        self._find(self._obstacles, name, "obstacle")
        del self._obstacles[name], self._placed[name]
        self._forget()

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
        self._forget()

    def detach(self, name: str) -> None:
        """Take a held object away.

        Raises:
            SceneError: There is no such held object.
        """
        self._find(self._attached, name, "held object")
        del self._attached[name], self._placed[name]
        self._forget()

    @property
    def movable(self) -> NDArray[np.bool_]:
        """Which of the kernel's obstacles do not belong to the robot's fixtures, shape (obstacles,)."""
        numbers = self._scene().scene
        owners = [numbers[name] for name in self.obstacle_names]
        return np.isin(self.kernel.scene.arrays.owner, owners)

    @property
    def kernel(self) -> Kernel:
        """The compiled kernel for the robot and scene of now: clearances, their gradients, and the tables."""
        return self._proved().kernel

    def prepare(self) -> None:
        """Do now what the first queries would do: compile the scene, make tables, and load or compile the kernel."""
        still = np.zeros((2, self.robot.dof))
        self._scene()
        if self._prove:
            self._proved().first_collision(still, 1.0, True, CheckCounts(), lambda *_: True)
            self._proved().unproved_at(still[0], CheckCounts())

    def is_free(self, q: Array) -> bool:
        """Whether the state ``q``, shape (dof,), collides with nothing."""
        q = np.asarray(q, float)
        if q.shape != (self.robot.dof,):
            self.robot.to_pinocchio(q)  # says what is wrong
            raise ParameterError("state", q.shape, f"an array of shape ({self.robot.dof},)")
        if not self._prove:
            return self._free_by_meshes(q)
        left = self._proved().unproved_at(q, self.check_counts)
        return left is None or self._free_by_meshes(q, left)

    def are_free(self, states: Array) -> NDArray[np.bool_]:
        """Whether each of the states, shape (N, dof), collides with nothing; shape (N,).

        Raises:
            ParameterError: Another shape.
        """
        states = np.asarray(states, float)
        if states.ndim != 2 or states.shape[1] != self.robot.dof:
            raise ParameterError("states", states.shape, f"an array of shape (N, {self.robot.dof})")
        if not self._prove:
            return np.array([self._free_by_meshes(q) for q in states], bool)
        free = np.ones(len(states), bool)
        for k, left in self._proved().unproved_among(states, self.check_counts):
            free[k] = self._free_by_meshes(states[k], left)
        return free

    def first_collision(self, path: Array, resolution: float, start: bool = True) -> Collision | None:
        """Return a colliding state along a path, or None when it is free.

        States at most ``resolution`` apart are checked, those of ``apex_ompl.collision.path_grid.sample_path``,
        in bit-reversed order; those inside a stretch that the spheres prove to be free count as judged.

        Args:
            path: States, shape (N, dof).
            resolution: Largest spacing [rad, max-norm].
            start: Whether the first state is judged too.

        Raises:
            ParameterError: ``path`` has not the shape (N, dof), or too many steps; ``resolution`` is not positive.
        """
        path = np.require(path, float, ["C", "W"])  # the kernel is compiled for arrays like this
        if not (math.isfinite(resolution) and resolution > 0.0):
            raise ParameterError("resolution", resolution, "a positive number of radians")
        if path.ndim != 2 or path.shape[1] != self.robot.dof or len(path) == 0:
            raise ParameterError("path", path.shape, f"an array of shape (N, {self.robot.dof})")
        if len(path) == 1:
            free = not start or self.is_free(path[0])
            return None if free else Collision(path[0].copy(), 0)
        if self._prove:
            try:
                hit = self._proved().first_collision(path, resolution, start, self.check_counts, self._free_by_meshes)
                return None if hit is None else Collision(*hit)
            except NoGridError:
                pass
        broken = ~np.isfinite(path).all(axis=1)
        if broken.any():
            k = int(np.argmax(broken))
            return Collision(path[k].copy(), max(k - 1, 0))
        if float(np.abs(np.diff(path, axis=0)).max(axis=1).sum()) / resolution > MOST_STEPS:
            raise ParameterError("path", f"longer than {MOST_STEPS} steps of {resolution:g}", "a shorter one")
        return self._first_sampled(path, resolution, start)

    def _first_sampled(self, path: Array, resolution: float, start: bool) -> Collision | None:
        states, segments = sample_path(path, resolution)
        skip = 0 if start else 1
        last = len(states) - 1 - skip
        for k in (last, *bit_reversed(last)):
            if not self.is_free(states[k + skip]):
                return Collision(states[k + skip], int(segments[k + skip]))
        return None

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

    def obstacle_point(self, q: Array) -> Array:
        """Return the obstacle point nearest to the robot by GJK, fixtures excluded, shape (3,) [m].

        This is the obstacle point in the paper's condition g; NO_POINT where there is no obstacle.
        """
        nearest = self.distance(q)
        return np.asarray(nearest.points[1] if nearest.first else NO_POINT, float)

    def clearance(self, q: Array) -> float:
        """Return the least distance of all pairs that are checked, links against each other included [m]."""
        return self._scene().distances("pairs").closest(self.robot.to_pinocchio(q)).value

    def _free_by_meshes(self, q: Array, left: UnprovedPairs | None = None) -> bool:
        """Check a state by its meshes: those that are left to be judged first, and all unless these are all."""
        self.check_counts.meshes += 1
        order = self.robot.to_pinocchio(q)
        if not np.isfinite(order).all():
            return False
        scene = self._scene()
        if left is not None:
            if left.pairs and scene.any_collides(order, left.pairs):
                return False
            if left.complete:
                return True
        return not scene.collides(order)

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

    def _proved(self) -> ConservativeChecker:
        proofs = self._conservative
        if proofs is None:
            with self._lock:
                proofs = self._conservative = self._conservative or ConservativeChecker(self.robot, self._scene())
        return proofs

    def _scene(self) -> CompiledScene:
        compiled = self._compiled
        if compiled is None:
            with self._lock:
                compiled = self._compiled or CompiledScene(self.robot, self._obstacles, self._attached, self._placed)
                self._compiled = compiled
        return compiled

    def _forget(self) -> None:
        """Drop what was made of the objects of before."""
        self._compiled = self._conservative = None
