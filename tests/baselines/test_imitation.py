"""Imitation policies: what the network sees, what it is taught, and what it rolls out."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from imitations import GROUPS, NETWORK, SMALL, config, lively, trained
from support import DATA, ROOT
from trainings import query_from_path

from apex_ompl.baselines.imitation.config import ImitationConfig, NetworkConfig
from apex_ompl.baselines.imitation.data import NO_PROBES, WindowData
from apex_ompl.baselines.imitation.network import PolicyNetwork
from apex_ompl.baselines.imitation.policy import shared_policy
from apex_ompl.baselines.imitation.training import ImitationTrainer
from apex_ompl.errors import ApexError, FileFormatError
from apex_ompl.kernel import Kernel, RobotTables
from apex_ompl.kernel.scene_builder import scene_tables
from apex_ompl.training.conditions import Conditions, batch_queries
from apex_ompl.training.data import Mirror
from apex_ompl.training.records import Paths
from apex_ompl.training.store import load
from apex_ompl.util.process import one_torch_thread

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
        found: torch.Tensor = network(batch_queries([replace(query, known=obstacles)], NO_PROBES, kernel), state, time)
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
    part = policy.roll_out(queries, kernel, first_step=CLOCK - 6, steps=64)
    assert part is not None and part.shape == (5, 6, 16)
    assert policy.roll_out(queries, kernel, stop=lambda: True) is None
