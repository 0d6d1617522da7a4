"""Pages in headless Chromium: no errors, pictures that are not blank, the robot where kinematics says, and editing."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import numpy as np
import pytest
from browser import SIZE, address, browser, errors, needs_browser, picture, press, until
from small_arm import arm_problem

from apex_ompl import plan
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Problem
from apex_ompl.viz.appearance import CONTACT
from apex_ompl.viz.view import view
from apex_ompl.viz.viewer.page import FIELD_OF_VIEW, draw, write_page
from apex_ompl.viz.viewer.scene import paint
from apex_ompl.viz.viewer.server import serving
from apex_ompl.viz.viewer.shown import Shown

pytestmark = needs_browser
VIEW = (sys.executable, "-c", "import sys; from apex_ompl.cli import main; sys.exit(main())", "view")


@pytest.fixture(scope="module")
def driver() -> Iterator[Any]:
    with browser() as found:
        yield found


def opened(driver: Any, where: str) -> None:
    driver.get("about:blank")
    driver.get_log("browser")  # what a page said whose server has gone
    driver.get(where)
    until(lambda: driver.find_elements("css selector", "canvas"), "a canvas")


WRITTEN, LIVE = slice(310, 700), slice(20, 380)  # columns that no panel covers


def is_drawn(driver: Any, columns: slice, reds: int = 100, colors: int = 200) -> bool:
    """Whether the picture has many colors, and pixels of the hue of obstacles."""
    seen = picture(driver)[140:-60, columns].reshape(-1, 3)
    red = (seen[:, 0] > 1.4 * seen[:, 1]) & (seen[:, 0] > 1.4 * seen[:, 2])
    return len(np.unique(seen, axis=0)) > colors and red.sum() >= reds


def with_a_cloud(problem: Problem, folder: Path) -> Problem:
    points = np.random.default_rng(0).uniform((0.5, -0.1, 0.2), (0.6, 0.1, 0.5), (60, 3))
    np.save(folder / "cloud.npy", points)
    cloud = Obstacle(name="cloud", points={"file": str(folder / "cloud.npy"), "radius": 0.01})
    return problem.model_copy(update={"scene": (cloud,)})


@pytest.mark.parametrize("name", ["ball_in_cup", "a cloud"])
def test_pages_show_and_play_to_the_end(driver: Any, name: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    if name == "a cloud":
        result = plan(with_a_cloud(arm_problem(tmp_path), tmp_path), timeout=20.0)
    else:
        result = request.getfixturevalue("result")
    assert result.trajectory is not None
    write_page([Shown.of(result)], tmp_path / "page.html")
    opened(driver, address(tmp_path / "page.html"))
    few = {"reds": 300, "colors": 30} if name == "a cloud" else {}  # points have one color, plain shapes few
    until(lambda: is_drawn(driver, WRITTEN, **few), "a picture with obstacles")
    slider = until(lambda: driver.find_elements("css selector", "[role=slider]"), "a slider")[0]
    end = result.trajectory.duration
    seen = [0.0]

    def at_the_end() -> bool:
        seen.append(float(slider.get_attribute("aria-valuenow")))
        return seen[-1] >= end or seen[-1] < seen[-2]  # it begins anew after the end

    until(at_the_end, "the motion played to its end")
    cursor = driver.find_element("id", "cursor").get_attribute("transform")
    assert cursor and cursor.startswith("translate(")
    assert errors(driver) == []


def test_live_pages_show_results(driver: Any, tmp_path: Path) -> None:
    result = plan(arm_problem(tmp_path), timeout=20.0)
    said, stop = SimpleQueue[str](), threading.Event()
    options: dict[str, Any] = {"opened": False, "ready": said.put, "until": stop.is_set}
    serve = threading.Thread(target=view, args=(result,), kwargs=options)
    serve.start()
    try:
        opened(driver, said.get(timeout=60))
        until(lambda: is_drawn(driver, LIVE), "a live picture with obstacles")
        until(lambda: f"{result.length:.2f} rad" in driver.page_source, "what there is to say of the result")
        assert errors(driver) == []
    finally:
        stop.set()
        serve.join(30)
    assert not serve.is_alive()


def projected(points: np.ndarray, camera: Any, size: tuple[int, int]) -> np.ndarray:
    """Where a camera that looks at a point sees points, in pixels, shape (N, 2)."""
    eye, target = np.array(camera.position), np.array(camera.look_at)
    ahead = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(ahead, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    local = (points - eye) @ np.stack([right, np.cross(right, ahead), ahead]).T
    focal = 0.5 * size[1] / np.tan(0.5 * FIELD_OF_VIEW)
    return np.stack([
        0.5 * size[0] + focal * local[:, 0] / local[:, 2], 0.5 * size[1] - focal * local[:, 1] / local[:, 2]
    ], axis=1)  # fmt: skip


def test_a_link_is_seen_where_forward_kinematics_says(driver: Any, problem: Problem) -> None:
    driver.set_window_size(1200, 640)  # wide enough for the middle to be clear of the panel
    shown = Shown.of(problem.model_copy(update={"scene": ()}))
    link, robot = "left_link6", shown.setup.robot
    with serving() as server:
        scenes = draw(server, [shown])
        for ghost in scenes[0]._ghosts.values():
            ghost.root.visible = False
        for item, handle in scenes[0].robot.handles:
            if item.body == link:
                paint(item, handle, CONTACT)
        opened(driver, f"http://127.0.0.1:{server.get_port()}")

        def red() -> Any:
            seen = picture(driver)
            hue = (seen[..., 0] > 90) & (seen[..., 0] > 2.2 * seen[..., 1]) & (seen[..., 0] > 2.2 * seen[..., 2])
            hue[:, :330] = hue[:, 870:] = False  # the browser's warning, and red before there is a scene; the panel
            return np.argwhere(hue)[:, ::-1] if hue.sum() > 50 else None

        seen = until(red, "a red link")
        canvas = driver.find_element("css selector", "canvas").rect
        camera = server.initial_camera
    driver.set_window_size(*SIZE)
    item = next(item for item, _ in scenes[0].robot.handles if item.body == link and item.mesh is not None)
    pose = robot.link_pose(shown.setup.start, link)
    frame = robot.model.frames[robot.model.getFrameId(link)]
    corners = np.asarray(item.mesh.vertices) @ item.placement[:3, :3].T + item.placement[:3, 3]
    local = (corners - frame.placement.translation) @ frame.placement.rotation
    wanted = projected(local @ pose[:3, :3].T + pose[:3, 3], camera, (canvas["width"], canvas["height"]))
    wanted += (canvas["x"], canvas["y"])
    assert np.abs(np.median(seen, axis=0) - np.median(wanted, axis=0)).max() < 12.0
    assert (seen.min(axis=0) > wanted.min(axis=0) - 5.0).all() and (seen.max(axis=0) < wanted.max(axis=0) + 5.0).all()


def started(*arguments: str) -> tuple[subprocess.Popen[str], str]:
    """A served page by the command line, and its address."""
    process = subprocess.Popen([*VIEW, *arguments, "--no-browser"], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    line = process.stdout.readline()
    return process, line.strip()


def test_editing_in_the_page_changes_the_scene_and_plan_answers(driver: Any, tmp_path: Path) -> None:
    arm_problem(tmp_path).save(tmp_path / "p.yaml")
    process, where = started(str(tmp_path / "p.yaml"))
    try:
        opened(driver, where)
        until(lambda: is_drawn(driver, LIVE), "a picture")
        before = picture(driver)
        press(driver, "add a box")
        until(lambda: "box_1" in driver.page_source, "a box")
        until(lambda: (np.abs(picture(driver) - before)[:, LIVE].max(axis=2) > 40).sum() > 100, "another picture")
        press(driver, "plan")
        until(lambda: "ms in all" in driver.page_source, "a plan")
        assert errors(driver) == []
        driver.get("about:blank")
        assert process.wait(90) == 0, "closing the page ends the command"
    finally:
        process.kill()


def test_ctrl_c_leaves_nothing_running(driver: Any, apex_cli: Any, tmp_path: Path) -> None:
    arm_problem(tmp_path).save(tmp_path / "p.yaml")
    page = str(tmp_path / "p.yaml"), "--port", "8391"
    process, where = started(*page)
    try:
        assert where == "http://127.0.0.1:8391"
        taken = apex_cli("view", *page, "--no-browser")
        assert taken.returncode == 2 and taken.stderr.count("\n") == 1 and "8391" in taken.stderr
        opened(driver, where)
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 130
    finally:
        process.kill()
    with serving(8391) as server:
        assert server.get_port() == 8391, "the port is free again"
