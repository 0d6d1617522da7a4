"""The loop step by step: steps that come too late, what is told of obstacles, and when the world sets out."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from loops import FAR, PROBLEM, ByHand, context_of, line, world_of

from apex_ompl import run
from apex_ompl.errors import ParameterError
from apex_ompl.loop.clocks import simulate
from apex_ompl.loop.control import Decided, RunRecord, undo
from apex_ompl.loop.cycle import Cycle
from apex_ompl.loop.environment import Observation
from apex_ompl.loop.replanning import ImmediateReplanning
from apex_ompl.loop.result import INTERRUPTED
from apex_ompl.loop.sensor import Sensor, SensorStream
from apex_ompl.moving.settings import LoopSettings
from apex_ompl.problems import worlds
from apex_ompl.scene.scripts import place_at
from apex_ompl.timing.rests import is_at_rest

PERIOD, NAN = LoopSettings.period, float("nan")


def loop_of(replanner: Any, sensor: Sensor | None = None, **parameters: Any) -> Cycle:
    context, world = context_of(PROBLEM, **parameters), world_of(PROBLEM)
    eyes = SensorStream(sensor or Sensor(), world, context.settings.watched)
    return Cycle(world, context, ImmediateReplanning(context, replanner), eyes, seed=0)


def steps(loop: Cycle) -> Iterator[tuple[float, Decided, RunRecord | None]]:
    """The time of each step, what had been decided before it, and what came of the run."""
    for k in range(2000):
        before = Decided.of(loop.executor)
        loop.advance(k * PERIOD)
        loop.observe(k * PERIOD)
        ended = loop.step(k * PERIOD)
        yield k * PERIOD, before, ended
        if ended is not None:
            return


BLIND = {"guarded": False, "monitored": False, "prediction": "still"}


@pytest.mark.parametrize("settings", [{}, BLIND])
def test_a_motion_that_was_taken_too_late_is_asked_for_again(settings: dict[str, Any]) -> None:
    loop, undone = loop_of(ByHand(line), **settings), 0
    executor = loop.executor
    for time, before, ended in steps(loop):  # noqa: B007 - the last one is looked at behind
        if executor.route is not None and not undone:
            undo(executor, time, before)
            assert executor.route is None and executor.following is before.following and executor.stop is before.stop
            undone += 1
    assert undone and ended is not None and ended.reached
    kinds = [event.kind for event in ended.events]
    assert kinds == ["request", "rejected", "late", "request", "accepted", "goal"]
    assert "too late" in ended.events[1].data["why"] and ended.events[1].data["number"] == 1


def test_a_stop_at_the_end_that_came_too_late_is_made_at_the_next_step() -> None:
    loop = loop_of(ByHand(line), **BLIND, timeout=0.3)
    for time, before, ended in steps(loop):  # noqa: B007 - the last one is looked at behind
        if time == pytest.approx(0.3):
            assert "stop" in [event.kind for event in loop.executor.events]
            undo(loop.executor, time, before)
            assert loop.executor.following.to_goal
    assert ended is not None and not ended.reached and ended.ended == "timeout"
    assert is_at_rest(ended.trajectory, ended.trajectory.duration) and ended.trajectory.duration < 0.8
    assert [event.kind for event in ended.events].count("stop") == 1


def test_an_answer_under_way_survives_a_late_step_that_changed_nothing() -> None:
    replanner = ByHand(line, seconds=0.04)
    loop = loop_of(replanner)
    for time, before, ended in steps(loop):  # noqa: B007 - the last one is looked at behind
        if time == pytest.approx(0.02):
            undo(loop.executor, time, before)
    assert ended is not None and ended.reached and len(replanner.asked) == 1


def test_what_is_true_is_told_as_it_is_when_the_step_is_decided_for_a_later_time() -> None:
    """As on the wall clock, where a step is decided in the period before it."""
    replanner = ByHand(line)
    loop = loop_of(replanner, prediction="truth", guarded=False)
    loop.advance(0.0)
    loop.observe(0.0)
    loop.step(0.1)
    asked = replanner.asked[0]
    for time in (0.1, 0.5):
        np.testing.assert_allclose(asked.predicted.at(time)["far"], place_at(FAR, time), atol=1e-12)
    np.testing.assert_allclose(asked.obstacles[0].position, place_at(FAR, 0.1), atol=1e-12)


def test_obstacles_that_count_as_standing_are_told_without_a_velocity() -> None:
    for prediction in ("still", "cv"):
        replanner = ByHand(line)
        for _ in steps(loop_of(replanner, prediction=prediction)):
            pass
        assert any(replanner.asked[0].obstacles[0].velocity) == (prediction == "cv")


def test_the_filter_knows_how_much_a_sensor_errs() -> None:
    """With the noise of the default sensor it would take most of the errors of this one for turns, and begin anew."""
    sensor = Sensor(noise=0.03)
    loop = loop_of(ByHand(lambda context, request: None), sensor, error=sensor.largest_error, timeout=1.0)
    for _ in steps(loop):
        pass
    assert loop.executor.tracker.settings.noise == pytest.approx(0.03)
    assert loop.executor.tracker.tracks["far"].seen > 30


def test_a_world_is_for_one_run() -> None:
    world = world_of(PROBLEM)
    run(world, "no-network")
    with pytest.raises(ParameterError, match="load it again"):
        run(world, "no-network")


def test_a_sensor_that_would_have_looked_too_often_is_a_sentence() -> None:
    with pytest.raises(ParameterError, match="watched"):
        SensorStream(Sensor(rate=20_000.0), world_of(PROBLEM), 60.0)


class Changed:
    """A sensor whose looks are changed by a function of their number, from the first on."""

    def __init__(self, change: Callable[[int, Observation], Observation]) -> None:
        self._eyes, self._change, self._count = SensorStream(Sensor(), world_of(PROBLEM, NEAR), 0.3), change, 0

    def observations(self, until: float) -> list[Observation]:
        found = [self._change(self._count + k, one) for k, one in enumerate(self._eyes.observations(until))]
        self._count += len(found)
        return found


NEAR = FAR.model_copy(update={"name": "near", "position": (1.2, 0.0, 1.2)})
WATCHED = 10  # looks before the run


def seen_by(eyes: Any, **parameters: Any) -> RunRecord:
    """A run with a sensor made by hand."""
    context, world = context_of(PROBLEM, **{"timeout": 1.0, **parameters}), world_of(PROBLEM, NEAR)
    return simulate(world, context, ByHand(line), eyes, seed=0)


def nowhere(k: int, one: Observation) -> Observation:
    return replace(one, seen=tuple(o.model_copy(update={"position": (NAN,) * 3}) for o in one.seen))


def test_a_robot_does_not_start_before_it_has_seen_what_is_there() -> None:
    assert seen_by(Changed(lambda k, one: one)).reached
    for change, words in (
        (nowhere, "observations were refused, the last one since the place of near is not finite"),
        (lambda k, one: replace(one, seen=()), "never seen: near"),
    ):
        done = seen_by(Changed(change))
        assert not done.reached and (done.trajectory.positions == done.trajectory.positions[0]).all()
        assert words in done.reason and done.ended == "timeout"
    assert seen_by(Changed(nowhere)).refused > 30


def test_a_look_of_the_future_does_not_block_the_later_ones() -> None:
    ahead = Changed(lambda k, one: replace(one, stamp=one.stamp + 5.0) if k < WATCHED else one)
    done = seen_by(ahead, timeout=3.0)
    assert done.reached and done.refused == WATCHED
    assert "in the future" in next(e for e in done.events if e.kind == "observation refused").data["why"]


def test_a_robot_stops_where_there_is_no_look_of_use_for_too_long() -> None:
    """As when a camera is unplugged under way."""
    silent = Changed(lambda k, one: nowhere(k, one) if k > WATCHED + 3 else one)
    done = seen_by(silent, silence=0.2, timeout=2.0)
    assert not done.reached and "no observation was usable in the end" in done.reason
    blind = next(event for event in done.events if event.kind == "blind")
    assert blind.time - blind.data["last"] == pytest.approx(0.2, abs=0.02)
    assert is_at_rest(done.trajectory, blind.time + 0.5) and not is_at_rest(done.trajectory, blind.time)


def test_one_place_far_away_is_doubted_and_does_not_count() -> None:
    far = {"position": (1e9, 0.0, 0.0)}
    jumps = Changed(
        lambda k, one: replace(one, seen=tuple(o.model_copy(update=far) for o in one.seen)) if k == WATCHED + 4 else one
    )
    done = seen_by(jumps, timeout=3.0)
    assert done.reached and done.doubted == 1 and done.broken == 0
    assert "near was 1e+09 m away" in next(e for e in done.events if e.kind == "place doubted").data["why"]


@pytest.mark.parametrize("step", [0, 30, 60])
def test_a_sensor_that_fails_ends_the_run_at_rest_with_what_was_done_so_far(step: int) -> None:
    class Failing(Changed):
        def observations(self, until: float) -> list[Observation]:
            if until >= step * PERIOD - 1e-9:
                raise OSError("no camera")
            return super().observations(until)

    done = seen_by(Failing(lambda k, one: one), timeout=3.0)
    assert done.ended == "aborted" and done.reason == "the sensor failed, OSError: no camera"
    motion = done.trajectory
    assert is_at_rest(motion, motion.duration) and step * PERIOD - 1e-9 <= motion.duration < step * PERIOD + 0.6


@pytest.mark.parametrize("where", ["advance", "observe", "step", "announce_start"])
def test_an_interrupt_stops_the_robot_and_returns_what_was_done_so_far(
    where: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever of a step was done, it is undone; the next interrupt is raised."""
    original = getattr(Cycle, where)
    for count in (1, 2):
        left = [count]

        def interrupted(loop: Cycle, now: float, left: list[int] = left) -> Any:
            found = original(loop, now)
            if now >= 0.4 and left[0]:
                left[0] -= 1
                raise KeyboardInterrupt
            return found

        monkeypatch.setattr(Cycle, where, interrupted)
        eyes = Changed(lambda k, one: one)
        if count == 2:
            with pytest.raises(KeyboardInterrupt):
                seen_by(eyes, timeout=3.0)
            continue
        done = seen_by(eyes, timeout=3.0)
        motion = done.trajectory
        assert done.ended == "aborted" and done.reason == INTERRUPTED and done.unguarded == 0
        assert is_at_rest(motion, motion.duration) and 0.4 < motion.duration < 1.0 and not is_at_rest(motion, 0.39)


def test_assumptions_are_those_of_the_world_and_the_sensor_unless_they_are_given() -> None:
    world = worlds.load("vertical/moving-large-0.2/800001")
    for settings, assumed in (
        (None, (0.03, 0.2)), (LoopSettings(timeout=0.5), (0.03, 0.2)),
        (LoopSettings(fastest=0.7, timeout=0.5), (0.03, 0.7)),
        (LoopSettings(error=0.1, timeout=0.5), (0.1, 0.2)),
    ):  # fmt: skip
        found = run(world.name, "blind", settings=settings, sensor=Sensor(noise=0.01)).settings["loop"]
        assert (found["error"], found["fastest"]) == pytest.approx(assumed, rel=1e-4)
    with pytest.raises(ParameterError, match="completed"):
        _ = LoopSettings().assumed
