"""Runs whose robot is a driver's, with sensors of one's own: what they end with, and what fails around them."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from loops import PROBLEM, ByHand, crossing, line, setup_of, world_of
from support import benchmark_script

from apex_ompl import LoopSettings, Obstacle, problems, run
from apex_ompl.api import load_environment
from apex_ompl.drivers import DriverState, KinematicDriver
from apex_ompl.errors import ApexError, ParameterError
from apex_ompl.loop import Observation
from apex_ompl.loop.driven import DrivenRun, LiveStream
from apex_ompl.loop.referee import judge
from apex_ompl.loop.result import Outcome
from apex_ompl.problems.suite_robot import robot
from apex_ompl.problems.worlds import environment_of
from apex_ompl.timing import Trajectory

faults: Any = benchmark_script("loop.faults")
SETTINGS = LoopSettings(error=0.024, fastest=0.4, timeout=3.0)
BALL = Obstacle(name="ball", sphere={"radius": 0.05}, position=(1.5, 1.5, 1.0))


class Camera:
    """Sees a ball that stays where it is, on whatever clock it is asked."""

    def __init__(self) -> None:
        self.asked: list[float] = []

    def read(self, now: float) -> Observation | None:
        self.asked.append(now)
        return Observation(now, now, (BALL,))


def exact(start: float = 0.0) -> KinematicDriver:
    driver = KinematicDriver(robot(), problems.load(PROBLEM).start_state(robot().joint_names))
    driver.advance(start)
    return driver


@pytest.mark.parametrize("zero", [0.0, 7.5])
def test_a_run_on_a_driver_goes_where_the_driver_went(zero: float) -> None:
    driver, camera = exact(zero), Camera()
    found = run(problems.load(PROBLEM), ByHand(line), settings=SETTINGS, sensor=camera, driver=driver)
    assert found.outcome is Outcome.REACHED and camera.asked[0] == zero
    assert found.metrics["tracking_error"] < 1e-9 and found.metrics["late_commands"] == 0.0
    assert np.abs(driver.state().positions - found.trajectory.positions[-1]).max() < 1e-9
    assert not driver.state().velocities.any()
    assert driver.time - zero == pytest.approx(found.trajectory.duration)
    assert found.settings["driver"] == "KinematicDriver" and found.settings["sensor"] == {"name": "Camera"}
    assert found.metrics["limit_use"] <= 1.0 + 1e-9


def test_the_same_seed_gives_the_same_run_on_a_driver() -> None:
    runs = []
    for _ in range(2):
        world = world_of(PROBLEM, crossing(setup_of(PROBLEM)))
        runs.append(run(world, "no-network", settings=replace(SETTINGS, timeout=2.0), driver="kinematic"))
    assert np.array_equal(runs[0].trajectory.positions, runs[1].trajectory.positions)
    assert runs[0].as_dict() == runs[1].as_dict()


def test_a_driver_on_the_wall_clock_is_followed() -> None:
    driver = KinematicDriver(robot(), exact().state().positions, clock=time.monotonic)
    limits = replace(SETTINGS, timeout=5.0, silence=60.0)
    found = run(problems.load(PROBLEM), "no-network", clock="real", settings=limits, sensor=Camera(), driver=driver)
    assert found.outcome in (Outcome.REACHED, Outcome.TIMEOUT) and found.clock == "real"
    assert np.abs(driver.state().velocities).max() == 0.0
    assert np.abs(driver.state().positions - found.trajectory.positions[-1]).max() < 1e-9


class Lagging(KinematicDriver):
    """Is where the commands had it some time ago."""

    lag = 0.4  # [s]

    def state(self) -> DriverState:
        now = super().state()
        self.past = [*getattr(self, "past", []), (time.monotonic(), now.positions)]
        old = [positions for at, positions in self.past if at <= time.monotonic() - self.lag]
        return replace(now, positions=old[-1] if old else self.past[0][1])


def test_a_robot_that_lags_behind_its_commands_is_judged_where_it_comes_to_rest() -> None:
    driver = Lagging(robot(), exact().state().positions, clock=time.monotonic)
    limits = replace(SETTINGS, timeout=10.0)
    found = run(
        problems.load(PROBLEM), ByHand(line), clock="real", settings=limits, sensor=Camera(), driver=driver,
        tolerance=3.0,
    )  # fmt: skip
    assert found.outcome is Outcome.REACHED and found.metrics["tracking_error"] > 0.1


def test_the_motion_that_was_measured_is_judged() -> None:
    """A robot that is off by some millimeters of an obstacle beside its way touches it, though its command does not."""
    setup, problem = setup_of(PROBLEM), problems.load(PROBLEM).still
    q, still = np.repeat(setup.start[None], 3, axis=0), np.zeros((3, len(setup.start)))
    rest = Trajectory(np.array([0.0, 0.5, 1.0]), q, still, still, robot().joint_names)
    off = np.where(np.arange(len(setup.start)) == 0, 0.02, 0.0)
    moved = Trajectory(rest.times, q + off, still, still, rest.joint_names)
    link = robot().link_pose(setup.start, "left_hand_palm")[:3, 3]
    way = robot().link_pose(setup.start + off, "left_hand_palm")[:3, 3] - link
    places = [tuple((link + s * way / np.linalg.norm(way)).tolist()) for s in np.arange(0.03, 0.3, 0.001)]
    for place in places:
        ball = Obstacle(name="ball", sphere={"radius": 0.01}, position=place, velocity=(0.0, 0.0, 1e-9))
        truth = problem.model_copy(update={"scene": (*problem.scene, ball)})
        if judge(robot(), truth, rest).contact is None:
            break
    report = judge(robot(), truth, moved, commanded=rest)
    assert report.contact is not None and report.contact.second == "ball" and not report.contact.moved
    assert report.at_goal is judge(robot(), truth, rest).at_goal
    assert not judge(robot(), truth, moved, commanded=rest, goals=setup.start[None] + 1.0).at_goal
    far = Trajectory(rest.times, q + 3.0 * off, still, still, rest.joint_names)
    assert judge(robot(), truth, rest, goals=setup.start).at_goal
    assert not judge(robot(), truth, far, commanded=rest, goals=setup.start).at_goal


def test_a_start_that_is_off_is_refused() -> None:
    start = exact().state().positions + 0.1 * (np.arange(robot().dof) == 2)
    driver = KinematicDriver(robot(), start)
    found = run(problems.load(PROBLEM), ByHand(line), settings=SETTINGS, sensor=Camera(), driver=driver)
    assert found.outcome is Outcome.ABORTED and "left_joint3 is 0.1 rad from where it should be" in found.reason
    assert np.array_equal(driver.state().positions, start)


ENDS = {
    "none": (Outcome.REACHED, "", 4.0), "silent": (Outcome.ABORTED, "no state of the robot was usable for 0.4 s", 0.6),
    "frozen": (Outcome.ABORTED, "no state of the robot was usable for 0.4 s", 0.6),
    "late": (Outcome.ABORTED, "the last 41 commands did not reach the driver in time", 0.2),
    "late once": (Outcome.REACHED, "", 0.2),
    "refuses": (Outcome.ABORTED, "the driver refused a motion, DriverError: the controller is not active", 0.2),
    "jumps": (Outcome.ABORTED, "left_joint4 is 0.1 rad from where it should be", 0.2),
    "clock": (Outcome.ABORTED, "the clock went back by 0.29 s", 0.2), "camera": (Outcome.REACHED, "", 0.6),
    "nan": (Outcome.REACHED, "", 5.0), "nan only": (Outcome.TIMEOUT, "no observation was usable in the end", 0.6),
}  # fmt: skip


def check_end(fault: str, kind: str) -> Any:
    """The run ends as it should, at rest in time, within the limits."""
    outcome, reason, soon = ENDS[fault]
    found, driver = faults.tried(fault, kind)
    assert found.outcome is outcome and reason in found.reason
    after, stays = faults.rest_after(driver)
    assert after <= soon and (stays or fault in ("late once", "camera"))
    assert driver.speeds[-1][1] <= faults.REST
    assert found.metrics["limit_use"] <= 1.0 + 1e-9 and found.metrics["unguarded_steps"] == 0.0
    return found


@pytest.mark.parametrize("fault", ENDS)
def test_faults_end_at_rest_with_a_reason(fault: str) -> None:
    found = check_end(fault, "exact")
    assert (found.metrics["refused_looks"] > 0.0) == (fault in ("nan", "nan only"))
    assert (found.metrics["late_commands"] > 0.0) == (fault in ("late", "late once", "refuses"))


@pytest.mark.parametrize("fault", ["none", "jumps"])
def test_faults_end_at_rest_with_a_reason_in_physics(fault: str) -> None:
    pytest.importorskip("mujoco")
    assert 0.0 < check_end(fault, "physics").metrics["tracking_error"] < 0.2


def test_a_push_stops_a_robot_in_physics() -> None:
    pytest.importorskip("mujoco")
    found, driver = faults.tried("pushed", "physics")
    assert found.outcome is Outcome.ABORTED and "left_joint4" in found.reason  # the loop or the guard tells first
    assert faults.rest_after(driver)[1] and driver.speeds[-1][1] <= faults.REST


def test_a_measured_motion_is_within_the_range_of_joints() -> None:
    """Between sparse states of a hand that opens, a spline leaves the range; a fixed one is off by rounding."""
    limits, dof = robot().limits, robot().dof
    start = exact().state().positions
    found = DrivenRun.__new__(DrivenRun)
    found.driver, found.times = exact(), [0.0, 0.1, 0.2, 0.3, 0.4]
    found.positions = [start.copy() for _ in found.times]
    hands = robot().groups["hands"]
    for k, q in enumerate(found.positions):
        q[0] += 0.01 * k**2
        q[hands[0]], q[hands[1]] = limits.lower[hands[0]] + (0.5 if k < 2 else 0.0), limits.lower[hands[1]] - 1e-9
    motion = found.executed()
    assert motion is not None
    rows = motion(np.linspace(0.0, motion.duration, 1000))
    assert (rows >= limits.lower - 1e-12).all() and (rows <= limits.upper + 1e-12).all()
    kept = np.setdiff1d(np.arange(dof), hands)
    assert np.abs(motion.positions - np.stack(found.positions))[:, kept].max() < 1e-12
    assert np.abs(motion.positions - np.stack(found.positions))[:, hands[0]].max() < 0.2
    spread = np.diff(motion(np.linspace(0.1, 0.3, 2001))[:, hands[0]]) / 1e-4
    speeds = motion(np.linspace(0.1, 0.3, 2001), 1)[:, hands[0]]
    assert np.abs(spread - 0.5 * (speeds[1:] + speeds[:-1])).max() < 1e-4


def test_a_driver_that_needs_time_for_messages_is_late_and_does_not_refuse() -> None:
    class Slow(KinematicDriver):
        def send(self, motion: Trajectory, at: float) -> None:
            if 0.3 < at < 0.35:
                raise ParameterError("at", at, "a time that is not over, with that for the message")
            super().send(motion, at)

    driver = Slow(robot(), exact().state().positions)
    found = run(problems.load(PROBLEM), "no-network", speed=0.5, settings=SETTINGS, sensor=Camera(), driver=driver)
    assert found.outcome is Outcome.REACHED and found.metrics["late_commands"] > 0.0


def test_worlds_whose_obstacles_move_are_told_from_problems_that_stand() -> None:
    """Tasks are executed in physics only among obstacles that stand (``apex-ompl run --driver mujoco``)."""
    moving = "turning/vertical/small/900000", "popup/vertical/small/900000", "vertical/moving-small-0.1/900000"
    assert [load_environment(name).still for name in (*moving, PROBLEM)] == [False, False, False, True]


def test_observations_of_a_live_sensor_are_of_its_own_clock() -> None:
    (found,) = LiveStream(Camera(), 100.0).observations(0.5)
    assert (found.stamp, found.received) == (0.5, 0.5)


def test_a_driver_that_stops_by_itself_ends_the_run_with_its_reason() -> None:
    class Pushed(KinematicDriver):
        def advance(self, until: float) -> None:
            super().advance(until)
            if until > 0.5 and not self.fault:
                self.push(np.where(np.arange(len(self.names)) == 3, 0.1, 0.0))

    driver = Pushed(robot(), exact().state().positions)
    found = run(problems.load(PROBLEM), ByHand(line), speed=0.3, settings=SETTINGS, sensor=Camera(), driver=driver)
    assert found.outcome is Outcome.ABORTED and found.reason.endswith(driver.fault)
    assert "left_joint4 was 0.1 off its commanded position" in driver.fault
    assert driver.end <= driver.time and not driver.state().velocities.any()


def test_a_robot_at_rest_is_left_alone() -> None:
    class Counted(KinematicDriver):
        sent = 0

        def send(self, motion: Trajectory, at: float) -> None:
            self.sent += 1
            super().send(motion, at)

    near = BALL.model_copy(
        update={"position": tuple(robot().link_pose(exact().state().positions, "left_hand_palm")[:3, 3] + 0.15)}
    )

    class Blocked(Camera):
        def read(self, now: float) -> Observation | None:
            return Observation(now, now, (near,))

    driver = Counted(robot(), exact().state().positions)
    settings = replace(SETTINGS, error=0.3, timeout=0.5)
    found = run(problems.load(PROBLEM), ByHand(line), settings=settings, sensor=Blocked(), driver=driver)
    assert found.outcome is Outcome.TIMEOUT and driver.sent == 0 and found.metrics["late_commands"] == 0.0


@pytest.mark.parametrize(
    ("given", "words"),
    [({"driver": "mujco"}, "driver 'mujco', did you mean 'mujoco'"), ({"driver": 5}, "driver: expected a driver with"),
     ({"driver": "mujoco", "clock": "real"}, "driver: expected the simulated clock"),
     ({"sensor": 5}, "sensor: expected a Sensor, an object with read"),
     ({"sensor": Camera(), "settings": LoopSettings(error=0.01)}, "settings: expected both, .* 'no fastest"),
     ({"tolerance": -1.0}, "tolerance"), ({"driver": "kinematic", "tolerance": float("nan")}, "tolerance")],
)  # fmt: skip
def test_what_is_asked_for_wrongly_is_named(given: dict[str, Any], words: str) -> None:
    world = environment_of(problems.load(PROBLEM))
    with pytest.raises(ApexError, match=words):
        run(world, **{"method": ByHand(line), "settings": SETTINGS, **given})


def test_a_sensor_that_returns_nonsense_stops_the_robot() -> None:
    class Bad:
        def read(self, now: float) -> Any:
            return 5 if now > 0.5 else Observation(now, now, (BALL,))

    found = run(problems.load(PROBLEM), ByHand(line), speed=0.3, settings=SETTINGS, sensor=Bad(), driver=exact())
    assert found.outcome is Outcome.ABORTED and "the sensor failed, ParameterError: sensor" in found.reason
