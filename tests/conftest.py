from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch is imported: two processes of tests share the cores

import runpy
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import settings as hypothesis_settings
from planning import HARD, cached_problem
from support import DATA, ROOT

from apex_ompl import plan
from apex_ompl.cli import main
from apex_ompl.collision import CollisionChecker
from apex_ompl.evaluation import Workers
from apex_ompl.ompl.process import quiet_ompl
from apex_ompl.ompl.setup import PlanningSetup, assemble
from apex_ompl.problems.suite_robot import robot as suite_robot
from apex_ompl.result import PlanResult
from apex_ompl.robot import Robot, load_robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Goal, Problem
from apex_ompl.training.records import Paths
from apex_ompl.training.store import load, save
from apex_ompl.viz.viewer.server import serving

hypothesis_settings.register_profile("here", derandomize=True, deadline=None)  # the same examples on every machine
hypothesis_settings.load_profile("here")


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
def checker(robot: Robot, post: Obstacle) -> CollisionChecker:
    return CollisionChecker(robot, [post])


@pytest.fixture
def problem(robot: Robot, post: Obstacle) -> Problem:
    """The left arm passes a post; easy for every planner, but the straight line collides."""
    start, goal = robot.home.copy(), robot.home.copy()
    start[[0, 1, 3]] = 0.1, 0.4, -1.6
    goal[[0, 1, 3]] = -1.3, 0.4, -1.6

    def as_dict(q: np.ndarray) -> dict[str, float]:
        return dict(zip(robot.joint_names, q.tolist(), strict=True))

    return Problem(
        name="sweep", robot=robot.name, scene=(post,), start=as_dict(start), goal=Goal(joints=(as_dict(goal),))
    )


@pytest.fixture
def apex_cli(capfd: pytest.CaptureFixture[str]):
    """Run the command line in this process; returns exit code, standard output and standard error."""

    def run(*arguments: object) -> subprocess.CompletedProcess[str]:
        capfd.readouterr()
        stdout = sys.stdout
        try:
            code = main([str(one) for one in arguments])
        except SystemExit as ended:
            code = int(ended.code or 0)
        finally:
            sys.stdout = stdout
        return subprocess.CompletedProcess(arguments, code, *capfd.readouterr())

    return run


@pytest.fixture
def script_here(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    """Run a script of ``scripts`` in this process; returns exit code, standard output and standard error."""

    def run(script: str, *arguments: object) -> subprocess.CompletedProcess[str]:
        file = str(ROOT / "scripts" / script)
        capfd.readouterr()
        monkeypatch.setattr(sys, "argv", [file, *map(str, arguments)])
        code = 0
        try:
            runpy.run_path(file, run_name="__main__")
        except SystemExit as ended:
            code = int(ended.code or 0)
        return subprocess.CompletedProcess(arguments, code, *capfd.readouterr())

    return run


@pytest.fixture
def apex_process():
    """Run the command line in a new process; returns exit code, standard output and standard error."""

    def run(*arguments: object) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "apex_ompl.cli", *map(str, arguments)]
        return subprocess.run(command, check=False, capture_output=True, text=True, timeout=120)

    return run


@pytest.fixture(scope="session")
def _process_of_runs() -> Iterator[ProcessPoolExecutor]:
    pool = Workers()._pool((), 1)
    ended = pool.shutdown
    pool.shutdown = lambda *_, **__: None  # type: ignore[method-assign]
    yield pool
    ended()


@pytest.fixture
def shared_process(_process_of_runs: ProcessPoolExecutor, monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs of a benchmark are made in one process for many tests, which saves them its start and its warm-up."""
    monkeypatch.setattr(Workers, "_pool", lambda *_: _process_of_runs)


@pytest.fixture(scope="session")
def paths() -> Paths:
    """Paths of a few problems of every level."""
    return load(DATA / "paths.zip")


@pytest.fixture(scope="session")
def few(paths: Paths, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file of 32 paths of different problems."""
    first = np.unique(paths.arrays["problem"], return_index=True)[1][:32]
    arrays = dict(paths.arrays)
    for name in ("problem", "start", "goal", "control", "point", "clearance", "length", "source", "homotopy"):
        arrays[name] = arrays[name][first]
    file = tmp_path_factory.mktemp("data") / "few.zip"
    save(file, Paths(arrays, paths.names, paths.about))
    return file


@pytest.fixture
def quiet() -> Iterator[None]:
    """OMPL's log is off."""
    with quiet_ompl():
        yield


@pytest.fixture
def ready() -> PlanningSetup:
    """The planning setup of a hard problem."""
    return assemble(cached_problem(HARD), suite_robot())


@pytest.fixture(scope="session")
def server() -> Iterator[Any]:
    with serving() as found:
        yield found


@pytest.fixture(scope="session")
def result() -> PlanResult:
    found = plan("ball_in_cup", timeout=20.0)
    assert found
    return found
