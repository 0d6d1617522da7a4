from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from apex_ompl.collision import Verdict
from apex_ompl.problem import Goal, Obstacle, Problem
from apex_ompl.robot import Robot, load_robot


@pytest.fixture(scope="session")
def robot() -> Robot:
    return load_robot("dual_panda_softhand")


@pytest.fixture(scope="session")
def baxter() -> Robot:
    return load_robot("baxter")


@pytest.fixture
def post() -> Obstacle:
    return Obstacle(name="post", box=(0.1, 0.1, 0.6), position=(0.45, 0.0, 0.3))


@pytest.fixture
def verdict(robot: Robot, post: Obstacle) -> Verdict:
    return Verdict(robot, [post])


@pytest.fixture
def problem(robot: Robot, post: Obstacle) -> Problem:
    """Both arms turn; easy for every planner, and the straight line collides."""
    start, goal = robot.home.copy(), robot.home.copy()
    start[[0, 1, 3]] = 0.1, 0.4, -1.6
    goal[[0, 1, 3]] = -1.3, 0.4, -1.6

    def as_dict(q: np.ndarray) -> dict[str, float]:
        return dict(zip(robot.joint_names, q.tolist(), strict=True))

    return Problem(
        name="sweep", robot=robot.name, scene=(post,), start=as_dict(start), goal=Goal(joints=(as_dict(goal),))
    )


@pytest.fixture
def apex_cli():
    """Run the command line in a fresh process: exit code, standard output, standard error."""

    def run(*arguments: object, **options: object) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "apex_ompl.cli", *map(str, arguments)]
        settings = {"capture_output": True, "text": True, "timeout": 120, "env": os.environ, **options}
        return subprocess.run(command, check=False, **settings)

    return run
