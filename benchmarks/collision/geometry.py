"""Meshes, points and voxels beside boxes: answers, first paths, the cost of a state, set-up and memory.

1. Validation problems, each in four versions: as it is; with every box, ball, cylinder and capsule as a mesh; with
   points on them, 5 mm apart, with balls that reach to their surfaces from inside; and as one grid of the cells of 1 cm
   whose centers are inside of them. Whole calls of a kept planner, the first path of apex, and the answers at states
   around the problem's start and goal: those of the mesh must be those of the shapes; points lie inside of these. How
   far proposals of the model are from those among the shapes, with the same noise, over the standard deviation of
   these: two that have nothing to do with each other are 1.4 apart.
2. Scenes of one large mesh that is not convex, up to 40 000 triangles, of the benchmark's own making: arches, rings and
   bumpy balls; starts and goals are the validation problems', free in the scene, and the straight line is not.
3. Proofs of states by the kernel against the number of triangles and points; set-up, and memory.
4. New clouds in a world that is kept: points of a wavy wall as a camera sees it, each in place of the one before,
   with the first query among them, whether the home state is free.

Usage: python -m benchmarks.collision.geometry [-n 60] [--states 2000]
"""

from __future__ import annotations

import resource
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from tqdm import tqdm

from apex_ompl import MotionPlanner, PlanResult, load_model, load_problem, problems
from apex_ompl.apex.models import make_query
from apex_ompl.collision import CollisionChecker
from apex_ompl.model.proposals import TrajectoryModel
from apex_ompl.ompl.process import quiet_ompl
from apex_ompl.problems.suite_robot import robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import one_or_more
from benchmarks.collision.geometry_versions import VERSIONS, version
from benchmarks.lib import record

DEPENDS = ("@planning", "apex_ompl/timing", "apex_ompl/planning", "benchmarks/collision/geometry_versions.py")
LEVELS = ("shelf/medium", "bins/medium", "cage/medium", "posts/medium", "wall/medium", "clutter/medium")
CLOUD, CLOUDS, POINT_RADIUS = 100_000, 25, 0.005  # points of a new cloud, how many, and the radius of points [m]
WARM = 200  # triangles and points of a first one, which compiles what is not compiled yet
COUNTS = (100, 1_000, 10_000, 100_000, 200_000, 1_000_000)
TIMEOUT = 10.0  # [s]
PROPOSALS = 8


def proposed(model: TrajectoryModel, checker: CollisionChecker, ends: Sequence[np.ndarray]) -> np.ndarray:
    """Return proposals of a model, always with the same noise: control points, shape (PROPOSALS, points, dof) [rad]."""
    query, generator = make_query(checker, *ends, point=False), np.random.default_rng(0)
    return model.propose(query, checker.kernel, PROPOSALS, generator=generator).control


def large_mesh(rng: np.random.Generator, kind: int) -> trimesh.Trimesh:
    """Return a closed mesh that is not convex, as large as a piece of furniture."""
    if kind % 3 == 0:  # an arch
        outer = trimesh.creation.annulus(0.25 + 0.1 * rng.random(), 0.45 + 0.1 * rng.random(), 0.15, sections=256)
        return outer.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2.0, [1, 0, 0]))
    if kind % 3 == 1:  # a torus
        return trimesh.creation.torus(0.3 + 0.1 * rng.random(), 0.05 + 0.05 * rng.random(), 200, 100)
    ball = trimesh.creation.icosphere(5, 0.2)
    direction = ball.vertices / np.linalg.norm(ball.vertices, axis=1)[:, None]
    wave = (
        np.sin(5.0 * direction[:, 0] + rng.random() * 6.0)
        * np.sin(4.0 * direction[:, 1])
        * np.sin(6.0 * direction[:, 2])
    )
    ball.vertices = ball.vertices * (1.0 + 0.6 * wave)[:, None]
    return ball


def first_path(result: PlanResult) -> float:
    """Return when the planner had its first path [s]: by the straight line at once."""
    return result.times.get("solve: first", result.times.get("solve", 0.0)) + result.times.get("line", 0.0)


def seen_alike(first: CollisionChecker, second: CollisionChecker, states: np.ndarray) -> tuple[int, int]:
    """Return how many states only the first finds free, and how many only the second."""
    a, b = first.are_free(states), second.are_free(states)
    return int((a & ~b).sum()), int((b & ~a).sum())


