"""The model evaluated by NumPy, against torch's evaluation of the same weights."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from models import (
    CLEARANCES,
    DOF,
    HANDS,
    POST,
    REFINED,
    REGRESSION,
    VARIATIONAL,
    WALL,
    config,
    kernel,
    network,
    query,
    some_paths,
)

from apex_ompl.errors import ParameterError
from apex_ompl.kernel.compiled.network.dense_layer import dense_layer
from apex_ompl.model.array_model import ArrayModel, expanded, is_supported, quantized, weight_shapes
from apex_ompl.model.checkpoint import load_model
from apex_ompl.model.config import ConditionConfig, DenoiserConfig, LatentConfig, NoiseConfig
from apex_ompl.model.diffusion import SAMPLERS
from apex_ompl.model.guidance import Guidance
from apex_ompl.model.proposals import Sampling
from apex_ompl.model.query import ObstacleSet, Query
from apex_ompl.training.latent_diffusion import LatentDiffusion
from apex_ompl.training.torch_model import TorchModel, load_torch_model

SCENES: list[dict[str, Any]] = [
    {},
    {"condition": ConditionConfig(scene="set", width=16, out=32, along=3)},
    {"condition": ConditionConfig(scene="none", point=True, width=16, out=32, along=3)},
    {"noise": NoiseConfig(prediction="noise", schedule="linear", most=4.0)},
    {"noise": NoiseConfig(prediction="clean")},
    REGRESSION,
    CLEARANCES,
    REFINED,
]
EMPTY = Query(query().start, query().goal, np.zeros(3), ObstacleSet.from_rows([]))


def both(**parts: Any) -> tuple[ArrayModel, TorchModel]:
    """The same weights as arrays and as modules; limits are those of the robot, so that features are of size one."""
    net, limits = network(**parts), kernel().robot.arrays
    net.encoder.set_limits(*(torch.tensor(v, dtype=torch.float32) for v in (limits.lower, limits.upper)))
    weights = quantized({name: tensor.numpy() for name, tensor in net.state_dict().items()})
    net.load_state_dict({name: torch.from_numpy(values) for name, values in expanded(weights).items()})
    return ArrayModel(net.config, weights, {}), TorchModel(net, {})


@pytest.mark.parametrize(
    "parts", SCENES, ids=["distances", "set", "point", "noise", "clean", "regression", "clearances", "refined"]
)
@pytest.mark.parametrize("queries", [query(), [query(1), query(2), EMPTY]], ids=["one", "three"])
def test_numpy_proposes_what_torch_does(parts: dict[str, Any], queries: Any) -> None:
    models = both(**parts)
    for sampling in (Sampling("ddim", 2), Sampling("dpm_solver", 5, 1.6), Sampling("ddpm", 8)):
        mine, theirs = (
            model.propose(queries, kernel(WALL, POST), 5, sampling=sampling, generator=np.random.default_rng(3))
            for model in models
        )
        np.testing.assert_allclose(mine.control, theirs.control, atol=2e-4)
        assert np.ptp(mine.control[:5], axis=0).max() > 1e-2 or parts is REGRESSION


@pytest.mark.parametrize("scaling", ["noise", "clean"])
@pytest.mark.parametrize("name", SAMPLERS)
def test_guidance_by_numpy_is_that_of_torch(name: str, scaling: str) -> None:
    sampling = Sampling(name, 4, 1.0, Guidance(1.0, scaling, margin=0.1))
    plain, *found = (
        model.propose(query(), kernel(WALL, POST), 4, sampling=how, generator=np.random.default_rng(5)).control
        for model, how in zip((*both()[:1], *both()), (Sampling(name, 4), sampling, sampling), strict=True)
    )
    np.testing.assert_allclose(found[0], found[1], atol=2e-3)  # gradients jump where the nearest pair changes
    assert np.abs(found[0] - plain).max() > 1e-2


def test_paths_noised_by_numpy_are_those_of_torch() -> None:
    control = some_paths().control(slice(0, 1)).repeat(6, axis=0)
    ends = Query(control[0, 0], control[0, -1], np.zeros(3), ObstacleSet.from_rows([]))
    mine, theirs = (
        model.renoise(ends, kernel(), control, 60, sampling=Sampling(steps=3), generator=np.random.default_rng(0))
        for model in both()
    )
    np.testing.assert_allclose(mine.control, theirs.control, atol=2e-4)
    np.testing.assert_allclose(mine.latent, theirs.latent.numpy(), atol=2e-4)


@settings(max_examples=25, deadline=None)
@given(
    st.sampled_from(["none", "set", "distances", "clearances"]), st.booleans(), st.sampled_from(["mlp", "regression"]),
    st.integers(1, 12 * DOF), st.sampled_from([8, 24, 64]), st.integers(1, 5), st.integers(2, 6),
)  # fmt: skip
def test_shapes_of_weights_are_those_of_the_modules(  # noqa: PLR0917
    scene: Any, point: bool, kind: Any, dim: int, width: int, blocks: int, along: int
) -> None:
    made = config(
        latent=LatentConfig(dim=dim), denoiser=DenoiserConfig(kind=kind, width=width, blocks=blocks),
        condition=ConditionConfig(
            scene=scene, point=point, width=width, out=2 * width, along=along, keys=along, hands=HANDS
        ),
    )  # fmt: skip
    assert is_supported(made)
    with torch.device("meta"):
        wanted = {name: tuple(tensor.shape) for name, tensor in LatentDiffusion(made).state_dict().items()}
    assert weight_shapes(made) == wanted


def test_what_numpy_cannot_evaluate_is_said() -> None:
    assert not is_supported(config(**VARIATIONAL))
    with pytest.raises(ParameterError, match="dimension of the latent space"):
        weight_shapes(config(latent=LatentConfig(dim=12 * DOF + 1)))


@pytest.mark.parametrize(("after", "before"), [(1, 53), (36, 64), (37, 53), (38, 3)])
@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 8, 11])
def test_a_dense_layer_is_a_matrix_product(count: int, after: int, before: int) -> None:
    rng = np.random.default_rng(count)
    weight = rng.integers(-127, 128, (after, before)).astype(np.int8)
    scale, bias, rows = (rng.normal(size=s).astype(np.float32) for s in ((after,), (after,), (count, before)))
    out = np.full((count, after), np.nan, np.float32)
    dense_layer(weight, scale, bias, rows, out)
    wanted = rows.astype(float) @ (weight * scale[:, None].astype(float)).T + bias
    np.testing.assert_allclose(out, wanted, rtol=1e-5, atol=1e-3)


def test_eight_bits_propose_what_half_precision_does() -> None:
    """The paths of the shipped model move by far less than they differ from each other."""
    models = load_model("apex"), load_torch_model("apex")
    assert models[0].weights["denoiser.blocks.0.first.weight"].dtype == np.int8
    mine, theirs = (
        m.propose(query(), kernel(WALL, POST), 16, generator=np.random.default_rng(0)).control for m in models
    )
    spread = np.sqrt(((theirs - theirs.mean(axis=0)) ** 2).mean())
    assert 0.0 < np.sqrt(((mine - theirs) ** 2).mean()) < 0.15 * spread


def test_a_plan_needs_no_torch() -> None:
    """Importing it takes longer than most problems."""
    code = "import sys, apex_ompl; result = apex_ompl.plan('shelf/hard/800003', seed=1); print(result.status); "
    code += "sys.exit('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=False)
    assert (done.returncode, done.stdout.split()) == (0, ["EXACT_SOLUTION"]), done.stderr
