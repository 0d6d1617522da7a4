from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import ROOT

from apex_ompl import problems
from apex_ompl.collision.checker import NO_POINT
from apex_ompl.errors import ParameterError, UnknownNameError
from apex_ompl.model.geometry import SHAPES
from apex_ompl.ompl.setup import assemble
from apex_ompl.ompl.validity import full_check
from apex_ompl.paths.path import path_length
from apex_ompl.paths.spline import Spline
from apex_ompl.problems.suite_robot import robot
from apex_ompl.training.engine import STRAIGHT_SHARE, EngineOptions
from apex_ompl.training.records import FIELDS, SOURCES, Paths, to_half
from apex_ompl.training.store import Store, load
from apex_ompl.training.units import Unit, plan_units, solve_unit, static_levels
from apex_ompl.util.cluster import ClusterError, spread

SCRIPT = ROOT / "scripts" / "generate_data.py"
UNITS = [
    Unit("vertical", "medium", 3, 4),
    Unit("wall", "easy", 3, 3),
    Unit("broad", "free", 3, 4),
    Unit("broad", "arches", 3, 4),
]


@pytest.fixture(scope="module")
def made() -> list[Paths]:
    return [solve_unit(unit, EngineOptions(), Spline())[0] for unit in UNITS]


def same(a: Paths, b: Paths) -> bool:
    return all(np.array_equal(a.arrays[k], b.arrays[k]) for k in FIELDS) and a.counts == b.counts


def test_every_path_passes_the_full_check_and_its_record_is_true(made: list[Paths]) -> None:
    spline, sources, inner = Spline(), set(), 0
    for paths in made:
        assert len(paths) > 10
        control, a = paths.control(), paths.arrays
        bounds = np.concatenate([[0], np.cumsum(a["things"])]).astype(int)
        for k in range(len(paths)):
            owner = int(a["problem"][k])
            problem = problems.load(paths.problem_name(owner))
            ready = assemble(problem, robot())
            path = spline.path(control[k])
            assert full_check(ready.checker, path, paths.start[k], [paths.goal[k]])
            assert a["length"][k] == pytest.approx(path_length(path), rel=1e-5)
            # The stored clearance is that of the sphere cover at every other state.
            assert ready.checker.kernel.clearance(path[::2], 0.2).min() == pytest.approx(a["clearance"][k], abs=1e-6)
            source = SOURCES[a["source"][k]]
            sources.add(source)
            ends = ready.start, ready.goals[0]
            ends = ends[::-1] if source == "reversed" else ends
            if source != "part":
                assert np.array_equal(path[0], ends[0])
                assert np.array_equal(path[-1], ends[1])
            inner += not any(np.array_equal(path[-1], end) for end in ends)
            straight = bool(full_check(ready.checker, path[[0, -1]]))
            assert not straight or source in ("line", "reversed")
            nearest = ready.checker.distance(path[0])
            point = nearest.points[1] if problem.scene else NO_POINT
            np.testing.assert_allclose(a["point"][k], point, atol=1e-3)
            mine, things = slice(bounds[owner], bounds[owner + 1]), problems.primitives(problem, enclosing=True)
            np.testing.assert_allclose(a["position"][mine], [o.position for o in things] or np.zeros((0, 3)), atol=1e-6)
            for number, obstacle in zip(a["shape"][mine], things, strict=True):
                assert getattr(obstacle, SHAPES[number]) is not None
    assert {"perturbation", "rrtconnect", "reversed", "part"} <= sources
    assert inner > 0, "some parts end where no path does"


def test_the_same_seed_gives_the_same_paths_and_another_one_others(made: list[Paths]) -> None:
    assert same(solve_unit(UNITS[1], EngineOptions(), Spline())[0], made[1])
    assert not same(solve_unit(UNITS[1], EngineOptions(seed=1), Spline())[0], made[1])


def test_problems_that_a_line_solves_are_few() -> None:
    paths, _ = solve_unit(Unit("vertical", "free", 1, 10), EngineOptions(copies=1, parts=0), Spline())
    lines = int((paths.arrays["source"] == SOURCES.index("line")).sum())
    assert paths.counts["straight, left out"] > 0
    assert lines <= STRAIGHT_SHARE * paths.problems


