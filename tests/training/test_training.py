"""Training: it learns, goes on after any interruption, and names what is wrong."""

from __future__ import annotations

import importlib.util
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from support import DATA
from trainings import CLEARANCES, HERE, SCRIPT, SMALL, VARIATIONAL, assert_same, config, query_from_path, weights

from apex_ompl.errors import FileFormatError, MissingFileError
from apex_ompl.kernel import Kernel, RobotTables
from apex_ompl.kernel.scene_builder import scene_tables
from apex_ompl.model.proposals import Sampling
from apex_ompl.paths.candidates import first_valid
from apex_ompl.paths.optimizer import Optimizer
from apex_ompl.paths.path import FINE_RESOLUTION
from apex_ompl.training.kernel_problems import load_kernel_problems, save_kernel_problems
from apex_ompl.training.records import Paths
from apex_ompl.training.run import TrainingError, read_log
from apex_ompl.training.store import Store, load, save
from apex_ompl.training.torch_model import TorchModel, load_torch_model
from apex_ompl.training.training import DistributedProcess, Trainer
from apex_ompl.training.validation import query_from_problem, success_rates
from apex_ompl.util.process import one_torch_thread


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    with one_torch_thread():
        yield


def test_32_trajectories_are_memorized(few: Path, tmp_path: Path) -> None:
    sizes = {
        "latent": {"dim": 20},
        "denoiser": {"width": 192, "blocks": 2},
        "condition": {"width": 64, "out": 128, "along": 3},
    }
    trainer = Trainer(config(few, steps=1000, rate=1.5e-3, ema=0.99, log_every=10_000, **sizes), tmp_path, HERE)
    trainer.run()
    model, paths = TorchModel(trainer.averaged_network(), {}), load(few)
    kernel = Kernel(RobotTables.load(DATA / "robot.npz"), scene_tables([]))
    control, errors, from_line = paths.control(), [], []
    for k in range(len(paths)):
        generator = np.random.default_rng(k)
        query = query_from_path(paths, k)
        found = model.propose(query, kernel, 4, sampling=Sampling("ddim", 8), generator=generator).control
        errors.append(np.abs(found - control[k]).mean())
        from_line.append(np.abs(model.spline.line(query.start, query.goal) - control[k]).mean())
    assert np.mean(errors) < 0.35 * np.mean(from_line)


@pytest.mark.parametrize("kind", ["linear", "variational", "several shards"])
def test_an_interrupted_run_ends_with_the_same_weights(kind: str, few: Path, paths: Paths, tmp_path: Path) -> None:
    data, changes = few, VARIATIONAL if kind == "variational" else {}
    if kind == "several shards":
        data, changes = tmp_path / "store", {"units": 2, "batch": 64}
        store = Store.create(data, {"robot": "x"}, [])
        for k in range(5):
            store.write(f"unit-{k}", paths.subset(np.arange(20 * k, 20 * k + 7)))
    cut = {"linear": [5], "variational": [3, 7], "several shards": [6, 9]}[kind]
    (tmp_path / "whole").mkdir()
    whole = Trainer(config(data, **changes), tmp_path / "whole", HERE)
    whole.run()
    part_folder = tmp_path / "part"
    part_folder.mkdir()
    for last in [*cut, 10_000]:
        part = Trainer(config(data, **changes), part_folder, HERE)
        steps = 0
        while not part.done and steps < last:
            part.advance()
            steps += 1
        if not part.done:
            part.save()
            part.advance()  # what is not saved is lost
    assert part.phase == whole.phase and part.step == whole.step == 12
    assert_same(weights(part), weights(whole))


def test_estimates_of_a_model_that_pays_for_collisions_have_fewer(few: Path, tmp_path: Path) -> None:
    """The same steps with and without; what is measured is what the collisions of its estimates cost."""
    costs = []
    for weight in (0.0, 3.0):
        folder = tmp_path / f"{weight:g}"
        folder.mkdir()
        trainer = Trainer(config(few, condition=CLEARANCES, steps=70, rate=3e-3, collision=weight), folder, HERE)
        trainer.run()
        data, generator, network = trainer.data, torch.Generator().manual_seed(0), trainer.averaged_network()
        control, conditions = data.shard.batch(np.arange(len(data.shard)), generator)
        clean, draws = network.autoencoder.encode(control), network.draws(len(control), generator)
        batch = clean, draws, conditions, data.features_along
        with torch.no_grad():
            costs.append(float(network.loss(*batch, data.collision_cost) - network.loss(*batch)))
    assert costs[1] < 0.8 * costs[0]


