"""Pictures, films, pages and time lines of runs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
from runs import run_by_hand
from small_arm import write_arm

from apex_ompl.cli import main
from apex_ompl.errors import ParameterError, RobotError
from apex_ompl.loop.result import Event, Outcome, RunResult
from apex_ompl.ompl.setup import assemble
from apex_ompl.result import PlanResult
from apex_ompl.robot import Robot, load_robot
from apex_ompl.scene.scripts import place_at
from apex_ompl.viz.render import caption, render
from apex_ompl.viz.scene_renderer import SceneRenderer
from apex_ompl.viz.sources import load_saved, robot_of, saved_in, saved_kind
from apex_ompl.viz.timeline import _kinds, plot_run
from apex_ompl.viz.viewer.live_page import LivePage
from apex_ompl.viz.viewer.saved_run import SavedRun, shown_of

SMALL = (320, 240)


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    return load_robot(write_arm(tmp_path_factory.mktemp("arm")))


@pytest.fixture(scope="module")
def run(arm: Robot) -> RunResult:
    made, file = run_by_hand(arm, "turn", "lower"), str(arm.files[0])
    return replace(made, robot=file, problem=made.problem.model_copy(update={"robot": file}))


@pytest.fixture(scope="module")
def saved(run: RunResult, tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("runs") / "run.npz"
    run.save(file)
    return file


def red(picture: np.ndarray) -> int:
    """Number of pixels that are obstacles."""
    given = picture.astype(int)
    return int(((given[..., 0] > given[..., 1] + 40) & (given[..., 0] > given[..., 2] + 40)).sum())


def test_strips_and_films_of_runs_are_drawn(run: RunResult, tmp_path: Path) -> None:
    short = replace(run, events=run.events[:-1])
    render(short, tmp_path / "r.png", SMALL)
    strip = iio.imread(tmp_path / "r.png")
    assert strip.shape[:2] == (SMALL[1] // 2 * 2, SMALL[0] // 2 * 3)
    first, last = strip[: SMALL[1] // 2, : SMALL[0] // 2], strip[SMALL[1] // 2 :, -(SMALL[0] // 2) :]
    assert red(first) > 20 and red(last) > 1.3 * red(first), "the second obstacle appears later"
    render(short, tmp_path / "r.gif", (160, 120))
    assert len(iio.imread(tmp_path / "r.gif", index=None)) > 20
    render(short, tmp_path / "r.mp4", (160, 120))
    assert (tmp_path / "r.mp4").read_bytes()[4:8] == b"ftyp"


def test_the_caption_tells_time_and_last_event(run: RunResult) -> None:
    stop = next(event.time for event in run.events if event.kind == "stop")
    assert caption(run, 0.5 * stop) == f"{0.5 * stop:.2f} s", "observations and reactions are too many"
    assert caption(run, stop + 0.15) == f"{stop + 0.15:.2f} s   rejected at {stop + 0.1:.2f} s"
    renderer = SceneRenderer(assemble(run.problem), SMALL)
    q = run.trajectory(0.0)
    without, with_text = renderer.screenshot(q), renderer.screenshot(q, "1.00 s")
    changed = np.argwhere(np.abs(with_text.astype(int) - without).max(axis=2) > 30)
    assert len(changed) > 20 and changed[:, 0].min() > 0.7 * SMALL[1] and changed[:, 1].max() < 0.5 * SMALL[0]


def test_the_time_line_has_a_row_for_each_kind_of_event(run: RunResult, tmp_path: Path) -> None:
    assert _kinds(run)[::-1] == ["observation", "conflict", "request", "accepted", "rejected", "stop", "goal"]
    plot_run(run, tmp_path / "t.svg")
    text = (tmp_path / "t.svg").read_text()
    assert "<svg" in text
    plot_run(run, tmp_path / "t.png")
    shape = iio.imread(tmp_path / "t.png").shape
    assert shape[1] == 1100 and shape[0] > 500
    bare = replace(run, events=(), problem=run.problem.still, reason="stuck " * 30, outcome=Outcome.STUCK)
    plot_run(bare, tmp_path / "bare.png")
    odd = replace(run, events=(Event(0.2, "a kind of its own"), Event(9.0, "contact")))
    assert _kinds(odd) == ["a kind of its own", "contact"]
    plot_run(odd, tmp_path / "odd.pdf")
    with pytest.raises(ParameterError, match=r"\.png, \.pdf, \.svg"):
        plot_run(run, tmp_path / "t.mp4")


def test_pages_show_the_robot_obstacles_and_events_at_each_time(server: Any, run: RunResult) -> None:
    shown = shown_of(run)
    assert isinstance(shown, SavedRun) and not shown.grows and not shown.is_editable
    page = LivePage(server, [shown])
    assert page.editor is None
    scene, names = page.player.scenes[0], server.scene._handle_from_node_name
    ball, late = run.problem.scene
    for time in (0.1, 0.9, 0.9 * run.trajectory.duration):
        page.player.seek(time)
        np.testing.assert_allclose(scene.obstacles["ball"].position, place_at(ball, time), atol=1e-9)
        assert scene.obstacles["late"].visible == (time >= late.appears)
        np.testing.assert_array_equal(shown.state(time), run.trajectory(time))
    accepted = next(event.time for event in run.events if event.kind == "accepted")
    page.player.seek(accepted + 0.01)
    assert names["/1/event"].text == "accepted"
    assert {"time", "clearance", "velocity"} <= shown.curves.keys()
    assert any("reached" in row for row in shown.facts) and any("1 stops" in row for row in shown.facts)


def test_the_commands_take_files_of_runs(saved: Path, run: RunResult, capsys: pytest.CaptureFixture[str]) -> None:
    folder = saved.parent
    run.save(folder / "run.json")
    for given in (
        ["plot", str(saved), "-o", str(folder / "t.png")],
        ["render", str(folder / "run.json"), "-o", str(folder / "r.png")],
        ["view", str(saved), "-o", str(folder / "p.html")],
    ):
        assert main(given) == 0, capsys.readouterr().err
        assert Path(given[-1]).stat().st_size > 10_000
    text = (folder / "p.html").read_text()
    assert "reached" in text and "share of limit" in text
    bad = folder / "bad.json"
    bad.write_text((folder / "run.json").read_text().replace("apex-ompl/run/1", "apex-ompl/run/9"))
    capsys.readouterr()
    assert main(["plot", str(bad), "-o", str(folder / "t.png")]) == 2
    assert "expected 'apex-ompl/run/1'" in capsys.readouterr().err


def test_files_are_told_apart_by_what_they_hold(
    saved: Path, run: RunResult, result: PlanResult, arm: Robot, tmp_path: Path
) -> None:
    run.save(tmp_path / "a.npz")
    run.save(tmp_path / "b.json")
    result.save(tmp_path / "c.npz")
    for name in ("d.json", "e.yaml"):  # a motion as YAML text takes seconds
        replace(result, trajectory=None).save(tmp_path / name)
    result.problem.save(tmp_path / "f.yaml")
    (tmp_path / "g.json").write_text("{}")
    kinds = [saved_kind(path) for path in sorted(tmp_path.iterdir())]
    assert kinds == [RunResult, RunResult, PlanResult, PlanResult, PlanResult, None, None]
    assert [path.name for path in saved_in(tmp_path)] == ["a.npz", "b.json", "c.npz", "d.json", "e.yaml"]
    assert isinstance(load_saved(tmp_path / "b.json"), RunResult)
    assert isinstance(load_saved(tmp_path / "e.yaml"), PlanResult)
    assert robot_of(run).name == arm.name
    with pytest.raises(RobotError, match="no longer the one"):
        robot_of(replace(run, robot_digest="0" * 16))
