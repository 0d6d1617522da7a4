"""Inverse kinematics of the Panda beside an analytic solver, ssik: free states that reach a pose, and the nearest one.

Targets are poses of the hand's flange at random free states, which are those of ``ik_branches``, and so are the states
of the dense search: one counts as found where a state is within 0.1 rad of it in each joint. ssik solves for samples of
the redundant joint (``solve``), or gives each self-motion as a curve, of which states 0.1 rad apart are taken here. Its
states are checked for collision by the planner's checker, whose time counts as well. For the nearest state, ``solve``
ranks by the distance from home, and the first free one is taken. Times are those of the process.

Usage: python -m benchmarks.planners.ik_analytic [-n 300] [--split test]    (needs the extra "peers")
"""

from __future__ import annotations

import time
from collections.abc import Callable
from importlib.metadata import version
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from ssik import Manipulator
from tqdm import tqdm

from apex_ompl import MotionPlanner, PoseTarget
from apex_ompl.goals.self_motions import SPACING
from apex_ompl.types import Array
from apex_ompl.util.entry_point import run_script
from benchmarks.lib import record
from benchmarks.planners.ik_branches import COUNT, HAND, ROBOT, SEEDS, dense

DEPENDS = ("@planning",)
ARM, FLANGE, BASE = "panda", "panda_link8", "panda_link0"
JOINTS = 7
DENSE, EVEN = 64, 1e-2  # states of each self-motion; how even their spacing is, all are on it anyway [rad]
ROWS = "planner.ik", "ssik, solve", "ssik, self-motions"
HEAD = (
    "states", "free states p50", "found of the dense search's %", "targets without one", "largest error um, urad",
    "CPU ms a target p50", "p95",
)  # fmt: skip
NEAREST = "nearest to home", "targets without one", "distance rad p50", "CPU ms a target p50", "p95"


class Target(NamedTuple):
    """A target.

    Attributes:
        pose: Pose of the flange in the world, shape (4, 4) [m].
        target: The same for the planner.
        inside: The same in the frame of the arm's base.
    """

    pose: Array
    target: PoseTarget
    inside: Array


def target_at(planner: MotionPlanner, q: Array) -> Target:
    """Return the pose of the flange at a state."""
    pose = pin.SE3(planner.fk(q, FLANGE))
    xyzw = tuple(pin.Quaternion(pose.rotation).coeffs().tolist())
    target = PoseTarget(frame=FLANGE, position=tuple(pose.translation.tolist()), orientation=xyzw)
    inside = pin.SE3(planner.fk(q, BASE)).actInv(pose)
    return Target(pose.homogeneous, target, inside.homogeneous)


class Rival:
    """ssik's solver for the arm of a planner, whose other joints stay at home."""

    def __init__(self, planner: MotionPlanner) -> None:
        """Take the solver of the Panda that comes with the package."""
        self.planner, self.arm = planner, Manipulator.from_prebuilt(ARM)
        limits = planner.robot.limits
        self.lower, self.upper = limits.lower[:JOINTS], limits.upper[:JOINTS]

    def whole(self, states: list[Array]) -> Array:
        """Return states of all joints inside the limits, turned by whole turns where that brings them there."""
        arm = np.array(states).reshape(-1, JOINTS)
        arm = arm - 2.0 * np.pi * np.round((arm - (self.lower + self.upper) / 2.0) / (2.0 * np.pi))
        arm = arm[((arm >= self.lower) & (arm <= self.upper)).all(axis=1)]
        return np.column_stack([arm, np.tile(self.planner.robot.home[JOINTS:], (len(arm), 1))])

    def free(self, states: list[Array]) -> Array:
        """Return those that are free as well."""
        found = self.whole(states)
        return found[self.planner.checker.are_free(found)] if len(found) else found

    def solved(self, at: Target) -> Array:
        """Return the free states of ``solve``."""
        return self.free([one.q for one in self.arm.solve(at.inside)])

    def on_curves(self, at: Target) -> Array:
        """Return free states on the self-motions, about SPACING apart or nearer."""
        found = list[Array]()
        for chart in self.arm.self_motion(at.inside).charts:
            found += [states for _, states in chart.sample(DENSE, limits=True, tol=EVEN)]
        return self.free([q for states in found for q in states])

    def nearest(self, at: Target) -> Array | None:
        """Return the first free state of ``solve`` from home on."""
        home = self.planner.robot.home
        ranked = self.whole([one.q for one in self.arm.solve(at.inside, q_seed=home[:JOINTS])])
        return next((q for q in ranked if self.planner.is_free(q)), None)


