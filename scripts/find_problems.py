"""Find and check the ready-made problems and the example for Baxter, and write their files.

Reaching problems give poses of both hands at start and goal; alignment problems give objects in the hands and
how they are to meet. States are found by inverse kinematics from seeded random states. A problem is kept when its
start (and goal) is free with 1 cm to spare, no straight line to a goal is free for seed 0, and rrtconnect finds a
path that passes the full check for three seeds.

Usage: python scripts/find_problems.py [NAME ...]
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from apex_ompl.api import plan
from apex_ompl.collision import CollisionChecker
from apex_ompl.kernel import offset_target, opposition_target
from apex_ompl.ompl_adapter.setup import assemble
from apex_ompl.ompl_adapter.validity import full_check
from apex_ompl.problems.objects import (
    DATA,
    bar,
    block_and_peg,
    boxes,
    cup_and_ball,
    parcels,
    two_cups,
)
from apex_ompl.robot import Robot, load_robot
from apex_ompl.scene.bodies import AttachedObject, Obstacle
from apex_ompl.scene.problem import Alignment, Goal, Problem
from apex_ompl.tasks.grasp import HandObjects, close_hands
from apex_ompl.tasks.inverse_kinematics import Links, in_world
from apex_ompl.util.entry_point import run_script

ROOT = Path(__file__).resolve().parent.parent
MARGIN = 0.01  # [m]
FORWARD, DOWN = (1.0, 0.0, 0.0), (0.0, 0.0, -1.0)


@dataclass(frozen=True)
class HandPose:
    """Where a hand's grasp point goes, and where its fingers point."""

    point: tuple[float, float, float]
    fingers: tuple[float, float, float]


@dataclass(frozen=True)
class Reach:
    """A problem between (left, right) hand poses, with what the hands hold, or with their synergies."""

    file: str
    robot: str
    scene: Callable[[], Sequence[Obstacle]]
    start: tuple[HandPose, HandPose]
    goal: tuple[HandPose, HandPose]
    held: Callable[[], HandObjects] = tuple
    synergies: tuple[float, ...] = ()


@dataclass(frozen=True)
class Align:
    """A problem that brings two held objects together."""

    file: str
    scene: Callable[[], Sequence[Obstacle]]
    held: Callable[[], HandObjects]
    alignment: Alignment
    seed: int = 0


def shelf() -> list[Obstacle]:
    """A shelf of three columns and three levels in front of both arms: nine boards 2 cm thick."""
    board, depth, front = 0.02, 0.36, 0.56
    columns, levels = (-0.72, -0.24, 0.24, 0.72), (0.12, 0.42, 0.72, 1.02)
    middle = front + depth / 2
    height, centre = levels[-1] - levels[0] + board, (levels[0] + levels[-1]) / 2
    width = columns[-1] - columns[0] + board
    uprights = [
        Obstacle(name=f"upright_{k}", box=(depth, board, height), position=(middle, y, centre))
        for k, y in enumerate(columns)
    ]
    shelves = [
        Obstacle(name=f"board_{k}", box=(depth, width, board), position=(middle, 0.0, z)) for k, z in enumerate(levels)
    ]
    back = Obstacle(name="back", box=(board, width, height), position=(front + depth + board / 2, 0.0, centre))
    return [*uprights, *shelves, back]


def posts() -> list[Obstacle]:
    """A post between the arms and one in front of each."""
    return [
        Obstacle(name="post", cylinder={"radius": 0.06, "length": 0.9}, position=(0.45, 0.0, 0.45)),
        Obstacle(name="left_post", box=(0.08, 0.08, 0.7), position=(0.5, 0.45, 0.35)),
        Obstacle(name="right_post", box=(0.08, 0.08, 0.7), position=(0.5, -0.45, 0.35)),
    ]


def table() -> list[Obstacle]:
    """A table in front of Baxter with three posts on it."""
    return [
        Obstacle(name="table", box=(0.7, 1.8, 0.04), position=(0.85, 0.0, -0.22)),
        Obstacle(name="middle_post", box=(0.06, 0.06, 0.4), position=(0.75, 0.0, 0.0)),
        Obstacle(name="left_post", cylinder={"radius": 0.04, "length": 0.5}, position=(0.75, 0.38, 0.05)),
        Obstacle(name="right_post", cylinder={"radius": 0.04, "length": 0.5}, position=(0.75, -0.38, 0.05)),
    ]


