"""Where a robot is, as the makers of worlds ask for it: its hands, its reach, and distances of cubes to it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from apex_ompl.collision import CollisionChecker
from apex_ompl.kernel import Kernel
from apex_ompl.problems.suite_robot import COLUMNS, HIGH, LOW, ROBOT, STAYING
from apex_ompl.robot import Robot, load_robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Problem
from apex_ompl.types import Array, Flags
from apex_ompl.util.cache import weakly_cached

SHORTEST = 1e-9  # time inside that counts [s]
STATES = 200  # random states at which a robot is measured
WIDEST = 0.3  # half width up to which the places of a link over all states make a column [m]
MIDDLE = (10.0, 90.0)  # percentiles of the places of hands between which cubes wander


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


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Where cubes may be around a robot.

    Attributes:
        columns: Upright columns of rectangles in which links stay that cannot evade: centers, shape (C, 2), and half
            widths, shape (C, 2) [m].
        staying: Ends of the names of these links.
        low: Lower corner of a box around the places of hands, shape (3,) [m].
        high: Its upper corner.
    """

    columns: tuple[Array, Array]
    staying: tuple[str, ...]
    low: Array
    high: Array

    def box(self, edge: float) -> tuple[Array, Array]:
        """Return the corners of the box of the centers of cubes with an edge [m], above the floor, shape (3,) each."""
        return np.maximum(self.low, [-np.inf, -np.inf, edge / 2.0]), self.high

    def entry(self, place: Array, velocity: Array, edge: float) -> tuple[float, int]:
        """Return when a moving cube comes to a column, where the robot cannot evade it.

        Args:
            place: Where it is at time 0, shape (3,) [m].
            velocity: Shape (3,) [m/s].
            edge: Of the cube [m].

        Returns:
            The time, infinite where it never does and 0 where it is there [s]; and the axis, 0 or 1, across the side.
        """
        found = (np.inf, 0)
        for base, reach in zip(*self.columns, strict=True):
            half = reach + edge / 2.0
            inside = np.abs(place[:2] - base) < half
            enters, leaves = np.where(inside, 0.0, np.inf), np.full(2, np.inf)
            for axis in range(2):
                if velocity[axis] != 0.0:
                    sides = (base[axis] - half[axis] - place[axis], base[axis] + half[axis] - place[axis])
                    times = sorted(side / velocity[axis] for side in sides)
                    enters[axis], leaves[axis] = times if times[1] > 0.0 else (np.inf, np.inf)
            axis = int(np.argmax(enters))
            if max(enters[axis], 0.0) + SHORTEST < leaves.min():
                found = min(found, (float(max(enters[axis], 0.0)), axis))
        return found


@weakly_cached
def surroundings(robot: Robot) -> Surroundings:
    """Return the surroundings of a robot: those of the suites are given, others are measured at random states.

    A link stays where its balls keep inside of a column no wider than twice WIDEST, or where it does not move.
    """
    if robot.name == ROBOT:
        return Surroundings(COLUMNS, STAYING, LOW, HIGH)
    states = robot.random_state(np.random.default_rng(0), STATES)
    links = _Leaves(CollisionChecker(robot).kernel)
    centers, radii = np.array([links.centers(q)[:, :2] for q in states]), links.radius[:, None]
    low, high = (centers - radii).min(axis=0), (centers + radii).max(axis=0)
    middles, halves, staying = list[Array](), list[Array](), list[str]()
    for body, name in enumerate(links.names):
        mine = links.body == body
        corner, other = low[mine].min(axis=0), high[mine].max(axis=0)
        half = (other - corner) / 2.0
        if links.moves[body] and half.max() > WIDEST:
            continue
        middles.append((corner + other) / 2.0)
        halves.append(half)
        staying.append(name)
    hands = np.array([robot.link_pose(q, link)[:3, 3] for q in states for link in hands_of(robot)])
    box = np.percentile(hands, MIDDLE, axis=0)
    columns = np.array(middles).reshape(-1, 2), np.array(halves).reshape(-1, 2)
    return Surroundings(columns, tuple(staying), box[0], box[1])


def hands_of(robot: Robot) -> tuple[str, ...]:
    """Return the links of a robot's palms, or the last ones of its chains where it has no hands."""
    return tuple(hand.palm for hand in robot.hands.values()) or robot.last_links


class _Leaves:
    """Balls of the covers of a robot and what it holds, by the joints that carry them."""

    def __init__(self, kernel: Kernel) -> None:
        a = kernel.robot.arrays
        ends = np.append(a.body_root[1:], len(a.node_count))
        body = np.repeat(np.arange(len(ends)), ends - a.body_root)
        leaf = a.node_count == 0
        self._kernel, self.names, self.body = kernel, kernel.robot.body_names, body[leaf]
        self._joint, self._center = a.body_joint[body][leaf], a.node_center[leaf]
        self.radius: Array = a.node_radius[leaf]
        self.moves: Flags = np.asarray(a.body_joint > 0)

    def centers(self, q: Array) -> Array:
        """Return their centers at a state, shape (dof,), shape (balls, 3) [m]."""
        rotation, origin = (value[0] for value in self._kernel.joint_frames(q[None]))
        return np.asarray(np.einsum("nij,nj->ni", rotation[self._joint], self._center) + origin[self._joint])


class RobotPlaces:
    """The robot of a problem with what it holds, at any state.

    Attributes:
        problem: The problem.
        robot: The robot.
        start: Its start, shape (dof,).
        goals: Its goals that are joint configurations, shape (goals, dof).
        hands: Links that hold something, else the palms.
        around: Its surroundings.
    """

    def __init__(self, problem: Problem) -> None:
        """Make the tables of a problem."""
        self.problem, self.robot = problem, load_robot(problem.robot)
        self.start = problem.start_state(self.robot.joint_names)
        self.goals = problem.goal_states(self.robot.joint_names)
        self.hands: Sequence[str] = tuple(held.link for held in problem.attached) or hands_of(self.robot)
        self.around = surroundings(self.robot)
        self._leaves = _Leaves(CollisionChecker(self.robot, (), problem.attached).kernel)
        ends = [name.rpartition("_")[0] for name in self._leaves.names]
        evading = [not one.endswith(self.around.staying) and name not in self.around.staying
                   for name, one in zip(self._leaves.names, ends, strict=True)]  # fmt: skip
        self._evading: Flags = np.array(evading)[self._leaves.body]

    def balls(self, q: Array, evading: bool = False) -> Balls:
        """Return the balls at a state, shape (dof,); with ``evading`` without those of links that stay at the bases."""
        centers = self._leaves.centers(q)
        chosen = self._evading if evading else slice(None)
        return Balls(centers[chosen], self._leaves.radius[chosen])

    def hand(self, q: Array, link: str) -> Array:
        """Return where a hand is at a state, shape (3,) [m]."""
        return np.array(self.robot.link_pose(q, link)[:3, 3])


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
