"""Live pages without a browser: the player, editing, planning, proposals, and runs."""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from planning import cached_problem
from small_arm import arm_problem

from apex_ompl import plan
from apex_ompl.errors import ParameterError
from apex_ompl.ompl.setup import assemble
from apex_ompl.result import PlanResult
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Problem
from apex_ompl.viz.sources import saved_in
from apex_ompl.viz.view import view
from apex_ompl.viz.viewer.live_page import LivePage
from apex_ompl.viz.viewer.run import ShownRun
from apex_ompl.viz.viewer.scene import BrowserScene, pose_of
from apex_ompl.viz.viewer.server import serving
from apex_ompl.viz.viewer.shown import Shown

RED = (0xE0, 0x10, 0x1B)  # of contacts
LARGEST = 6e6  # of a page [bytes]


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> PlanResult:
    """A plan of an arm that is drawn in no time."""
    return plan(arm_problem(tmp_path_factory.mktemp("arm")), timeout=20.0)


@pytest.fixture(scope="module")
def page() -> Iterator[LivePage]:
    """A page of a problem of the two arms, on a server of its own."""
    with serving() as server:
        yield LivePage(server, [Shown.of(cached_problem("posts/medium/900003"))])


def test_dragging_says_what_is_free(page: LivePage) -> None:
    editor = page.editor
    assert editor is not None and "free" in editor._state.content
    name = editor.add_box()
    assert name in editor.planner.world.obstacles and name in page.player.scenes[0].obstacles
    inside = np.eye(4)
    inside[:3, 3] = editor.planner.robot.link_pose(editor.start, "left_link5")[:3, 3]
    editor.drag(inside)
    assert "start **blocked**" in editor._state.content
    editor._edited_at = 0.0
    page.step(0.0)
    assert "left" in editor._state.content and "box" in editor._state.content
    assert tuple(page.player.scenes[0].obstacles[name].color) == RED
    names = page._server.scene._handle_from_node_name
    assert "/1/why start" in names
    editor.drag(pose_of((1, 0, 0, 0), (0.9, 0.9, 1.2)))
    assert "start free" in editor._state.content
    editor._edited_at = 0.0
    page.step(0.0)
    assert "/1/why start" not in names and tuple(page.player.scenes[0].obstacles[name].color) != RED
    hand = next(iter(editor.planner.robot.hands))
    editor.grab(f"goal of {hand}")
    before, pose = np.array(editor.goal), pose_of(editor._control.wxyz, editor._control.position)
    pose[:3, 3] += (0.0, 0.0, 0.01)
    editor.drag(pose)
    assert 1e-4 < np.abs(np.asarray(editor.goal) - before).max() < 0.5
    far = pose.copy()
    far[:3, 3] = (3.0, 0.0, 0.0)
    reached = np.array(editor.goal)
    editor.drag(far)
    assert np.array_equal(np.asarray(editor.goal), reached) and "out of reach" in editor._state.content
    editor._edited_at = 0.0
    page.step(0.0)
    np.testing.assert_allclose(editor._control.position, pose[:3, 3], atol=5e-3)


