"""The loop step by step: steps that come too late, what is told of obstacles, and when the world sets out."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from loops import FAR, PROBLEM, ByHand, line, ready_of, world_of

from apex_ompl.errors import ParameterError
from apex_ompl.loop.cycle import Loop, RunRecord
from apex_ompl.loop.late_steps import Decided, undo
from apex_ompl.loop.replanning import AtOnce
from apex_ompl.loop.run import run
from apex_ompl.loop.sensor import Sensor, SensorStream
from apex_ompl.loop.settings import LoopSettings
from apex_ompl.scene.scripts import place_at
from apex_ompl.trajectory.rests import is_at_rest

PERIOD = LoopSettings.period


def loop_of(replanner: Any, sensor: Sensor | None = None, **parameters: Any) -> Loop:
    ready, world = ready_of(PROBLEM, **parameters), world_of(PROBLEM)
    eyes = SensorStream(sensor or Sensor(), world, ready.settings.watched)
    return Loop(world, ready, AtOnce(ready, replanner), eyes, seed=0)


def steps(loop: Loop) -> Iterator[tuple[float, Decided, RunRecord | None]]:
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
    """As on the clock on the wall, where a step is decided in the period before it."""
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
    loop = loop_of(ByHand(lambda ready, request: None), sensor, error=sensor.largest_error, timeout=1.0)
    for _ in steps(loop):
        pass
    assert loop.executor.tracker.settings.noise == pytest.approx(0.03)
    assert loop.executor.tracker.tracks["far"].seen > 30


def test_a_world_is_for_one_run() -> None:
    world = world_of(PROBLEM)
    run(world, "no-network")
    with pytest.raises(ParameterError, match="load it anew"):
        run(world, "no-network")


def test_a_sensor_that_would_have_looked_too_often_is_a_sentence() -> None:
    with pytest.raises(ParameterError, match="watched"):
        SensorStream(Sensor(rate=20_000.0), world_of(PROBLEM), 60.0)
