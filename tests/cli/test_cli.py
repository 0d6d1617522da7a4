from __future__ import annotations

import errno
import json
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from support import ROOT

from apex_ompl.cli.parser import main
from apex_ompl.scene.problem import Problem

# Around the left shoulder: in collision with the arm at every state.
BLOB = {"name": "blob", "sphere": {"radius": 0.1}, "position": [0.0, 0.5, 0.45]}
GOOD = (ROOT / "problems" / "data" / "shelf_swap.yaml").read_text()


def one_sentence(text: str) -> bool:
    return text.startswith("apex-ompl") and len(text.strip().splitlines()) == 1 and "Traceback" not in text


@pytest.fixture
def easy(problem: Problem, tmp_path: Path) -> Path:
    problem.save(tmp_path / "easy.yaml")
    return tmp_path / "easy.yaml"


def test_plan_prints_status_time_and_length(apex_cli, easy: Path) -> None:
    done = apex_cli("plan", easy, "--timeout", 30, "--seed", 3)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[0].startswith("sweep: EXACT_SOLUTION by ")
    assert lines[2].startswith("  solve      query 0.") and lines[7].endswith("planner apex, seed 3")
    assert "time" in lines[1] and "length" in lines[3] and "clearance" in lines[4]
    assert lines[5].startswith("  motion     ") and ", jerk " in lines[6]


def test_json_goes_to_standard_output_alone_and_out_writes_the_same(apex_process, easy: Path, tmp_path: Path) -> None:
    done = apex_process("plan", easy, "--timeout", 30, "--json", "--set", "range=1.5", "--out", tmp_path / "r.json")
    assert done.returncode == 0, done.stderr
    printed = json.loads(done.stdout)
    assert printed["status"] == "EXACT_SOLUTION"
    assert printed == json.loads((tmp_path / "r.json").read_text())
    names = ("status", "reason", "planner", "seed", "path", "times", "length", "clearance", "checks", "solved_by")
    assert set(names) <= set(printed)


def test_parameters_of_a_file_have_names(apex_cli, easy: Path, tmp_path: Path) -> None:
    (tmp_path / "params.yaml").write_text("no: true\n")  # which YAML reads as a truth value
    done = apex_cli("plan", easy, "--params", tmp_path / "params.yaml")
    assert done.returncode == 2 and one_sentence(done.stderr) and "params.yaml" in done.stderr, done.stderr


@pytest.mark.parametrize("suffix", [".npz", ".csv", ".yaml"])
def test_out_writes_by_suffix(apex_cli, easy: Path, tmp_path: Path, suffix: str) -> None:
    done = apex_cli("plan", easy, "--timeout", 30, "--out", tmp_path / f"r{suffix}")
    assert done.returncode == 0 and (tmp_path / f"r{suffix}").stat().st_size > 100


def test_listings(apex_cli) -> None:
    problems, planners, info = (apex_cli(c) for c in ("problems", "planners", "info"))
    assert problems.returncode == planners.returncode == info.returncode == 0
    assert "shelf_swap" in problems.stdout and "reach_past_post" in problems.stdout
    assert "rrtconnect" in planners.stdout and "range = 0.0 rad" in planners.stdout
    assert "ompl" in info.stdout and "baxter" in info.stdout and "left_hand_synergy" in info.stdout
    schema = json.loads(apex_cli("schema").stdout)
    assert "start" in schema["required"]
    assert apex_cli("--version").stdout.startswith("apex-ompl 0.")
    assert "plan" in apex_cli("--help").stdout


def test_check_says_what_is_free_and_what_touches(apex_cli, tmp_path: Path) -> None:
    good = apex_cli("check", "shelf_swap")
    assert good.returncode == 0 and good.stdout.count("free") == 2
    data = yaml.safe_load(GOOD)
    data["scene"] = [BLOB]
    (tmp_path / "bad.yaml").write_text(yaml.safe_dump(data))
    bad = apex_cli("check", tmp_path / "bad.yaml")
    assert bad.returncode == 3 and "mm deep" in bad.stdout and "<-> blob" in bad.stdout


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"payload": {"nohand": 1.0}}, "unknown payload 'nohand'"),
        ({"after": [{"kind": "wait", "seconds": 1.0}, {"kind": "detach", "object": "cup"}]}, "after.1.object: "),
        ({"after": [{"kind": "move", "goal": {"any_of": [
            {"poses": [{"frame": "left_hand", "position": [0.5, 0.2, 0.4], "orientation": [1, 0, 0, 0],
                        "approach": [0, 0, by]}]} for by in (0.1, 0.2)]}}]}, "approach: expected the same frames"),
    ],
    ids=["payload", "step", "approaches"],
)  # fmt: skip
def test_check_prints_nothing_of_a_faulty_problem(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], fields: dict[str, object], words: str
) -> None:
    assert main(["check", str(edited(tmp_path, **fields))]) == 2
    told = capsys.readouterr()
    assert not told.out and words in told.err and one_sentence(told.err)


