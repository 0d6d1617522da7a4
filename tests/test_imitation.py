"""Imitation policies: what the network sees, what it is taught, and how it is kept."""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from imitations import GROUPS, NETWORK, SMALL, config, trained, weights
from support import DATA, ROOT
from trainings import assert_same, query_from_path

from apex_ompl.datasets.records import Paths
from apex_ompl.datasets.store import load
from apex_ompl.diffusion.conditions import Conditions, batch_queries
from apex_ompl.diffusion.mirror import Mirror
from apex_ompl.errors import ApexError, FileFormatError, MissingFileError
from apex_ompl.imitation.checkpoint import load_policy_network, save_policy
from apex_ompl.imitation.config import ImitationConfig, NetworkConfig
from apex_ompl.imitation.data import NO_PROBES, WindowData
from apex_ompl.imitation.network import PolicyNetwork
from apex_ompl.imitation.policy import ImitationPolicy, policy_folder, shared_policy
from apex_ompl.imitation.training import ImitationTrainer
from apex_ompl.kernel import Kernel, RobotTables
from apex_ompl.kernel.scene_builder import scene_tables
from apex_ompl.util.threads import one_torch_thread

MIRROR = yaml.safe_load((ROOT / "scripts" / "configs" / "il.yaml").read_text())["mirror"]
CLOCK, CHUNK = NETWORK["clock"], NETWORK["chunk"]


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


