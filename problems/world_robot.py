"""Where the robot of the suites is, as the makers of worlds ask for it: its hands, and distances of cubes to it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from apex_ompl.collision import CollisionChecker
from apex_ompl.problems.suite_robot import robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Problem
from apex_ompl.types import Array

BASES = ((0.0, 0.5), (0.0, -0.5))  # where the arms stand, x and y [m]
BASE_REACH = 0.21  # along x and y, of the links that cannot evade, from the axis of a base [m]
SHORTEST = 1e-9  # time inside that counts [s]
NEVER_EVADING = ("link0", "link1", "link2")  # ends of the names of links that stay in that column


class Balls(NamedTuple):
    """Balls that contain the robot and what it holds.

    Attributes:
        centers: Shape (N, 3) [m].
        radii: Shape (N,) [m].
    """

    centers: Array
    radii: Array

    def clearance(self, place: Array, edge: float) -> float:
        """Return the distance to a cube at a place, shape (3,), with an edge [m]: at most the true one.

        It is negative only where the center of a ball is less than its radius from the cube.
        """
        outside = np.maximum(np.abs(self.centers - place) - edge / 2.0, 0.0)
        return float((np.linalg.norm(outside, axis=1) - self.radii).min())


class RobotPlaces:
    """The robot of the suites with what it holds in a problem, at any state.

    Attributes:
        problem: The problem.
        start: Its start, shape (dof,).
        goals: Its goals that are joint configurations, shape (goals, dof).
        hands: Links that hold something, else the palms.
    """

    def __init__(self, problem: Problem) -> None:
        """Make the tables of a problem of the suites."""
        self.problem = problem
        self.start = problem.start_state(robot().joint_names)
        self.goals = problem.goal_states(robot().joint_names)
        self.hands: Sequence[str] = tuple(held.link for held in problem.attached)
        self._kernel = CollisionChecker(robot(), (), problem.attached).kernel
        a = self._kernel.robot.arrays
        ends = np.append(a.body_root[1:], len(a.node_count))
        body = np.repeat(np.arange(len(ends)), ends - a.body_root)
        leaf = a.node_count == 0
        self._joint, self._center = a.body_joint[body][leaf], a.node_center[leaf]
        self._radius: Array = a.node_radius[leaf]
        evading = [not name.rpartition("_")[0].endswith(NEVER_EVADING) for name in self._kernel.robot.body_names]
        self._evading: NDArray[np.bool_] = np.array(evading)[body][leaf]

    def balls(self, q: Array, evading: bool = False) -> Balls:
        """Return the balls at a state, shape (dof,); with ``evading`` without those of links that stay at the bases."""
        rotation, origin = (value[0] for value in self._kernel.joint_frames(q[None]))
        centers = np.einsum("nij,nj->ni", rotation[self._joint], self._center) + origin[self._joint]
        chosen = self._evading if evading else slice(None)
        return Balls(centers[chosen], self._radius[chosen])

    def hand(self, q: Array, link: str) -> Array:
        """Return where a hand is at a state, shape (3,) [m]."""
        return np.array(robot().link_pose(q, link)[:3, 3])


def cube(name: str, edge: float, place: Array, velocity: Array | None = None) -> Obstacle:
    """Return a cube.

    Args:
        name: Its name.
        edge: [m].
        place: Where it is at time 0, shape (3,) [m].
        velocity: Shape (3,) [m/s].
    """
    fields = {"name": name, "box": (edge,) * 3, "position": tuple(place.tolist())}
    return Obstacle.model_validate(fields if velocity is None else {**fields, "velocity": tuple(velocity.tolist())})


def base_entry(place: Array, velocity: Array, edge: float) -> tuple[float, int]:
    """Return when a moving cube comes to a column above a base, where the robot cannot evade it.

    Args:
        place: Where it is at time 0, shape (3,) [m].
        velocity: Shape (3,) [m/s].
        edge: Of the cube [m].

    Returns:
        The time, infinite where it never does and 0 where it is there [s]; and the axis, 0 or 1, across the side.
    """
    half, found = BASE_REACH + edge / 2.0, (np.inf, 0)
    for base in BASES:
        inside = np.abs(place[:2] - base) < half
        enters, leaves = np.where(inside, 0.0, np.inf), np.full(2, np.inf)
        for axis in range(2):
            if velocity[axis] != 0.0:
                sides = (base[axis] - half - place[axis], base[axis] + half - place[axis])
                times = sorted(side / velocity[axis] for side in sides)
                enters[axis], leaves[axis] = times if times[1] > 0.0 else (np.inf, np.inf)
        axis = int(np.argmax(enters))
        if max(enters[axis], 0.0) + SHORTEST < leaves.min():
            found = min(found, (float(max(enters[axis], 0.0)), axis))
    return found
