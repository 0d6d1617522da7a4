"""Random edits of a world against a checker that is built anew, and the memory of the process.

Obstacles of all kinds and held objects are added, moved, removed, attached, detached and allowed to touch. Every so
often the answers on random states are compared with those of a checker of the same world that is built anew: which
states are free, and the clearances by the kernel. Memory is the resident set of the process.

Then worlds of many boxes are set up, and a mesh of 20 000 triangles is added, for the first time and again.

Usage: python -m benchmarks.collision.world_edits [-n 10000] [--every 100]
"""

from __future__ import annotations

import os
import tempfile
import threading
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
from tqdm import tqdm

from apex_ompl.collision import CollisionChecker
from apex_ompl.planning.world import World
from apex_ompl.robot import load_robot
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import one_or_more
from benchmarks.lib import record

DEPENDS = ("@checking", "apex_ompl/planning/world.py")
SHAPES = (
    {"box": (0.1, 0.15, 0.2)}, {"sphere": {"radius": 0.08}}, {"cylinder": {"radius": 0.05, "length": 0.3}},
    {"capsule": {"radius": 0.04, "length": 0.2}}, {"half_space": {"normal": (0.0, 0.0, 1.0), "offset": -0.05}},
)  # fmt: skip
KINDS = ("add", "add ten boxes", *["move"] * 3, *["remove"] * 2, "allow", "attach", "detach")
MOST = 60  # obstacles at once
STATES = 50  # compared at a time
BOXES = (100, 1_000, 2_000, 5_000)
RINGS = 100, 101  # of a mesh of 20 000 triangles


