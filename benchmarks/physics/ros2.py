"""Motions over ROS 2: sent through its middleware to two controllers, which are handed over in the middle of motions.

Motions between random free states are sent to stand-ins for ROS 2's joint trajectory controller, in processes of their
own, which follow its documented rules. In the middle of each motion another one takes its place: the stop from there.
Each sample of the stand-ins, 200 a second, is compared with the motion that was commanded then. Messages stay on this
machine.

Then the node ``apex-ompl ros2`` gets clouds of 2 000 to 100 000 points, each on a block in front of the robot, and a
goal of joints as soon as the cloud has come through the middleware. Counted is the time from the publication of the
cloud to the first trajectory at a controller: two messages, the cloud in the world, a plan, its proof, its timing. Only
answers count whose plan was made with that cloud, as the node's markers show.

Usage: python -m benchmarks.physics.ros2 [-n 200] [--clouds 40]    (needs the extra "ros2")
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from sensor_msgs.msg import JointState
from tqdm import tqdm

from apex_ompl.collision import CollisionChecker
from apex_ompl.problems.suite_robot import robot
from apex_ompl.timing import Trajectory, time_path
from apex_ompl.types import Array
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import one_or_more
from benchmarks.lib import record
from benchmarks.physics.ros2_client import Client, cloud_of
from benchmarks.physics.stand_ins import PREFIX, StandIns, differences

DEPENDS = (
    "@planning", "apex_ompl/drivers", "apex_ompl/ros2", "apex_ompl/timing", "benchmarks/physics/ros2_client.py",
    "benchmarks/physics/stand_ins.py", "benchmarks/physics/stand_in_controller.py",
)  # fmt: skip
LEAD = 0.05  # between a message and the start of its motion [s]
SPREAD = 0.2  # of the states around home [rad]
POINTS = (2_000, 20_000, 100_000)
NEAR = 0.02  # distance of a drawn cloud from the one that was sent [m]
LARGEST = 1e-6  # difference that counts as none [rad]


def free_states(count: int) -> list[Array]:
    """Return random states around home, joined by free straight lines, from home on."""
    checker, rng, limits = CollisionChecker(robot()), np.random.default_rng(0), robot().limits
    found = [robot().home]
    while len(found) <= count:
        q = np.clip(robot().home + rng.normal(0.0, SPREAD, robot().dof), limits.lower, limits.upper)
        if all(checker.is_free(found[-1] + share * (q - found[-1])) for share in np.linspace(0.0, 1.0, 30)):
            found.append(q)
    return found


def follow(count: int) -> dict[str, float]:
    """Send motions and handovers, and return how they were followed."""
    commanded, delays = list[tuple[float, Trajectory]](), list[float]()
    limits, names = robot().limits, robot().joint_names
    states = free_states(count)
    with tempfile.TemporaryDirectory() as folder:
        stand_ins = StandIns(robot(), Path(folder))
        driver = stand_ins.driver()
        q = states[0]
        for state in tqdm(states[1:], unit="motion"):
            motion = time_path(np.stack([q, state]), limits, names).trajectory
            half, start = 0.5 * motion.duration, driver.time + LEAD
            rest = motion.after(half).stop_at(0.0, limits)
            for at, one in ((start, motion), (start + half, rest)):
                time.sleep(max(0.0, at - LEAD - driver.time))
                began = driver.time
                driver.send(one, at)
                delays.append(driver.time - began)
                commanded.append((at, one))
            time.sleep(max(0.0, driver.end + 0.02 - driver.time))
            q = rest.positions[-1]
        time.sleep(0.3)
        off, moving = differences(stand_ins, driver, commanded)
        driver.close()
        stand_ins.close()
    return {
        "samples": len(off), "of them in motion": moving, "largest difference [urad]": 1e6 * float(off.max()),
        "over 1 urad": int((off > LARGEST).sum()), "send p50 [ms]": 1e3 * float(np.percentile(delays, 50)),
        "send p95 [ms]": 1e3 * float(np.percentile(delays, 95)),
    }  # fmt: skip


def block(count: int, rng: np.random.Generator) -> Array:
    """Return points on the surface of a block that stands in front of the robot, shape (count, 3) [m]."""
    points = rng.uniform(-0.5, 0.5, (count, 3))
    side = rng.integers(0, 3, count)
    points[np.arange(count), side] = np.sign(points[np.arange(count), side]) * 0.5
    return np.array([0.75, rng.uniform(-0.2, 0.2), 0.1]) + points * (0.1, 0.3, 0.2)


def answer(client: Any, points: Array, goal: Array) -> float | None:
    """Return the time from a cloud, with a goal after it, to the first trajectory [s].

    None where the goal was faster than the cloud.
    """
    joints = JointState(name=[PREFIX + name for name in robot().joint_names], position=goal.tolist())
    cloud, ended = cloud_of(points), len(client.outcomes)
    client.trajectories.clear()
    received = client.clouds
    began = time.monotonic()
    client.publishers["points"].publish(cloud)
    client.wait(lambda: client.clouds > received)
    client.publishers["goal/joints"].publish(joints)
    client.wait(lambda: client.outcomes[ended:])
    if client.outcomes[-1] != "reached":
        sys.exit(f"a goal was not reached: {client.outcomes[-1]}")
    time.sleep(0.2)  # so that markers have come
    seen = [point.y for marker in client.markers if marker.ns == "points" for point in marker.points]
    center = 0.5 * (points[:, 1].min() + points[:, 1].max())
    if not seen or abs(0.5 * (min(seen) + max(seen)) - center) > NEAR:
        return None
    return float(client.trajectories[0][0] - began)


def answers(count: int) -> dict[str, dict[str, float]]:
    """Return percentiles of the times of answers by the number of points [ms]."""
    found, rng = dict[str, dict[str, float]](), np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as folder:
        stand_ins = StandIns(robot(), Path(folder))
        command = [sys.executable, "-m", "apex_ompl.cli", "ros2", "--ros-args", *stand_ins.parameters()]
        node = subprocess.Popen([*command, "-p", "speed:=1.0"], stderr=subprocess.DEVNULL)
        client = Client(("goal/joints", "points"))
        client.matched()
        client.trajectories_of([*stand_ins.joints])
        client.count_clouds()
        for points in POINTS:
            states = free_states(count)[1:]
            given = [answer(client, block(points, rng), state) for state in tqdm(states, unit="goal")]
            times = [time for time in given if time is not None]
            percentiles = np.percentile(1e3 * np.array(times), [50, 95, 100]).tolist()
            row = dict(zip(("p50 [ms]", "p95 [ms]", "largest [ms]"), percentiles, strict=True))
            found[str(points)] = {"answers": len(times)} | row
        client.close()
        node.terminate()
        node.wait()
        stand_ins.close()
    return found


def main() -> None:
    """Measure, and write the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-n", type=one_or_more, default=200, help="motions, each with a handover")
    parser.add_argument("--clouds", type=one_or_more, default=40, help="of each number of points")
    args = parser.parse_args()
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    followed, answered = follow(args.n), answers(args.clouds)
    cells = [value if isinstance(value, int) else f"{value:.3f}" for value in followed.values()]
    lines = [record.row(some) for some in (list(followed), ["---:"] * len(followed), cells)]
    head = ["points", *next(iter(answered.values()))]
    rows = [
        [points, *(v if isinstance(v, int) else f"{v:.1f}" for v in times.values())]
        for points, times in answered.items()
    ]
    lines += ["", "From a cloud and a goal to the first trajectory, through the node:", ""]
    lines += [record.row(some) for some in (head, ["---:"] * len(head), *rows)]
    lines += ["", f"Of {args.clouds} goals each; without an answer are those that reached the node before their cloud."]
    data = followed | {"answers": answered}
    record.write("physics_ros2", data, "\n".join(lines), n=args.n, clouds=args.clouds, rclpy=version("ros-rclpy"))


if __name__ == "__main__":
    run_script(main, "ros2")
