"""Soundness and completeness of the sphere proofs: a proved state must never collide by the meshes.

For each robot, over scenes of all kinds of obstacles, with and without held objects: states drawn widely, states
bisected to within a thousandth of a contact, and states with a small obstacle inside a link. The checker
with proofs is compared with that of the meshes alone. Motions that were proved without the meshes are sampled a
hundred times as densely as planners sample. Then the share of states and of motion length that the spheres prove.

The full check is given paths that were made to graze (:mod:`grazing`): what it proves must be free by Coal's distances.
Shares of them go to processes of their own.

Usage: python -m benchmarks.collision.proofs [--states 1000000] [--motions 2000] [--grazes 2000] [--jobs 2]
    [--robot dual_panda_softhand --robot baxter]
"""

from __future__ import annotations

import tempfile
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import coal
import numpy as np

from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.conservative import CheckCounts
from apex_ompl.collision.discretization import sample_path
from apex_ompl.paths.path import FINE_RESOLUTION, SEARCH_RESOLUTION
from apex_ompl.robot import Robot, load_robot
from apex_ompl.scene.bodies import AttachedObject, MeshFile, Obstacle
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import one_or_more, whole_number
from benchmarks.collision.collision_checker import around_home, boxes, near_contact
from benchmarks.collision.grazing import Grazes, grazing_paths
from benchmarks.lib import record

DEPENDS = ("@checking", "benchmarks/collision/collision_checker.py", "benchmarks/collision/grazing.py")
SCENES = 20
INSIDE_SCENES = 100
DENSER = 100
GRAZES = 50  # grazing paths that one process tries at a time
WEDGE = "v 0 0 0\nv 0.3 0 0\nv 0 0.3 0\nv 0 0 0.3\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"


def scene(rng: np.random.Generator, count: int, mesh: Path) -> list[Obstacle]:
    """Return boxes, spheres and cylinders, and one capsule, half-space and mesh."""
    turn = rng.normal(size=4)
    spot = {"position": tuple(rng.uniform([0.3, -0.7, 0.2], [0.8, 0.7, 0.8]))}
    return [
        *boxes(count, rng),
        Obstacle(name="pill", capsule={"radius": 0.05, "length": 0.3}, orientation=tuple(turn / np.linalg.norm(turn)),
                 position=tuple(rng.uniform([0.3, -0.7, 0.2], [0.8, 0.7, 0.8]))),
        Obstacle(name="wedge", mesh=MeshFile(file=str(mesh)), **spot),
        Obstacle(name="ceiling", half_space={"normal": (0.0, 0.1, -1.0), "offset": -1.3}),
    ]  # fmt: skip


def held(robot: Robot) -> list[AttachedObject]:
    """Return a cup in one hand and a block in the other."""
    palms = [hand.palm for hand in robot.hands.values()]
    return [
        AttachedObject(name="cup", link=palms[0], cylinder={"radius": 0.035, "length": 0.12}, position=(0, 0, 0.1)),
        AttachedObject(name="block", link=palms[1], box=(0.05, 0.08, 0.2), position=(0, 0, 0.12)),
    ]


def pair(
    robot: Robot, obstacles: list[Obstacle], hands: list[AttachedObject]
) -> tuple[CollisionChecker, CollisionChecker]:
    """Return the checker in two stages, and of the meshes alone."""
    return CollisionChecker(robot, obstacles, hands), CollisionChecker(robot, obstacles, hands, proofs=False)


class Count:
    """Numbers of states checked, free, proved free, and of errors, which must be 0."""

    def __init__(self, kind: str) -> None:
        """Count states of a kind."""
        self.kind, self.states, self.free, self.proved, self.false_free, self.differ = kind, 0, 0, 0, 0, 0

    def add(self, both: CollisionChecker, meshes: CollisionChecker, states: np.ndarray) -> None:
        """Check states by both checkers."""
        proved = both.kernel.unproved(states)[1] == 0
        truth = meshes.are_free(states)
        self.states += len(states)
        self.free += int(truth.sum())
        self.proved += int(proved.sum())
        self.false_free += int((proved & ~truth).sum())
        self.differ += int((both.are_free(states) != truth).sum())

    def row(self, robot: Robot) -> list[object]:
        """Return a row of the table."""
        share = self.proved / max(self.free, 1)
        return [robot.name, self.kind, self.states, self.free, f"{share:.3f}", self.false_free, self.differ]


