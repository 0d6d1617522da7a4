"""Cost of the checker: of states with 3 to 300 obstacles, and of free paths, two stages against the meshes alone.

For each scene the same states are checked by the two stages, by the meshes alone (Pinocchio's AABB tree) and by a plain
loop over all pairs; every disagreement is counted, with half of the states near the border of collision. The kernel's
clearance and gradient are timed beside them. Then free paths of 256 states, straight lines in these scenes and what
rrtconnect found on the ready-made problems, are checked state by state and by the full check.

Usage: python -m benchmarks.collision.collision_checker [--states 50000] [--paths 200]
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import pinocchio as pin

from apex_ompl import plan, problems
from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.mesh_stage import MeshStage, exact_requests
from apex_ompl.ompl.validity import full_check
from apex_ompl.paths.path import FINE_RESOLUTION, resample
from apex_ompl.robot import Robot, load_robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import one_or_more, whole_number
from benchmarks.lib import record

DEPENDS = ("@checking", "apex_ompl/ompl", "problems")
SCENES = (3, 10, 30, 100, 300)
CROWDED = 30  # obstacles; more are made smaller, so that some room is left
LIMIT = 0.1  # clearances over this are not looked for, as by an optimizer [m]


def boxes(count: int, rng: np.random.Generator) -> list[Obstacle]:
    """Return boxes of 5 to 30 cm in the space in front of the arms, and every third one a cylinder or sphere.

    More than 30 are smaller, in keeping with their number.
    """
    scale = min(1.0, (CROWDED / count) ** 0.5)
    scene = []
    for k in range(count):
        position = tuple(rng.uniform([0.2, -0.8, 0.05], [0.9, 0.8, 0.9]))
        if k % 3 == 1:
            ball = {"radius": scale * rng.uniform(0.03, 0.1)}
            scene.append(Obstacle(name=f"o{k}", sphere=ball, position=position))
        elif k % 3 == 2:
            bar = {"radius": scale * rng.uniform(0.03, 0.06), "length": scale * rng.uniform(0.1, 0.5)}
            scene.append(Obstacle(name=f"o{k}", cylinder=bar, position=position))
        else:
            size = tuple(scale * rng.uniform(0.05, 0.3, 3))
            scene.append(Obstacle(name=f"o{k}", box=size, position=position))
    return scene


def around_home(robot: Robot, rng: np.random.Generator, count: int) -> np.ndarray:
    """Return states around home, inside the limits, hands anywhere."""
    states = robot.home + rng.normal(0.0, 0.4, (count, robot.dof))
    hands = robot.groups.get("hands", [])
    states[:, hands] = rng.uniform(0.0, 1.0, (count, len(hands)))
    return np.clip(states, robot.limits.lower, robot.limits.upper)


def whole_geometry(scene: MeshStage) -> pin.GeometryModel:
    """Return the solids of a scene and the pairs that are checked as one geometry model of Pinocchio."""
    geometry, places = pin.GeometryModel(), {}
    for number, solid in scene.solids.items():
        item = pin.GeometryObject(f"{solid.name}#{number}", solid.joint, solid.placement, solid.shape)
        places[number] = geometry.addGeometryObject(item)
    for a, b in scene.pairs:
        geometry.addCollisionPair(pin.CollisionPair(places[a], places[b]))
    return geometry


class PlainLoop:
    """The same geometry checked pair by pair, by Pinocchio."""

    def __init__(self, checker: CollisionChecker) -> None:
        """Take the solids of ``checker``."""
        self.robot, self.geometry = checker.robot, whole_geometry(checker.meshes)
        self.data, self.geometry_data = self.robot.model.createData(), exact_requests(self.geometry.createData())

    def is_free(self, q: np.ndarray) -> bool:
        """Whether no pair collides at ``q``."""
        state = self.robot.to_pinocchio(q)
        model = self.robot.model
        return not pin.computeCollisions(model, self.data, self.geometry, self.geometry_data, state, True)


def microseconds(check: Callable[[np.ndarray], object], states: np.ndarray, repeats: int = 3) -> float:
    """Return the best mean of several passes over ``states``, one call each [us a state]."""
    best = np.inf
    for _ in range(repeats):
        start = time.perf_counter()
        for q in states:
            check(q)
        best = min(best, (time.perf_counter() - start) / len(states))
    return best * 1e6


def of_batch(work: Callable[[np.ndarray], object], states: np.ndarray, repeats: int = 5) -> float:
    """Return the best of several calls with all ``states`` [us a state]."""
    best = np.inf
    for _ in range(repeats):
        start = time.perf_counter()
        work(states)
        best = min(best, (time.perf_counter() - start) / len(states))
    return best * 1e6


def near_contact(
    checker: CollisionChecker, states: np.ndarray, free: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Return states on both sides of the border of collision, by bisection between free and colliding ones."""
    inside, outside = states[~free], states[free]
    count = min(len(inside), len(outside))
    found = []
    for a, b in zip(rng.permutation(outside)[:count], rng.permutation(inside)[:count], strict=True):
        low, high = 0.0, 1.0
        for _ in range(10):
            middle = (low + high) / 2
            low, high = (middle, high) if checker.is_free(a + middle * (b - a)) else (low, middle)
        found += [a + low * (b - a), a + high * (b - a)]
    return np.array(found).reshape(-1, states.shape[1])


