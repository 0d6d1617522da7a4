"""Timing of paths: limits, deviation, proof, duration beside TOPP-RA's optimum, computing time; and other methods.

The paths are those that apex finds for the first test problems of each static level; those of rrtconnect, simplified,
whose corners are sharp, are timed as well. Each is timed by both methods of ``Timing``, ruckig and spline, as ``plan``
does it: with the full check of the motion, whose time is not counted. TOPP-RA's optimum is that of the cubic spline
through the states of apex's paths under the same limits of velocity and acceleration, without any of jerk (package
``toppra``, extra ``peers``).

The other methods, on the first problems of each level:
``Ruckig along the arc``: one number moves along the same curve by Ruckig, in stretches with limits from the curve's
derivatives and with speeds between them that can be reached; the best of 1 to 32 stretches.
``TOPP-RA, then Ruckig``: TOPP-RA's states every 50 ms, Ruckig in all joints from one to the next.
``Ruckig from waypoint to waypoint``: points of the curve every 0.2 rad with the velocities of the fastest motion and no
acceleration, Ruckig in all joints.
``Ruckig from corner to corner``: at rest at each, without leaving the path; of rrtconnect's paths.

rrtconnect's paths are kept in benchmarks/runs, so that they can be planned beside other work (--paths-only).

Usage: python -m benchmarks.timing.timing [SUITE[/LEVEL] ...] [-n 18] [--others 3] [--paths-only]
"""

from __future__ import annotations

import io
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from importlib import metadata
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import toppra
from tqdm import tqdm

from apex_ompl import plan, problems
from apex_ompl.errors import TimingError
from apex_ompl.kernel.timing import max_distance
from apex_ompl.ompl.setup import assemble
from apex_ompl.ompl.validity import full_check
from apex_ompl.paths.path import Path
from apex_ompl.problems.suite_robot import robot
from apex_ompl.result import PlanResult
from apex_ompl.timing import Timing, Trajectory, time_path
from apex_ompl.timing.curve import Polyline
from apex_ompl.timing.parameterization import METHODS
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.files import write_atomically
from apex_ompl.util.validation import whole_number
from benchmarks.lib import record
from benchmarks.timing.timing_methods import (
    EACH,
    LIMITS,
    NAMES,
    after_toppra,
    along_arc,
    by_waypoints,
    from_corner_to_corner,
    optimum,
)

DEPENDS = ("@planning", "apex_ompl/timing")
Method = Callable[[np.ndarray], Trajectory | None]
KEPT = FilePath(__file__).parents[1] / "runs" / "timing"  # rrtconnect's paths
DERIVATIVES = ("position", "velocity", "acceleration", "jerk")


@dataclass
class Figures:
    """Figures of a method of time parameterization."""

    ratios: list[float] = field(default_factory=list)
    durations: list[float] = field(default_factory=list)
    deviations: list[float] = field(default_factory=list)
    uses: list[list[float]] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    jerks: list[float] = field(default_factory=list)
    proofs: list[float] = field(default_factory=list)
    knots: list[int] = field(default_factory=list)
    other: int = 0
    stops: int = 0
    failed: int = 0
    none: int = 0

    def cells(self) -> list[Any]:
        """Return the cells of a row."""
        ratio = [f"{v:.3f}" for v in record.percentiles(self.ratios, 50, 95, 100)] if self.ratios else ["-"] * 3
        uses = [f"{v:.4f}" for v in np.max(self.uses, axis=0)] if self.uses else ["-"] * 4
        deviation = [f"{1e3 * v:.1f}" for v in record.percentiles(self.deviations, 50, 95, 100)]
        took = [f"{1e3 * v:.1f}" for v in record.percentiles(self.seconds, 50, 95)]
        made = len(self.durations)
        shares = [made + self.none, f"{made / max(made + self.none, 1):.3f}"]
        whole = [f"{np.median(self.durations):.2f}", f"{np.median(self.jerks):.0f}"] if made else ["-", "-"]
        proof = [f"{1e3 * v:.1f}" for v in record.percentiles(self.proofs, 50, 95)] if self.proofs else ["-"] * 2
        knots = [f"{np.median(self.knots):.0f}"] if self.knots else ["-"]
        return [*shares, *whole, *ratio, *uses, *deviation, self.failed, *took, *proof, *knots, self.other, self.stops]


