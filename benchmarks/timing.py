"""Timing of paths: limits, deviation, proof, duration beside TOPP-RA's optimum, computing time; and other ways.

The paths are those that apex finds for the first test problems of each static level; those of rrtconnect, simplified,
whose corners are sharp, are timed as well. TOPP-RA's optimum is that of the cubic spline through the states of apex's
paths under the same limits of velocity and acceleration, without any of jerk (package ``toppra``, extra ``peers``).

The other ways, on the first problems of each level:
``Ruckig along the arc``: one number moves along the same curve by Ruckig, in stretches with limits from the curve's
derivatives and with speeds between them that can be reached; the best of 1 to 32 stretches.
``TOPP-RA, then Ruckig``: TOPP-RA's states every 50 ms, Ruckig in all joints from one to the next.
``Ruckig from waypoint to waypoint``: points of the curve every 0.2 rad with the velocities of the fastest way and no
acceleration, Ruckig in all joints.
``Ruckig from corner to corner``: at rest at each, without leaving the path; of rrtconnect's paths.

Usage: python benchmarks/timing.py [SUITE[/LEVEL] ...] [-n 18] [--ways 3]
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import metadata
from typing import Any

import numpy as np
import record
import ruckig
import toppra
from toppra import algorithm, constraint
from tqdm import tqdm

from apex_ompl import plan, problems
from apex_ompl.kernel.compiled.polyline_distance import max_distance
from apex_ompl.kernel.compiled.time_parameterization import max_path_speeds
from apex_ompl.ompl_adapter.setup import assemble
from apex_ompl.ompl_adapter.validity import full_check
from apex_ompl.problems.reach import robot
from apex_ompl.result import PlanResult, PlanStatus
from apex_ompl.trajectory import Timing, Trajectory, time_path
from apex_ompl.trajectory.curve import Curve, Polyline
from apex_ompl.trajectory.motion import joined
from apex_ompl.trajectory.point_to_point import calculate, knots, stops
from apex_ompl.trajectory.timing import PER_PIECE, SPACING, least_spacing, spline
from apex_ompl.util.scripts import run_command
from apex_ompl.util.validation import one_or_more, whole_number

LIMITS, NAMES = robot().limits, robot().joint_names
APART_ON_PATH = SPACING * Timing().deviation  # of control points, as the first that time_path tries [rad]
EACH, APART, POINTS = 0.004, 0.05, 500  # of samples [s], of TOPP-RA's states [s], of its grid
DERIVATIVES = ("position", "velocity", "acceleration", "jerk")


@dataclass
class Figures:
    """What came of a way of timing."""

    ratios: list[float] = field(default_factory=list)
    durations: list[float] = field(default_factory=list)
    deviations: list[float] = field(default_factory=list)
    uses: list[list[float]] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    jerks: list[float] = field(default_factory=list)
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
        return [*shares, *whole, *ratio, *uses, *deviation, self.failed, *took]


HEAD = (
    "N", "timed", "duration s p50", "jerk rad/s^3 p50", "duration / TOPP-RA p50", "p95", "most",
    *(f"most use of {name}" for name in DERIVATIVES), "deviation mrad p50", "p95", "most", "full check failed",
    "ms p50", "p95",
)  # fmt: skip


def optimum(path: np.ndarray) -> tuple[Any, float] | None:
    """Return TOPP-RA's trajectory along the cubic spline through a path, and its duration [s]."""
    line = Polyline.through(path)
    v, a = LIMITS.velocity, LIMITS.acceleration
    along = toppra.SplineInterpolator(line.arc, line.states)
    bounds = [
        constraint.JointVelocityConstraint(np.stack([-v, v], 1)),
        constraint.JointAccelerationConstraint(np.stack([-a, a], 1)),
    ]
    grid = np.linspace(0.0, line.length, POINTS)
    made = algorithm.TOPPRA(bounds, along, gridpoints=grid, parametrizer="ParametrizeConstAccel").compute_trajectory()
    return None if made is None else (made, float(made.duration))


def in_all_joints(states: list[tuple[np.ndarray, np.ndarray, np.ndarray]], least: float | None) -> Trajectory | None:
    """Return Ruckig's motion through positions, velocities and accelerations."""
    solver, task, parts = ruckig.Ruckig(len(NAMES)), ruckig.InputParameter(len(NAMES)), list[Trajectory]()
    for name in ("velocity", "acceleration", "jerk"):
        setattr(task, f"max_{name}", getattr(LIMITS, name).tolist())
    task.minimum_duration = least
    for before, after in zip(states[:-1], states[1:], strict=True):
        for which, state in (("current", before), ("target", after)):
            for name, value in zip(("position", "velocity", "acceleration"), state, strict=True):
                setattr(task, f"{which}_{name}", value.tolist())
        made = ruckig.Trajectory(len(NAMES))
        try:
            calculate(solver, task, made)
        except ruckig.RuckigError:
            return None
        parts.append(Trajectory(*knots(made), NAMES))
    return joined(parts)


