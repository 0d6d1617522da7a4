"""Cost of the verdict of one state, and its agreement with a plain loop over all pairs.

For scenes of 3, 10 and 30 boxes: microseconds a state, free and colliding, of the AABB-tree broadphase and of
the loop. Then both judge the same states, half of them uniform or around home, half pushed to within a
thousandth of the way between a free and a colliding state; every disagreement is counted.

Usage: python benchmarks/verdict.py [--states 100000]
"""

from __future__ import annotations

import argparse
import time

import numpy as np
import pinocchio as pin
import record

from apex_ompl.collision import Verdict
from apex_ompl.collision.broadphase import exact_requests
from apex_ompl.problem import Obstacle
from apex_ompl.robot import Robot, load_robot

SCENES = (3, 10, 30)


def boxes(count: int, rng: np.random.Generator) -> list[Obstacle]:
    """Return boxes of 5 to 30 cm in the space in front of the arms, and every third one a cylinder or sphere."""
    scene = []
    for k in range(count):
        position = tuple(rng.uniform([0.2, -0.8, 0.05], [0.9, 0.8, 0.9]))
        if k % 3 == 1:
            scene.append(Obstacle(name=f"o{k}", sphere={"radius": rng.uniform(0.03, 0.1)}, position=position))
        elif k % 3 == 2:
            bar = {"radius": rng.uniform(0.03, 0.06), "length": rng.uniform(0.1, 0.5)}
            scene.append(Obstacle(name=f"o{k}", cylinder=bar, position=position))
        else:
            scene.append(Obstacle(name=f"o{k}", box=tuple(rng.uniform(0.05, 0.3, 3)), position=position))
    return scene


def around_home(robot: Robot, rng: np.random.Generator, count: int) -> np.ndarray:
    """Return states around home, inside the limits, hands anywhere."""
    states = robot.home + rng.normal(0.0, 0.4, (count, robot.dof))
    hands = robot.groups.get("hands", [])
    states[:, hands] = rng.uniform(0.0, 1.0, (count, len(hands)))
    return np.clip(states, robot.limits.lower, robot.limits.upper)


class PlainLoop:
    """The same geometry judged pair by pair, without a broadphase."""

    def __init__(self, verdict: Verdict) -> None:
        """Take the compiled scene of ``verdict``."""
        self.robot, self.scene = verdict.robot, verdict._scene()
        self.data, self.geometry_data = self.robot.model.createData(), exact_requests(self.scene.geometry.createData())

    def is_free(self, q: np.ndarray) -> bool:
        """Whether no pair collides at ``q``."""
        state = self.robot.to_pinocchio(q)
        model = self.robot.model
        return not pin.computeCollisions(model, self.data, self.scene.geometry, self.geometry_data, state, True)


def microseconds(judge: Verdict | PlainLoop, states: np.ndarray, repeats: int = 5) -> float:
    """Return the best mean of several passes over ``states`` [us a state]."""
    best = np.inf
    for _ in range(repeats):
        begin = time.perf_counter()
        for q in states:
            judge.is_free(q)
        best = min(best, (time.perf_counter() - begin) / len(states))
    return best * 1e6


def near_contact(verdict: Verdict, states: np.ndarray, free: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return states on both sides of the border of collision, by bisection between free and colliding ones."""
    inside, outside = states[~free], states[free]
    count = min(len(inside), len(outside))
    found = []
    for a, b in zip(rng.permutation(outside)[:count], rng.permutation(inside)[:count], strict=True):
        low, high = 0.0, 1.0
        for _ in range(10):
            middle = (low + high) / 2
            low, high = (middle, high) if verdict.is_free(a + middle * (b - a)) else (low, middle)
        found += [a + low * (b - a), a + high * (b - a)]
    return np.array(found)


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--states", type=int, default=100_000, help="states judged by both, over all scenes")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    rng = np.random.default_rng(args.seed)
    robot = load_robot("dual_panda_softhand")
    rows, figures = [], []
    share = args.states // len(SCENES) + 1
    for count in SCENES:
        verdict = Verdict(robot, boxes(count, rng))
        loop = PlainLoop(verdict)
        spread = np.concatenate([around_home(robot, rng, share // 3), robot.random_state(rng, share // 6 + 1)])
        free = np.array([verdict.is_free(q) for q in spread])
        tight = near_contact(verdict, spread, free, rng)[: share - len(spread)]
        while len(tight) < share - len(spread):
            more = around_home(robot, rng, share // 3)
            more_free = np.array([verdict.is_free(q) for q in more])
            tight = np.concatenate([tight, near_contact(verdict, more, more_free, rng)])[: share - len(spread)]
        states = np.concatenate([spread, tight])
        tree = np.array([verdict.is_free(q) for q in states])
        plain = np.array([loop.is_free(q) for q in states])
        differ = int((tree != plain).sum())
        free_states, hit_states = spread[free][:1000], spread[~free][:1000]
        us = [microseconds(judge, s) for judge in (verdict, loop) for s in (free_states, hit_states)]
        pairs = len(verdict._scene().geometry.collisionPairs)
        figures.append(
            {"obstacles": count, "pairs": pairs, "tree_free_us": us[0], "tree_colliding_us": us[1],
             "loop_free_us": us[2], "loop_colliding_us": us[3], "states": len(states),
             "near_contact": len(tight), "free_share": float(tree.mean()), "disagreements": differ}
        )  # fmt: skip
        rows.append([count, pairs, *(f"{u:.1f}" for u in us), len(states), len(tight), differ])
    head = ["obstacles", "pairs", "tree free us", "tree colliding us", "loop free us", "loop colliding us"]
    head += ["states judged by both", "of them near contact", "disagreements"]
    table = "\n".join(record.row(r) for r in [head, ["---:"] * len(head), *rows])
    record.write("verdict", {"scenes": figures}, table, seed=args.seed, N=args.states)


if __name__ == "__main__":
    main()