def edited(tmp_path: Path, **changes: object) -> Path:
    data = yaml.safe_load(GOOD)
    for key, value in changes.items():
        part, _, rest = key.partition("__")
        if rest:
            data[part][rest] = value
        else:
            data[part] = value
    path = tmp_path / "edited.yaml"
    path.write_text(yaml.safe_dump(data))
    return path


CUBE = {"name": "b", "box": [0.1, 0.1, 0.1]}
MESH = {"name": "b", "mesh": {"file": "b.stl"}}
FAULTS = {
    "missing file": (lambda t: ["plan", t / "gone.yaml"], 2, ["gone.yaml", "no such file"]),
    "unknown problem": (lambda t: ["plan", "shelf_swp"], 2, ["'shelf_swp'", "did you mean 'shelf_swap'"]),
    "not yaml": (lambda t: ["plan", edited_text(t, "start: {a: [")], 2, ["line", "valid YAML"]),
    "wrong version": (lambda t: ["plan", edited(t, schema="apex-ompl/problem/7")], 2, ["schema", "problem/1"]),
    "unknown key": (lambda t: ["plan", edited(t, scnee=[])], 2, ["scnee", "did you mean 'scene'"]),
    "unknown joint": (lambda t: ["plan", edited(t, start__left_joint9=0.0)], 2, ["left_joint9", "did you mean"]),
    "missing joint": (lambda t: ["plan", edited(t, start={"left_joint1": 0.0})], 2, ["'left_joint2' is missing"]),
    "nan": (lambda t: ["plan", edited(t, start__left_joint3=float("nan"))], 2, ["start.left_joint3", "finite"]),
    "wrong dimension": (lambda t: ["plan", edited(t, scene=[{"name": "b", "box": [1, 2]}])], 2, ["scene.0.box"]),
    "unknown robot": (lambda t: ["plan", edited(t, robot="tripanda")], 2, ["robot 'tripanda'", "dual_panda_softhand"]),
    "missing mesh": (lambda t: ["plan", edited(t, scene=[MESH])], 2, ["'b'", "b.stl"]),
    "name of a link": (lambda t: ["plan", edited(t, scene=[{**CUBE, "name": "left_link1"}])], 2, ["left_link1"]),
    "unknown link": (
        lambda t: ["plan", edited(t, attached=[{**CUBE, "link": "left_plam"}])],
        2,
        ["link 'left_plam'"],
    ),
    "unknown planner": (lambda t: ["plan", "shelf_swap", "--planner", "rtr"], 2, ["planner 'rtr'", "rrtconnect"]),
    "unknown parameter": (lambda t: ["plan", "shelf_swap", "--set", "rnge=1"], 2, ["'rnge'", "did you mean 'range'"]),
    "bad parameter": (lambda t: ["plan", "shelf_swap", "--set", "range=far"], 2, ["'range'", "a number", "'far'"]),
    "bad --set": (lambda t: ["plan", "shelf_swap", "--set", "range"], 2, ["--set", "NAME=VALUE"]),
    "own name as parameter": (lambda t: ["plan", "shelf_swap", "--set", "name=1"], 2, ["unknown parameter 'name'"]),
    "huge whole number": (
        lambda t: ["plan", "shelf_swap", "--planner", "prm", "--set", "max_nearest_neighbors=99999999999"],
        2,
        ["'max_nearest_neighbors'", "99999999999"],
    ),
    "impossible name": (lambda t: ["plan", "shelf_swap", "--out", t / ("n" * 300 + ".npz")], 2, ["this name"]),
    "zero timeout": (lambda t: ["plan", "shelf_swap", "--timeout", "0"], 2, ["timeout", "positive"]),
    "negative timeout": (lambda t: ["plan", "shelf_swap", "--timeout=-1"], 2, ["timeout", "positive"]),
    "not a number": (lambda t: ["plan", "shelf_swap", "--timeout", "soon"], 2, ["--timeout", "'soon'"]),
    "no output folder": (lambda t: ["plan", "shelf_swap", "--out", t / "no" / "r.npz"], 2, ["r.npz", "does not exist"]),
    "output suffix": (lambda t: ["plan", "shelf_swap", "--out", t / "r.bag"], 2, ["r.bag", ".npz"]),
    "output is a folder": (lambda t: ["plan", "shelf_swap", "--out", folder(t, "r.npz")], 2, ["r.npz", "is a folder"]),
    "no command": (lambda t: [], 2, ["COMMAND"]),
    "unknown option": (lambda t: ["plan", "shelf_swap", "--fast"], 2, ["--fast"]),
    "limits broken": (
        lambda t: ["plan", edited(t, start__left_joint2=3.0)],
        3,
        ["INVALID_START", "left_joint2 = 3", "[-1.7628, 1.7628]"],
    ),
    "start in collision": (
        lambda t: ["plan", edited(t, scene=[BLOB])],
        3,
        ["INVALID_START", "left_link", "<-> blob", "mm deep"],
    ),
    "approximate": (lambda t: ["plan", "shelf_swap", "--planner", "rrt", "--timeout", ".2"], 4, ["APPROXIMATE_SOL"]),
    "no plan": (lambda t: ["plan", "shelf_swap", "--timeout", "0.00001"], 1, ["TIMEOUT"]),
}  # fmt: skip


