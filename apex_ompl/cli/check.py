"""The command ``apex-ompl check``."""

from __future__ import annotations

import argparse

from apex_ompl.api import load_problem
from apex_ompl.ompl.setup import assemble


def run(parsed: argparse.Namespace) -> int:
    """Validate a problem, and print whether start and goal are free."""
    setup = assemble(load_problem(parsed.problem))
    problem = setup.problem
    print(f"{problem.name}: robot {setup.robot.name}, {setup.robot.dof} joints")
    moving = f", moving: {', '.join(problem.moving)}" if problem.moving else ""
    print(f"  scene      {len(problem.scene)} obstacles{moving}")
    if problem.attached:
        print("  held       " + ", ".join(f"{held.name} by {held.link}" for held in problem.attached))
    print(f"  start      {setup.start_fault or 'free'}")
    goal_faults, note = setup.goal_faults, ""
    if problem.moving:  # an obstacle at the goal at time 0 may have left when the robot arrives
        static = tuple(obstacle for obstacle in problem.scene if not obstacle.moving)
        goal_faults = assemble(problem.model_copy(update={"scene": static}), setup.robot).goal_faults
        note = f" (without {', '.join(problem.moving)})"
    for k, fault in enumerate(goal_faults):
        label = "goal" if len(goal_faults) == 1 else f"goal {k}"
        print(f"  {label:<10} {fault or 'free'}{note}")
    for text in setup.notes:
        print(f"  note       {text}")
    return 3 if setup.start_fault or all(goal_faults) else 0