def bin_between() -> list[Obstacle]:
    """An open bin on the tables between the arms."""
    (x, y), (long, wide, high), wall = (0.55, 0.0), (0.4, 0.6, 0.2), 0.02
    return [
        Obstacle(name="bin_bottom", box=(long, wide, wall), position=(x, y, wall / 2)),
        Obstacle(name="bin_near", box=(wall, wide, high), position=(x - long / 2, y, high / 2)),
        Obstacle(name="bin_far", box=(wall, wide, high), position=(x + long / 2, y, high / 2)),
        Obstacle(name="bin_left", box=(long, wall, high), position=(x, y + wide / 2, high / 2)),
        Obstacle(name="bin_right", box=(long, wall, high), position=(x, y - wide / 2, high / 2)),
    ]


def wall_between(height: float = 0.62) -> Callable[[], list[Obstacle]]:
    """A wall that stands between the two hands, and a lamp that hangs over it."""

    def scene() -> list[Obstacle]:
        lamp = Obstacle(name="lamp", sphere={"radius": 0.12}, position=(0.5, 0.0, 1.0))
        return [Obstacle(name="wall", box=(0.7, 0.06, height), position=(0.55, 0.0, height / 2)), lamp]

    return scene


def two_walls() -> list[Obstacle]:
    """A wall on the inner side of each hand."""
    size = (0.7, 0.04, 0.5)
    return [
        Obstacle(name=f"{side}_wall", box=size, position=(0.5, y, 0.25)) for side, y in (("left", 0.2), ("right", -0.2))
    ]


RECIPES: tuple[Reach | Align, ...] = (
    Reach(
        "problems/data/shelf_swap.yaml", "dual_panda_softhand", shelf,
        (HandPose((0.68, 0.06, 0.87), FORWARD), HandPose((0.68, -0.48, 0.27), FORWARD)),
        (HandPose((0.68, 0.48, 0.27), FORWARD), HandPose((0.68, -0.06, 0.87), FORWARD)),
        synergies=(0.3, 0.3),
    ),
    Reach(
        "problems/data/reach_past_post.yaml", "dual_panda_softhand", posts,
        (HandPose((0.55, 0.72, 0.20), DOWN), HandPose((0.55, -0.72, 0.20), DOWN)),
        (HandPose((0.55, 0.16, 0.20), DOWN), HandPose((0.55, -0.16, 0.20), DOWN)),
        synergies=(0.0, 0.0),
    ),
    Reach(
        "problems/data/pack_bin.yaml", "dual_panda_softhand", bin_between,
        (HandPose((0.55, 0.52, 0.22), DOWN), HandPose((0.55, -0.52, 0.22), DOWN)),
        (HandPose((0.55, 0.13, 0.16), DOWN), HandPose((0.55, -0.13, 0.16), DOWN)),
        held=parcels,
    ),
    Reach(
        "examples/baxter_table.yaml", "baxter", table,
        (HandPose((0.75, 0.62, 0.0), DOWN), HandPose((0.75, -0.62, 0.0), DOWN)),
        (HandPose((0.75, 0.14, 0.0), DOWN), HandPose((0.75, -0.14, 0.0), DOWN)),
    ),
    Align(
        "problems/data/stack_boxes.yaml", wall_between(), boxes,
        Alignment(kind="vertical", first="lower", second="upper"),
    ),
    Align(
        "problems/data/ball_in_cup.yaml", two_walls, cup_and_ball,
        Alignment(kind="horizontal", first="cup", second="ball"),
    ),
    Align(
        "problems/data/peg_in_hole.yaml", two_walls, block_and_peg,
        Alignment(kind="horizontal", first="block", second="peg", distance=0.02),
    ),
    Align(
        "problems/data/pour.yaml", wall_between(), two_cups,
        Alignment(kind="pour", first="full", second="empty"),
    ),
    Align(
        "problems/data/handover.yaml", wall_between(), bar,
        Alignment(kind="handover", first="bar", second="right_hand"),
    ),
)  # fmt: skip


