"""Writes the bag of ``tests/data/golden_bag``, and the motion in it: python tests/helpers/golden_bag.py

The bag is read by ``tests/drivers/test_golden_bag.py``. It is written anew only where the driver is to write other
messages: what it holds is what players and controllers of earlier versions got.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np

from apex_ompl.drivers import BagDriver
from apex_ompl.robot import Robot, load_robot
from apex_ompl.timing import Trajectory, time_path

FOLDER = Path(__file__).resolve().parents[1] / "data" / "golden_bag"
ZERO, START, RATE = 1_800_000_000.0, 0.125, 25.0
CONTROLLERS = {"left_arm": slice(0, 7), "right_arm": slice(7, 14), "hands": slice(14, 16)}


def write(robot: Robot, motion: Trajectory, folder: Path) -> None:
    """Write a bag of a motion from the robot's home to a folder."""
    controllers = {name: robot.joint_names[part] for name, part in CONTROLLERS.items()}
    driver = BagDriver(robot, folder, controllers, motion.positions[0], zero=ZERO, rate=RATE)
    driver.send(motion, START)
    driver.advance(driver.end + 0.1)
    driver.close()


def main() -> None:
    """Write both."""
    robot = load_robot("dual_panda_softhand")
    goal = robot.home + 0.3 * (np.arange(robot.dof) % 7 < 4)
    motion = time_path(np.stack([robot.home, goal]), robot.limits, robot.joint_names).trajectory.merged()
    shutil.rmtree(FOLDER, ignore_errors=True)
    FOLDER.mkdir(parents=True)
    motion.save(FOLDER / "motion.npz")
    write(robot, motion, FOLDER / "bag")


if __name__ == "__main__":
    main()