def check_states(robot: Robot, count: int, share: int, rng: np.random.Generator) -> dict[str, float]:
    """Return the figures of a scene."""
    scene = boxes(count, rng)
    both, meshes = CollisionChecker(robot, scene), CollisionChecker(robot, scene, proofs=False)
    loop = PlainLoop(meshes)
    spread = np.concatenate([around_home(robot, rng, share // 3), robot.random_state(rng, share // 6 + 1)])
    free = both.are_free(spread)
    tight = near_contact(both, spread, free, rng)[: share - len(spread)]
    states = np.concatenate([spread, tight])
    answers = [both.are_free(states), meshes.are_free(states), np.array([loop.is_free(q) for q in states])]
    free_states, hit_states = spread[free][:1000], spread[~free][:1000]
    kernel = both.kernel
    proved = kernel.unproved(free_states)[1] == 0
    return {
        "obstacles": count, "pairs": len(meshes.meshes.pairs), "free_share": float(free.mean()),
        "proved_of_free": float(proved.mean()),
        "kernel_us": of_batch(kernel.unproved, free_states[proved]),
        "two_stages_free_us": microseconds(both.is_free, free_states),
        "two_stages_colliding_us": microseconds(both.is_free, hit_states),
        "meshes_free_us": microseconds(meshes.is_free, free_states),
        "meshes_colliding_us": microseconds(meshes.is_free, hit_states),
        "loop_free_us": microseconds(loop.is_free, free_states[:200]),
        "clearance_us": of_batch(kernel.clearance, free_states),
        "clearance_limit_us": of_batch(lambda q: kernel.clearance(q, LIMIT), free_states),
        "gradient_limit_us": of_batch(lambda q: kernel.clearance_gradient(q, LIMIT), free_states),
        "states": len(states), "near_contact": len(tight),
        "disagreements": int((answers[0] != answers[1]).sum() + (answers[1] != answers[2]).sum()),
    }  # fmt: skip


def straight_paths(robot: Robot, count: int, wanted: int, rng: np.random.Generator) -> tuple[list, list[np.ndarray]]:
    """Return a scene and free straight paths of 256 states in it."""
    scene, found = boxes(count, rng), []
    checker = CollisionChecker(robot, scene)
    while len(found) < wanted:
        a, b = around_home(robot, rng, 2)
        if checker.first_collision(np.stack([a, b]), FINE_RESOLUTION) is None:
            found.append(resample(np.stack([a, b]), 256))
    return scene, found


def check_paths(checkers: tuple[CollisionChecker, CollisionChecker], paths: list[np.ndarray]) -> dict[str, list[float]]:
    """Return milliseconds of each path: its states, and its full check, by two stages and by the meshes alone.

    ``batched`` is Pinocchio's own call for a batch of states, on one thread.
    """
    both, meshes = checkers
    both.prepare()
    meshes.prepare()
    geometry = whole_geometry(meshes.meshes)
    pool = pin.BroadPhaseManagerPool_DynamicAABBTreeCollisionManager(meshes.robot.model, geometry, 1)
    exact_requests(pool.getGeometryData(0))
    times: dict[str, list[float]] = {}

    def timed(name: str, work: Callable[[], object]) -> None:
        start = time.perf_counter()
        good = work()
        times.setdefault(name, []).append((time.perf_counter() - start) * 1e3)
        assert good, name

    for path in paths:
        columns = np.asfortranarray(both.robot.to_pinocchio(path).T)
        for name, checker in (("two_stages", both), ("meshes", meshes)):
            timed(f"{name}_states", lambda v=checker, p=path: v.are_free(p).all())
            timed(f"{name}_full", lambda v=checker, p=path: full_check(v, p).ok)
        timed("batched_states", lambda c=columns: not any(pin.computeCollisionsInParallel(1, pool, c, False)))
    return times


def main() -> None:
    """Measure and write."""
    parser = record.parser(__doc__)
    parser.add_argument("--states", type=one_or_more, default=50_000, help="states checked, over all scenes")
    parser.add_argument("--paths", type=one_or_more, default=200, help="straight paths a scene")
    parser.add_argument("--seed", type=whole_number, default=0)
    args = parser.parse_args()
    rng = np.random.default_rng(args.seed)
    robot = load_robot("dual_panda_softhand")
    figures = [check_states(robot, count, args.states // len(SCENES), rng) for count in SCENES]
    paths = {}
    for count in SCENES[:3]:
        scene, found = straight_paths(robot, count, args.paths, rng)
        paths[f"straight, {count} obstacles"] = check_paths(
            (CollisionChecker(robot, scene), CollisionChecker(robot, scene, proofs=False)), found
        )
    solved: dict[str, list[float]] = {}
    for name in problems.names():
        problem = problems.load(name)
        robot = load_robot(problem.robot)
        pair = tuple(CollisionChecker(robot, problem.scene, problem.attached, proofs=p) for p in (True, False))
        results = [plan(problem, "rrtconnect", timeout=10.0, seed=seed) for seed in range(5)]
        done = [resample(r.path.states, 256) for r in results if r]
        done = [p for p in done if full_check(pair[1], p)]  # resampling cuts corners
        for key, values in check_paths(pair, done).items():  # type: ignore[arg-type]
            solved.setdefault(key, []).extend(values)
    paths["rrtconnect's, ready-made problems"] = solved
    columns = list(figures[0])
    rows = [[f"{v:.3g}" if isinstance(v, float) else v for v in row.values()] for row in figures]
    table = "\n".join(record.row(r) for r in [[c.replace("_", " ") for c in columns], ["---:"] * len(columns), *rows])
    head = ["free paths of 256 states", "N", "what", "two stages ms p50", "p95", "meshes ms p50", "p95", "batched p50",
            "meshes / two stages p50", "p95"]  # fmt: skip
    rows = []
    for name, times in paths.items():
        for what in ("states", "full"):
            two, one = (np.percentile(times[f"{k}_{what}"], [50, 95]) for k in ("two_stages", "meshes"))
            batch = f"{np.median(times['batched_states']):.2f}" if what == "states" else ""
            label = "every state" if what == "states" else "full check"
            rows.append([name, len(times["meshes_full"]), label, *(f"{v:.2f}" for v in (*two, *one)), batch,
                         *(f"{v:.1f}" for v in one / two)])  # fmt: skip
    table += "\n\n" + "\n".join(record.row(r) for r in [head, ["---", "---:", "---"] + ["---:"] * 7, *rows])
    record.write("checker", {"scenes": figures, "paths": paths}, table, seed=args.seed, N=args.states)


if __name__ == "__main__":
    run_script(main)
