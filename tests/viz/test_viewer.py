"""The viewer without a browser: nodes, pages, ports, editing, and layers of runs."""

from __future__ import annotations

import re
import sys
import urllib.request
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_arm import arm_problem

from apex_ompl import load_problem
from apex_ompl.cli import main
from apex_ompl.collision.tables import joint_tree
from apex_ompl.errors import MissingFileError, ParameterError, RobotError
from apex_ompl.ompl.setup import assemble
from apex_ompl.result import PlanResult
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.viz.appearance import items_of
from apex_ompl.viz.sources import saved_in
from apex_ompl.viz.view import view
from apex_ompl.viz.viewer.live_page import LivePage
from apex_ompl.viz.viewer.page import write_page
from apex_ompl.viz.viewer.scene import RobotNodes, _cover_of, pose_of
from apex_ompl.viz.viewer.server import HOST, free_port
from apex_ompl.viz.viewer.shown import Shown, markdown

RED = (0xE0, 0x10, 0x1B)  # of contacts
LARGEST = 6e6  # of a page [bytes]


def world_pose(api: Any, path: str) -> np.ndarray:
    """Pose of a node in the world, by the frames above it."""
    pose, names = np.eye(4), path.strip("/").split("/")
    for k in range(len(names)):
        handle = api._handle_from_node_name["/" + "/".join(names[: k + 1])]
        pose = pose @ pose_of(handle.wxyz, handle.position)
    return pose


def test_nodes_stand_where_forward_kinematics_says(server: Any, robot: Robot) -> None:
    ready = assemble(load_problem("ball_in_cup"))
    moving = [item for item in items_of(ready) if item.moves]
    nodes = RobotNodes(server.scene, "/kinematics", robot, moving)
    held = {one.name: one.link for one in ready.problem.attached}
    assert len(held) == 2 and {item.layer for item in moving} == {"robot", "held", "faces"}
    for q in robot.random_state(np.random.default_rng(0), 4):
        nodes.show(q)
        for item in moving:
            found = world_pose(server.scene, nodes.path_of(item.joint)) @ item.placement
            link = held.get(item.body, item.body)
            frame = robot.model.frames[robot.model.getFrameId(link)]
            assert frame.parentJoint == item.joint
            wanted = robot.link_pose(q, link) @ np.linalg.inv(frame.placement.homogeneous) @ item.placement
            np.testing.assert_allclose(found, wanted, atol=1e-6)


def test_the_drawn_cover_is_that_of_the_kernel(robot: Robot) -> None:
    ready = assemble(load_problem("ball_in_cup"))
    kernel, turns = ready.checker.kernel, joint_tree(robot).turns
    q = robot.random_state(np.random.default_rng(1), 1)[0]
    rotation, origin = (value[0] for value in kernel.joint_frames(q[None]))
    tables, drawn = kernel.robot.arrays, _cover_of(ready)
    ends = np.append(tables.body_root[1:], len(tables.node_count))
    joint_of = np.repeat(tables.body_joint, ends - tables.body_root)
    leaves = (tables.node_count == 0) & (joint_of > 0)
    assert sum(len(rows) for rows in drawn.values()) == leaves.sum() > 300
    for joint, rows in drawn.items():
        pin_rotation = rotation[joint] @ np.asarray(turns[joint])[:3, :3].T
        there = rows[:, :3] @ pin_rotation.T + origin[joint]
        mine = np.flatnonzero(leaves & (joint_of == joint))
        centers = tables.node_center[mine] @ rotation[joint].T + origin[joint]
        np.testing.assert_allclose(there, centers, atol=1e-9)
        np.testing.assert_array_equal(rows[:, 3], tables.node_radius[mine])


def test_pages_are_one_small_file_that_needs_no_network(result: PlanResult, tmp_path: Path) -> None:
    write_page([Shown.of(result)], tmp_path / "p.html", cover=True)
    text = (tmp_path / "p.html").read_text()
    assert (tmp_path / "p.html").stat().st_size < LARGEST
    assert not re.search(r"""<(script|link|img|iframe)[^>]*(src|href)=["']?(https?:)?//""", text)
    assert f"{result.length:.2f} rad" in text and "share of limit" in text


