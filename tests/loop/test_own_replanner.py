"""Replanners and environments given as objects, and what the loop imports."""

from __future__ import annotations

import subprocess
import sys
from importlib.util import module_from_spec, spec_from_file_location

import numpy as np
import pytest
from support import ROOT

from apex_ompl import problems, run
from apex_ompl.errors import ParameterError
from apex_ompl.loop.result import Outcome
from apex_ompl.moving import Answer, ComputeBudget, Request, RunContext
from apex_ompl.moving.replanner import REGISTRY, register
from apex_ompl.moving.settings import LoopSettings
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.scripts import obstacle_at
from apex_ompl.timing import Trajectory

EXAMPLE = ROOT / "examples" / "05_own_replanner.py"
WORLD = "turning/vertical/medium/800001"
UNUSED = """
import sys, apex_ompl.loop.run
used = {name.split(".")[1] for name in sys.modules if name.startswith("apex_ompl.")}
sys.exit(", ".join(used & {"problems", "baselines", "evaluation", "training", "viz", "api"}) or None)
"""


class Idle:
    """Finds nothing."""

    def prepare(self, context: RunContext) -> None:
        self.asked = 0

    def replan(self, context: RunContext, request: Request, budget: ComputeBudget) -> Answer:
        self.asked += 1
        return Answer(None, "idle", budget)


def test_the_loop_loads_no_problems_baselines_or_evaluation() -> None:
    done = subprocess.run([sys.executable, "-c", UNUSED], check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_example_is_short_and_reaches_the_goal() -> None:
    assert len(EXAMPLE.read_text().splitlines()) < 40
    spec = spec_from_file_location("own_replanner", EXAMPLE)
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    found = run(WORLD, module.DirectMotions())
    assert found.outcome is Outcome.REACHED and found.method == "DirectMotions"
    assert {event.data["part"] for event in found.events if event.kind == "accepted"} == {"direct"}


@pytest.mark.parametrize("clock", ["sim", "real"])
def test_a_replanner_that_finds_nothing_leaves_the_robot_at_rest(clock: str) -> None:
    one = Idle()
    found = run(WORLD, one, clock=clock, settings=LoopSettings(timeout=1.0))
    assert found.outcome in (Outcome.TIMEOUT, Outcome.HIT_AT_REST)
    assert (found.trajectory.positions == found.trajectory.positions[0]).all()
    assert clock == "real" or one.asked > 5


def test_a_replanner_is_known_by_the_name_that_it_is_registered_by() -> None:
    register("idle", Idle, "finds nothing", {"evade": "never"})
    try:
        found = run(WORLD, "idle", settings=LoopSettings(timeout=0.3))
        assert found.method == "idle" and found.settings["loop"]["evade"] == "never"
    finally:
        del REGISTRY["idle"]


class OneBall:
    """An environment of the user's own: a ball that passes far from the robot."""

    def __init__(self) -> None:
        self.name, self.problem, self.fastest, self.ran = "one ball", problems.load("vertical/free/1"), 0.1, False
        self.ball = Obstacle(name="ball", sphere={"radius": 0.05}, position=(2.0, 0.0, 1.0), velocity=(0.0, 0.1, 0.0))
        self.started: list[float] = []
        self.times: list[float] = []

    def start(self, motion: Trajectory, time: float) -> None:
        self.started.append(time)

    def advance(self, time: float, q: np.ndarray) -> None:
        self.times.append(time)

    def present(self, time: float) -> tuple[Obstacle, ...]:
        return (obstacle_at(self.ball, time),)

    def script(self) -> tuple[Obstacle, ...]:
        return (self.ball,)


def test_an_environment_of_the_users_own_is_run_in_once() -> None:
    one = OneBall()
    found = run(one, "no-network")
    assert found.outcome is Outcome.REACHED and found.problem.name == "one ball" and "ball" in found.problem.moving
    assert one.ran and len(one.started) == 1 and one.times == sorted(one.times)
    with pytest.raises(ParameterError, match="load it again"):
        run(one, "no-network")


def test_what_is_no_replanner_is_named() -> None:
    with pytest.raises(ParameterError, match="method: expected the name of a replanner, or an object with prepare"):
        run(WORLD, object())  # type: ignore[arg-type]
    lost = Idle()
    lost.callback = lambda: None  # type: ignore[attr-defined]
    with pytest.raises(ParameterError, match="method: expected a replanner that can be pickled"):
        run(WORLD, lost, clock="real")
    with pytest.raises(ParameterError, match="problem: expected a problem, its name, its file, or an environment"):
        run(object(), "no-network")  # type: ignore[arg-type]
