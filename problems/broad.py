"""The suites ``broad``, to train with, and ``unseen``, never trained: their levels, and the drawing of their problems.

A grammar is a small program that places, repeats, tilts, mirrors, nests, cuts and bends parts, and names places that
hands are sent to. Each grammar is a level: those of furniture, containers, panels, single curved objects and scattered
solids make up ``broad``; those of networks, tunnels, trees, helices, nets, machines and frameworks ``unseen``.

Hands are sent to the places of a composition that stands somewhere, or the composition is put where the palms pass on
the straight line. Parts that are nearer than 1 cm to start or goal are left out. A problem is drawn anew until it is as
hard as was wanted, or else the hardest of some is taken.

Two levels of ``broad`` have few obstacles and no grammar. ``broad/free`` goes between two free states with the hands in
wide regions; ``broad/alignment`` goes from a random start to an aligned goal with objects in both hands. Up to twelve
primitives keep a margin to start and goal; about half of them are near the motion of the palms along the straight line.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from apex_ompl.goals.state_sampling import HandPoseSampler, Interval, scene_kernel
from apex_ompl.kernel import Kernel, RobotTables
from apex_ompl.problems import alignment
from apex_ompl.problems.broad_furniture import FURNITURE
from apex_ompl.problems.broad_parts import Composition, Grammar, Parts, extents, kept, place, shift, site, turn
from apex_ompl.problems.broad_representation import Representation, draw_representation, feasible, obstacles
from apex_ompl.problems.broad_structures import STRUCTURES, solid
from apex_ompl.problems.broad_tasks import (
    EndSampler,
    Held,
    clear_parts,
    difficulty,
    draw_held,
    scene_of,
    tips_on_line,
)
from apex_ompl.problems.broad_unseen import STRANGERS
from apex_ompl.problems.objects import primitive
from apex_ompl.problems.robot_cells import Cell, standard_cell
from apex_ompl.problems.suite_robot import MARGIN, DrawnProblem
from apex_ompl.scene.bodies import AttachedObject, Obstacle
from apex_ompl.types import Array

SIMPLE_LEVELS = ("free", "alignment")
MAX_OBSTACLES = 12
SIMPLE_SIZE = (0.04, 0.3)  # edges and diameters [m]
SIMPLE_LOW, SIMPLE_HIGH = (0.05, -0.9, 0.05), (0.85, 0.9, 1.0)  # box of the positions that are not near the palms [m]
PALM_SPREAD = 0.2  # standard deviation of the other positions around those of the palms [m]
ATTEMPTS = 5  # positions tried for an obstacle
LINE_STATES = 7  # states between start and goal at which the palms are looked up
SUITE, UNSEEN = "broad", "unseen"
MOST_OBSTACLES = 300
WANTED = (0.05, 0.2, 0.4, 0.35)  # shares of the classes of difficulty that are wanted
TRIES = 10  # drawn for one problem at most
ROUNDING = 5e-4  # by which rounding may move a surface [m]
MIRRORED, SECOND, SPRINKLED = 0.4, 0.2, 0.35  # shares of scenes with a mirror image, another one, loose solids
MET, ALIGNED = 0.35, 0.05  # shares of compositions that are put in the way, and of aligned ends
MOST_LOOSE = 25
LOW, HIGH = np.array([-0.4, -1.3, 0.0]), np.array([1.25, 1.3, 1.5])  # parts outside are left out [m]
LEAST_MOTION = 0.4  # of some joint from start to goal [rad]


def draw_simple(
    rng: np.random.Generator, level: str, synergies: Interval, cell: Cell | None = None
) -> DrawnProblem | None:  # fmt: skip
    """Draw a problem; None when this draw has no start or no goal.

    Args:
        rng: Source of everything.
        level: One of ``SIMPLE_LEVELS``; ``alignment`` is for the robot of the suites alone.
        synergies: Interval of the synergies of empty hands.
        cell: The robot's cell, by default that of the suites.
    """
    cell = cell or standard_cell()
    attached: tuple[AttachedObject, ...] = ()
    if level == "alignment":
        suite = sorted(alignment.SAMPLERS)[int(rng.integers(len(alignment.SAMPLERS)))]
        bare = alignment.draw(rng, suite, "free")
        if bare is None:
            return None
        ends, attached = np.stack([bare.start, bare.goal]), bare.attached
        tables = next(s().tables for s in alignment.SAMPLERS[suite] if s().attached == attached)
    else:
        tables = cell.tables.whole
        poses = HandPoseSampler(cell.tables, (), MARGIN)
        regions = [cell.wide_region(arm) for arm in range(len(cell.arms))]
        start, goal = (poses.sample(rng, regions, synergies) for _ in range(2))
        if start is None or goal is None:
            return None
        ends = _turned(start, goal, cell)
    scene = _draw_obstacles(rng, cell, tables, ends)
    return DrawnProblem(scene, ends[0], ends[1], attached)


def _draw_obstacles(rng: np.random.Generator, cell: Cell, tables: RobotTables, ends: Array) -> tuple[Obstacle, ...]:
    """Return obstacles that keep ``MARGIN`` to the robot at start and goal, ``ends`` of shape (2, dof)."""
    palms = tips_on_line(cell, tables, ends, LINE_STATES)
    scene: list[Obstacle] = []
    for k in range(int(rng.integers(MAX_OBSTACLES + 1))):
        for _ in range(ATTEMPTS):
            center = rng.uniform(SIMPLE_LOW, SIMPLE_HIGH)
            if rng.integers(2):
                center = palms[int(rng.integers(len(palms)))] + rng.normal(0.0, PALM_SPREAD, 3)
            size, quaternion = rng.uniform(*SIMPLE_SIZE, 3), rng.normal(size=4)
            kind = int(rng.integers(4))
            # Data sets refer to problems by their content, these names included.
            obstacle = cell.obstacle(primitive(f"thing_{k}", kind, size, np.maximum(center, SIMPLE_LOW), quaternion))
            if (scene_kernel(cell.robot, tables, [obstacle]).clearance(ends, MARGIN)[:, 0] >= MARGIN).all():
                scene.append(obstacle)
                break
    return tuple(scene)


GRAMMARS: Mapping[str, Mapping[str, Grammar]] = MappingProxyType({
    SUITE: MappingProxyType({**FURNITURE, **STRUCTURES}), UNSEEN: MappingProxyType(STRANGERS),
})  # fmt: skip
"""Suite -> its levels -> grammar."""

LEVELS = {SUITE: (*SIMPLE_LEVELS, *GRAMMARS[SUITE]), UNSEEN: tuple(GRAMMARS[UNSEEN])}


@dataclass(frozen=True, eq=False)
class Candidate:
    """A problem before its difficulty is known.

    Attributes:
        parts: The parts, in the world.
        ends: Start and goal, shape (2, dof).
        held: What the hands hold.
        representation: How the parts are given.
    """

    parts: Parts
    ends: Array
    held: Held
    representation: Representation


def draw(rng: np.random.Generator, suite: str, level: str, cell: Cell | None = None) -> DrawnProblem | None:
    """Draw a problem of a suite and level; None when no draw has a start and a goal.

    Args:
        rng: Source of everything.
        suite: ``broad`` or ``unseen``.
        level: One of its grammars.
        cell: The robot's cell, by default that of the suites.
    """
    wanted, best, hardest = int(rng.choice(len(WANTED), p=WANTED)), None, -1
    held = draw_held(rng, cell)  # once, as tables of the robot that holds something take longest
    for _ in range(TRIES):
        found = _candidate(rng, suite, GRAMMARS[suite][level], held)
        if found is None:
            continue
        kernel = Kernel(found.held.tables.whole, scene_of(found.parts, found.representation.swelling, held.cell))
        measured = difficulty(kernel, found.ends, rng, wanted)
        if measured > hardest:
            best, hardest = found, measured
        if hardest >= wanted:
            break
    if best is None:
        return None
    groups = best.representation.groups(len(best.parts))
    groups = groups if feasible(best.parts, groups) else ()
    return DrawnProblem(obstacles(best.parts), best.ends[0], best.ends[1], best.held.attached, groups)


def _candidate(rng: np.random.Generator, suite: str, grammar: Grammar, held: Held) -> Candidate | None:
    representation, cell = draw_representation(rng), held.cell
    margin = MARGIN + ROUNDING + representation.swelling
    scene = composition(rng, suite, grammar)
    way = rng.random()
    if suite == SUITE and way < ALIGNED and cell is standard_cell():
        held, ends = _aligned(rng)
    else:
        sent = way >= ALIGNED + MET
        sampler = EndSampler(held, cell.outward(scene.parts) if sent else (), scene.places if sent else (), margin)
        ends = _ends(rng, sampler, cell)
    if ends is None or np.abs(ends[0] - ends[1]).max() < LEAST_MOTION:
        return None
    palms = tips_on_line(cell, held.tables.whole, ends, 9)
    if way < ALIGNED + MET:
        scene = in_the_way(rng, scene, palms)
    parts = scene.parts
    if rng.random() < SPRINKLED:
        for _ in range(int(rng.integers(1, MOST_LOOSE + 1))):
            center = palms[int(rng.integers(len(palms)))] + rng.normal(0.0, 0.18, 3)
            parts = [*parts, *place(solid(rng, 0.015, 0.2), shift(*center))]
    parts = clear_parts(cell, held.tables.whole, cell.outward(near(parts)[:MOST_OBSTACLES]), ends, margin)
    return Candidate(parts, ends, held, representation)


def composition(rng: np.random.Generator, suite: str, grammar: Grammar) -> Composition:
    """Return a composition at its site, with its mirror image or another one beside it."""
    bare = grammar(rng)
    first = bare.placed(site(rng, bare))
    share = rng.random()
    if share < MIRRORED:
        second = first.mirrored()
    elif share < MIRRORED + SECOND:
        names = list(GRAMMARS[suite])
        other = GRAMMARS[suite][names[int(rng.integers(len(names)))]](rng)
        second = other.placed(site(rng, other))
    else:
        return first
    return Composition([*first.parts, *second.parts], [*first.places, *second.places])


def _ends(rng: np.random.Generator, sampler: EndSampler, cell: Cell) -> Array | None:
    start = sampler.sample(rng)
    goal = None if start is None else sampler.sample(rng)
    return None if start is None or goal is None else _turned(start, goal, cell)


def _turned(start: Array, goal: Array, cell: Cell) -> Array:
    """Return start and goal, shape (2, dof), the goal after whole turns that bring it near the start."""
    return np.stack([start, np.round(cell.robot.turned_to(goal, start), 6)])


def _aligned(rng: np.random.Generator) -> tuple[Held, Array | None]:
    """Return the objects, the start and the aligned goal of a problem of stacking or insertion."""
    suite = sorted(alignment.SAMPLERS)[int(rng.integers(len(alignment.SAMPLERS)))]
    drawn = alignment.draw(rng, suite, "free")
    attached = () if drawn is None else drawn.attached
    held = Held.of(attached, (0.0, 0.0), (0.0, 0.0))
    return held, None if drawn is None else np.stack([drawn.start, drawn.goal])


def in_the_way(rng: np.random.Generator, scene: Composition, palms: Array) -> Composition:
    """Return a composition moved so that one of its places, or of its parts, is where a palm passes."""
    one = scene.places[int(rng.integers(len(scene.places)))]
    center = one.point if rng.random() < 0.5 else scene.parts[int(rng.integers(len(scene.parts)))].pose[:3, 3]
    to = palms[int(rng.integers(len(palms)))] + rng.normal(0.0, 0.05, 3)
    return scene.placed(shift(*to) @ turn("z", rng.normal(0.0, 0.3)) @ shift(*-center))


def near(parts: Parts) -> Parts:
    """Return those parts that are in the workspace, at least in part."""
    if not parts:
        return parts
    boxes = extents(parts)
    return kept(parts, np.asarray(((boxes[:, 1] > LOW) & (boxes[:, 0] < HIGH)).all(axis=1)))