def lively(obstacles: str = "set") -> PolicyNetwork:
    """A network all of whose weights are random, the last layer's, too."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        network = PolicyNetwork(NetworkConfig.model_validate({**NETWORK, "obstacles": obstacles}))
        for parameter in network.parameters():
            torch.nn.init.normal_(parameter, std=0.2)
    return network.eval().requires_grad_(False)


def some(file: Path, kernel: Kernel, which: range = range(32)) -> tuple[Conditions, torch.Tensor, torch.Tensor]:
    """Conditions of stored paths, and states and times of three windows of each."""
    paths, generator = load(file), torch.Generator().manual_seed(1)
    conditions = batch_queries([query_from_path(paths, k) for k in which], NO_PROBES, kernel)
    state = conditions.start[:, None] + 0.3 * torch.randn(len(which), 3, 16, generator=generator)
    return conditions, state, torch.randint(CLOCK - 1, (len(which), 3), generator=generator)


# Network


@pytest.mark.parametrize("obstacles", ["set", "point"])
def test_a_batch_is_what_its_windows_are_alone(obstacles: str, few: Path, kernel: Kernel) -> None:
    """Padding, other paths of the batch and other windows of the path change nothing."""
    network, paths = lively(obstacles), load(few)
    conditions, state, time = some(few, kernel)
    found = network(conditions, state, time)
    assert found.shape == (32, 3, CHUNK, 16) and found.dtype == torch.float32
    assert found.std() > 0.1
    for k in range(0, 32, 5):
        alone = batch_queries([query_from_path(paths, k)], NO_PROBES, kernel)
        for w in range(3):
            one = network(alone, state[k : k + 1, w : w + 1], time[k : k + 1, w : w + 1])
            torch.testing.assert_close(one[0, 0], found[k, w], atol=2e-5, rtol=1e-5)


def test_the_order_of_the_obstacles_does_not_matter_and_each_of_them_does(few: Path, kernel: Kernel) -> None:
    network, paths, rng = lively(), load(few), np.random.default_rng(0)
    queries = [query_from_path(paths, k) for k in range(32)]
    k = int(np.argmax([len(query.obstacles) for query in queries]))
    query, count = queries[k], len(queries[k].obstacles)
    assert count >= 5
    columns = ("shape", "position", "rotation", "size")
    state, time = torch.zeros(1, 1, 16), torch.tensor([[9]])

    def answer(which: np.ndarray) -> torch.Tensor:
        obstacles = replace(query.obstacles, **{name: getattr(query.obstacles, name)[which] for name in columns})
        found: torch.Tensor = network(
            batch_queries([replace(query, obstacles=obstacles)], NO_PROBES, kernel), state, time
        )
        return found

    whole = answer(np.arange(count))
    torch.testing.assert_close(answer(rng.permutation(count)), whole, atol=1e-5, rtol=1e-5)
    for left_out in range(count):
        assert (answer(np.delete(np.arange(count), left_out)) - whole).abs().max() > 1e-4
    point = lively("point")
    conditions = batch_queries([query], NO_PROBES, kernel)
    torch.testing.assert_close(
        point(conditions, state, time), point(replace(conditions, mask=~conditions.mask), state, time)
    )
    assert (
        point(replace(conditions, point=conditions.point + 0.1), state, time) - point(conditions, state, time)
    ).any()


def test_without_an_output_the_policy_goes_straight_and_arrives_in_time(few: Path, kernel: Kernel) -> None:
    network = PolicyNetwork(NetworkConfig.model_validate(NETWORK)).eval()  # its last layer is zero at first
    conditions, state, _ = some(few, kernel)
    with torch.no_grad():
        for at in (0, 20, CLOCK - 1 - CHUNK, CLOCK - 3):
            found = network(conditions, state, torch.full((32, 3), at)).numpy()
            for j in range(CHUNK):
                share = min(1.0, (j + 1) / (CLOCK - 1 - at))
                goal, here = conditions.goal.numpy()[:, None], state.numpy()
                np.testing.assert_allclose(found[:, :, j], here + share * (goal - here), atol=1e-5)


# Data


def test_windows_are_states_of_the_paths(few: Path) -> None:
    data, paths = WindowData(config(few, noise=0.1), RobotTables.load(DATA / "robot.npz")), load(few)
    dense = np.stack([paths.spline.basis(np.linspace(0, 1, CLOCK)) @ c for c in paths.control()])
    which = np.arange(len(paths))
    clean = data.windows(data.train, which, 0.0, torch.Generator().manual_seed(3))
    noisy = data.windows(data.train, which, 0.1, torch.Generator().manual_seed(3))
    for k in which:
        for w in range(4):
            at = int(clean.time[k, w])
            assert w * (CLOCK - 1) // 4 <= at <= -(-(w + 1) * (CLOCK - 1) // 4)
            wanted = dense[k, np.minimum(at + np.arange(CHUNK + 1), CLOCK - 1)]
            np.testing.assert_allclose(clean.state[k, w], wanted[0], atol=2e-6)
            np.testing.assert_allclose(clean.following[k, w], wanted[1:], atol=2e-6)
    assert torch.equal(clean.following, noisy.following) and torch.equal(clean.time, noisy.time)
    noise = (noisy.state - clean.state).numpy()
    assert noise.std() == pytest.approx(0.1, rel=0.1) and abs(noise.mean()) < 0.01
    np.testing.assert_array_equal(clean.conditions.goal.numpy(), paths.goal.astype(np.float32))
    again = WindowData(config(few, noise=0.1), RobotTables.load(DATA / "robot.npz"))
    for step in (0, 5, 17):
        assert torch.equal(data.batch(step).state, again.batch(step).state)
    assert not torch.equal(data.batch(0).state, data.batch(1).state)


def test_mirror_images_are_images_of_windows(few: Path) -> None:
    """A window of an image is the image of a window: states, goal, point and obstacles."""
    robot, mirror = RobotTables.load(DATA / "robot.npz"), Mirror(**MIRROR)
    data, paths = WindowData(config(few, mirror=MIRROR), robot), load(few)
    image = mirror.paths(paths, Kernel(robot, scene_tables([])))
    count, extra = len(paths), len(data.train) - len(paths)
    assert 0 < extra == len(image)
    both = data.windows(data.train, np.arange(count + extra), 0.0, torch.Generator().manual_seed(0))
    states = data.states(data.train.control, torch.zeros(count + extra, 1, dtype=torch.long) + 13)[:, 0].numpy()
    flip = np.array([1.0, -1.0, 1.0])
    matched = 0
    for n in range(count, count + extra):
        twin = next(
            k for k in range(count)
            if np.abs(mirror.states(states[k].astype(float)) - states[n]).max() < 2e-3  # half precision of the images
        )  # fmt: skip
        conditions = both.conditions
        np.testing.assert_allclose(mirror.states(conditions.goal[twin].double().numpy()), conditions.goal[n], atol=1e-5)
        np.testing.assert_allclose(conditions.point[twin].numpy() * flip, conditions.point[n], atol=1e-6)
        mask = conditions.mask[n]
        assert torch.equal(mask, conditions.mask[twin])
        here, there = (conditions.position[k][mask].numpy() for k in (twin, n))
        np.testing.assert_allclose(here * flip, there, atol=1e-6)
        turned = np.diag(flip) @ conditions.rotation[twin][mask].numpy() @ np.diag(flip)
        np.testing.assert_allclose(turned, conditions.rotation[n][mask], atol=1e-5)
        matched += 1
    assert matched == extra


def test_faulty_data_and_configurations_are_named(few: Path, tmp_path: Path) -> None:
    for change, message in (
        ({"data": "/no/such"}, "manifest of a data set '/no/such/manifest.json': no such file"),
        ({"mirror": {"order": [0], "sign": [1], "shift": [0]}}, "mirror: expected 16 joints, got 1"),
        ({"network": {**NETWORK, "groups": [[0, 1]]}}, "network.groups: expected 16 joints, got 2"),
    ):
        with pytest.raises(ApexError) as caught:
            ImitationTrainer(ImitationConfig.model_validate({**SMALL, "data": str(few), **change}), tmp_path)
        assert str(caught.value) == message
    file = tmp_path / "faulty.yaml"
    for change, message in (
        ({"schema": "apex-ompl/training/1"}, "schema: expected 'apex-ompl/imitation-training/1'"),
        ({"stepz": 3}, "stepz: unknown key, did you mean 'steps'?"),
        ({"network": {**NETWORK, "heads": 5}}, "network: expected a width that is a multiple of the number of heads"),
        ({"network": {**NETWORK, "groups": [[0], [2]]}}, "network: expected every joint's number once in the groups"),
    ):
        file.write_text(yaml.safe_dump({**SMALL, "data": str(few), **change}))
        with pytest.raises(FileFormatError, match="faulty.yaml") as caught:
            ImitationConfig.read(file)
        assert message in str(caught.value)
    for name in ("il", "il-paper"):
        read = ImitationConfig.read(ROOT / "scripts" / "configs" / f"{name}.yaml", {"network.layers": 2, "steps": 3})
        assert (read.network.layers, read.steps, read.noise) == (2, 3, 0.005)
        assert [list(group) for group in read.network.groups] == GROUPS


# Training


def test_a_few_paths_are_learned(few: Path, tmp_path: Path) -> None:
    """The error falls far below that of straight lines, and the policy's own path follows the stored one."""
    network = {**NETWORK, "width": 64}
    changes: dict[str, Any] = {"steps": 350, "rate": 3e-3, "cooldown": 100, "ema": 0.98, "noise": 0.01, "batch": 16}
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
    with pytest.raises(FileFormatError, match="expected the state of a run with this configuration"):
        ImitationTrainer(config(few, obstacles="point"), tmp_path)