def test_plans_and_files_are_of_what_was_edited(server: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    problem = cached_problem("posts/medium/900003")
    pair = (problem.scene[0].name, "left_link3")
    page = LivePage(server, [Shown.of(problem.model_copy(update={"allowed": (pair,)}))])
    editor = page.editor
    assert editor is not None
    name = editor.add_box()
    editor.drag(pose_of((1, 0, 0, 0), (0.9, 0.9, 1.2)))
    editor.grab(f"goal of {next(iter(editor.planner.robot.hands))}")
    pose = pose_of(editor._control.wxyz, editor._control.position)
    pose[:3, 3] += (0.0, 0.0, 0.01)
    editor.drag(pose)
    reached = np.array(editor.goal)
    for _ in range(2):  # the dragged goal holds for the next plan too
        assert "ms in all" in editor.plan() and page.player.sources[0].result
        np.testing.assert_allclose(page.player.sources[0].state(99.0), reached, atol=1e-6)
    editor.grab(problem.scene[0].name)
    editor.remove()
    assert "ms in all" in editor.plan(), "the pairs that may touch are those of what is left"
    editor._file.value = "edited.yaml"
    assert "saved" in editor.save()
    saved = Problem.load(tmp_path / "edited.yaml")
    assert name in [body.name for body in saved.scene] and not saved.allowed
    np.testing.assert_allclose(saved.goal_states(editor.planner.robot.joint_names)[0], reached, atol=1e-6)
    editor.grab(name)
    assert editor.remove() == f"{name} removed" and name not in page.player.scenes[0].obstacles
    assert "saved" in editor.save(), "its own file is written again"
    (tmp_path / "other.yaml").write_text("mine")
    for file in ("other.yaml", "../edited.yaml", "edited.txt"):
        editor._file.value = file
        editor._say(editor.save)
        assert editor._said.content.startswith("error: ")
    assert (tmp_path / "other.yaml").read_text() == "mine"


def test_a_goal_in_the_workspace_stays_one_until_it_is_dragged(server: Any) -> None:
    page = LivePage(server, [Shown.of(cached_problem("ball_in_cup"))])
    editor = page.editor
    assert editor is not None and editor.problem().goal.alignment is not None
    editor.add_box()
    assert "ms in all" in editor.plan()
    assert editor.problem().goal.alignment is not None
    np.testing.assert_allclose(editor.goal, page.player.sources[0].state(99.0), atol=1e-9)


def test_what_was_asked_of_controls_that_are_gone_is_not_done(server: Any, result: PlanResult, tmp_path: Path) -> None:
    files = [tmp_path / f"{k}.npz" for k in range(2)]
    for file in files:
        result.save(file)
    page = LivePage(server, [], files)
    old = page.player._slider._impl.update_cb[0]
    page.choose(files[1].as_posix())
    old(SimpleNamespace(client=object(), target=SimpleNamespace(value=0.3)))
    page.step(0.0)
    assert page.player._play.value
    assert page.inspection is not None
    page.inspection.draw()
    assert page.editor is not None and "ms in all" in page.editor.plan()
    page.inspection._layers()
    page.inspection.denoise()
    assert not page.inspection._nodes, "its nodes went with the scene"


def test_proposals_and_their_denoising_are_drawn(page: LivePage) -> None:
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
    run = ShownRun("a run", assemble(problem))
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


def test_a_run_that_goes_on_is_followed(server: Any, small: PlanResult) -> None:
    run = ShownRun("a run", assemble(small.problem))
    page = LivePage(server, [run])
    assert page.editor is None and not page.player._slider.visible
    states = np.linspace(run.setup.start, run.setup.goals[0], 300)
    done = threading.Event()

    def feed() -> None:
        for k, q in enumerate(states):
            run.feed_state(0.01 * k, q)
        done.set()

    feeder = threading.Thread(target=feed)
    feeder.start()
    while not done.is_set():
        page.step(0.01)
    feeder.join()
    page.step(0.01)
    assert page.player.time == pytest.approx(2.99) and page.player._slider.max == pytest.approx(2.99)
    run.has_ended = True
    page.step(10.0)
    page.step(0.1)
    assert page.player.time < 0.2


def test_the_player_plays_to_the_end_and_begins_anew(server: Any, small: PlanResult) -> None:
    result = small
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
    asked: Any = SimpleNamespace(client=object(), target=SimpleNamespace(value=0.3))
    for callback in page.player._slider._impl.update_cb:
        callback(asked)
    page.step(0.0)
    assert page.player.time == pytest.approx(0.3) and not page.player._play.value


def test_of_a_folder_one_result_is_chosen_at_a_time(server: Any, small: PlanResult, tmp_path: Path) -> None:
    files = [tmp_path / f"{k}.npz" for k in range(2)]
    small.save(files[0])
    replace(small, planner="another").save(files[1])
    page = LivePage(server, [], saved_in(tmp_path))
    assert "another" not in page.player._facts.content
    page.choose(files[1].as_posix())
    assert "another" in page.player._facts.content and page.editor is not None