def test_units_cover_all_static_levels_with_training_seeds() -> None:
    units = plan_units(3000)
    assert {(u.suite, u.level) for u in units} == set(static_levels())
    assert len({u.name for u in units}) == len(units)
    assert 0.8 * 3000 < sum(u.size for u in units) < 1.2 * 3000
    assert max(u.seeds.stop for u in units) <= 800_000
    more = {u.name for u in plan_units(4000)}
    assert {u.name for u in units} <= more, "a larger set goes on with a smaller one"
    assert {u.suite for u in plan_units(10, ["shelf"])} == {"shelf"}
    assert {(u.suite, u.level) for u in plan_units(10, ["cage/hard"])} == {("cage", "hard")}
    with pytest.raises(UnknownNameError, match="shelv"):
        plan_units(10, ["shelv"])
    with pytest.raises(UnknownNameError, match="moving"):
        plan_units(10, ["vertical/moving-large-0.2"])


def test_half_precision_stays_inside_the_limits() -> None:
    lower, upper = robot().limits.lower, robot().limits.upper
    control = np.stack([lower, upper, np.nextafter(upper, -np.inf)])
    half = to_half(control, lower, upper)
    assert (half >= lower).all() and (half <= upper).all()
    assert np.array_equal(half, half.astype(np.float16)) and np.abs(half - control).max() < 4e-3


SMALL = ("vertical/small", "wall/easy", "broad/free", "--problems", 24, "--parts", 1, "--quiet")


def test_a_killed_run_goes_on_and_ends_as_one_that_was_not(tmp_path: Path, script_here: Any) -> None:
    whole = script_here(SCRIPT.name, tmp_path / "whole", *SMALL)
    assert whole.returncode == 0, whole.stderr
    wanted = Store(tmp_path / "whole")
    command = [sys.executable, str(SCRIPT), str(tmp_path / "killed"), *map(str, SMALL)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    units = tmp_path / "killed" / "units"
    until = time.monotonic() + 120
    while time.monotonic() < until and not (units.is_dir() and list(units.glob("[!.]*.zip"))):
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    before = {p.name: p.stat().st_mtime_ns for p in units.glob("[!.]*.zip")}
    assert 0 < len(before) < len(wanted.units())
    assert script_here(SCRIPT.name, tmp_path / "killed", *SMALL).returncode == 0
    killed = Store(tmp_path / "killed")
    assert killed.units() == wanted.units()
    assert all(same(killed.read(name), wanted.read(name)) for name in wanted.units())
    assert all((units / name).stat().st_mtime_ns == stamp for name, stamp in before.items()), "made once"
    assert killed.manifest["counts"] == wanted.manifest["counts"]
    again = script_here(SCRIPT.name, tmp_path / "killed", *SMALL)
    assert again.returncode == 0 and "nothing was left to do" in again.stdout


def test_a_set_is_described_and_made_compact(made: list[Paths], tmp_path: Path, script_here: Any) -> None:
    store = Store.create(tmp_path / "data", {}, {})
    for unit, paths in zip(UNITS, made, strict=True):
        store.write(unit.name, paths)
    command = ("compact_data.py", tmp_path / "data", tmp_path / "c.zip")
    assert script_here(*command).returncode == 0
    size = 0.8 * (tmp_path / "c.zip").stat().st_size
    assert len(load(tmp_path / "c.zip")) == sum(map(len, made))
    done = script_here(*command, "--mib", size / 2**20)
    assert done.returncode == 0, done.stderr
    few, all_of_them = load(tmp_path / "c.zip"), Paths.concatenate(store)
    assert (tmp_path / "c.zip").stat().st_size <= size
    assert few.problems == all_of_them.problems and 10 < len(few) < len(all_of_them)
    parts = SOURCES.index("part")
    assert (few.arrays["source"] != parts).sum() == (all_of_them.arrays["source"] != parts).sum(), "parts go first"
    done = script_here(*command, "--mib", "0.001")
    assert done.returncode == 2 and "expected a higher limit" in done.stderr
    command = ("describe_data.py", tmp_path / "c.zip")
    done = script_here(*command, "--out", tmp_path, "--check", "5", "--motions", "2")
    assert done.returncode == 0, done.stderr
    text = (tmp_path / "description.md").read_text()
    assert f"{len(few)} paths of {few.problems} problems" in text
    assert "5 of 5 random paths pass the full check" in text
    for name in ("figures.png", "motions.jpg"):
        assert (tmp_path / name).stat().st_size > 10_000
    done = script_here(*command, "--out", "/nowhere")
    assert done.returncode == 2 and "does not exist" in done.stderr and "Traceback" not in done.stderr


def test_faults_of_the_command_are_sentences(tmp_path: Path, script_here: Any) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "manifest.json").write_text('{"schema": "apex-ompl/dataset/0"}')
    cases = [
        ((tmp_path / "file", "wall/easy"), "file"),
        ((tmp_path / "old", "wall/easy"), "expected 'apex-ompl/dataset/1'"),
        ((tmp_path / "new", "wal/easy"), "did you mean 'wall/easy'"),
        ((tmp_path / "new", "--problems", "-3"), "expected a whole number"),
        ((tmp_path / "new", "--control-points", "5"), "points: expected a whole number, 6 or more"),
        ((tmp_path / "new", "wall/easy", "--address", "127.0.0.1:1"), "Ray"),
    ]
    for arguments, words in cases:
        result = script_here(SCRIPT.name, *arguments)
        assert result.returncode == 2 and words in result.stderr and "Traceback" not in result.stderr, result.stderr
    assert not (tmp_path / "new" / "units").exists() or not list((tmp_path / "new" / "units").iterdir())


