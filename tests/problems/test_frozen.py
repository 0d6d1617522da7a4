"""The frozen problems: complete, unchanged, and each with a witness that is a valid path."""

from __future__ import annotations

import hashlib
import json
import lzma
import runpy
import shutil
from pathlib import Path

import numpy as np
import pytest
from support import ROOT

from apex_ompl import problems
from apex_ompl.collision import CollisionChecker
from apex_ompl.constraints.constraint_set import ConstraintSet
from apex_ompl.errors import FileFormatError, MissingFileError, ParameterError, UnknownNameError
from apex_ompl.moving.timed_proof import check_timed_path
from apex_ompl.ompl.validity import full_check
from apex_ompl.paths.path import resample
from apex_ompl.problems import constrained_held, frozen
from apex_ompl.problems.catalogue import ProblemId, first_drawn
from apex_ompl.problems.suite_robot import robot
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import Obstacle

FOLDER = ROOT / "problems" / "frozen"
SUITE_LEVELS = [(suite, level) for suite, levels in problems.suites().items() for level in levels]
# Published results refer to these problems. With other frozen problems they have to be measured again.
FROZEN = "1cb754585edcab18c1cdcf74f26f220a679f7ef7b3be7d328d9be834b31a0b60"
MOVING = [pair for pair in SUITE_LEVELS if pair[1].startswith("moving-")]
STATIC = [pair for pair in SUITE_LEVELS if pair not in MOVING]


def test_the_files_match_their_hashes_and_are_small() -> None:
    sums = (FOLDER / "SHA256SUMS").read_text()
    constrained = tuple(f"-{level}.json.xz\n" for level in constrained_held.KINDS)
    kept = "".join(line for line in sums.splitlines(keepends=True) if not line.endswith(constrained))
    assert hashlib.sha256(kept.encode()).hexdigest() == FROZEN
    lines = [line.split() for line in sums.splitlines()]
    there = [pair for pair in frozen.suite_levels() if pair in SUITE_LEVELS or frozen.exists(*pair)]
    assert {name for _, name in lines} == {f"{suite}-{level}.json.xz" for suite, level in there}
    for wanted, name in lines:
        assert hashlib.sha256((FOLDER / name).read_bytes()).hexdigest() == wanted
    assert sum(path.stat().st_size for path in FOLDER.iterdir()) < 10 * 2**20


@pytest.mark.parametrize(("suite", "level"), SUITE_LEVELS)
def test_the_first_problems_of_validation_and_test_are_frozen(robot: Robot, suite: str, level: str) -> None:
    counts = (20, 10) if level.startswith("moving-") else (30, 20) if level == "extreme" else (100, 30)
    names = [problems.frozen_names(suite, level, split) for split in ("test", "validation")]
    for first, count, some in zip((900_000, 800_000), counts, names, strict=True):
        assert some == tuple(f"{suite}/{level}/{first + k}" for k in range(count))
    digests, some = set(), [name for split in names for name in split[::5]]  # the files are those of their hashes
    for name in some:
        problem, witness = problems.load(name), problems.witness(name)
        digests.add(frozen.digest(problem.model_copy(update={"name": "any"})))
        assert problem.name == name and bool(problem.moving) == level.startswith("moving-")
        assert np.array_equal(witness.path[0], problem.start_state(robot.joint_names))
        assert np.array_equal(witness.path[-1], problem.goal_states(robot.joint_names)[0])
        assert (witness.times is not None) == bool(problem.moving)
    assert len(digests) == len(some)


@pytest.mark.parametrize(("suite", "level"), STATIC)
def test_witnesses_pass_the_full_check(robot: Robot, suite: str, level: str) -> None:
    """Some of each level; scripts/check_frozen.py checks all."""
    for name in problems.frozen_names(suite, level)[::34]:
        problem, witness = problems.load(name), problems.witness(name)
        checker = CollisionChecker(robot, problem.scene, problem.attached)
        check = full_check(checker, witness.path, witness.path[0], problem.goal_states(robot.joint_names))
        assert check, check.reason
        # An obstacle at the right palm in the middle of the path is reported.
        palm = robot.link_pose(resample(witness.path, 3)[1], "right_hand_palm")[:3, 3]
        checker.add(Obstacle(name="at_the_palm", sphere={"radius": 0.03}, position=tuple(palm)))
        assert "at_the_palm" in full_check(checker, witness.path, witness.path[0], [witness.path[-1]]).reason


