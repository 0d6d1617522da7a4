"""The viewer without a browser: nodes, pages, ports, editing, and layers of runs."""

from __future__ import annotations

import re
import sys
import urllib.request
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from planning import cached_problem

from apex_ompl import load_problem, plan
from apex_ompl.cli import main
from apex_ompl.collision.tabulate import joint_tree
from apex_ompl.errors import MissingFileError, ParameterError, RobotError
from apex_ompl.ompl_adapter.setup import assemble
from apex_ompl.result import PlanResult
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Problem
from apex_ompl.viz.appearance import items_of
from apex_ompl.viz.browser.live_page import LivePage
from apex_ompl.viz.browser.nodes import RobotNodes, pose_of
from apex_ompl.viz.browser.page import write_page
from apex_ompl.viz.browser.run import ShownRun
from apex_ompl.viz.browser.scene import BrowserScene, _cover_of
from apex_ompl.viz.browser.server import HOST, free_port, serving
from apex_ompl.viz.browser.shown import Shown, results_in
from apex_ompl.viz.view import view

LARGEST = 6e6  # of a page [bytes]


@pytest.fixture(scope="module")
def server() -> Iterator[Any]:
    with serving() as found:
        yield found


@pytest.fixture(scope="module")
def result() -> PlanResult:
    found = plan("ball_in_cup", timeout=20.0)
    assert found
    return found


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
    for q in robot.random_state(np.random.default_rng(0), 4):
        nodes.show(q)
        for item in moving:
            found = world_pose(server.scene, nodes.path_of(item.joint)) @ item.placement
            frame = robot.model.frames[robot.model.getFrameId(item.body)] if item.layer == "robot" else None
            if frame is not None and frame.parentJoint == item.joint:
                link = robot.link_pose(q, item.body) @ np.linalg.inv(frame.placement.homogeneous) @ item.placement
                np.testing.assert_allclose(found, link, atol=1e-6)


def test_the_drawn_cover_is_that_of_the_kernel(robot: Robot) -> None:
    ready = assemble(load_problem("ball_in_cup"))
    kernel, turns = ready.checker.kernel, joint_tree(robot).turns
    q = robot.random_state(np.random.default_rng(1), 1)[0]
    rotation, origin = (value[0] for value in kernel.joint_frames(q[None]))
    tables, drawn = kernel.robot.arrays, _cover_of(ready)
    assert sum(len(rows) for rows in drawn.values()) <= (tables.node_count == 0).sum()
    for joint, rows in drawn.items():
        pin_rotation = rotation[joint] @ np.asarray(turns[joint])[:3, :3].T
        there = rows[:, :3] @ pin_rotation.T + origin[joint]
        all_centres = tables.node_centre @ rotation[joint].T + origin[joint]
        apart = np.linalg.norm(there[:, None] - all_centres[None], axis=2)
        assert apart.min(axis=1).max() < 1e-6


@pytest.mark.parametrize("name", ["ball_in_cup", "shelf/hard/900012"])
def test_pages_are_one_small_file_that_needs_no_network(name: str, tmp_path: Path) -> None:
    found = plan(name, timeout=20.0)
    write_page([Shown.of(found)], tmp_path / "p.html", cover=True)
    text = (tmp_path / "p.html").read_text()
    assert (tmp_path / "p.html").stat().st_size < LARGEST
    assert not re.search(r"""<(script|link|img|iframe)[^>]*(src|href)=["']?(https?:)?//""", text)
    assert f"{found.length:.2f} rad" in text and "share of limit" in text


def test_several_results_and_a_problem_with_a_fault_stand_side_by_side(
    server: Any, problem: Problem, result: PlanResult, tmp_path: Path
) -> None:
    blocked = problem.model_copy(update={"goal": problem.goal.model_copy(update={"joints": (problem.start,)})})
    post = Obstacle(name="inside", sphere={"radius": 0.3}, position=(0.3, 0.4, 0.5))
    blocked = blocked.model_copy(update={"scene": (post,)})
    shown = [Shown.of(result), Shown.of(blocked)]
    assert "start" in shown[1].facts and "inside" in shown[1].facts
    page = LivePage(server, shown)
    assert page.editor is None and len(page.player.scenes) == 2
    names = server.scene._handle_from_node_name
    assert np.ptp([names[f"/{k}"].position[1] for k in (1, 2)]) > 2.0
    assert tuple(page.player.scenes[1].obstacles["inside"].color) == (0xE0, 0x10, 0x1B), "in contact"
    assert "/2/why start" in names
    view(shown, tmp_path / "two.html")
    assert "inside" in (tmp_path / "two.html").read_text()