def memory() -> float:
    """Return the resident set of this process [MB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def edit(world: World, rng: np.random.Generator, number: int) -> str:
    """Make one random edit and return its kind."""
    names, held = list(world.obstacles), list(world.held)
    turn = rng.normal(size=4)
    place = {
        "position": tuple(rng.uniform([0.2, -0.8, 0.05], [0.9, 0.8, 0.9]).tolist()),
        "orientation": tuple((turn / np.linalg.norm(turn)).tolist()),
    }
    kind = str(
        rng.choice(["add", "add ten boxes", "move", "move", "move", "remove", "remove", "allow", "attach", "detach"])
    )
    if kind == "move" and names:
        world.move(str(rng.choice(names)), **place)
    elif kind == "remove" and names or len(names) >= MOST:
        world.remove(str(rng.choice(names)))
        kind = "remove"
    elif kind == "attach" and len(held) < 2:
        side = "right" if "bar_left" in held else "left"
        link, size = f"{side}_hand_palm", {"radius": 0.02, "length": 0.12}
        world.attach({"name": f"bar_{side}", "link": link, "cylinder": size, "position": (0.0, 0.02, -0.03)})
    elif kind == "allow" and names:
        first = str(rng.choice([*held, "left_hand_palm", "right_link6"]))
        world.allow(first, str(rng.choice(names)), allowed=bool(rng.integers(2)))
    elif kind == "add ten boxes" and len(names) <= MOST - 10:
        for k in range(10):
            low, high = np.array([0.2, -0.8, 0.05]), np.array([0.9, 0.8, 0.9])
            world.add(name=f"o{number}.{k}", box=(0.05, 0.05, 0.2), position=tuple(rng.uniform(low, high).tolist()))
    elif kind == "detach" and held:
        world.detach(str(rng.choice(held)))
    else:
        kind = "add"
        world.add(name=f"o{number}", **SHAPES[int(rng.integers(len(SHAPES)))], **place)
    return kind


def setups() -> dict[str, float]:
    """Return the times that it takes to fill worlds [s]: problem read, obstacles added, tables and broadphase made."""
    robot, rng, found = load_robot("dual_panda_softhand"), np.random.default_rng(0), {}
    places = rng.uniform([-2.0, -2.0, 1.2], [2.0, 2.0, 3.0], (max(BOXES), 3))
    boxes = [{"name": f"b{k}", "box": (0.05, 0.05, 0.05), "position": tuple(p.tolist())} for k, p in enumerate(places)]
    for count in BOXES:
        begin = time.perf_counter()
        checker = CollisionChecker(robot)
        World(checker, threading.RLock()).add(*boxes[:count])
        checker.prepare()
        checker.is_free(robot.home)
        found[f"{count} boxes"] = time.perf_counter() - begin
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "ball.obj"
        file.write_text(ball(*RINGS))
        for which in ("first", "again"):
            checker = CollisionChecker(robot)
            checker.prepare()
            begin = time.perf_counter()
            World(checker, threading.RLock()).add(name="m", mesh={"file": str(file)}, position=(0.6, 0.0, 0.6))
            checker.is_free(robot.home)
            found[f"mesh of {2 * RINGS[0] * (RINGS[1] - 1)} triangles, {which}"] = time.perf_counter() - begin
    return found


def ball(around: int, along: int) -> str:
    """Return a bumpy ball as a Wavefront OBJ, of 2 around (along - 1) triangles."""
    u, v = np.meshgrid(np.arange(around) / around, np.arange(1, along) / along)
    turn, lift = 2.0 * np.pi * u.ravel(), np.pi * v.ravel()
    radius = 0.12 * (1.0 + 0.2 * np.sin(5.0 * turn) * np.sin(lift) ** 2)
    points = radius[:, None] * np.stack(
        [np.sin(lift) * np.cos(turn), np.sin(lift) * np.sin(turn), np.cos(lift)], axis=1
    )
    points = np.concatenate([points, [[0.0, 0.0, 0.12], [0.0, 0.0, -0.12]]])
    top, bottom = len(points) - 2, len(points) - 1
    faces = [(top, k, (k + 1) % around) for k in range(around)]
    last = (along - 2) * around
    faces += [(bottom, last + (k + 1) % around, last + k) for k in range(around)]
    for row in range(along - 2):
        for k in range(around):
            a, b = row * around + k, row * around + (k + 1) % around
            faces += [(a, a + around, b), (b, a + around, b + around)]
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in points]
    return "\n".join([*lines, *(f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces)]) + "\n"


def main() -> None:
    """Edit, compare and write."""
    parser = record.parser(__doc__)
    parser.add_argument("-n", type=one_or_more, default=10_000, metavar="EDITS")
    parser.add_argument("--every", type=one_or_more, default=100, metavar="EDITS", help="between comparisons")
    args = parser.parse_args()
    rng, robot = np.random.default_rng(0), load_robot("dual_panda_softhand")
    checker = CollisionChecker(robot)
    world = World(checker, threading.RLock())
    checker.prepare()
    times: dict[str, list[float]] = defaultdict(list)
    compared = differing = 0
    used: list[float] = []
    for k in tqdm(range(1, args.n + 1), unit="edit"):
        begin = time.perf_counter()
        kind = edit(world, rng, k)
        checker.kernel  # noqa: B018 - the tables are made when they are asked for
        times[kind].append(time.perf_counter() - begin)
        if k % args.every == 0:
            anew = CollisionChecker(robot, world.obstacles.values(), world.held.values(), world.allowed)
            states = robot.home + rng.normal(0.0, 0.5, (STATES, robot.dof))
            states = np.clip(states, robot.limits.lower, robot.limits.upper)
            near, other = checker.kernel.clearance(states, 0.3), anew.kernel.clearance(states, 0.3)
            same = checker.are_free(states) == anew.are_free(states)
            same &= np.isclose(near, other, rtol=0.0, atol=1e-12, equal_nan=True).all(axis=1)
            compared, differing = compared + STATES, differing + int((~same).sum())
            used.append(memory())
    lines = [["edit", "N", "p50 ms", "p95 ms"], ["---", *["---:"] * 3]]
    for kind, values in sorted(times.items()):
        lines.append([kind, str(len(values)), *(f"{1e3 * v:.2f}" for v in record.percentiles(values, 50, 95))])
    text = "\n".join(record.row(line) for line in lines)
    quarter = max(1, len(used) // 4)
    text += f"\n\n{compared} states compared with checkers built anew, {differing} with another answer. "
    text += f"Memory after a quarter of the edits {used[quarter - 1]:.0f} MB, at the end {used[-1]:.0f} MB."
    filled = setups()
    text += "\n\n" + record.row(["world", "set-up s"]) + "\n" + record.row(["---", "---:"]) + "\n"
    text += "\n".join(record.row([name, f"{seconds:.3f}"]) for name, seconds in filled.items())
    data = {"times": times, "setups": filled, "compared": compared, "differing": differing, "memory": used}
    record.write("world_edits", data, text, n=args.n, every=args.every, seed=0)


if __name__ == "__main__":
    run_script(main)
