"""Occupancy maps of test problems from noisy depth images: time, coverage, errors against the true scene, and plans.

A robot at the start of a problem, with what it holds, stands in a room with walls. Cameras of 640 x 480 pixels look at
it from three places 1.2 to 1.6 m in front; their assumed poses have errors with the standard deviations that they
state. Images are drawn by the kernel's renderer, or are rays of MuJoCo, each with a seed of its own, and have the
errors of a stereo camera (``benchmarks/perception/depth_rays.py``). "look-up" is ``apex_ompl.perception.OccupancyMap``;
"rays" (with ``--rays``) follows the ray of every fourth pixel, with the same hits and the same filter of the robot, and
lowers the evidence of the voxels on its way once an image each.

``ms`` is CPU time of one image on one core, with the filter of the robot, into a map of 1.6 x 1.6 x 1.2 m; "large ms"
of 2.4 x 2.4 x 1.6 m, which the shares are of. The first image of a map is left out. "covered" is the share of the
surface seen without noise that has an occupied voxel within a voxel of it. "off" are occupied voxels that touch no
solid, or are 3 cm off. "freed" is the share of the voxels with their centers in a solid, the robot's among them, that
are free. "sure" is the share of the voxels free by rays without errors that are free.

Plans are made by the default planner, with a margin of 5 cm around the start, in maps of 20 and 10 mm: from nine
places all around at the start ("around"), or from the three places in front in six states of the robot that are free
("sweep"); every state of the paths, 0.02 rad apart, is checked in the true scene by Coal alone. Goals that are "told"
are given to the map as free (``goal=``). Of those that fail, "goal on occupied" and "goal on unknown" are those whose
goal touches such voxels.

"update" is CPU time from a depth image of the last place to the edited world of a planner, in maps of 20 mm.

What was measured of a problem is kept in benchmarks/runs/voxels, and an interrupted command goes on from there; remove
the folder to measure anew.

Usage: python -m benchmarks.perception.voxels [-n 50] [--plans 60] [--rays]
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from itertools import product
from typing import Any, NamedTuple

import numba
import numpy as np
import pinocchio as pin
from tqdm import tqdm

from apex_ompl import MotionPlanner, plan, problems
from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.cloud_contact import signed_distances
from apex_ompl.collision.shapes import coal_geometry, world_geometry
from apex_ompl.kernel.voxels import ENOUGH
from apex_ompl.perception import Camera, OccupancyMap, look_at
from apex_ompl.perception.rendering import Part, ZBuffer
from apex_ompl.perception.surfaces import geometry_surface
from apex_ompl.perception.synthetic import LINK_SLICES, solid_part
from apex_ompl.problems.suite_robot import robot
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject, Body, Obstacle
from apex_ompl.scene.problem import Problem
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.files import write_atomically
from benchmarks.lib import record
from benchmarks.perception.depth_rays import RayScene, measured

DEPENDS = (
    "@planning", "apex_ompl/perception/camera.py", "apex_ompl/perception/frames.py",
    "apex_ompl/perception/occupancy.py", "apex_ompl/perception/occupancy_contact.py",
    "apex_ompl/perception/occupancy_settings.py", "apex_ompl/perception/rendering.py",
    "benchmarks/perception/depth_rays.py",
)  # fmt: skip
CAMERA = Camera(
    width=640, height=480, focal=(465.0, 465.0), center=(319.5, 239.5), position_spread=0.002, angle_spread=0.0015
)
BOX = np.array([[-0.6, -1.2, -0.1], [1.8, 1.2, 1.5]])
SMALL = np.array([[0.0, -0.8, -0.1], [1.6, 0.8, 1.1]])  # box that images are timed in
RUNS = record.ROOT / "benchmarks" / "runs" / "voxels"
PLAN_TIME = 10.0  # [s]
SIDES = (0.01, 0.02, 0.04)
SEEDS = {"ZBuffer": 31, "MuJoCo": 32}
PLAN_SEED = 33
ROOM = (
    Obstacle(name="back_wall", box=(0.1, 6.0, 4.0), position=(-1.3, 0.0, 0.5)),
    Obstacle(name="front_wall", box=(0.1, 6.0, 4.0), position=(2.5, 0.0, 0.5)),
    Obstacle(name="left_wall", box=(6.0, 0.1, 4.0), position=(0.0, 1.9, 0.5)),
    Obstacle(name="right_wall", box=(6.0, 0.1, 4.0), position=(0.0, -1.9, 0.5)),
    Obstacle(name="ground", box=(6.0, 6.0, 0.1), position=(0.0, 0.0, -0.8)),
)
FRONT, AROUND = (-0.7, 0.0, 0.7), tuple(np.arange(9) * 2.0 * np.pi / 9.0)
PLANNED, MARGIN = (0.02, 0.01), 0.05  # of maps that are planned in: sides of voxels, and margin of unknown space [m]
SWEPT = 5  # states beside the start
SUITES = ("posts", "shelf", "clutter", "wall")
OFF = 0.03  # [m]


class Look(NamedTuple):
    """An image, as measured and as it is, poses of the camera, assumed and true, and the state of the robot."""

    depth: np.ndarray
    true: np.ndarray
    without_robot: np.ndarray
    assumed: np.ndarray
    pose: np.ndarray
    state: np.ndarray


Solid = tuple[Any, np.ndarray]
"""Geometry and pose in the world."""


class Truth(NamedTuple):
    """A scene: solids without the robot, centers of voxels in solids, points that are seen, and voxels free by rays.

    The robot is one of the solids that voxels are in.
    """

    solids: list[Solid]
    inside: np.ndarray
    surface: np.ndarray
    free: np.ndarray


class DrawnScene:
    """A scene that the kernel's renderer draws, as :class:`RayScene` has it by rays."""

    def __init__(self, made: Robot, bodies: Sequence[Body], held: Sequence[AttachedObject]) -> None:
        """Collect the surfaces."""
        self.robot, self.held = made, tuple(held)
        self._links = [
            geometry_surface(item.geometry, item.name, LINK_SLICES) for item in made.geometry.geometryObjects
        ]
        placed = [world_geometry(one) for one in (*made.fixtures, *bodies)]
        self._rest = [solid_part(shape, pose, 1, (1.0, 1.0, 1.0)) for shape, pose in placed]

    def depth(self, camera: Camera, pose: np.ndarray, state: np.ndarray, robot: bool = True) -> np.ndarray:
        """Return the true depths, shape (height, width) [m]; 0 where there is nothing."""
        parts, made = list(self._rest), self.robot
        if robot:
            data = made.model.createData()
            pin.forwardKinematics(made.model, data, made.to_pinocchio(state))
            parts += [
                Part(surface.at((data.oMi[item.parentJoint] * item.placement).homogeneous), 1)
                for surface, item in zip(self._links, made.geometry.geometryObjects, strict=True)
            ]
            held = [(coal_geometry(one), made.link_pose(state, one.link) @ one.pose) for one in self.held]
            parts += [solid_part(shape, at, 1, (1.0, 1.0, 1.0)) for shape, at in held]
        return ZBuffer().draw(parts, camera, pose).depth


