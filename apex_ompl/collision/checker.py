"""Collision checking of states and paths, shared by all planners, benchmarks and tests of this package."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from apex_ompl.collision.conservative import CheckCounts, ConservativeChecker, NoGridError, UnprovedPairs
from apex_ompl.collision.discretization import Collision, first_colliding_sample
from apex_ompl.collision.mesh_stage import Contact
from apex_ompl.collision.path_proof import TOLERANCE, Curve, PathProof, PathProver, obstacles_alone
from apex_ompl.collision.scene_bodies import SceneBodies
from apex_ompl.collision.solids import Distance
from apex_ompl.errors import ParameterError
from apex_ompl.kernel import Kernel
from apex_ompl.kernel.kernel import MOST_PAIRS
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject, Obstacle
from apex_ompl.types import Array, Flags
from apex_ompl.util.arrays import compact
from apex_ompl.util.validation import check_states, number_array, shape_error

TESTED = np.array([8, 4, 12, 2, 6, 10, 14, 1, 3, 5, 7, 9, 11, 13, 15, 0, 16]) / 16.0  # in a quick test, by share
AT_ONCE, DOUBTFUL = 4, 3  # states tested at a time, and states that the meshes check
NO_POINT = (0.0, 0.0, -1.0)
"""Obstacle point of a scene without obstacles, 1 m below the table tops, farther away than any obstacle [m]."""


class CollisionChecker(SceneBodies):
    """Checks states of a robot in a scene for collision, in two stages.

    The first stage is conservative: sphere covers that contain the solids prove most free states, and long stretches
    of motions, to be free, and balls inside the robot's solids that overlap obstacles prove most other states to
    collide. The second stage checks what neither proves: Coal's meshes pair by pair; both give the same result.

    Meshes collide by their triangles, primitives as solids, and a solid that lies entirely inside a mesh counts as a
    collision. Bodies that never move, such as the robot's base, are not checked against each other. A state with a
    number that is not finite is never free. Joint limits are not checked. Queries are safe from several threads, scene
    changes are not.
    """

    def __init__(
        self,
        robot: Robot,
        scene: Iterable[Obstacle] = (),
        attached: Iterable[AttachedObject] = (),
        allowed: Iterable[tuple[str, str]] = (),
        *,
        proofs: bool = True,
    ) -> None:
        """Make a checker of ``robot`` with its fixtures, the obstacles of ``scene`` and the held objects.

        Args:
            robot: The robot.
            scene: Obstacles.
            attached: Held objects.
            allowed: Pairs of names of bodies that may touch, see :meth:`allow`.
            proofs: Whether the conservative stage is used; without it every state is checked by the meshes.

        Raises:
            SceneError: A name is taken already.
            UnknownNameError: A held object names an unknown link, or a pair an unknown body.
            MissingFileError: A mesh file is missing.
            FileFormatError: A mesh file holds no triangles.
        """
        self.check_counts = CheckCounts()
        self._two_stages = proofs
        super().__init__(robot)
        self._spheres = ConservativeChecker(robot, self.meshes)
        self._prover, self._prover_alone = PathProver(robot, self.meshes), PathProver(robot, self.meshes)
        self._alone: tuple[Kernel, Kernel] | None = None  # a kernel, and the kernel of its obstacles alone
        self.fill(scene, attached, allowed)

    @property
    def movable(self) -> Flags:
        """Which of the kernel's obstacles are not fixtures of the robot, shape (obstacles,)."""
        owners = [self.meshes.scene[name] for name in self.obstacle_names]
        return np.isin(self.kernel.scene.arrays.owner, owners)

    @property
    def kernel(self) -> Kernel:
        """The compiled kernel of the robot in the current scene: clearances, their gradients, and the tables."""
        return self._spheres.kernel

    def prepare(self) -> None:
        """Make the tables, and load or compile the kernel, before the first query."""
        still = np.zeros((2, self.robot.dof))
        if self._two_stages:
            self._spheres.first_collision(still, 1.0, True, CheckCounts(), lambda *_: True)
            self._spheres.unproved_at(still[0], CheckCounts())
            self.kernel.clearance(still[:1], 0.0)  # proofs start with it

    def is_free(self, q: Array) -> bool:
        """Whether the state ``q``, shape (dof,), collides with nothing."""
        q = number_array(q, "state")
        if q.shape != (self.robot.dof,):
            raise shape_error(q, (self.robot.dof,), "state")
        if not self._two_stages:
            return self._is_free_given(q)
        left = self._spheres.unproved_at(q, self.check_counts)
        return left is None or self._is_free_given(q, left)

    def are_free(self, states: Array, threads: int = 1) -> Flags:
        """Whether each of the states, shape (N, dof), collides with nothing; shape (N,).

        Args:
            states: The states.
            threads: Number of threads of the kernel for many states; the meshes are checked by one thread.

        Raises:
            ParameterError: Another shape, or the number of threads is no positive whole number.
        """
        states = number_array(states, "states")
        check_states(states, self.robot.dof)
        if not self._two_stages:
            return np.array([self._is_free_given(q) for q in states], bool)
        free = np.ones(len(states), bool)
        for k, unproved in self._spheres.unproved_among(states, self.check_counts, threads):
            free[k] = self._is_free_given(states[k], unproved)
        return free

    def collides_along(self, path: Array) -> bool:
        """Whether a quick test finds a collision along a path, shape (N, dof); a path that passes may still collide.

        It tests a few states, spread evenly along the path, the middle first. Where none is proved to collide, the
        meshes check the states with the most pairs that the spheres do not prove.

        Raises:
            ParameterError: Another shape.
        """
        path = number_array(path, "path")
        check_states(path, self.robot.dof, "path", least=1)
        place, share = np.divmod(TESTED * (len(path) - 1), 1.0)
        before = place.astype(int)
        after = np.minimum(before + 1, len(path) - 1)
        states = path[before] + share[:, None] * (path[after] - path[before])
        if not self._two_stages:
            return not self.are_free(states).all()
        left = list[tuple[int, UnprovedPairs]]()
        for first in range(0, len(states), AT_ONCE):
            unproved = self._spheres.unproved_among(states[first : first + AT_ONCE], self.check_counts)
            colliding = sum(one.collides for _, one in unproved)
            if colliding:
                self.check_counts.colliding += colliding
                return True
            left += [(first + k, one) for k, one in unproved]
        doubtful = sorted(left, key=lambda one: len(one[1].pairs) if one[1].pairs else MOST_PAIRS, reverse=True)
        return any(not self._is_free_given(states[k], unproved) for k, unproved in doubtful[:DOUBTFUL])

    def first_collision(self, path: Array, resolution: float, start: bool = True) -> Collision | None:
        """Return a colliding state along a path, or None when the path is free.

        The states of :func:`apex_ompl.collision.discretization.sample_path`, at most ``resolution`` apart, are
        checked in bit-reversed order. States of a stretch that the spheres prove free count as checked.

        Args:
            path: States, shape (N, dof).
            resolution: Largest spacing [rad, max-norm].
            start: Whether the first state is checked too.

        Raises:
            ParameterError: ``path`` has not the shape (N, dof), or too many steps; ``resolution`` is not positive.
        """
        path = compact(number_array(path, "path"))
        if not (math.isfinite(resolution) and resolution > 0.0):
            raise ParameterError("resolution", resolution, "a positive number of radians")
        if path.ndim != 2 or path.shape[1] != self.robot.dof or len(path) == 0:
            raise shape_error(path, ("N", self.robot.dof), "path", least=1)
        if len(path) == 1:
            return None if not start or self.is_free(path[0]) else Collision(path[0].copy(), 0)
        if self._two_stages:
            try:
                first = self._spheres
                hit = first.first_collision(path, resolution, start, self.check_counts, self._is_free_given)
                return None if hit is None else Collision(*hit)
            except NoGridError:  # a state is not finite, or there are too many steps
                pass
        return first_colliding_sample(path, resolution, start, self.is_free)

    def prove(
        self, path: Array | Curve, *, tolerance: float = TOLERANCE, share: float = 0.0, deadline: float | None = None
    ) -> PathProof:  # fmt: skip
        """Prove that a path is free from its first state to its last, and find its least clearance.

        The first state is checked in full, solids inside of others included. Along the rest all pairs are proved to
        stay apart: by the sphere covers, and where they do not suffice by distances of the exact shapes (meshes by
        their triangles) against bounds on their relative motion. No stretch is assumed free.

        Args:
            path: States joined by straight lines, shape (N, dof), or a curve.
            tolerance: Tolerance of the least clearance [m]; 0 asks for the proof alone, which is faster.
            share: The same as a share of the clearance; the larger one counts.
            deadline: Value of ``time.perf_counter`` at which the proof is abandoned [s].

        Raises:
            ParameterError: ``path`` has not the shape (N, dof).
        """
        if not isinstance(path, Curve):
            path = number_array(path, "path")
            check_states(path, self.robot.dof, "path", least=1)
            path = Curve.polyline(path)
        start = path.states[0]
        if not self.is_free(start):
            contacts = self.contacts(start) if np.isfinite(start).all() else []
            return PathProof.refused(str(contacts[0]) if contacts else "in collision", path)
        return self._prover.prove(self.kernel, path, tolerance=tolerance, share=share, deadline=deadline)

    def obstacle_distance(self, path: Array) -> float:
        """Return the least distance of robot and held objects to obstacles along a path, 0 where they touch [m].

        The robot's fixtures are left out. The distance is that of the exact shapes, infinite without obstacles.

        Args:
            path: States joined by straight lines, shape (N, dof).
        """
        kernel, alone = self.kernel, self._alone
        if alone is None or alone[0] is not kernel:
            alone = self._alone = kernel, obstacles_alone(kernel, self.movable)
        return max(0.0, self._prover_alone.prove(alone[1], Curve.polyline(path)).clearance)

    def contacts(self, q: Array) -> list[Contact]:
        """Return all overlapping pairs at ``q``, shape (dof,), the deepest first."""
        return self.meshes.contacts(self.robot.to_pinocchio(q))

    def distance(self, q: Array, fixtures: bool = False) -> Distance:
        """Return the signed distance of robot and held objects to obstacles by convex hulls, and its nearest points.

        It is computed by GJK between convex shapes; a mesh that is not convex is replaced by its convex hull, which
        is enough for the model's condition. Distances of exact shapes are those of :meth:`obstacle_distance`.

        Args:
            q: State, shape (dof,).
            fixtures: Whether the robot's fixtures are obstacles too.
        """
        return self.meshes.distance(self.robot.to_pinocchio(q), fixtures)

    def obstacle_point(self, q: Array) -> Array:
        """Return the obstacle point nearest to the robot by GJK, fixtures excluded, shape (3,) [m].

        This is the obstacle point of the paper's condition g; NO_POINT in a scene without obstacles.
        """
        nearest = self.distance(q)
        return np.asarray(nearest.points[1] if nearest.first else NO_POINT, float)

    def clearance(self, q: Array) -> float:
        """Return the distance of the nearest pair that is checked, self-collision pairs included [m].

        It is that of the exact shapes at a free state, minus the largest depth of :meth:`contacts` at a colliding one,
        and NaN where a hand is outside its limits.
        """
        proof = self.prove(number_array(q, "state")[None])
        if not proof.clearance <= 0.0:
            return proof.clearance
        return -max((contact.depth for contact in self.contacts(q)), default=0.0)

    def clearances(self, states: Array) -> Array:
        """Return :meth:`clearance` at states, shape (N, dof), faster where they are free; shape (N,) [m]."""
        states = number_array(states, "states")
        check_states(states, self.robot.dof, "states", least=0)
        free = self.are_free(states)
        found = np.empty(len(states))
        found[free] = self._prover.clearances(self.kernel, states[free])
        found[~free] = [self.clearance(q) for q in states[~free]]
        return found

    def _is_free_given(self, q: Array, unproved: UnprovedPairs | None = None) -> bool:
        """Whether a state is free, given the pairs that the balls did not prove.

        Unless the balls proved a collision, the meshes check the unproved pairs, and all pairs unless the unproved ones
        are complete.
        """
        if unproved is not None and unproved.collides:
            self.check_counts.colliding += 1
            return False
        self.check_counts.meshes += 1
        order = self.robot.to_pinocchio(q)
        if not np.isfinite(order).all():
            return False
        if unproved is not None:
            if unproved.pairs and self.meshes.any_collides(order, unproved.pairs):
                return False
            if unproved.complete:
                return True
        return not self.meshes.collides(order)

    def _obstacle_moved(self, number: int) -> None:
        self._spheres.obstacle_moved(number)

    def _obstacles_changed(self) -> None:
        self._spheres.obstacles_changed()

    def _held_changed(self) -> None:
        self._spheres.held_changed()
