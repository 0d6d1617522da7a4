"""A robot goes through ``apex-ompl robot new``, ``check`` and ``prepare`` to a plan."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from toy_robot import write_toy

from apex_ompl import load_robot
from apex_ompl.collision import CollisionChecker
from apex_ompl.scene.problem import Problem


def test_a_urdf_becomes_a_robot_that_plans(apex_cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_toy(tmp_path)
    new = apex_cli("robot", "new", "toy.urdf", "--srdf", "toy.srdf", "--at", "-0.5,0,0,1.5")
    assert new.returncode == 0 and new.stdout.split()[0].endswith("toy.robot.yaml"), new.stderr
    assert "note: manipulator: 4 joints joint1 to joint4, a group of the SRDF" in new.stderr
    before = apex_cli("robot", "check", "toy.robot.yaml", "--samples", 200)
    assert before.returncode == 0 and "made at run time, see robot prepare" in before.stdout, before.stderr
    prepare = apex_cli("robot", "prepare", "toy.robot.yaml", "--effort", 1, "--samples", 600, "--jobs", 2)
    assert prepare.returncode == 0 and "of 3 shapes: 3 with effort 1" in prepare.stdout, prepare.stderr
    after = json.loads(apex_cli("robot", "check", "toy.robot.yaml", "--json").stdout)
    assert after["dof"] == 4 and 0.0 < after["proved"] <= 1.0 and after["faults"] == []
    robot = load_robot("toy.robot.yaml")
    assert np.allclose(robot.link_pose(robot.home, "stand")[:3, 3], [-0.5, 0, 0])
    states = robot.random_state(np.random.default_rng(0), 100)
    start, goal = (dict(zip(robot.joint_names, q.tolist(), strict=True))
                   for q in states[CollisionChecker(robot).are_free(states)][:2])  # fmt: skip
    post = {"name": "post", "sphere": {"radius": 0.05}, "position": [0.5, 0.5, 0.5]}
    Problem(name="p", robot="toy.robot.yaml", scene=[post], start=start, goal={"joints": [goal]}).save("p.yaml")
    plan = apex_cli("plan", "p.yaml", "--timeout", 30)
    assert plan.returncode == 0 and "EXACT_SOLUTION" in plan.stdout, plan.stderr


def test_faults_are_one_sentence_and_exit_code_2(apex_cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_toy(tmp_path)
    (tmp_path / "empty.urdf").write_text("")
    assert apex_cli("robot", "new", "toy.urdf", "-o", "r.robot.yaml").returncode == 0
    Path("r.robot.yaml").rename("r2.robot.yaml")
    for arguments, words in (
        (("new", "gone.urdf"), "no such file"),
        (("new", "."), "URDF"),
        (("new", "empty.urdf"), "not valid XML"),
        (("new", "toy.urdf", "--srdf", "gone.srdf"), "SRDF '"),
        (("new", "toy.urdf", "--at", "1,2"), "--at: expected x,y,z,yaw"),
        (("new", "toy.urdf", "toy.urdf"), "--at: expected one for each of 2 URDFs"),
        (("new", "toy.urdf", "--package", "a"), "--package: expected NAME=VALUE"),
        (("new", "toy.urdf", "--package", "a=gone"), "--package: expected NAME=FOLDER"),
        (("new", "toy.urdf", "-o", "gone/r.yaml"), "does not exist"),
        (("new", "toy.urdf", "-o", "r.txt"), "expected a file name ending in .yaml"),
        (("new", "toy.urdf", "-o", "r2.robot.yaml"), "this one exists"),
        (("check", "gone.robot.yaml"), "gone.robot.yaml"),
        (("check", "pandaa"), "did you mean 'panda'"),
        (("check", "r2.robot.yaml", "--samples", 0), "--samples"),
        (("prepare", "gone.robot.yaml"), "gone.robot.yaml"),
        (("prepare", "toy.urdf"), "toy.urdf"),
        (("prepare", "r2.robot.yaml", "--budget", -1), "budget"),
    ):
        done = apex_cli("robot", *arguments)
        assert done.returncode == 2 and words in done.stderr, (arguments, done.stderr)
        assert len(done.stderr.strip().splitlines()) == 1 and "Traceback" not in done.stderr
    names = {"toy.urdf", "toy.srdf", "empty.urdf", "r2.robot.yaml"}
    assert {path.name for path in tmp_path.iterdir()} - {"r.pairs.yaml"} == names


def test_a_robot_whose_home_touches_is_faulty(apex_cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_toy(tmp_path)
    apex_cli("robot", "new", "toy.urdf", "--srdf", "toy.srdf")
    text = Path("toy.robot.yaml").read_text()
    Path("toy.robot.yaml").write_text(text.replace("joint2: {home: 0.9", "joint2: {home: 1.9").replace("-1.1", "1.9"))
    done = apex_cli("robot", "check", "toy.robot.yaml", "--samples", 50)
    assert done.returncode == 2 and "fault: toy: home: expected a state that is free, " in done.stderr, done.stderr
