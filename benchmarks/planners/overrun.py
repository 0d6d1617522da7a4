"""How long plans and runs of benchmarks go on behind their time limits.

Each planner plans under limits of 0.05, 0.5 and 5 s, by ``plan`` with a timed motion and as a row of a benchmark, on
validation problems of three kinds: hard levels; the same with three of their boxes dented, as non-convex meshes; and
one without a way to the goal. The overrun of a plan is the time after its set-up that exceeds the limit, clearance and
all; that of a row is its end beyond the limit, with OMPL's own measuring left out. An overrun of 0.1 s and 2 % of the
limit is allowed.

Usage: python -m benchmarks.planners.overrun [--planner apex ...] [--share 1.0]
"""

from __future__ import annotations

import re
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import cycle, islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from apex_ompl import plan, problems
from apex_ompl.evaluation.rows import Job
from apex_ompl.evaluation.runs import run
from apex_ompl.scene.bodies import MeshFile, Obstacle
from apex_ompl.scene.problem import Problem
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import check_positive
from benchmarks.lib import record
from benchmarks.planners.robustness import walled

DEPENDS = ("@benchmark", "apex_ompl/timing", "benchmarks/planners/robustness.py")
PLANNERS = ("apex", "rrtconnect", "rrtconnect+polish", "rrt", "bitstar", "informedrrtstar", "aorrtc", "kpiece1")
SUITES = ("shelf", "bins", "cage", "clutter", "swap", "posts", "wall")
COUNTS = {0.05: 40, 0.5: 30, 5.0: 5}
"""Runs of each planner under each limit [s]."""
ALLOWED, ALLOWED_SHARE = 0.1, 0.02  # overrun [s], and as a share of the limit
CELLS, MESHES = 6, 3  # squares of a dented mesh along a side, and boxes of a problem that become meshes
EVERY = 3  # problem has meshes
DENT = 0.6  # depth of the dent, as a share of the height
PLAN, ROW = "plan", "row"


class Measured(NamedTuple):
    """One run.

    Attributes:
        planner: Name of the planner.
        limit: Time limit [s].
        how: ``plan`` or ``row``.
        problem: Name of the problem.
        status: Status of the result.
        reason: Reason where it is not solved.
        overrun: Time beyond the limit, 0 or more [s].
    """

    planner: str
    limit: float
    how: str
    problem: str
    status: str
    reason: str
    overrun: float


def dented(size: Sequence[float]) -> str:
    """Return a box of some size [m] with a dent in its top, as the text of an OBJ file: a closed, non-convex mesh."""
    n, height = CELLS + 1, size[2]
    x, y = np.meshgrid(*(np.linspace(-0.5, 0.5, n) * side for side in size[:2]), indexing="ij")
    depth = DENT * height * np.clip(1.0 - 2.0 * np.maximum(np.abs(x) / size[0], np.abs(y) / size[1]), 0.0, 0.5) * 2.0
    top, bottom = height / 2.0 - depth, np.full_like(x, -height / 2.0)
    corners = np.concatenate([np.stack([x, y, z], axis=-1).reshape(-1, 3) for z in (top, bottom)])
    faces = []
    for i in range(CELLS):
        for k in range(CELLS):
            a, b, c, d = i * n + k, (i + 1) * n + k, (i + 1) * n + k + 1, i * n + k + 1
            faces += [(a, b, c), (a, c, d)]
            faces += [tuple(v + n * n for v in face) for face in ((a, c, b), (a, d, c))]
    around = [(i, 0) for i in range(n - 1)] + [(n - 1, k) for k in range(n - 1)]
    around += [(i, n - 1) for i in range(n - 1, 0, -1)] + [(0, k) for k in range(n - 1, 0, -1)]
    rim = [i * n + k for i, k in around]
    for a, b in zip(rim, rim[1:] + rim[:1], strict=True):
        faces += [(a, a + n * n, b), (b, a + n * n, b + n * n)]
    lines = [f"v {v[0]:.9g} {v[1]:.9g} {v[2]:.9g}" for v in corners]
    return "\n".join([*lines, *(f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces), ""])


def with_meshes(problem: Problem, folder: Path) -> Problem:
    """Return a problem whose first boxes are dented meshes, in files of a folder."""
    scene, boxes = [], 0
    for k, body in enumerate(problem.scene):
        if body.box is None or boxes == MESHES:
            scene.append(body)
            continue
        boxes += 1
        file = folder / f"{problem.name}-{k}.obj".replace("/", "-")
        file.write_text(dented(body.box))
        mesh = MeshFile(file=str(file))
        scene.append(Obstacle(name=body.name, mesh=mesh, position=body.position, orientation=body.orientation))
    return problem.model_copy(update={"scene": tuple(scene), "name": f"{problem.name}-dented"})


