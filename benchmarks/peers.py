"""RoboPlan's RRT-Connect (C++ on Pinocchio and Coal) beside apex and rrtconnect, on the same problems.

RoboPlan loads this project's URDF, with the same pairs of links, obstacles and held objects; how often it says of
random states what the checker says is part of the results. It plans with the same spacing of states, as a Euclidean
distance, which is finer than the greatest step of a joint that OMPL's planners go by here. What differs: it has no
proofs of stretches; its paths are shortened by its own shortcuts; of several goals it takes the first. Its paths then
go the way of rrtconnect's: the shortened one has to pass the full check, or is repaired; if it cannot be, the path as
it was found has its turn. The first path counts from when it was found and checked, if it passes, else from the end.
None looks at the straight line before it plans, but apex, which does so itself. Problems with shapes that RoboPlan has
not are left out.

Usage: python benchmarks/peers.py [SUITE[/LEVEL] ...] [-n 30] [--jobs 1]    (needs the extra "peers")
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import record
import torch
from store import RunStore

from apex_ompl import problems
from apex_ompl.benchmark import runs
from apex_ompl.benchmark.rows import Job
from apex_ompl.ompl_adapter.process import quiet_ompl
from apex_ompl.ompl_adapter.repair import repair
from apex_ompl.ompl_adapter.setup import PlanningSetup, assemble
from apex_ompl.ompl_adapter.validity import full_check
from apex_ompl.problems.reach import robot
from apex_ompl.robot import Robot
from apex_ompl.robot.model import link_of
from apex_ompl.scene.bodies import Body, pose_matrix
from apex_ompl.scene.problem import Problem
from apex_ompl.trajopt.path import path_length
from apex_ompl.types import Array
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.resolution import SEARCH_RESOLUTION
from apex_ompl.util.validation import one_or_more

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


STORE = Path(__file__).parent / "runs" / "peers.jsonl"
LIMIT = 10.0  # [s]
METHODS = ("apex", "rrtconnect", "roboplan")
NODES, REACH = 1_000_000, 3.0  # of RoboPlan's trees, and their longest step, its default [rad]
TOGETHER = ("all hard", "all")
STATES = 200  # on which the checkers are compared, for each problem
ORIGIN = np.eye(4)
COLOUR = np.array([0.5, 0.5, 0.5, 1.0])


def carried_over(problem: Problem) -> bool:
    """Whether all shapes of a problem are such that RoboPlan has them."""
    bodies = (*problem.scene, *problem.attached)
    return all(body.box or body.sphere or body.cylinder or body.mesh for body in bodies)


def bare_frame(machine: Robot, link: str) -> str:
    """Return a link without geometry that is fixed to one: the name of a link stands for all geometry in its frame."""
    there = {link_of(machine.model, item) for item in machine.geometry.geometryObjects}
    joint = machine.model.frames[machine.link_frame(link)].parentJoint
    fixed = [frame.name for frame in machine.model.frames if frame.parentJoint == joint and frame.name not in there]
    return next(name for name in fixed if name in machine.link_names)


def add(scene: Scene, body: Body, frame: str, at: Array = ORIGIN) -> None:
    """Add a solid to a scene, posed at ``at`` in the frame of the joint that a link is fixed to."""
    pose = np.asfortranarray(at @ pose_matrix(body.position, body.orientation))
    if body.box is not None:
        scene.addBoxGeometry(body.name, frame, Box(*body.box), pose, COLOUR)
    elif body.sphere is not None:
        scene.addSphereGeometry(body.name, frame, Sphere(body.sphere.radius), pose, COLOUR)
    elif body.cylinder is not None:
        shape = Cylinder(body.cylinder.radius, body.cylinder.length)
        scene.addCylinderGeometry(body.name, frame, shape, pose, COLOUR)
    elif body.mesh is not None:
        shape = Mesh(body.mesh.file, np.array(body.mesh.scale))
        scene.addMeshGeometry(body.name, frame, shape, pose, COLOUR)


def roboplan_scene(ready: PlanningSetup) -> Scene:
    """Return a problem as RoboPlan has it: the robot, its fixtures, obstacles and held objects."""
    machine, problem = ready.robot, ready.problem
    scene = Scene("problem", loadUrdfSceneDescriptionFromXml(machine.urdf, []))
    items = list(machine.geometry.geometryObjects)
    links = {link_of(machine.model, item): item.parentJoint for item in items}
    objects = machine.geometry.geometryObjects
    pairs = machine.geometry.collisionPairs
    judged = {frozenset(link_of(machine.model, objects[k]) for k in (pair.first, pair.second)) for pair in pairs}
    names = sorted(links)
    apart = [(a, b) for k, a in enumerate(names) for b in names[k + 1 :] if frozenset((a, b)) not in judged]
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
    """Return how many random states both call free, both colliding, only RoboPlan free, only the checker free."""
    ends = np.stack([ready.start, ready.goals[0]])
    limits = ready.robot.limits
    states = ends[rng.integers(2, size=STATES)] + rng.normal(0.0, 0.3, (STATES, ready.robot.dof))
    counts = [0, 0, 0, 0]
    for q in np.clip(states, limits.lower, limits.upper):
        theirs, ours = not scene.hasCollisions(ready.robot.to_pinocchio(q)), ready.checker.is_free(q)
        counts[{(True, True): 0, (False, False): 1, (True, False): 2, (False, True): 3}[theirs, ours]] += 1
    return counts


def run(job: tuple[str, str]) -> dict[str, Any]:
    """Return one run."""
    name, method = job
    number = int(name.rsplit("/", 1)[1]) % 1000
    problem = problems.load(name)
    about = {"problem": name, "method": method, "carried": carried_over(problem)}
    if not about["carried"]:
        return {**about, "solved": False}
    if method != "roboplan":
        made = runs.run(Job(name, name, method, method, {}, number, LIMIT, simplify=True))
        told = {key: made[key] for key in ("solved", "first", "total", "length", "reason")}
        return {**about, **told, "failed": "repair" in made["times"]}
    ready = assemble(problem, robot())
    scene = roboplan_scene(ready)
    same = agreement(ready, scene, np.random.default_rng(number))
    names = list(scene.getJointNames())
    options = RRTOptions(
        max_nodes=NODES, max_connection_distance=REACH, collision_check_step_size=SEARCH_RESOLUTION,
        max_planning_time=LIMIT, rrt_connect=True,
    )  # fmt: skip
    planner = RRT(scene, options)
    planner.setRngSeed(number)
    start, goal = (JointConfiguration(names, ready.robot.to_pinocchio(q)) for q in (ready.start, ready.goals[0]))
    begin = time.perf_counter()
    try:
        path = planner.plan(start, goal)
    except RuntimeError as error:
        return {**about, "solved": False, "reason": str(error)[:80], "agreement": same, "failed": False}
    took = time.perf_counter() - begin
    shortcuts = PathShortcuttingOptions(max_step_size=SEARCH_RESOLUTION, seed=number)
    shortened = PathShortcutter(scene, shortcuts).shortcut(path)
    order, mended, failed = [names.index(joint) for joint in ready.robot.joint_names], None, False
    candidates = [np.array(one.positions)[:, order] for one in (shortened, path)]
    for states in candidates:
        states[0], states[-1] = ready.start, ready.goals[0]
        check = full_check(ready.checker, states, ready.start, ready.goals)
        if check:
            mended = states
            break
        failed = True
        with quiet_ompl():
            mended = repair(ready, states, check, begin + LIMIT)
        if mended is not None:
            break
    total = time.perf_counter() - begin
    begin = time.perf_counter()
    first = total
    if full_check(ready.checker, candidates[-1], ready.start, ready.goals):
        first = took + time.perf_counter() - begin
    return {
        **about, "solved": mended is not None, "failed": failed, "first": first, "total": total, "agreement": same,
        "length": None if mended is None else path_length(mended),
        "reason": "" if mended is not None else f"the path found failed the full check and repair, {check.reason}",
    }  # fmt: skip


def warm_up() -> None:
    """Load the kernel, the robot, the model."""
    torch.set_num_threads(1)
    for method in METHODS:
        run(("wall/easy/800000", method))


def figures(made: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return what came of a method on a level."""
    first, total = (np.array([r[key] if r["solved"] else np.inf for r in made]) for key in ("first", "total"))
    lengths = [r["length"] for r in made if r["solved"]]
    same = np.sum([r["agreement"] for r in made if "agreement" in r] or [[0] * 4], axis=0)
    return {
        "n": len(made), "solved": float(np.mean([r["solved"] for r in made])),
        "failed_check": sum(r["failed"] for r in made),
        "first_s": [record.reached(first, p) for p in (50, 95)],
        "total_s": [record.reached(total, p) for p in (50, 95)],
        "length": float(np.median(lengths)) if lengths else None, "agreement": same.tolist(),
    }  # fmt: skip


