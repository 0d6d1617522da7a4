from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
from PIL import Image, ImageSequence
from small_arm import arm_problem

from apex_ompl import plan
from apex_ompl.errors import MissingFileError, ParameterError
from apex_ompl.ompl.setup import assemble
from apex_ompl.scene.problem import Problem
from apex_ompl.viz.render import render
from apex_ompl.viz.scene_renderer import SceneRenderer

SMALL = (320, 240)


def test_a_problem_becomes_a_picture_with_start_goal_and_obstacles(problem: Problem, tmp_path: Path) -> None:
    render(problem, tmp_path / "p.png", SMALL)
    picture = iio.imread(tmp_path / "p.png").astype(int)
    assert picture.shape[:2] == SMALL[::-1]
    red = (picture[..., 0] > picture[..., 1] + 40) & (picture[..., 0] > picture[..., 2] + 40)
    assert 100 < red.sum() < 10000  # the post
    background = picture[2, 2]
    assert 0.15 < (np.abs(picture - background).max(axis=2) > 8).mean() < 0.9


def test_the_robot_is_drawn_where_it_is(problem: Problem) -> None:
    ready = assemble(problem)
    renderer = SceneRenderer(ready, SMALL)
    first, second = renderer.screenshot(ready.start).astype(int), renderer.screenshot(ready.goals[0]).astype(int)
    assert (np.abs(first - second).max(axis=2) > 20).sum() > 500
    assert np.abs(first - renderer.screenshot(ready.start)).mean() < 1.0


def test_a_result_becomes_a_strip_and_a_film(tmp_path: Path) -> None:
    problem = arm_problem(tmp_path)
    result = plan(problem, timeout=20.0)
    for name in ("r.png", "r.gif", "r.mp4"):
        render(result, tmp_path / name, SMALL)
    assert iio.imread(tmp_path / "r.png").shape[:2] == (SMALL[1] // 2 * 2, SMALL[0] // 2 * 3)
    assert result.trajectory is not None
    shown = int(np.ceil(24 * result.trajectory.duration)) + 1
    with Image.open(tmp_path / "r.gif") as film:  # equal frames are kept once, for the time of all of them
        times = [frame.info["duration"] for frame in ImageSequence.Iterator(film)]
    whole = 1000.0 * (shown + 12) / 24  # each for 1/24 s, the last one for half a second [ms]
    assert 0.96 * whole <= sum(times) <= whole, "GIF rounds times down to 10 ms, so 1/24 s to 40 ms"
    assert (tmp_path / "r.mp4").read_bytes()[4:8] == b"ftyp"
    with pytest.raises(ParameterError, match="result with a path"):
        render(replace(result, path=None), tmp_path / "none.png", SMALL)
    with pytest.raises(ParameterError, match=r"\.png, \.gif, \.mp4"):
        render(result, tmp_path / "r.jpg")
    with pytest.raises(ParameterError, match="films are of results"):
        render(problem, tmp_path / "p.gif")
    with pytest.raises(MissingFileError, match="does not exist"):
        render(problem, tmp_path / "no" / "p.png")


def test_the_command_draws_problems_and_results(apex_cli, tmp_path: Path) -> None:
    problem = arm_problem(tmp_path)
    problem.save(tmp_path / "p.yaml")
    plan(problem, timeout=20.0).save(tmp_path / "r.json")
    for source in ("p.yaml", "r.json"):
        done = apex_cli("render", tmp_path / source, "-o", tmp_path / "x.png", "--azimuth", 150)
        assert done.returncode == 0 and (tmp_path / "x.png").stat().st_size > 10_000, done.stderr
        (tmp_path / "x.png").unlink()
    done = apex_cli("render", "no_such_problem", "-o", tmp_path / "x.png")
    assert done.returncode == 2 and "no_such_problem" in done.stderr
