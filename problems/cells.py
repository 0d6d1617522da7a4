"""Cells: sequences of steps in random rooms, for one arm and for two, from an empty hand to the last object's place.

``pick_and_place``: a Panda takes a box with any of 50 grasps out of one bin and puts it into another one, turned as it
likes. ``handover``: one of two hands takes a bar from the table, the other one takes it over and puts it down.
``stacking``: both hands stack three boxes from the table, as in the paper.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from apex_ompl.robot import load_robot
from apex_ompl.scene.bodies import pose_fields
from apex_ompl.scene.problem import Problem
from apex_ompl.types import Array
from apex_ompl.util.validation import check_name, check_seed

DOWN = pin.rpy.rpyToMatrix(np.pi, 0.0, 0.0)  # a gripper whose z axis points down
GRASPS = 50  # of the box in a bin
WALL = 0.01  # of a bin [m]
ON_PALM = 0.034  # from the palm's grasp point to a face that lies on the palm [m]
PALM_GAP = 0.004  # between the palm and a face before the hand closes [m]
APPROACH = [0.0, 0.0, -0.08]  # of a palm along its outward normal [m]
Entry = dict[str, Any]


def names() -> tuple[str, ...]:
    """Return the kinds of cells."""
    return tuple(KINDS)


def draw(kind: str, seed: int) -> Problem:
    """Return a cell.

    Args:
        kind: One of :func:`names`.
        seed: Its seed; the same one gives the same cell.

    Raises:
        UnknownNameError: There is no such kind.
        ParameterError: The seed is no whole number from 0 on.
    """
    check_name(kind, "kind of cell", KINDS)
    check_seed(seed)
    rng = np.random.default_rng([tuple(KINDS).index(kind), seed])
    data = KINDS[kind](rng)
    return Problem.parse({"schema": "apex-ompl/problem/1", "name": f"{kind}-{seed}", **data}, f"{kind}-{seed}")


def _rounded(values: Sequence[float] | Array, digits: int = 4) -> list[float]:
    return [round(float(x), digits) for x in values]


def _pose(pose: Array) -> Entry:
    """Return the fields of a pose, shape (4, 4), rounded so that quaternions stay units."""
    fields = pose_fields(pose)
    return {"position": _rounded(fields["position"], 5), "orientation": _rounded(fields["orientation"], 8)}


def _turn(angle: float) -> list[float]:
    """Return the quaternion of a turn about z."""
    return _rounded([0.0, 0.0, np.sin(angle / 2.0), np.cos(angle / 2.0)], 8)


def _box(name: str, size: Sequence[float] | Array, position: Sequence[float], **fields: Any) -> Entry:
    return {"name": name, "box": _rounded(size), "position": _rounded(position), **fields}


def _bin(name: str, center: Array, inside: Array, height: float) -> list[Entry]:
    """Return the floor and the four walls of a bin whose floor is at z = 0."""
    x, y = inside
    cx, cy = center
    walls = [
        ((WALL, y + 2 * WALL, height), (cx - (x + WALL) / 2, cy)),
        ((WALL, y + 2 * WALL, height), (cx + (x + WALL) / 2, cy)),
        ((x, WALL, height), (cx, cy - (y + WALL) / 2)),
        ((x, WALL, height), (cx, cy + (y + WALL) / 2)),
    ]
    return [
        _box(f"{name}_floor", (x, y, WALL), (cx, cy, -WALL / 2)),
        *(_box(f"{name}_wall{k}", size, (*at, height / 2)) for k, (size, at) in enumerate(walls)),
    ]


def gripper_grasps(size: Sequence[float] | Array, width: float = 0.08, count: int = GRASPS) -> list[Entry]:
    """Return grasps of an upright box by a parallel gripper from above, the steepest first.

    The fingers close along y of the hand, on faces that are nearer to each other than they open.

    Args:
        size: Edges of the box [m].
        width: How far the fingers open [m].
        count: Most grasps.
    """
    found = list[Entry]()
    turns = [k * np.pi / 2 for k in range(4) if size[(k + 1) % 2] < width - 0.005]
    for tilt in (0.0, -0.3, 0.3, -0.6, 0.6):
        for depth in (0.02, 0.035, 0.05):
            for turn in turns:
                for along in (0.0, -0.25, 0.25):
                    # the hand turns about its y axis, along which it closes
                    rotation = pin.rpy.rpyToMatrix(0.0, 0.0, turn) @ DOWN @ pin.rpy.rpyToMatrix(0.0, tilt, 0.0)
                    if along and not tilt:
                        continue
                    shift = along * size[int(round(turn / (np.pi / 2))) % 2] * (rotation @ np.array([1.0, 0.0, 0.0]))
                    shift[2] = 0.0
                    pose = np.eye(4)
                    pose[:3, :3], pose[:3, 3] = rotation, shift + [0.0, 0.0, size[2] / 2 - depth]
                    found.append(_pose(pose))
    return found[:count]


def _pick_and_place(rng: np.random.Generator) -> Entry:
    """Return a cell of a Panda between two bins."""
    centers = np.array([[0.45, -0.27], [0.45, 0.27]]) + rng.uniform(-0.05, 0.05, (2, 2))
    inside, size = rng.uniform(0.22, 0.3, (2, 2)), np.array([*rng.uniform(0.04, 0.06, 2), rng.uniform(0.09, 0.14)])
    size = size.round(4)
    heights = rng.uniform(0.05, size[2], 2)
    reach = inside - np.linalg.norm(size[:2]) - 2.0 * np.array([[0.02], [0.035]])  # room for fingers
    at = centers + rng.uniform(-0.5, 0.5, (2, 2)) * reach
    scene = [
        *_bin("left_bin", centers[0], inside[0], heights[0]), *_bin("right_bin", centers[1], inside[1], heights[1]),
        _box("divider", (0.5, 0.02, rng.uniform(0.1, 0.3)), (0.5, rng.uniform(-0.03, 0.03), 0.1)),
    ]  # fmt: skip
    for k in range(int(rng.integers(0, 4))):  # what stands beside the places
        side = int(rng.integers(0, 2))
        edge, tall = rng.uniform(0.03, 0.06), rng.uniform(0.05, 0.18)
        place = centers[side] + rng.uniform(-0.5, 0.5, 2) * (inside[side] - edge * 1.5)
        if np.linalg.norm(place - at[side]) > 0.5 * np.linalg.norm(size[:2]) + 0.75 * edge + 0.005:
            scene.append(_box(f"other{k}", (edge, edge, tall), (*place, tall / 2)))
    turned = _turn(rng.uniform(-np.pi, np.pi))
    scene.append(_box("box", size, (*at[0], size[2] / 2), orientation=turned, grasps=gripper_grasps(size)))
    robot = load_robot("panda")
    start = {name: round(float(q), 4) for name, q in zip(robot.joint_names, robot.home, strict=True)}
    target = {
        "frame": "box", "position": _rounded([*at[1], size[2] / 2 + 1e-4]), "orientation": [0.0, 0.0, 0.0, 1.0],
        "free_turn": "z", "approach": [0.0, 0.0, -0.1],
    }  # fmt: skip
    after = [
        {"kind": "allow", "pairs": [["box", "left_bin_floor"], ["box", "right_bin_floor"]]},
        {"kind": "grasp", "hand": "hand", "object": "box"},
        {"kind": "line", "frame": "hand", "by": [0.0, 0.0, 0.15], "blend": 0.05},
        {"kind": "move", "goal": {"poses": [target]}, "blend": 0.05},
        {"kind": "release", "hand": "hand"},
        {"kind": "retreat", "hand": "hand", "distance": 0.12, "blend": 0.05},
        {"kind": "move", "goal": {"joints": start}},
    ]  # fmt: skip
    goal = {"grasp": {"object": "box", "hand": "hand", "approach": [0.0, 0.0, 0.1]}}
    return {"robot": "panda", "scene": scene, "start": start, "goal": goal, "after": after}


def hand_grasps(size: Sequence[float] | Array, heights: Sequence[float]) -> list[Entry]:
    """Return grasps of an upright box of square cross-section by a hand from its four sides, the palm flat on a face.

    Args:
        size: Edges of the box [m].
        heights: Heights of the grasp point over the middle of the box [m].
    """
    found = list[Entry]()
    beside = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])  # the palm's x axis is up, its back at -x
    point = np.array([ON_PALM - size[0] / 2 - PALM_GAP, -0.01, 0.0])
    for face in range(4):
        for flip in (0.0, np.pi):
            for height in heights:
                turn = pin.rpy.rpyToMatrix(flip, 0.0, face * np.pi / 2)
                pose = np.eye(4)
                pose[:3, :3], pose[:3, 3] = turn @ beside, turn @ point + [0.0, 0.0, height]
                found.append(_pose(pose))
    return found


def _home() -> tuple[dict[str, float], dict[str, float]]:
    """Return the home of the robot with two arms, and of its arms alone."""
    robot = load_robot("dual_panda_softhand")
    start = {name: round(float(q), 4) for name, q in zip(robot.joint_names, robot.home, strict=True)}
    return start, {name: q for name, q in start.items() if "joint" in name}


def _standing(name: str, size: Array, place: Array, turn: float, heights: Sequence[float]) -> Entry:
    """Return a box that stands on the table, with its grasps."""
    return _box(name, size, (*place, size[2] / 2), orientation=_turn(turn), grasps=hand_grasps(size, heights))


def _place(name: str, position: Sequence[float], **fields: Any) -> Entry:
    """Return the goal that an object stands somewhere, turned as it likes, and comes from above."""
    upright = {"orientation": [0.0, 0.0, 0.0, 1.0], "free_turn": "z"}
    return {
        "poses": [{"frame": name, "position": _rounded(position), **upright, "approach": [0.0, 0.0, -0.06], **fields}]
    }


def _let_go(hand: str) -> list[Entry]:
    return [{"kind": "release", "hand": hand}, {"kind": "retreat", "hand": hand, "distance": 0.12, "blend": 0.05}]


def _stacking(rng: np.random.Generator) -> Entry:
    """Return a cell in which both hands stack three boxes."""
    edge, tall = rng.uniform(0.055, 0.065), rng.uniform(0.16, 0.18)
    size = np.array([edge, edge, tall]).round(4)
    tower = rng.uniform([0.48, 0.1], [0.56, 0.18])
    places = {
        "a": rng.uniform([0.4, 0.35], [0.55, 0.45]), "b": rng.uniform([0.4, -0.45], [0.55, -0.3]),
        "c": rng.uniform([0.5, 0.55], [0.6, 0.65]),
    }  # fmt: skip
    scene = [_standing(n, size, at, rng.uniform(-np.pi, np.pi), (0.0, 0.03, 0.05)) for n, at in places.items()]
    scene.append(_box("lamp", (0.2, 0.2, 0.1), (rng.uniform(0.4, 0.6), rng.uniform(-0.1, 0.1), rng.uniform(0.85, 1.0))))
    start, home = _home()
    tables = {"a": "table_left", "b": "table_right", "c": "table_left"}
    at = [[*tower, tall * (k + 0.5) + 0.001 * (k + 1)] for k in range(3)]
    lift = {"kind": "line", "by": [0.0, 0.0, 0.08]}
    grasps = [
        {"grasp": {"object": "a", "hand": "left_hand", "remaining": APPROACH}},
        {"grasp": {"object": "b", "hand": "right_hand", "remaining": APPROACH}},
    ]  # fmt: skip
    after = [
        {"kind": "together", "steps": [_near("left_hand"), _near("right_hand")]},
        {"kind": "allow", "pairs": [[name, table] for name, table in tables.items()]},
        {"kind": "together", "steps": [_take("left_hand", "a"), _take("right_hand", "b")]},
        {"kind": "together", "steps": [{**lift, "frame": "left_hand"}, {**lift, "frame": "right_hand"}]},
        {"kind": "move", "goal": _place("a", at[0]), "group": "left_arm"}, *_let_go("left_hand"),
        {"kind": "move", "goal": {"grasp": {"object": "c", "hand": "left_hand", "approach": APPROACH}}},
        _take("left_hand", "c"), {**lift, "frame": "left_hand"},
        {"kind": "move", "goal": _place("b", at[1])}, *_let_go("right_hand"),
        {"kind": "move", "goal": _place("c", at[2])}, *_let_go("left_hand"),
        {"kind": "move", "goal": {"joints": home}},
    ]  # fmt: skip
    return {"robot": "dual_panda_softhand", "scene": scene, "start": start, "goal": {"all_of": grasps}, "after": after}


def _near(hand: str) -> Entry:
    return {"kind": "line", "frame": hand, "by": APPROACH, "axes": "frame"}


def _take(hand: str, name: str) -> Entry:
    return {"kind": "grasp", "hand": hand, "object": name}


def _handover(rng: np.random.Generator) -> Entry:
    """Return a cell in which a bar goes from the left table to the right one through both hands."""
    edge, tall = rng.uniform(0.045, 0.055), rng.uniform(0.3, 0.34)
    size = np.array([edge, edge, tall]).round(4)
    heights = (-0.25 * tall, 0.25 * tall)
    at, to = rng.uniform([0.4, 0.3], [0.6, 0.5]), rng.uniform([0.4, -0.5], [0.6, -0.3])
    scene = [_standing("bar", size, at, rng.uniform(-np.pi, np.pi), heights)]
    for k in range(int(rng.integers(0, 4))):
        place = rng.uniform([0.35, -0.6], [0.7, 0.6])
        if min(np.linalg.norm(place - at), np.linalg.norm(place - to)) > 0.22 and abs(place[1]) > 0.1:
            high = rng.uniform(0.1, 0.35)
            scene.append(_box(f"post{k}", (0.06, 0.06, high), (*place, high / 2)))
    start, home = _home()
    between = [
        _place("bar", (rng.uniform(0.42, 0.58), y, z), approach=None) for y in (-0.08, 0.0, 0.08) for z in (0.35, 0.45)
    ]  # fmt: skip
    taken_over = {"grasp": {"object": "bar", "hand": "right_hand", "approach": APPROACH}}
    after = [
        {"kind": "allow", "pairs": [["bar", "table_left"], ["bar", "table_right"]]},
        _take("left_hand", "bar"),
        {"kind": "line", "frame": "left_hand", "by": [0.0, 0.0, 0.08], "blend": 0.05},
        {"kind": "move", "goal": {"any_of": between}, "group": "left_arm"},
        {"kind": "move", "goal": taken_over, "group": "right_arm"},
        _take("right_hand", "bar"),
        *_let_go("left_hand"),
        {"kind": "move", "goal": _place("bar", (*to, tall / 2 + 1e-4))}, *_let_go("right_hand"),
        {"kind": "move", "goal": {"joints": home}},
    ]  # fmt: skip
    goal = {"grasp": {"object": "bar", "hand": "left_hand", "approach": APPROACH}}
    return {"robot": "dual_panda_softhand", "scene": scene, "start": start, "goal": goal, "after": after}


KINDS: dict[str, Callable[[np.random.Generator], Entry]] = {
    "pick_and_place": _pick_and_place,
    "handover": _handover,
    "stacking": _stacking,
}
"""Kind of cell -> its entries in a problem file, by random numbers."""