def is_of(problem: str, level: str) -> bool:
    """Whether a problem is one of a level, or of several levels together."""
    return problem.startswith(f"{level}/") or level == "all" or (level == "all hard" and "/hard/" in problem)


def main() -> None:
    """Run what is missing, and write the results of all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("levels", nargs="*", metavar="SUITE[/LEVEL]")
    parser.add_argument("-n", type=one_or_more, default=30, help="problems of a level (default: %(default)s)")
    parser.add_argument("--jobs", type=one_or_more, default=1, help="runs at a time (default: one, as they are timed)")
    parser.add_argument("--split", choices=("validation", "test"), default="test")
    parser.add_argument("--store", type=Path, default=STORE)
    parser.add_argument("--name", default="peers", help="of the results (default: %(default)s)")
    args = parser.parse_args()
    chosen = record.static_levels(args.levels)
    names = [name for level in chosen for name in problems.frozen_names(*level.split("/"), args.split)[: args.n]]
    jobs = sorted(((n, m) for n in names for m in METHODS), key=lambda job: int(job[0].rsplit("/", 1)[1]))
    store = RunStore(args.store, ("problem", "method"))
    done = store.read()
    store.complete(run, [job for job in jobs if job not in done], args.jobs, warm_up)
    done = store.read()
    head = ["level", "method", "N", "solved", "failed the check at first", "first ms p50", "p95", "end ms p50", "p95"]
    rows = [record.row([*head, "length rad"]), record.row(["---", "---", *["---:"] * (len(head) - 1)])]
    found: dict[str, Any] = {}
    for level in (*chosen, *TOGETHER):
        for k, method in enumerate(METHODS):
            mine = [done[job] for job in jobs if job in done and job[1] == method and is_of(job[0], level)]
            mine = [one for one in mine if one["carried"]]
            if not mine:
                continue
            f = found[f"{level}, {method}"] = figures(mine)
            times = ["-" if v is None else f"{1e3 * v:.0f}" for v in (*f["first_s"], *f["total_s"])]
            length = "-" if f["length"] is None else f"{f['length']:.1f}"
            cells = [level if k == 0 else "", method, f["n"], f"{f['solved']:.2f}", f["failed_check"], *times, length]
            rows.append(record.row(cells))
    same = np.sum([f["agreement"] for name, f in found.items() if name.startswith("all,")] or [[0] * 4], axis=0)
    left = sum(not done[job]["carried"] for job in jobs if job in done) // len(METHODS)
    words = "both free, both colliding, free to RoboPlan alone, free to the checker alone"
    text = f"\n\nRandom states near starts and goals: {', '.join(str(n) for n in same)} ({words}). "
    text += f"{left} problems have shapes that RoboPlan has not, and are left out."
    record.write(
        args.name, {"levels": found}, "\n".join(rows) + text, split=args.split, limit=f"{LIMIT:g} s",
        seeds="number of the problem modulo 1000", roboplan=version("roboplan"),
        **record.made_with(done[job] for job in jobs),
    )  # fmt: skip


if __name__ == "__main__":
    run_script(main)
