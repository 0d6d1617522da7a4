"""What the closed loop does when a driver or a sensor fails while the robot moves: how each run ends.

A robot moves to a goal at a fifth of its speed, and from some time on something fails. Each fault is tried with the
exact driver and with that of physics (``apex_ompl.drivers``). The clock is simulated.

Usage: python -m benchmarks.loop.faults
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from apex_ompl import load_problem, run
from apex_ompl.drivers import DriverState, KinematicDriver, MujocoDriver
from apex_ompl.drivers.library import mujoco
from apex_ompl.errors import DriverError
from apex_ompl.loop import Observation, Outcome, RunResult
from apex_ompl.moving.settings import LoopSettings
from apex_ompl.problems.suite_robot import robot
from apex_ompl.scene.bodies import Obstacle, Sphere
from apex_ompl.timing import Trajectory
from apex_ompl.types import Array
from apex_ompl.util.entry_point import run_script
from benchmarks.lib import record

DEPENDS = ("@planning", "apex_ompl/moving", "apex_ompl/loop", "apex_ompl/timing", "apex_ompl/drivers")
PROBLEM, SPEED, SEED = "vertical/free/800001", 0.2, 0
START = 0.6  # time of a fault [s]
SETTINGS = LoopSettings(error=0.01, fastest=0.3, silence=0.4, timeout=6.0)
BALL = Obstacle(name="ball", sphere=Sphere(radius=0.05), position=(1.5, 1.5, 1.0))
NOWHERE = BALL.model_copy(update={"position": (float("nan"),) * 3})
REST = 1e-3  # largest velocity of a joint at rest [rad/s]
JUMP, BACK, DELAY, PUSH, PUSHED = 0.1, 0.3, 0.02, 400.0, 0.02  # [rad], [s], [s], [Nm], [s]
FAULTS = {
    "none": "none", "silent": "the driver has no state any more", "frozen": "its state stays the same",
    "late": "every command takes 20 ms longer than there is", "late once": "one command does",
    "refuses": "the driver refuses motions", "jumps": "a measured joint jumps by 0.1 rad",
    "clock": "the clock steps back by 0.3 s", "pushed": "a joint is pushed by 400 Nm for 20 ms",
    "camera": "the camera stops for 1 s", "nan": "every second observation is NaN",
    "nan only": "all observations are NaN",
}  # fmt: skip
HEAD = ("fault", "driver", "outcome", "reason", "at rest after s", "stayed at rest", "refused", "limit use")


@dataclass(eq=False)
class FaultyDriver:
    """A driver on a simulated clock that fails from a time on.

    Attributes:
        inner: The driver.
        failure: One of ``FAULTS``.
        speeds: Times [s], and true velocities of the fastest joint [rad/s].
    """

    inner: Any
    failure: str
    speeds: list[tuple[float, float]] = field(default_factory=list)
    _last: DriverState | None = None
    _failed: bool = False

    def __post_init__(self) -> None:
        """Take names and limits of the driver."""
        self.names, self.limits = self.inner.names, self.inner.limits

    @property
    def failing(self) -> bool:
        """Whether the fault is there."""
        return bool(self.inner.time >= START - 1e-9)

    @property
    def time(self) -> float:
        """Time on the driver's clock [s]."""
        return float(self.inner.time - (BACK if self.failure == "clock" and self.failing else 0.0))

    @property
    def end(self) -> float:
        """Time from which on rest is commanded [s]."""
        return float(self.inner.end)

    @property
    def fault(self) -> str:
        """Why the driver stopped, in a sentence; else empty."""
        return str(self.inner.fault)

    def state(self) -> DriverState:
        """Return the measured state."""
        found: DriverState = self.inner.state()
        if not self.failing:
            self._last = found
        elif self.failure == "silent":
            raise DriverError("there were no joint states")
        elif self.failure == "frozen":
            assert self._last is not None
            return self._last
        elif self.failure == "jumps":
            return replace(found, positions=found.positions + JUMP * (np.arange(len(self.names)) == 3))
        return replace(found, stamp=self.time)

    def send(self, motion: Trajectory, at: float) -> None:
        """Follow a motion from a time on."""
        if self.failing and (self.failure == "late" or (self.failure == "late once" and not self._failed)):
            self._failed = True
            self.advance(at + DELAY)
        if self.failing and self.failure == "refuses":
            raise DriverError("the controller is not active")
        self.inner.send(motion, at)

    def advance(self, until: float) -> None:
        """Let the clock go on to a time [s]."""
        self.inner.advance(until + (self.inner.time - self.time))
        if self.failure == "pushed" and isinstance(self.inner, MujocoDriver):
            pushed = START <= self.inner.time < START + PUSHED
            self.inner.data.qfrc_applied[self.inner.twin.v[3]] = PUSH if pushed else 0.0
        self.speeds.append((self.inner.time, float(np.abs(self.inner.state().velocities).max())))

    def stop(self) -> None:
        """Come to rest."""
        self.inner.stop()

    def recover(self) -> Array:
        """Take up motions again."""
        found: Array = self.inner.recover()
        return found

    def close(self) -> None:
        """Release the driver."""
        self.inner.close()