def test_workers_of_ray_make_the_same_paths_and_may_die(made: list[Paths]) -> None:
    """Two workers give what one gives; one that dies over a unit twice is a sentence, and so is one that fails."""
    ray = pytest.importorskip("ray")
    options: dict = {"workers": 2, "address": None}
    try:
        ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, logging_level="error")
    except Exception as error:  # sandboxes without sockets or shared memory
        pytest.skip(f"Ray does not start here: {error}")
    try:
        units = {unit.name: (unit, EngineOptions(), Spline()) for unit in UNITS[1:3]}
        found = {name: paths for name, (paths, _) in spread(solve_unit, units, **options)}
        assert all(same(found[unit.name], paths) for unit, paths in zip(UNITS[1:3], made[1:3], strict=True))

        def fails(unit: int) -> int:
            if unit == 1:
                os._exit(1)
            if unit == 2:
                raise ValueError("no unit 2")
            return unit

        done = []
        with pytest.raises(ClusterError, match=r"b: its worker died twice .*the same command continues"):
            for name, _ in spread(fails, {"a": (0,), "b": (1,)}, **options):
                done.append(name)
        assert done == ["a"]
        rest = dict(spread(fails, {"a": (0,), "b": (1,), "d": (3,)}, lost=lambda name: f"{name} lost", **options))
        assert rest == {"a": 0, "b": "b lost", "d": 3}
        with pytest.raises(ClusterError, match="c: no unit 2"):
            list(spread(fails, {"c": (2,)}, **options))
    finally:
        ray.shutdown()


def test_paths_from_a_models_proposals_pass_the_full_check() -> None:
    unit, options = Unit("posts", "hard", 3, 3), EngineOptions(copies=2, parts=0, model="apex")
    paths, times = solve_unit(unit, options, Spline())
    assert "model" in {SOURCES[k] for k in paths.arrays["source"]} and times["model"] > 0.0
    assert same(paths, solve_unit(unit, options, Spline())[0])
    for k in range(len(paths)):
        ready = assemble(problems.load(paths.problem_name(paths.arrays["problem"][k])), robot())
        assert full_check(ready.checker, paths.spline.path(paths.control(slice(k, k + 1))[0]))
    with pytest.raises(ParameterError, match="model: expected one of paths by"):
        solve_unit(unit, options, Spline(16))
