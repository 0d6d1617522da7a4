"""Motions over ROS 2: sent through its middleware to two controllers, which are handed over in the middle of motions.

Motions between random free states are sent to stand-ins for ROS 2's joint trajectory controller, in processes of their
own, which follow its documented rules. In the middle of each motion another one takes its place: the stop from there.
Each sample of the stand-ins, 200 a second, is compared with the motion that was commanded then. Messages stay on this
machine.

Usage: python -m benchmarks.physics.ros2 [-n 200]    (needs the extra "ros2")
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np
from tqdm import tqdm

from apex_ompl.collision import CollisionChecker
from apex_ompl.problems.suite_robot import robot
from apex_ompl.timing import Trajectory, time_path
from apex_ompl.types import Array
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import one_or_more
from benchmarks.lib import record
from benchmarks.physics.stand_ins import StandIns, differences

DEPENDS = (
    "apex_ompl/drivers", "apex_ompl/timing", "benchmarks/physics/stand_ins.py",
    "benchmarks/physics/stand_in_controller.py",
)  # fmt: skip
LEAD = 0.05  # between a message and the start of its motion [s]
SPREAD = 0.2  # of the states around home [rad]
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


def main() -> None:
    """Send the motions and write the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-n", type=one_or_more, default=200, help="motions, each with a handover")
    args = parser.parse_args()
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    commanded, delays = list[tuple[float, Trajectory]](), list[float]()
    limits, names = robot().limits, robot().joint_names
    states = free_states(args.n)
    with tempfile.TemporaryDirectory() as folder:
        stand_ins = StandIns(robot(), Path(folder))
        driver = stand_ins.driver()
        q = states[0]
        for state in tqdm(states[1:], unit="motion"):
            motion = time_path(np.stack([q, state]), limits, names).trajectory
            half, start = 0.5 * motion.duration, driver.time + LEAD
            rest = motion.stop_at(half, limits).after(half)
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
    data = {
        "samples": len(off), "of them in motion": moving, "largest difference [urad]": 1e6 * float(off.max()),
        "over 1 urad": int((off > LARGEST).sum()), "send p50 [ms]": 1e3 * float(np.percentile(delays, 50)),
        "send p95 [ms]": 1e3 * float(np.percentile(delays, 95)),
    }  # fmt: skip
    cells = [value if isinstance(value, int) else f"{value:.3f}" for value in data.values()]
    lines = [record.row(some) for some in (list(data), ["---:"] * len(data), cells)]
    record.write("physics_ros2", data, "\n".join(lines), n=args.n, rclpy=version("ros-rclpy"))


if __name__ == "__main__":
    run_script(main, "ros2")
