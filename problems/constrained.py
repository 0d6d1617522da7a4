"""Levels with constraints: ``tray``, ``level`` and ``cups`` of some suites.

On ``tray`` both hands hold one tray, so that their relative pose stays as at the start. On ``level`` a cup stands on
the tray, which also stays level. On ``cups`` each hand keeps a cup upright. Cups go through the scenes of the suites
themselves, trays through those of :mod:`apex_ompl.problems.constrained_scenes`. On ``unseen`` the grammars of that
suite take turns by the seed; their composition stands somewhere, or where the hands pass, without the parts that are
too near to the start or to the goal.

Starts and goals are on the constraint, and free by a margin; of the goal's states on many branches of inverse
kinematics the nearest one to the start is taken, and trees without obstacles join the two. Of most problems the
straight line, moved to the constraint, collides.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from apex_ompl.goals.state_sampling import HandRegion, scene_kernel
from apex_ompl.kernel import SceneTables
from apex_ompl.problems import constrained_scenes, scenes
from apex_ompl.problems.broad import MOST_OBSTACLES, ROUNDING, UNSEEN, composition, in_the_way, near
from apex_ompl.problems.broad_representation import Group, draw_representation, feasible, obstacles
from apex_ompl.problems.broad_tasks import clear_parts, scene_of, tips_on_line
from apex_ompl.problems.broad_unseen import STRANGERS
from apex_ompl.problems.constrained_ends import PalmSampler, are_joined, line_is_free, palms_at, palms_with_cups
from apex_ompl.problems.constrained_held import CUPS, KINDS, Carried, draw_carried
from apex_ompl.problems.robot_cells import SHOULDERS, standard_cell
from apex_ompl.problems.suite_robot import MARGIN, DrawnProblem, robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.types import Array

SUITES = (*constrained_scenes.SCENES, UNSEEN)
LEVELS = dict.fromkeys(SUITES, KINDS)
"""Suite -> its levels with constraints."""

LEAST_MOTION, MOST_MOTION = 0.5, 3.5  # of the joint that moves most from start to goal [rad]
ANY_LINE = 7  # of so many problems one may have a straight line that is free
MET = 0.6  # share of compositions that are put in the way
YAW = 0.6  # largest yaw of the fingers of a hand that is not sent along a direction [rad]
JITTER = 0.15  # largest yaw of the fingers of one that is [rad]


def draw(rng: np.random.Generator, suite: str, kind: str, seed: int) -> DrawnProblem | None:
    """Draw a problem of a suite; None when this draw has no start or no goal, or its straight line is free.

    Args:
        rng: Source of everything but the grammar.
        suite: One of ``SUITES``.
        kind: One of ``KINDS``, the level.
        seed: Of the problem, by which grammars take turns; of every ``ANY_LINE``-th one the straight line may be free.
    """
    carried = draw_carried(rng, kind)
    if suite == UNSEEN:
        found = _among_parts(rng, carried, kind, tuple(STRANGERS)[seed % len(STRANGERS)])
    elif kind == CUPS:
        task = scenes.SUITES[suite](rng, str(rng.choice(scenes.LEVELS[suite])))
        ends = _cup_ends(rng, carried, _tables(task.scene, carried), task.start, task.goal)
        found = None if ends is None else _drawn(carried, task.scene, ends)
    else:
        found = _with_tray(rng, carried, suite, kind)
    if found is not None and kind != CUPS and not are_joined(carried, np.stack([found.start, found.goal])):
        return None
    if found is None or seed % ANY_LINE == 0:
        return found
    is_free = line_is_free(carried, _tables(found.scene, carried), np.stack([found.start, found.goal]))
    return None if is_free else found


def _drawn(
    carried: Carried, scene: tuple[Obstacle, ...], ends: Array, groups: tuple[Group, ...] = ()
) -> DrawnProblem:  # fmt: skip
    return DrawnProblem(scene, ends[0], ends[1], carried.held.attached, groups, carried.constraints)


def _tables(scene: Sequence[Obstacle], carried: Carried) -> SceneTables:
    return scene_kernel(robot(), carried.held.tables.whole, scene).scene


def _with_tray(rng: np.random.Generator, carried: Carried, suite: str, kind: str) -> DrawnProblem | None:
    assert carried.tray is not None
    task = constrained_scenes.SCENES[suite](rng, kind, carried.tray)
    loose = suite == "clutter"  # what is too near to an end is left out
    scene = scene_of(()) if loose else _tables(task.scene, carried)
    ends = _tray_ends(rng, carried, scene, task.start, task.goal)
    if ends is None:
        return None
    kept = tuple(body for body in task.scene if not loose or _keeps_clear(carried, body, ends))
    return _drawn(carried, kept, ends)


def _keeps_clear(carried: Carried, body: Obstacle, ends: Array) -> bool:
    kernel = scene_kernel(robot(), carried.held.tables.whole, [body])
    return bool((kernel.clearance(ends, MARGIN)[:, 0] >= MARGIN).all())


def _among_parts(rng: np.random.Generator, carried: Carried, kind: str, grammar: str) -> DrawnProblem | None:
    """Draw a problem among the parts of a grammar of ``unseen``."""
    representation = draw_representation(rng)
    ends = _ends_anywhere(rng, carried, kind, scene_of(()))
    if ends is None:
        return None
    found, tables = composition(rng, UNSEEN, STRANGERS[grammar]), carried.held.tables.whole
    if rng.random() < MET:
        found = in_the_way(rng, found, tips_on_line(standard_cell(), tables, ends, 9))
    margin = MARGIN + ROUNDING + representation.swelling
    parts = clear_parts(standard_cell(), tables, near(found.parts)[:MOST_OBSTACLES], ends, margin)
    groups = representation.groups(len(parts))
    return _drawn(carried, obstacles(parts), ends, groups if feasible(parts, groups) else ())


def _ends_anywhere(rng: np.random.Generator, carried: Carried, kind: str, scene: SceneTables) -> Array | None:
    if kind == CUPS:
        regions = [(_wide_region(0), _wide_region(1)) for _ in range(2)]
        return _cup_ends(rng, carried, scene, *regions)
    poses = [constrained_scenes.anywhere(rng, kind) for _ in range(2)]
    return _tray_ends(rng, carried, scene, *poses)


def _wide_region(side: int) -> HandRegion:
    """Return the region of a hand over its own table and a part of the other one."""
    middle = 0.6 * SHOULDERS[side]
    return HandRegion((0.3, 0.7), (middle - 0.35, middle + 0.35), (0.12, 0.65), (scenes.DOWN,))


def _tray_ends(
    rng: np.random.Generator, carried: Carried, scene: SceneTables, start: Array, goal: Array
) -> Array | None:  # fmt: skip
    """Return start and goal, shape (2, dof), with a tray at two poses."""
    return _ends(rng, carried, scene, palms_at(carried, start), palms_at(carried, goal))


def _cup_ends(
    rng: np.random.Generator, carried: Carried, scene: SceneTables, start: scenes.RegionPair, goal: scenes.RegionPair
) -> Array | None:  # fmt: skip
    """Return start and goal, shape (2, dof), with upright cups in regions of the hands."""
    palms = []
    for regions in (start, goal):
        points, yaws = zip(*(_level_hand(rng, region) for region in regions), strict=True)
        palms.append(palms_with_cups(points, yaws))
    return _ends(rng, carried, scene, palms[0], palms[1])


def _level_hand(rng: np.random.Generator, region: HandRegion) -> tuple[Array, float]:
    """Return a grasp point of a region, and the yaw of level fingers: those of the region, or any that are forward."""
    level = [fingers for fingers in region.fingers if fingers[2] == 0.0]
    point, _ = region.sample(rng)
    if not level:
        return point, float(rng.uniform(-YAW, YAW))
    x, y, _ = level[int(rng.integers(len(level)))]
    return point, float(np.arctan2(y, x) + rng.uniform(-JITTER, JITTER))


def _ends(
    rng: np.random.Generator, carried: Carried, scene: SceneTables, start: Sequence[Array], goal: Sequence[Array]
) -> Array | None:  # fmt: skip
    """Return start and goal, shape (2, dof), with the palms at poses: of the goal's states the nearest to the start."""
    sampler = PalmSampler(carried, scene, MARGIN)
    starts = sampler.sample(rng, start)
    if not len(starts):
        return None
    first = starts[int(rng.integers(len(starts)))]
    goals = sampler.sample(rng, goal, near=first)
    if not len(goals):
        return None
    distances = np.abs(goals - first).max(axis=1)
    best = int(distances.argmin())
    return np.stack([first, goals[best]]) if LEAST_MOTION <= distances[best] <= MOST_MOTION else None