def after_toppra(path: np.ndarray) -> Trajectory | None:
    """Return the motion by TOPP-RA, then Ruckig."""
    found = optimum(path)
    if found is None:
        return None
    made, duration = found
    times = np.linspace(0.0, duration, max(2, math.ceil(duration / APART)))
    states = [
        (made(t), 0.999 * made(t, 1), np.clip(made(t, 2), -LIMITS.acceleration, LIMITS.acceleration)) for t in times
    ]
    still = np.zeros(len(NAMES))
    states[0], states[-1] = (path[0], still, still), (path[-1], still, still)
    return in_all_joints(states, times[1])


def curve_of(path: np.ndarray) -> tuple[Curve, np.ndarray, np.ndarray]:
    """Return the curve along a path and its derivatives."""
    curve = Curve.along(Polyline.through(path), APART_ON_PATH)
    return curve, *curve.derivatives(PER_PIECE)


def by_waypoints(path: np.ndarray) -> Trajectory | None:
    """Return the motion by Ruckig from waypoint to waypoint."""
    curve, first, second = curve_of(path)
    step, x = curve.spacing / PER_PIECE, np.empty(len(first))
    max_path_speeds(first, second, LIMITS.velocity, LIMITS.acceleration, step, x)
    chosen = np.unique(np.linspace(0, len(x) - 1, max(2, math.ceil(step * len(x) / 0.2))).astype(int))
    points, still = curve.points(chosen * step), np.zeros(len(NAMES))
    states = [(q, 0.999 * first[k] * math.sqrt(x[k]), still) for q, k in zip(points, chosen, strict=True)]
    states[0], states[-1] = (path[0], still, still), (path[-1], still, still)
    return in_all_joints(states, None)


def along_arc(path: np.ndarray) -> Trajectory | None:
    """Return the motion by Ruckig along the arc."""
    curve, first, second = curve_of(path)
    made = (in_stretches(curve, first, second, count) for count in (1, 2, 4, 8, 16, 32))
    return min((one for one in made if one is not None), key=lambda one: one.duration, default=None)


def in_stretches(curve: Curve, first: np.ndarray, second: np.ndarray, count: int) -> Trajectory | None:
    """Return the motion along a curve in so many stretches, each with limits of its own."""
    length, n = curve.spans * curve.spacing, len(first)
    edges = np.linspace(0, n - 1, count + 1).astype(int)
    parts = [slice(a, b + 1) for a, b in zip(edges[:-1], edges[1:], strict=True)]
    with np.errstate(divide="ignore"):
        speed = [
            min(np.min(LIMITS.velocity / abs(first[p])), math.sqrt(np.min(0.5 * LIMITS.acceleration / abs(second[p]))))
            for p in parts
        ]
        push = [float(np.min(0.5 * LIMITS.acceleration / abs(first[p]))) for p in parts]
        jolt = [float(np.min(0.5 * LIMITS.jerk / abs(first[p]))) for p in parts]
    ends = edges / (n - 1) * length
    between = [0.0, *(min(pair) for pair in zip(speed[:-1], speed[1:], strict=True)), 0.0]
    for order in (range(count), reversed(range(count))):  # forwards, then backwards
        for k in order:
            slow, fast = (k, k + 1) if between[k] < between[k + 1] else (k + 1, k)
            between[fast] = within_reach(between[slow], between[fast], push[k], jolt[k], ends[k + 1] - ends[k])
    solver, task = ruckig.Ruckig(1), ruckig.InputParameter(1)
    pieces, took = [], 0.0
    for k in range(count):
        task.current_position, task.target_position = [float(ends[k])], [float(ends[k + 1])]
        task.current_velocity, task.target_velocity = [between[k]], [between[k + 1]]
        task.max_velocity, task.max_acceleration, task.max_jerk = [float(speed[k])], [push[k]], [jolt[k]]
        made = ruckig.Trajectory(1)
        try:
            solver.calculate(task, made)
        except ruckig.RuckigError:
            return None
        pieces.append((took, made))
        took += made.duration
    times = np.linspace(0.0, took, max(2, math.ceil(took / EACH)))
    place = np.empty(len(times))
    for k, time_ in enumerate(times):
        begin, made = next(piece for piece in reversed(pieces) if piece[0] <= time_)
        place[k] = made.at_time(float(time_ - begin))[0][0]
    points = curve.points(np.clip(place, 0.0, length))
    control = np.concatenate([points[[0, 0]], points, points[[-1, -1]]])
    return spline(control, least_spacing(control, LIMITS), NAMES)


def within_reach(slow: float, fast: float, push: float, jolt: float, distance: float) -> float:
    """Return the greatest speed up to ``fast`` that a jerk-limited ramp reaches from ``slow`` over a distance."""

    def needs(speed: float) -> float:
        gain = speed - slow
        took = gain / push + push / jolt if gain > push**2 / jolt else 2.0 * math.sqrt(gain / jolt)
        return 0.5 * (slow + speed) * took

    if needs(fast) <= distance:
        return fast
    low, high = slow, fast
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if needs(middle) <= distance else (low, middle)
    return low


def from_corner_to_corner(path: np.ndarray) -> Trajectory:
    """Return the motion by Ruckig that stops at each corner."""
    return stops(Polyline.through(path).corners().states, LIMITS, NAMES)


