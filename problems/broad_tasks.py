"""Tasks among parts: random held objects, starts and goals, and how hard a problem is.

Held objects are pins, boxes, balls, pegs, bars, trays, angles and cups, in the frame of a palm. An object lies on the
palm, and the fingers close on it until just before they touch; the hand that holds it may touch it. The fingers stay so
from the start to the goal.

At a start or goal the hands are at places, in wide regions, at rest, or contorted.

The difficulty is measured by the kernel alone. Class 0: the straight line is free. Class 1: the optimizer repairs the
straight line. Class 2: a sprint of rrtconnect finds a path. Class 3: none of these does; such a problem need not have a
solution. Each is measured with fixed numbers of steps and no clock. The sprint is not OMPL's, whose random numbers are
one sequence for the whole process: a problem is drawn the same from its own random numbers, whatever else the process
plans.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apex_ompl.constraints.links import Links
from apex_ompl.errors import SceneError
from apex_ompl.goals.grasp import grasp
from apex_ompl.goals.state_sampling import ArmTables, HandPoseSampler, HandRegion, Region
from apex_ompl.kernel import Kernel, RobotTables, SceneTables
from apex_ompl.kernel.scene_builder import Solids, boxes_around, tables_of
from apex_ompl.paths.candidates import first_valid
from apex_ompl.paths.optimizer import Optimizer
from apex_ompl.paths.path import FINE_RESOLUTION, SEARCH_RESOLUTION
from apex_ompl.problems.broad_parts import Part, Place, kernel_columns
from apex_ompl.problems.objects import ALONG_X, PALM, cup
from apex_ompl.problems.robot_cells import FINGERS, Cell, standard_cell
from apex_ompl.problems.suite_robot import robot
from apex_ompl.scene.bodies import AttachedObject
from apex_ompl.types import Array

NONE_HELD, ONE_HELD = 0.45, 0.3  # shares of problems with empty hands, and with an object in one
OPEN = (0.0, 0.4)  # interval of the synergies of empty hands
SYNERGY_STEP = 1e-3
HELD_SIZE = (0.03, 0.14)  # edges of boxes in hands that do not close, in the cell's frame
PLACE_WIDTH = 0.02  # half the width of the region around a place [m]
PLACED, RESTING = 0.7, 0.07  # share of hands that are sent to places, and of states at rest
CONTORTED = 0.13  # share of states that are drawn evenly from the limits
BATCH = 48  # such states at once
REST_SPREAD = 0.15  # standard deviation of a state at rest around home [rad]
CLASSES = 4
RANGE = 1.0  # longest motion of the sprint [rad], as rrtconnect is tuned
SPRINT = 400  # samples of the sprint
MOTIONS = 1500  # motions that it checks at most


@dataclass(frozen=True, eq=False)
class Held:
    """Held objects, and the robot with them.

    Attributes:
        cell: The robot's cell.
        attached: The objects.
        tables: The kernel's tables of the robot with the objects.
        low: Least synergy of each hand that closes.
        high: Largest one, the same for a hand that holds something.
    """

    cell: Cell
    attached: tuple[AttachedObject, ...]
    tables: ArmTables
    low: Array
    high: Array

    @classmethod
    def of(
        cls, attached: Sequence[AttachedObject], low: Sequence[float], high: Sequence[float], cell: Cell | None = None
    ) -> Held:
        """Return held objects with the tables of the robot that holds them, by default that of the suites."""
        cell = cell or standard_cell()
        tables = cell.holding(attached) if attached else cell.tables
        return cls(cell, tuple(attached), tables, np.array(low, float), np.array(high, float))


def draw_held(rng: np.random.Generator, cell: Cell | None = None) -> Held:
    """Draw what the hands hold: nothing in about half of the problems, else an object in one hand or in two.

    The hands of the robot of the suites, the default, close on objects of many kinds; other hands hold boxes.
    """
    if cell is not None and cell is not standard_cell():
        return _held_boxes(rng, cell)
    share = rng.random()
    sides = (0, 1) if share >= NONE_HELD + ONE_HELD else (int(rng.integers(2)),) if share >= NONE_HELD else ()
    attached, low, high = list[AttachedObject](), [OPEN[0]] * 2, [OPEN[1]] * 2
    for side in sides:
        kind = list(KINDS)[int(rng.integers(len(KINDS)))]
        bodies, synergy = _grasped(kind, tuple(np.round(rng.uniform(size=4), 2).tolist()), side)
        attached += bodies
        if bodies:
            low[side] = high[side] = synergy
    return Held.of(attached, low, high)


def _held_boxes(rng: np.random.Generator, cell: Cell) -> Held:
    """Draw boxes at the grasp points of some of the hands of a cell, half of each beyond the tips of the fingers."""
    share, robot = rng.random(), cell.robot
    hands = [arm.hand for arm in cell.arms if arm.hand is not None]
    count = 0 if share < NONE_HELD else 1 if share < NONE_HELD + ONE_HELD else 2
    attached = []
    for number in rng.permutation(len(hands))[:count].tolist():
        hand = robot.hands[hands[number]]
        x, y, z = np.round(cell.size * rng.uniform(*HELD_SIZE, 3), 4).tolist()
        attached.append(AttachedObject(name=f"held_{number}", link=hand.palm, box=(x, y, z), position=hand.point))
    closing = len(cell.tables.synergies)
    return Held.of(attached, (OPEN[0],) * closing, (OPEN[1],) * closing, cell)


@lru_cache(maxsize=256)
def _grasped(kind: str, shares: tuple[float, ...], side: int) -> tuple[tuple[AttachedObject, ...], float]:
    """Return the bodies of an object in a hand, and the synergy that holds them; none where the hand is too small."""
    hand = ("left_hand", "right_hand")[side]
    bodies, synergy = list[AttachedObject](), 1.0
    for k, fields in enumerate(KINDS[kind](*shares)):
        if "cup" in fields:
            body = cup(hand.replace("hand", "cup"), -1 if side == 0 else 1)
        else:
            body = AttachedObject.model_validate({"name": f"{hand}_{kind}_{k}", "link": "palm", **fields})
        try:
            closed = grasp(robot(), hand, body)
        except SceneError:
            return (), 0.0
        bodies.append(closed.held.model_copy(update={"touch_links": None}))
        synergy = min(synergy, closed.synergy)
    return tuple(bodies), float(np.floor(synergy / SYNERGY_STEP) * SYNERGY_STEP)


def _scaled(share: float, low: float, high: float) -> float:
    """Return the length at a share of an interval [m], in tenths of millimeters."""
    return round(low + share * (high - low), 4)


def _pin(u: float, v: float, w: float, x: float) -> list[dict[str, Any]]:
    radius, length = _scaled(u, 0.003, 0.008), _scaled(v, 0.05, 0.14)
    pose = {"position": (_scaled(w, -0.04, 0.04), _scaled(x, 0.02, 0.05), PALM - radius), "orientation": ALONG_X}
    return [{"cylinder": {"radius": radius, "length": length}, **pose}]


def _box(u: float, v: float, w: float, x: float) -> list[dict[str, Any]]:
    size = (_scaled(u, 0.03, 0.14), _scaled(v, 0.03, 0.12), _scaled(w, 0.02, 0.07))
    return [{"box": size, "position": (0.0, _scaled(x, 0.02, 0.06), PALM - size[2] / 2)}]


def _ball(u: float, v: float, w: float, x: float) -> list[dict[str, Any]]:
    radius = _scaled(u, 0.012, 0.045)
    return [{"sphere": {"radius": radius}, "position": (_scaled(v, -0.03, 0.03), 0.03, PALM - radius)}]


def _peg(u: float, v: float, w: float, x: float) -> list[dict[str, Any]]:
    radius, length = _scaled(u, 0.01, 0.03), _scaled(v, 0.1, 0.2)
    pose = {"position": (_scaled(w, -0.05, 0.05), 0.03, PALM - radius), "orientation": ALONG_X}
    return [{"cylinder" if x < 0.6 else "capsule": {"radius": radius, "length": length}, **pose}]


def _bar(u: float, v: float, w: float, x: float) -> list[dict[str, Any]]:
    radius, length = _scaled(u, 0.006, 0.018), _scaled(v, 0.22, 0.4)
    offset = _scaled(w, -0.3, 0.3) * length
    pose = {"position": (round(offset, 4), 0.03, PALM - radius), "orientation": ALONG_X}
    if x < 0.3:
        return [{"box": (2 * radius, 2 * radius, length), **pose}]
    return [{"cylinder": {"radius": radius, "length": length}, **pose}]


def _tray(u: float, v: float, w: float, x: float) -> list[dict[str, Any]]:
    size = (_scaled(u, 0.15, 0.3), _scaled(v, 0.12, 0.3), _scaled(w, 0.006, 0.02))
    return [{"box": size, "position": (0.0, round(0.03 + size[1] / 2 * x, 4), PALM - size[2] / 2)}]


def _angle(u: float, v: float, w: float, x: float) -> list[dict[str, Any]]:
    """An L or a T of two bars: one across the palm, one off it at an end or in the middle."""
    thick, length, arm = _scaled(u, 0.014, 0.03), _scaled(v, 0.12, 0.3), _scaled(w, 0.08, 0.22)
    end = length / 2 - thick / 2 if x < 0.6 else 0.0
    across = {"box": (length, thick, thick), "position": (0.0, 0.03, PALM - thick / 2)}
    off = {"box": (thick, thick, arm), "position": (round(end, 4), 0.03, round(PALM - thick - arm / 2, 4))}
    return [across, off]


def _cup(u: float, v: float, w: float, x: float) -> list[dict[str, Any]]:
    return [{"cup": True}]


KINDS: dict[str, Callable[[float, float, float, float], list[dict[str, Any]]]] = {
    "pin": _pin, "box": _box, "ball": _ball, "peg": _peg, "bar": _bar, "tray": _tray, "angle": _angle, "cup": _cup,
}  # fmt: skip
"""Kinds of objects: the fields of their bodies for four numbers from 0 to 1."""


def scene_of(parts: Sequence[Part], swelling: float = 0.0, cell: Cell | None = None) -> SceneTables:
    """Return the kernel's scene of a robot's fixtures, followed by parts.

    Args:
        parts: The parts, in the world.
        swelling: By how much every part is thicker on each side [m].
        cell: The robot's cell, by default that of the suites.
    """
    found = dict(enumerate((cell or standard_cell()).fixtures))
    kind, rotation, offset, size = kernel_columns(parts, swelling)
    around = boxes_around(kind, rotation, offset, size) if parts else np.empty((0, 2, 3))
    exact = np.array([swelling == 0.0], np.int64)
    for k in range(len(parts)):
        one = slice(k, k + 1)
        found[len(found)] = Solids(kind[one], exact, rotation[one], offset[one], size[one], around[one], (None,))
    return tables_of(found)


def clear_parts(cell: Cell, tables: RobotTables, parts: list[Part], ends: Array, margin: float) -> list[Part]:
    """Return those parts that keep a margin to the robot at some states.

    Args:
        cell: The robot's cell.
        tables: The robot with its held objects.
        parts: The parts, in the world.
        ends: Shape (n, dof).
        margin: [m].
    """
    fixtures = len(cell.fixtures)
    while parts:
        found, counts = Kernel(tables, scene_of(parts, margin, cell)).unproved(ends)
        rows = np.concatenate([some[: max(n, 0), 1] for some, n in zip(found, counts, strict=True)])
        touching: NDArray[np.int64] = np.unique(-1 - rows[rows < -fixtures]) - fixtures
        if not len(touching):
            break
        gone = set(touching.tolist())
        parts = [part for k, part in enumerate(parts) if k not in gone]
    return parts


def tips_on_line(cell: Cell, tables: RobotTables, ends: Array, count: int) -> Array:
    """Return the tips of all arms at states between start and goal, in the cell's frame: shape (arms * count, 3)."""
    links = Links.of(cell.robot)
    points = [links.point(arm.link, arm.point) for arm in cell.arms]
    states = np.linspace(ends[0], ends[1], count + 2)[1:-1]
    rotation, origin = Kernel(tables, scene_of((), cell=cell)).joint_frames(states)
    tips = [rotation[:, p.joint] @ np.asarray(p.vector) + origin[:, p.joint] for p in points]
    return cell.inward(np.concatenate(tips))


