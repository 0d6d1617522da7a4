"""What this machine could do at best in the stages of a solve, beside what they take.

The least time of a stage is that of its arithmetic at the rate of products of 64 x 64 matrices on one core, or that of
its bytes at the rate at which one core reads memory, whichever is longer. Operations are counted from sizes: of a
network the products with its weights, a byte each; of a Cholesky factor the products inside its band; of kinematics
108 for a joint (a rotation by a rotation, a vector by a rotation, a turn, sine and cosine as 20 each). What tests of
distances do depends on the scene and is not counted: rows without a least time. Times are those of one thread, the
least of repetitions.

Usage: python -m benchmarks.planners.limits [--repeat 15]
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from apex_ompl import load_model, problems
from apex_ompl.apex.models import make_query
from apex_ompl.kernel.compiled.arrays import robot_view
from apex_ompl.kernel.compiled.compilation import entry_point, reassociating_entry_point
from apex_ompl.kernel.compiled.layout import Floats, Integers
from apex_ompl.kernel.compiled.path.path_cost import PANEL, add_sample
from apex_ompl.kernel.compiled.path.path_optimization import _factorize
from apex_ompl.kernel.compiled.robot.kinematics import place_cluster, place_robot
from apex_ompl.kernel.compiled.workspace import workspace_view
from apex_ompl.ompl.setup import assemble
from apex_ompl.paths.optimizer import Optimizer, path_grid
from apex_ompl.problems.suite_robot import robot
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import one_or_more
from benchmarks.lib import record

DEPENDS = ("apex_ompl/model", "apex_ompl/kernel", "apex_ompl/paths", "apex_ompl/collision")
PROBLEM = "shelf/hard/800003"
PROPOSALS, BUMPED, STEPS = 4, 8, 12
JOINT = 108  # operations
ROWS = 64  # of the matrices whose product shows the rate of arithmetic: larger ones are divided among cores
TIMES = 100  # products in a row
MEMORY = 64 * 2**20  # bytes that are read


@entry_point
def place(tables: tuple[Integers, Floats], work: tuple[Integers, Floats], states: Floats, hands: bool) -> float:
    """Place the robot at states, shape (N, dof), with the inner joints of its clusters or without."""
    t = robot_view(tables[0], tables[1])
    w = workspace_view(t, work[0], work[1])
    total = 0.0
    for k in range(len(states)):
        place_robot(t, w, states[k])
        if hands:
            for c in range(len(t.cluster_joint)):
                place_cluster(t, w, states[k], c)
        total += w.ball[0, 0]
    return total


@reassociating_entry_point
def factorize(matrix: Floats, factor: Floats, band: int, panel: Floats) -> bool:
    """Copy a banded matrix and factorize it."""
    for i in range(len(matrix)):
        for j in range(i, min(len(matrix), i + band)):
            factor[i, j] = matrix[i, j]
    return _factorize(factor, band, panel)


@reassociating_entry_point
def add_samples(weights: Floats, first: Integers, matrix: Floats, gram: Floats, room: Floats) -> None:
    """Add one matrix at all samples of a path."""
    for k in range(len(weights)):
        add_sample(1.0, weights[k], first[k], 1, len(gram) // len(matrix), matrix[0], matrix, room[0], gram, room[1])


def least(call: Callable[[], Any], repeat: int, of: int = 1) -> float:
    """Return the least time of one of ``of`` things that a call does [s]."""
    call()
    found = []
    for _ in range(repeat):
        began = time.perf_counter()
        call()
        found.append((time.perf_counter() - began) / of)
    return min(found)


def rates(repeat: int) -> dict[str, float]:
    """Return operations a second in single and double precision, and bytes a second, of one core."""
    found = {}
    for name, kind in (("single", np.float32), ("double", np.float64)):
        a = np.ones((ROWS, ROWS), kind)
        out = np.empty_like(a)
        took = least(lambda a=a, out=out: [np.matmul(a, a, out=out) for _ in range(TIMES)], repeat, TIMES)
        found[name] = 2.0 * ROWS**3 / took
    data = np.ones(MEMORY // 8)
    found["bytes"] = MEMORY / least(data.max, repeat)
    return found


def stages(repeat: int) -> list[tuple[str, float, float, str, float]]:
    """Return name, operations, bytes, precision, and time [s] of stages; operations are NaN where not counted."""
    model, ready = load_model("apex"), assemble(problems.load(PROBLEM), robot())
    kernel, optimizer = ready.checker.kernel, Optimizer(model.spline)
    query = make_query(ready.checker, ready.start, ready.goals[0], point=False)
    weights = {name: array.size for name, array in model.weights.items()}  # type: ignore[attr-defined]
    denoiser = sum(size for name, size in weights.items() if name.startswith("denoiser") and name.endswith("weight"))
    once = sum(size for name, size in weights.items() if "modulation.weight" in name)  # the same for all proposals
    encoder = sum(size for name, size in weights.items() if "phi" in name and name.endswith("weight"))
    token = sum(size for name, size in weights.items() if "thing" in name and name.endswith("weight"))
    condition = model.condition([query], kernel)
    noise = np.random.default_rng(0).normal(size=(PROPOSALS, model.config.latent.dim)).astype(np.float32)
    products = 2.0 * (once + PROPOSALS * (denoiser - once))
    rows = [
        (
            "condition", 2.0 * (encoder + token * len(query.obstacles)), float(encoder + token), "single",
            least(lambda: model.condition([query], kernel), repeat),
        ),
        (
            f"denoising step of {PROPOSALS}", products, float(denoiser), "single",
            least(lambda: model.denoise(noise, 100, condition), repeat),
        ),
    ]  # fmt: skip
    starts = optimizer.starts(ready.start, ready.goals[0], BUMPED, np.random.default_rng(0), 0.5)
    near = optimizer.improve(kernel, starts, steps=STEPS).control
    limits = ready.checker.robot.limits
    states = np.ascontiguousarray(np.clip(np.concatenate([model.spline.path(c) for c in near]), *limits_of(limits)))
    arrays, packed, work = kernel.robot.arrays, kernel.packed, kernel.workspace()
    eager, lazy = JOINT * len(arrays.eager), JOINT * len(arrays.lazy)
    for name, joints, hands in (("kinematics of a state", eager, False), ("with its fingers", eager + lazy, True)):
        took = least(lambda hands=hands: place(packed[:2], work, states, hands), repeat, len(states))
        rows.append((name, float(joints), 0.0, "double", took))
    took = least(lambda: kernel.unproved(states), repeat, len(states))
    rows.append(("proof of a state", np.nan, 0.0, "double", took))
    many, threads = np.tile(states, (8, 1)), os.cpu_count() or 1
    took = least(lambda: kernel.unproved(many, threads), repeat, len(many))
    rows.append((f"the same of many, by {threads} threads", np.nan, 0.0, "double", took))
    grid, dof = path_grid(optimizer.spline, optimizer.settings.samples), len(limits.lower)
    n, band = optimizer.spline.free * dof, grid[0].shape[1] * dof
    matrix = np.eye(dof) + 1.0
    gram, room = np.zeros((n, n)), np.zeros((2, n))
    count = grid[0].shape[1] * (grid[0].shape[1] + 1) / 2 * dof * dof * 2.0 * len(grid[0])
    took = least(lambda: add_samples(*grid[:2], matrix, gram, room), repeat)
    rows.append(("all samples into the matrix of a step", count, 8.0 * n * band, "double", took))
    banded = np.where(np.abs(np.subtract.outer(np.arange(n), np.arange(n))) < band, 0.01, 0.0) + 10.0 * np.eye(n)
    factor, panel = np.zeros((n, n)), np.zeros(PANEL)
    count = float(sum(min(band, n - k) ** 2 for k in range(n)))
    took = least(lambda: factorize(banded, factor, band, panel), repeat)
    rows.append(("Cholesky factor of a step", count, 8.0 * n * band, "double", took))
    took = least(lambda: optimizer.improve(kernel, near, steps=0), repeat, len(near))
    rows.append(("cost of a path, with gradient and matrix", np.nan, 0.0, "double", took))
    steps = int(optimizer.improve(kernel, starts, steps=STEPS).steps.sum())
    took = least(lambda: optimizer.improve(kernel, starts, steps=STEPS), repeat, steps)
    rows.append(("step of Levenberg-Marquardt", np.nan, 0.0, "double", took))
    return rows


def limits_of(limits: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and upper limits of a robot's positions."""
    return limits.lower, limits.upper


