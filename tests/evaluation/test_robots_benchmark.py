"""The benchmarks of robots: robots that are set up, problems among boxes, and MotionBenchMaker's files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support import benchmark_script
from toy_robot import SRDF, toy_urdf

from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import MissingFileError
from apex_ompl.robot import load_robot
from apex_ompl.util.schema import dump_yaml

fleet, boxes, mbm, figures = (
    benchmark_script(f"robots.{name}") for name in ("fleet", "boxes", "motion_bench_maker", "figures")
)


def test_problems_among_boxes_have_free_ends_and_a_blocked_line(tmp_path: Path) -> None:
    file = fleet.robot_file("planar", tmp_path)
    robot = load_robot(file)
    assert robot.dof == 12 and fleet.robot_file("planar", tmp_path) == file
    drawn = boxes.Boxes(robot, str(file))
    one, other = drawn.problem(3), drawn.problem(4)
    assert one == boxes.Boxes(robot, str(file)).problem(3) and one.scene != other.scene
    for problem in (one, other):
        meshes = CollisionChecker(robot, problem.scene, proofs=False)
        line = np.stack([problem.start_state(robot.joint_names), problem.goal_states(robot.joint_names)[0]])
        assert meshes.are_free(np.stack([*line, robot.home])).all() and len(problem.scene) >= boxes.FEWEST
        assert meshes.first_collision(line, 0.01) is not None


def test_figures_count_problems_that_one_planner_solves(tmp_path: Path) -> None:
    kept = figures.Figures(tmp_path / "a.robot.yaml")
    found, lost = ({"solved": ok, "cpu_s": t, "length": 2.0 * ok or None, "by": ""} for ok, t in ((1, 0.5), (0, 9.0)))
    pairs = {"0": (found, found), "1": (found, lost), "2": (lost, lost)}
    kept.write(dof=7, pairs=9, free=0.5, proved=0.9, spoilers={"a and b": 0.1}, prepare_cpu_s=3.0)
    kept.write(runs={name: dict(zip(figures.PLANNERS, pair, strict=True)) for name, pair in pairs.items()})
    row, cells = figures.Figures(tmp_path / "a.robot.yaml").row("a", [*pairs, "3"])
    assert row["n"] == 2 and row["unsolved"] == 1 and "a and b 10%" in cells
    assert row["apex"] == {"soon": 1.0, "p50_s": 0.5, "p95_s": 0.5, "length_rad": 2.0}
    assert row["rrtconnect+polish"]["soon"] == 0.5 and row["rrtconnect+polish"]["p95_s"] is None


def test_files_of_motion_bench_maker_become_problems(tmp_path: Path) -> None:
    here = tmp_path / "ur5"
    folder = here / "problems" / "box_ur5"
    folder.mkdir(parents=True)
    (here / "ur5.urdf").write_text(toy_urdf())
    (here / "ur5.srdf").write_text(SRDF)
    names = [f"joint{k}" for k in range(1, 5)]
    for k, turn in enumerate((0.9, 0.0), 1):
        state = {"name": [*names, "grip1"], "position": [0.0, 0.9, -1.1, 0.7, 0.01]}
        joints = [{"joint_name": n, "position": v} for n, v in zip(names, (turn, 0.9, -1.1, 0.7), strict=True)]
        request = {"start_state": {"joint_state": state}, "goal_constraints": [{"joint_constraints": joints}]}
        place = {"position": [0.5, 0.0, 0.5 * k], "orientation": [0, 0, 0, 1]}
        box = {"id": "box", "primitives": [{"type": "box", "dimensions": [0.1] * 3}], "primitive_poses": [place]}
        scene = {"world": {"collision_objects": [box | {"header": {"frame_id": "world"}}]}}
        (folder / f"request000{k}.yaml").write_bytes(dump_yaml(request).encode())
        (folder / f"scene000{k}.yaml").write_bytes(dump_yaml(scene).encode())
    file = mbm.set_up("ur5", tmp_path, tmp_path / "made")
    robot = load_robot(file)
    assert "grip1: 0.01" in file.read_text() and robot.joint_names == tuple(names)
    found = dict(mbm.problems(file, tmp_path, 9))
    assert list(found) == ["box_ur5/request0001", "box_ur5/request0002"]
    problem = found["box_ur5/request0001"]
    assert problem is not None and problem.robot == str(file)
    assert problem.goal_states(robot.joint_names)[0].tolist() == [0.9, 0.9, -1.1, 0.7]
    with pytest.raises(MissingFileError):
        mbm.requests("panda", tmp_path)
