"""Results of plans and their files."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import ROOT

from apex_ompl import PlanResult, Timing, plan
from apex_ompl.errors import FileFormatError, MissingFileError, ParameterError
from apex_ompl.scene.problem import Problem

BAXTER = ROOT / "examples" / "baxter_table.yaml"


def test_results_are_saved_in_every_format(problem: Problem, tmp_path: Path) -> None:
    import yaml

    result = plan(problem, timeout=20.0, timing=Timing(method="spline"))
    assert result.path is not None
    for suffix in (".npz", ".json", ".yaml", ".csv"):
        result.save(tmp_path / f"r{suffix}")
    with np.load(tmp_path / "r.npz") as data:
        assert np.array_equal(data["path"], result.path)
        assert list(data["joint_names"]) == list(result.joint_names)
        assert json.loads(str(data["result"]))["status"] == "EXACT_SOLUTION"
    for suffix in (".npz", ".json", ".yaml"):
        again = PlanResult.load(tmp_path / f"r{suffix}")
        assert again.as_dict() == result.as_dict() and again.problem == problem
    with pytest.raises(ParameterError, match=r"\.npz, \.json, \.yaml"):
        PlanResult.load(tmp_path / "r.csv")
    for name, content in (("broken.npz", b"PK"), ("other.json", b"{}"), ("half.yaml", b"schema: apex-ompl/result/2")):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(FileFormatError, match=name):
            PlanResult.load(tmp_path / name)
    data = json.loads((tmp_path / "r.json").read_text())
    for change in ({"path": [[1.0, 2.0], [3.0, 4.0]]}, {"trajectory": {"times": None}}, {"limit_use": None}):
        (tmp_path / "changed.json").write_text(json.dumps(data | change))
        with pytest.raises(FileFormatError, match="changed.json"):
            PlanResult.load(tmp_path / "changed.json")
    with pytest.raises(MissingFileError, match="gone.npz"):
        PlanResult.load(tmp_path / "gone.npz")
    assert np.array_equal(np.array(json.loads((tmp_path / "r.json").read_text())["path"]), result.path)
    assert np.array_equal(np.array(yaml.safe_load((tmp_path / "r.yaml").read_text())["path"]), result.path)
    replace(result, trajectory=None).save(tmp_path / "r.csv")
    lines = (tmp_path / "r.csv").read_text().splitlines()
    assert lines[0].split(",") == list(result.joint_names)
    assert np.array_equal(np.array([[float(v) for v in line.split(",")] for line in lines[1:]]), result.path)
    with pytest.raises(ParameterError, match=r"\.npz, \.csv, \.json, \.yaml"):
        result.save(tmp_path / "r.txt")
    with pytest.raises(ParameterError, match="a result with a path"):
        replace(result, path=None, trajectory=None).save(tmp_path / "none.csv")
    with pytest.raises(ParameterError, match="a result with a timed motion"):
        replace(result, trajectory=None).save(tmp_path / "none.traj.yaml")
    assert not list(tmp_path.glob("none*"))


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The content of the file of a timed result."""
    file = tmp_path_factory.mktemp("results") / "r.json"
    result = plan("shelf/easy/800000", planner="rrtconnect", timeout=20.0, timing=Timing(method="spline"))
    assert result
    result.save(file)
    return json.loads(file.read_text())


def put(*keys: Any, value: Any) -> Callable[[dict[str, Any]], None]:
    """Return a function that replaces a value inside a result."""

    def change(data: dict[str, Any]) -> None:
        inside = data
        for key in keys[:-1]:
            inside = inside[key]
        inside[keys[-1]] = value

    return change


FAULTS = {
    "NaN in the path": (put("path", 1, 0, value=float("nan")), "path: expected finite numbers, got nan"),
    "beyond a limit": (put("path", 1, 0, value=9.0), "path: expected states inside the limits, got 'left_joint1 = 9"),
    "another start": (put("path", 0, 1, value=0.1), "path: expected states that include the problem's start"),
    "another goal": (put("path", -1, 1, value=0.1), "path: expected states that include the problem's goal"),
    "a foreign status": (put("status", value="SOLVED"), "status: expected one of UNKNOWN, .*, got 'SOLVED'"),
    "a number as status": (put("status", value=5), "status: expected one of UNKNOWN, .*, got 5"),
    "no solution, yet a motion": (
        put("status", value="TIMEOUT"),
        "trajectory: expected none, as the status is TIMEOUT",
    ),
    "a solution without a path": (put("path", value=None), "path: expected a path, as the status is EXACT_SOLUTION"),
    "NaN in the motion": (
        put("trajectory", "positions", 1, 0, value=float("nan")),
        "positions: expected finite numbers",
    ),
    "time that stands still": (put("trajectory", "times", 1, value=0.0), "times: expected times that start at 0"),
    "another unit of speed": (put("trajectory", "velocities", 1, 0, value=90.0), "expected constant jerk"),
    "NaN as length": (put("length", value=float("nan")), "length: expected finite numbers, got nan"),
    "text as time": (put("times", "total", value="soon"), "times.total: expected finite numbers, got 'soon'"),
    "a list as times": (put("times", value=[1.0]), "expected a complete saved result"),
    "unknown joints": (put("joint_names", 0, value="elbow"), "start: unknown joint"),
}


@pytest.mark.parametrize(("change", "words"), FAULTS.values(), ids=FAULTS)
def test_results_that_contradict_themselves_are_refused(
    saved: dict[str, Any], tmp_path: Path, change: Callable[[dict[str, Any]], None], words: str
) -> None:
    data = json.loads(json.dumps(saved))
    file = tmp_path / "changed.json"
    file.write_text(json.dumps(data))
    assert PlanResult.load(file)
    change(data)
    file.write_text(json.dumps(data))
    with pytest.raises(FileFormatError, match=words) as caught:
        PlanResult.load(file)
    assert "changed.json" in str(caught.value)


@pytest.mark.parametrize("name", ["pipe.npz", "pipe.json"])
def test_pipes_are_refused_where_a_result_is_expected(tmp_path: Path, name: str) -> None:
    os.mkfifo(tmp_path / name)
    with pytest.raises(MissingFileError, match="is a pipe or a device, expected a regular file"):
        PlanResult.load(tmp_path / name)