def test_the_player_plays_to_the_end_and_begins_anew(server: Any, result: PlanResult) -> None:
    page = LivePage(server, [Shown.of(result)])
    page.step(0.5)
    assert page.player.time == pytest.approx(0.5) and page.player._slider.value == pytest.approx(0.5)
    for _ in range(100):
        page.step(0.1)
        if page.player.time == page.player.duration:
            break
    assert result.trajectory is not None and page.player.time == pytest.approx(result.trajectory.duration)
    page.step(10.0)
    page.step(0.0)
    assert page.player.time < 0.1
    curves = page.player.sources[0].curves
    assert curves["clearance"].min() >= 1e3 * result.motion_clearance - 0.01
    assert curves["velocity"].max() <= result.limit_use["velocity"] + 1e-9
    asked: Any = SimpleNamespace(client=object())
    page.player._slider.value = 0.3
    for callback in page.player._slider._impl.update_cb:
        callback(asked)
    page.step(0.0)
    assert page.player.time == pytest.approx(0.3) and not page.player._play.value


def test_dragging_editing_planning_and_saving(server: Any, tmp_path: Path) -> None:
    problem = cached_problem("posts/medium/900003")
    page = LivePage(server, [Shown.of(problem)])
    editor = page.editor
    assert editor is not None and "free" in editor._state.content
    name = editor.add_box()
    assert name in editor.planner.world.obstacles and name in page.player.scenes[0].obstacles
    inside = np.eye(4)
    inside[:3, 3] = editor.planner.robot.link_pose(editor.start, "left_link5")[:3, 3]
    editor.drag(inside)
    assert "start **blocked**" in editor._state.content
    editor._dragged_at = 0.0
    page.step(0.0)
    assert "left_link" in editor._state.content and name in editor._state.content
    editor.drag(pose_of((1, 0, 0, 0), (0.9, 0.9, 1.2)))
    assert "start free" in editor._state.content
    hand = next(iter(editor.planner.robot.hands))
    editor.select(f"goal of {hand}")
    before, pose = np.array(editor.goal), pose_of(editor._control.wxyz, editor._control.position)
    pose[:3, 3] += (0.0, 0.0, 0.01)
    editor.drag(pose)
    assert 1e-4 < np.abs(np.asarray(editor.goal) - before).max() < 0.5
    far = pose.copy()
    far[:3, 3] = (3.0, 0.0, 0.0)
    reached = np.array(editor.goal)
    editor.drag(far)
    assert np.array_equal(np.asarray(editor.goal), reached), "out of reach: it stays"
    editor._file.value = str(tmp_path / "edited.yaml")
    assert "saved" in editor.save()
    saved = Problem.load(tmp_path / "edited.yaml")
    assert name in [body.name for body in saved.scene]
    assert "ms in all" in editor.plan() and page.player.sources[0].result
    np.testing.assert_allclose(page.player.sources[0].state(99.0), reached, atol=1e-6)
    editor.select(name)
    assert editor.remove() == f"{name} removed" and name not in page.player.scenes[0].obstacles
    editor._file.value = str(tmp_path / "no" / "edited.yaml")
    editor._said_by(editor.save)
    assert editor._said.content.startswith("error: ")


def test_proposals_and_their_denoising_are_drawn(server: Any) -> None:
    page = LivePage(server, [Shown.of(cached_problem("posts/medium/900003"))])
    assert page.inspection is not None
    page.inspection.draw()
    assert re.match(r"8 proposals: \d free as they are, \d after", page.inspection._said.content)
    nodes = page.inspection._nodes
    assert {"sampled", "guided", "denoising"} <= set(nodes)
    last, k = np.array(nodes["denoising"].points), page.inspection._step
    k.value = 0
    page.inspection.denoise()
    assert not np.allclose(last, nodes["denoising"].points)