def test_rows_logged_after_the_last_save_are_removed(paths: Paths, tmp_path: Path) -> None:
    def trainer() -> Trainer:
        return Trainer(config(data, log_every=1, held_out=0.2), tmp_path, HERE)

    data = tmp_path / "some.zip"
    save(data, paths)
    first = trainer()
    for step in range(1, 6):
        first.advance()
        first._log(1.0, False)  # noqa: SLF001
        if step == 4:
            first.save()
    assert [row["step"] for row in read_log(tmp_path)] == ["1", "2", "3", "4", "5"]
    second = trainer()
    assert second.step == 4
    second.run()
    rows = read_log(tmp_path)
    assert [int(row["step"]) for row in rows] == list(range(1, 13))
    assert all(float(row["held_out"]) > 0 for row in rows)
    if importlib.util.find_spec("tensorboard"):
        assert len(list((tmp_path / "tensorboard").iterdir())) == 2
    (tmp_path / "log.csv").write_text("phase,step\ndenoiser,three\n")
    with pytest.raises(FileFormatError, match="log.csv: step: expected the log of a training run"):
        trainer()


def test_a_killed_command_is_resumed(few: Path, tmp_path: Path, script_here: Any) -> None:
    file = tmp_path / "small.yaml"
    file.write_text(yaml.safe_dump({**SMALL, "data": str(few), "steps": 3000, "save_every": 0.05, "log_every": 500}))
    command = [sys.executable, str(SCRIPT), str(file), "--out", str(tmp_path / "run"), "--quiet"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    state = tmp_path / "run" / "state.pt"
    begin = time.monotonic()
    while not state.exists():
        assert process.poll() is None and time.monotonic() - begin < 120
        time.sleep(0.02)
    while not (tmp_path / "run" / "checkpoint" / "README.md").exists():
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    step = torch.load(state, weights_only=True)["step"]
    assert 0 < step < 3000
    load_torch_model(tmp_path / "run" / "checkpoint")
    again = (SCRIPT.name, *command[2:])
    done = script_here(*again, "--minutes", "0.01")
    assert done.returncode == 0, done.stderr
    assert torch.load(state, weights_only=True)["step"] > step
    assert [path.name for path in (tmp_path / "run").glob(".*")] == [".lock"]
    same = script_here(*again, "--set", "log_every=7", "--minutes", "0.001")
    assert same.returncode == 0, same.stderr  # it does not determine the weights


def test_two_processes_train_one_model(few: Path, tmp_path: Path) -> None:
    file = tmp_path / "small.yaml"
    changes = {"steps": 4, "warmup": 1, "rate": 0.05}
    file.write_text(yaml.safe_dump({**SMALL, "data": str(few), **changes}))
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", str(SCRIPT)]
    command += [str(file), "--out", str(tmp_path / "run"), "--quiet"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "denoiser, step 4 of 4" in done.stdout
    both = load_torch_model(tmp_path / "run" / "checkpoint").network.state_dict()
    # The same steps by hand: the gradients of both processes' batches, averaged.
    (tmp_path / "single").mkdir()
    single = Trainer(config(few, **changes), tmp_path / "single", HERE)
    before = {name: tensor.clone() for name, tensor in single.averaged_network().state_dict().items()}
    for _ in range(4):
        gradients = []
        for rank in range(2):
            single.process = DistributedProcess(rank, 2, torch.device("cpu"))
            loss = single._loss()  # noqa: SLF001
            gradients.append(torch.autograd.grad(loss, single._parameters, allow_unused=True))  # noqa: SLF001
        single.process = HERE
        mean = [None if a is None else (a + b) / 2 for a, b in zip(*gradients, strict=True)]
        single._loss = lambda mean=mean: _Given(single, mean)  # type: ignore[assignment,method-assign]  # noqa: SLF001
        single.advance()
        del single._loss
    after = single.averaged_network().state_dict()
    moved = {name: float((after[name] - before[name]).abs().max()) for name in single.averaged}
    assert max(moved.values()) > 0.02
    for name in single.averaged:
        torch.testing.assert_close(both[name], after[name], atol=2e-3, rtol=2e-3)


class _Given:
    """Stands for a loss whose gradient is known."""

    def __init__(self, trainer: Trainer, gradients: list[torch.Tensor | None]) -> None:
        self.trainer, self.gradients = trainer, gradients

    def backward(self) -> None:
        for parameter, gradient in zip(self.trainer._parameters, self.gradients, strict=True):  # noqa: SLF001
            parameter.grad = gradient

    def detach(self) -> float:
        return 0.0


# Validation


def test_success_rates_are_those_of_repair_and_proof(few: Path, tmp_path: Path) -> None:
    problems = load_kernel_problems(DATA / "validation")[::4]
    model = TorchModel(Trainer(config(few), tmp_path, HERE).averaged_network(), {})
    rates = success_rates(model, problems, 3)
    wanted = []
    for problem in problems:
        kernel = Kernel(problem.robot, problem.scene)
        control = model.propose(query_from_problem(problem), kernel, 3, generator=np.random.default_rng(0)).control
        found = first_valid(Optimizer(model.spline), kernel, control, lambda p, k=kernel: k.proves(p, FINE_RESOLUTION))
        wanted.append(found is not None)
    assert rates["repaired"] == pytest.approx(np.mean(wanted))
    assert 0.0 <= rates["sampled"] <= rates["repaired"]
    assert {f"{problem.suite}/{problem.level}" for problem in problems} <= rates.keys()


@pytest.mark.parametrize("condition", [SMALL["condition"], CLEARANCES])
def test_a_run_begins_with_the_weights_of_a_checkpoint(
    condition: dict[str, Any], few: Path, paths: Paths, tmp_path: Path
) -> None:
    first, others = tmp_path / "first", tmp_path / "others.zip"
    first.mkdir()
    Trainer(config(few, condition=condition), first, HERE).run()
    save(others, paths.subset(np.arange(40, 90)))
    wanted = load_torch_model(first / "checkpoint").network.state_dict()
    again = {"condition": condition, "initial": str(first / "checkpoint"), "rate": 1e-9}
    second = Trainer(config(others, **again), tmp_path, HERE)
    assert second.about()["config"]["initial"] == "checkpoint", "without its folder"
    assert_same(second.network.state_dict(), wanted)
    if second.data.scene_encoding is not None:
        assert np.array_equal(second.data.scene_encoding.keys.state, wanted["key_state"].numpy()), "it sees what it saw"
    second.advance()
    moved = [float((p.detach() - wanted[name]).abs().max()) for name, p in second.network.named_parameters()]
    assert 0.0 < max(moved) < 1e-6, "it is trained"


def test_a_damaged_state_is_named(few: Path, tmp_path: Path) -> None:
    (tmp_path / "state.pt").write_bytes(b"not a state")
    with pytest.raises(FileFormatError, match=r"state.pt: expected the state of a training run"):
        Trainer(config(few), tmp_path, HERE)
    (tmp_path / "state.pt").unlink()
    trainer = Trainer(config(few), tmp_path, HERE)
    trainer.save()
    with pytest.raises(FileFormatError, match="expected the state of a run with this configuration and these data"):
        Trainer(config(few, steps=7), tmp_path, HERE)
    state = torch.load(tmp_path / "state.pt", weights_only=True)
    del state["optimizer"]
    torch.save(state, tmp_path / "state.pt")
    with pytest.raises(FileFormatError, match="expected the state of a training run, got 'KeyError'"):
        Trainer(config(few), tmp_path, HERE)
    with pytest.raises(MissingFileError, match="does not exist"):
        Trainer(config(few), tmp_path / "no" / "folder", HERE)


def test_steps_without_a_finite_gradient_change_nothing(few: Path, tmp_path: Path) -> None:
    trainer = Trainer(config(few, steps=100), tmp_path, HERE)
    trainer.advance()
    before = {name: tensor.clone() for name, tensor in weights(trainer).items()}
    trainer.data.shard.control.fill_(torch.nan)
    trainer.advance()
    assert_same(before, weights(trainer))
    with pytest.raises(TrainingError, match="20 gradients in a row are not finite"):
        for _ in range(20):
            trainer.advance()
    assert_same(before, weights(trainer))


def test_training_needs_no_ompl_and_no_pinocchio(few: Path, tmp_path: Path) -> None:
    file = tmp_path / "small.yaml"
    save_kernel_problems(tmp_path / "cases", load_kernel_problems(DATA / "validation")[::8])
    file.write_text(yaml.safe_dump({**SMALL, "data": str(few), "steps": 2, "cases": str(tmp_path / "cases")}))
    code = "import sys\nfor name in ('ompl', 'pinocchio', 'coal', 'ruckig'):\n    sys.modules[name] = None\n"
    code += f"sys.argv = ['train.py', {str(file)!r}, '--out', {str(tmp_path / 'run')!r}, '--quiet']\n"
    code += f"exec(compile(open({str(SCRIPT)!r}).read(), 'train.py', 'exec'))\n"
    done = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "step 2 of 2" in done.stdout and "repaired" in done.stdout