def cup_obj(radius: float = 0.04, wall: float = 0.004, height: float = 0.13, sides: int = 24) -> str:
    """Return a cup as OBJ text: a closed surface around z, opening towards +z, centred on the origin."""
    low, high, inner = -height / 2, height / 2, radius - wall
    profile = [(0.0, low), (radius, low), (radius, high), (inner, high), (inner, low + wall), (0.0, low + wall)]
    return _lathe(profile, sides)


def _lathe(profile: Sequence[tuple[float, float]], sides: int) -> str:
    """Return the solid of revolution of a profile (radius, z) that starts and ends on the axis, as OBJ text."""
    lines = [f"v 0 0 {profile[0][1]:.6g}", f"v 0 0 {profile[-1][1]:.6g}"]
    rings = profile[1:-1]
    for radius, z in rings:
        for k in range(sides):
            turn = 2 * np.pi * k / sides
            lines.append(f"v {radius * np.cos(turn):.6g} {radius * np.sin(turn):.6g} {z:.6g}")

    def at(ring: int, k: int) -> int:
        return 3 + ring * sides + k % sides

    for k in range(sides):
        lines.append(f"f 1 {at(0, k + 1)} {at(0, k)}")
        lines.append(f"f 2 {at(len(rings) - 1, k)} {at(len(rings) - 1, k + 1)}")
        for ring in range(len(rings) - 1):
            a, b, c, d = at(ring, k), at(ring, k + 1), at(ring + 1, k + 1), at(ring + 1, k)
            lines += [f"f {a} {b} {c}", f"f {a} {c} {d}"]
    return "\n".join(lines) + "\n"


def block_obj(edge: float = 0.08, hole: float = 0.042, depth: float = 0.07, floor: float = 0.01) -> str:
    """Return a block with a square blind hole as OBJ text, opening towards +z, centred on the origin."""
    low, high = -depth / 2, depth / 2
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    levels = [(edge / 2, low), (edge / 2, high), (hole / 2, high), (hole / 2, low + floor)]
    lines = [f"v {x * half:.6g} {y * half:.6g} {z:.6g}" for half, z in levels for x, y in corners]
    lines += ["f 1 3 2", "f 1 4 3", "f 13 14 15", "f 13 15 16"]
    for level in range(3):
        for k in range(4):
            a, b = 1 + 4 * level + k, 1 + 4 * level + (k + 1) % 4
            lines += [f"f {a} {b} {b + 4}", f"f {a} {b + 4} {a + 4}"]
    return "\n".join(lines) + "\n"


def hold(robot: Robot, held: HandObjects) -> tuple[tuple[AttachedObject, ...], np.ndarray]:
    """Return what the hands hold and a home state that holds it, and say how it is held."""
    objects, home, grasps = close_hands(robot, held)
    for closed in grasps:
        print(f"  {closed.held.name}: synergy {closed.synergy:.3f}, first touch {closed.touched or 'none'}")
    return objects, home


def hand_states(
    robot: Robot,
    checker: CollisionChecker,
    home: np.ndarray,
    poses: tuple[HandPose, HandPose],
    *,
    seed: int,
    count: int,
) -> list[np.ndarray]:
    """Return free states with both hands at their poses."""
    rng, links = np.random.default_rng(seed), Links.of(robot)
    targets = []
    fixed = [robot.joint_names.index(h.synergy) for h in robot.hands.values() if h.synergy]
    for hand, pose in zip(robot.hands.values(), poses, strict=True):
        targets.append(offset_target(in_world(pose.point), links.point(hand.palm, hand.point)))
        targets.append(opposition_target(links.direction(hand.palm, hand.fingers), in_world(pose.fingers), -1.0))
    inverse = links.inverse(targets, fixed)
    found: list[np.ndarray] = []
    for _ in range(4000):
        q0 = home + rng.normal(0.0, 0.6, robot.dof)
        q0[fixed] = home[fixed]
        end = inverse.descend(q0)
        q = end.states[0]
        if end.errors[0] < 1e-3 and checker.is_free(q) and checker.clearance(q) > MARGIN:
            found.append(np.round(q, 4))
            if len(found) == count:
                break
    return found


def named(robot: Robot, q: np.ndarray) -> dict[str, float]:
    """Return a state as joint name -> value."""
    return dict(zip(robot.joint_names, q.tolist(), strict=True))


