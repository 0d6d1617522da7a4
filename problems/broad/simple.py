"""The levels of ``broad`` that no grammar makes: random scenes with few obstacles, and hands anywhere.

``broad/free`` goes between two free states with the hands in wide regions; ``broad/alignment`` goes from a random start
to an aligned goal with objects in both hands. Up to twelve primitives keep a margin to start and goal; about half of
them are near the motion of the palms along the straight line.
"""

from __future__ import annotations

import numpy as np

from apex_ompl.goals.inverse_kinematics import Links
from apex_ompl.goals.state_sampling import HandPoseSampler, HandRegion, Interval, scene_kernel
from apex_ompl.kernel import RobotTables
from apex_ompl.problems import alignment
from apex_ompl.problems.drawn_problem import MARGIN, DrawnProblem
from apex_ompl.problems.obstacles import primitive
from apex_ompl.problems.scenes import DOWN, FORWARD
from apex_ompl.problems.suite_robot import empty_hand_tables, robot
from apex_ompl.scene.bodies import AttachedObject, Obstacle
from apex_ompl.types import Array

LEVELS = ("free", "alignment")
MAX_OBSTACLES = 12
SIZE = (0.04, 0.3)  # edges and diameters [m]
LOW, HIGH = (0.05, -0.9, 0.05), (0.85, 0.9, 1.0)  # box of the positions that are not near the palms [m]
PALM_SPREAD = 0.2  # standard deviation of the other positions around those of the palms [m]
ATTEMPTS = 5  # positions tried for an obstacle
LINE_STATES = 7  # states between start and goal at which the palms are looked up
UP, INWARD, OUTWARD = (0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (0.0, 1.0, 0.0)


def draw(rng: np.random.Generator, level: str, synergies: Interval) -> DrawnProblem | None:
    """Draw a problem; None when this draw has no start or no goal.

    Args:
        rng: Source of everything.
        level: One of ``LEVELS``.
        synergies: Interval of the synergies of empty hands.
    """
    attached: tuple[AttachedObject, ...] = ()
    if level == "alignment":
        suite = sorted(alignment.SAMPLERS)[int(rng.integers(len(alignment.SAMPLERS)))]
        bare = alignment.draw(rng, suite, "free")
        if bare is None:
            return None
        ends, attached = np.stack([bare.start, bare.goal]), bare.attached
        tables = next(s().tables for s in alignment.SAMPLERS[suite] if s().attached == attached)
    else:
        tables = empty_hand_tables().both
        poses = HandPoseSampler(empty_hand_tables(), (), MARGIN)
        found = [poses.sample(rng, (_wide_region(0.35), _wide_region(-0.35)), synergies) for _ in range(2)]
        if found[0] is None or found[1] is None:
            return None
        ends = np.stack([q for q in found if q is not None])
    scene = _draw_obstacles(rng, tables, ends)
    return DrawnProblem(scene, ends[0], ends[1], attached)


def _draw_obstacles(rng: np.random.Generator, tables: RobotTables, ends: Array) -> tuple[Obstacle, ...]:
    """Return obstacles that keep ``MARGIN`` to the robot at start and goal, ``ends`` of shape (2, dof)."""
    palms = _palm_positions(tables, np.linspace(ends[0], ends[1], LINE_STATES + 2)[1:-1])
    scene: list[Obstacle] = []
    for k in range(int(rng.integers(MAX_OBSTACLES + 1))):
        for _ in range(ATTEMPTS):
            center = rng.uniform(LOW, HIGH)
            if rng.integers(2):
                center = palms[int(rng.integers(len(palms)))] + rng.normal(0.0, PALM_SPREAD, 3)
            size, quaternion = rng.uniform(*SIZE, 3), rng.normal(size=4)
            kind = int(rng.integers(4))
            # Data sets refer to problems by their content, these names included.
            obstacle = primitive(f"thing_{k}", kind, size, np.maximum(center, LOW), quaternion)
            if (scene_kernel(robot(), tables, [obstacle]).clearance(ends, MARGIN)[:, 0] >= MARGIN).all():
                scene.append(obstacle)
                break
    return tuple(scene)


def _palm_positions(tables: RobotTables, states: Array) -> Array:
    """Return the grasp points of both hands at states (N, dof), shape (2 N, 3) [m], those of the first hand first."""
    links = Links.of(robot())
    points = [links.point(hand.palm, hand.point) for hand in robot().hands.values()]
    rotation, origin = scene_kernel(robot(), tables, ()).joint_frames(states)
    return np.concatenate([rotation[:, p.joint] @ np.asarray(p.vector) + origin[:, p.joint] for p in points])


def _wide_region(y: float) -> HandRegion:
    """Return the region of the hand of an arm at a side: over its own table and half of the other one."""
    return HandRegion((0.25, 0.75), (y - 0.5, y + 0.5), (0.1, 0.8), (DOWN, FORWARD, UP, INWARD, OUTWARD))
