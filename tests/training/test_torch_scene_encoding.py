"""What models of scene ``clearances`` are trained on: distances by torch, pushes of joints, and augmented paths."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from models import DOF, HANDS, POST, REFINED, WALL, kernel, keys, network, query, some_paths

from apex_ompl.kernel import Kernel
from apex_ompl.kernel.scene_distances import nearest_points
from apex_ompl.model.query import ObstacleSet, Probes
from apex_ompl.model.scene_encoding import REACH, SceneEncoding
from apex_ompl.training.conditions import Augmentation, EncodedPaths
from apex_ompl.training.scene_encoding import KernelSceneEncoding, Obstacles, TorchSceneEncoding
from apex_ompl.training.torch_model import TorchModel
from apex_ompl.types import Array

CPU = torch.device("cpu")
ENCODING = SceneEncoding(keys(), Probes.from_robot(kernel().robot, 3), HANDS)


def drawn(rng: np.random.Generator, count: int) -> ObstacleSet:
    """Obstacles of all shapes at all angles."""
    rows = [(k % 4, rng.uniform(-0.5, 0.5, 3), rng.normal(size=4), rng.uniform(0.05, 0.6, 3)) for k in range(count)]
    return ObstacleSet.from_rows(rows)


def as_tensors(scenes: list[ObstacleSet]) -> Obstacles:
    columns = (
        torch.tensor(np.concatenate([getattr(s, name) for s in scenes]), dtype=kind)
        for name, kind in (
            ("shape", torch.int64), ("position", torch.float32), ("rotation", torch.float32), ("size", torch.float32),
        )
    )  # fmt: skip
    shape, position, rotation, size = columns
    owner = torch.repeat_interleave(torch.arange(len(scenes)), torch.tensor([len(s) for s in scenes]))
    return Obstacles(shape, position, rotation, size, owner)


@settings(max_examples=20)
@given(seed=st.integers(0, 2**31), counts=st.lists(st.integers(0, 9), min_size=1, max_size=4))
def test_nearest_obstacles_are_the_kernels(seed: int, counts: list[int]) -> None:
    rng = np.random.default_rng(seed)
    scenes = [drawn(rng, n) for n in counts]
    points = rng.uniform(-0.8, 0.8, (len(scenes), 30, 3)).astype(np.float32)
    distances, gradients = as_tensors(scenes).nearest(torch.from_numpy(points), 0.4)
    for k, scene in enumerate(scenes):
        wanted, slopes = nearest_points(scene.tables(), points[k], 0.4)
        np.testing.assert_allclose(distances[k].numpy(), wanted, atol=1e-5)
        alike = np.abs(gradients[k].numpy() - slopes).max(axis=1) < 1e-3
        assert alike.mean() >= 0.9, "but for points on edges of the distance"


def test_joints_are_where_the_kernel_has_them() -> None:
    states = np.random.default_rng(0).uniform(kernel().robot.arrays.lower, kernel().robot.arrays.upper, (9, DOF))
    encoding = TorchSceneEncoding(ENCODING, kernel(), CPU)
    paths = torch.tensor(states, dtype=torch.float32)[None]
    centers, radii = encoding.arm_balls(paths)
    rotation, origin = kernel().joint_frames(states)
    ball, joint = ENCODING.keys.ball[:, :, 1:], ENCODING.keys.joint
    wanted = np.einsum("nacij,acpj->nacpi", rotation[:, joint], ball[..., :3]) + origin[:, joint][:, :, :, None]
    np.testing.assert_allclose(centers.numpy().reshape(wanted.shape), wanted, atol=1e-5)
    np.testing.assert_allclose(radii.reshape(9, -1)[0], ball[..., 3].ravel(), atol=1e-6)


def test_features_along_paths_are_those_of_numpy() -> None:
    rng = np.random.default_rng(1)
    scenes = [ObstacleSet.from_rows([]), query(0).obstacles, drawn(rng, 8)]
    paths = np.stack([np.linspace(query(k).start, query(k).goal, 3) for k in range(3)])
    found = TorchSceneEncoding(ENCODING, kernel(), CPU).along(
        torch.tensor(paths, dtype=torch.float32), as_tensors(scenes)
    )
    for row, path, scene in zip(found, paths, scenes, strict=True):
        np.testing.assert_allclose(
            row.numpy(), ENCODING.along(kernel(), path[None], scene.tables(), None)[0], atol=2e-4
        )
    pushed = found[:, -3 * DOF :].abs().amax(dim=1)
    assert pushed[2] > 0.1 and pushed[0] == 0.0


def test_what_the_kernel_sees_is_what_torch_sees() -> None:
    """Frames, distances with their gradients, and clearances at key states, of many scenes at once."""
    rng = np.random.default_rng(5)
    scenes = [drawn(rng, n) for n in (3, 0, 17, 8)]
    among, limits = as_tensors(scenes), kernel().robot.arrays
    states = rng.uniform(limits.lower, limits.upper, (4, 6, DOF))
    paths = torch.tensor(states, dtype=torch.float32)
    encoding, wanted = KernelSceneEncoding(ENCODING, kernel(), CPU), TorchSceneEncoding(ENCODING, kernel(), CPU)
    balls = [one.arm_balls(paths) for one in (encoding, wanted)]
    for mine, theirs in zip(*balls, strict=True):
        torch.testing.assert_close(mine, theirs, atol=1e-5, rtol=0.0)
    torch.testing.assert_close(encoding.least(among, *balls[0]), wanted.least(among, *balls[1]), atol=1e-5, rtol=0.0)
    torch.testing.assert_close(encoding.at_keys(among).float(), wanted.at_keys(among).float(), atol=1e-3, rtol=0.0)
    points = torch.tensor(rng.uniform(-0.8, 0.8, (4, 40, 3)), dtype=torch.float32)
    near, far = encoding.nearest(among, points), wanted.nearest(among, points)
    torch.testing.assert_close(near[0], far[0], atol=1e-5, rtol=0.0)
    assert ((near[1] - far[1]).abs().amax(dim=2) < 1e-3).float().mean() > 0.95, "but for points on edges"
    many, torch_threads = scenes * 200, torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        again = encoding.nearest(as_tensors(many), points.repeat(200, 1, 1))
    finally:
        torch.set_num_threads(torch_threads)
    assert torch.equal(again[0], near[0].repeat(200, 1)) and torch.equal(again[1], near[1].repeat(200, 1, 1))
    lines = np.stack([np.linspace(query(k).start, query(k).goal, 3) for k in range(4)])
    paths = torch.tensor(lines, dtype=torch.float32)
    apart = (encoding.along(paths, among) - wanted.along(paths, among)).abs()
    assert (apart < 1e-3).float().mean() > 0.97
    nothing = as_tensors([drawn(rng, 0), drawn(rng, 0)])
    assert len(encoding.at_keys(nothing)) == len(encoding.least(nothing, balls[0][0][:2], balls[0][1])) == 0
    assert (encoding.nearest(nothing, points[:2])[0] == 0.4).all()


def test_pushes_are_virtual_work() -> None:
    """The rate of a joint times its push is the power of the forces: f . dp/dq, by finite differences."""
    probes, state = ENCODING.probes, query(4).start
    rng = np.random.default_rng(2)

    def points(q: Array) -> Array:
        rotation, origin = kernel().joint_frames(q[None])
        return np.einsum("pij,pj->pi", rotation[0, probes.joint], probes.offset) + origin[0, probes.joint]

    distances, gradients = rng.uniform(-0.1, 2 * REACH, 14), rng.normal(size=(14, 3))
    force = np.maximum(0.0, 1.0 - distances / REACH)[:, None] * gradients
    near = distances[None], gradients[None]
    found = kernel().joint_pushes(kernel().joint_frames(state), probes.joint, points(state)[None], near, REACH)[0]
    step = 1e-6
    wanted = [(force * (points(state + d) - points(state - d))).sum() / (2 * step) for d in step * np.eye(DOF)]
    np.testing.assert_allclose(found, wanted, atol=1e-6)
    assert (np.abs(found[:14]) > 1e-3).sum() >= 12 and not found[14:].any()


def test_what_collisions_cost_rises_as_its_gradient_says() -> None:
    """Against finite differences and the definition; nothing far away, and depth where arms are in obstacles."""
    rng, margin = np.random.default_rng(3), 0.05
    scenes, limits = [drawn(rng, n) for n in (6, 0, 3)], kernel().robot.arrays
    among, paths = as_tensors(scenes), rng.uniform(limits.lower, limits.upper, (3, 4, DOF))
    for kind in (KernelSceneEncoding, TorchSceneEncoding):
        encoding = kind(ENCODING, kernel(), CPU)

        def cost(states: Array, encoding: TorchSceneEncoding = encoding) -> tuple[Array, Array]:
            found = encoding.collision_cost(torch.tensor(states, dtype=torch.float32), among, margin)
            return found[0].double().numpy(), found[1].double().numpy()

        found, slope = cost(paths)
        assert found[0] > 0.1 and found[1] == 0.0 and not slope[1].any() and not slope[..., 14:].any()
        centers, radii = encoding.arm_balls(torch.tensor(paths, dtype=torch.float32))
        for k, scene in enumerate(scenes):
            d = nearest_points(scene.tables(), centers[k].double().numpy(), 1.0)[0] - radii.double().numpy()
            near = np.where(d < 0.0, margin / 2 - d, np.maximum(0.0, margin - d) ** 2 / (2 * margin))
            np.testing.assert_allclose(found[k], near.sum() / 4, rtol=1e-3, atol=1e-4)
        step, wanted = 2e-3, np.zeros_like(paths)
        for where in np.ndindex(*paths.shape):
            d = np.zeros_like(paths)
            d[where] = step
            wanted[where] = (cost(paths + d)[0] - cost(paths - d)[0])[where[0]] / (2 * step)
        apart = np.abs(slope - wanted)
        assert np.mean(apart < 0.03) > 0.95, "but for balls that are as near to two obstacles, or in their middle"
        assert np.abs(wanted).max() > 0.3


@pytest.fixture(scope="module")
def varied() -> EncodedPaths:
    return EncodedPaths(some_paths(), TorchSceneEncoding(ENCODING, kernel(), CPU), Augmentation(0.6, 1.0))


def test_augmented_paths_are_free_among_their_obstacles(varied: EncodedPaths) -> None:
    """Among those of another scene, too; a part is another curve than its path by less than a centimeter."""
    paths, robot = some_paths(), kernel().robot
    which = torch.arange(0, len(paths), len(paths) // 60)
    control, conditions = varied.batch(which, torch.Generator().manual_seed(0))
    among = conditions.among
    assert among is not None
    things = paths.arrays["things"][paths.arrays["problem"][which.numpy()]]
    more = np.bincount(among.owner.numpy(), minlength=len(which)) - things
    assert (more >= 0).all() and (more > 0).sum() > 5
    clearances = []
    for k in np.flatnonzero(more > 0):
        mine = among.owner == k
        columns = (getattr(among, name)[mine].double().numpy() for name in ("position", "rotation", "size"))
        scene = ObstacleSet(among.shape[mine].numpy(), *columns)
        states = np.clip(paths.spline.path(control[k].double().numpy()), robot.arrays.lower, robot.arrays.upper)
        clearances.append(Kernel(robot, scene.tables()).clearance(states[::8])[:, 0].min())
    assert min(clearances) > -0.02 and np.mean(np.array(clearances) > 0.0) > 0.9


def test_parts_are_on_their_paths_and_paths_turn_round(varied: EncodedPaths) -> None:
    paths, which = some_paths(), torch.arange(0, 600, 3)
    control, conditions = varied.batch(which, torch.Generator().manual_seed(1))
    assert torch.equal(control[:, 0], conditions.start)
    assert torch.equal(control[:, -1], conditions.goal)
    whole, turned, parts = 0, 0, 0
    for k, row in zip(which.tolist(), control.double().numpy(), strict=True):
        mine = paths.control(slice(k, k + 1))[0]
        if np.abs(row - mine).max() < 1e-6:
            whole += 1
        elif np.abs(row[::-1] - mine).max() < 1e-6:
            turned += 1
        else:
            parts += 1
            apart = (
                np.abs(paths.spline.path(row)[::16][:, None] - paths.spline.path(mine)[None]).max(axis=2).min(axis=1)
            )
            assert apart.max() < 0.05
    assert min(whole, turned, parts) > 20


def test_the_same_generator_gives_the_same_batch(varied: EncodedPaths) -> None:
    which = torch.arange(40)
    first, second, other = (varied.batch(which, torch.Generator().manual_seed(k)) for k in (3, 3, 4))
    assert torch.equal(first[0], second[0]) and torch.equal(first[1].features, second[1].features)
    assert not torch.equal(first[0], other[0])


def test_a_denoiser_that_sees_its_estimate_depends_on_the_obstacles_there() -> None:
    """At the second step, behind an encoded condition that stays the same."""
    model, asked = TorchModel(network(**REFINED), {}), query(1)
    for parameter in model.network.encoder.psi.parameters():
        torch.nn.init.normal_(parameter, std=0.5)
    seen = []
    along = model._along

    def watched(*args: object) -> object:
        seen.append(args[2])
        return along(*args)

    model._along = watched
    found = model.propose(asked, kernel(WALL, POST), 2)
    assert len(seen) == 1, "of two steps the second sees an estimate"
    model._along = lambda *args: np.zeros_like(along(*args))
    assert np.abs(model.propose(asked, kernel(WALL, POST), 2).control - found.control).max() > 1e-3
    model._along, seen[:] = watched, []
    model.renoise(asked, kernel(WALL, POST), found.control, 200)
    assert len(seen) == 2, "paths that are varied are seen at once"
    np.testing.assert_allclose(seen[0][:, [0, -1]], found.control[:, [0, -1]], atol=1e-5)