def deviation_of(motion: Trajectory, path: np.ndarray) -> float:
    """Return the largest distance of samples from a path [rad]."""
    line, states = Polyline.through(path), motion.sample(EACH).position
    arc = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(states, axis=0), axis=1)))
    return float(max_distance(states, arc * line.length / max(arc[-1], 1e-12), line.states, line.arc, 1.5))


def judge(figures: Figures, motion: Trajectory | None, path: np.ndarray, checker: Any, best: float | None) -> None:
    """Add the figures of a motion."""
    if motion is None:
        figures.none += 1
        return
    figures.durations.append(motion.duration)
    figures.uses.append([motion.use(LIMITS)[name] for name in DERIVATIVES])
    figures.deviations.append(deviation_of(motion, path))
    figures.jerks.append(motion.jerk)
    states = np.clip(motion.sample(EACH).position, LIMITS.lower, LIMITS.upper)
    states = np.concatenate([path[:1], states[1:-1], path[-1:]])
    figures.failed += not full_check(checker, states, path[0], [path[-1]])
    if best is not None:
        figures.ratios.append(motion.duration / best)


def timed_way(way: Callable[[np.ndarray], Trajectory | None], path: np.ndarray) -> tuple[Trajectory | None, float]:
    """Return the motion of a way, and the seconds it took."""
    begin = time.perf_counter()
    motion = way(path)
    return motion, time.perf_counter() - begin


def ours(path: np.ndarray) -> Trajectory | None:
    """Return the motion of ``time_path``."""
    return time_path(path, LIMITS, NAMES).trajectory


WAYS: dict[str, Callable[[np.ndarray], Trajectory | None]] = {
    "time_path": ours,
    "Ruckig along the arc": along_arc,
    "TOPP-RA, then Ruckig": after_toppra,
    "Ruckig from waypoint to waypoint": by_waypoints,
}


def main() -> None:
    """Time paths, and write the results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("levels", nargs="*", metavar="SUITE[/LEVEL]")
    parser.add_argument("-n", type=one_or_more, default=18, help="problems of a level (default: %(default)s)")
    parser.add_argument(
        "--ways", type=whole_number, default=3, help="of them for the other ways (default: %(default)s)"
    )
    args = parser.parse_args()
    toppra.setup_logging("ERROR")
    names = [
        (name, k)
        for level in record.static_levels(args.levels)
        for k, name in enumerate(problems.frozen_names(*level.split("/"), "test")[: args.n])
    ]
    whole = {planner: Figures() for planner in ("apex", "rrtconnect")}
    ways = {**{name: Figures() for name in WAYS}, "Ruckig from corner to corner": Figures()}
    stages: dict[str, list[float]] = {}
    for name, k in tqdm(names, unit="problem"):
        checker = assemble(problems.load(name), robot()).checker
        for planner, figures in whole.items():
            result: PlanResult = plan(name, planner, timeout=10.0, seed=k)
            if result.status is PlanStatus.TIMING_FAILED:
                figures.none += 1
            if result.trajectory is None or result.path is None:
                continue
            path, motion = result.path, result.trajectory
            found = optimum(path) if planner == "apex" and len(path) > 2 else None
            best = None if found is None else found[1]
            judge(figures, motion, path, checker, best)
            figures.seconds.append(result.times["timing"])
            for stage in ("setup", "solve", "verify", "timing", "timing proof", "clearance", "total"):
                if planner == "apex":
                    stages.setdefault(stage, []).append(result.times.get(stage, 0.0))
            if k >= args.ways:
                continue
            if planner == "rrtconnect":
                made, took = timed_way(from_corner_to_corner, path)
                judge(ways["Ruckig from corner to corner"], made, path, checker, None)
                ways["Ruckig from corner to corner"].seconds.append(took)
            elif len(path) > 2:
                for label, way in WAYS.items():
                    made, took = timed_way(way, path)
                    judge(ways[label], made, path, checker, best)
                    ways[label].seconds.append(took)
    rows = [record.row(["paths", *HEAD]), record.row(["---", *["---:"] * len(HEAD)])]
    rows += [record.row([planner, *figures.cells()]) for planner, figures in whole.items()]
    rows += ["", record.row(["way", *HEAD]), record.row(["---", *["---:"] * len(HEAD)])]
    rows += [record.row([label, *figures.cells()]) for label, figures in ways.items()]
    rows += ["", record.row(["stage of plan, apex", "ms p50", "p95"]), record.row(["---", "---:", "---:"])]
    for stage, seconds in stages.items():
        rows.append(record.row([stage, *(f"{1e3 * v:.1f}" for v in record.percentiles(seconds, 50, 95))]))
    figures = {label: f.__dict__ for label, f in {**whole, **ways}.items()}
    about = {"split": "test", "seed": "number of the problem in its level", "toppra": metadata.version("toppra")}
    record.write("timing", {"figures": figures}, "\n".join(rows), **about, ruckig=metadata.version("ruckig"))


if __name__ == "__main__":
    run_command(main)
