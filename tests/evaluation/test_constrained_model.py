"""The benchmark of a model that is told constraints: what it is told, its data, its inputs, and the comparison."""

from __future__ import annotations

import math
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from support import DATA, ROOT, benchmark_script

from apex_ompl import load_model, load_problem
from apex_ompl.apex.models import make_query
from apex_ompl.constraints.links import Links
from apex_ompl.model.checkpoint import SHIPPED
from apex_ompl.ompl.setup import PlanningSetup, assemble
from apex_ompl.paths.spline import Spline
from apex_ompl.problems.suite_robot import ROBOT, robot
from apex_ompl.training.store import Store

TRAY, LEVEL, CUPS = (f"unseen/{level}/800000" for level in ("tray", "level", "cups"))


@pytest.fixture(scope="module")
def made() -> ModuleType:
    return benchmark_script("model.constrained_data")


@pytest.fixture(scope="module")
def told_models() -> ModuleType:
    return benchmark_script("model.constrained_told")


@pytest.fixture(scope="module")
def script() -> ModuleType:
    return benchmark_script("model.constrained_model")


def setup_of(name: str) -> PlanningSetup:
    return assemble(load_problem(name), robot())


def hand_frames(q: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return rotation and origin of the joints that carry the palms."""
    links = Links.of(robot())
    joints = [links.point(hand.palm, np.zeros(3)).joint for hand in robot().hands.values()]
    rotation, origin = setup_of(TRAY).checker.kernel.joint_frames(q[None])
    return [(rotation[0, joint], origin[0, joint]) for joint in joints]


def palm_offset(q: np.ndarray) -> np.ndarray:
    """Return the position of the right palm in the left palm's frame."""
    left, right = (robot().link_pose(q, hand.palm) for hand in robot().hands.values())
    return np.asarray(left[:3, :3].T @ (right[:3, 3] - left[:3, 3]))


@pytest.mark.parametrize("name", [TRAY, LEVEL, CUPS])
def test_a_model_is_told_the_relative_pose_and_what_is_upright(made: ModuleType, name: str) -> None:
    setup = setup_of(name)
    found = made.told(robot(), setup.constraints)
    frames = hand_frames(setup.start)
    chain, upright = found[: made.CHAIN_SIZE], found[made.CHAIN_SIZE :].reshape(2, made.UPRIGHT_SIZE)
    if name == CUPS:
        np.testing.assert_array_equal(chain, 0.0)
    else:
        (left, _), (right, _) = frames
        np.testing.assert_allclose(chain[:4], [1.0, *palm_offset(setup.start)], atol=1e-7)
        np.testing.assert_allclose(chain[4:].reshape(2, 3), (left.T @ right)[:, :2].T, atol=1e-7)
    tolerances = {TRAY: (0.0, 0.0), LEVEL: (0.01, 0.0), CUPS: (0.1, 0.1)}[name]
    for (rotation, _), (is_upright, *axis, scaled), tolerance in zip(frames, upright, tolerances, strict=True):
        assert is_upright == (tolerance > 0.0)
        assert scaled * made.TOLERANCE_SCALE == pytest.approx(tolerance)
        up = rotation @ axis
        assert np.arccos(np.clip(up[2], -1.0, 1.0)) <= tolerance if is_upright else not np.any(axis)


@pytest.mark.parametrize("name", [LEVEL, CUPS])
def test_violations_are_the_largest_along_a_path(made: ModuleType, name: str) -> None:
    setup = setup_of(name)
    paths = setup.start + np.random.default_rng(0).normal(0.0, 0.1, (2, 5, robot().dof))
    found = made.violations(setup.constraints, paths)
    tilt = [max(np.arccos(up(q)) for q in path) for path in paths for up in [smallest_up(made, setup)]]
    np.testing.assert_allclose(found.tilt, tilt, rtol=1e-6)
    assert np.isnan(found.distance).all() == np.isnan(found.angle).all() == (name == CUPS)
    if name == LEVEL:
        wanted = made.told(robot(), setup.constraints)[1:4]
        offsets = [np.linalg.norm(palm_offset(q) - wanted) for q in paths[0]]
        assert found.distance[0] == pytest.approx(max(offsets), rel=1e-6)


def smallest_up(made: ModuleType, setup: PlanningSetup):
    """Return a function from a state to the least z of the axes that are kept upright."""
    upright = made.told(robot(), setup.constraints)[made.CHAIN_SIZE :].reshape(2, made.UPRIGHT_SIZE)

    def least(q: np.ndarray) -> float:
        return min(
            (rotation @ row[1:4])[2] for (rotation, _), row in zip(hand_frames(q), upright, strict=True) if row[0]
        )

    return least


@pytest.fixture(scope="module")
def store(made: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a store of the paths of two problems."""
    folder = tmp_path_factory.mktemp("constrained")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(made, "UNIT", 1)
        patch.setattr(made, "LEVELS", ("wall/tray", "wall/cups"))
        assert list(made.make(folder, 2, load_model("apex"))) == ["0000", "0001"]
        before = (folder / made.PATHS / "units" / "0000.zip").stat().st_mtime_ns
        assert list(made.make(folder, 2, load_model("apex"))) == ["0000", "0001"]
    assert (folder / made.PATHS / "units" / "0000.zip").stat().st_mtime_ns == before
    return folder


def test_data_are_near_the_constraints_in_both_directions(made: ModuleType, store: Path) -> None:
    found = made.statistics(store)
    assert (found.drawn, found.solved) == (2, 2)
    assert np.nanmax(found.stored, axis=0) == pytest.approx(0.0, abs=0.11)  # cups may tilt by 0.1 rad
    assert np.nanmax(found.stored[:, :2]) < 5e-3 < np.nanmin(found.latent[:, :2])
    told = made.told_of(store)
    for paths in Store(store / made.PATHS):
        assert paths.problem_name(0).split("/")[2] == "0"
        starts = {row.tobytes() for row in paths.arrays["start"]}
        assert len(starts) == 2 and starts == {row.tobytes() for row in paths.arrays["goal"]}
        setup = setup_of(paths.problem_name(0))
        np.testing.assert_array_equal(told[paths.names["held"][0]], made.told(robot(), setup.constraints))


def test_new_inputs_leave_the_shipped_model_as_it_is(
    told_models: ModuleType, made: ModuleType, store: Path, tmp_path: Path
) -> None:
    import torch

    from apex_ompl.training.config import TrainingConfig
    from apex_ompl.training.training import DistributedProcess, Trainer

    torch.set_num_threads(1)
    told = made.told_of(store)
    changes = {"data": str(store / made.PATHS), "initial": "apex", "cases": None, "mirror": None, "mixed": 0.0}
    changes |= {"robot": str(DATA / "robot.npz"), "steps": 2, "batch": 2, "warmup": 1}
    config = TrainingConfig.read(ROOT / "scripts" / "configs" / "apex-continued.yaml", changes)
    runs = {}
    for name, kind in (("plain", Trainer), ("told", told_models.told_trainer(told))):
        (tmp_path / name).mkdir()
        runs[name] = kind(config, tmp_path / name, DistributedProcess.current())
    first = {name: run.advance() for name, run in runs.items()}
    assert first["plain"] == pytest.approx(first["told"], rel=1e-5)
    runs["told"].run()
    query_of = setup_of(TRAY)
    query = make_query(query_of.checker, query_of.start, query_of.goals[0])
    shipped = told_models.load(SHIPPED / "apex", ROBOT)
    columns = runs["told"].network.encoder.phi[0].weight[:, -made.TOLD :]
    assert float(columns.abs().max()) > 0.0, "they are trained"
    trained = told_models.load(tmp_path / "told" / "checkpoint", ROBOT)
    trained.weights[told_models.LAYER][:, -made.TOLD :] = 1  # after two steps they are rounded to 0 in the checkpoint
    found = []
    for model, features in ((shipped, 0.0), (load_model("apex"), 0.0), (trained, 0.0), (trained, 1.0), (trained, 0.0)):
        told_models.tell(model, np.full(made.TOLD, features))
        found.append(model.propose(query, query_of.checker.kernel, 1).control)
    np.testing.assert_array_equal(found[0], found[1])
    np.testing.assert_array_equal(found[2], found[4])
    assert np.abs(found[2] - found[3]).max() > 1e-6


def test_proposals_and_planner_make_runs(made: ModuleType) -> None:
    from apex_ompl.evaluation.rows import Job

    runs = benchmark_script("model.constrained_runs")
    params = {"model": str(SHIPPED / "apex")}
    run = runs.proposed(Job("unseen", TRAY, "", "apex", params, 0, 1.0, True))
    assert run["solved"] == (run["valid"] > 0.0) == (run["first_cpu"] is not None)
    assert len(run["distance"]) == len(run["angle"]) == runs.PROPOSALS and run["tilt"] == []
    assert run["cpu"] >= run["proposals_cpu"] > 0.0
    raw = runs.raw(Job("unseen", TRAY, "", "apex", {**params, "told": False}, 0, 1.0, True))
    assert [len(values) for values in raw[runs.LINE]] == [1, 1, 0]
    for temperature in runs.TEMPERATURES:
        assert [len(values) for values in raw[f"{temperature:g}"]] == [runs.PROPOSALS, runs.PROPOSALS, 0]
    assert raw["0.5"] != raw["1"]
    run = runs.planned(Job("unseen", TRAY, "", "apex", {**params, "trees": True}, 0, 1.0, True))
    assert run["solved"] and run["first_cpu"] <= run["cpu"] and not run["fault"]
    setup = setup_of(TRAY)
    assert run["length"] >= np.linalg.norm(setup.goals[0] - setup.start)
    assert Spline().states == load_model("apex").spline.states  # of the row of the straight line


def run_of(label: str, problem: str, **values: object) -> dict[str, object]:
    return {"label": label, "problem": problem, "first_cpu": 0.1, "length": 1.0, "solved": True, **values}


def test_rows_are_compared_by_problem(script: ModuleType) -> None:
    kind = script.KINDS[0]
    one, other = (f"{kind}, {name}" for name in ("one", "other"))
    runs = [
        run_of(one, "a", valid=0.5, first_cpu=0.2), run_of(other, "a", valid=0.25), run_of(one, "b", valid=1.0),
        run_of(other, "b", valid=0.0, solved=False, first_cpu=None, length=None),
    ]  # fmt: skip
    found = dict(zip(script.PAIRED_HEAD, script.paired("all", kind, "one", "other", runs), strict=False))
    assert (found["N"], found["alone solved"], found["the other alone"]) == (2, 1, 0)
    assert found["share of proposals, difference"] == "0.625" and found["first CPU ratio"] == "2.000"


def test_raw_proposals_are_pooled_by_temperature(script: ModuleType) -> None:
    runs = [
        {"label": "apex", "problem": f"{suite}/tray/1", "line": [[0.2], [0.1], []],
         **{f"{t:g}": [[t * k, t], [0.1, 0.1], []] for t in script.TEMPERATURES}}
        for k, suite in enumerate(("wall", "posts", "unseen"))
    ]  # fmt: skip
    lines = script.raw_lines(runs)
    assert [line[:4] for line in lines[:2]] == [["suites", script.LINE, "-", 2], ["suites", "apex", "0.5", 2]]
    assert lines[0][4] == "200" and lines[1][4] == "500" and lines[1][8] == "-"
    assert len(lines) == 2 * (1 + len(script.TEMPERATURES)) and lines[-1][0] == "unseen" and lines[-1][3] == 1


def test_the_interval_of_ratios_is_geometric(script: ModuleType) -> None:
    logs = np.random.default_rng(1).normal(0.3, 0.2, 400)
    mean, ends = script.interval(logs.tolist(), log=True)
    low, high = map(float, ends.split(" to "))
    assert float(mean) == pytest.approx(math.exp(logs.mean()), abs=1e-3)
    assert math.log(high / low) == pytest.approx(2 * 1.96 * 0.2 / np.sqrt(400), rel=0.2)


def test_problems_are_grouped(script: ModuleType) -> None:
    names = script.problems_of(1, 2)
    assert sum(name.startswith("unseen/") for name in names) == 6 and len(names) == 18
    runs = [run_of(script.LINE, name, solved=name.startswith("wall/")) for name in names]
    groups = script.groups_of(runs)
    assert len(groups["suites"]) == 12 and len(groups["suites, line fails"]) == 9
    assert groups["unseen"] == groups["unseen, line fails"] and len(groups["unseen, cups"]) == 2