@dataclass(eq=False)
class FaultyCamera:
    """A camera that sees a ball that stays far away, 50 times a second, and fails from a time on."""

    failure: str
    count: int = 0

    def read(self, now: float) -> Observation | None:
        """Return what it sees, or None."""
        self.count += 1
        failing = now >= START - 1e-9
        if self.count % 2 or (self.failure == "camera" and failing and now < START + 1.0):
            return None
        bad = failing and (self.failure == "nan only" or (self.failure == "nan" and self.count % 4 == 0))
        return Observation(now, now, (NOWHERE if bad else BALL,))


def driver_of(kind: str, start: Array) -> Any:
    """Return the exact driver or that of physics, at rest in a state."""
    return KinematicDriver(robot(), start) if kind == "exact" else MujocoDriver(robot(), state=start)


def tried(fault: str, kind: str) -> tuple[RunResult, FaultyDriver]:
    """Return a run with a fault, and its driver 0.5 s after the run."""
    problem = load_problem(PROBLEM)
    driver = FaultyDriver(driver_of(kind, problem.start_state(robot().joint_names)), fault)
    found = run(problem, "no-network", speed=SPEED, seed=SEED, settings=SETTINGS, sensor=FaultyCamera(fault),
                driver=driver)  # fmt: skip
    for _ in range(50):
        driver.advance(driver.time + 0.01)
    return found, driver


def rest_after(driver: FaultyDriver) -> tuple[float, bool]:
    """Return how long after its fault a robot was at rest for 20 ms first [s], and whether it stayed there."""
    late = np.array([one for one in driver.speeds if one[0] >= START])
    still = late[:, 1] <= REST
    starts = [k for k in range(len(late)) if still[k : np.searchsorted(late[:, 0], late[k, 0] + 0.02)].all()]
    return float(late[starts[0], 0] - START), bool(still[starts[0] :].all())


def row(fault: str, kind: str) -> list[Any]:
    """Return the row of a fault."""
    found, driver = tried(fault, kind)
    after, stays = rest_after(driver)
    moves = found.outcome is Outcome.REACHED
    return [
        FAULTS[fault], kind, str(found.outcome), found.reason or "-", f"{after:.2f}",
        "goes on" if moves and not stays else ("yes" if stays else "no"), int(found.metrics["refused_looks"]),
        f"{found.metrics['limit_use']:.3f}",
    ]  # fmt: skip


def main() -> None:
    """Try all faults, and write the results."""
    record.parser(__doc__ or "").parse_args()
    cases = [(fault, kind) for fault in FAULTS for kind in ("exact", "physics") if (fault, kind) != ("pushed", "exact")]
    rows = [row(*case) for case in cases]
    lines = [HEAD, ["---"] * len(HEAD), *rows]
    text = "\n".join(record.row(list(line)) for line in lines)
    settings = {"seed": SEED, "start": START, "silence": SETTINGS.silence, "mujoco": mujoco().__version__}
    record.write("faults", {"columns": HEAD, "rows": rows}, text, **settings)


if __name__ == "__main__":
    run_script(main)
