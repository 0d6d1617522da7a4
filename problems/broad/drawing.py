"""Drawing of problems of the suites ``broad`` and ``unseen``: a grammar's composition, hands, and a wanted difficulty.

Two ways: hands are sent to the places of a composition that stands somewhere, or the composition is put where the palms
pass on the straight line. Parts that are nearer than 1 cm to start or goal are left out. A problem is drawn anew until
it is as hard as was wanted, or else the hardest of some is taken.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from apex_ompl.kernel import Kernel
from apex_ompl.problems import alignment
from apex_ompl.problems.broad.composition import Composition, site
from apex_ompl.problems.broad.difficulty import difficulty
from apex_ompl.problems.broad.ends import EndSampler, clear_parts, palm_line, scene_of
from apex_ompl.problems.broad.held import Held, draw_held
from apex_ompl.problems.broad.levels import GRAMMARS, SUITE, Grammar
from apex_ompl.problems.broad.representation import Representation, draw_representation, feasible, obstacles
from apex_ompl.problems.broad.scattered import solid
from apex_ompl.problems.broad.shapes import Parts, extents, kept, place, shift, turn
from apex_ompl.problems.drawn_problem import MARGIN, DrawnProblem
from apex_ompl.types import Array

MOST_OBSTACLES = 300
WANTED = (0.05, 0.2, 0.4, 0.35)  # shares of the classes of difficulty that are wanted
TRIES = 10  # drawn for one problem at most
ROUNDING = 5e-4  # by which rounding may move a surface [m]
MIRRORED, SECOND, SPRINKLED = 0.4, 0.2, 0.35  # shares of scenes with a mirror image, another one, loose solids
MET, ALIGNED = 0.35, 0.05  # shares of compositions that are put in the way, and of aligned ends
MOST_LOOSE = 25
LOW, HIGH = np.array([-0.4, -1.3, 0.0]), np.array([1.25, 1.3, 1.5])  # parts outside are left out [m]
LEAST_MOTION = 0.4  # of some joint from start to goal [rad]


@dataclass(frozen=True, eq=False)
class Candidate:
    """A problem before its difficulty is known.

    Attributes:
        parts: The parts.
        ends: Start and goal, shape (2, dof).
        held: What the hands hold.
        representation: How the parts are given.
    """

    parts: Parts
    ends: Array
    held: Held
    representation: Representation


def draw(rng: np.random.Generator, suite: str, level: str) -> DrawnProblem | None:
    """Draw a problem of a suite and level; None when no draw has a start and a goal."""
    wanted, best, hardest = int(rng.choice(len(WANTED), p=WANTED)), None, -1
    held = draw_held(rng)  # once, as tables of the robot that holds something take longest
    for _ in range(TRIES):
        found = _candidate(rng, suite, GRAMMARS[suite][level], held)
        if found is None:
            continue
        kernel = Kernel(found.held.tables.both, scene_of(found.parts, found.representation.swelling))
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
    representation = draw_representation(rng)
    margin = MARGIN + ROUNDING + representation.swelling
    scene = _composition(rng, suite, grammar)
    way = rng.random()
    if suite == SUITE and way < ALIGNED:
        held, ends = _aligned(rng)
    else:
        sent = way >= ALIGNED + MET
        sampler = EndSampler(held, scene.parts if sent else (), scene.places if sent else (), margin)
        ends = _ends(rng, sampler)
    if ends is None or np.abs(ends[0] - ends[1]).max() < LEAST_MOTION:
        return None
    palms = palm_line(held.tables.both, ends, 9).reshape(-1, 3)
    if way < ALIGNED + MET:
        scene = _in_the_way(rng, scene, palms)
    parts = scene.parts
    if rng.random() < SPRINKLED:
        for _ in range(int(rng.integers(1, MOST_LOOSE + 1))):
            center = palms[int(rng.integers(len(palms)))] + rng.normal(0.0, 0.18, 3)
            parts = [*parts, *place(solid(rng, 0.015, 0.2), shift(*center))]
    parts = clear_parts(held.tables.both, _near(parts)[:MOST_OBSTACLES], ends, margin)
    return Candidate(parts, ends, held, representation)


def _composition(rng: np.random.Generator, suite: str, grammar: Grammar) -> Composition:
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


def _ends(rng: np.random.Generator, sampler: EndSampler) -> Array | None:
    start = sampler.sample(rng)
    goal = None if start is None else sampler.sample(rng)
    return None if start is None or goal is None else np.stack([start, goal])


def _aligned(rng: np.random.Generator) -> tuple[Held, Array | None]:
    """Return the objects, the start and the aligned goal of a problem of stacking or insertion."""
    suite = sorted(alignment.SAMPLERS)[int(rng.integers(len(alignment.SAMPLERS)))]
    drawn = alignment.draw(rng, suite, "free")
    attached = () if drawn is None else drawn.attached
    held = Held.of(attached, (0.0, 0.0), (0.0, 0.0))
    return held, None if drawn is None else np.stack([drawn.start, drawn.goal])


def _in_the_way(rng: np.random.Generator, scene: Composition, palms: Array) -> Composition:
    """Return a composition moved so that one of its places, or of its parts, is where a palm passes."""
    one = scene.places[int(rng.integers(len(scene.places)))]
    center = one.point if rng.random() < 0.5 else scene.parts[int(rng.integers(len(scene.parts)))].pose[:3, 3]
    to = palms[int(rng.integers(len(palms)))] + rng.normal(0.0, 0.05, 3)
    return scene.placed(shift(*to) @ turn("z", rng.normal(0.0, 0.3)) @ shift(*-center))


def _near(parts: Parts) -> Parts:
    """Return those parts that are in the workspace, at least in part."""
    if not parts:
        return parts
    boxes = extents(parts)
    return kept(parts, np.asarray(((boxes[:, 1] > LOW) & (boxes[:, 0] < HIGH)).all(axis=1)))