def inside_a_link(robot: Robot, rng: np.random.Generator, count: Count, states: int) -> None:
    """Check states with a small obstacle at a random place inside a random link, and states near by."""
    items = [g for g in robot.geometry.geometryObjects if g.parentJoint > 0]
    large = [g for g in items if g.geometry.getObjectType() == coal.OT_BVH] or items
    for _ in range(INSIDE_SCENES):
        item = large[rng.integers(len(large))]
        q = around_home(robot, rng, 1)[0]
        item.geometry.computeLocalAABB()
        box = item.geometry.aabb_local
        low, high = np.array(box.min_), np.array(box.max_)
        point = low + rng.uniform(0.3, 0.7, 3) * (high - low)
        at = robot.link_pose(q, robot.model.frames[item.parentFrame].name)
        if item.geometry.getObjectType() != coal.OT_BVH:
            at = at @ (robot.model.frames[item.parentFrame].placement.inverse() * item.placement).homogeneous
        size = rng.uniform(0.005, 0.03)
        seed = Obstacle(name="seed", sphere={"radius": size}, position=tuple(at[:3, :3] @ point + at[:3, 3]))
        near = q + rng.normal(0.0, 1.0, (states // INSIDE_SCENES, robot.dof)) * rng.uniform(0.0, 0.03)
        near = np.clip(near, robot.limits.lower, robot.limits.upper)
        count.add(*pair(robot, [seed], []), np.concatenate([q[None], near[1:]]))


def motions(robot: Robot, rng: np.random.Generator, wanted: int, mesh: Path) -> dict[str, float]:
    """Sample motions that the spheres proved, densely; and count how much of free motions they prove."""
    found = {"proved": 0, "samples": 0, "colliding": 0}
    search, full = CheckCounts(), CheckCounts()
    while found["proved"] < wanted:
        both, meshes = pair(robot, scene(rng, int(rng.choice([3, 10, 30])), mesh), held(robot))
        states = around_home(robot, rng, 500)
        states = states[both.are_free(states)]
        pool = around_home(robot, rng, 200)
        edge = near_contact(both, pool, both.are_free(pool), rng)
        starts = np.concatenate([states[:60], edge[both.are_free(edge)][:60]]) if len(edge) else states[:60]
        for a in starts:
            step = rng.normal(0.0, 1.0, robot.dof) * rng.uniform(0.01, 0.3)
            path = np.stack([a, np.clip(a + step, robot.limits.lower, robot.limits.upper)])
            both.check_counts = CheckCounts()
            free = both.first_collision(path, SEARCH_RESOLUTION) is None
            if free:
                _add(search, both.check_counts)
            if free and both.check_counts.meshes == 0:
                dense = sample_path(path, SEARCH_RESOLUTION / DENSER)[0]
                found["proved"] += 1
                found["samples"] += len(dense)
                found["colliding"] += int((~meshes.are_free(dense)).sum())
            if free:
                both.check_counts = CheckCounts()
                if both.first_collision(path, FINE_RESOLUTION) is None:
                    _add(full, both.check_counts)
    for name, check_counts in (("search", search), ("full", full)):
        found[f"{name}_steps_proved"] = check_counts.proved_steps / check_counts.steps
        found[f"{name}_states_proved"] = check_counts.proved / max(check_counts.states, 1)
        found[f"{name}_to_meshes"] = check_counts.meshes / check_counts.steps
    return found


def _add(total: CheckCounts, part: CheckCounts) -> None:
    for name, value in vars(part).items():
        setattr(total, name, getattr(total, name) + value)


def _share(name: str, seed: int, wanted: int) -> Grazes:
    with tempfile.TemporaryDirectory() as folder:
        return grazing_paths(load_robot(name), np.random.default_rng(seed), wanted, Path(folder))


def grazes(name: str, wanted: int, seed: int, jobs: int) -> Grazes:
    """Try grazing paths of a robot, in shares of 50."""
    total = Grazes()
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        shares = range((wanted + GRAZES - 1) // GRAZES)
        for part in pool.map(_share, [name] * len(shares), [seed + k for k in shares], [GRAZES] * len(shares)):
            total.add(part)
    return total


def main() -> None:
    """Measure and write."""
    parser = record.parser(__doc__, jobs=1)
    parser.add_argument("--states", type=one_or_more, default=1_000_000)
    parser.add_argument("--motions", type=one_or_more, default=2000)
    parser.add_argument("--grazes", type=one_or_more, default=2000)
    parser.add_argument("--robot", action="append", default=[])
    parser.add_argument("--seed", type=whole_number, default=0)
    args = parser.parse_args()
    rows, figures, motion_rows, graze_rows = [], [], [], []
    with tempfile.TemporaryDirectory() as folder:
        mesh = Path(folder) / "wedge.obj"
        mesh.write_text(WEDGE)
        for name in args.robot or ["dual_panda_softhand", "baxter"]:
            robot, rng = load_robot(name), np.random.default_rng(args.seed)
            wide, tight, inside = Count("wide"), Count("near contact"), Count("obstacle in a link")
            for k in range(SCENES):
                hands = held(robot) if k % 2 else []
                both, meshes = pair(robot, scene(rng, (3, 10, 30)[k % 3], mesh), hands)
                share = args.states // SCENES
                around = around_home(robot, rng, share // 2)
                wide.add(both, meshes, np.concatenate([around, robot.random_state(rng, share // 6)]))
                wanted = share // 3 // 20
                pool = around[: max(4 * wanted, 400)]
                edge = near_contact(both, pool, both.are_free(pool), rng)[: 2 * wanted]
                if len(edge) == 0:  # all of them free, or none
                    continue
                spread = edge[rng.integers(len(edge), size=share // 3)]
                tight.add(both, meshes, spread + rng.normal(0.0, 3e-4, spread.shape))
            inside_a_link(robot, rng, inside, max(args.states // 10, 200))
            rows += [count.row(robot) for count in (wide, tight, inside)]
            moved = motions(robot, rng, args.motions, mesh)
            grazed = grazes(name, args.grazes, args.seed, args.jobs)
            figures.append({
                "robot": name, "states": [vars(c) for c in (wide, tight, inside)], "motions": moved,
                "grazes": vars(grazed),
            })  # fmt: skip
            graze_rows.append([name, grazed.paths, grazed.colliding, grazed.false_free, grazed.clear, grazed.refused,
                               grazed.off, ", ".join(f"{k} {n}" for k, n in sorted(grazed.pairs.items()))])  # fmt: skip
            motion_rows.append([name, moved["proved"], moved["samples"], moved["colliding"],
                                *(f"{moved[key]:.3f}" for key in list(moved)[3:])])  # fmt: skip
    head = ["robot", "states", "N", "free by meshes", "proved, of the free", "proved free but colliding",
            "two stages differ from meshes"]  # fmt: skip
    table = "\n".join(record.row(r) for r in [head, ["---"] * 2 + ["---:"] * 5, *rows])
    head = ["robot", "motions proved", f"samples on them, {DENSER} times denser", "of these colliding",
            "search: length inside proved intervals", "checked states proved", "states to meshes, per step",
            "full check: length inside proved intervals", "checked states proved",
            "states to meshes, per step"]  # fmt: skip
    table += "\n\nFree motions of all lengths, half of them beginning near a contact:\n\n"
    table += "\n".join(record.row(r) for r in [head, ["---"] + ["---:"] * 9, *motion_rows])
    head = ["robot", "grazing paths", "colliding by Coal", "of these proved", "clear by more than 20 um",
            "of these refused", "nearer than the proved clearance", "pairs"]  # fmt: skip
    table += "\n\nPaths bisected to contact, then shifted by 1 um to 1 mm to either side, against the full check:\n\n"
    table += "\n".join(record.row(r) for r in [head, ["---"] + ["---:"] * 6 + ["---"], *graze_rows])
    record.write("proofs", {"robots": figures}, table, seed=args.seed, states_per_robot=args.states)


if __name__ == "__main__":
    run_script(main)
