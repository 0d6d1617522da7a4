"""Checkpoints: they give the model back, and say what they are and what is wrong with them."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file as load_arrays
from safetensors.numpy import save_file as save_arrays
from safetensors.torch import load_file, save_file
from support import DATA
from trainings import HERE, config, query_from_path

import apex_ompl
from apex_ompl.errors import FileFormatError, MissingFileError, ParameterError, UnknownNameError
from apex_ompl.kernel import Kernel, RobotTables
from apex_ompl.kernel.scene_builder import scene_tables
from apex_ompl.model.array_model import expanded, quantized
from apex_ompl.model.checkpoint import load_model
from apex_ompl.training.store import load
from apex_ompl.training.torch_model import load_torch_model, save_model
from apex_ompl.training.training import Trainer
from apex_ompl.util.threads import one_torch_thread


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    with one_torch_thread():
        yield


# Checkpoints


@pytest.fixture(scope="module")
def saved(few: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    trainer = Trainer(config(few), folder, HERE)
    trainer.run()
    return folder / "checkpoint"


def test_a_checkpoint_gives_the_model_back(saved: Path, few: Path, tmp_path: Path) -> None:
    trainer = Trainer(config(few), saved.parent, HERE)
    assert trainer.done
    model, original = load_torch_model(saved), trainer.averaged_network()
    assert model.network.config == original.config
    for name, tensor in original.state_dict().items():
        found = model.network.state_dict()[name]
        torch.testing.assert_close(found, tensor.half().to(tensor) if tensor.is_floating_point() else tensor)
    save_model(tmp_path / "again", model.network, model.about)
    assert (tmp_path / "again" / "model.safetensors").read_bytes() == (saved / "model.safetensors").read_bytes()
    assert "denoiser, step 12, 0 min, 32 paths in memory" in (saved / "README.md").read_text()
    assert model.about["config"]["steps"] == 12
    kernel = Kernel(RobotTables.load(DATA / "robot.npz"), scene_tables([]))
    query = query_from_path(load(few), 0)
    first, second = (
        m.propose(query, kernel, 3, generator=np.random.default_rng(1)).control
        for m in (apex_ompl.load_model(saved), load_model(str(tmp_path / "again")))
    )
    np.testing.assert_array_equal(first, second)


def test_eight_bits_are_a_step_of_each_row_off_and_half_the_size(saved: Path, few: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    wide = (rng.normal(size=(200, 300)) * rng.uniform(0.01, 3.0, (200, 1))).astype(np.float32)
    wide[7] = 0.0
    weights = {"a.weight": wide, "a.bias": wide[:, 0], "small": wide[:3, :3], "whole": np.arange(5)}
    packed = quantized(weights)
    assert packed["a.weight"].dtype == np.int8 and len(packed) == 5
    found = expanded(packed)
    assert list(found) == list(weights)
    assert (np.abs(found["a.weight"] - wide) <= 0.5001 * np.abs(wide).max(axis=1, keepdims=True) / 127).all()
    assert all(found[name] is weights[name] for name in weights if name != "a.weight")
    again = quantized(found)
    assert np.array_equal(again["a.weight"], packed["a.weight"])

    model = load_torch_model(saved)
    save_model(tmp_path / "eight", model.network, model.about, bits=8)
    sizes = [(folder / "model.safetensors").stat().st_size for folder in (saved, tmp_path / "eight")]
    assert sizes[1] < 0.75 * sizes[0]
    kernel, query = Kernel(RobotTables.load(DATA / "robot.npz"), scene_tables([])), query_from_path(load(few), 0)
    first, second, wide_paths = (
        model.propose(query, kernel, 3, generator=np.random.default_rng(1)).control
        for model in (load_model(saved), load_model(tmp_path / "eight"), load_torch_model(saved))
    )
    np.testing.assert_array_equal(first, second)  # NumPy computes with eight bits, however they are stored
    assert 0.0 < np.abs(first - wide_paths).max() < 0.02 * np.ptp(first)
    source = tmp_path / "eight" / "model.safetensors"
    arrays = load_arrays(source)
    gone = next(name for name in arrays if name.endswith(".scale"))
    save_arrays({name: values for name, values in arrays.items() if name != gone}, source)
    data = json.loads((tmp_path / "eight" / "config.json").read_text())
    data["digest"] = hashlib.sha256(source.read_bytes()).hexdigest()
    (tmp_path / "eight" / "config.json").write_text(json.dumps(data))
    with pytest.raises(FileFormatError, match="expected a scale for each row"):
        load_model(tmp_path / "eight")


def _changed(saved: Path, folder: Path, **changes: Any) -> Path:
    shutil.copytree(saved, folder)
    data = json.loads((folder / "config.json").read_text())
    data.update(changes)
    (folder / "config.json").write_text(json.dumps(data))
    return folder


def test_faulty_checkpoints_are_named(saved: Path, tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="unknown checkpoint 'apexx'"):
        load_model("apexx")
    with pytest.raises(MissingFileError, match="checkpoint '/no/such/folder': no such folder"):
        load_model("/no/such/folder")
    with pytest.raises(FileFormatError, match="pickles are not read, got '.pt'"):
        load_model(saved.parent / "state.pt")
    with pytest.raises(FileFormatError, match="model.robot: expected 'baxter', got 'dual_panda_softhand'"):
        load_model(saved, robot="baxter")
    with pytest.raises(ParameterError, match="device: expected a device of torch's"):
        load_model(saved, device="cuda:7")
    with pytest.raises(MissingFileError, match="config.json': no such file"):
        load_model(tmp_path)
    other = _changed(saved, tmp_path / "version", schema="apex-ompl/model/9")
    with pytest.raises(FileFormatError, match="schema: expected 'apex-ompl/model/1', got 'apex-ompl/model/9'"):
        load_model(other)
    other = _changed(saved, tmp_path / "key", modle={})
    with pytest.raises(FileFormatError, match="modle: unknown key, did you mean 'model'"):
        load_model(other)
    model = json.loads((saved / "config.json").read_text())["model"]
    for section, key, value, words in (
        ("denoiser", "width", 8 * 10**8, "model.denoiser.width: input should be less than"),
        ("denoiser", "width", 16_384, "expected weights that fit config.json"),
        ("noise", "steps", 10**9, "model.noise.steps: input should be less than"),
    ):
        wide = {**model, section: {**model.get(section, {}), key: value}}
        other = _changed(saved, tmp_path / f"{section}-{value}", model=wide)
        with pytest.raises(FileFormatError, match=words):
            load_model(other)
    (tmp_path / "key" / "config.json").write_text("[]")
    with pytest.raises(FileFormatError, match=r"config.json: expected a mapping of keys to values"):
        load_model(tmp_path / "key")
    damaged = _changed(saved, tmp_path / "damaged")
    content = bytearray((damaged / "model.safetensors").read_bytes())
    content[-100] ^= 1
    (damaged / "model.safetensors").write_bytes(content)
    with pytest.raises(FileFormatError, match=r"model.safetensors: expected .*: damaged, got 'SHA-256"):
        load_model(damaged)


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("missing", "denoiser.leave.bias: expected weights that fit config.json"),
        ("shape", "denoiser.leave.bias: expected weights that fit config.json"),
        ("nan", "denoiser.leave.bias: expected finite weights"),
        ("text", "model.safetensors: expected safetensors"),
    ],
)
def test_weights_that_do_not_fit_are_named(what: str, message: str, saved: Path, tmp_path: Path) -> None:
    import hashlib

    folder = _changed(saved, tmp_path / what)
    file = folder / "model.safetensors"
    tensors = load_file(file)
    bias = tensors.pop("denoiser.leave.bias")
    if what == "shape":
        tensors["denoiser.leave.bias"] = bias[:-1].clone()
    elif what == "nan":
        tensors["denoiser.leave.bias"] = torch.full_like(bias, torch.nan)
    save_file(tensors, file)
    if what == "text":
        file.write_text("weights")
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    shutil.rmtree(tmp_path / "fitting", ignore_errors=True)
    fitting = _changed(folder, tmp_path / "fitting", digest=digest)
    with pytest.raises(FileFormatError) as caught:
        load_model(fitting)
    assert message in str(caught.value)


def test_a_checkpoint_is_written_whole_or_not_at_all(saved: Path, tmp_path: Path, monkeypatch: Any) -> None:
    network = load_torch_model(saved).network
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(MissingFileError, match="folder for a checkpoint"):
        save_model(tmp_path / "file" / "inside", network, {})
    (tmp_path / "precious").mkdir()
    (tmp_path / "precious" / "thesis.txt").write_text("years of work")
    with pytest.raises(MissingFileError, match="something else is there"):
        save_model(tmp_path / "precious", network, {})
    folder = tmp_path / "there"
    save_model(folder, network, {"step": 1})
    left = tmp_path / ".there.killed.part"
    left.mkdir()

    def full(*_: object) -> int:
        raise OSError(28, "No space left on device")

    replace, calls = os.replace, []

    def refused(source: Any, target: Any) -> None:
        calls.append(target)
        if len(calls) == 2:
            full()
        replace(source, target)

    for owner, name, fault in ((Path, "write_bytes", full), (os, "replace", refused)):
        monkeypatch.setattr(owner, name, fault)
        with pytest.raises(MissingFileError, match="no space left on device"):
            save_model(folder, network, {"step": 2})
        monkeypatch.undo()
        assert load_model(folder).about == {"step": 1}
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "precious", "there"]
    save_model(folder, network, {"step": 3})
    assert load_model(folder).about == {"step": 3}
