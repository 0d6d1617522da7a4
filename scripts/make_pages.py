"""Write the pages that docs/viewer.md shows into docs/pages.

Usage: python scripts/make_pages.py
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
import trimesh

from apex_ompl import load_problem, plan
from apex_ompl.collision.shapes import coal_geometry
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Problem
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.files import make_folder
from apex_ompl.viz.appearance import mesh_of
from apex_ompl.viz.view import view
from apex_ompl.viz.viewer.shown import Shown

OUT = Path(__file__).resolve().parent.parent / "docs" / "pages"
SHELF, SCANNED = "shelf/hard/900012", "posts/medium/900003"
SPACING = 0.01  # of the points of the cloud [m]


def scanned(problem: Problem, folder: Path) -> Problem:
    """Return a problem in which the obstacles are points on their surfaces."""
    points = []
    for k, body in enumerate(problem.scene):
        mesh = mesh_of(coal_geometry(body))
        found = trimesh.sample.sample_surface_even(mesh, int(mesh.area / SPACING**2), seed=k)[0]
        points.append(np.asarray(found) @ body.pose[:3, :3].T + body.pose[:3, 3])
    np.save(folder / "cloud.npy", np.concatenate(points).astype(np.float32))
    cloud = Obstacle(name="cloud", points={"file": str(folder / "cloud.npy"), "radius": 0.006})
    return problem.model_copy(update={"scene": (cloud,), "name": f"{problem.name}, scanned"})


def main() -> None:
    """Plan, and write the pages."""
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    make_folder(OUT)
    view(plan("ball_in_cup"), OUT / "ball_in_cup.html")
    both = [Shown.of(plan(SHELF, name, timeout=30.0), f"{SHELF} by {name}") for name in ("apex", "rrtconnect")]
    view(both, OUT / "shelf.html")
    with tempfile.TemporaryDirectory() as folder:
        view(plan(scanned(load_problem(SCANNED), Path(folder))), OUT / "cloud.html", cover=True)


if __name__ == "__main__":
    run_script(main)
