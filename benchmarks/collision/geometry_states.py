"""States that the kernel decides among meshes, points and voxels, checked by Coal's triangles and point by point.

Scenes are those of ``geometry.py``: validation problems with their obstacles as meshes, points or voxels, and scenes of
a large mesh that is not convex. States are drawn around starts and goals, where few are far from obstacles. Those that
the kernel proves free, or to collide, are given to the second stage alone: triangles by Coal's trees, each point's ball
against each link's triangles by trees of their own (which the tests compare with Coal ball by ball).

Usage: python -m benchmarks.collision.geometry_states [--states 1000000] [--jobs 2]
"""

from __future__ import annotations

import tempfile
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
from tqdm import tqdm

from apex_ompl import load_problem, problems
from apex_ompl.collision import CollisionChecker
from apex_ompl.kernel.kernel import COLLIDES
from apex_ompl.problems.suite_robot import robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import one_or_more
from benchmarks.collision import geometry
from benchmarks.collision.geometry_versions import version
from benchmarks.lib import record

DEPENDS = ("@checking", "benchmarks/collision/geometry.py", "benchmarks/collision/geometry_versions.py")
KINDS = ("meshes", "points", "voxels", "large")
EACH = 4000  # states of a scene


def count_states(kind: str, number: int) -> tuple[int, int, int, int, int]:
    """Return numbers of a scene's states: proved free, of these colliding, free, proved to collide, of these free."""
    names = [n for level in geometry.LEVELS for n in problems.frozen_names(*level.split("/"), "validation")]
    rng = np.random.default_rng(number)
    problem = load_problem(names[number % len(names)])
    ends = problem.start_state(robot().joint_names), problem.goal_states(robot().joint_names)[0]
    states = np.concatenate([end + rng.normal(0.0, 0.3, (EACH // 2, len(end))) for end in ends])
    states = np.clip(states, robot().limits.lower, robot().limits.upper)
    with tempfile.TemporaryDirectory() as folder:
        if kind == "large":
            geometry.large_mesh(rng, number).export(Path(folder) / "large.stl")
            place = tuple(rng.uniform([0.35, -0.3, 0.3], [0.7, 0.3, 0.8]).tolist())
            scene = (Obstacle(name="large", mesh={"file": str(Path(folder) / "large.stl")}, position=place),)
        else:
            scene = version(problem, kind, Path(folder)).scene
        checker = CollisionChecker(robot(), scene, problem.attached)
        _, counts = checker.kernel.unproved(states)
        proved = states[counts == 0]
        wrong = sum(checker.meshes.collides(robot().to_pinocchio(q)) for q in proved)
        colliding = states[counts == COLLIDES]
        free = sum(not checker.meshes.collides(robot().to_pinocchio(q)) for q in colliding)
        return len(proved), wrong, int(checker.are_free(states).sum()), len(colliding), free


def main() -> None:
    """Count, and write the results."""
    parser = record.parser(__doc__, jobs=2)
    parser.add_argument("--states", type=one_or_more, default=1_000_000, help="of each kind (default: %(default)s)")
    args = parser.parse_args()
    scenes = -(-args.states // EACH)
    head = (
        "kind", "scenes", "states", "free", "proved free by the kernel", "of these in collision",
        "proved to collide by the kernel", "of these free",
    )  # fmt: skip
    rows, figures = [record.row([*head]), record.row(["---", *["---:"] * (len(head) - 1)])], {}
    with ProcessPoolExecutor(args.jobs) as pool:
        for kind in KINDS:
            done = pool.map(count_states, [kind] * scenes, range(scenes))
            counts = np.array(list(tqdm(done, total=scenes, desc=kind))).sum(axis=0).tolist()
            proved, wrong, free, colliding, wrong_colliding = counts
            rows.append(record.row([kind, scenes, scenes * EACH, free, proved, wrong, colliding, wrong_colliding]))
            figures[kind] = {"states": scenes * EACH, "free": free, "proved": proved, "wrong": wrong}
            figures[kind] |= {"colliding": colliding, "wrong_colliding": wrong_colliding}
            record.write("geometry_states", figures, "\n".join(rows), split="validation", seed="number of the scene")


if __name__ == "__main__":
    run_script(main)
