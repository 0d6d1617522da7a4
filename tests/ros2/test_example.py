"""The example of a camera of one's own over ROS 2, against controllers in processes of their own."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from support import ROOT, benchmark_script

from apex_ompl import load_problem
from apex_ompl.robot import Robot

pytest.importorskip("rclpy")

client_of, stand_ins_of = benchmark_script("physics.ros2_client"), benchmark_script("physics.stand_ins")


def test_the_example_reaches_its_goal(robot: Robot, tmp_path: Path) -> None:
    stand_ins = stand_ins_of.StandIns(robot, tmp_path)
    try:
        done = subprocess.run(
            [sys.executable, str(ROOT / "examples" / "10_ros2.py")],
            check=False, timeout=120, capture_output=True, text=True,
        )  # fmt: skip
        assert done.returncode == 0 and done.stdout.startswith("reached"), done.stderr
        _, states = stand_ins.followed()
    finally:
        stand_ins.close()
    last = np.array([column[~np.isnan(column)][-1] for column in states.T])
    goals = load_problem("vertical/free/800001").goal_states(robot.joint_names)
    assert np.abs(goals - last).max(axis=1).min() <= 1e-3
