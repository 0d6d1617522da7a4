"""The wall clock: the planner in a process of its own, which fails in every way, and steps that come late."""

from __future__ import annotations

import math
import multiprocessing
import os
import pickle
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from faulty_replanners import Faulty
from loops import BLOCKED, PROBLEM, context_of, crossing, setup_of, world_of

from apex_ompl import run
from apex_ompl.errors import PlannerProcessError
from apex_ompl.loop import replanning
from apex_ompl.loop.clocks import run_in_real_time
from apex_ompl.loop.control import RunRecord
from apex_ompl.loop.cycle import Cycle
from apex_ompl.loop.environment import Observation
from apex_ompl.loop.planner_worker import rehearse
from apex_ompl.loop.referee import RefereeReport, judge
from apex_ompl.loop.replan.methods import replanner_of
from apex_ompl.loop.replanning import PlannerProcess, Work, reply_of
from apex_ompl.loop.result import INTERRUPTED, Outcome, RunResult
from apex_ompl.loop.sensor import Sensor, SensorStream
from apex_ompl.moving.compute_costs import ComputeBudget
from apex_ompl.moving.context import Following, RunContext
from apex_ompl.moving.dynamic_obstacles import DynamicObstacles, clearance_in_time
from apex_ompl.moving.replanner import Answer, Request
from apex_ompl.problems.worlds import DynamicEnvironment
from apex_ompl.timing.rests import is_at_rest


class BadEyes:
    """A sensor whose observations are doubled, out of order, late by turns, or not numbers."""

    def __init__(self, world: DynamicEnvironment) -> None:
        self._eyes = SensorStream(Sensor(), world, 0.3)

    def observations(self, until: float) -> list[Observation]:
        found: list[Observation] = []
        for k, one in enumerate(self._eyes.observations(until)):
            late = replace(one, received=one.received + 0.15)
            nowhere = tuple(o.model_copy(update={"position": (float("nan"),) * 3}) for o in one.seen)
            found += [one, one] if k % 2 else [late, one]
            found += [replace(one, seen=nowhere), replace(one, stamp=float("nan"))]
        return found[::-1]


def go(
    *faults: str, eyes: type[BadEyes] | None = None, timeout: float = 3.0
) -> tuple[RunRecord, RefereeReport, PlannerProcess]:
    context = context_of(PROBLEM, speed=0.3, prediction="still", fastest=0.5, timeout=timeout)
    world = world_of(PROBLEM, crossing(setup_of(PROBLEM)))
    work = Work(world.problem.still, context.limits, context.stopping, context.settings, Faulty, faults, 0)
    seen = SensorStream(Sensor(), world, context.settings.watched) if eyes is None else eyes(world)
    with PlannerProcess(work) as process:
        done = run_in_real_time(world, context, process, seen, seed=0)
    truth = world.problem.still
    truth = truth.model_copy(update={"scene": (*truth.scene, *world.script())})
    return done, judge(context.setup.robot, truth, done.trajectory, goals=context.goals), process


def check_defined(done: RunRecord, report: RefereeReport, process: PlannerProcess) -> None:
    """At rest, with a reason, nothing touched by a robot that moves, no process left."""
    assert done.reached or done.ended == "timeout"
    assert is_at_rest(done.trajectory, done.trajectory.duration) or not done.reached
    assert report.contact is None or not report.contact.moved
    assert report.still_contact is None and max(report.limit_use.values()) <= 1.0 + 1e-9
    assert process.process.poll() is not None
    assert done.measured["tick_p50"] > 0.0 and done.measured["deadline_misses"] >= 0.0


def test_faults_of_the_planner_end_defined() -> None:
    done, report, process = go(*["raises"] * 4, *["nonsense"] * 4, *["late"] * 2, "killed")
    check_defined(done, report, process)
    why = {event.data["why"] for event in done.events if event.kind == "rejected"}
    assert {"ValueError: a bad number", "it does not start where the robot will be", "no answer came in time"} <= why
    assert process.restarts and any(event.kind == "planner fault" for event in done.events)


def test_a_killed_planner_whose_child_lives_on_is_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(replanning, "HUNG", math.inf)  # its death alone is noticed, and not that it does not answer
    done, report, process = go("orphaned")
    check_defined(done, report, process)
    faults = [event for event in done.events if event.kind == "planner fault"]
    assert process.restarts and faults[0].data["what"] == "the planner process died"


def test_a_planner_that_never_answers_ends_defined() -> None:
    done, report, process = go("never", timeout=1.5)
    check_defined(done, report, process)
    assert "no answer came in time" in {event.data["why"] for event in done.events if event.kind == "rejected"}


