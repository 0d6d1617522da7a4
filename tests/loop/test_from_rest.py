"""Replanners that stop first: what they follow, where they stop, and when they ask."""

from __future__ import annotations

import numpy as np
import pytest

from apex_ompl import run
from apex_ompl.collision import CollisionChecker
from apex_ompl.loop.replan.methods import named
from apex_ompl.loop.result import Outcome, RunResult
from apex_ompl.moving.settings import LoopSettings
from apex_ompl.problems import worlds
from apex_ompl.problems.suite_robot import robot
from apex_ompl.scene.scripts import problem_at

GRAZING = "vertical/moving-xlarge-0.4/900000"  # the straight way to the goal touches between two steps
CROSSED = "vertical/moving-large-0.4/800000"  # a world in which the way is blocked for a while


def events(found: RunResult, kind: str) -> list[float]:
    return [event.time for event in found.events if event.kind == kind]


@pytest.fixture(scope="module")
def waited() -> RunResult:
    return run(CROSSED, "stop-and-wait")


@pytest.mark.parametrize("name", ["stop-and-wait", "rrtconnect"])
def test_plans_begin_at_rest(name: str, waited: RunResult) -> None:
    found = waited if name == "stop-and-wait" else run(CROSSED, name)
    assert found.outcome is Outcome.REACHED and events(found, "stop")
    joins = {event.data["number"]: event.data["join"] for event in found.events if event.kind == "request"}
    for event in found.events:
        if event.kind == "accepted":  # a robot that stands sets out at once, one that stops at the time of joining
            begins = np.array([event.time, joins[event.data["number"]]])
            assert np.abs(found.trajectory(begins, 1)).max(axis=1).min() < 1e-6
    assert max(found.trajectory.use(robot().limits).values()) <= 1.0 + 1e-9


def test_what_steps_find_free_and_no_proof_does_is_no_reason_to_wait_for_ever() -> None:
    """Two held objects meet at the goal; a search that looks in steps finds the same straight way to it each time."""
    world = worlds.load(GRAZING)
    assert run(world, "rrtconnect", speed=0.25, settings=LoopSettings(timeout=12.0)).outcome is Outcome.REACHED


def test_who_waits_stays_on_the_first_plan(waited: RunResult) -> None:
    assert len(events(waited, "accepted")) > 1
    motion = waited.trajectory
    states = motion(np.linspace(0.0, motion.duration, 400))
    # Behind the stop the robot goes on from the line that it was on: no jump, and no way back.
    assert np.abs(np.diff(states, axis=0)).max() < 0.1
    goal = motion.positions[-1]
    left = np.linalg.norm(states - goal, axis=1)
    assert (np.diff(left) < 0.02).all()


def test_retiming_alone_keeps_to_the_path_without_a_stop_first() -> None:
    found = run(CROSSED, "retime")
    assert found.outcome is Outcome.REACHED
    parts = {event.data["part"] for event in found.events if event.kind == "accepted"}
    assert parts & {"retime", "resume"}


def test_the_papers_loop_stops_at_its_distance_and_follows_what_is_not_proved() -> None:
    settings = LoopSettings(trigger=0.1, timeout=0.58, latency=0.0)
    found = run("vertical/moving-small-0.1/800000", "apex-paper", settings=settings)
    stops = events(found, "stop")
    assert stops and found.metrics["replans_accepted"] >= 2.0
    for time in stops:
        problem = problem_at(found.problem, time)
        still = {o.name for o in worlds.load("vertical/moving-small-0.1/800000").problem.still.scene}
        alone = problem.model_copy(update={"scene": tuple(o for o in problem.scene if o.name not in still)})
        checker = CollisionChecker(robot(), alone.scene, alone.attached)
        # What the sensor saw is 50 ms old and 8 mm off; spheres that cover the robot protrude by 2 cm.
        assert checker.obstacle_distance(found.trajectory(np.array([time]))) < 0.1 + 0.06


def test_ways_that_plan_from_rest_say_so() -> None:
    for name in ("stop-and-wait", "rrtconnect", "apex-paper", "apex-paper-unguided"):
        assert named(name).settings["from_rest"]
