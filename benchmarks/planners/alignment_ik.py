"""Inverse kinematics of alignment goals: share of random restarts that converge and that are free, and its cost.

For each ready-made alignment, without its obstacles, with the bases 1.0 m and 0.7 m apart.

Usage: python -m benchmarks.planners.alignment_ik [--attempts 300]
"""

from __future__ import annotations

import time

import numpy as np

from apex_ompl import load_problem
from apex_ompl.collision import CollisionChecker
from apex_ompl.goals.alignment import alignment_goal
from apex_ompl.goals.goal_sampling import DESCENT_STEPS, HOME_SPREAD, REACHED, TOLERANCE
from apex_ompl.robot import Robot
from apex_ompl.robot.config import DATA, Part, read_config
from apex_ompl.robot.model import build_robot
from apex_ompl.scene.bodies import Body
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import one_or_more, whole_number
from benchmarks.lib import record

DEPENDS = ("@checking", "apex_ompl/goals", "problems")
PROBLEMS = ("stack_boxes", "ball_in_cup", "peg_in_hole", "pour", "handover")


def robot_with_bases_apart(distance: float) -> Robot:
    """Return the dual Panda with its bases and tables ``distance`` meters apart."""
    path = DATA / "dual_panda_softhand.robot.yaml"
    config = read_config(path)

    def spread(part: Part) -> Part:
        x, y, z = part.position
        return part.model_copy(update={"position": (x, y * distance, z)}) if part.parent == "world" else part

    def shifted(table: Body) -> Body:
        x, y, z = table.position
        return table.model_copy(update={"position": (x, y + float(np.sign(y)) * (distance - 1.0) / 2, z)})

    parts, fixtures = tuple(map(spread, config.parts)), tuple(map(shifted, config.fixtures))
    return build_robot(config.model_copy(update={"parts": parts, "fixtures": fixtures}), path)


def main() -> None:
    """Measure and write."""
    parser = record.parser(__doc__)
    parser.add_argument("--attempts", type=one_or_more, default=300)
    parser.add_argument("--seed", type=whole_number, default=0)
    args = parser.parse_args()
    rows, figures = [], []
    for distance in (1.0, 0.7):
        robot = robot_with_bases_apart(distance)
        for name in PROBLEMS:
            problem = load_problem(name)
            goal = alignment_goal(robot, problem)
            assert goal is not None
            checker = CollisionChecker(robot, (), problem.attached)
            checker.is_free(robot.home)
            start = time.perf_counter()
            noise = np.random.default_rng(args.seed).normal(size=(args.attempts, robot.dof))
            states = np.tile(goal.start, (args.attempts, 1))
            free = goal.inverse.free
            states[:, free] = robot.home[free] + HOME_SPREAD * noise[:, free]
            states = states.clip(robot.limits.lower, robot.limits.upper)
            ends = goal.inverse.descend(states, tolerance=TOLERANCE, max_steps=DESCENT_STEPS)
            reached = ends.states[ends.errors <= REACHED]
            found = reached[checker.are_free(reached)]
            spent = (time.perf_counter() - start) * 1e3
            figure = {
                "problem": name,
                "gap_m": distance,
                "converged": len(reached) / args.attempts,
                "free": len(found) / args.attempts,
                "ms_per_attempt": spent / args.attempts,
                "ms_per_free_goal": spent / max(len(found), 1),
            }
            figures.append(figure)
            shares = [f"{figure[key]:.2f}" for key in ("converged", "free")]
            costs = [f"{figure[key]:.1f}" for key in ("ms_per_attempt", "ms_per_free_goal")]
            rows.append([goal.alignment.kind, name, f"{distance:.1f}", *shares, *costs])
    head = ["kind", "objects of", "bases apart m", "converged", "converged and free", "ms an attempt", "ms a free goal"]
    table = "\n".join(record.row(r) for r in [head, ["---", "---", *["---:"] * 5], *rows])
    record.write("alignment_ik", {"rows": figures}, table, seed=args.seed, N=args.attempts)


if __name__ == "__main__":
    run_script(main)
