"""A robot goes through ``robot new``, ``prepare`` and ``train`` to plans with a model of its own."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml
from small_arm import write_arm
from support import ROOT
from toy_robot import write_toy

from apex_ompl import load_robot, plan
from apex_ompl.apex.model_search import DIGEST, find_model
from apex_ompl.apex.models import trajectory_model
from apex_ompl.goals.arms import arms_of
from apex_ompl.model.proposals import TrajectoryModel
from apex_ompl.onboarding import gain
from apex_ompl.onboarding.gain import Pair
from apex_ompl.onboarding.session import Session, train_robot
from apex_ompl.onboarding.symmetry import mirror_of
from apex_ompl.problems.robot_cells import cell_of
from apex_ompl.problems.robot_problems import drawn_for, problem_of, robot_of
from apex_ompl.robot import Robot
from apex_ompl.robot.identity import digest
from apex_ompl.training.store import Store


def test_a_urdf_becomes_a_robot_with_a_model(apex_cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_toy(tmp_path)
    for step in ("new toy.urdf --srdf toy.srdf", "prepare toy.robot.yaml --effort 1 --samples 600"):
        assert apex_cli("robot", *step.split()).returncode == 0
    train = "robot", "train", "toy.robot.yaml", "--hours", 0.0005
    stages = list[str]()

    def interrupt(stage: str, share: float, text: str) -> None:
        stages.append(stage)
        if stages.count(stage) == 2:
            raise KeyboardInterrupt

    for _ in range(3):
        with pytest.raises(KeyboardInterrupt):
            train_robot("toy.robot.yaml", None, Session(0.0005), interrupt)
    assert stages[:2] == ["data"] * 2 and stages.index("training") < stages.index("validation")
    done = apex_cli(*train)
    assert done.returncode == 0 and "too few problems to tell" in done.stdout, done.stderr
    robot = load_robot("toy.robot.yaml")
    assert (
        find_model(robot).name == str(tmp_path / "toy.model")
        and "model: toy.model" in Path("toy.robot.yaml").read_text()
    )
    card = Path("toy.model/README.md").read_text()
    assert "for toy" in card and "| solved |" in card
    record = json.loads(Path("toy.model/config.json").read_text())
    assert record["trained"][DIGEST] == digest(robot) and record["trained"]["validation"]["problems"] >= 4
    tips = [arm.link for arm in arms_of(robot) if arm.hand is not None]
    assert record["model"]["condition"]["hands"] == tips and len(tips) == 1
    paths = Store("toy.training/paths")
    assert paths.manifest["robot"] == "toy" and sum(map(len, paths)) >= 40
    again = apex_cli(*train)  # nothing is left to do
    assert again.returncode == 0 and again.stdout == done.stdout
    problem = problem_of(drawn_for(robot, "posts", 800_000), "toy.robot.yaml", "posts", 800_000)
    assert problem.name == "toy/broad/posts/800000"
    result = plan(problem, timeout=20.0, timing=False)
    assert result and not result.notes and isinstance(trajectory_model("auto", robot), TrajectoryModel)
    # A robot that has changed since does without the model, and says so.
    text = Path("toy.robot.yaml").read_text()
    Path("moved.robot.yaml").write_text(text.replace("acceleration: 8", "velocity: 1.5, acceleration: 8", 1))
    assert text != Path("moved.robot.yaml").read_text()
    moved = plan(problem.model_copy(update={"robot": "moved.robot.yaml"}), timeout=20.0, timing=False)
    assert moved and "toy.model is of another robot than toy is now" in moved.notes[0]
    problem.save("p.yaml")
    for arguments, words in (
        ((*train[:-1], 1), "hours"),
        (("plan", "p.yaml", "--model", "gone/folder"), "gone/folder"),
        (("plan", "p.yaml", "--model", "apex"), "expected 'toy'"),
    ):
        assert_one_sentence(apex_cli(*arguments), words)
    (tmp_path / "toy.model" / "model.safetensors").write_bytes(b"damaged")
    assert_one_sentence(apex_cli("plan", "p.yaml"), "damaged")


def assert_one_sentence(done, words: str) -> None:
    assert done.returncode == 2 and words in done.stderr, done.stderr
    assert len(done.stderr.strip().splitlines()) == 1 and "Traceback" not in done.stderr


def test_faults_are_one_sentence(apex_cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    file = write_arm(tmp_path)
    text = file.read_text()
    locked = text.replace("  shoulder: {home: 0.4, acceleration: 10, jerk: 200}\n", "").replace(
        "  elbow: {home: 0.6, acceleration: 10, jerk: 200}\n", ""
    )
    (tmp_path / "one_joint.robot.yaml").write_text(locked + "locked: {shoulder: 0.4, elbow: 0.6}\n")
    ball = "fixtures:\n  - {name: ball, sphere: {radius: 0.6}, position: [0, 0, 0.5]}\n"
    (tmp_path / "shut.robot.yaml").write_text(text + ball)
    for arguments, words in (
        (("gone.robot.yaml",), "gone.robot.yaml"),
        (("gone",), "robot"),
        ((file.name, "--hours", 0), "hours"),
        ((file.name, "--hours", "nan"), "hours"),
        ((file.name, "--jobs", 0), "jobs"),
        ((file.name, "--seed", -1), "seed"),
        ((file.name, "--out", "small_arm.urdf"), "small_arm.urdf"),
        (("one_joint.robot.yaml",), "has no arms"),
        (("shut.robot.yaml",), "no free state"),
    ):
        assert_one_sentence(apex_cli("robot", "train", *arguments), words)


def test_the_mirror_symmetry_of_robots_is_found(robot: Robot, baxter: Robot, tmp_path: Path) -> None:
    wanted = yaml.safe_load((ROOT / "scripts" / "configs" / "apex.yaml").read_text())["mirror"]
    found = mirror_of(cell_of(robot))
    assert found is not None and {key: list(values) for key, values in found.items()} == wanted
    assert mirror_of(cell_of(baxter)) is not None
    small = write_arm(tmp_path)
    assert mirror_of(cell_of(load_robot(small))) == {
        "order": (0, 1, 2), "sign": (-1, 1, 1), "shift": (0.0, 0.0, 0.0),
    }  # fmt: skip
    urdf = tmp_path / "small_arm.urdf"
    urdf.write_text(urdf.read_text().replace('<origin xyz="0 0 0.42"/>', '<origin xyz="0 0.1 0.42"/>'))
    assert mirror_of(cell_of(robot_of(str(small)))) is None


def test_a_gain_is_told_where_the_times_show_it() -> None:
    def figures(factor: float, count: int) -> dict:
        rows = [Pair("p", (True, True), (factor * s, s), "proposals") for s in (0.1, 0.11, 0.3, 0.5) * count]
        return gain.summary(rows, 2.0)

    few, faster, slower, same = figures(0.5, 2), figures(0.5, 10), figures(1.5, 10), figures(1.0, 10)
    assert few["verdict"].startswith("too few problems")
    assert faster["verdict"].startswith("proposals gain: 50%") and faster["ratio"] == pytest.approx(0.5)
    assert slower["verdict"].startswith("proposals do not gain: 50%")
    rows = [Pair("p", (True, True), (a, b), "") for a, b in ((1.0, 1.2), (1.2, 1.0)) * 12]
    assert gain.summary(rows, 2.0)["verdict"].startswith("no gain")
    assert same["solved"] == [40, 40] and same["stages"] == {"proposals": 40}
    trees = [row._replace(stage="sprint", seconds=(0.1, 0.2)) for row in rows]
    assert gain.summary(trees, 2.0)["verdict"].startswith("no gain: trees found all")
    assert gain.summary([], 2.0)["ratio"] is None
