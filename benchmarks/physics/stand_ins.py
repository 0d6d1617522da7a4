"""Two joint trajectory controllers in processes of their own, and what they made of the motions that they were sent."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from apex_ompl.drivers import Ros2Driver
from apex_ompl.robot import Robot
from apex_ompl.timing import Trajectory
from apex_ompl.types import Array
from benchmarks.lib.record import ROOT

PREFIX = "r_"  # of joints in ROS
PROGRAM = "benchmarks.physics.stand_in_controller"


class StandIns:
    """Controllers of the left arm with its hand, and of the right one, at the robot's home.

    Attributes:
        joints: The joints of each, by its name.
        processes: Their processes.
    """

    def __init__(self, robot: Robot, folder: Path, arguments: Sequence[str] = ()) -> None:
        """Start them with arguments of ROS; each writes what it does to a file in a folder."""
        left = [name for name in robot.joint_names if name.startswith("left")]
        self.joints = {"left": left, "right": [name for name in robot.joint_names if name not in left]}
        self.robot, self.folder, self.processes = robot, folder, list[subprocess.Popen[bytes]]()
        home = dict(zip(robot.joint_names, robot.home.tolist(), strict=True))
        for name, joints in self.joints.items():
            at = [f"{PREFIX}{joint}={home[joint]!r}" for joint in joints]
            command = [sys.executable, "-m", PROGRAM, str(folder / name), name, *at, "--ros-args", *arguments]
            self.processes.append(subprocess.Popen(command, cwd=ROOT, env={**os.environ, "OMP_NUM_THREADS": "1"}))

    def driver(self, **options: Any) -> Ros2Driver:
        """Return a driver that sends them motions."""
        renamed = {name: PREFIX + name for name in self.robot.joint_names}
        return Ros2Driver(self.robot, self.joints, renamed=renamed, **{"started": 60.0, "silence": 10.0} | options)

    def parameters(self) -> list[str]:
        """Return the arguments by which the node ``apex-ompl ros2`` knows them."""
        controllers = [f"{name}={','.join(joints)}" for name, joints in self.joints.items()]
        renamed = [f"{name}={PREFIX}{name}" for name in self.robot.joint_names]
        return ["-p", f"controllers:={controllers}", "-p", f"renamed:={renamed}"]

    def close(self) -> None:
        """End them."""
        for process in self.processes:
            process.send_signal(signal.SIGKILL)
            process.wait()

    def followed(self) -> tuple[Array, Array]:
        """Return times by the system's clock [ns], and states, shape (N, dof), of which half the joints are NaN."""
        times, found = [], []
        for name, joints in self.joints.items():
            lines = (self.folder / name).read_text().splitlines()[:-1]  # the last one may not be complete
            rows = [json.loads(one) for one in lines]
            states = np.full((len(rows), self.robot.dof), np.nan)
            states[:, [self.robot.joint_names.index(joint) for joint in joints]] = [row[1:] for row in rows]
            times.append(np.array([row[0] for row in rows], np.int64))
            found.append(states)
        return np.concatenate(times), np.concatenate(found)


def differences(
    stand_ins: StandIns, driver: Ros2Driver, commanded: Sequence[tuple[float, Trajectory]]
) -> tuple[Array, int]:
    """Return how far each sample is from the motion that was commanded then [rad], and how many samples moved.

    Args:
        stand_ins: The controllers.
        driver: The driver, whose clock counts.
        commanded: Motions, each from a time on.
    """
    times, states = stand_ins.followed()
    found, moving = np.empty(len(times)), 0
    starts = np.array([at for at, _ in commanded])
    for k, now in enumerate(driver.times_of(times).tolist()):
        last = int(np.searchsorted(starts, now, side="right")) - 1
        at, motion = commanded[max(last, 0)]
        wanted = motion(min(max(now - at, 0.0), motion.duration))
        found[k] = np.nanmax(np.abs(states[k] - wanted))
        moving += last >= 0 and now - at < motion.duration
    return found, moving
