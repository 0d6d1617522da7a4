"""The command ``apex-ompl ros2`` as a process: killed, interrupted, on simulated time, and with faulty arguments."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import benchmark_script

from apex_ompl.cli import main
from apex_ompl.robot import Robot
from apex_ompl.types import Array

pytest.importorskip("rclpy")

from rosgraph_msgs.msg import Clock  # noqa: E402 - without rclpy there are no messages
from sensor_msgs.msg import JointState  # noqa: E402
from visualization_msgs.msg import MarkerArray  # noqa: E402

client_of, stand_ins_of = benchmark_script("physics.ros2_client"), benchmark_script("physics.stand_ins")


@pytest.fixture
def stand_ins(robot: Robot, tmp_path: Path) -> Iterator[Any]:
    found = stand_ins_of.StandIns(robot, tmp_path)
    yield found
    found.close()


@contextmanager
def node_of(stand_ins: Any, *arguments: str) -> Iterator[tuple[subprocess.Popen[bytes], Any]]:
    """The command as a process, and a client that it answers."""
    command = [sys.executable, "-m", "apex_ompl.cli", "ros2", "--ros-args", *stand_ins.parameters(), *arguments]
    process = subprocess.Popen(command)
    client = client_of.Client(("goal/joints", "obstacles"))
    try:
        client.matched()
        yield process, client
    finally:
        client.close()
        process.kill()
        process.wait()
        print(client.outcomes, file=sys.stderr)


def swing(robot: Robot, client: Any, by: float) -> Array:
    """Send the first joint of the left arm elsewhere, and return the goal."""
    goal = robot.home.copy()
    goal[0] += by
    names = [stand_ins_of.PREFIX + name for name in robot.joint_names]
    client.publishers["goal/joints"].publish(JointState(name=names, position=goal.tolist()))
    return goal


def first_joint(stand_ins: Any) -> Array:
    """Times [s] and positions of the first joint so far, shape (2, N)."""
    times, states = stand_ins.followed()
    known = ~np.isnan(states[:, 0])
    return np.stack([1e-9 * times[known], states[known, 0]])


def moving(robot: Robot, stand_ins: Any) -> bool:
    return bool(abs(first_joint(stand_ins)[1, -1] - robot.home[0]) > 0.05)


def at_rest(stand_ins: Any) -> float:
    """Wait until the robot has been at rest for half a second, and return the position of the first joint."""
    end = time.monotonic() + 15.0
    while True:
        times, found = first_joint(stand_ins)
        late = found[times > times[-1] - 0.5]
        if len(late) > 5 and np.ptp(late) == 0.0:
            return float(late[-1])
        assert time.monotonic() < end, "it does not come to rest"
        time.sleep(0.1)


@pytest.mark.parametrize("closed_loop", ["never", "always"])
def test_a_node_that_is_killed_leaves_the_robot_at_rest(robot: Robot, stand_ins: Any, closed_loop: str) -> None:
    with node_of(stand_ins, "-p", f"closed_loop:={closed_loop}", "-p", "speed:=0.3") as (process, client):
        over = threading.Event()

        def look() -> None:
            while not over.wait(0.03):
                client.publishers["obstacles"].publish(MarkerArray())

        camera = threading.Thread(target=look)
        camera.start()
        goal = swing(robot, client, 1.0)
        client.wait(lambda: moving(robot, stand_ins))
        process.send_signal(signal.SIGKILL)
        assert process.wait(10.0) == -signal.SIGKILL
        over.set()
        camera.join()
        rest = at_rest(stand_ins)
    times, found = first_joint(stand_ins)
    assert robot.home[0] < rest <= goal[0] + 1e-6
    assert closed_loop == "always" or abs(rest - goal[0]) <= 1e-6  # a plan is followed to its end
    gaps = np.diff(times) > 1e-4
    speeds = np.diff(found)[gaps] / np.diff(times)[gaps]
    assert speeds.max() <= 0.3 * robot.limits.velocity[0] * 1.05


def test_an_interrupted_node_stops_the_robot_and_ends_well(
    robot: Robot, stand_ins: Any, capfd: pytest.CaptureFixture[str]
) -> None:
    with node_of(stand_ins, "-p", "speed:=0.3") as (process, client):
        goal = swing(robot, client, 1.0)
        client.wait(lambda: moving(robot, stand_ins))
        process.send_signal(signal.SIGINT)
        assert process.wait(20.0) == 0
        assert client.wait(lambda: client.outcomes) == ["interrupted: the node ends"]
        assert robot.home[0] + 0.05 < at_rest(stand_ins) < goal[0] - 0.05
    assert "Traceback" not in capfd.readouterr().err


def test_simulated_time_counts_where_it_is_asked_for(robot: Robot, tmp_path: Path) -> None:
    """At half the speed of the wall clock, a motion takes twice its duration."""
    simulated = ["-p", "use_sim_time:=true"]
    stand_ins, over = stand_ins_of.StandIns(robot, tmp_path, simulated), threading.Event()
    with client_of.Client(topics=()).running() as clock:
        publisher = clock.node.create_publisher(Clock, "/clock", 10)

        def tick() -> None:
            began = time.monotonic()
            while not over.wait(0.005):
                message = Clock()
                ticks = int(5e8 * (time.monotonic() - began)) + 10**9
                message.clock.sec, message.clock.nanosec = divmod(ticks, 10**9)
                publisher.publish(message)

        thread = threading.Thread(target=tick)
        thread.start()
        try:
            with node_of(stand_ins, *simulated, "-p", "speed:=0.5", "-p", "lead:=0.2") as (_, client):
                client.trajectories_of(["left"])
                began = time.monotonic()
                goal = swing(robot, client, 0.5)
                assert client.wait(lambda: client.outcomes) == ["reached"]
                took = time.monotonic() - began
                time.sleep(0.3)
                times, found = first_joint(stand_ins)
                assert abs(found[-1] - goal[0]) <= 1e-6
                assert times[-1] < 100.0  # by the simulated clock
                (message,) = [one for _, _, one in client.trajectories]
                last = message.points[-1].time_from_start
                assert took > 2.0 * (last.sec + 1e-9 * last.nanosec)
        finally:
            over.set()
            thread.join()
            stand_ins.close()


def stderr_of(capfd: pytest.CaptureFixture[str], arguments: Sequence[str]) -> tuple[int, str]:
    code = main(arguments)
    return code, capfd.readouterr().err


def test_faulty_arguments_are_one_sentence(capfd: pytest.CaptureFixture[str]) -> None:
    for arguments, why in (
        (["ros2", "nobody"], "nobody"),
        (["ros2", "missing.yaml"], "missing.yaml"),
        (["ros2", "ball_in_cup", "--ros-args", "-p", "speed:=7.0"], "parameter speed"),
        (["ros2", "--ros-args", "-p", "goal_frames:=[nose]"], "nose"),
        (["ros2", "--ros-args", "--params-file", "missing.yaml"], "missing.yaml"),
    ):
        code, said = stderr_of(capfd, arguments)
        assert code == 2 and why in said
        *others, last = said.splitlines()
        assert last.startswith("apex-ompl: error: "), said
        assert all("[rcl]" in one for one in others)  # which has a line of its own where it does not parse