def test_layers_of_a_run_show_what_was_fed_last(server: Any, problem: Problem, tmp_path: Path) -> None:
    run = ShownRun.begun("a run", assemble(problem))
    cube = Obstacle(name="cube", box=(0.1, 0.1, 0.1), position=(0.5, 0.0, 0.5))
    states = np.linspace(run.setup.start, run.setup.goals[0], 20)
    for k in range(5):
        run.feed_state(0.1 * k, states[k])
        moved = cube.model_copy(update={"position": (0.5, 0.1 * k, 0.5)})
        run.feed_bodies("true", 0.1 * k, [moved])
        if k % 2 == 0:
            run.feed_bodies("observed", 0.1 * k, [moved.model_copy(update={"box": (0.1 + 0.01 * k,) * 3})])
            run.feed_motion("committed", 0.1 * k, states[k:])
    run.feed_event(0.25, "replanned")
    run.feed_bodies("observed", 0.4, [])
    scene = BrowserScene(server.scene, run.setup, "/run")
    names = server.scene._handle_from_node_name
    run.draw(scene, 0.15)
    np.testing.assert_allclose(names["/run/true/cube"].position, (0.5, 0.1, 0.5))
    np.testing.assert_allclose(names["/run/observed/cube"].position, (0.5, 0.0, 0.5))
    np.testing.assert_allclose(run.state(0.15), 0.5 * (states[1] + states[2]))
    assert "/run/event" not in names and len(names["/run/committed"].points) == 2 * 19
    run.draw(scene, 0.3)
    np.testing.assert_allclose(names["/run/observed/cube"].position, (0.5, 0.2, 0.5))
    assert names["/run/event"].text == "replanned"
    run.draw(scene, 0.45)
    assert "/run/observed/cube" not in names and "/run/true/cube" in names
    assert run.duration == pytest.approx(0.4)
    with pytest.raises(ParameterError, match="one of true, observed, predicted"):
        run.feed_bodies("seen", 1.0, [])
    with pytest.raises(ParameterError, match="at least 0.4"):
        run.feed_bodies("true", 0.3, [])
    with pytest.raises(ParameterError, match="shape"):
        run.feed_state(1.0, np.zeros(3))
    view(run, tmp_path / "run.html")
    assert (tmp_path / "run.html").stat().st_size < LARGEST


def test_of_a_folder_one_result_is_chosen_at_a_time(server: Any, result: PlanResult, tmp_path: Path) -> None:
    files = [tmp_path / f"{k}.npz" for k in range(2)]
    result.save(files[0])
    replace(result, planner="another").save(files[1])
    page = LivePage(server, [], results_in(tmp_path))
    assert "another" not in page.player._facts.content
    page._choice.value = files[1].as_posix()
    page._choose()
    assert "another" in page.player._facts.content and page.editor is not None


def test_pages_are_served_to_this_machine_alone(server: Any) -> None:
    port = server.get_port()
    with urllib.request.urlopen(f"http://{HOST}:{port}", timeout=10) as answer:
        assert b"<html" in answer.read()
    with pytest.raises(ParameterError, match=f"free, got {port}"):
        free_port(port)
    with pytest.raises(ParameterError, match="65535"):
        free_port(70_000)
    assert server.get_host() == "127.0.0.1"


def test_without_a_browser_the_address_is_given(problem: Problem, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("webbrowser.open", lambda address: False)
    said: list[str] = []
    view(problem, ready=said.append, until=lambda: True)
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
        (["ball_in_cup", "--port", "70000", "--no-browser"], "65535"),
    ):
        assert main(["view", *given]) == 2, given
        said_by = capfd.readouterr().err
        assert said in said_by and said_by.count("\n") == 1, said_by
    (tmp_path / "empty").mkdir()
    assert main(["view", str(tmp_path / "empty")]) == 2
    assert "with results" in capfd.readouterr().err
    assert results_in(tmp_path) == [tmp_path / "r.npz"]
    with pytest.raises(RobotError, match="no longer the one"):
        view(replace(result, robot_digest="0" * 16), tmp_path / "x.html")
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(MissingFileError, match=r"install the extra: apex-ompl\[view\]"):
        view(result, tmp_path / "x.html")
    assert not (tmp_path / "x.html").exists()
