"""The model of a robot is found by the robot's digest: by its file, by what ships, and by folders of checkpoints."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import pytest

from apex_ompl.apex.model_search import DIGEST, NONE, VARIABLE, data_folder, find_model, robot_fault
from apex_ompl.apex.models import PerturbationModel, trajectory_model
from apex_ompl.errors import FileFormatError, MissingFileError
from apex_ompl.model.checkpoint import CONFIG, SHIPPED
from apex_ompl.model.proposals import TrajectoryModel
from apex_ompl.robot import Robot
from apex_ompl.robot.config import DATA, RobotConfig, read_config
from apex_ompl.robot.identity import digest
from apex_ompl.robot.model import build_robot

FILE = DATA / "dual_panda_softhand.robot.yaml"


@pytest.fixture(autouse=True)
def _no_other_models(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))


def pandas(**changes: object) -> RobotConfig:
    return read_config(FILE).model_copy(update=changes)


def moved_parts() -> tuple[object, ...]:
    first, *others = read_config(FILE).parts
    return (first.model_copy(update={"position": (0.0, 0.6, 0.0)}), *others)


@pytest.fixture(scope="module")
def moved() -> Robot:
    """The Pandas under the same name, one of them 10 cm farther to the left."""
    return build_robot(pandas(parts=moved_parts()), FILE)


def checkpoint(folder: Path, found: str | None) -> Path:
    """Copy the checkpoint that ships, with another digest of its robot."""
    shutil.copytree(SHIPPED / "apex", folder)
    record = json.loads((folder / CONFIG).read_text())
    record["trained"][DIGEST] = found
    (folder / CONFIG).write_text(json.dumps(record))
    return folder


def test_what_ships_is_for_the_robot_that_ships(robot: Robot, moved: Robot) -> None:
    same = build_robot(pandas(), FILE)
    assert same is not robot and find_model(same).name == find_model(robot).name == "apex"
    assert moved.name == robot.name and digest(moved) != digest(robot)
    assert find_model(moved).name == NONE and isinstance(trajectory_model("auto", moved), PerturbationModel)


def test_folders_are_searched_by_the_digest(
    robot: Robot, moved: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mine = checkpoint(tmp_path / "models" / "b", digest(moved))
    checkpoint(tmp_path / "models" / "a", digest(robot))
    damaged = tmp_path / "models" / "0"
    damaged.mkdir()
    (damaged / CONFIG).write_text("{")
    assert find_model(moved).name == NONE
    for places in ((tmp_path / "models",), (tmp_path / "gone", mine)):
        monkeypatch.setenv(VARIABLE, os.pathsep.join(map(str, places)))
        assert find_model(moved).name == str(mine)
    assert isinstance(trajectory_model("auto", moved), TrajectoryModel)
    monkeypatch.delenv(VARIABLE)
    home = data_folder()
    assert home is not None and str(home).startswith(str(tmp_path))
    shutil.copytree(mine, home / "moved")
    assert find_model(moved).name == str(home / "moved")
    fault = robot_fault(mine, robot)
    assert isinstance(fault, FileFormatError) and digest(robot) in str(fault) and "as it is now" in str(fault)
    with pytest.raises(FileFormatError, match="train a model for it"):
        trajectory_model(str(mine), robot)


def test_the_robot_file_names_a_model(moved: Robot, tmp_path: Path) -> None:
    mine = checkpoint(tmp_path / "mine", digest(moved))
    named = build_robot(pandas(parts=moved_parts(), model=str(mine)), FILE)
    assert digest(named) == digest(moved) and find_model(named).name == str(mine)
    shutil.rmtree(mine)
    with pytest.raises(MissingFileError, match="mine"):
        find_model(named)
    stale = checkpoint(tmp_path / "mine", "0123456789abcdef")
    found = find_model(named)
    assert found.name == NONE and str(stale) in found.note and "another robot" in found.note
