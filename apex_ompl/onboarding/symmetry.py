"""Mirror symmetry of a robot in the plane y = 0, by its kinematics, the bodies of its arms, and its limits.

Each arm is the image of an arm, of itself or of another one. Joint by joint from the base, the image of a state is
searched for whose joints are where the mirrored joints are: a joint turns one way or the other, and is shifted by a
multiple of a right angle. Of several such images the one is taken whose home is nearest to home. Hands are compared by
their frames, bodies by the balls around their sphere covers. Links of the robots that pass are not exactly symmetric:
images of paths are checked against limits and self-collision when they are made.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from apex_ompl.constraints.links import Links
from apex_ompl.goals.arms import Arm
from apex_ompl.kernel import Kernel
from apex_ompl.kernel.arrays import REVOLUTE
from apex_ompl.kernel.scene_builder import scene_tables
from apex_ompl.problems.robot_cells import Cell
from apex_ompl.types import Array

MIRROR = np.array([1.0, -1.0, 1.0])
TOLERANCE = 2e-3  # of positions of joints [m], and of their axes
HAND_TOLERANCE = 0.02  # of grasp points [m], and of directions of hands
BODY_TOLERANCE = 0.08  # of the centers and radii of balls around bodies, as a share of the reach
EMPTY = np.empty((0, 2, 3))
STATES = 4  # random states at which joints are compared
SHIFTS = (0.0, np.pi / 2, -np.pi / 2, np.pi)
WHOLE = 0.7  # share of each joint's range whose images must be within the limits


class _Image(NamedTuple):
    """Where the value of a joint comes from: ``sign * q[order] + shift``."""

    order: int
    sign: int
    shift: float


def mirror_of(cell: Cell) -> dict[str, Sequence[float]] | None:
    """Return the fields of a :class:`~apex_ompl.training.data.Mirror` for a robot; None where it has no symmetry."""
    search = _Search(cell)
    if not search.fixtures_agree():
        return None
    images = dict[int, _Image]()
    for k in cell.tables.others:  # such a joint is its own image, or there is none
        images[k] = _Image(k, 1, 0.0)
    for arm in cell.arms:
        partner = next((one for one in cell.arms if search.are_bases(arm, one)), None)
        found = None if partner is None else search.images(arm, partner)
        if found is None:
            return None
        images |= found
    rows = [images[k] for k in range(cell.robot.dof)]
    if sorted(row.order for row in rows) != list(range(cell.robot.dof)) or not search.is_symmetric(rows):
        return None
    order, sign, shift = zip(*rows, strict=True)
    return {"order": order, "sign": sign, "shift": shift}


class _Search:
    """Search for the images of the joints of arms, at random states of a robot."""

    def __init__(self, cell: Cell) -> None:
        self._cell, self._robot = cell, cell.robot
        self._kernel = Kernel(cell.tables.whole, scene_tables([]))
        self._states = self._robot.random_state(np.random.default_rng(0), STATES)
        self._frames = self._kernel.joint_frames(self._states)
        source = self._kernel.robot.arrays.joint_source
        self._joint = [int(np.flatnonzero(source == k)[0]) for k in range(self._robot.dof)]

    def fixtures_agree(self) -> bool:
        """Whether each fixture is where the mirrored one of another, or of itself, is, by the boxes around them."""
        boxes = np.concatenate([np.asarray(solids.box).reshape(-1, 2, 3) for solids in self._cell.fixtures] or [EMPTY])
        mirrored = boxes * MIRROR
        mirrored[:, :, 1] = mirrored[:, ::-1, 1]
        gaps = np.abs(boxes[:, None] - mirrored[None]).max(axis=(2, 3))
        return not len(boxes) or float(gaps.min(axis=1).max()) < HAND_TOLERANCE

    def are_bases(self, arm: Arm, other: Arm) -> bool:
        """Whether the base of an arm is where the mirrored base of another one is, and both have as many joints."""
        alike = len(arm.joints) == len(other.joints) and len(arm.chain) == len(other.chain)
        return alike and bool(np.abs(arm.base - MIRROR * other.base).max() < TOLERANCE)

    def images(self, arm: Arm, other: Arm) -> dict[int, _Image] | None:
        """Return the images of the joints of an arm, whose values come from those of the other one; None without."""
        beyond = {k: _Image(j, 1, 0.0) for k, j in zip(arm.joints, other.joints, strict=True) if k not in arm.chain}
        found = [rows | beyond for rows in self._chains(arm, other, {})]
        agreed = [rows for rows in found if self._hands_agree(arm, other, rows)]
        agreed = [rows for rows in agreed if self._bodies_agree(arm, other, rows)]
        return min(agreed, key=self._far_from_home, default=None)

    def _far_from_home(self, rows: dict[int, _Image]) -> float:
        home = self._robot.home
        return max(float(abs(sign * home[order] + shift - home[k])) for k, (order, sign, shift) in rows.items())

    def _hands_agree(self, arm: Arm, other: Arm, rows: dict[int, _Image]) -> bool:
        """Whether the hand of an arm is where the mirrored hand of the other one is, or neither has one."""
        if arm.hand is None or other.hand is None:
            return arm.hand is other.hand
        frames, links = self._kernel.joint_frames(self._imaged(rows)), Links.of(self._robot)
        for name in ("point", "axis", "fingers"):
            found = []
            for (rotation, origin), one in ((frames, arm), (self._frames, other)):
                hand = self._robot.hands[str(one.hand)]
                fixed = links.point(hand.palm, hand.point) if name == "point" else links.direction(
                    hand.palm, getattr(hand, name)
                )  # fmt: skip
                place = rotation[:, fixed.joint] @ np.asarray(fixed.vector)
                found.append(place + origin[:, fixed.joint] if name == "point" else place)
            if np.abs(found[0] - MIRROR * found[1]).max() > HAND_TOLERANCE:
                return False
        return True

    def _chains(self, arm: Arm, other: Arm, rows: dict[int, _Image]) -> Iterator[dict[int, _Image]]:
        """Yield the ways in which joints of an arm follow those of the other one, ``rows`` being the first of them."""
        place = len(rows)
        if place == len(arm.chain):
            yield rows
            return
        mine, theirs = arm.chain[place], other.chain[place]
        sign = self._sign(mine, theirs, rows)
        if sign is None:
            return
        turns = self._kernel.robot.arrays.joint_kind[self._joint[mine]] == REVOLUTE
        for shift in SHIFTS if turns else (0.0,):
            yield from self._chains(arm, other, rows | {mine: _Image(theirs, sign, shift)})

    def _sign(self, mine: int, theirs: int, rows: dict[int, _Image]) -> int | None:
        """Return how a joint follows another one, by its place and axis; None where these are no mirror images."""
        rotation, origin = self._kernel.joint_frames(self._imaged(rows))
        place, axis = origin[:, self._joint[mine]], rotation[:, self._joint[mine], :, 2]
        wanted = MIRROR * self._frames[1][:, self._joint[theirs]]
        mirrored = MIRROR * self._frames[0][:, self._joint[theirs], :, 2]
        if np.abs(place - wanted).max() > TOLERANCE:
            return None
        turns = -1 if self._kernel.robot.arrays.joint_kind[self._joint[mine]] == REVOLUTE else 1
        for sign in (1, -1):  # the mirror image of a rotation by an angle is one by its negative
            if np.abs(axis - turns * sign * mirrored).max() < TOLERANCE:
                return sign
        return None

    def _imaged(self, rows: dict[int, _Image]) -> Array:
        """Return the images of the states, joints without an image being as they are."""
        states = self._states.copy()
        for k, (order, sign, shift) in rows.items():
            states[:, k] = sign * self._states[:, order] + shift
        return states

    def _bodies_agree(self, arm: Arm, other: Arm, rows: dict[int, _Image]) -> bool:
        """Whether the bodies of an arm are where the mirrored ones of the other one are."""
        mine, theirs = (self._balls(one, q) for one, q in ((arm, self._imaged(rows)), (other, self._states)))
        if len(mine) != len(theirs) or not len(mine):
            return False
        wanted = theirs * (1.0, -1.0, 1.0, 1.0)
        gaps = np.abs(mine[:, None] - wanted[None]).max(axis=(2, 3))  # of every ball to every other one
        return float(max(gaps.min(axis=1).max(), gaps.min(axis=0).max())) < BODY_TOLERANCE * arm.reach

    def _balls(self, arm: Arm, states: Array) -> Array:
        """Return the balls around the clusters of bodies that an arm moves, shape (clusters, states, 4) [m]."""
        a, moved = self._kernel.robot.arrays, {self._joint[k] for k in arm.joints}
        for joint in range(len(a.joint_parent)):  # parents come first
            if joint and int(a.joint_parent[joint]) in moved:
                moved.add(joint)
        clusters = [c for c, joint in enumerate(a.cluster_joint) if int(joint) in moved]
        rotation, origin = self._kernel.joint_frames(states)
        rows = []
        for c in clusters:
            joint, ball = int(a.cluster_joint[c]), a.cluster_ball[c]
            centers = rotation[:, joint] @ ball[:3] + origin[:, joint]
            rows.append(np.column_stack([centers, np.full(len(states), ball[3])]))
        return np.array(rows)

    def is_symmetric(self, rows: Sequence[_Image]) -> bool:
        """Whether images of states are mostly within the limits, and images of images the states themselves."""
        limits, order = self._robot.limits, [row.order for row in rows]
        sign, shift = np.array([row.sign for row in rows]), np.array([row.shift for row in rows])
        states = self._states
        for _ in range(2):
            states = sign * states[:, order] + shift
        full = np.abs(np.angle(np.exp(1j * (states - self._states))))
        ends = np.sort(sign * np.stack([limits.lower, limits.upper])[:, order] + shift, axis=0)
        inside = np.minimum(ends[1], limits.upper) - np.maximum(ends[0], limits.lower)
        span = np.minimum(limits.upper - limits.lower, ends[1] - ends[0])
        return bool(full.max() < TOLERANCE and (inside >= WHOLE * span).all())
