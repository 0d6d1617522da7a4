"""Find and check the ready-made problems and the example for Baxter, and write their files.

Each problem is a scene and two poses of both hands. Start and goal are found by inverse kinematics from
seeded random states; a pair is kept when both are free with 1 cm to spare, the straight line between them
collides, and rrtconnect finds a path that passes the full check for three seeds.

Usage: python scripts/find_problems.py [NAME ...]
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from apex_ompl.api import plan
from apex_ompl.collision.verdict import Verdict
from apex_ompl.ik import AxisTask, Kinematics, PointTask, Task, solve
from apex_ompl.problem import Goal, Obstacle, Problem
from apex_ompl.robot import Robot, load_robot
from apex_ompl.validity import full_check

ROOT = Path(__file__).resolve().parent.parent
MARGIN = 0.01  # [m]


@dataclass(frozen=True)
class Hands:
    """The links of a robot's two hands, and in their frames a grasp point [m] and where the fingers point."""

    links: tuple[str, str]
    point: tuple[float, float, float]
    fingers: tuple[float, float, float]


HANDS = {
    "dual_panda_softhand": Hands(("left_hand_palm", "right_hand_palm"), (0.0, 0.04, -0.035), (0.0, 1.0, 0.0)),
    "baxter": Hands(("left_gripper", "right_gripper"), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
}


@dataclass(frozen=True)
class HandPose:
    """Where a hand's grasp point goes, and where its fingers point."""

    point: tuple[float, float, float]
    fingers: tuple[float, float, float]


@dataclass(frozen=True)
class Recipe:
    """A problem to find: obstacles, and (left, right) hand poses at start and goal."""

    file: str
    robot: str
    scene: Callable[[], Sequence[Obstacle]]
    start: tuple[HandPose, HandPose]
    goal: tuple[HandPose, HandPose]
    synergies: tuple[float, ...] = ()

    @property
    def name(self) -> str:
        """Name of the problem."""
        return Path(self.file).stem


def shelf() -> list[Obstacle]:
    """A shelf of three columns and three levels in front of both arms: nine boards 2 cm thick."""
    board, depth, front = 0.02, 0.36, 0.56
    columns, levels = (-0.72, -0.24, 0.24, 0.72), (0.12, 0.42, 0.72, 1.02)
    middle = front + depth / 2
    height = levels[-1] - levels[0] + board
    boards = [
        Obstacle(name=f"upright_{k}", box=(depth, board, height), position=(middle, y, sum(levels[::3]) / 2))
        for k, y in enumerate(columns)
    ]
    boards += [
        Obstacle(name=f"board_{k}", box=(depth, columns[-1] - columns[0] + board, board), position=(middle, 0.0, z))
        for k, z in enumerate(levels)
    ]
    back = Obstacle(
        name="back", box=(board, columns[-1] - columns[0] + board, height),
        position=(front + depth + board / 2, 0.0, sum(levels[::3]) / 2),
    )  # fmt: skip
    return [*boards, back]


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


FORWARD, DOWN = (1.0, 0.0, 0.0), (0.0, 0.0, -1.0)
RECIPES = (
    Recipe(
        "problems/data/shelf_swap.yaml", "dual_panda_softhand", shelf,
        (HandPose((0.68, 0.06, 0.87), FORWARD), HandPose((0.68, -0.48, 0.27), FORWARD)),
        (HandPose((0.68, 0.48, 0.27), FORWARD), HandPose((0.68, -0.06, 0.87), FORWARD)),
        (0.3, 0.3),
    ),
    Recipe(
        "problems/data/reach_past_post.yaml", "dual_panda_softhand", posts,
        (HandPose((0.55, 0.72, 0.20), DOWN), HandPose((0.55, -0.72, 0.20), DOWN)),
        (HandPose((0.55, 0.16, 0.20), DOWN), HandPose((0.55, -0.16, 0.20), DOWN)),
        (0.0, 0.0),
    ),
    Recipe(
        "examples/baxter_table.yaml", "baxter", table,
        (HandPose((0.75, 0.62, 0.0), DOWN), HandPose((0.75, -0.62, 0.0), DOWN)),
        (HandPose((0.75, 0.14, 0.0), DOWN), HandPose((0.75, -0.14, 0.0), DOWN)),
    ),
)  # fmt: skip


def hand_states(
    robot: Robot,
    verdict: Verdict,
    poses: tuple[HandPose, HandPose],
    synergies: Sequence[float],
    *,
    seed: int,
    count: int,
) -> list[np.ndarray]:
    """Return free states with both hands at their poses."""
    rng, kinematics = np.random.default_rng(seed), Kinematics(robot)
    tasks: list[Task] = []
    hands = HANDS[robot.name]
    for link, pose in zip(hands.links, poses, strict=True):
        frame = robot.link_frame(link)
        tasks.append(PointTask(frame, np.asarray(hands.point), np.asarray(pose.point)))
        tasks.append(AxisTask(frame, np.asarray(hands.fingers), np.asarray(pose.fingers)))
    synergy = robot.groups.get("hands", np.array([], int))
    found: list[np.ndarray] = []
    for _ in range(4000):
        q0 = robot.home + rng.normal(0.0, 0.6, robot.dof)
        q0[synergy] = synergies
        result = solve(kinematics, tasks, q0)
        if result.error < 1e-3 and verdict.is_free(result.q) and verdict.clearance(result.q) > MARGIN:
            found.append(np.round(result.q, 4))
            if len(found) == count:
                break
    return found


def find(recipe: Recipe) -> Problem:
    """Return the problem of a recipe, or say why there is none."""
    robot = load_robot(recipe.robot)
    scene = list(recipe.scene())
    verdict = Verdict(robot, scene)
    starts = hand_states(robot, verdict, recipe.start, recipe.synergies, seed=1, count=6)
    goals = hand_states(robot, verdict, recipe.goal, recipe.synergies, seed=2, count=6)
    print(f"{recipe.name}: {len(starts)} starts, {len(goals)} goals")
    pairs = sorted(((float(np.linalg.norm(a - b)), i, j) for i, a in enumerate(starts) for j, b in enumerate(goals)))
    for gap, i, j in pairs:
        if full_check(verdict, np.array([starts[i], goals[j]])):
            continue
        problem = Problem(
            name=recipe.name, robot=robot.name, scene=tuple(scene),
            start=dict(zip(robot.joint_names, starts[i].tolist(), strict=True)),
            goal=Goal(joints=(dict(zip(robot.joint_names, goals[j].tolist(), strict=True)),)),
        )  # fmt: skip
        results = [plan(problem, "rrtconnect", timeout=10.0, seed=s) for s in range(3)]
        print(f"  {gap:.1f} rad apart: " + ", ".join(f"{r.status} {r.times['total']:.2f} s" for r in results))
        if all(results):
            return problem
    raise SystemExit(f"{recipe.name}: no pair of start and goal could be solved")


def main() -> None:
    """Find the problems named, or all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*")
    names = parser.parse_args().names
    for recipe in RECIPES:
        if not names or recipe.name in names:
            find(recipe).save(ROOT / recipe.file)


if __name__ == "__main__":
    main()