def main() -> None:
    """Measure, and write the results."""
    parser = record.parser(__doc__)
    parser.add_argument("--repeat", type=one_or_more, default=15, help="repetitions (default: %(default)s)")
    args = parser.parse_args()
    speed, rows = rates(args.repeat), stages(args.repeat)
    head = ["stage", "operations", "bytes", "least us", "takes us", "ratio"]
    lines = [record.row(head), record.row(["---", *["---:"] * 5])]
    figures = []
    for name, operations, size, precision, took in rows:
        floor = max(operations / speed[precision], size / speed["bytes"])
        known = np.isfinite(floor)
        figures.append({"stage": name, "operations": operations if known else None, "bytes": size, "seconds": took,
                        "least": floor if known else None})  # fmt: skip
        cells = [f"{operations:.3g}", f"{size:.3g}", f"{1e6 * floor:.2f}"] if known else ["", "", ""]
        lines.append(record.row([name, *cells, f"{1e6 * took:.2f}", f"{took / floor:.1f}" if known else ""]))
    rate = (
        f"{speed['single'] / 1e9:.0f} and {speed['double'] / 1e9:.0f} thousand million operations a second in single "
    )
    rate += f"and double precision, {speed['bytes'] / 1e9:.1f} GB a second read, by one core."
    record.write(
        "limits", {"rates": speed, "stages": figures}, "\n".join([*lines, "", rate]), problem=PROBLEM, threads=1
    )


if __name__ == "__main__":
    run_script(main)
