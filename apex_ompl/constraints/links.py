"""Points, directions and frames fixed to the links of a robot, given in the frames of joints as the kernel does."""

from __future__ import annotations

from collections.abc import Sequence
from weakref import WeakKeyDictionary

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from apex_ompl.collision.tables import joint_tree
from apex_ompl.errors import UnknownNameError
from apex_ompl.kernel import FixedVector, IKSolver, RobotTables, Target
from apex_ompl.kernel.robot_builder import robot_tables
from apex_ompl.robot import Robot
from apex_ompl.types import Array
from apex_ompl.util.forking import ProcessLock

MOST_VECTORS = 4096  # that are kept


def in_world(vector: ArrayLike) -> FixedVector:
    """Return a point [m] or a unit direction in the world frame, shape (3,), for the targets of the solver."""
    return FixedVector(0, vector)


class Links:
    """Points, directions and frames fixed to the links of a robot; safe for several threads."""

    def __init__(self, robot: Robot) -> None:
        """Tabulate the joints of ``robot``.

        Raises:
            RobotError: The kernel does not support the type of a joint.
        """
        # No reference to the robot, so that the cache of `of` can release it.
        tree = joint_tree(robot)
        frames = (f for f in robot.model.frames if f.type == pin.FrameType.BODY)
        self._placements = {f.name: (int(f.parentJoint), f.placement.copy()) for f in frames}
        self._turns = [turn[:3, :3] for turn in tree.turns]
        self._vectors = dict[tuple[str, bytes, bool], FixedVector]()
        limits = robot.limits
        self.tables: RobotTables = robot_tables(
            robot.name, robot.joint_names, lower=limits.lower, upper=limits.upper, tree=tree, bodies=[], pairs=[],
            weights=robot.weights, continuous=robot.continuous,
        )  # fmt: skip

    @classmethod
    def of(cls, robot: Robot) -> Links:
        """Return the links of a robot, made once per robot."""
        with _lock:
            if robot not in _known:
                _known[robot] = cls(robot)
            return _known[robot]

    def point(self, link: str, point: ArrayLike) -> FixedVector:
        """Return a point given in the frame of a link, shape (3,) [m].

        Raises:
            UnknownNameError: No such link.
        """
        return self._fixed(link, np.asarray(point, float), is_point=True)

    def direction(self, link: str, direction: ArrayLike) -> FixedVector:
        """Return a unit direction given in the frame of a link, shape (3,).

        Raises:
            UnknownNameError: No such link.
        """
        return self._fixed(link, np.asarray(direction, float), is_point=False)

    def frame(self, link: str, pose: pin.SE3) -> tuple[int, pin.SE3]:
        """Return the joint of a frame given in that of a link, and its pose in the joint's frame [m].

        Raises:
            UnknownNameError: No such link.
        """
        joint, placement = self._placement(link)
        return joint, pin.SE3(self._turns[joint], np.zeros(3)).actInv(placement * pose)

    def moved(self, first: int, second: int = 0) -> tuple[int, ...]:
        """Return the planned joints that move one joint's frame relative to another's, the world's by default."""
        arrays, sides = self.tables.arrays, []
        for joint in (first, second):
            above, k = set(), joint
            while k > 0:
                above.add(k)
                k = int(arrays.joint_parent[k])
            sides.append(above)
        planned = {int(arrays.joint_source[k]) for k in sides[0] ^ sides[1]}
        return tuple(sorted(planned - {-1}))

    def inverse(self, targets: Sequence[Target], fixed: Sequence[int] | NDArray[np.intp] = ()) -> IKSolver:
        """Return the inverse kinematics of targets; the planned joints with indices ``fixed`` are not moved."""
        return IKSolver(self.tables, targets, fixed)

    def _fixed(self, link: str, vector: Array, *, is_point: bool) -> FixedVector:
        key = link, vector.tobytes(), is_point
        found = self._vectors.get(key)
        if found is None:
            joint, placement = self._placement(link)
            inside = placement.act(vector) if is_point else placement.rotation @ vector
            found = FixedVector(joint, self._turns[joint].T @ inside)
            if len(self._vectors) >= MOST_VECTORS:
                self._vectors.clear()
            self._vectors[key] = found
        return found

    def _placement(self, link: str) -> tuple[int, pin.SE3]:
        if link not in self._placements:
            raise UnknownNameError("link", link, self._placements)
        return self._placements[link]


_known: WeakKeyDictionary[Robot, Links] = WeakKeyDictionary()
_lock = ProcessLock()