def test_observations_may_be_late_doubled_out_of_order_or_no_numbers() -> None:
    check_defined(*go(eyes=BadEyes, timeout=2.0))


@pytest.mark.parametrize("where", ["advance", "step", "announce_start"])
def test_an_interrupt_stops_the_robot(where: str, monkeypatch: pytest.MonkeyPatch) -> None:
    original, left = getattr(Cycle, where), [1]

    def interrupted(loop: Cycle, now: float) -> Any:
        found = original(loop, now)
        if now >= 0.5 and left:
            left.pop()
            raise KeyboardInterrupt
        return found

    monkeypatch.setattr(Cycle, where, interrupted)
    done, report, process = go()
    assert done.ended == "aborted" and done.reason == INTERRUPTED and process.process.poll() is not None
    assert is_at_rest(done.trajectory, done.trajectory.duration) and done.trajectory.duration < 1.5
    assert report.moving_contact is None and done.unguarded == 0


def test_a_run_by_name_is_a_result(tmp_path: Path) -> None:
    found = run("vertical/moving-small-0.1/800000", "no-network", clock="real")
    assert found.clock == "real" and found.outcome in (Outcome.REACHED, Outcome.TIMEOUT, Outcome.HIT_AT_REST)
    assert {"tick_p50", "tick_p99", "tick_worst", "deadline_misses"} <= found.metrics.keys()
    found.save(tmp_path / "run.npz")
    assert RunResult.load(tmp_path / "run.npz").as_dict() == found.as_dict()


def test_a_rehearsal_asks_for_all_sorts_of_replans_and_is_forgotten() -> None:
    context, asked = context_of(PROBLEM), list[Request | str]()

    class Noting:
        def prepare(self, context: RunContext) -> None:
            asked.append("prepared")

        def replan(self, context: RunContext, request: Request, budget: ComputeBudget) -> Answer:
            asked.append(request)
            raise ValueError("a bad number")

    rehearse(Noting(), context)
    some = [one for one in asked if isinstance(one, Request)]
    assert asked[-1] == "prepared" and len(some) == len(asked) - 1
    assert {(one.following.at_rest(0.0), math.isfinite(one.conflict)) for one in some} == {
        (True, True), (True, False), (False, True), (False, False),
    }  # fmt: skip
    assert [one.hastens for one in some].count(True) == 1
    for one in some:  # the straight line is blocked
        line = next(other.following for other in some if not other.following.at_rest(0.0))
        assert math.isfinite(context.first_conflict(one.predicted, line, 0.0, line.end))
    replanner = replanner_of("apex")
    replanner.prepare(context)
    before = reply_of(replanner, context, some[2], ComputeBudget(0.05))
    rehearse(replanner, context)
    after = reply_of(replanner, context, some[2], ComputeBudget(0.05))
    assert before.answer.budget.counts == after.answer.budget.counts


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="processes are not kept to cores here")
def test_the_process_keeps_to_its_core_from_the_beginning() -> None:
    """Though it was started by a thread that keeps to another one, while the executor runs."""
    context, world, core = context_of(PROBLEM), world_of(PROBLEM), max(os.sched_getaffinity(0))
    work = Work(world.problem.still, context.limits, context.stopping, context.settings, Faulty, (), 0)
    process = PlannerProcess(work, core)
    try:
        assert os.sched_getaffinity(process.process.pid) == {core}
    finally:
        process.process.kill()
        process.close()


def test_a_process_that_cannot_be_made_ready_is_a_sentence() -> None:
    context, world = context_of(PROBLEM), world_of(PROBLEM)
    work = Work(world.problem.still, context.limits, context.stopping, context.settings, replanner_of, ("apx",), 0)
    with pytest.raises(PlannerProcessError, match="apx"), PlannerProcess(work):
        pass


def test_a_process_that_dies_while_it_is_made_ready_is_a_sentence() -> None:
    context, world = context_of(BLOCKED), world_of(BLOCKED)
    work = Work(world.problem.still, context.limits, context.stopping, context.settings, replanner_of, ("apex",), 0)
    process = PlannerProcess(work)
    process.process.kill()
    with pytest.raises(PlannerProcessError, match="died"), process:
        pass
    assert process.process.poll() is not None