def timed(call: Callable[[], Any]) -> tuple[Any, float]:
    """Return the result of a call and its processor time [ms]."""
    begin = time.process_time()
    found = call()
    return found, 1e3 * (time.process_time() - begin)


def error(planner: MotionPlanner, states: Array, at: Target) -> float:
    """Return the largest error of poses at states [m, rad]."""
    wanted = pin.SE3(at.pose)
    return max(
        (float(np.abs(pin.log6(wanted.actInv(pin.SE3(planner.fk(q, FLANGE)))).vector).max()) for q in states),
        default=0.0,
    )


def examined(planner: MotionPlanner, rival: Rival, seed: int) -> dict[str, Any]:
    """Return the figures of a target."""
    rng, q, robot = np.random.default_rng(seed), planner.robot.home, planner.robot
    while not planner.is_free(q := robot.random_state(rng)):
        pass
    q[JOINTS:] = robot.home[JOINTS:]
    at = target_at(planner, q)
    calls: dict[str, Callable[[], Array]] = {
        ROWS[0]: lambda: planner.ik(at.target, count=COUNT, seed=seed).states,
        ROWS[1]: lambda: rival.solved(at), ROWS[2]: lambda: rival.on_curves(at),
    }  # fmt: skip
    others = np.array(dense(planner, pin.SE3(planner.fk(q, HAND)), rng)).reshape(-1, robot.dof)
    made: dict[str, Any] = {"seed": seed, "dense": len(others)}
    for row, call in calls.items():
        states, spent = timed(call)
        away = np.abs(others[:, None, :JOINTS] - states[None, :, :JOINTS]).max(axis=2)
        near = int((away.min(axis=1, initial=np.inf) < SPACING).sum())
        made[row] = {"ms": spent, "free": len(states), "near": near, "error": error(planner, states, at)}
    found, spent = timed(lambda: planner.ik(at.target, near="home", count=1, seed=seed))
    ours = found[0].state if found else None
    theirs, other = timed(lambda: rival.nearest(at))
    for row, state, ms in ((ROWS[0], ours, spent), (ROWS[1], theirs, other)):
        away = None if state is None else float(np.abs(state - robot.home)[:JOINTS].max())
        made[row]["nearest"] = {"ms": ms, "away": away}
    return made


def tables(runs: list[dict[str, Any]]) -> str:
    """Return the tables."""
    lines, total = [HEAD, ("---", *["---:"] * (len(HEAD) - 1))], sum(run["dense"] for run in runs)
    for row in ROWS:
        mine, near = [run[row] for run in runs], sum(run[row]["near"] for run in runs)
        spent = record.percentiles([one["ms"] for one in mine], 50, 95)
        lines.append((
            row, f"{np.median([one['free'] for one in mine]):.0f}", f"{100.0 * near / total:.1f}",
            sum(not one["free"] for one in mine), f"{1e6 * max(one['error'] for one in mine):.2g}",
            *(f"{value:.1f}" for value in spent),
        ))  # fmt: skip
    nearest = [NEAREST, ("---", *["---:"] * (len(NEAREST) - 1))]
    both = [run for run in runs if all(run[row]["nearest"]["away"] is not None for row in ROWS[:2])]
    for row in ROWS[:2]:
        spent = record.percentiles([run[row]["nearest"]["ms"] for run in runs], 50, 95)
        nearest.append((
            row, sum(run[row]["nearest"]["away"] is None for run in runs),
            f"{np.median([run[row]['nearest']['away'] for run in both]):.2f}", *(f"{value:.2f}" for value in spent),
        ))  # fmt: skip
    return "\n\n".join("\n".join(record.row(list(line)) for line in table) for table in (lines, nearest))


def main() -> None:
    """Examine targets, and write the results."""
    parser = record.parser(__doc__ or "", n=300, of="targets")
    parser.add_argument("--split", default="test", choices=SEEDS)
    given = parser.parse_args()
    with MotionPlanner(ROBOT) as planner:
        rival = Rival(planner)
        examined(planner, rival, 0)  # loads the code
        seeds = range(SEEDS[given.split], SEEDS[given.split] + given.n)
        runs = [examined(planner, rival, seed) for seed in tqdm(seeds)]
    dense_states = sum(run["dense"] for run in runs)
    record.write(
        "ik_analytic", {"runs": runs}, tables(runs), split=given.split, n=given.n, dense_states=dense_states,
        ssik=version("ssik"),
    )  # fmt: skip


if __name__ == "__main__":
    run_script(main)