@pytest.mark.parametrize(("suite", "level"), MOVING)
def test_timed_witnesses_pass_their_check(robot: Robot, suite: str, level: str) -> None:
    for name in problems.frozen_names(suite, level)[3::33]:
        witness = problems.witness(name)
        check = check_timed_path(robot, problems.load(name), witness.path, witness.times)
        assert check, check.reason


@pytest.fixture
def folder_copy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with copies of two files of frozen problems, in place of the real one."""
    for name in ("swap-easy.json.xz", "vertical-small.json.xz", "SHA256SUMS"):
        shutil.copy(FOLDER / name, tmp_path / name)
    monkeypatch.setattr(frozen, "FOLDER", tmp_path)
    frozen.clear_cache()
    yield tmp_path
    frozen.clear_cache()


def test_saving_and_loading_are_inverse(folder_copy: Path) -> None:
    seeds = (900_000, 900_007, 800_003)
    some = {seed: frozen.load(ProblemId("vertical", "small", seed)) for seed in seeds}
    (folder_copy / "vertical-small.json.xz").unlink()
    frozen.save("vertical", "small", some, 3)
    with pytest.raises(ParameterError, match="vertical-small.json.xz exists"):
        frozen.save("vertical", "small", some, 3)
    for seed, item in some.items():
        again = frozen.load(ProblemId("vertical", "small", seed))
        assert again.problem == item.problem and again.draw_number == item.draw_number
        assert np.array_equal(again.witness.path, item.witness.path)


def test_meshes_and_points_are_stored_as_their_parts_and_made_again(folder_copy: Path) -> None:
    drawn = (first_drawn(ProblemId("unseen", "net", 800_500 + k))[1] for k in range(30))
    one = next(found for found in drawn if found.groups)
    problem, line = one.to_problem("unseen/net/800007", robot()), frozen.Witness(np.stack([one.start, one.goal]))
    kept = frozen.FrozenProblem(problem, line, 2, one.scene, one.groups)
    frozen.save("unseen", "net", {800_007: kept}, 4)
    text = lzma.decompress((folder_copy / "unseen-net.json.xz").read_bytes()).decode()
    assert "file" not in text, "no meshes and no points"
    again = frozen.load(ProblemId("unseen", "net", 800_007))
    assert again.problem == problem and again.digest == kept.digest and again.groups == one.groups
    assert problems.primitives(again.problem) == one.scene
    assert frozen.load_level("unseen", "net")[1] == 4
    assert problems.frozen_names("unseen", "net", "validation")[7] == "unseen/net/800007"
    assert problems.frozen_names("unseen", "net", "test") == ()


def test_witnesses_under_constraints_are_moved_onto_them(folder_copy: Path) -> None:
    name = ProblemId("wall", "level", 900_004)
    assert not frozen.is_frozen(name), "the folder has no file of that level"
    number, drawn = first_drawn(name)
    problem, q = drawn.to_problem(str(name), robot()), np.stack([drawn.start, drawn.goal])
    constraints = ConstraintSet.of(robot(), problem.constraints, problem.attached, q[0])
    off = np.stack([q[0], q[0] + 0.004 * np.eye(16)[2], q[0]])
    assert not constraints.is_satisfied(off[1])
    frozen.save("wall", "level", {name.seed: frozen.FrozenProblem(problem, frozen.Witness(q), number)}, 1)
    again = frozen.load(name)
    assert frozen.is_frozen(name) and again.problem == problem and again.problem.constraints == drawn.constraints
    assert again.problem.attached[0].links == problem.attached[0].links
    states = frozen.on_constraints(problem, off)
    assert states is not None and (constraints.violations(states) <= constraints.tolerances).all()
    assert np.array_equal(states[[0, -1]], off[[0, -1]])
    assert frozen.on_constraints(problem, np.stack([q[0], np.full(16, 2.0), q[1]])) is None


def test_a_changed_or_missing_file_is_reported_and_no_problem_is_drawn(folder_copy: Path) -> None:
    file = folder_copy / "swap-easy.json.xz"
    assert problems.load("swap/easy/900003").name == "swap/easy/900003"
    frozen.clear_cache()
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)
    with pytest.raises(FileFormatError, match="swap-easy.json.xz: SHA-256"):
        problems.load("swap/easy/900003")
    file.unlink()
    with pytest.raises(MissingFileError, match="swap-easy.json.xz"):
        problems.sample("swap", level="easy", seed=900_003)
    assert problems.load("swap/easy/900100").name == "swap/easy/900100"  # after the last frozen problem


def changed_file(folder_copy: Path, change) -> None:
    """Change the content of a file of frozen problems, and its hash in ``SHA256SUMS``."""
    file = folder_copy / "swap-easy.json.xz"
    data = json.loads(lzma.decompress(file.read_bytes()))
    content = change(data)
    content = content if isinstance(content, bytes) else lzma.compress(json.dumps(content).encode())
    file.write_bytes(content)
    (folder_copy / "SHA256SUMS").write_text(f"{hashlib.sha256(content).hexdigest()}  swap-easy.json.xz\n")
    frozen.clear_cache()


def first_row(change) -> object:
    def apply(data: dict) -> dict:
        change(next(row for row in data["problems"] if row["seed"] == 900_000))
        return data

    return apply


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda data: b"not xz", "LZMA"),
        (lambda data: lzma.compress(b"{"), "JSON"),
        (lambda data: [], "JSON"),
        (lambda data: {**data, "schema": "apex-ompl/frozen/9"}, "schema"),
        (lambda data: {**data, "level": "hard"}, "level"),
        (lambda data: {**data, "robot": "baxter"}, "robot"),
        (lambda data: {**data, "joints": ["a"]}, "joints"),
        (lambda data: {**data, "problems": data["problems"] * 2}, "once"),
        (lambda data: {**data, "held": None}, "held"),
        (lambda data: {**data, "problems": data["problems"][1:2]}, "none with seed 900000"),
        (first_row(lambda row: row.pop("draw")), "seed 900000"),
        (first_row(lambda row: row.update(held=7)), "seed 900000"),
        (first_row(lambda row: row["start"].pop()), "seed 900000"),
        (first_row(lambda row: row["path"].append([1])), "900000"),
        (first_row(lambda row: row.update(scene=[{"name": "x"}])), "scene"),
    ],
)
def test_invalid_content_with_a_valid_hash_is_reported_in_one_sentence(folder_copy: Path, change, message: str) -> None:
    changed_file(folder_copy, change)
    with pytest.raises(FileFormatError, match=message) as caught:
        problems.load("swap/easy/900000")
    assert "swap-easy.json.xz" in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("line", ["one", "a b c", f"{'0' * 64}  swap-easy.json.xz"])
def test_an_invalid_file_of_hashes_is_reported(folder_copy: Path, line: str) -> None:
    with (folder_copy / "SHA256SUMS").open("a") as file:
        file.write(line + "\n")
    frozen.clear_cache()
    with pytest.raises(FileFormatError, match="SHA256SUMS"):
        problems.load("swap/easy/900000")


def test_only_frozen_problems_have_witnesses() -> None:
    for name in ("swap/easy/12", "swap/easy/900100", "ball_in_cup"):
        with pytest.raises(ParameterError, match="frozen"):
            problems.witness(name)
    with pytest.raises(UnknownNameError, match="train"):
        problems.frozen_names("swap", "easy", "train")


@pytest.mark.parametrize("name", ["shelf/tray/900000", "clutter/tray/900000", "shelf/level/900000"])
def test_the_script_checks_witnesses_under_constraints_on_them(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """They are stored in steps of .1 mrad, which leave a limit by a last bit, and a closed chain by more."""
    fault = runpy.run_path(str(ROOT / "scripts" / "check_frozen.py"))["fault"]
    assert fault(name) == ""
    path = problems.witness(name).path.copy()
    path[len(path) // 2] = 2.0  # elbows over their limits, hands in each other
    monkeypatch.setattr(problems, "witness", lambda name: frozen.Witness(path))
    assert fault(name) != ""