class EndSampler:
    """Sampler of starts and goals among parts, by tips in places and by joints."""

    def __init__(self, held: Held, parts: Sequence[Part], places: Sequence[Place], margin: float) -> None:
        """Sample states that keep ``margin`` [m] to ``parts``, or else to the fixtures alone.

        Args:
            held: The robot with its held objects.
            parts: The parts, in the world.
            places: Places that tips are sent to, in the cell's frame.
            margin: [m].
        """
        self._held, self._margin, self._cell = held, margin, held.cell
        bare = scene_of((), cell=held.cell)
        self._scenes = [scene_of(parts, cell=held.cell), bare] if parts else [bare]
        self._places = [[p for p in places if self._cell.in_reach(p.point, k)] for k in range(len(self._cell.arms))]

    def sample(self, rng: np.random.Generator) -> Array | None:
        """Return a state, shape (dof,), or None; where none is found among the parts, one that is clear without."""
        share = rng.random()
        if share < RESTING + CONTORTED:
            return self._joints(rng, rest=share < RESTING)
        regions = [self._region(rng, arm) for arm in range(len(self._cell.arms))]
        synergies = (self._held.low, self._held.high)
        for scene in self._scenes:
            sampler = HandPoseSampler(self._held.tables, scene, self._margin)
            found = sampler.sample(rng, regions, synergies, attempts=2)
            if found is not None:
                return found
        return None

    def _joints(self, rng: np.random.Generator, *, rest: bool) -> Array | None:
        some, tables = self._cell.robot, self._held.tables
        hands = tables.synergies
        states = some.random_state(rng, BATCH)
        if rest:
            states[:] = some.home + rng.normal(0.0, REST_SPREAD, (BATCH, some.dof))
        states[:, hands] = rng.uniform(self._held.low, self._held.high, (BATCH, len(hands)))
        states[:] = np.round(np.clip(states, some.limits.lower, some.limits.upper), 6)
        states = states[[some.limit_fault(q) is None for q in states]]
        for scene in self._scenes:
            clear = np.flatnonzero(
                self._held.tables.are_clear(Kernel(self._held.tables.whole, scene), states, self._margin)
            )
            if len(clear):
                return np.array(states[clear[0]])
        return None

    def _region(self, rng: np.random.Generator, arm: int) -> Region:
        """Return a region for a tip: around a place within reach, or wide."""
        own = self._places[arm]
        if own and rng.random() < PLACED:
            one = own[int(rng.integers(len(own)))]
            x, y, z = ((float(v) - PLACE_WIDTH, float(v) + PLACE_WIDTH) for v in one.point)
            fingers = FINGERS if one.fingers is None or rng.random() < 0.2 else (one.fingers,)
            return self._cell.region(HandRegion(x, y, z, fingers))
        return self._cell.wide_region(arm)