def looks(
    scene: DrawnScene | RayScene, states: Sequence[np.ndarray], rng: np.random.Generator, directions: Sequence[float],
    alone: bool = True,
) -> list[Look]:  # fmt: skip
    """Return the images of a scene from directions around z [rad] in each state; ``alone``: without the robot, too."""
    found = []
    for q, middle in product(states, directions):
        around, above = middle + rng.uniform(-0.2, 0.2), rng.uniform(0.2, 0.9)
        target = np.array([0.4, 0.0, 0.5]) + rng.normal(0.0, 0.05, 3)
        away = np.array([np.cos(around) * np.cos(above), np.sin(around) * np.cos(above), np.sin(above)])
        pose = look_at(target + rng.uniform(1.2, 1.6) * away, target)
        error = pin.SE3(
            pin.exp3(CAMERA.angle_spread * rng.normal(size=3)), CAMERA.position_spread * rng.normal(size=3)
        ).homogeneous
        true = scene.depth(CAMERA, pose, q)
        without = scene.depth(CAMERA, pose, q, robot=False) if alone else true
        found.append(Look(measured(true, CAMERA, rng), true, without, pose @ error, pose, q))
    return found


@numba.njit
def follow(evidence, hits, depth, left_out, rays, pose, origin, side):  # type: ignore[no-untyped-def] # noqa: ANN001, ANN201, PLR0917
    """Lower the evidence of voxels on the ways of rays (Amanatides and Woo 1987), once an image; hits are done."""
    nx, ny, nz = evidence.shape
    passed = np.zeros(evidence.shape, np.bool_)
    start = (pose[:3, 3] - origin) / side
    for p in range(len(depth)):
        z = depth[p]
        if z <= 0.0:
            continue
        step, way, at, leap = np.zeros(3, np.int64), np.zeros(3), np.zeros(3, np.int64), np.zeros(3)
        low, high = 0.0, 1.0
        for k in range(3):
            d = (pose[k, 0] * rays[p, 0] + pose[k, 1] * rays[p, 1] + pose[k, 2]) * z / side
            d = d if abs(d) > 1e-9 else 1e-9
            a, b = -start[k] / d, (evidence.shape[k] - 1e-6 - start[k]) / d
            low, high = max(low, min(a, b)), min(high, max(a, b))
            leap[k], step[k] = 1.0 / abs(d), 1 if d > 0 else -1
            way[k] = d
        if low >= high:
            continue
        for k in range(3):
            place = start[k] + (low + 1e-9) * way[k]
            at[k] = min(max(int(np.floor(place)), 0), evidence.shape[k] - 1)
            way[k] = low + ((at[k] + (step[k] > 0)) - place) / way[k]
        last = high - leap.min() if high == 1.0 else high
        while 0 <= at[0] < nx and 0 <= at[1] < ny and 0 <= at[2] < nz:
            k = 0 if way[0] <= way[1] and way[0] <= way[2] else (1 if way[1] <= way[2] else 2)
            if way[k] > last:
                break
            i, j, m = at[0], at[1], at[2]
            if not passed[i, j, m] and hits[i, j, m] == 0:
                passed[i, j, m] = True
                if evidence[i, j, m] > -1:
                    evidence[i, j, m] -= 1
            at[k] += step[k]
            way[k] += leap[k]