def is_hard_enough(problem: Problem, robot: Robot) -> bool:
    """Whether no straight line solves a problem for seed 0, and rrtconnect does for three seeds."""
    ready = assemble(problem, robot, seed=0)
    lines = [np.array([ready.start, goal]) for goal in ready.goals]
    if not lines or any(full_check(ready.checker, line) for line in lines):
        return False
    results = [plan(problem, "rrtconnect", timeout=10.0, seed=seed) for seed in range(3)]
    print("  " + ", ".join(f"{r.status} {r.times['total']:.2f} s {r.reason}" for r in results), flush=True)
    return all(results)


def find_reach(recipe: Reach) -> Problem:
    """Return the problem of a reaching recipe."""
    robot = load_robot(recipe.robot)
    scene = tuple(recipe.scene())
    attached, home = hold(robot, recipe.held())
    for joint, value in zip((h.synergy for h in robot.hands.values()), recipe.synergies, strict=False):
        home[robot.joint_names.index(str(joint))] = value
    checker = CollisionChecker(robot, scene, attached)
    starts = hand_states(robot, checker, home, recipe.start, seed=1, count=6)
    goals = hand_states(robot, checker, home, recipe.goal, seed=2, count=6)
    print(f"  {len(starts)} starts, {len(goals)} goals")
    pairs = sorted((float(np.linalg.norm(a - b)), i, j) for i, a in enumerate(starts) for j, b in enumerate(goals))
    for _, i, j in pairs:
        problem = Problem(
            name=Path(recipe.file).stem, robot=robot.name, scene=scene, attached=attached,
            start=named(robot, starts[i]), goal=Goal(joints=(named(robot, goals[j]),)),
        )  # fmt: skip
        if is_hard_enough(problem, robot):
            return problem
    raise SystemExit("no pair of start and goal will do")


def find_align(recipe: Align) -> Problem:
    """Return the problem of an alignment recipe: from a random free start with the hands well apart."""
    robot = load_robot("dual_panda_softhand")
    scene = tuple(recipe.scene())
    attached, home = hold(robot, recipe.held())
    checker = CollisionChecker(robot, scene, attached)
    rng = np.random.default_rng(recipe.seed)
    fixed = [robot.joint_names.index(str(h.synergy)) for h in robot.hands.values()]
    palms = [h.palm for h in robot.hands.values()]
    for _ in range(4000):
        start = home + rng.normal(0.0, 0.35, robot.dof)
        start[fixed] = home[fixed]
        start = np.round(np.clip(start, robot.limits.lower, robot.limits.upper), 4)
        left, right = (robot.link_pose(start, palm)[:3, 3] for palm in palms)
        apart = np.linalg.norm(left - right) > 0.4 and 0.1 < min(left[2], right[2]) and max(left[2], right[2]) < 0.4
        if not apart or not checker.is_free(start) or checker.clearance(start) < MARGIN:
            continue
        problem = Problem(
            name=Path(recipe.file).stem, robot=robot.name, scene=scene, attached=attached,
            start=named(robot, start), goal=Goal(alignment=recipe.alignment),
        )  # fmt: skip
        if is_hard_enough(problem, robot):
            return problem
    raise SystemExit("no start will do")


def with_relative_meshes(problem: Problem) -> Problem:
    """Return the problem with its meshes named from the folder of the file."""

    def moved(body: AttachedObject) -> AttachedObject:
        if body.mesh is None:
            return body
        return body.model_copy(update={"mesh": body.mesh.model_copy(update={"file": Path(body.mesh.file).name})})

    return problem.model_copy(update={"attached": tuple(moved(body) for body in problem.attached)})


def main() -> None:
    """Write the meshes, and find the problems named, or all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*")
    names = parser.parse_args().names
    (DATA / "cup.obj").write_text(cup_obj())
    (DATA / "block.obj").write_text(block_obj())
    for recipe in RECIPES:
        name = Path(recipe.file).stem
        if not names or name in names:
            print(name, flush=True)
            problem = find_reach(recipe) if isinstance(recipe, Reach) else find_align(recipe)
            with_relative_meshes(problem).save(ROOT / recipe.file)


if __name__ == "__main__":
    run_script(main)
