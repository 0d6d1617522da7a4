"""Planned motions followed in physics: tracking error, torques against their limits, contacts, real-time factor.

The motions are those that apex plans for the ready-made problems, and for a validation problem of some levels. Each is
planned with and without limits of torque in its timing, with nothing or 2 kg in each hand beside the held objects, and
followed by MuJoCo (``apex_ompl.drivers``). Held objects without a mass have 300 kg/m^3. The limits are 87 and 12 Nm at
the links. A motion is clipped where a motor reaches its limit. In the last row the controller does not know the 2 kg.

Usage: python -m benchmarks.physics.tracking [PROBLEM ...] [--payload 2]
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from tqdm import tqdm

from apex_ompl import plan, problems
from apex_ompl.drivers import Guard, MujocoDriver
from apex_ompl.drivers.library import mujoco
from apex_ompl.drivers.twin_settings import with_mass
from apex_ompl.problems.suite_robot import robot
from apex_ompl.scene.problem import Problem
from apex_ompl.timing import Timing, Trajectory
from apex_ompl.util.entry_point import run_script
from benchmarks.lib import record

DEPENDS = ("@planning", "apex_ompl/timing", "apex_ompl/drivers")
LEVELS = (
    "shelf/hard", "bins/hard", "cage/hard", "posts/hard", "wall/hard", "swap/hard", "clutter/hard", "vertical/large",
    "horizontal/large", "shelf/extreme",
)  # fmt: skip
SEED, TIMEOUT = 800003, 30.0
DENSITY = 300.0  # of held objects without a mass [kg/m^3]
AFTER = 0.3  # that is simulated after the end of a motion [s]
ARMS = slice(0, 14)


@dataclass(frozen=True)
class Case:
    """How motions are timed and followed: with limits of torque, payload in each hand [kg], known to the controller."""

    limited: bool
    payload: float
    known: bool = True

    def loaded(self, problem: Problem) -> Problem:
        """Return a problem with the payload, and with a mass of each held object."""
        payload = dict.fromkeys(robot().hands, self.payload) if self.payload else {}
        attached = tuple(with_mass(held, DENSITY) for held in problem.attached)
        return problem.model_copy(update={"payload": payload, "attached": attached})


@dataclass
class Figures:
    """Figures of the motions of a case; errors in mrad, torques as shares of the limits, of the arms."""

    names: list[str] = field(default_factory=list)
    durations: list[float] = field(default_factory=list)
    errors: list[list[float]] = field(default_factory=list)
    ends: list[float] = field(default_factory=list)
    uses: list[list[float]] = field(default_factory=list)
    clipped: list[float] = field(default_factory=list)
    contacts: dict[str, list[str]] = field(default_factory=dict)
    factors: list[float] = field(default_factory=list)
    unplanned: list[str] = field(default_factory=list)

    def cells(self) -> list[Any]:
        """Return the cells of a row."""
        errors, uses, count = np.array(self.errors), np.array(self.uses), len(self.names)
        return [
            count, f"{np.median(self.durations):.2f}", f"{np.median(errors[:, 0]):.3f}", f"{errors[:, 1].max():.3f}",
            f"{errors[:, 2].max():.2f}", f"{(errors[:, 1] <= 1.0).sum()}/{count}", f"{max(self.ends):.3f}",
            f"{np.median(uses[:, 1]):.2f}", f"{uses[:, 1].max():.2f}", f"{np.count_nonzero(self.clipped)}/{count}",
            f"{len(self.contacts)}/{count}", f"{np.median(self.factors):.1f}",
        ]  # fmt: skip


HEAD = (
    "torque limits", "payload kg", "N", "duration s p50", "error mrad p50", "largest p95", "most", "p95 <= 1",
    "at the end", "torque p50", "most", "clipped", "with contacts", "real-time factor",
)  # fmt: skip


def follow(figures: Figures, case: Case, problem: Problem, motion: Trajectory) -> None:
    """Follow a motion and add its figures."""
    assumed = None if case.known else Case(case.limited, 0.0).loaded(problem)
    driver = MujocoDriver(robot(), case.loaded(problem), assumed=assumed, guard=Guard(tracking=None))
    if not case.known:
        driver.advance(1.0)  # the arms come to rest under the load
    driver.forget()
    begin = driver.time
    driver.send(motion, begin)
    started = time.process_time()
    driver.advance(begin + motion.duration + AFTER)
    figures.factors.append((motion.duration + AFTER) / (time.process_time() - started))
    happened = driver.execution
    moving = happened.times <= begin + motion.duration
    error, use = 1e3 * happened.tracking_error[:, ARMS], happened.torque_use[moving, ARMS]
    figures.names.append(problem.name)
    figures.durations.append(motion.duration)
    figures.errors.append(record.percentiles(error[moving], 50, 95, 100))
    figures.ends.append(float(error[-1].max()))
    figures.uses.append(record.percentiles(use, 95, 100))
    figures.clipped.append(float(happened.clipped[moving].any(axis=1).mean()))
    if driver.contacts:
        figures.contacts[problem.name] = [f"{a}, {b}" for a, b in driver.contacts]


def main() -> None:
    """Measure, and write the results."""
    parser = record.parser(__doc__ or "")
    parser.add_argument("problems", nargs="*", default=[*problems.names(), *(f"{level}/{SEED}" for level in LEVELS)])
    parser.add_argument("--payload", type=float, default=2.0, help="in each hand [kg] (default: %(default)s)")
    given = parser.parse_args()
    heavy = given.payload
    cases = [Case(False, 0.0), Case(True, 0.0), Case(False, heavy), Case(True, heavy), Case(True, heavy, known=False)]
    figures = {case: Figures() for case in cases}
    for name in tqdm(given.problems):
        problem = problems.load(name)
        for case in cases:
            timing = Timing(torque_limits=case.limited)
            motion = plan(case.loaded(problem), timeout=TIMEOUT, seed=1, timing=timing).trajectory
            if motion is None:
                figures[case].unplanned.append(problem.name)
            else:
                follow(figures[case], case, problem, motion)
    lines = [record.row(list(HEAD)), record.row(["---"] * len(HEAD))]
    for case, found in figures.items():
        load = f"{case.payload:g}{'' if case.known else ', unknown'}"
        lines.append(record.row(["yes" if case.limited else "no", load, *found.cells()]))
    lines += [""] + [
        f"Not planned with{'' if case.limited else 'out'} limits of torque and {case.payload:g} kg: "
        + ", ".join(found.unplanned)
        for case, found in figures.items()
        if found.unplanned and case.known
    ]
    data = {"cases": [{**vars(case), **vars(found)} for case, found in figures.items()]}
    settings = {"n": len(given.problems), "seed": SEED, "mujoco": mujoco().__version__}
    record.write("physics_tracking", data, "\n".join(lines).rstrip(), **settings)


if __name__ == "__main__":
    run_script(main)