def by_rays(made: OccupancyMap, camera: Camera, look: Look, q: np.ndarray, held: tuple[AttachedObject, ...]) -> None:
    """Change a map as rays do: hits as the map has them, the way to them by :func:`follow`."""
    spheres = made._own_spheres(q, held, look.assumed, camera.depth.noise)
    points = made._points(camera, look.depth, spheres)
    hits = np.zeros_like(made.evidence)
    made._change(camera, look.assumed).fill(made.evidence, hits, points, (camera.depth.nearest, camera.depth.farthest))
    hits = (hits == ENOUGH).astype(np.int8)
    z = points.depths.astype(float)
    follow(
        made.evidence, hits, z, points.left_out, points.rays, look.assumed, made.origin, made.resolution
    )  # fmt: skip


def distances(points: np.ndarray, solids: list[Solid], limit: float) -> np.ndarray:
    """Return the signed distances of points from solids, at most ``limit``, shape (N,) [m]."""
    found = np.full(len(points), limit)
    for shape, pose in solids:
        shape.computeLocalAABB()
        box, local = shape.aabb_local, (points - pose[:3, 3]) @ pose[:3, :3]
        near = ((local > box.min_ - limit) & (local < box.max_ + limit)).all(axis=1)
        found[near] = np.minimum(found[near], signed_distances(shape, np.ascontiguousarray(local[near]), limit))
    return found


