"""Draw every ready-made problem, and the motions that README and pages of docs show, into docs/pictures.

Usage: python scripts/make_pictures.py
"""

from __future__ import annotations

import argparse
from pathlib import Path

from apex_ompl import load_problem, plan, problems
from apex_ompl.util.entry_point import run_script
from apex_ompl.viz.plots import plot_motion
from apex_ompl.viz.render import render

OUT = Path(__file__).resolve().parent.parent / "docs" / "pictures"
SIZE = (960, 720)
MOVING = "vertical/moving-large-0.2/900003"
FROM_BEHIND = {"shelf_swap": 150.0}
IMITATED = "vertical/medium/800001"  # the first problem of its level that il solves, and no straight line
BASELINES = {
    "gpmp2": ("gpmp2", {}), "il": ("il", {}), "damon_2": ("damon", {"model": "damon-2"}),
    "damon_8": ("damon", {"model": "damon-8"}),
}  # fmt: skip


def main() -> None:
    """Draw the problems and motions."""
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    OUT.mkdir(parents=True, exist_ok=True)
    for name in problems.names():
        render(load_problem(name), OUT / f"{name}.png", SIZE, FROM_BEHIND.get(name, 26.0))
        print(OUT / f"{name}.png")
    for name in ("ball_in_cup", "carry_tray"):
        render(plan(name, timeout=20.0), OUT / f"{name}_motion.png", (1280, 960))
        print(OUT / f"{name}_motion.png")
    render(plan(MOVING, timeout=20.0), OUT / "moving.png", (1280, 960))
    print(OUT / "moving.png")
    for name, (planner, params) in BASELINES.items():
        found = plan(IMITATED, planner=planner, params=params, timeout=20.0)
        render(found, OUT / f"baseline_{name}.png", (640, 480))
        print(OUT / f"baseline_{name}.png", found.solved_by, f"{found.length:.2f} rad")
    plot_motion(plan("shelf_swap", timeout=20.0), OUT / "shelf_swap_timing.png")
    print(OUT / "shelf_swap_timing.png")


if __name__ == "__main__":
    run_script(main, "viz")
