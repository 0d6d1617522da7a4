"""Training of imitation policies: it learns, goes on after an interruption, and keeps what it learned."""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from imitations import NETWORK, SMALL, config, lively, trained, weights
from support import DATA, ROOT
from trainings import assert_same, query_from_path

from apex_ompl.baselines.imitation.checkpoint import load_policy_network, save_policy
from apex_ompl.baselines.imitation.config import NetworkConfig
from apex_ompl.baselines.imitation.policy import ImitationPolicy, policy_folder, shared_policy
from apex_ompl.baselines.imitation.training import ImitationTrainer
from apex_ompl.errors import ApexError, FileFormatError, MissingFileError
from apex_ompl.kernel import Kernel, RobotTables
from apex_ompl.kernel.scene_builder import scene_tables
from apex_ompl.training.store import load
from apex_ompl.util.process import one_torch_thread

CLOCK = NETWORK["clock"]


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    with one_torch_thread():
        yield


@pytest.fixture(scope="module")
def kernel() -> Kernel:
    return Kernel(RobotTables.load(DATA / "robot.npz"), scene_tables([]))


@pytest.fixture(scope="module")
def saved(few: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return trained(tmp_path_factory.mktemp("runs") / "run", few)


# Training


def test_a_few_paths_are_learned(few: Path, tmp_path: Path) -> None:
    """The error falls far below that of straight lines, and the policy's own path follows the stored one."""
    network = {**NETWORK, "width": 64}
    changes: dict[str, Any] = {"steps": 230, "rate": 4e-3, "cooldown": 70, "ema": 0.98, "noise": 0.01, "batch": 16}
    trainer = ImitationTrainer(config(few, log_every=10_000, **changes).model_copy(update={
        "network": NetworkConfig.model_validate(network)}), tmp_path)  # fmt: skip
    trainer.run()
    learned, data = trainer.averaged_network(), trainer.data
    with torch.no_grad():
        shown = data.windows(data.train, np.arange(32), 0.0, torch.Generator().manual_seed(9))
        line = learned.line(shown.conditions.goal, shown.state, shown.time)
        straight = (((line - shown.following) / learned.scale) ** 2).mean()
        assert trainer.loss(learned, shown) < 0.35 * straight
    paths, kernel = load(few), Kernel(RobotTables.load(DATA / "robot.npz"), scene_tables([]))
    policy = ImitationPolicy(learned.requires_grad_(False), load_policy_network(tmp_path / "checkpoint")[1])
    rolled = policy.roll_out([query_from_path(paths, k) for k in range(32)], kernel)
    assert rolled is not None and rolled.shape == (32, CLOCK, 16)
    true = np.stack([paths.spline.basis(np.linspace(0, 1, CLOCK)) @ c for c in paths.control()])
    lines = paths.start[:, None] + np.linspace(0, 1, CLOCK)[:, None] * (paths.goal - paths.start)[:, None]
    assert np.abs(rolled - true).mean() < 0.6 * np.abs(lines - true).mean()


def test_an_interrupted_run_ends_with_the_same_weights(few: Path, tmp_path: Path) -> None:
    folders = tmp_path / "whole", tmp_path / "part"
    for folder in folders:
        folder.mkdir()
    whole = ImitationTrainer(config(few), folders[0])
    whole.run()
    for last in (5, 4, 10_000):
        part = ImitationTrainer(config(few, steps=500 if last < 10_000 else 12), folders[1])  # steps may be changed
        steps = 0
        while not part.done and steps < last:
            part.advance()
            steps += 1
        if not part.done:
            part.save() if part.step <= 8 else None
            part.advance()  # what is not saved is lost
    assert part.step == whole.step == 12
    assert_same(weights(part), weights(whole))
    with pytest.raises(FileFormatError, match="expected the state of a run with this configuration and these data"):
        ImitationTrainer(config(few, noise=0.5), folders[0])


def test_a_policy_of_other_obstacles_begins_with_the_weights_of_another(saved: Path, few: Path, tmp_path: Path) -> None:
    first, other = load_policy_network(saved)[0], lively("point").state_dict()
    trainer = ImitationTrainer(config(few, obstacles="point", init=str(saved)), tmp_path)
    alone = {name for name, tensor in first.state_dict().items() if other[name].shape != tensor.shape}
    assert alone == {"obstacle.0.weight"}
    for name, tensor in trainer.network.state_dict().items():
        assert name in alone or torch.equal(tensor, first.state_dict()[name]), name
    trainer.run()
    assert "It began with the weights of `checkpoint`." in (tmp_path / "checkpoint" / "README.md").read_text()
    with pytest.raises(FileFormatError, match="expected the state of a run with this configuration"):
        ImitationTrainer(config(few, obstacles="point"), tmp_path)


def test_the_script_trains_resumes_and_needs_no_ompl(few: Path, tmp_path: Path, script_here: Any) -> None:
    file, script = tmp_path / "small.yaml", ROOT / "scripts" / "train_il.py"
    file.write_text(yaml.safe_dump({**SMALL, "data": str(few), "steps": 4}))
    code = "import sys\nfor name in ('ompl', 'pinocchio', 'coal', 'ruckig'):\n    sys.modules[name] = None\n"
    code += f"sys.argv = ['train_il.py', {str(file)!r}, '--out', {str(tmp_path / 'run')!r}, '--quiet', *sys.argv[1:]]\n"
    code += f"exec(compile(open({str(script)!r}).read(), {str(script)!r}, 'exec'), {{'__name__': '__main__', "
    code += f"'__file__': {str(script)!r}}})\n"
    first = subprocess.run(
        [sys.executable, "-c", code, "--set", "steps=4"], check=False, capture_output=True, text=True
    )
    again = script_here(script.name, file, "--out", tmp_path / "run", "--quiet", "--set", "steps=9")
    for done, steps in ((first, 4), (again, 9)):
        assert done.returncode == 0, done.stderr
        assert f"step {steps} of {steps}" in done.stdout
    network, about = load_policy_network(tmp_path / "run" / "checkpoint")
    assert about.trained["step"] == 9 and about.robot == "dual_panda_softhand"
    assert not list(tmp_path.rglob("*.pkl")) and network.config.clock == CLOCK


# Checkpoints


def test_a_checkpoint_gives_the_policy_back_bit_for_bit(saved: Path, few: Path, tmp_path: Path, kernel: Kernel) -> None:
    trainer = ImitationTrainer(config(few), saved.parent)
    network, about = load_policy_network(saved, robot="dual_panda_softhand")
    for name, tensor in trainer.averaged_network().state_dict().items():
        assert torch.equal(network.state_dict()[name], tensor.half().float()), name
    save_policy(tmp_path / "again", network, about.robot, about.joints, about.trained)
    for file in ("model.safetensors", "config.json", "README.md"):
        assert (tmp_path / "again" / file).read_bytes() == (saved / file).read_bytes()
    save_policy(tmp_path / "exact", trainer.averaged_network(), about.robot, about.joints, {}, bits=32)
    assert_same(load_policy_network(tmp_path / "exact")[0].state_dict(), trainer.averaged_network().state_dict())
    queries = [query_from_path(load(few), k) for k in range(4)]
    first, second = (shared_policy(f).roll_out(queries, kernel) for f in (saved, tmp_path / "again"))
    assert first is not None
    np.testing.assert_array_equal(first, second)
    card = (saved / "README.md").read_text()
    assert "step 12 of 12" in card and "384 windows" in card


def _changed(saved: Path, folder: Path, **changes: Any) -> Path:
    shutil.copytree(saved, folder)
    data = json.loads((folder / "config.json").read_text()) | changes
    (folder / "config.json").write_text(json.dumps(data))
    return folder


def test_faulty_checkpoints_are_named_in_one_sentence(saved: Path, tmp_path: Path) -> None:
    cases = []
    missing = tmp_path / "missing"
    with pytest.raises(MissingFileError, match="train_il.py scripts/configs/il.yaml --save makes it"):
        policy_folder(missing)
    shutil.copytree(saved, tmp_path / "no_weights")
    (tmp_path / "no_weights" / "model.safetensors").unlink()
    cases.append((tmp_path / "no_weights", "model.safetensors': no such file"))
    shutil.copytree(saved, tmp_path / "damaged")
    content = bytearray((saved / "model.safetensors").read_bytes())
    content[-5] ^= 1
    (tmp_path / "damaged" / "model.safetensors").write_bytes(content)
    cases.append((tmp_path / "damaged", "damaged"))
    no_tensors = _changed(saved, tmp_path / "text", digest=hashlib.sha256(b"text").hexdigest())
    (no_tensors / "model.safetensors").write_bytes(b"text")
    cases.append((no_tensors, "expected safetensors"))
    cases.append((_changed(saved, tmp_path / "version", schema="apex-ompl/model/1"), "schema: expected"))
    cases.append((_changed(saved, tmp_path / "robot", robot="baxter"), "robot: expected 'dual_panda_softhand'"))
    wider = {**json.loads((saved / "config.json").read_text())["network"], "width": 64}
    cases.append((_changed(saved, tmp_path / "wider", network=wider), "expected weights that fit config.json"))
    for folder, message in cases:
        with pytest.raises(ApexError) as caught:
            shared_policy(folder, robot="dual_panda_softhand")
        assert message in str(caught.value) and "\n" not in str(caught.value), folder
    with pytest.raises(MissingFileError, match="something else is there"):
        save_policy(tmp_path, lively(), "robot", ("joint",), {})