def errors(made: OccupancyMap, truth: Truth) -> dict[str, float]:
    """Return shares of a map."""
    steps = np.stack(np.meshgrid(*[(-1, 0, 1)] * 3), axis=-1).reshape(-1, 3) * made.resolution
    covered = np.any([made.look_up(truth.surface + step) > 0 for step in steps], axis=0)
    gap = distances(made.points(), truth.solids, made.ball_radius + 2.0 * OFF) - made.ball_radius
    return {
        "covered": float(covered.mean()), "free": float(made.free.mean()),
        "off": float((gap > 0.0).mean()), "far off": float((gap > OFF).mean()),
        "freed": float((made.look_up(truth.inside) < 0).mean()), "sure": float(made.free[truth.free].mean()),
    }  # fmt: skip


def truth_of(made: Robot, problem: Problem, q: np.ndarray, seen: list[Look], exact: OccupancyMap) -> Truth:
    """Return the truth about a scene; ``exact`` is an empty map."""
    data = made.model.createData()
    pin.forwardKinematics(made.model, data, made.to_pinocchio(q))
    links = [
        (item.geometry, (data.oMi[item.parentJoint] * item.placement).homogeneous)
        for item in made.geometry.geometryObjects
    ]
    links += [(coal_geometry(one), made.link_pose(q, one.link) @ one.pose) for one in problem.attached]
    solids = [world_geometry(one) for one in (*problem.scene, *ROOM, *made.fixtures)]
    cells = np.random.default_rng(1).integers(0, exact.evidence.shape, (100_000, 3))
    centers = (cells + 0.5) * exact.resolution + exact.origin
    inside = centers[np.minimum(distances(centers, solids, 0.01), distances(centers, links, 0.01)) < 0.0]
    surface = []
    for look in seen:
        rays = np.concatenate([CAMERA.grid, np.ones((*CAMERA.grid.shape[:2], 1))], axis=2) * look.true[..., None]
        rays = rays[(look.true > 0.0) & (np.abs(look.true - look.without_robot) < 1e-6)][::5]
        points = rays @ look.pose[:3, :3].T + look.pose[:3, 3]
        surface.append(points[((points > BOX[0]) & (points < BOX[1])).all(axis=1)])
    for look in seen:
        by_rays(exact, CAMERA, look._replace(depth=look.true, assumed=look.pose), q, tuple(problem.attached))
    return Truth(solids, inside, np.concatenate(surface), exact.free)


def tested(made: Robot, problem: Problem, seen: list[Look], side: float, rays: bool) -> dict[str, dict[str, Any]]:
    """Return times and shares, by rays as well where that is asked for."""
    held, q = tuple(problem.attached), seen[0].state
    truth = truth_of(made, problem, q, seen, OccupancyMap(BOX, side, made))
    found: dict[str, dict[str, Any]] = {}
    for name in ("look-up", "rays")[: 1 + rays]:
        one, small = OccupancyMap(BOX, side, made), OccupancyMap(SMALL, side, made)
        times: dict[int, list[float]] = {0: [], 1: []}
        for look, (k, into) in product(seen, enumerate((small, one))):
            started = time.process_time()
            if name == "rays":
                by_rays(into, CAMERA, look, q, held)
            else:
                into.integrate(look.depth, CAMERA, look.assumed, q, held)
            times[k].append(1e3 * (time.process_time() - started))
        found[name] = {"ms": times[0][1:], "large_ms": times[1][1:], **errors(one, truth)}
    return found


def planned(
    made: Robot, problem: Problem, seen: OccupancyMap, q: np.ndarray, *, unknown: Any, told: bool
) -> dict[str, Any]:  # fmt: skip
    """Return how a plan in a map went, which is ``told`` that the goal is free."""
    goal = np.array([problem.goal.joints[0][joint] for joint in made.joint_names])
    world = seen.world(unknown, q, goal=goal if told else None, held=problem.attached, margin=MARGIN)
    started = time.process_time()
    result = plan(problem.model_copy(update={"scene": world, "allowed": ()}), timeout=PLAN_TIME, seed=0)
    spent = time.process_time() - started
    if result and result.path is not None:
        truth = CollisionChecker(made, problem.scene, problem.attached, problem.allowed, proofs=False)
        return {"cause": "", "free": bool(truth.are_free(result.path.sample(0.02)).all()), "cpu_s": spent}
    cause = str(result.status)
    if cause == "INVALID_GOAL":
        world = seen.world("free", q, goal=goal if told else None, held=problem.attached)
        occupied = CollisionChecker(made, world, problem.attached, proofs=False)
        cause = "goal on unknown" if occupied.is_free(goal) else "goal on occupied"
    return {"cause": cause, "reason": result.reason, "cpu_s": spent}


