"""Latent spaces, encoders, and networks, against other implementations, and against what they claim."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from models import DOF, VARIATIONAL, WALL, kernel, network, query, some_paths

from apex_ompl.errors import ParameterError
from apex_ompl.kernel import Kernel
from apex_ompl.model.config import DenoiserConfig
from apex_ompl.model.geometry import SHAPES, rotation_matrices, signed_distances
from apex_ompl.model.proposals import Sampling
from apex_ompl.model.query import ObstacleSet, Probes, Query
from apex_ompl.paths.spline import Spline
from apex_ompl.training.autoencoder import LinearLatent, VariationalLatent
from apex_ompl.training.conditions import ConditionTable, batch_queries
from apex_ompl.training.networks import ConditionEncoder, UNetDenoiser
from apex_ompl.training.torch_model import TorchModel

# Latent spaces


@pytest.mark.parametrize("parts", [{}, VARIATIONAL], ids=["linear", "variational"])
def test_ends_are_exact_whatever_the_weights_are(parts: dict[str, object]) -> None:
    model = network(3, **parts)
    ends = torch.randn(2, 5, DOF, generator=torch.Generator().manual_seed(0))
    latent = 10.0 * torch.randn(5, *model.latent, generator=torch.Generator().manual_seed(1))
    path = model.autoencoder.decode(latent, *ends)
    assert path.shape == (5, 256, DOF)
    assert (path[:, 0] == ends[0]).all() and (path[:, -1] == ends[1]).all()
    control = model.autoencoder.control(latent, *ends)
    assert (control[:, 0] == ends[0]).all() and (control[:, -1] == ends[1]).all()
    assert torch.isfinite(path).all()


def test_all_components_give_paths_back_and_few_give_the_nearest() -> None:
    control = torch.tensor(some_paths().control(), dtype=torch.float64)
    full = LinearLatent(Spline(), DOF, 192).double()
    full.fit(control)
    latent = full.encode(control)
    torch.testing.assert_close(full.control(latent, control[:, 0], control[:, -1]), control, atol=1e-5, rtol=0)
    torch.testing.assert_close(latent.mean(dim=0), torch.zeros(192).double(), atol=1e-4, rtol=0)
    large = full.deviations > 1.01e-3 * full.deviations.max()  # the others are nearly nothing
    torch.testing.assert_close(latent.T @ latent / len(latent) * large, torch.diag(large).double(), atol=2e-3, rtol=0)
    few = LinearLatent(Spline(), DOF, 20).double()
    few.fit(control)
    rows = few.residual(control).flatten(1)
    rows = rows - rows.mean(dim=0)
    values = torch.linalg.svdvals(rows)  # no 20 directions leave less (Eckart and Young)
    rest = few.control(few.encode(control), control[:, 0], control[:, -1]) - control
    assert float(rest.square().sum()) == pytest.approx(float(values[20:].square().sum()), rel=1e-3)


def test_paths_of_control_points_are_those_of_the_spline() -> None:
    paths = some_paths()
    model = LinearLatent(Spline(), DOF, 10).double()
    control = torch.tensor(paths.control(slice(0, 20)))
    np.testing.assert_allclose(model.path(control).numpy(), Spline().path(control.numpy()), atol=2e-6)
    line = model.line(control[:, 0], control[:, -1]).numpy()
    np.testing.assert_allclose(line, Spline().line(control[:, 0].numpy(), control[:, -1].numpy()), atol=1e-6)


def test_the_variational_network_learns_to_give_paths_back() -> None:
    torch.manual_seed(0)
    control = torch.tensor(some_paths().control()[::10][:32], dtype=torch.float32)
    model = VariationalLatent(Spline(), DOF, 8, 32)
    model.fit_scale(control)
    optimizer = torch.optim.Adam(model.parameters(), 2e-3)
    errors = []
    for k in range(120):
        noise = torch.randn(len(control), *model.latent, generator=torch.Generator().manual_seed(k))
        loss, error = model.loss(control, noise, 1e-6)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        errors.append(float(error.detach()))
    assert errors[-1] < 0.1 * errors[0]
    model.fit_scale(control)
    with torch.no_grad():
        latent = model.encode(control)
        assert latent.std(dim=(0, 2)) == pytest.approx(np.ones(8), abs=0.05)
        found = model.control(latent, control[:, 0], control[:, -1])
        path = model.path(control)
        error = (model.path(found) - path).square().mean()
        assert error < 0.2 * (model.path(model.line(control[:, 0], control[:, -1])) - path).square().mean()


def test_states_that_cannot_be_halved_are_refused() -> None:
    with pytest.raises(ParameterError, match="states, width: expected 16 times a whole number of states"):
        VariationalLatent(Spline(states=250), DOF)
    with pytest.raises(
        ParameterError, match="dimension of the latent space: expected a whole number from 1 to 192, got 193"
    ):
        LinearLatent(Spline(), DOF, 193)


# Conditions


@given(st.integers(0, 2**31))
@settings(max_examples=20)
def test_quaternions_become_the_rotations_of_scipy(seed: int) -> None:
    from scipy.spatial.transform import Rotation

    quaternions = np.random.default_rng(seed).normal(size=(7, 4))
    np.testing.assert_allclose(rotation_matrices(quaternions), Rotation.from_quat(quaternions).as_matrix(), atol=1e-6)


@pytest.mark.parametrize("shape", SHAPES)
def test_distances_are_those_of_the_meshes_library(shape: str) -> None:
    import coal

    rng = np.random.default_rng(3)
    size = {"box": (0.1, 0.2, 0.3), "sphere": (0.2, 0.0, 0.0)}.get(shape, (0.15, 0.4, 0.0))
    theirs = {
        "box": coal.Box(0.1, 0.2, 0.3), "sphere": coal.Sphere(0.2), "cylinder": coal.Cylinder(0.15, 0.4),
        "capsule": coal.Capsule(0.15, 0.4),
    }[shape]  # fmt: skip
    quaternion = rng.normal(size=4)
    obstacles = ObstacleSet.from_rows([(SHAPES.index(shape), (0.1, -0.2, 0.3), quaternion, size)])
    ends = np.zeros(DOF)
    given_ = batch_queries([Query(ends, ends, np.zeros(3), obstacles)], Probes.from_robot(kernel().robot, 2), kernel())
    points = rng.uniform(-0.8, 0.8, (60, 3))
    mine = signed_distances(
        given_.shape[0], given_.position[0], given_.rotation[0], given_.size[0], torch.tensor(points[None]).float()
    )[0].numpy()  # fmt: skip
    pose = coal.Transform3s(rotation_matrices(quaternion).astype(float), np.array([0.1, -0.2, 0.3]))
    for point, value in zip(points, mine, strict=True):
        result = coal.DistanceResult()
        dot = coal.Transform3s(np.eye(3), point)
        coal.distance(coal.Sphere(1e-9), dot, theirs, pose, coal.DistanceRequest(), result)
        if result.min_distance > 1e-3:
            assert value == pytest.approx(result.min_distance, abs=1e-4)
        else:
            assert value < 2e-3


def test_probes_are_where_the_joints_take_them() -> None:
    probes, q = Probes.from_robot(kernel().robot, 5), query()
    positions = probes.positions(kernel(), q.start[None], q.goal[None])
    assert positions.shape == (1, 5, len(probes.joint), 3)
    turn, origin = kernel().joint_frames(np.stack([q.start, (q.start + q.goal) / 2, q.goal]))
    for k, along in enumerate((0, 2, 4)):
        wanted = [turn[k, j] @ p + origin[k, j] for j, p in zip(probes.joint, probes.offset, strict=True)]
        np.testing.assert_allclose(positions[0, along], wanted, atol=1e-6)


@pytest.mark.parametrize("scene", ["none", "set", "distances"])
def test_the_order_of_obstacles_does_not_matter(scene: str) -> None:
    torch.manual_seed(0)
    probes, rng = Probes.from_robot(kernel().robot, 3), np.random.default_rng(5)
    sizes = {"probes": len(probes.joint), "along": 3, "out": 20, "width": 16}
    encoder = ConditionEncoder(DOF, scene=scene, point=True, **sizes)
    rows = [
        (int(rng.integers(4)), rng.uniform(-1, 1, 3), rng.normal(size=4), rng.uniform(0.05, 0.4, 3)) for _ in range(9)
    ]
    q = query()

    def encoded(chosen: list[int], beside: int = 0) -> torch.Tensor:
        """The code of a query, in a batch with another one of ``beside`` obstacles."""
        mine = Query(q.start, q.goal, q.point, ObstacleSet.from_rows([rows[k] for k in chosen]))
        other = Query(q.goal, q.start, q.point, ObstacleSet.from_rows(rows[:beside]))
        return encoder(batch_queries([mine, other], probes, kernel()))[0]

    first = encoded(list(range(9)))
    for _ in range(5):
        torch.testing.assert_close(encoded(list(rng.permutation(9)), 4), first, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(encoded([0, 1]), encoded([1, 0], 9), atol=1e-5, rtol=1e-5)
    other = encoded(list(range(8)))
    assert (scene == "none") == torch.allclose(other, first, atol=1e-5)
    assert torch.isfinite(encoded([])).all()


def test_conditions_of_stored_paths_are_those_of_their_problems() -> None:
    paths = some_paths()
    probes = Probes.from_robot(kernel().robot, 3)
    which = np.arange(0, len(paths), 37)
    found = ConditionTable(paths, probes, kernel()).conditions(torch.from_numpy(which))
    a = paths.arrays
    first = np.concatenate([[0], np.cumsum(a["things"])])
    queries = []
    for k in which:
        p = a["problem"][k]
        span = slice(int(first[p]), int(first[p + 1]))
        columns = (a[name][span] for name in ("shape", "position", "orientation", "size"))
        obstacles = ObstacleSet.from_rows(list(zip(*columns, strict=True)))
        queries.append(Query(paths.start[k], paths.goal[k], a["point"][k], obstacles))
    wanted = batch_queries(queries, probes, kernel())
    torch.manual_seed(0)
    sizes = {"probes": len(probes.joint), "along": 3, "out": 20, "width": 16}
    encoder = ConditionEncoder(DOF, scene="distances", point=True, **sizes)
    torch.testing.assert_close(encoder(found), encoder(wanted), atol=1e-4, rtol=1e-4)


# Networks


def test_the_unet_takes_its_condition_and_its_step() -> None:
    torch.manual_seed(0)
    net = UNetDenoiser(4, 12, 8, (1, 2, 4))
    latent, condition, t = torch.randn(3, 4, 16), torch.randn(3, 12), torch.tensor([3, 100, 255])
    out = net(latent, t, condition)
    assert out.shape == latent.shape
    assert not torch.allclose(out, net(latent, t, condition + 1.0), atol=1e-3)
    assert not torch.allclose(out, net(latent, t - 3, condition), atol=1e-3)
    torch.testing.assert_close(out[1:2], net(latent[1:2], t[1:2], condition[1:2]), atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize(
    "parts", [{}, VARIATIONAL, {"denoiser": DenoiserConfig(kind="regression", width=32, blocks=2)}]
)
def test_the_same_seed_gives_the_same_paths(parts: dict[str, object]) -> None:
    model = TorchModel(network(**parts), {})

    def proposed(seed: int) -> np.ndarray:
        generator = np.random.default_rng(seed)
        sampling = Sampling("ddpm", 4)
        return model.propose(query(), kernel(WALL), 3, sampling=sampling, generator=generator).control

    first, limits = proposed(1), kernel().robot.arrays
    np.testing.assert_array_equal(first, proposed(1))
    assert np.array_equal(first, proposed(2)) == model.network.is_regression
    assert (first[:, 0] == query().start).all() and (first[:, -1] == query().goal).all()
    assert ((first >= limits.lower) & (first <= limits.upper)).all()


def test_noise_up_to_a_step_leaves_paths_near() -> None:
    """One step of noise, and of denoising by whatever network, changes a path less than all of it."""
    model = TorchModel(network(), {})
    control = some_paths().control(slice(0, 1)).repeat(6, axis=0)
    ends = Query(control[0, 0], control[0, -1], np.zeros(3), ObstacleSet.from_rows([]))

    def change(step: int) -> float:
        generator = np.random.default_rng(0)
        found = model.renoise(ends, kernel(), control, step, sampling=Sampling(steps=3), generator=generator)
        return float(np.abs(found.control - control).mean())

    assert change(0) < 0.2 * change(255)
    with pytest.raises(ParameterError, match="step: expected a whole number from 0 to 255, got 256"):
        change(256)
    with pytest.raises(ParameterError, match=r"control points: expected finite numbers of shape \(B, 14, 16\)"):
        model.renoise(ends, kernel(), control[:, :5], 3)
    with pytest.raises(ParameterError, match="control points: expected finite numbers"):
        model.renoise(ends, kernel(), control * np.nan, 3)


def test_a_query_of_another_robot_is_refused() -> None:
    model = TorchModel(network(), {})
    with pytest.raises(ParameterError, match=r"start: expected finite numbers of shape \(16,\)"):
        model.propose(Query(np.zeros(7), np.zeros(7), np.zeros(3), ObstacleSet.from_rows([])), kernel(), 1)
    tables = kernel().robot
    other = Kernel(dataclasses.replace(tables, name="baxter"), kernel().scene)
    with pytest.raises(ParameterError, match="robot: expected dual_panda_softhand, which .* got 'baxter'"):
        model.propose(query(), other, 1)
    nan = query()
    nan.goal[3] = np.nan
    with pytest.raises(ParameterError, match="goal: expected finite numbers"):
        model.propose(nan, kernel(), 1)
    lost = query()
    lost.obstacles.position[0, 1] = np.nan
    with pytest.raises(ParameterError, match="obstacles: expected finite positions"):
        model.propose(lost, kernel(), 1)
    with pytest.raises(ParameterError, match="count: expected a whole number, 1 or more, got 0"):
        model.propose(query(), kernel(), 0)