HEAD = (
    "N", "timed", "duration s p50", "jerk rad/s^3 p50", "duration / TOPP-RA p50", "p95", "most",
    *(f"most use of {name}" for name in DERIVATIVES), "deviation mrad p50", "p95", "most", "full check failed",
    "ms p50", "p95", "proof ms p50", "p95", "knots p50", "by the other method", "stops at corners",
)  # fmt: skip


def deviation_of(motion: Trajectory, path: np.ndarray) -> float:
    """Return the largest distance of samples from a path [rad]."""
    line, states = Polyline.through(path), motion.sample(EACH).position
    arc = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(states, axis=0), axis=1)))
    return max_distance(states, arc * line.length / max(arc[-1], 1e-12), line.states, line.arc, 1.5)


def measure(figures: Figures, motion: Trajectory | None, path: np.ndarray, checker: Any, best: float | None) -> None:
    """Add the figures of a motion."""
    if motion is None:
        figures.none += 1
        return
    figures.durations.append(motion.duration)
    figures.uses.append([motion.use(LIMITS)[name] for name in DERIVATIVES])
    figures.deviations.append(deviation_of(motion, path))
    figures.jerks.append(motion.jerk)
    if motion.use(LIMITS)["position"] > 1.0 + 1e-9:
        figures.failed += 1
    else:
        positions = np.clip(motion.positions, LIMITS.lower, LIMITS.upper)
        positions[[0, -1]] = path[[0, -1]]  # without rounding
        figures.failed += not full_check(checker, replace(motion, positions=positions), path[0], [path[-1]])
    if best is not None:
        figures.ratios.append(motion.duration / best)


def proved(figures: Figures, path: Path, checker: Any, method: str, best: float | None) -> None:
    """Time a path by a method of ``Timing``, as ``plan`` does it, and add the figures; the proof's time is left out."""
    proof = 0.0

    def fault(motion: Trajectory) -> str:
        nonlocal proof
        started = time.perf_counter()
        reason = full_check(checker, motion, path.states[0], [path.states[-1]]).reason
        proof += time.perf_counter() - started
        return reason

    started = time.perf_counter()
    try:
        made = time_path(path, LIMITS, NAMES, Timing(method), fault)
    except TimingError:
        figures.none += 1
        return
    figures.seconds.append(time.perf_counter() - started - proof)
    figures.proofs.append(proof)
    figures.knots.append(len(made.trajectory.times))
    figures.other += made.method != method
    figures.stops += made.form == "stops"
    measure(figures, made.trajectory, path.states, checker, best)


def timed_method(
    method: Callable[[np.ndarray], Trajectory | None], path: np.ndarray
) -> tuple[Trajectory | None, float]:
    """Return the motion of a method, and its computing time [s]."""
    started = time.perf_counter()
    motion = method(path)
    return motion, time.perf_counter() - started


def rrtconnect_path(name: str, seed: int) -> tuple[Path | None, str]:
    """Return rrtconnect's path of a problem, None where it finds none in 10 s, and the commit; both are kept."""
    file = KEPT / f"{name.replace('/', '-')}-{seed}.npz"
    if not file.exists():
        path = plan(name, "rrtconnect", timeout=10.0, seed=seed, timing=False).path
        KEPT.mkdir(parents=True, exist_ok=True)
        content = io.BytesIO()
        states = np.empty((0, 0)) if path is None else path.states
        np.savez(content, states=states, commit=np.array(record.session()["commit"]))
        write_atomically(file, content.getvalue())
    with np.load(file) as data:
        return (Path(data["states"]) if len(data["states"]) else None), str(data["commit"])


