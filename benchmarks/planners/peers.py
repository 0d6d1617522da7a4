"""RoboPlan's RRT-Connect (C++ on Pinocchio and Coal) beside apex and rrtconnect, on the same problems.

RoboPlan loads this project's URDF, with the same pairs of links, obstacles and held objects; how often it agrees with
the collision checker on random states is part of the results. It plans with the same spacing of states, as a Euclidean
distance, which is finer than the greatest step of a joint that OMPL's planners use here. What differs: it proves no
motions by clearance; its paths are shortened by its own shortcuts; of several goals it takes the first. Its paths then
go through the stages of rrtconnect's: the shortened one has to pass the full check, or is repaired; where that fails,
the path as it was found is tried. First-path times are accounted as in apex_ompl.evaluation. None tries the straight
line before it plans, but apex, which does so itself. Problems with shapes that RoboPlan does not have are left out.
Each run is stored in benchmarks/runs/peers when it ends; the command resumes where it was stopped.

Usage: python -m benchmarks.planners.peers [SUITE[/LEVEL] ...] [-n 30] [--jobs 1]    (needs the extra "peers")
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from apex_ompl.api import load_problem
from apex_ompl.evaluation import Results, Row, Workers, bench
from apex_ompl.evaluation.rows import Job
from apex_ompl.evaluation.runs import NO_PROBLEM, Run, first_path_proof
from apex_ompl.evaluation.summary import Statistics
from apex_ompl.ompl.setup import PlanningSetup, assemble
from apex_ompl.ompl.tuned import TUNED
from apex_ompl.paths.path import SEARCH_RESOLUTION, path_length
from apex_ompl.robot import Robot
from apex_ompl.robot.model import link_of
from apex_ompl.scene.bodies import Body, pose_matrix
from apex_ompl.scene.problem import Problem
from apex_ompl.types import Array
from apex_ompl.util.clocks import Deadline, timed
from apex_ompl.util.entry_point import run_script
from benchmarks.lib import record
from benchmarks.lib.full_check import proved_or_repaired

try:
    from roboplan.core import (
        Box,
        Cylinder,
        JointConfiguration,
        Mesh,
        PathShortcutter,
        PathShortcuttingOptions,
        Scene,
        Sphere,
        loadUrdfSceneDescriptionFromXml,
    )
    from roboplan.rrt import RRT, RRTOptions
except ImportError as error:
    sys.exit(f"peers.py: error: no RoboPlan ({error}), expected: pip install 'apex-ompl[peers]'")


DEPENDS = ("@benchmark",)
FOLDER = Path(__file__).parents[1] / "runs" / "peers"
TIMEOUT = 10.0  # [s]
RUNNER = "benchmarks.planners.peers:plan_with_roboplan"
ROWS = (
    Row("apex", "apex"),
    Row("rrtconnect", "rrtconnect"),
    Row.of("rrtconnect", TUNED["rrtconnect"]),
    Row("roboplan", "roboplan", runner=RUNNER),
    Row.of("roboplan", TUNED["roboplan"], runner=RUNNER),
)
NODES = 1_000_000  # most of RoboPlan's trees
GROUPS = ("all hard", "all")
STATES = 200  # on which the checkers are compared, for each problem
ORIGIN = np.eye(4)
COLOR = np.array([0.5, 0.5, 0.5, 1.0])


def representable(problem: Problem) -> bool:
    """Whether RoboPlan has all shapes of a problem."""
    bodies = (*problem.scene, *problem.attached)
    return all(body.box or body.sphere or body.cylinder or body.mesh for body in bodies)


def bare_frame(machine: Robot, link: str) -> str:
    """Return a link without geometry that is fixed to a link: RoboPlan takes a link for all geometry in its frame."""
    there = {link_of(machine.model, item) for item in machine.geometry.geometryObjects}
    joint = machine.model.frames[machine.link_frame(link)].parentJoint
    fixed = [frame.name for frame in machine.model.frames if frame.parentJoint == joint and frame.name not in there]
    return next(name for name in fixed if name in machine.link_names)


def add(scene: Scene, body: Body, frame: str, at: Array = ORIGIN) -> None:
    """Add a solid to a scene, posed at ``at`` in the frame of the joint that a link is fixed to."""
    pose = np.asfortranarray(at @ pose_matrix(body.position, body.orientation))
    if body.box is not None:
        scene.addBoxGeometry(body.name, frame, Box(*body.box), pose, COLOR)
    elif body.sphere is not None:
        scene.addSphereGeometry(body.name, frame, Sphere(body.sphere.radius), pose, COLOR)
    elif body.cylinder is not None:
        shape = Cylinder(body.cylinder.radius, body.cylinder.length)
        scene.addCylinderGeometry(body.name, frame, shape, pose, COLOR)
    elif body.mesh is not None:
        shape = Mesh(body.mesh.file, np.array(body.mesh.scale))
        scene.addMeshGeometry(body.name, frame, shape, pose, COLOR)


def roboplan_scene(ready: PlanningSetup) -> Scene:
    """Return the RoboPlan scene of a problem: the robot, its fixtures, obstacles and held objects."""
    machine, problem = ready.robot, ready.problem
    scene = Scene("problem", loadUrdfSceneDescriptionFromXml(machine.urdf, []))
    items = list(machine.geometry.geometryObjects)
    links = {link_of(machine.model, item): item.parentJoint for item in items}
    objects = machine.geometry.geometryObjects
    pairs = machine.geometry.collisionPairs
    checked = {frozenset(link_of(machine.model, objects[k]) for k in (pair.first, pair.second)) for pair in pairs}
    names = sorted(links)
    apart = [(a, b) for k, a in enumerate(names) for b in names[k + 1 :] if frozenset((a, b)) not in checked]
    scene.setCollisions(apart, False)
    still = [*machine.fixtures, *problem.scene]
    for body in still:
        add(scene, body, "world")
    bases = [link for link, joint in links.items() if joint == 0]  # that do not move
    off = [(link, body.name) for link in bases for body in still]
    off += [(a.name, b.name) for k, a in enumerate(still) for b in still[k + 1 :]]
    scene.setCollisions(off, False)
    for held in problem.attached:
        joint, place = links[held.link], machine.model.frames[machine.link_frame(held.link)].placement
        add(scene, held, bare_frame(machine, held.link), place.homogeneous)
        touched = machine.hand_of(held.link) if held.touch_links is None else held.touch_links
        scene.setCollisions([(held.name, link) for link, on in links.items() if link in touched or on == joint], False)
    return scene


def agreement(ready: PlanningSetup, scene: Scene, rng: np.random.Generator) -> list[int]:
    """Return the numbers of random states: free to both, colliding, free to RoboPlan alone, to the checker alone."""
    ends = np.stack([ready.start, ready.goals[0]])
    limits = ready.robot.limits
    states = ends[rng.integers(2, size=STATES)] + rng.normal(0.0, 0.3, (STATES, ready.robot.dof))
    counts = [0, 0, 0, 0]
    for q in np.clip(states, limits.lower, limits.upper):
        theirs, ours = not scene.hasCollisions(ready.robot.to_pinocchio(q)), ready.checker.is_free(q)
        counts[{(True, True): 0, (False, False): 1, (True, False): 2, (False, True): 3}[theirs, ours]] += 1
    return counts


def plan_with_roboplan(job: Job) -> Run:
    """Return the columns of a run of RoboPlan; ``agreement`` as :func:`agreement` returns it.

    Parameters of the job are those of ``RRTOptions``, whose defaults hold otherwise.
    """
    problem = load_problem(job.problem)
    if not representable(problem):
        return {"solved": False, "status": NO_PROBLEM, "reason": "it has shapes that RoboPlan has not"}
    ready = assemble(problem)
    scene = roboplan_scene(ready)
    same = agreement(ready, scene, np.random.default_rng(job.seed))
    names = list(scene.getJointNames())
    deadline = Deadline(job.timeout)
    options = RRTOptions(
        max_nodes=NODES, collision_check_step_size=SEARCH_RESOLUTION, max_planning_time=deadline.for_search,
        rrt_connect=True, **job.params,
    )  # fmt: skip
    planner = RRT(scene, options)
    planner.setRngSeed(job.seed)
    start, goal = (JointConfiguration(names, ready.robot.to_pinocchio(q)) for q in (ready.start, ready.goals[0]))
    times = dict[str, float]()
    try:
        deadline.restart(job.timeout)
        with timed(times, "solve"):
            found = planner.plan(start, goal)
    except RuntimeError as error:
        return {"solved": False, "reason": str(error)[:80], "times": times, "agreement": same}
    with timed(times, "simplify"):
        shortcuts = PathShortcuttingOptions(max_step_size=SEARCH_RESOLUTION, seed=job.seed)
        shortened = PathShortcutter(scene, shortcuts).shortcut(found)
    order = [names.index(joint) for joint in ready.robot.joint_names]
    candidates = [np.array(path.positions)[:, order] for path in (shortened, found)]
    for states in candidates:
        states[0], states[-1] = ready.start, ready.goals[0]
    path, reason = proved_or_repaired(ready, candidates, deadline.at, times)
    total = sum(times.values())
    first = times["solve"] + first_path_proof(ready.checker, candidates[-1], ready.start, ready.goals, times)
    return {
        "solved": path is not None, "first": first if path is not None else None, "total": total, "times": times,
        "length": None if path is None else path_length(path), "reason": reason, "agreement": same,
    }  # fmt: skip


def summary(runs: Sequence[Run]) -> dict[str, Any]:
    """Return the statistics of a row on some levels."""
    found = Statistics("", "", runs)
    same = np.sum([run["agreement"] for run in runs if "agreement" in run] or [[0] * 4], axis=0)
    lengths = found.median("length")
    return {
        "n": len(runs), "solved": len(found.solved) / len(runs),
        "failed_check": sum("repair" in run["times"] for run in runs),
        "first_s": [record.reached(found.times("first"), p) for p in (50, 95)],
        "total_s": [record.reached(found.times("total"), p) for p in (50, 95)],
        "length": None if np.isnan(lengths) else lengths, "agreement": same.tolist(),
    }  # fmt: skip


def is_of(problem: str, level: str) -> bool:
    """Whether a problem is one of a level, or of several levels together."""
    return problem.startswith(f"{level}/") or level == "all" or (level == "all hard" and "/hard/" in problem)


def tabulate(results: Results, levels: Sequence[str]) -> tuple[dict[str, Any], str]:
    """Return the statistics of each row on each level and group of levels, and a Markdown table of them."""
    head = ["level", "method", "N", "solved", "failed the check at first", "first ms p50", "p95", "end ms p50", "p95"]
    lines = [record.row([*head, "length rad"]), record.row(["---", "---", *["---:"] * (len(head) - 1)])]
    found: dict[str, Any] = {}
    for level in (*levels, *GROUPS):
        for k, row in enumerate(ROWS):
            runs = [run for run in results.runs if run["label"] == row.label and is_of(run["problem"], level)]
            if not runs:
                continue
            f = found[f"{level}, {row.label}"] = summary(runs)
            times = ["-" if v is None else f"{1e3 * v:.0f}" for v in (*f["first_s"], *f["total_s"])]
            length = "-" if f["length"] is None else f"{f['length']:.1f}"
            cells = [level if k == 0 else "", row.label, f["n"], f"{f['solved']:.2f}", f["failed_check"], *times]
            lines.append(record.row([*cells, length]))
    return found, "\n".join(lines)


def main() -> None:
    """Run what is missing, and write the results of all."""
    parser = record.parser(__doc__, n=30, jobs=1)
    parser.add_argument("levels", nargs="*", metavar="SUITE[/LEVEL]")
    parser.add_argument("--split", choices=("validation", "test"), default="test")
    parser.add_argument("--store", type=Path, default=FOLDER, help="folder of the runs")
    parser.add_argument("--name", default="peers", help="of the results (default: %(default)s)")
    args = parser.parse_args()
    levels = record.static_levels(args.levels)
    results = bench(
        levels, ROWS, args.store, runs=args.n, timeout=TIMEOUT, split=args.split, workers=Workers(args.jobs),
        provenance=record.session(),
    )  # fmt: skip
    wanted = [run for run in results.runs if run["experiment"] in levels and run["seed"] < args.n]
    left_out = {run["problem"] for run in wanted if run["status"] == NO_PROBLEM}
    results = replace(results, runs=[run for run in wanted if run["problem"] not in left_out])
    found, table = tabulate(results, levels)
    same = np.sum([f["agreement"] for name, f in found.items() if name.startswith("all,")] or [[0] * 4], axis=0)
    words = "both free, both colliding, free to RoboPlan alone, free to the checker alone"
    table += f"\n\nRandom states near starts and goals: {', '.join(str(n) for n in same)} ({words}). "
    table += f"{len(left_out)} problems have shapes that RoboPlan has not, and are left out."
    record.write(
        args.name, {"levels": found}, table, split=args.split, limit=f"{TIMEOUT:g} s",
        seeds="number of the problem modulo 1000", roboplan=version("roboplan"), **record.made_with(results),
    )  # fmt: skip


if __name__ == "__main__":
    run_script(main)