def swept(made: Robot, problem: Problem, q: np.ndarray, rng: np.random.Generator) -> list[np.ndarray]:
    """Return the start and some states that are free."""
    checker = CollisionChecker(made, problem.scene, problem.attached, problem.allowed)
    states = rng.uniform(made.limits.lower, made.limits.upper, (20_000, made.dof))
    states = q + rng.uniform(0.2, 0.6, (len(states), 1)) * (states - q)
    found: list[np.ndarray] = [q]
    for some in np.array_split(states, 200):
        found += [*some[checker.are_free(some)]]
        if len(found) > SWEPT:
            break
    return found[: SWEPT + 1]


def updated(made: Robot, problem: Problem, seen: OccupancyMap, look: Look) -> float:
    """Return the CPU time from a depth image to the edited world of a planner [ms]."""
    planner = MotionPlanner(made)
    for one in problem.attached:
        planner.world.attach(one)
    planner.world.add(*seen.world())
    started = time.process_time()
    seen.integrate(look.depth, CAMERA, look.assumed, look.state, problem.attached)
    with planner.world.locked():
        planner.world.remove("map")
        planner.world.add(*seen.world())
    return 1e3 * (time.process_time() - started)


def plans_of(made: Robot, name: str, k: int) -> list[dict[str, Any]]:
    """Return how plans of a problem went."""
    problem, rng = problems.load(name), np.random.default_rng((PLAN_SEED, k))
    q = np.array([problem.start[joint] for joint in made.joint_names])
    scene = DrawnScene(made, [*problem.scene, *ROOM], problem.attached)
    views = {
        "around": looks(scene, [q], rng, AROUND, alone=False),
        "sweep": looks(scene, swept(made, problem, q, rng), rng, FRONT, alone=False),
    }
    found = []
    for seen, side in product(views, PLANNED):
        kept = OccupancyMap(BOX, side, made)
        for look in views[seen]:
            kept.integrate(look.depth, CAMERA, look.assumed, look.state, problem.attached)
        about = {"problem": name, "views": seen, "side": side}
        for unknown, told in product(("free", "blocked"), (False, True) if side == PLANNED[0] else (True,)):
            how = planned(made, problem, kept, q, unknown=unknown, told=told)
            found.append({**about, "unknown": unknown, "told": told, **how})
        if side == PLANNED[0]:
            found[-3]["update_ms"] = updated(made, problem, kept, views[seen][-1])
    return found


def stored(name: str, measure: Callable[[], Any]) -> Any:
    """Return what was measured of a problem before, or measure and keep it."""
    file = RUNS / f"{name}.json"
    if not file.exists():
        file.parent.mkdir(exist_ok=True, parents=True)
        write_atomically(file, json.dumps(measure()).encode())
    return json.loads(file.read_text(encoding="utf-8"))


def images_of(made: Robot, name: str, renderer: str, k: int, rays: bool) -> list[tuple[str, float, dict[str, Any]]]:
    """Return ways, sides of voxels, and what was measured of the k-th problem drawn by a renderer."""
    problem = problems.load(name)
    q = np.array([problem.start[joint] for joint in made.joint_names])
    scene = RENDERERS[renderer](made, [*problem.scene, *ROOM], problem.attached)
    seen = looks(scene, [q], np.random.default_rng((SEEDS[renderer], k)), FRONT)
    return [(way, side, row) for side in SIDES for way, row in tested(made, problem, seen, side, rays).items()]


