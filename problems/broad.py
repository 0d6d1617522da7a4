"""Problems of no suite, for training: any poses of the hands among any few things.

``broad/free`` goes between free poses of the hands, ``broad/alignment`` from a random start to an aligned goal with
objects in the hands. Up to twelve primitives stand where they leave start and goal a margin, half of them near the
hands' way.
"""

from __future__ import annotations

import numpy as np

from apex_ompl.problems import alignment
from apex_ompl.problems.outline import Outline
from apex_ompl.problems.reach import MARGIN, HandPoses, Range, Region, bare_tables, robot, scene_kernel
from apex_ompl.problems.scenes import DOWN, FORWARD, primitive
from apex_ompl.scene.bodies import AttachedObject, Obstacle
from apex_ompl.tasks.inverse_kinematics import Links

SUITE = "broad"
LEVELS = ("free", "alignment")
MOST_THINGS = 12
SIZE = (0.04, 0.3)  # edges and diameters [m]
LOW, HIGH = (0.05, -0.9, 0.05), (0.85, 0.9, 1.0)  # where things are drawn that are not near the hands' way [m]
ASIDE = 0.2  # of things near the hands' way [m]
TRIES = 5  # for a place of one thing
UP, INWARD, OUTWARD = (0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (0.0, 1.0, 0.0)


def draw(rng: np.random.Generator, level: str, hands: Range) -> Outline | None:
    """Draw a problem, or None when this draw does not work out; ``hands`` is the range of empty hands' synergies."""
    attached: tuple[AttachedObject, ...] = ()
    if level == "alignment":
        suite = sorted(alignment.HOLDINGS)[int(rng.integers(len(alignment.HOLDINGS)))]
        bare = alignment.draw(rng, suite, "free")
        if bare is None:
            return None
        ends, attached = np.stack([bare.start, bare.goal]), bare.attached
        tables = next(h().tables for h in alignment.HOLDINGS[suite] if h().attached == attached)
    else:
        poses, tables = HandPoses(()), bare_tables()
        found = [poses.draw(rng, (_anywhere(0.35), _anywhere(-0.35)), hands) for _ in range(2)]
        if found[0] is None or found[1] is None:
            return None
        ends = np.stack([q for q in found if q is not None])
    names = robot().hands.values()
    line = np.linspace(ends[0], ends[1], 9)[1:-1]
    links = Links.of(robot())
    palms = [links.point(hand.palm, hand.point) for hand in names]
    turn, origin = scene_kernel(tables, ()).joint_frames(line)
    ways = np.concatenate([turn[:, p.joint] @ np.asarray(p.vector) + origin[:, p.joint] for p in palms])
    scene: list[Obstacle] = []
    for k in range(int(rng.integers(MOST_THINGS + 1))):
        for _ in range(TRIES):
            centre = rng.uniform(LOW, HIGH)
            if rng.integers(2):
                centre = ways[int(rng.integers(len(ways)))] + rng.normal(0.0, ASIDE, 3)
            size, turn = rng.uniform(*SIZE, 3), rng.normal(size=4)
            thing = primitive(f"thing_{k}", int(rng.integers(4)), size, np.maximum(centre, LOW), turn)
            if (scene_kernel(tables, [thing]).clearance(ends, MARGIN)[:, 0] >= MARGIN).all():
                scene.append(thing)
                break
    return Outline(tuple(scene), ends[0], ends[1], attached)


def _anywhere(y: float) -> Region:
    """Return where the hand of the arm at a side may be: over its own table and half of the other's."""
    return Region((0.25, 0.75), (y - 0.5, y + 0.5), (0.1, 0.8), (DOWN, FORWARD, UP, INWARD, OUTWARD))