def edited_text(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "edited.yaml"
    path.write_text(text)
    return path


def folder(tmp_path: Path, name: str) -> Path:
    (tmp_path / name).mkdir()
    return tmp_path / name


@pytest.mark.parametrize("case", FAULTS)
def test_each_fault_is_one_sentence_and_an_exit_code(apex_cli, tmp_path: Path, case: str) -> None:
    arguments, code, words = FAULTS[case]
    done = apex_cli(*arguments(tmp_path))
    assert done.returncode == code, done.stderr + done.stdout
    assert "Traceback" not in done.stderr
    if code == 2:
        assert one_sentence(done.stderr) and done.stdout == "", done.stderr
    output = done.stderr if code == 2 else done.stdout
    for word in words:
        assert word in output, output
    leftovers = {p.name for p in tmp_path.iterdir()} - {"edited.yaml", "r.npz"}
    assert not leftovers


@pytest.mark.parametrize("case", ["no plan", "wrong version", "start in collision", "approximate"])
def test_exit_codes_are_those_of_the_process(apex_process, tmp_path: Path, case: str) -> None:
    arguments, code, words = FAULTS[case]
    done = apex_process(*arguments(tmp_path))
    assert done.returncode == code and "Traceback" not in done.stderr
    output, other = (done.stderr, done.stdout) if code == 2 else (done.stdout, done.stderr)
    assert all(word in output for word in words) and (code != 2 or not other)


def test_an_output_that_cannot_be_written_is_reported(apex_cli, easy: Path) -> None:
    """No file can be made in /proc, not even by root."""
    done = apex_cli("plan", easy, "--out", "/proc/r.npz")
    assert done.returncode == 2 and one_sentence(done.stderr) and "/proc/r.npz" in done.stderr


def cpu_time(pid: int) -> float:
    """CPU time of a process [s], which unlike elapsed time does not depend on the load of the machine."""
    user, system = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


@pytest.fixture(scope="module")
def set_up() -> float:
    """CPU time of imports and set-up [s], by this machine as it is loaded now."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, "-m", "apex_ompl.cli", "plan", "shelf_swap", "--planner", "rrtstar", "--timeout", "0.01"]
    subprocess.run(command, check=False, capture_output=True, timeout=300)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


@pytest.mark.parametrize(
    ("planner", "settings"),
    [("rrtconnect", ["range=0.001"]), ("prm", ["max_nearest_neighbors=1"]), ("rrtstar", [])],
)
def test_ctrl_c_ends_a_plan_with_its_exit_code_and_no_output(
    planner: str, settings: list[str], set_up: float, tmp_path: Path
) -> None:
    """Planners that run until the time limit: asymptotically optimal ones, or slowed down by a parameter."""
    command = [sys.executable, "-m", "apex_ompl.cli", "plan", "shelf_swap", "--planner", planner]
    command += [word for setting in settings for word in ("--set", setting)]
    command += ["--timeout", "600", "--out", str(tmp_path / "r.npz")]
    running = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    while running.poll() is None and cpu_time(running.pid) < 1.5 * set_up + 0.5:
        time.sleep(0.05)
    assert running.poll() is None, running.communicate()
    running.send_signal(signal.SIGINT)
    out, err = running.communicate(timeout=120)  # a fifth of the time limit
    assert running.returncode == 130, (running.returncode, out, err)
    assert out == "" and "interrupted" in err and "Traceback" not in err
    assert not (tmp_path / "r.npz").exists()


def test_without_a_path_no_csv_is_written_and_the_status_is_printed(apex_cli, tmp_path: Path) -> None:
    done = apex_cli("plan", edited(tmp_path, start__left_joint2=3.0), "--out", tmp_path / "r.csv")
    assert done.returncode == 3 and "INVALID_START" in done.stdout and "is not written" in done.stderr
    assert not (tmp_path / "r.csv").exists()


@pytest.mark.parametrize(
    ("shell", "code", "said"),
    [
        ("{} schema > /dev/full", 2, "apex-ompl: error: output: No space left on device\n"),
        ("set -o pipefail; {} problems | true", 141, ""),
        ("{} schema >&-", 0, ""),
        ("{} schema <&- >&-", 0, ""),
        ("{} check nothing >&-", 2, "apex-ompl: error: unknown problem 'nothing'; known: "),
        ("{} check nothing 2>&-", 2, ""),
    ],
)
def test_an_output_that_is_full_or_closed_is_no_traceback(shell: str, code: int, said: str) -> None:
    command = ["bash", "-c", shell.format(f"{sys.executable} -m apex_ompl.cli")]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=60)
    assert done.returncode == code and done.stdout == "", (done.returncode, done.stdout, done.stderr)
    assert done.stderr.startswith(said) and done.stderr.count("\n") == bool(said), done.stderr


def test_a_file_written_while_the_output_is_closed_holds_nothing_else(easy: Path, tmp_path: Path) -> None:
    """What is opened first gets the number of the output, and what libraries print would go there."""
    command = f"{sys.executable} -m apex_ompl.cli plan {easy} --timeout 30 --json --out {tmp_path}/r.json >&-"
    assert subprocess.run(["bash", "-c", command], check=False, timeout=120).returncode == 0
    assert json.loads((tmp_path / "r.json").read_text())["status"] == "EXACT_SOLUTION"


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (FileNotFoundError(errno.ENOENT, "No such file or directory", "table.json"), "table.json: No such file"),
        (PermissionError(errno.EACCES, "Permission denied", b"folder"), "folder: Permission denied"),
        (OSError(errno.ENOSPC, "No space left on device"), "error: No space left on device"),
    ],
)
def test_an_error_of_the_system_names_its_file(
    apex_cli, monkeypatch: pytest.MonkeyPatch, error: OSError, said: str
) -> None:
    """Not the output, unless it is the output."""

    def fails(_: object) -> int:
        raise error

    monkeypatch.setattr("apex_ompl.cli.commands.schema", fails)
    done = apex_cli("schema")
    assert done.returncode == 2 and one_sentence(done.stderr) and said in done.stderr, done.stderr
    assert "output" not in done.stderr


def test_a_saved_npz_holds_the_checked_path(apex_cli, easy: Path, tmp_path: Path) -> None:
    assert apex_cli("plan", easy, "--out", tmp_path / "r.npz", "--timeout", 30).returncode == 0
    with np.load(tmp_path / "r.npz") as data:
        assert data["path"].shape[1] == 16 and data["path"].dtype == np.float64


def test_see_prints_draws_and_says_what_is_missing(apex_cli, robot, tmp_path: Path) -> None:
    pytest.importorskip("cv2")
    from apex_ompl.perception import Frame
    from apex_ompl.perception.rig import default_cameras

    camera = default_cameras(160)[0]
    joints = dict(zip(robot.joint_names, robot.home.tolist(), strict=True))
    blank = Frame(camera, np.full((120, 160), 3.0), np.zeros((120, 160, 3), np.uint8), 0.5, joints)
    blank.save(tmp_path / "frame.npz")
    done = apex_cli("see", tmp_path / "frame.npz", "-o", tmp_path / "seen.png")
    assert done.returncode == 1 and "front: 1 frame up to 0.500 s" in done.stdout and "reason" in done.stdout
    assert (tmp_path / "seen.png").read_bytes()[:4] == b"\x89PNG"
    done = apex_cli("see", tmp_path / "frame.npz", "--problem", "stack_boxes", "--json")
    told = json.loads(done.stdout)
    assert done.returncode == 1 and told["reasons"] and [one["name"] for one in told["objects"]] == ["lower", "upper"]
    for wrong in (
        ("see", tmp_path / "none.npz"), ("see", tmp_path / "frame.npz", "-o", "seen.gif"),
        ("see", tmp_path / "frame.npz", "--problem", "nowhere"), ("see", tmp_path / "seen.png"),
    ):  # fmt: skip
        done = apex_cli(*wrong)
        assert done.returncode == 2 and one_sentence(done.stderr), done.stderr


def test_cameras_of_runs_are_checked(apex_cli, tmp_path: Path) -> None:
    pytest.importorskip("cv2")
    pytest.importorskip("mujoco")
    for wrong in (
        ("stack_boxes", "--camera", "--cameras", tmp_path / "none.yaml"), ("stack_boxes", "--cubes", 1),
        ("stack_boxes", "--cameras", "front.yaml"), ("shelf_swap", "--camera"),
        ("popup/vertical/large/12", "--camera", "--cubes", 1),
    ):  # fmt: skip
        done = apex_cli("run", *wrong)
        assert done.returncode == 2 and one_sentence(done.stderr), done.stderr