def versions(count: int, states: int) -> tuple[list[str], dict[str, Any]]:
    """Measure the versions of problems; return rows and figures."""
    names = [n for level in LEVELS for n in problems.frozen_names(*level.split("/"), "validation")[: -(-count // 6)]]
    names = names[:count]
    solved = dict.fromkeys(VERSIONS, 0)
    paths: dict[str, list[float]] = {kind: [] for kind in VERSIONS}
    calls: dict[str, list[float]] = {kind: [] for kind in VERSIONS}
    setups: dict[str, list[float]] = {kind: [] for kind in VERSIONS}
    unlike: dict[str, list[float]] = {kind: [] for kind in VERSIONS}
    model = load_model("apex")
    answers: dict[str, list[int]] = {kind: [0, 0] for kind in VERSIONS}
    seen = 0
    with quiet_ompl(), MotionPlanner() as planner, tempfile.TemporaryDirectory() as folder:
        planner.plan_problem(load_problem("wall/easy/800000"))
        for name in tqdm(names, unit="problem"):
            problem = load_problem(name)
            rng = np.random.default_rng(len(name))
            ends = problem.start_state(robot().joint_names), problem.goal_states(robot().joint_names)[0]
            drawn = np.concatenate([end + 0.25 * rng.normal(size=(states // 2, len(end))) for end in ends])
            drawn = np.clip(drawn, robot().limits.lower, robot().limits.upper)
            plain = CollisionChecker(robot(), problem.scene, problem.attached)
            wanted = proposed(model, plain, ends)
            spread = np.sqrt(((wanted - wanted.mean(axis=0)) ** 2).mean())
            seen += len(drawn)
            for kind in VERSIONS:
                other = version(problem, kind, Path(folder))
                began = time.perf_counter()
                checker = CollisionChecker(robot(), other.scene, other.attached)
                checker.prepare()
                setups[kind].append(time.perf_counter() - began)
                apart = proposed(model, checker, ends) - wanted
                unlike[kind].append(float(np.sqrt((apart**2).mean()) / spread))
                for k, number in enumerate(seen_alike(plain, checker, drawn)):
                    answers[kind][k] += number
                planner.plan_problem(other, timeout=TIMEOUT)  # the scene is loaded, as at any second plan in it
                began = time.perf_counter()
                result = planner.plan_problem(other, timeout=TIMEOUT)
                calls[kind].append(time.perf_counter() - began)
                solved[kind] += bool(result)
                paths[kind].append(first_path(result) if result.path is not None else np.inf)
    times = [f"{what} ms p50" for what in ("first path", "whole call", "set-up once")]
    head = ("version", "N", "solved", *(cell for time in times for cell in (time, "p95")),
            "proposals' distance p50", "p95", "states", "free among the shapes alone", "free here alone")  # fmt: skip
    rows = [record.row([*head]), record.row(["---", *["---:"] * (len(head) - 1)])]
    for kind in VERSIONS:
        columns = [f"{1e3 * v:.0f}" for some in (paths, calls, setups) for v in record.percentiles(some[kind], 50, 95)]
        columns += [f"{v:.2f}" for v in record.percentiles(unlike[kind], 50, 95)]
        rows.append(record.row([kind, len(names), f"{solved[kind] / len(names):.3f}", *columns, seen, *answers[kind]]))
    return rows, {"first path": paths, "call": calls, "setup": setups, "answers": answers, "unlike": unlike}


def large(count: int) -> tuple[list[str], dict[str, Any]]:
    """Measure scenes of one large mesh; return rows and figures."""
    names = [n for level in LEVELS for n in problems.frozen_names(*level.split("/"), "validation")]
    rng = np.random.default_rng(0)
    paths: list[float] = []
    calls: list[float] = []
    setups: list[float] = []
    triangles: list[int] = []
    stages: dict[str, list[float]] = {}
    with quiet_ompl(), MotionPlanner() as planner, tempfile.TemporaryDirectory() as folder:
        planner.plan_problem(load_problem("wall/easy/800000"))
        bar = tqdm(total=count, unit="scene")
        while len(calls) < count:
            problem = load_problem(names[int(rng.integers(len(names)))])
            mesh = large_mesh(rng, len(calls))
            file = Path(folder) / f"{len(setups)}-{rng.integers(10**9)}.stl"
            mesh.export(file)
            place = tuple(rng.uniform([0.35, -0.3, 0.3], [0.7, 0.3, 0.8]).tolist())
            turn = tuple(trimesh.transformations.random_quaternion(rng.random(3))[[1, 2, 3, 0]].tolist())
            body = Obstacle(name="large", mesh={"file": str(file)}, position=place, orientation=turn)
            scene = problem.model_copy(update={"scene": (body,)})
            began = time.perf_counter()
            checker = CollisionChecker(robot(), scene.scene, scene.attached)
            checker.prepare()
            took = time.perf_counter() - began
            ends = problem.start_state(robot().joint_names), problem.goal_states(robot().joint_names)[0]
            if not checker.are_free(np.array(ends)).all() or checker.prove(np.array(ends), tolerance=0.0):
                continue  # starts and goals are free, and the straight line is not
            planner.world.load(scene)
            began = time.perf_counter()
            result = planner.plan_problem(scene, timeout=TIMEOUT)
            calls.append(time.perf_counter() - began)
            setups.append(took)
            triangles.append(len(mesh.faces))
            paths.append(first_path(result) if result.path is not None else np.inf)
            for stage in ("setup", "line", "solve", "verify", "timing", "timing proof"):
                stages.setdefault(stage, []).append(result.times.get(stage, 0.0))
            bar.update()
    head = ("N", "triangles p50", "solved", "first path ms p50", "p95", "whole call ms p50", "p95",
            *(f"{stage} ms p50" for stage in ("set-up once", *stages)))  # fmt: skip
    rows = [record.row([*head]), record.row(["---:"] * len(head))]
    cells = [f"{1e3 * v:.0f}" for some in (paths, calls) for v in record.percentiles(some, 50, 95)]
    cells += [f"{1e3 * np.median(some):.0f}" for some in (setups, *stages.values())]
    rows.append(record.row([count, int(np.median(triangles)), f"{np.isfinite(paths).mean():.3f}", *cells]))
    return rows, {"large": {"first path": paths, "call": calls, "setup": setups, "stages": stages}}


def sizes() -> tuple[list[str], dict[str, Any]]:
    """Measure a state's cost against the number of triangles and points; return rows and figures."""
    head = ("kind", "number", "set-up once s", "again ms", "proof of a state us", "clearance us", "MB")
    rows, figures = [record.row([*head]), record.row(["---", *["---:"] * (len(head) - 1)])], []
    rng = np.random.default_rng(0)
    states = np.clip(
        robot().home + 0.5 * rng.normal(size=(5000, robot().dof)), robot().limits.lower, robot().limits.upper
    )
    with tempfile.TemporaryDirectory() as folder:
        for kind in ("mesh", "points"):
            for number, count in enumerate((WARM, *COUNTS)):
                file = Path(folder) / f"{kind}{count}.{'stl' if kind == 'mesh' else 'npy'}"
                if kind == "mesh":
                    rings = max(4, int(np.sqrt(count / 8.0)))
                    trimesh.creation.uv_sphere(0.35, [rings, 2 * rings]).export(file)
                else:
                    direction = rng.normal(size=(count, 3))
                    np.save(file, 0.35 * direction / np.linalg.norm(direction, axis=1)[:, None])
                fields = (
                    {"mesh": {"file": str(file)}}
                    if kind == "mesh"
                    else {"points": {"file": str(file), "radius": 0.005}}
                )
                body = Obstacle(name="one", position=(0.75, 0.0, 0.45), **fields)
                before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
                took = []
                for _ in range(2):
                    began = time.perf_counter()
                    checker = CollisionChecker(robot(), [body])
                    checker.prepare()
                    took.append(time.perf_counter() - began)
                memory = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024.0
                costs = []
                for call in (checker.kernel.unproved, checker.kernel.clearance):
                    call(states)
                    began = time.perf_counter()
                    call(states)
                    costs.append((time.perf_counter() - began) / len(states))
                if number == 0:
                    continue
                cells = [f"{took[0]:.2f}", f"{1e3 * took[1]:.0f}", *(f"{1e6 * c:.1f}" for c in costs), f"{memory:.0f}"]
                rows.append(record.row([kind, count, *cells]))
                figures.append([kind, count, *took, *costs, memory])
    return rows, {"sizes": figures}


def updates() -> tuple[list[str], dict[str, Any]]:
    """Measure new clouds in a world that is kept; return rows and figures."""
    rng, took = np.random.default_rng(0), []
    with quiet_ompl(), MotionPlanner() as planner:
        for k in range(CLOUDS + 3):
            side, height = rng.uniform(-0.6, 0.6, CLOUD), rng.uniform(0.1, 1.1, CLOUD)
            depth = 0.95 + 0.05 * np.sin(7.0 * side + k) * np.cos(5.0 * height) + 0.002 * rng.normal(size=CLOUD)
            points = np.column_stack([depth, side, height])
            began = time.perf_counter()
            planner.world.set_points("seen", points, radius=POINT_RADIUS)
            planner.is_free(planner.robot.home)
            took.append(time.perf_counter() - began)
    took = took[3:]  # the first ones load and compile
    p50, p95 = record.percentiles(took, 50, 95)
    head = ("new cloud of", "N", "ms p50", "p95")
    rows = [record.row([*head]), record.row(["---", *["---:"] * 3])]
    rows.append(record.row([f"{CLOUD} points", CLOUDS, f"{1e3 * p50:.0f}", f"{1e3 * p95:.0f}"]))
    return rows, {"updates": took}


def main() -> None:
    """Measure, and write the results."""
    parser = record.parser(__doc__, n=60, of="problems and scenes")
    parser.add_argument("--states", type=one_or_more, default=2000, help="states of a problem (default: %(default)s)")
    args = parser.parse_args()
    rows, figures = sizes()
    for more, found in (updates(), versions(args.n, args.states), large(args.n)):
        rows += ["", *more]
        figures |= found
    record.write("geometry", figures, "\n".join(rows), split="validation", seed="0", trimesh=trimesh.__version__)


if __name__ == "__main__":
    run_script(main)