def test_the_script_trains_resumes_and_needs_no_ompl(few: Path, tmp_path: Path) -> None:
    file, script = tmp_path / "small.yaml", ROOT / "scripts" / "train_il.py"
    file.write_text(yaml.safe_dump({**SMALL, "data": str(few), "steps": 4}))
    code = "import sys\nfor name in ('ompl', 'pinocchio', 'coal', 'ruckig'):\n    sys.modules[name] = None\n"
    code += f"sys.argv = ['train_il.py', {str(file)!r}, '--out', {str(tmp_path / 'run')!r}, '--quiet', *sys.argv[1:]]\n"
    code += f"exec(compile(open({str(script)!r}).read(), {str(script)!r}, 'exec'), {{'__name__': '__main__', "
    code += f"'__file__': {str(script)!r}}})\n"
    for steps in ("4", "9"):
        done = subprocess.run(
            [sys.executable, "-c", code, "--set", f"steps={steps}"], check=False, capture_output=True, text=True
        )
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


# Roll-outs


def test_roll_outs_are_the_policy_step_by_step(saved: Path, paths: Paths, kernel: Kernel) -> None:
    """Against a loop that asks the network itself, with and without blending; several starts are as each alone."""
    policy = shared_policy(saved)
    queries = [query_from_path(paths, k) for k in range(0, 60, 12)]
    lower, upper = (v.astype(np.float32) for v in (kernel.robot.arrays.lower, kernel.robot.arrays.upper))
    for blend, executed in ((True, 3), (False, 8), (True, 8)):
        found = policy.roll_out(queries, kernel, executed=executed, blend=blend)
        assert found is not None
        for query, path in zip(queries, found, strict=True):
            np.testing.assert_array_equal(path[0], query.start)
            assert ((path >= kernel.robot.arrays.lower) & (path <= kernel.robot.arrays.upper)).all()
            conditions = batch_queries([query], NO_PROBES, kernel)
            states, rest = [query.start.astype(np.float32)], np.empty((0, 16), np.float32)
            while len(states) < CLOCK:
                state, at = torch.from_numpy(states[-1])[None, None], len(states) - 1
                with torch.no_grad():
                    chunk = policy.network(conditions, state, torch.tensor([[at]]))[0, 0].numpy()
                taken = chunk.copy()
                for j in range(len(rest) if blend else 0):
                    weight = (j + 1) / (len(rest) + 1)
                    taken[j] = weight * chunk[j] + (1 - weight) * rest[j]
                rest = chunk[executed:]
                states += list(np.clip(taken[: min(executed, CLOCK - len(states))], lower, upper))
            np.testing.assert_allclose(path, np.array(states), atol=1e-5)
    part = policy.roll_out(queries, kernel, begin=CLOCK - 6, steps=64)
    assert part is not None and part.shape == (5, 6, 16)
    assert policy.roll_out(queries, kernel, stop=lambda: True) is None
