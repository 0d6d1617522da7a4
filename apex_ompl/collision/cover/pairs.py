"""Pairs of links that need no collision check: those that touch always, or by design, and those that never do.

The pairs considered are those that no SRDF lists and whose links stand on the same root part (a hand against itself
and its own arm), never one arm against the other. Three findings disable a pair:

- by design: both links belong to a soft part, a hand whose fingers touch each other and the palm as its synergy closes;
- always: in collision at every random state;
- never: free at every random state, and still ``margin`` apart at the closest state that a local search finds; or, with
  one joint between them, apart over its whole range, or in contact as bearings are, nowhere deeper than ``graze``
  (:mod:`apex_ompl.collision.cover.neighbors`).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from apex_ompl.collision.cover.neighbors import reason_of_neighbors
from apex_ompl.collision.hulls import convex_hull
from apex_ompl.collision.links import Links
from apex_ompl.errors import ParameterError, UnknownNameError
from apex_ompl.robot.config import RobotConfig
from apex_ompl.robot.model import Robot, link_of
from apex_ompl.robot.self_collision import ALWAYS, SelfCollision, enabled_pairs, links_of_pair
from apex_ompl.types import Array, Flags
from apex_ompl.util.validation import check_integer, check_positive, check_seed

Pair = tuple[int, int]

FIRST = 500  # states at which all pairs are checked; those that touch at none remain
CHUNK = 250  # states between looks at the time
STARTS = 4  # closest states from which a local search starts, where the closest is ...
FAR = 0.3  # ... nearer than this; else it starts from one [m]
DISTANCES = 2000  # states at which distances are measured
STEPS = 60  # of a local search
SWEEP = 1001  # positions of the synergies of soft parts
GRAZE, MOST_GRAZE = 1e-3, 1e-2  # depth of contacts of bearings, and most that may be allowed [m]


@dataclass(frozen=True)
class PairSearch:
    """Settings of the search for pairs.

    Attributes:
        samples: Random states.
        margin: Least distance of a pair that never touches [m].
        seed: Of the states.
        soft: Parts whose links may touch each other.
        graze: Depth to which links with one joint between them may touch over its whole range; 0 for not at all [m].
    """

    samples: int = 20_000
    margin: float = 0.02
    seed: int = 0
    soft: tuple[str, ...] = ()
    graze: float = GRAZE

    def __post_init__(self) -> None:
        """Check the ranges."""
        check_integer(self.samples, "samples", 1)
        check_positive(self.margin, "margin", "a positive distance [m]")
        check_seed(self.seed)
        if not 0.0 <= self.graze <= MOST_GRAZE:
            raise ParameterError("graze", self.graze, f"0 to {MOST_GRAZE:g} m")


def disabled_pairs(
    robot: Robot,
    config: RobotConfig,
    search: PairSearch,
    deadline: float = np.inf,
    progress: Callable[[float], object] = lambda share: None,
    *,
    links: Links | None = None,
) -> list[tuple[tuple[str, str], str]]:
    """Return the pairs of links to disable, sorted, with their reasons.

    A pair that is not decided before the deadline stays enabled.

    Args:
        robot: The robot without its file of disabled pairs.
        config: Its file.
        search: Settings.
        deadline: By ``time.monotonic`` [s].
        progress: Called with the share of the work that is done.
        links: The links with covers, which save most checks of meshes.

    Returns:
        Links of each pair, and the reason.

    Raises:
        UnknownNameError: There is no part of a name.
    """
    unknown = sorted({*search.soft} - {*robot.part_links})
    if unknown:
        raise UnknownNameError("part", unknown[0], robot.part_links)
    pairs = [pair for pair in enabled_pairs(robot) if _same_root(robot, config, pair)]
    inside = [pair for pair in pairs if (parts := _parts(robot, pair))[0] == parts[1] and parts[0] in search.soft]
    reasons = dict(zip(inside, _sweep(robot, inside), strict=True))
    rest = [pair for pair in pairs if pair not in reasons]
    reasons |= _decide(robot, rest, search, deadline, progress, links=links)
    return _by_links(robot, pairs, reasons)


def _by_links(robot: Robot, pairs: Sequence[Pair], reasons: dict[Pair, str]) -> list[tuple[tuple[str, str], str]]:
    """Return pairs of links all of whose geometries have a reason, with the first that is no mere "never"."""
    found: dict[tuple[str, str], list[str]] = {}
    for pair in pairs:
        found.setdefault(links_of_pair(robot, pair), []).append(reasons.get(pair, ""))
    chosen = {links: some for links, some in found.items() if all(some)}
    return sorted((links, min(some, key=lambda reason: reason.startswith("never"))) for links, some in chosen.items())


def _parts(robot: Robot, pair: Pair) -> tuple[str, str]:
    first, second = (robot.part_of(link_of(robot.model, robot.geometry.geometryObjects[k])) for k in pair)
    return first, second


def _same_root(robot: Robot, config: RobotConfig, pair: Pair) -> bool:
    """Whether the chains of parts that carry the links of a pair start at the same part."""
    above = {part.name: part.parent for part in config.parts}

    def root(part: str) -> str:
        return part if above[part] == "world" else root(robot.part_of(above[part]))

    first, second = map(root, _parts(robot, pair))
    return first == second


def _sweep(robot: Robot, pairs: list[Pair]) -> list[str]:
    """Return the reason for each pair inside a soft part, from a sweep of all synergies at once."""
    checks = SelfCollision(robot, pairs)
    synergies = {hand.synergy for hand in robot.hands.values()}
    moved = [k for k, name in enumerate(robot.joint_names) if name in synergies]
    first = np.full(len(pairs), np.nan)
    for s in np.linspace(0.0, 1.0, SWEEP) if pairs else ():
        q = robot.home.copy()
        q[moved] = s
        first[np.isnan(first) & checks.colliding(q)] = s
    return ["never in a sweep of the synergy" if np.isnan(s) else f"by design, from synergy {s:.3f}" for s in first]


class _Hits:
    """Which of some pairs collide at states; only those that covers leave open are checked by their meshes."""

    def __init__(self, robot: Robot, pairs: Sequence[Pair], links: Links | None) -> None:
        self._meshes, self._links = SelfCollision(robot, pairs), links
        self._place = {(min(pair), max(pair)): k for k, pair in enumerate(pairs)}

    def __call__(self, states: Array) -> Flags:
        """Return the hits at states, shape (states, pairs)."""
        if self._links is None:
            return self._meshes.hits(states)
        found = np.zeros((len(states), len(self._place)), bool)
        for row, (q, some) in enumerate(zip(states, self._links.open_pairs(states), strict=True)):
            if some is None:
                found[row] = self._meshes.colliding(q)
            else:
                found[row] = self._meshes.colliding_among(q, [self._place[p] for p in some if p in self._place])
        return found


def _decide(
    robot: Robot, pairs: list[Pair], search: PairSearch, deadline: float, progress: Callable[[float], object],
    *, links: Links | None,
) -> dict[Pair, str]:  # fmt: skip
    """Return pair -> reason for the pairs that always or never touch."""
    rng = np.random.default_rng(search.seed)
    first = min(FIRST, search.samples)
    counts = _Hits(robot, pairs, links)(robot.random_state(rng, first)).sum(axis=0)
    enough = ALWAYS * first
    reasons = {
        pair: f"always, in {count} of {first} samples"
        for pair, count in zip(pairs, counts, strict=True)
        if count >= enough
    }
    reasons |= {
        pair: why for pair in pairs if pair not in reasons and (why := reason_of_neighbors(robot, pair, search.graze))
    }
    untouched = [pair for pair, count in zip(pairs, counts, strict=True) if count == 0]
    left = [pair for pair in untouched if pair not in reasons]
    done = first
    while done < search.samples and left:
        if time.monotonic() > deadline:
            return reasons
        chunk = robot.random_state(rng, min(CHUNK, search.samples - done))
        hits = _Hits(robot, left, links)(chunk)
        left = [pair for k, pair in enumerate(left) if not hits[:, k].any()]
        done += len(chunk)
        progress(0.5 * done / search.samples)
    if not left or time.monotonic() > deadline:
        return reasons
    states = robot.random_state(rng, DISTANCES)
    hulls = {k: convex_hull(robot.geometry.geometryObjects[k].geometry) for k in {k for pair in left for k in pair}}
    apart = SelfCollision(robot, left, hulls)
    table = np.array([apart.distances(q) for q in states])
    for k, pair in enumerate(left):
        if time.monotonic() > deadline:
            break
        progress(0.5 + 0.5 * k / len(left))
        closest = float(table[:, k].min())
        alone = SelfCollision(robot, [pair], {k: hulls[k] for k in pair})
        starts = STARTS if closest < FAR else 1
        for q in states[np.argsort(table[:, k])[:starts]]:
            if closest < search.margin:
                break
            closest = min(closest, _closest(alone, q))
        if closest >= search.margin:
            reasons[pair] = f"never in {search.samples} samples, closest found {closest * 1e3:.0f} mm"
    return reasons


def _closest(alone: SelfCollision, q: Array) -> float:
    """Return the least distance of a single pair that a descent from a state finds [m].

    The direction is that of the signed gradient by finite differences, scaled by the ranges of the joints; the step is
    halved where it does not help.
    """
    moving = _moving(alone.robot, alone.pairs[0])
    low, high = alone.robot.limits.lower, alone.robot.limits.upper
    span = np.minimum(high - low, 2.0 * np.pi)
    best, step = float(alone.distances(q)[0]), 0.1
    for _ in range(STEPS):
        slope = np.zeros(len(q))
        for k in moving:
            moved = q.copy()
            change = 1e-4 * span[k] * (1.0 if q[k] + 1e-4 * span[k] <= high[k] else -1.0)
            moved[k] += change
            slope[k] = (alone.distances(moved)[0] - best) / change * span[k]
        size = float(np.linalg.norm(slope))
        if size < 1e-9 or best <= 0.0:
            break
        while step > 1e-4:
            tried = np.clip(q - step * span * slope / size, low, high)
            value = float(alone.distances(tried)[0])
            if value < best - 1e-7:
                q, best, step = tried, value, min(2.0 * step, 0.2)
                break
            step *= 0.5
        else:
            break
    return best


def _moving(robot: Robot, pair: Pair) -> list[int]:
    """Return the planned joints, by their numbers, that move the geometries of a pair against each other."""
    model = robot.model
    chains = [set(model.supports[robot.geometry.geometryObjects[k].parentJoint]) for k in pair]
    return sorted({int(robot.state_order[model.joints[joint].idx_q]) for joint in chains[0] ^ chains[1]})