OTHERS: dict[str, Method] = {
    "Ruckig along the arc": along_arc,
    "TOPP-RA, then Ruckig": after_toppra,
    "Ruckig from waypoint to waypoint": by_waypoints,
}


def main() -> None:
    """Time paths, and write the results."""
    parser = record.parser(__doc__, n=18)
    parser.add_argument("levels", nargs="*", metavar="SUITE[/LEVEL]")
    parser.add_argument(
        "--others", type=whole_number, default=3, help="of them for the other methods (default: %(default)s)"
    )
    parser.add_argument("--paths-only", action="store_true", help="plan rrtconnect's paths, for a later run")
    args = parser.parse_args()
    toppra.setup_logging("ERROR")
    names = [
        (name, k)
        for level in record.static_levels(args.levels)
        for k, name in enumerate(problems.frozen_names(*level.split("/"), "test")[: args.n])
    ]
    sharp = {name: rrtconnect_path(name, k) for name, k in tqdm(names, desc="rrtconnect", unit="problem")}
    if args.paths_only:
        return
    planned = {(planner, method): Figures() for planner in ("apex", "rrtconnect") for method in METHODS}
    methods = {**{name: Figures() for name in OTHERS}, "Ruckig from corner to corner": Figures()}
    stages: dict[str, list[float]] = {}
    for name, k in tqdm(names, unit="problem"):
        checker = assemble(problems.load(name), robot()).checker
        mine: PlanResult = plan(name, "apex", timeout=10.0, seed=k)
        for planner, way in (("apex", mine.path), ("rrtconnect", sharp[name][0])):
            if way is None:
                continue
            path = way.states
            found = optimum(path) if planner == "apex" and len(path) > 2 else None
            best = None if found is None else found[1]
            for method in METHODS if len(path) > 2 else ():
                proved(planned[planner, method], way, checker, method, best)
            for stage in ("setup", "solve", "verify", "timing", "timing proof", "clearance", "total"):
                if planner == "apex":
                    stages.setdefault(stage, []).append(mine.times.get(stage, 0.0))
            if k >= args.others:
                continue
            if planner == "rrtconnect":
                made, took = timed_method(from_corner_to_corner, path)
                measure(methods["Ruckig from corner to corner"], made, path, checker, None)
                methods["Ruckig from corner to corner"].seconds.append(took)
            elif len(path) > 2:
                for label, other in OTHERS.items():
                    made, took = timed_method(other, path)
                    measure(methods[label], made, path, checker, best)
                    methods[label].seconds.append(took)
    rows = [record.row(["paths", *HEAD]), record.row(["---", *["---:"] * len(HEAD)])]
    rows += [record.row([f"{planner}, {method}", *f.cells()]) for (planner, method), f in planned.items()]
    rows += ["", record.row(["method", *HEAD]), record.row(["---", *["---:"] * len(HEAD)])]
    rows += [record.row([label, *figures.cells()]) for label, figures in methods.items()]
    rows += ["", record.row(["stage of plan, apex", "ms p50", "p95"]), record.row(["---", "---:", "---:"])]
    for stage, seconds in stages.items():
        rows.append(record.row([stage, *(f"{1e3 * v:.1f}" for v in record.percentiles(seconds, 50, 95))]))
    figures = {f"{planner}, {method}": f.__dict__ for (planner, method), f in planned.items()}
    figures |= {label: f.__dict__ for label, f in methods.items()}
    commits = "; ".join(sorted({commit for _, commit in sharp.values()}))
    about = {
        "rrtconnect's paths": f"of commit {commits}",
        "split": "test",
        "seed": "number of the problem in its level",
        "toppra": metadata.version("toppra"),
    }
    record.write("timing", {"figures": figures}, "\n".join(rows), **about, ruckig=metadata.version("ruckig"))


if __name__ == "__main__":
    run_script(main)
