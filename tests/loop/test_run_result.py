"""Files of runs of the closed loop, and the metrics of runs."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from runs import motion_between, moved, run_by_hand, standing

from apex_ompl.errors import FileFormatError, MissingFileError, ParameterError
from apex_ompl.loop.metrics import failure_ratio, run_metrics
from apex_ompl.loop.result import Event, Outcome, RunResult
from apex_ompl.robot import Robot
from apex_ompl.timing.files import KNOTS
from apex_ompl.timing.rests import is_at_rest, rests
from apex_ompl.timing.trajectory import joined


@pytest.fixture(scope="module")
def run(robot: Robot) -> RunResult:
    return run_by_hand(robot)


@pytest.mark.parametrize("suffix", [".npz", ".json"])
def test_runs_are_read_as_they_were_written(run: RunResult, tmp_path: Path, suffix: str) -> None:
    file = tmp_path / f"run{suffix}"
    run.save(file)
    again = RunResult.load(file)
    assert again.as_dict() == run.as_dict() and again.problem == run.problem and again.events == run.events
    for key in KNOTS:
        assert np.array_equal(getattr(again.trajectory, key), getattr(run.trajectory, key))
    assert again.outcome is Outcome.REACHED and again and not replace(again, outcome=Outcome.STUCK)
    assert [path.name for path in tmp_path.iterdir()] == [file.name], "no temporary file stays"


def test_what_cannot_be_written_is_named_and_leaves_the_old_file(run: RunResult, tmp_path: Path) -> None:
    file = tmp_path / "run.npz"
    run.save(file)
    before = file.read_bytes()
    for change, words in (
        ({"metrics": {"clearance": float("inf")}}, "metrics: expected texts, finite numbers"),
        ({"settings": {"at": np.zeros(2)}}, "settings: expected texts"),
        ({"events": (Event(0.0, "conflict", {"at": float("nan")}),)}, "events: expected texts"),
    ):
        for name in ("run.npz", "run.json"):
            with pytest.raises(ParameterError, match=words):
                replace(run, **change).save(tmp_path / name)
    assert file.read_bytes() == before and not (tmp_path / "run.json").exists()
    with pytest.raises(ParameterError, match=r"ending in \.npz, \.json"):
        run.save(tmp_path / "run.yaml")
    with pytest.raises(ParameterError, match=r"ending in \.npz, \.json"):
        RunResult.load(tmp_path / "run.yaml")
    with pytest.raises(MissingFileError, match="does not exist"):
        run.save(tmp_path / "no" / "run.npz")


def put(*keys: Any, value: Any) -> Callable[[dict[str, Any]], None]:
    def change(data: dict[str, Any]) -> None:
        inside = data
        for key in keys[:-1]:
            inside = inside[key]
        inside[keys[-1]] = value

    return change


def without(key: str) -> Callable[[dict[str, Any]], None]:
    return lambda data: data.pop(key)


FAULTS = {
    "another schema": (put("schema", value="apex-ompl/result/2"), "schema: expected 'apex-ompl/run/1', got"),
    "a later version": (put("schema", value="apex-ompl/run/2"), "schema: expected 'apex-ompl/run/1', got"),
    "no schema": (without("schema"), "schema: expected 'apex-ompl/run/1', got None"),
    "a foreign outcome": (put("outcome", value="won"), "outcome: expected one of reached, .*, got 'won'"),
    "no seed": (without("seed"), "seed: required field is missing"),
    "no knots": (put("trajectory", value={"times": [0.0]}), "positions: required field is missing"),
    "no motion": (put("trajectory", value=None), "expected a complete saved run"),
    "a number as reason": (put("reason", value=5), "reason: expected a text, got 5"),
    "a mapping as events": (put("events", value={}), "events: expected a list"),
    "an event that is late": (put("events", 0, "time", value=99.0), "events: expected events by time"),
    "an event before 0": (put("events", 0, "time", value=-1.0), "events.0.time: expected a number, 0"),
    "NaN in an event": (put("events", 0, "data", value={"a": float("nan")}), "events: expected texts, finite"),
    "an event without a kind": (put("events", 0, value={"time": 0.0, "data": {}}), "kind: required field"),
    "NaN as metric": (put("metrics", "stops", value=float("nan")), "metrics: expected texts, finite"),
    "text as metric": (put("metrics", "stops", value="two"), "metrics.stops: expected finite numbers, got 'two'"),
    "NaN in the motion": (put("trajectory", "positions", 1, 0, value=float("nan")), "positions: expected finite"),
    "times that stand": (put("trajectory", "times", 1, value=0.0), "times: expected times that start at 0"),
    "another start": (put("problem_file", "start", "left_joint1", value=0.9), "a motion from the problem's start"),
    "unknown joints": (put("joint_names", 0, value="elbow"), "start: unknown joint"),
    "a negative seed": (put("seed", value=-1), "seed: expected a whole number"),
}


@pytest.mark.parametrize(("change", "words"), FAULTS.values(), ids=FAULTS)
def test_files_that_are_not_runs_are_refused(
    run: RunResult, tmp_path: Path, change: Callable[[dict[str, Any]], None], words: str
) -> None:
    data = json.loads(json.dumps(run.as_dict()))
    file = tmp_path / "changed.json"
    file.write_text(json.dumps(data))
    assert RunResult.load(file)
    change(data)
    file.write_text(json.dumps(data))
    with pytest.raises(FileFormatError, match=words) as caught:
        RunResult.load(file)
    assert "changed.json" in str(caught.value) and "\n" not in str(caught.value)


def test_archives_of_something_else_are_refused(run: RunResult, tmp_path: Path) -> None:
    (tmp_path / "broken.npz").write_bytes(b"PK")
    np.savez(tmp_path / "other.npz", path=np.zeros(3))
    run.save(tmp_path / "run.npz")
    with np.load(tmp_path / "run.npz") as archive:
        kept = {name: archive[name] for name in archive.files if name != "accelerations"}
    np.savez(tmp_path / "half.npz", **kept)
    shutil.copy(tmp_path / "run.npz", tmp_path / "short.npz")
    with (tmp_path / "short.npz").open("r+b") as file:
        file.truncate(2000)
    for name, words in (("broken", "saved"), ("other", "saved"), ("half", "accelerations"), ("short", "saved")):
        with pytest.raises(FileFormatError, match=words) as caught:
            RunResult.load(tmp_path / f"{name}.npz")
        assert f"{name}.npz" in str(caught.value)
    with pytest.raises(MissingFileError, match=r"gone\.npz"):
        RunResult.load(tmp_path / "gone.npz")


def test_rests_are_where_a_motion_stands(robot: Robot) -> None:
    a, b, c = robot.home, moved(robot, left_joint1=-0.3), moved(robot, left_joint1=-0.6)
    parts = [motion_between(robot, a, b), standing(robot, b, 0.4), motion_between(robot, b, c, a)]
    motion = joined(parts)
    turn = parts[0].duration + 0.4 + motion_between(robot, b, c).duration
    begin = parts[0].duration
    wanted = [[0.0, 0.0], [begin, begin + 0.4], [turn, turn], [motion.duration] * 2]
    np.testing.assert_allclose(rests(motion), wanted, atol=1e-9)
    for time in np.linspace(0.0, motion.duration, 401):
        inside = any(low <= time <= high for low, high in rests(motion))
        assert is_at_rest(motion, time) == inside or not (np.abs(motion(time, 1)) > 1e-4).any()
    assert rests(standing(robot, a, 2.0)).tolist() == [[0.0, 2.0]]


def test_metrics_come_from_events_and_motion(run: RunResult, robot: Robot) -> None:
    found, motion = run.metrics, run.trajectory
    assert found["time_to_goal"] == found["duration"] == motion.duration
    assert found["rest_time"] == pytest.approx(0.5) and found["stops"] == 1.0
    assert (found["replans_asked"], found["replans_accepted"], found["replans_rejected"]) == (2.0, 1.0, 1.0)
    assert found["reaction_p50"] == pytest.approx(0.02) and found["reaction_p95"] == pytest.approx(0.029)
    assert found["near_reaction_p95"] == 0.01, "of a robot on its way"
    assert found["clearance"] == 0.123 and found["jerk"] == motion.jerk
    assert found["spectral_arc_length"] == motion.spectral_arc_length < 0.0
    assert found["limit_use"] == max(motion.use(robot.limits).values()) and found["velocity_use"] <= 0.4 + 1e-9
    none = run_metrics(motion, [], robot.limits)
    assert not {"time_to_goal", "clearance", "reaction_p50"} & none.keys()
    assert none["stops"] == 2.0, "where the goal was not reached, the end is a stop"
    with pytest.raises(ParameterError, match=r"reaction\.seconds"):
        run_metrics(motion, [Event(0.0, "reaction", {})], robot.limits)


def test_standing_at_the_beginning_and_at_the_goal_is_no_stop(robot: Robot) -> None:
    a, b = robot.home, moved(robot, left_joint1=-0.3)
    motion = joined([standing(robot, a, 0.3), motion_between(robot, a, b), standing(robot, b, 0.7)])
    goal = [Event(motion.duration - 0.6, "goal")]
    found = run_metrics(motion, goal, robot.limits)
    assert found["stops"] == 0.0 and found["rest_time"] == pytest.approx(0.3)
    assert found["time_to_goal"] == pytest.approx(motion.duration - 0.6)


def test_the_failure_ratio_is_split_by_outcome(run: RunResult) -> None:
    outcomes = [Outcome.REACHED] * 95 + [Outcome.TIMEOUT] * 3 + [Outcome.HIT_AT_REST] * 2
    found = failure_ratio([replace(run, outcome=outcome) for outcome in outcomes])
    assert (found.failed, found.total, found.ratio) == (5, 100, 0.05)
    assert found.by_outcome == {Outcome.REACHED: 95, Outcome.TIMEOUT: 3, Outcome.HIT_AT_REST: 2}
    assert found.low == pytest.approx(0.0215, abs=1e-4) and found.high == pytest.approx(0.1118, abs=1e-4)
    assert str(found) == "5.0 % of 100 (95 %: 2.2 to 11.2 %): 95 reached, 3 timeout, 2 hit-at-rest"
    none = failure_ratio([Outcome.REACHED] * 3)
    assert none.low == 0.0 and 0.0 < none.high < 1.0
    with pytest.raises(ParameterError, match="one run or more"):
        failure_ratio([])
