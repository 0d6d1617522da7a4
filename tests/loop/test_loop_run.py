"""Runs of the closed loop in worlds of each kind, and what is asked for wrongly."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from loops import PROBLEM, context_of, world_of
from runs import motion_between

from apex_ompl import problems, run
from apex_ompl.errors import ApexError
from apex_ompl.loop.control import RunRecord
from apex_ompl.loop.referee import LIMIT_TOLERANCE
from apex_ompl.loop.result import Outcome, RunResult
from apex_ompl.loop.run import _Run
from apex_ompl.moving.context import Following
from apex_ompl.moving.settings import LoopSettings
from apex_ompl.problems import worlds
from apex_ompl.problems.suite_robot import robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.scripts import place_at
from apex_ompl.timing import time_path
from apex_ompl.timing.rests import is_at_rest

MOVING = "vertical/moving-large-0.2/800001"
NAN = float("nan")


@pytest.mark.parametrize("kind", worlds.kinds())
def test_runs_in_all_worlds_are_results(kind: str, tmp_path: Path) -> None:
    name = worlds.ids(kind, "validation", 1)[0]
    settings = LoopSettings(timeout=8.0, stuck=3.0, fastest=max(worlds.load(name).fastest, 1e-3))
    found = run(name, "no-network", speed=1.0, settings=settings)
    motion = found.trajectory
    assert found.outcome not in (Outcome.START_INVALID, Outcome.LIMITS, Outcome.HIT_STILL)
    assert bool(found) == (found.outcome is Outcome.REACHED) == (found.reason == "")
    assert 0.0 < motion.duration <= 8.0 + 0.01
    assert max(motion.use(robot().limits).values()) <= 1.0 + LIMIT_TOLERANCE
    assert found.metrics["replans_asked"] >= 1.0
    late = kind in ("popup", "imposed", "interceptor")  # what comes into being is not seen at once
    assert late or found.metrics["broken_steps"] == 0.0
    moved = [o for o in found.problem.scene if o.moving]
    assert moved or late
    for o in moved:
        assert np.isfinite(place_at(o, motion.duration)).all()
    found.save(tmp_path / "run.npz")
    again = RunResult.load(tmp_path / "run.npz")
    assert again.as_dict() == found.as_dict() and again.outcome is found.outcome
    assert np.array_equal(again.trajectory.positions, motion.positions)
    if found:
        goals = found.problem.goal_states(robot().joint_names)
        assert (np.abs(goals - motion.positions[-1]).max(axis=1) < 1e-9).any()


@pytest.mark.parametrize("timeout", [2.0, 2.95])
def test_a_goal_that_is_blocked_for_good_ends_the_run_at_rest_and_names_the_obstacle(timeout: float) -> None:
    """A box comes to where a hand would be at the goal, and stays there."""
    problem = problems.load(PROBLEM).still
    goal = problem.goal_states(robot().joint_names)[0]
    palm = robot().link_pose(goal, "left_hand_palm")[:3, 3]
    rows = tuple((t, *(palm + (0.0, 0.0, z)).tolist()) for t, z in ((0.0, 0.3), (0.5, 0.0), (60.0, 0.0)))
    box = Obstacle(name="box", box=(0.1, 0.1, 0.1), position=rows[0][1:], trajectory=rows)
    problem = problem.model_copy(update={"scene": (*problem.scene, box)})
    found = run(problem, "no-network", settings=LoopSettings(timeout=timeout, fastest=0.6))
    assert found.outcome is Outcome.TIMEOUT and not found and timeout <= found.trajectory.duration < timeout + 0.5
    assert "no goal was reached" in found.reason and "box stood where the robot would be at the goal" in found.reason
    assert is_at_rest(found.trajectory, found.trajectory.duration)
    assert "contact" not in {event.kind for event in found.events} and found.metrics["clearance"] > 0.0


def test_a_robot_that_stands_at_the_goal_is_there() -> None:
    problem = problems.load(PROBLEM)
    there = problem.model_copy(update={"start": dict(problem.goal.joints[0])})
    found = run(there, "no-network")
    assert found.outcome is Outcome.REACHED and found.metrics["time_to_goal"] == 0.0 == found.metrics["rest_time"]
    assert not [event for event in found.events if event.kind == "request"]


def test_whoever_is_late_and_comes_to_rest_at_the_goal_has_reached_it() -> None:
    whole = run(MOVING, "no-network")
    arrival = whole.metrics["time_to_goal"]
    for early in (0.01, 0.02, 0.03):
        found = run(MOVING, "no-network", settings=LoopSettings(timeout=arrival - early))
        assert ("time_to_goal" in found.metrics) == (found.outcome is Outcome.REACHED)
        if found:
            assert found.metrics["time_to_goal"] <= arrival + 0.1


@pytest.mark.parametrize(
    ("given", "words"),
    [({"method": "apx"}, "replanner 'apx', did you mean 'apex'"), ({"clock": "rel"}, "clock 'rel'"),
     ({"prediction": "cvv"}, "prediction 'cvv'"), ({"problem": "popup/vertical/larg/12"}, "size of cubes 'larg'"),
     ({"problem": "nothing"}, "world 'nothing'"), ({"problem": "no/such/file.yaml"}, "no/such/file.yaml"),
     ({"speed": 0.0}, "velocity_scale|speed"), ({"speed": NAN}, "velocity_scale|speed"),
     ({"speed": -1.0}, "velocity_scale|speed"), ({"speed": 1.5}, "velocity_scale|speed"), ({"seed": -1}, "seed"),
     ({"seed": 0.5}, "seed"), ({"method": 5}, "method: expected the name of a replanner, .*, got 5"),
     ({"clock": None}, "unknown clock None"),
     ({"problem": "carry_tray"}, "problem: expected no constraint: .*, got 'the upright of tray"),
     ({"prediction": []}, "unknown prediction"), ({"settings": 5}, "settings: expected a LoopSettings, got 5"),
     ({"speed": 10**400}, "velocity_scale")],
)  # fmt: skip
def test_what_is_asked_for_wrongly_is_named(given: dict[str, Any], words: str) -> None:
    arguments = {"problem": MOVING, "method": "no-network", **given}
    with pytest.raises(ApexError, match=words):
        run(**arguments)


@pytest.mark.parametrize(
    "given",
    [{"period": 0.0}, {"period": NAN}, {"budget": 0.055}, {"timeout": 0.0}, {"timeout": float("inf")},
     {"fastest": -0.1}, {"error": NAN}, {"latency": -2.0}, {"prediction": "best"}, {"evade": "maybe"},
     {"memory": 0.0}, {"silence": NAN}],
    ids=str,
)  # fmt: skip
def test_parameters_outside_their_ranges_are_named(given: dict[str, Any]) -> None:
    with pytest.raises(ApexError, match=next(iter(given))):
        LoopSettings(**given)


def test_a_robot_that_leaves_is_not_held_by_a_stop_before_it_has_set_out() -> None:
    """A cube comes to where the robot stands within 0.2 s: too soon for a motion that is proved."""
    name = "vertical/moving-huge-0.4/800007"
    found = run(name, "no-network", seed=0, settings=LoopSettings(evade="risk"))
    first = next(event for event in found.events if event.kind == "accepted")
    assert first.data["part"] == "evade" and first.data["leaving"] and found.metrics["unguarded_steps"] > 0.0
    assert found.outcome is Outcome.REACHED and found.metrics["clearance"] > 0.0
    proved = run(name, "no-network", seed=0, settings=LoopSettings(timeout=1.0))
    assert proved.outcome is Outcome.HIT_AT_REST and proved.metrics["unguarded_steps"] == 0.0


def test_a_stop_that_ends_at_a_goal_is_one_to_the_goal() -> None:
    """Such a run has reached the goal, though what is followed last is a stop."""
    context = context_of(PROBLEM)
    goal = context.goals[0]
    motion = time_path(np.stack([context.setup.start, goal]), context.limits, context.names).trajectory
    one = Following(motion, 0.0, to_goal=True)
    stops = [context.unproved_stop(one, time) for time in np.linspace(0.0, one.end, 100)]
    there = [bool(np.abs(stop.motion.positions[-1] - goal).max() <= 1e-6) for stop in stops]
    assert [stop.to_goal for stop in stops] == there and 0 < sum(there) < len(there)


def test_candidates_that_no_duration_makes_possible_are_not_carried_on() -> None:
    """One of a week made every later replan raise, and the robot stood until time was up."""
    found = run("horizontal/moving-medium-0.4/800005", "apex", seed=0)
    assert found.outcome is Outcome.REACHED
    assert not [event for event in found.events if "Error" in str(event.data.get("why", ""))]


def test_a_start_in_collision_is_an_outcome(tmp_path: Path) -> None:
    problem = problems.load(MOVING)
    q = problem.start_state(robot().joint_names)
    palm = tuple(map(float, robot().link_pose(q, "left_hand_palm")[:3, 3]))
    post = Obstacle(name="post", box=(0.1, 0.1, 0.1), position=palm)
    found = run(problem.model_copy(update={"scene": (*problem.scene, post)}), "no-network")
    assert found.outcome is Outcome.START_INVALID and not found and "post" in found.reason
    assert found.trajectory.duration == 0.0 and found.events == ()
    found.save(tmp_path / "run.json")
    assert RunResult.load(tmp_path / "run.json").reason == found.reason


def test_a_goal_in_collision_is_no_error() -> None:
    problem = problems.load(MOVING)
    goal = problem.goal_states(robot().joint_names)[0]
    palm = tuple(map(float, robot().link_pose(goal, "left_hand_palm")[:3, 3]))
    post = Obstacle(name="post", box=(0.03, 0.03, 0.03), position=palm)
    found = run(problem.model_copy(update={"scene": (*problem.scene, post)}), "no-network")
    assert found.outcome is Outcome.STUCK and "post" in found.reason


def test_rest_elsewhere_than_at_a_goal_is_no_success() -> None:
    context, world = context_of(PROBLEM), world_of(PROBLEM)
    q = context.setup.start
    aside = np.where(np.arange(len(q)) == 0, q + 0.05 * np.sign(-q), q)
    record = RunRecord(motion_between(robot(), q, aside), (), reached=True, ended="", broken=0)
    found = _Run(world, context, "no-network", "simulated", 0, {}).judged(record)
    assert found.outcome is Outcome.MISALIGNED and found.reason == "the motion does not end at a goal"
