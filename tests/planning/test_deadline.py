"""The time of a plan: what counts, what is kept for the proof, and what a result says when it runs out."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import bad_planners
import numpy as np
import pytest
from ompl import base as ob

from apex_ompl import planners
from apex_ompl.api import load_problem, plan
from apex_ompl.errors import TimingStoppedError
from apex_ompl.evaluation import runs
from apex_ompl.evaluation.rows import Job
from apex_ompl.ompl.process import ends_after
from apex_ompl.ompl.repair import repair, simplify
from apex_ompl.ompl.setup import PlanningSetup, assemble
from apex_ompl.ompl.space import to_state
from apex_ompl.ompl.validity import FullCheck, full_check, motions_until
from apex_ompl.paths.path import SEARCH_RESOLUTION, Path
from apex_ompl.planning import FoundPath, PlanQuery, ProvedPath, check, prove, solve, steps
from apex_ompl.planning import time as time_step
from apex_ompl.planning.steps import NOT_PROVED, NOT_TIMED, straight_line
from apex_ompl.result import PlanResult, PlanStatus
from apex_ompl.timing import Timing, time_path
from apex_ompl.util.clocks import Deadline

pytestmark = pytest.mark.usefixtures("quiet")

PROBLEM = "reach_past_post"
LIMIT = 1.5
NOT_REPAIRED = "the path found failed the full check and was not repaired in time, on purpose"


class Clock:
    """Stands still until it is moved."""

    now = 100.0


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(time, "perf_counter", lambda: made.now)
    return made


@pytest.fixture
def ready() -> PlanningSetup:
    made = assemble(load_problem(PROBLEM))
    setup = made.simple_setup
    setup.setPlanner(planners.make("rrtconnect", setup.getSpaceInformation()))
    setup.setup()  # or there is no simplifier
    return made


@pytest.fixture(scope="module")
def found() -> PlanResult:
    result = plan(PROBLEM, "rrtconnect", timeout=20.0, seed=3, simplify=False, objective="length")
    assert result and result.path is not None and len(result.path) > 2
    return result


def query_of(ready: PlanningSetup, timeout: float = 20.0, planner: str = "rrtconnect") -> PlanQuery:
    return check(ready, planner, timeout=timeout)


def exact(query: PlanQuery, found: PlanResult) -> FoundPath:
    return FoundPath(query, PlanStatus.EXACT_SOLUTION, "", found.path, "x")


def states_of(found: PlanResult) -> np.ndarray:
    assert found.path is not None
    return found.path.states


@pytest.mark.parametrize(("timeout", "reserve"), [(0.05, 0.025), (0.1, 0.05), (0.4, 0.05), (2.0, 0.2), (60.0, 0.5)])
def test_a_part_of_the_time_is_kept_for_the_proof(timeout: float, reserve: float, clock: Clock) -> None:
    deadline = Deadline(timeout)
    assert deadline.reserve == pytest.approx(reserve) and deadline.for_search == pytest.approx(timeout - reserve)
    clock.now += timeout - 0.5 * reserve
    assert deadline.for_search == 0.0 and deadline.remaining == pytest.approx(0.5 * reserve) and not deadline.expired
    clock.now += reserve
    assert deadline.remaining == 0.0 and deadline.expired


def test_some_blocks_do_not_count(clock: Clock) -> None:
    deadline = Deadline(1.0)
    with pytest.raises(ValueError, match="ends"), deadline.paused():
        clock.now += 10.0
        raise ValueError("ends")
    assert deadline.remaining == pytest.approx(1.0)
    clock.now += 2.0
    with deadline.paused():
        clock.now += 1.0
    assert deadline.expired and deadline.at == pytest.approx(clock.now - 1.0), "a pause gives no time back"
    deadline.restart(0.25)
    assert deadline.remaining == pytest.approx(0.25)


@pytest.mark.parametrize("seconds", [-1.0, 0.0, 1e300])
def test_ompl_gets_times_that_it_can_count(seconds: float) -> None:
    assert bool(ends_after(seconds)()) == (seconds <= 0.0)


def test_what_comes_late_has_no_time(ready: PlanningSetup) -> None:
    for find in (straight_line, solve, lambda query: solve(query, lines=False)):
        query = query_of(ready)
        query.deadline.restart(0.0)
        result = find(query)
        assert result is not None and result.status is PlanStatus.TIMEOUT and result.reason == "no path in 20 s"
        assert "setup" not in query.times, "no planner is built"


def test_a_straight_line_that_is_not_proved_in_time(monkeypatch: pytest.MonkeyPatch) -> None:
    late = FullCheck(False, "not proved in time", None, timed_out=True)
    monkeypatch.setattr(steps, "full_check", lambda *_, **__: late)
    line = load_problem(PROBLEM)
    near = dict(line.start, left_joint1=line.start["left_joint1"] + 0.01)
    goal = line.goal.model_copy(update={"joints": (near,)})
    result = straight_line(query_of(assemble(line.model_copy(update={"goal": goal}))))
    assert result is not None and (result.status, result.reason) == (PlanStatus.TIMEOUT, NOT_PROVED)


def test_an_expired_proof_is_none(ready: PlanningSetup, found: PlanResult) -> None:
    ends = ready.start, ready.goals
    check = full_check(ready.checker, states_of(found), *ends, deadline=time.perf_counter())
    assert not check and check.timed_out and check.reason == "not proved in time"
    check = full_check(ready.checker, states_of(found), *ends, deadline=time.perf_counter() + 20.0)
    assert check and not check.timed_out


@pytest.mark.parametrize("shorten", [True, False])
def test_a_planner_that_ignores_its_time(shorten: bool, ready: PlanningSetup) -> None:
    def ignores(query: PlanQuery, planner: ob.Planner, timeout: float) -> PlanStatus:
        status = steps.execute(query, planner, timeout)
        query.deadline.restart(-1.0)
        return status

    result = prove(solve(query_of(ready), lines=False, execute=ignores), shorten)
    assert (result.status, result.reason, result.path) == (PlanStatus.TIMEOUT, NOT_PROVED, None)


@pytest.mark.parametrize(("timeout", "looks"), [(0.01, 1), (0.1, 1), (0.45, 4), (0.9, 9), (9.5, 95)])
def test_ompls_benchmark_is_asked_to_end_before_the_reserve(timeout: float, looks: int) -> None:
    """It looks at the clock every 0.1 s, a little late: the first look after the time asked for is the last."""
    asked = runs.request_time(timeout)
    assert 0.1 * (looks - 1) < asked < 0.1 * looks <= max(timeout, 0.1) + 1e-9


@pytest.mark.parametrize("how", ["plan", "row"])
def test_a_planner_of_its_own_that_ignores_its_time(how: str) -> None:
    assert bad_planners.DeafParameters() == planners.parameters("deaf")
    if how == "plan":
        result = plan(PROBLEM, "deaf", timeout=LIMIT)
        status, reason, took = result.status, result.reason, result.times["solve"]
    else:
        made = runs.run(Job("x", PROBLEM, "deaf", "deaf", {}, 0, LIMIT, True))
        status, reason, took = made["status"], made["reason"], made["total"]
        assert not made["solved"] and made["properties"]["solved BOOLEAN"] == "1"
    assert (status, reason) == (PlanStatus.TIMEOUT, NOT_PROVED) and took > LIMIT


def test_a_repair_without_time_says_so(
    ready: PlanningSetup, found: PlanResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    query, ends = query_of(ready), list[float]()

    def fails(*args: Any) -> None:
        ends.append(args[3] - time.perf_counter())
        if spend:
            query.deadline.restart(-1.0)
            monkeypatch.setattr(time, "perf_counter", lambda: args[3])

    monkeypatch.setattr(steps, "full_check", lambda *_, **__: FullCheck(False, "on purpose", 0))
    monkeypatch.setattr(steps, "repair", fails)
    spend = False
    result = prove(exact(query, found))
    assert result.reason == "the path found failed the full check and repair, on purpose"
    assert len(ends) == 2 and all(8.0 < end <= 10.0 for end in ends), "half of what is left for each"
    spend = True
    result = prove(exact(query, found), False)
    assert (result.status, result.reason) == (PlanStatus.TIMEOUT, NOT_REPAIRED)


def test_repair_ends_in_time(ready: PlanningSetup) -> None:
    line = np.stack([ready.start, ready.goals[0]])
    fault = full_check(ready.checker, line, ready.start, ready.goals)
    assert not fault and repair(ready, line, fault, time.perf_counter()) is None
    mended = repair(ready, line, fault, time.perf_counter() + 1e300)
    assert mended is not None and full_check(ready.checker, mended[0].states, ready.start, ready.goals)


def test_the_path_as_it_was_found_has_its_turn(
    ready: PlanningSetup, found: PlanResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    def check(checker: object, path: np.ndarray, *args: object, **options: object) -> FullCheck:
        if np.array_equal(path, states_of(found)):
            return full_check(checker, path, *args, **options)  # type: ignore[arg-type]
        return FullCheck(False, "on purpose", 0)

    monkeypatch.setattr(steps, "full_check", check)
    monkeypatch.setattr(steps, "repair", lambda *_: None)
    result = prove(exact(query_of(ready), found))
    assert result and result.path is not None and np.array_equal(result.path.states, states_of(found))


def test_without_time_nothing_is_shortened(
    ready: PlanningSetup, found: PlanResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    query = query_of(ready)
    query.deadline.restart(0.5 * query.deadline.reserve)
    monkeypatch.setattr(steps, "shorten", lambda *_: pytest.fail("it was shortened"))
    result = prove(exact(query, found))
    assert result and result.path is not None and np.array_equal(result.path.states, states_of(found))


def counting(limit: int) -> Callable[[], bool]:
    """Hold from some call on."""
    calls = iter(range(limit))
    return lambda: next(calls, None) is None


def test_motions_end_with_the_time_and_begin_again(ready: PlanningSetup) -> None:
    validator, state = ready.motion_validator, to_state(ready.simple_setup.getSpaceInformation(), ready.start)
    with motions_until(validator, lambda: False):
        with pytest.raises(ValueError, match="ends"), motions_until(validator, counting(2)):
            assert [validator.checkMotion(state, state) for _ in range(4)] == [True, True, False, False]
            raise ValueError("ends")
        assert validator.checkMotion(state, state)
    with motions_until(validator, lambda: True), motions_until(validator, lambda: False):
        assert not validator.checkMotion(state, state), "the outer end counts, too"


def test_shortening_ends_in_time(ready: PlanningSetup, found: PlanResult) -> None:
    si, validator = ready.simple_setup.getSpaceInformation(), ready.motion_validator
    check, asked = validator.check, list[bool]()

    def counted(a: np.ndarray, b: np.ndarray) -> bool:
        asked.append(True)
        return check(a, b)

    validator.check = counted
    whole = simplify(si, states_of(found))
    all_motions = len(asked)
    asked.clear()
    short = simplify(si, states_of(found), counting(4))
    assert len(asked) <= 3 < all_motions and Path(whole).length < found.length
    assert ready.checker.first_collision(short, SEARCH_RESOLUTION) is None
    assert np.array_equal(short[[0, -1]], states_of(found)[[0, -1]])


def test_a_path_that_is_not_timed_in_time(
    ready: PlanningSetup, found: PlanResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    query = query_of(ready)
    query.deadline.restart(0.0)
    result = time_step(ProvedPath(query, PlanStatus.EXACT_SOLUTION, "", found.path))
    assert (result.status, result.reason) == (PlanStatus.TIMEOUT, NOT_TIMED)
    assert np.array_equal(states_of(result), states_of(found))
    assert result.trajectory is None and query.times["timing"] >= 0.0

    def ends(checker: object, motion: object, *ends: object, deadline: float, constraints: object) -> FullCheck:
        assert deadline == query.deadline.at and constraints is None
        query.deadline.restart(0.0)
        return FullCheck(False, "not proved in time", None, timed_out=True)

    query = query_of(ready)
    monkeypatch.setattr(steps, "full_check", ends)
    result = time_step(ProvedPath(query, PlanStatus.EXACT_SOLUTION, "", found.path))
    assert (result.status, result.reason) == (PlanStatus.TIMEOUT, NOT_TIMED)


@pytest.mark.parametrize("timing", [Timing(), Timing(start_velocity=(0.1,) * 16)])
def test_timing_ends_wherever_it_is_told(timing: Timing, found: PlanResult, ready: PlanningSetup) -> None:
    limits, names = ready.robot.limits, ready.robot.joint_names

    asked = 0
    for asked in (*range(10), *(round(10 * 1.3**k) for k in range(1, 40))):
        calls = counting(asked)
        try:
            made = time_path(states_of(found), limits, names, timing, stop=calls)
        except TimingStoppedError:
            continue
        whole = time_path(states_of(found), limits, names, timing)
        assert made.trajectory.duration == pytest.approx(whole.trajectory.duration)
        break
    assert asked > 5
    with pytest.raises(TimingStoppedError, match="on purpose"):
        time_path(states_of(found), limits, names, timing, lambda _: "on purpose", stop=counting(asked))


def test_a_tiny_time_ends_in_time_with_its_reason() -> None:
    for planner in ("apex", "rrtconnect", "rrtconnect+polish", "bitstar"):
        for timeout in (1e-9, 0.002):
            result = plan("shelf/hard/800012", planner, timeout=timeout)
            assert result.status is PlanStatus.TIMEOUT and result.reason and result.trajectory is None