def cases(folder: Path) -> Iterator[Path]:
    """Yield files of problems: hard ones of all suites in turn, every third with meshes, and the one without a way."""
    names = [problems.frozen_names(suite, "hard", "validation") for suite in SUITES]
    for number in range(min(map(len, names))):
        for k, some in enumerate(names):
            problem = problems.load(some[number])
            problem = with_meshes(problem, folder) if (number + k) % EVERY == 0 else problem
            file = folder / f"{problem.name.replace('/', '-')}.yaml"
            problem.save(file)
            yield file
        file = folder / f"walled-{number}.yaml"
        walled().save(file)
        yield file


def measured(planner: str, limit: float, how: str, file: Path, seed: int) -> Measured:
    """Make a run and return its overrun."""
    if how == PLAN:
        result = plan(file, planner, timeout=limit, seed=seed)
        took = result.times["total"] - result.times["setup"]
        status, reason = str(result.status), result.reason
    else:
        made = run(Job("overrun", str(file), planner, planner, {}, seed, limit, True))
        took, status, reason = made["total"] or 0.0, made["status"], made["reason"]
    return Measured(planner, limit, how, file.stem, status, reason, max(0.0, took - limit))


def table(found: Sequence[Measured]) -> str:
    """Return a Markdown table of the overruns of each planner under each limit."""
    head = [
        "planner",
        "limit s",
        "N",
        "limit reached",
        "overrun ms p50",
        "p95",
        "largest plan",
        "largest row",
        "allowed",
    ]
    lines = [record.row([*head, "over"]), record.row(["---", *["---:"] * len(head)])]
    for planner in dict.fromkeys(one.planner for one in found):
        for limit in sorted({one.limit for one in found}):
            mine = [one for one in found if (one.planner, one.limit) == (planner, limit)]
            if mine:
                lines.append(record.row([planner, f"{limit:g}", *_cells(mine, limit)]))
    return "\n".join([*lines, "", reasons(found)])


def _cells(mine: Sequence[Measured], limit: float) -> list[Any]:
    late = np.array([one.overrun for one in mine])
    allowed = ALLOWED + ALLOWED_SHARE * limit
    most = [max((one.overrun for one in mine if one.how == how), default=float("nan")) for how in (PLAN, ROW)]
    spread = [*record.percentiles(late, 50, 95), *most, allowed]
    reached = sum(one.status == "TIMEOUT" for one in mine)
    return [len(mine), reached, *(f"{1e3 * value:.1f}" for value in spread), int((late > allowed).sum())]


def reasons(found: Sequence[Measured]) -> str:
    """Return how often which reason was given for a status, as a sentence; what differs from run to run is left out."""
    shown = (re.sub(r"is \S+ rad", "is some way", one.reason.partition(",")[0]) for one in found)
    counts = Counter(f"{one.status}: {reason}" for one, reason in zip(found, shown, strict=True) if reason)
    return "Reasons: " + "; ".join(f"{count} {reason}" for reason, count in counts.most_common()) + "."


def main() -> None:
    """Make all runs, and write the results."""
    parser = record.parser(__doc__)
    parser.add_argument("--planner", action="append", choices=PLANNERS, default=[])
    parser.add_argument("--share", type=float, default=1.0, help="of the numbers of runs (default: %(default)s)")
    args = parser.parse_args()
    check_positive(args.share, "--share")
    counts = {limit: max(2, round(args.share * count)) for limit, count in COUNTS.items()}
    found: list[Measured] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        files = list(islice(cases(folder), max(counts.values())))
        for planner in args.planner or PLANNERS:
            for how in (PLAN, ROW):  # the first run of each loads what it needs
                measured(planner, 5.0, how, files[0], 0)
            for limit, count in counts.items():
                for seed, how, file in zip(range(count), cycle((PLAN, ROW)), files, strict=False):
                    found.append(measured(planner, limit, how, file, seed))
    worst = sorted(found, key=lambda one: -one.overrun)[:10]
    data = {"counts": {str(limit): count for limit, count in counts.items()}, "runs": [one._asdict() for one in found]}
    text = table(found) + "\n\nLargest: " + "; ".join(
        f"{1e3 * one.overrun:.0f} ms, {one.planner}, {one.limit:g} s, {one.how} of {one.problem} ({one.status})"
        for one in worst
    ) + "."  # fmt: skip
    record.write("overrun", data, text, split="validation", N=len(found), seeds="0 to N - 1")


if __name__ == "__main__":
    run_script(main)