def test_several_results_and_a_problem_with_a_fault_stand_side_by_side(
    server: Any, result: PlanResult, tmp_path: Path
) -> None:
    problem = arm_problem(tmp_path)
    blocked = problem.model_copy(update={"goal": problem.goal.model_copy(update={"joints": (problem.start,)})})
    post = Obstacle(name="inside", sphere={"radius": 0.1}, position=(0.1, -0.1, 0.7))
    blocked = blocked.model_copy(update={"scene": (post,)})
    shown = [Shown.of(result), Shown.of(blocked)]
    assert any(row.startswith("start: ") and "inside" in row for row in shown[1].facts)
    page = LivePage(server, shown)
    assert page.editor is None and len(page.player.scenes) == 2
    names = server.scene._handle_from_node_name
    assert np.ptp([names[f"/{k}"].position[1] for k in (1, 2)]) > 2.0
    assert tuple(page.player.scenes[1].obstacles["inside"].color) == RED, "in contact"
    assert "/2/why start" in names
    view(shown, tmp_path / "two.html")
    assert "inside" in (tmp_path / "two.html").read_text()


def test_names_that_are_nearly_equal_are_different_nodes(server: Any, tmp_path: Path) -> None:
    bodies = [
        Obstacle(name=name, sphere={"radius": 0.1}, position=(3.0, 0.0, k)) for k, name in enumerate(("a/b", "a_b"))
    ]
    page = LivePage(server, [Shown.of(arm_problem(tmp_path).model_copy(update={"scene": tuple(bodies)}))])
    found = page.player.scenes[0].obstacles
    assert [float(found[name].position[2]) for name in ("a/b", "a_b")] == [0.0, 1.0]


def test_text_is_shown_as_it_is() -> None:
    assert markdown(["a_b *c* <iframe srcdoc=x>", "[d](e)"]) == "a\\_b \\*c\\* &lt;iframe srcdoc=x&gt;\n\n\\[d\\](e)"


def test_pages_are_served_to_this_machine_alone(server: Any) -> None:
    port = server.get_port()
    with urllib.request.urlopen(f"http://{HOST}:{port}", timeout=10) as answer:
        assert b"<html" in answer.read()
    with pytest.raises(ParameterError, match=f"free, got {port}"):
        free_port(port)
    with pytest.raises(ParameterError, match="65535"):
        free_port(70_000)
    assert server.get_host() == "127.0.0.1"


def test_without_a_browser_the_address_is_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("webbrowser.open", lambda address: False)
    said: list[str] = []
    view(arm_problem(tmp_path), ready=said.append, until=lambda: True)
    assert said[0].startswith("http://127.0.0.1:") and "no browser was found" in said[1]


def test_bad_input_is_one_sentence(
    result: PlanResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    result.save(tmp_path / "r.npz")
    text = result.problem.to_yaml()
    (tmp_path / "p.yaml").write_text(text)
    for given, said in (
        (["nothing"], "unknown problem 'nothing'"),
        ([str(tmp_path / "r.npz"), "-o", str(tmp_path / "r.gif")], "ending in .html"),
        ([str(tmp_path / "r.npz"), "-o", str(tmp_path / "no" / "r.html")], "does not exist"),
        ([str(tmp_path / "r.npz")] * 7, "1 to 6 problems"),
        ([str(tmp_path), "ball_in_cup"], "a folder alone"),
        (["ball_in_cup", "--cover", "--no-browser"], "cover"),
        (["ball_in_cup", "--port", "8390", "-o", str(tmp_path / "r.html")], "port"),
        (["ball_in_cup", "--port", "70000", "--no-browser"], "65535"),
    ):
        assert main(["view", *given]) == 2, given
        said_by = capfd.readouterr().err
        assert said in said_by and said_by.count("\n") == 1, said_by
    (tmp_path / "empty").mkdir()
    for name, content in (("a.npz", b""), ("b.npz", b"text"), ("c.json", b"{}"), ("d.json", b"\xff\xfe")):
        (tmp_path / "empty" / name).write_bytes(content)
    (tmp_path / "empty" / "e.json").mkdir()
    assert main(["view", str(tmp_path / "empty")]) == 2
    assert "with results" in capfd.readouterr().err
    assert saved_in(tmp_path) == [tmp_path / "r.npz"]
    with pytest.raises(ParameterError, match="problems or results"):
        view("ball_in_cup", tmp_path / "x.html")  # type: ignore[arg-type]
    with pytest.raises(RobotError, match="has changed since"):
        view(replace(result, robot_digest="0" * 16), tmp_path / "x.html")
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(MissingFileError, match=r"install the extra: apex-ompl\[view\]"):
        view(result, tmp_path / "x.html")
    assert not (tmp_path / "x.html").exists()