RENDERERS: dict[str, Any] = {"ZBuffer": DrawnScene, "MuJoCo": RayScene}


def main() -> None:
    """Measure, and write the results."""
    parser = record.parser(__doc__ or "", 50, "problems of a renderer, of three images each")
    parser.add_argument("--plans", type=int, default=60, help="problems that are planned (default: %(default)s)")
    parser.add_argument("--rays", action="store_true", help="follow rays as well")
    given, made = parser.parse_args(), robot()
    names = [problems.frozen_names(suite, "easy")[k] for k in range(100) for suite in SUITES]
    found: dict[tuple[str, str, float], list[dict[str, Any]]] = {}
    for renderer in RENDERERS:
        for k, name in enumerate(tqdm(names[: given.n], desc=renderer)):
            about = f"{renderer}{'-rays' if given.rays else ''}-{k}"
            for way, side, row in stored(about, lambda n=name, k=k, r=renderer: images_of(made, n, r, k, given.rays)):
                found.setdefault((way, renderer, side), []).append(row)
    plans = []
    for k, name in enumerate(tqdm(names[: given.plans], desc="plans")):
        plans += stored(f"plans-{k}", lambda n=name, k=k: plans_of(made, n, k))
    lines = [tables(found), "", plan_table(plans)]
    rows = [{"way": way, "renderer": by, "side": side, "problems": some} for (way, by, side), some in found.items()]
    record.write("perception_voxels", {"rows": rows, "plans": plans}, "\n".join(lines), n=given.n, plans=given.plans)


def tables(found: dict[tuple[str, str, float], list[dict[str, Any]]]) -> str:
    """Return the table of times and shares, means over problems."""
    kinds = ("covered", "off", "far off", "free", "sure", "freed")
    head = [
        "voxels",
        "renderer",
        "mm",
        "N images",
        "ms p50",
        "ms p95",
        "large ms p50",
        *[f"{kind} %" for kind in kinds],
    ]
    lines = [record.row(head), record.row(["---", "---", *["---:"] * (len(head) - 2)])]
    for (way, by, side), some in sorted(found.items(), key=lambda item: (item[0][2], item[0][0], item[0][1])):
        times = np.concatenate([one["ms"] for one in some])
        shares = [f"{100.0 * np.mean([one[kind] for one in some]):.2f}" for kind in kinds]
        large = np.median(np.concatenate([one["large_ms"] for one in some]))
        spent = (f"{value:.1f}" for value in (*record.percentiles(times, 50, 95), large))
        lines.append(record.row([way, by, f"{1e3 * side:g}", len(FRONT) * len(some), *spent, *shares]))
    return "\n".join(lines)


def plan_table(plans: list[dict[str, Any]]) -> str:
    """Return the table of plans."""
    causes = sorted({one["cause"] for one in plans} - {""})
    head = [
        "views",
        "mm",
        "unknown space",
        "goal",
        "N",
        "solved",
        "free in the true scene",
        *causes,
        "CPU s p50",
        "update ms p50",
    ]
    lines = [record.row(head), record.row(["---", "---:", "---", "---", *["---:"] * (len(head) - 4)])]
    kinds = [(one["views"], -one["side"], one["unknown"], one["told"]) for one in plans]
    for views, side, unknown, told in sorted(set(kinds)):
        some = [one for one, kind in zip(plans, kinds, strict=True) if kind == (views, side, unknown, told)]
        solved = [one for one in some if not one["cause"]]
        counts = [sum(one["cause"] == cause for one in some) for cause in causes]
        edits = [one["update_ms"] for one in some if "update_ms" in one]
        spent = f"{np.median([one['cpu_s'] for one in some]):.1f}", f"{np.median(edits):.0f}" if edits else ""
        goal, right = "told" if told else "", sum(one["free"] for one in solved)
        cells = [views, f"{-1e3 * side:g}", unknown, goal, len(some), len(solved), right]
        lines.append(record.row([*cells, *counts, *spent]))
    return "\n".join(lines)


if __name__ == "__main__":
    run_script(main)
