"""The executor: the guarantee whatever a way of replanning says, and what happens to answers that are of no use."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from apex_ompl import problems
from apex_ompl.errors import ApexError
from apex_ompl.live.timed_spline import Start, TimedSpline
from apex_ompl.loop.charges import Charges
from apex_ompl.loop.following import Following
from apex_ompl.loop.ready import Ready
from apex_ompl.loop.referee import RefereeReport, judge
from apex_ompl.loop.request import Answer, Request
from apex_ompl.loop.run import run
from apex_ompl.loop.sensor import Sensor, SensorStream
from apex_ompl.loop.settings import LoopSettings
from apex_ompl.loop.simulation import Simulated, simulate
from apex_ompl.ompl_adapter.setup import PlanningSetup, assemble
from apex_ompl.problems.world_scripts import moving_world
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.trajectory import Timing, Trajectory, time_path
from apex_ompl.trajectory.methods.spline import least_knot_spacing
from apex_ompl.trajectory.rests import is_at_rest

PROBLEM, BLOCKED = "vertical/free/1", "vertical/free/0"  # the straight line is free, and meets what stands still
Find = Callable[[Ready, Request], Following | None]
FAR = Obstacle(name="far", box=(0.1, 0.1, 0.1), position=(2.0, 2.0, 1.0), velocity=(0.0, 0.01, 0.0))


class ByHand:
    """A way of replanning that answers what a function says."""

    def __init__(self, find: Find, seconds: float = 0.03) -> None:
        self.find, self.seconds, self.asked = find, seconds, []

    def prepare(self, ready: Ready) -> None:
        """Nothing is needed."""

    def replan(self, ready: Ready, request: Request, charges: Charges) -> Answer:
        self.asked.append(request)
        charges.spent += self.seconds
        return Answer(self.find(ready, request), "by hand", charges)


@cache
def setup_of(name: str) -> PlanningSetup:
    return assemble(problems.load(name).still, seed=0)


def line(ready: Ready, request: Request) -> Following:
    """The straight line to the goal, whatever is in its way."""
    start, goal = request.following.start(request.join), ready.goals[0]
    return Following(line_from(ready, start, goal), request.join, to_goal=True)


def line_from(ready: Ready, start: Start, goal: np.ndarray) -> Trajectory:
    if not np.stack(start)[1:].any():
        return time_path(np.stack([start.position, goal]), ready.limits, ready.names).trajectory
    spline = TimedSpline.along(np.linspace(start.position, goal, 32), 0.8, start, goal)
    for _ in range(20):
        least = least_knot_spacing(spline.control, ready.limits)
        if least <= spline.spacing:
            break
        spline = spline.lasting(max(least, 1.05 * spline.spacing))
    return spline.trajectory(ready.names)


def go(
    replanner: Any, *obstacles: Obstacle, name: str = PROBLEM, speed: float = 1.0, sensor: Sensor | None = None,
    **parameters: Any,
) -> tuple[Simulated, RefereeReport]:  # fmt: skip
    """A run, and what the referee says of it."""
    setup = setup_of(name)
    problem = problems.load(name).still
    world = moving_world(problem.model_copy(update={"scene": (*problem.scene, *(obstacles or (FAR,)))}))
    share = 1.0 - 1e-6
    limits = Timing(velocity_scale=speed).limits(setup.robot.limits, setup.robot.joint_names)
    kinds = ("velocity", "acceleration", "jerk")
    limits = replace(limits, **{kind: share * getattr(limits, kind) for kind in kinds})
    ready = Ready(setup, limits, LoopSettings(**{"timeout": 3.0, **parameters}))
    stream = SensorStream(sensor or Sensor(), world, ready.settings.watched)
    done = simulate(world, ready, replanner, stream, seed=0)
    truth = problem.model_copy(update={"scene": (*problem.scene, *world.script())})
    return done, judge(setup.robot, truth, done.trajectory, goals=ready.goals)


def reasons(done: Simulated) -> set[str]:
    return {event.data["why"] for event in done.events if event.kind == "rejected"}


def kinds(done: Simulated) -> set[str]:
    return {event.kind for event in done.events}


def stood(done: Simulated) -> bool:
    return bool((done.trajectory.positions == done.trajectory.positions[0]).all())


def check_limits(report: RefereeReport) -> None:
    assert max(report.limit_use.values()) <= 1.0 + 1e-9


def boxes(seed: int, fastest: float) -> list[Obstacle]:
    """Boxes that go to where the straight line is, and turn or not, no faster than allowed."""
    rng, setup = np.random.default_rng(seed), setup_of(PROBLEM)
    found = []
    for k in range(3):
        share, edge = rng.random(), rng.uniform(0.05, 0.15)
        q = setup.start + share * (setup.valid_goals[0] - setup.start)
        side = ("left", "right")[int(rng.integers(2))]
        target = setup.robot.link_pose(q, f"{side}_hand_palm")[:3, 3]
        place, time = target + rng.uniform(-0.5, 0.5, 3), 0.0
        rows = [(time, *place)]
        while time < 6.0:
            way = target + rng.uniform(-0.3, 0.3, 3) - place
            lasts = np.linalg.norm(way) / (fastest * rng.uniform(0.3, 1.0))
            lasts, way = (lasts, way) if rng.random() < 0.5 else (0.5 * lasts, 0.5 * way)
            place, time = place + way, time + lasts
            rows.append((time, *place))
        rows = tuple(tuple(map(float, row)) for row in rows)
        found.append(Obstacle(name=f"box_{k}", box=(edge,) * 3, position=rows[0][1:], trajectory=rows))
    return found


@settings(max_examples=8)
@given(st.integers(0, 10**6), st.sampled_from([0.2, 0.4, 0.8]), st.sampled_from(["still", "cv"]))
def test_the_robot_never_touches_what_moves_while_it_moves(seed: int, fastest: float, prediction: str) -> None:
    done, report = go(
        ByHand(line), *boxes(seed, fastest), fastest=fastest, prediction=prediction, sensor=Sensor(seed=seed)
    )  # fmt: skip
    assert done.broken == 0
    assert report.contact is None or not report.contact.moved, str(report.contact)
    assert report.still_contact is None
    check_limits(report)


def crossing(setup: PlanningSetup) -> Obstacle:
    """A box that comes into the straight line soon after the robot set out."""
    middle = 0.4 * setup.start + 0.6 * setup.valid_goals[0]
    links = ("left_hand_palm", "right_hand_palm")
    moves = [np.linalg.norm(setup.robot.link_pose(setup.start, n)[:3, 3] - setup.robot.link_pose(middle, n)[:3, 3])
             for n in links]  # fmt: skip
    target = setup.robot.link_pose(middle, links[int(np.argmax(moves))])[:3, 3]
    begin = target + (0.0, 0.0, 0.45)
    rows = ((0.0, *begin), (1.0, *target), (9.0, *target))
    rows = tuple(tuple(map(float, row)) for row in rows)
    return Obstacle(name="box", box=(0.1, 0.1, 0.1), position=rows[0][1:], trajectory=rows)


def test_without_the_guard_the_robot_runs_into_it() -> None:
    """So the guard is what keeps it from that in the other tests."""
    box, slow = crossing(setup_of(PROBLEM)), {"speed": 0.3, "fastest": 0.5}
    blind, hit = go(ByHand(line), box, prediction="still", guarded=False, monitored=False, **slow)
    assert hit.contact is not None and hit.contact.moved and "stop" not in kinds(blind)
    done, report = go(ByHand(line), box, prediction="still", monitored=False, **slow)
    assert report.contact is None or not report.contact.moved
    assert "stop" in kinds(done) and not done.reached and is_at_rest(done.trajectory, done.trajectory.duration)
    check_limits(report)


def test_the_straight_line_is_followed_where_nothing_is_in_the_way() -> None:
    done, report = go(ByHand(line))
    assert done.reached and report.at_goal and report.at_rest and not report.faults
    assert [event.kind for event in done.events] == ["request", "accepted", "goal"]
    check_limits(report)


def shifted(ready: Ready, request: Request) -> Following:
    start = ready.setup.start.copy()
    start[0] += 1e-3
    return Following(line_from(ready, Start.at_rest(start), ready.goals[0]), request.join, to_goal=True)


def under_way(ready: Ready, request: Request) -> Following:
    """Begins with a speed that the robot does not have."""
    found = line(ready, request)
    return Following(found.motion.after(0.1), request.join, to_goal=True)


def unfinished(ready: Ready, request: Request) -> Following:
    motion = line(ready, request).motion
    half = np.searchsorted(motion.times, 0.5 * motion.duration)
    rows = (getattr(motion, name)[:half] for name in ("times", "positions", "velocities", "accelerations"))
    return Following(Trajectory(*rows, motion.joint_names), request.join)


def fast(ready: Ready, request: Request) -> Following:
    motion = line(ready, request).motion
    rows = 0.5 * motion.times, motion.positions, 2.0 * motion.velocities, 4.0 * motion.accelerations
    return Following(Trajectory(*rows, motion.joint_names), request.join, to_goal=True)


def boasting(ready: Ready, request: Request) -> Following:
    halfway = 0.5 * (ready.setup.start + ready.goals[0])
    return Following(line_from(ready, Start.at_rest(ready.setup.start), halfway), request.join, to_goal=True)


def hasty(ready: Ready, request: Request) -> Following:
    return replace(line(ready, request), begin=request.join - 0.02)


def renamed(ready: Ready, request: Request) -> Following:
    found = line(ready, request)
    return replace(found, motion=replace(found.motion, joint_names=tuple(reversed(ready.names))))


@pytest.mark.parametrize(
    ("find", "name", "why"),
    [(shifted, PROBLEM, "it does not begin where the robot will be"),
     (under_way, PROBLEM, "it does not begin where the robot will be"),
     (hasty, PROBLEM, "it does not begin where the robot will be"),
     (unfinished, PROBLEM, "it does not end at rest"),
     (boasting, PROBLEM, "it does not end at a goal"),
     (renamed, PROBLEM, "it is a motion of other joints"),
     (fast, PROBLEM, "it exceeds limits, or is not proved clear of what stands still"),
     (line, BLOCKED, "it exceeds limits, or is not proved clear of what stands still"),
     (lambda ready, request: None, PROBLEM, "nothing was found")],
    ids=["shifted", "under-way", "hasty", "unfinished", "boasting", "renamed", "fast", "blocked", "nothing"],
)  # fmt: skip
def test_answers_that_do_not_fit_are_rejected_and_the_robot_stands(find: Find, name: str, why: str) -> None:
    replanner = ByHand(find)
    done, report = go(replanner, name=name, timeout=0.5)
    assert reasons(done) == {why} and stood(done) and not done.reached and done.ended == "timeout"
    assert kinds(done) == {"request", "rejected"} and len(replanner.asked) > 3
    assert report.contact is None and report.still_contact is None


def first_line_then(find: Find) -> Find:
    """The straight line at first, and then something else."""
    return lambda ready, request: line(ready, request) if request.number == 1 else find(ready, request)


@pytest.mark.parametrize("find", [shifted, under_way, boasting, lambda ready, request: 1 / 0])
def test_a_robot_that_moves_stops_where_answers_are_of_no_use(find: Find) -> None:
    box = crossing(setup_of(PROBLEM))
    done, report = go(ByHand(first_line_then(find)), box, prediction="still", speed=0.3, fastest=0.5)
    assert {"accepted", "conflict", "rejected", "stop"} <= kinds(done) and not stood(done) and not done.reached
    assert report.contact is None or not report.contact.moved
    assert report.still_contact is None and report.at_rest
    check_limits(report)


@pytest.mark.parametrize(
    ("error", "words"),
    [(ApexError("no way"), "ApexError: no way"), (ValueError("a bad number"), "ValueError: a bad number"),
     (MemoryError(), "MemoryError: ")],
)  # fmt: skip
def test_a_way_of_replanning_that_fails_is_an_event(error: Exception, words: str) -> None:
    def fail(ready: Ready, request: Request) -> Following:
        raise error

    done, _ = go(ByHand(fail), timeout=0.5)
    assert reasons(done) == {words} and stood(done) and done.ended == "timeout"


def test_something_that_is_no_answer_is_an_event() -> None:
    class Silent(ByHand):
        def replan(self, ready: Ready, request: Request, charges: Charges) -> Any:
            return None

    done, _ = go(Silent(line), timeout=0.3)
    assert stood(done) and reasons(done) == {"TypeError: NoneType is no answer"}


@pytest.mark.parametrize(("latency", "followed"), [(0.0, True), (0.05, True), (0.06, False), (0.2, False)])
def test_answers_behind_their_join_are_rejected(latency: float, followed: bool) -> None:
    replanner = ByHand(line)
    done, _ = go(replanner, latency=latency, timeout=1.5)
    assert done.reached == followed and stood(done) != followed
    assert reasons(done) == (set() if followed else {"it came too late"})
    known = [event.time for event in done.events if event.kind in ("accepted", "rejected")]
    asked = [request.asked for request in replanner.asked]
    for begin, end in zip(asked, known, strict=False):
        assert latency - 1e-9 <= end - begin <= latency + LoopSettings.period + 1e-9


def test_work_that_takes_longer_than_the_budget_comes_too_late() -> None:
    late, _ = go(ByHand(line, seconds=0.08), timeout=0.5)
    assert reasons(late) == {"it came too late"} and stood(late)
    never, _ = go(ByHand(line, seconds=99.0), timeout=0.5)
    assert stood(never) and [event.kind for event in never.events] == ["request"]


def test_a_goal_that_is_reached_ends_the_run_whatever_is_under_way() -> None:
    """A box comes to the goal behind the arrival, so that replans are asked for that never answer."""
    setup = setup_of(PROBLEM)
    palm = setup.robot.link_pose(setup.valid_goals[0], "left_hand_palm")[:3, 3]
    box = Obstacle(name="box", box=(0.1, 0.1, 0.1), position=tuple(map(float, palm + (0.0, 0.0, 1.0))),
                   velocity=(0.0, 0.0, -0.5))  # fmt: skip

    class Slow(ByHand):
        def replan(self, ready: Ready, request: Request, charges: Charges) -> Answer:
            self.seconds = 0.03 if request.number == 1 else 9.0
            return super().replan(ready, request, charges)

    replanner = Slow(line)
    done, report = go(replanner, box, fastest=0.5, hold=1.5)
    assert len(replanner.asked) > 1, "a replan is under way"
    assert done.reached and done.events[-1].kind == "goal" and report.at_goal and report.contact is None


@pytest.mark.parametrize("planner", ["no-network", "apex"])
def test_the_same_seed_gives_the_same_run(planner: str) -> None:
    one, other = (run("vertical/moving-large-0.2/800001", planner, seed=5, speed=0.5) for _ in range(2))
    assert one.events == other.events and len(one.events) > 2 and one.outcome == other.outcome
    for name in ("times", "positions", "velocities", "accelerations"):
        assert np.array_equal(getattr(one.trajectory, name), getattr(other.trajectory, name))
    assert max(one.trajectory.use(setup_of(PROBLEM).robot.limits).values()) <= 1.0 + 1e-9