@pytest.mark.parametrize("late", [0.3, 2.2])
def test_what_is_sent_late_goes_to_no_other_process(monkeypatch: pytest.MonkeyPatch, late: float) -> None:
    """The number of a connection is another's as soon as it is closed."""
    sent = []

    def slow(connection: Any, message: object) -> None:
        number = connection.fileno()
        time.sleep(late)
        with suppress(OSError):
            os.write(number, b"stale")
        sent.append(message)

    monkeypatch.setattr(replanning, "_sent", slow)
    context, world = context_of(PROBLEM), world_of(PROBLEM)
    process = PlannerProcess(
        Work(world.problem.still, context.limits, context.stopping, context.settings, Faulty, (), 0)
    )
    process.close()
    assert sent and process.process.poll() is not None
    mine, other = multiprocessing.Pipe()
    assert not mine.poll(0.1) and not other.poll(0.1)


def test_a_request_ends_what_the_process_is_busy_with() -> None:
    """The second of three requests takes its ten seconds; the third is answered at once, and ends it."""
    context, world = context_of(PROBLEM, budget=10.0), world_of(PROBLEM)
    work = Work(world.problem.still, context.limits, context.stopping, context.settings, Faulty, ("busy", ""), 0)
    standing = Following.resting(context.setup.start, 0.0, context.names)
    started, spent = time.monotonic(), []
    with PlannerProcess(work) as process:
        for number in (1, 2, 3):
            request = Request(number, 0.0, 1.0, standing, None, DynamicObstacles([]), 0.0, (), math.inf, 0)
            while not process.submit(request):  # the one before is still being sent
                assert time.monotonic() < started + 60.0
            while number != 2 and (not spent or spent[-1].number != number):
                assert time.monotonic() < started + 60.0
                reply = process.reply(0.0)
                spent += [] if reply is None else [reply]
                time.sleep(0.002)
    assert [one.number for one in spent] in ([1, 2, 3], [1, 3])
    assert all(one.answer.found is not None for one in spent) and spent[-2].answer.budget.spent < 8.0


def test_a_ready_process_imports_nothing_more() -> None:
    """An import of torch takes seconds, in which no replan is answered."""
    context, world = context_of(PROBLEM, budget=10.0), world_of(PROBLEM)
    work = Work(world.problem.still, context.limits, context.stopping, context.settings, Faulty, ("imports",), 0)
    standing = Following.resting(context.setup.start, 0.0, context.names)
    with PlannerProcess(work) as process:
        for number in (1, 2):
            assert process.submit(Request(number, 0.0, 1.0, standing, None, DynamicObstacles([]), 0.0, (), math.inf, 0))
            reply, started = None, time.monotonic()
            while reply is None and time.monotonic() < started + 60.0:
                reply = process.reply(0.0)
            assert reply is not None and reply.answer.found is not None, reply and reply.failed


def test_a_process_that_reads_nothing_holds_nobody_up() -> None:
    context, world = context_of(PROBLEM), world_of(PROBLEM)
    work = Work(world.problem.still, context.limits, context.stopping, context.settings, Faulty, ("never",), 0)
    standing = Following.resting(context.setup.start, 0.0, context.names)
    large = DynamicObstacles([]).larger(0.0)
    first = Request(1, 0.0, 0.05, standing, None, large, large, (), np.inf, 0)
    with PlannerProcess(work) as process:
        assert process.submit(first)
        while process.reply(0.0) is None:
            time.sleep(0.001)
        assert process.submit(replace(first, number=2))  # which is never answered
        time.sleep(0.1)
        heavy = replace(first, number=3, obstacles=(np.zeros(4_000_000),))  # more than a pipe holds
        assert process.submit(heavy) and not process.submit(heavy)
        assert process.reply(0.0) is None
    assert process.process.poll() is not None


def test_dynamic_obstacles_travel_between_processes() -> None:
    setup, box = setup_of(PROBLEM), crossing(setup_of(PROBLEM))
    dynamic = DynamicObstacles([box])
    dynamic.update(box.name, velocity=(0.1, 0.0, 0.0), growth=(0.01, 0.1))
    other = pickle.loads(pickle.dumps(dynamic))
    arguments: tuple[Any, ...] = setup.start[None], np.array([0.5]), 1.0
    assert np.array_equal(clearance_in_time(setup.checker.kernel, dynamic, *arguments)[0],
                          clearance_in_time(setup.checker.kernel, other, *arguments)[0])  # fmt: skip
    other.update(box.name, position=(0.0, 0.0, 5.0))  # its arrays are views again
    assert (
        clearance_in_time(setup.checker.kernel, other, *arguments)[0]
        > clearance_in_time(setup.checker.kernel, dynamic, *arguments)[0]
    )