@cache
def _optimizer() -> Optimizer:
    return Optimizer()


def difficulty(kernel: Kernel, ends: Array, rng: np.random.Generator, wanted: int = CLASSES - 1) -> int:
    """Return the class of a problem, or ``wanted`` where it is that or higher: easier methods are tried first.

    Args:
        kernel: The robot among the obstacles.
        ends: Start and goal, shape (2, dof).
        rng: Source of the sprint's samples.
        wanted: Class from which on no more is asked.
    """
    if wanted == 0 or kernel.proves(ends, FINE_RESOLUTION):
        return 0
    if wanted == 1 or _is_repaired(kernel, ends):
        return 1
    if wanted == 2 or sprint(kernel, ends, rng):
        return 2
    return 3


def _is_repaired(kernel: Kernel, ends: Array) -> bool:
    lower, upper = kernel.robot.arrays.lower, kernel.robot.arrays.upper

    def is_valid(states: Array) -> bool:
        inside = bool((states >= lower).all() and (states <= upper).all())
        return inside and kernel.proves(states, FINE_RESOLUTION)

    line = _optimizer().spline.line(ends[0], ends[1])
    return first_valid(_optimizer(), kernel, line[None], is_valid) is not None


def sprint(kernel: Kernel, ends: Array, rng: np.random.Generator) -> bool:
    """Whether a short run of rrtconnect (Kuffner, LaValle 2000) finds a path by the proofs of the spheres."""
    lower, upper = kernel.robot.arrays.lower, kernel.robot.arrays.upper
    trees, sizes = np.empty((2, MOTIONS + 1, len(lower))), [1, 1]
    trees[:, 0] = ends
    left = MOTIONS

    def grow(tree: int, target: Array, steps: int) -> Array | None:
        """Extend a tree towards a state by some steps; return the last new state, or None where there is none."""
        nonlocal left
        rows = trees[tree]
        state, found = rows[int(np.linalg.norm(rows[: sizes[tree]] - target, axis=1).argmin())], None
        while steps and left:
            steps, left = steps - 1, left - 1
            way = target - state
            far = float(np.linalg.norm(way))
            new = target if far <= RANGE else state + way * (RANGE / far)
            if not kernel.proves(np.stack([state, new]), SEARCH_RESOLUTION):
                break
            rows[sizes[tree]] = new
            sizes[tree] += 1
            state = found = new
            if far <= RANGE:
                break
        return found

    for k in range(SPRINT):
        new = grow(k % 2, rng.uniform(lower, upper), 1)
        met = None if new is None else grow(1 - k % 2, new, MOTIONS)
        if new is not None and met is not None and np.array_equal(met, new):
            return True
        if not left:
            break
    return False
