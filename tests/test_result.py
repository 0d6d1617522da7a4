"""Results of plans and their files."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support import ROOT

from apex_ompl import PlanResult, plan
from apex_ompl.errors import FileFormatError, MissingFileError, ParameterError
from apex_ompl.scene.problem import Problem

BAXTER = ROOT / "examples" / "baxter_table.yaml"


def test_results_are_saved_in_every_format(problem: Problem, tmp_path: Path) -> None:
    import yaml

    result = plan(problem, timeout=20.0)
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
