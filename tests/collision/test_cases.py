from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from support import ROOT

from apex_ompl import problems
from apex_ompl.errors import FileFormatError, MissingFileError, ParameterError
from apex_ompl.kernel import Kernel, RobotTables
from apex_ompl.kernel.tables import MADE
from apex_ompl.ompl.setup import assemble
from apex_ompl.ompl.validity import full_check
from apex_ompl.paths.optimizer import Optimizer
from apex_ompl.paths.spline import Spline
from apex_ompl.problems.suite_robot import robot
from apex_ompl.training.engine import PathFinder
from apex_ompl.training.kernel_problems import KernelProblem, load_kernel_problems, save_kernel_problems
from apex_ompl.training.records import SOURCES
from apex_ompl.training.store import Store
from apex_ompl.training.units import Unit, kernel_problems

WITHOUT = """
import runpy, sys
class Nothing:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("pinocchio", "coal", "hppfcl", "ompl", "pydantic"):
            raise ImportError(name)
sys.meta_path.insert(0, Nothing())
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


@pytest.fixture(scope="module")
def cases() -> list[KernelProblem]:
    return [*kernel_problems(Unit("broad", "free", 5, 4)), *kernel_problems(Unit("horizontal", "small", 5, 3))]


def test_what_is_written_is_read(cases: list[KernelProblem], tmp_path: Path) -> None:
    save_kernel_problems(tmp_path, cases)
    again = load_kernel_problems(tmp_path)
    assert len(again) == len(cases) == 7
    for old, new in zip(cases, again, strict=True):
        assert (new.unit, new.suite, new.level, new.strategy) == (old.unit, old.suite, old.level, old.strategy)
        assert new.record.seed == old.record.seed and new.record.held == old.record.held
        assert len(new.record.obstacles) == len(old.record.obstacles)
        for mine, theirs in ((new.start, old.start), (new.goal, old.goal), (new.points, old.points)):
            assert np.array_equal(mine, theirs)
        for mine, theirs in ((new.scene.arrays, old.scene.arrays), (new.robot.arrays, old.robot.arrays)):
            for name in set(mine._fields) - {"exact"} - MADE:  # which are not needed for the same answers
                assert np.array_equal(getattr(mine, name), getattr(theirs, name)), name


def test_they_are_solved_without_pinocchio_coal_and_ompl(cases: list[KernelProblem], tmp_path: Path) -> None:
    """What the spheres proved there passes the full check here, meshes and all."""
    save_kernel_problems(tmp_path / "cases", cases)
    command = [sys.executable, "-c", WITHOUT, str(ROOT / "scripts" / "generate_data.py"), str(tmp_path / "data")]
    command += ["--cases", str(tmp_path / "cases"), "--quiet"]
    result = subprocess.run(command, check=False, capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stderr
    store, spline = Store(tmp_path / "data"), Spline()
    assert store.units() == ["broad-free-00005", "horizontal-small-00005"]
    seen = 0
    for paths in store:
        for k, control in enumerate(paths.control()):
            ready = assemble(problems.load(paths.problem_name(int(paths.arrays["problem"][k]))), robot())
            assert full_check(ready.checker, spline.path(control), paths.start[k], [paths.goal[k]])
            assert SOURCES[paths.arrays["source"][k]] in ("line", "perturbation", "rrtconnect", "reversed")
            seen += 1
    assert seen >= 8


def test_trees_search_in_the_kernel_and_the_seed_decides(cases: list[KernelProblem]) -> None:
    spline, found = Spline(), 0
    for case in cases:
        finder = PathFinder(Kernel(case.robot, case.scene), case.start, case.goal, Optimizer(spline))
        control = finder.search(1)
        if control is None:
            continue
        found += 1
        assert np.array_equal(control[[0, -1]], np.stack([case.start, case.goal]))
        assert np.array_equal(control, finder.search(1))
        shorter = finder.shorten(control)
        assert shorter is None or finder.is_valid(spline.path(shorter))
    assert found >= 5
    finder.iterations = 0
    assert finder.search(1) is None


def test_parts_of_paths_are_valid_where_the_straight_line_is_not(cases: list[KernelProblem]) -> None:
    rng, spline = np.random.default_rng(0), Spline()
    kept = left_out = 0
    for case in cases:
        finder = PathFinder(Kernel(case.robot, case.scene), case.start, case.goal, Optimizer(spline))
        path = finder.optimize_perturbations(rng, line=False, many=True)
        if path is None:
            continue
        states = spline.path(path)
        for _ in range(15):
            first = int(rng.integers(120))
            last = int(rng.integers(first + 90, 256))
            part = finder.part(path, first, last)
            ends = np.round(states[[first, last]], 6)
            if finder.is_valid(ends):
                assert part is None
                left_out += 1
            elif part is not None:
                kept += 1
                assert np.array_equal(part[[0, -1]], ends) and finder.is_valid(spline.path(part))
                assert np.abs(spline.path(part)[128] - states[(first + last) // 2]).max() < 0.5, "it goes the same way"
    assert kept > 3 and left_out > 3


def test_damaged_files_are_named(cases: list[KernelProblem], tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match="cases"):
        save_kernel_problems(tmp_path, [])
    with pytest.raises(MissingFileError, match=r"cases\.npz"):
        load_kernel_problems(tmp_path / "nowhere")
    save_kernel_problems(tmp_path, cases[:2])
    file = tmp_path / "cases.npz"
    whole = file.read_bytes()
    for content in (b"", whole[: len(whole) // 2], b"PK" + whole[2:300]):
        file.write_bytes(content)
        with pytest.raises(FileFormatError, match=r"cases\.npz"):
            load_kernel_problems(tmp_path)
    file.write_bytes(whole)
    with np.load(file) as data:
        arrays = dict(data)
    wrong = {
        "start": arrays["start"][:, :5], "goal": arrays["goal"][:1], "points": arrays["points"][:, :1],
        "kind_count": arrays["kind_count"] + 1, "tree_skip": 0 * arrays["tree_skip"],
        "tree_range": arrays["tree_range"] + 10**6, "open": arrays["open"] + 99, "kind": arrays["kind"] + 7,
        "owner": arrays["owner"].astype(np.int32), "size": arrays["size"][:, :1], "offset": np.nan * arrays["offset"],
    }  # fmt: skip
    for name, value in wrong.items():
        np.savez(file, **{**arrays, name: value})
        with pytest.raises(FileFormatError, match=r"cases\.npz"):
            load_kernel_problems(tmp_path)
    about = json.loads(str(arrays["about"]))
    for key, value in (
        ("unit", "../../evil"),
        ("recipe", "none"),
        ("tables", -1),
        ("things", [[9, [], [], []]]),
        ("seed", "x"),
    ):
        first = {**about["cases"][0], key: value}
        np.savez(file, **{**arrays, "about": json.dumps({**about, "cases": [first, *about["cases"][1:]]})})
        with pytest.raises(FileFormatError, match=r"cases\.npz"):
            load_kernel_problems(tmp_path)
    for other, words in (({**about, "schema": "apex-ompl/cases/0"}, "cases/0"), ({**about, "cases": []}, "cases")):
        np.savez(file, **{**arrays, "about": json.dumps(other)})
        with pytest.raises(FileFormatError, match=words):
            load_kernel_problems(tmp_path)
    file.write_bytes(whole)
    other = RobotTables.load(tmp_path / "tables-0.npz").restricted_to(range(4))
    kept = (tmp_path / "tables-0.npz").read_bytes()
    other.save(tmp_path / "tables-0.npz")
    with pytest.raises(FileFormatError, match="another file"):
        load_kernel_problems(tmp_path)
    (tmp_path / "tables-0.npz").write_bytes(kept)
    assert len(load_kernel_problems(tmp_path)) == 2
    (tmp_path / "tables-0.npz").unlink()
    with pytest.raises(MissingFileError, match="tables-0"):
        load_kernel_problems(tmp_path)
