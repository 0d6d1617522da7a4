"""The arms of a robot: serial chains of planned joints, their bases, tips and reach.

An arm is a group of the robot file whose joints follow one another. Groups that share joints without one containing the
other, as two arms on one torso do, are left out in favor of the largest groups inside of them. A robot without such
groups has one arm for each joint that moves no other planned joint: the joints above it that move no other such joint.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from apex_ompl.constraints.links import Links
from apex_ompl.errors import RobotError
from apex_ompl.kernel import Kernel
from apex_ompl.kernel.scene_builder import scene_tables
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import Vector
from apex_ompl.types import Array
from apex_ompl.util.cache import weakly_cached

LEAST_JOINTS = 2  # of an arm
POINTED = 5  # joints from which an arm can reach a point with its fingers in a given direction
REACH_STATES = 4096  # random states among which the reach of an arm is the largest distance of its tip
DOWNWARD = -0.5  # vertical part of the axis of a first joint, below which the arm hangs


@dataclass(frozen=True, eq=False)
class Arm:
    """A serial chain of planned joints with a tip that can be sent to places.

    Attributes:
        name: Name of its group, or of its last joint.
        chain: Indices of its joints into a state, from the base to the tip.
        joints: Indices of these and of the planned joints beyond, such as those of its hand, ascending.
        link: Link that the tip is fixed to: the palm of its hand, or the link of its last joint.
        point: The tip in the frame of the link [m].
        fingers: Unit direction that points out of the tip, in the frame of the link.
        hand: Name of its hand; None where the robot file gives none.
        base: Position of the first joint at home, shape (3,) [m].
        tip: Position of the tip at home, shape (3,) [m].
        hangs: Whether the axis of the first joint points down.
        reach: Largest distance of the tip from the base among random states [m].
    """

    name: str
    chain: tuple[int, ...]
    joints: tuple[int, ...]
    link: str
    point: Vector
    fingers: Vector
    hand: str | None
    base: Array
    tip: Array
    hangs: bool
    reach: float

    @property
    def is_pointed(self) -> bool:
        """Whether the arm has joints enough for a point and a direction."""
        return len(self.chain) >= POINTED


@weakly_cached
def arms_of(robot: Robot) -> tuple[Arm, ...]:
    """Return the arms of a robot, in the order of their groups.

    Raises:
        RobotError: There are no arms.
    """
    tree = _Tree(robot)
    chains = tree.groups() or tree.branches()
    if not chains:
        expected = f"a group of {LEAST_JOINTS} or more joints that follow one another"
        raise RobotError(f"robot {robot.name!r} has no arms; expected {expected}")
    states = robot.random_state(np.random.default_rng(0), REACH_STATES)
    states[0] = robot.home
    frames = Kernel(Links.of(robot).tables, scene_tables([])).joint_frames(states)
    return tuple(_arm(robot, tree, name, chain, frames) for name, chain in chains.items())


def _arm(robot: Robot, tree: _Tree, name: str, chain: tuple[int, ...], frames: tuple[Array, Array]) -> Arm:
    beyond = [k for k in range(robot.dof) if chain[-1] in tree.above[k]]
    hand = next((h for h, record in robot.hands.items() if tree.carries(chain[-1], record.palm)), None)
    if hand is not None:
        record = robot.hands[hand]
        tip = record.palm, record.point, record.fingers
    else:
        tip = tree.tip(chain[-1])
    rotation, origin = frames
    end = Links.of(robot).point(tip[0], tip[1])
    points = rotation[:, end.joint] @ np.asarray(end.vector) + origin[:, end.joint]
    first = Links.of(robot).point(tree.link(chain[0]), (0.0, 0.0, 0.0)).joint
    base, hangs = origin[:, first], bool(rotation[0, first, 2, 2] < DOWNWARD)
    reach = float(np.linalg.norm(points - base, axis=1).max())
    return Arm(name, chain, tuple(sorted({*chain, *beyond})), *tip, hand, base[0], points[0], hangs, reach)


class _Tree:
    """Planned joints of a robot as a tree.

    Attributes:
        above: The planned joints that move each planned joint, itself among them, from the base.
    """

    def __init__(self, robot: Robot) -> None:
        self._robot, model = robot, robot.model
        self._joint = [int(model.getJointId(name)) for name in robot.joint_names]
        number = {joint: k for k, joint in enumerate(self._joint)}
        self.above = [tuple(number[int(j)] for j in model.supports[joint] if int(j) in number) for joint in self._joint]

    def groups(self) -> dict[str, tuple[int, ...]]:
        """Return name -> joints of the groups that are arms."""
        chains = dict[str, tuple[int, ...]]()
        for name, group in self._robot.groups.items():
            ordered = tuple(sorted((int(k) for k in group), key=lambda k: len(self.above[k])))
            serial = all(a in self.above[b] for a, b in itertools.pairwise(ordered))
            if len(ordered) >= LEAST_JOINTS and serial and ordered not in chains.values():
                chains[name] = ordered
        sets = {name: set(chain) for name, chain in chains.items()}
        clear = {
            name for name, mine in sets.items() if all(not mine & other or mine <= other or other <= mine
            for other in sets.values())
        }  # fmt: skip
        return {n: chains[n] for n in chains if n in clear and not any(sets[n] < sets[other] for other in clear)}

    def branches(self) -> dict[str, tuple[int, ...]]:
        """Return the name of the last joint -> joints that move it and no other last joint."""
        count = len(self.above)
        last = [k for k in range(count) if not any(k in self.above[j] for j in range(count) if j != k)]
        chains = {}
        for end in last:
            chain = tuple(k for k in self.above[end] if not any(k in self.above[j] for j in last if j != end))
            if len(chain) >= LEAST_JOINTS:
                chains[self._robot.joint_names[end]] = chain
        return chains

    def carries(self, joint: int, link: str) -> bool:
        """Whether a planned joint moves a link."""
        model = self._robot.model
        return self._joint[joint] in [
            int(j) for j in model.supports[model.frames[self._robot.link_frame(link)].parentJoint]
        ]

    def link(self, joint: int) -> str:
        """Return the first link that is fixed to a planned joint."""
        frames = self._robot.model.frames
        return next(str(f.name) for f in frames if f.type == pin.FrameType.BODY and f.parentJoint == self._joint[joint])

    def tip(self, joint: int) -> tuple[str, Vector, Vector]:
        """Return the link of an arm's last joint, and the middle and normal of the farthest side of all it moves.

        That is the box, along the axes of the joint, around the solids that it moves at home and the origins of their
        links.
        """
        robot, mine = self._robot, self._joint[joint]
        model, geometry = robot.model, robot.geometry
        data, places = model.createData(), geometry.createData()
        pin.framesForwardKinematics(model, data, robot.to_pinocchio(robot.home))
        pin.updateGeometryPlacements(model, data, geometry, places)
        points = [data.oMf[k].translation for k, f in enumerate(model.frames)
                  if f.type == pin.FrameType.BODY and mine in model.supports[f.parentJoint]]  # fmt: skip
        for k, item in enumerate(geometry.geometryObjects):
            if mine in model.supports[item.parentJoint]:
                item.geometry.computeLocalAABB()
                box = item.geometry.aabb_local
                corners = itertools.product(*zip(box.min_, box.max_, strict=True))
                points += [places.oMg[k].act(np.array(corner)) for corner in corners]
        local = np.array([data.oMi[mine].actInv(point) for point in points])
        low, high = local.min(axis=0), local.max(axis=0)
        side, end = (low, -1.0) if np.max(-low) > np.max(high) else (high, 1.0)
        axis = int(np.argmax(end * side))
        point, normal = (low + high) / 2.0, end * np.eye(3)[axis]
        point[axis] = side[axis]
        name = self.link(joint)
        placement = model.frames[robot.link_frame(name)].placement
        found = placement.actInv(point), placement.rotation.T @ normal
        (x, y, z), (u, v, w) = (np.round(values, 6).tolist() for values in found)
        return name, (x, y, z), (u, v, w)
