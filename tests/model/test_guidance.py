"""Guidance and the collision cost, against finite differences and the plain model."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import pytest
import torch
from models import POST, VARIATIONAL, WALL, kernel, network, query, some_paths

from apex_ompl.errors import ParameterError, UnknownNameError
from apex_ompl.kernel import Kernel
from apex_ompl.model.config import NoiseConfig
from apex_ompl.model.diffusion import SAMPLERS
from apex_ompl.model.guidance import Guidance, collision_cost
from apex_ompl.model.proposals import Sampling
from apex_ompl.model.query import ObstacleSet, Query
from apex_ompl.paths.spline import Spline
from apex_ompl.training.latent_diffusion import LatentDiffusion
from apex_ompl.training.networks import UNetDenoiser
from apex_ompl.training.torch_model import TorchModel, gradient, log_likelihood


@pytest.mark.parametrize("parts", [{}, VARIATIONAL], ids=["linear", "variational"])
@pytest.mark.parametrize("scaling", ["noise", "clean"])
def test_guidance_of_nothing_is_the_plain_model_bit_for_bit(parts: dict[str, object], scaling: str) -> None:
    model = TorchModel(network(**parts), {})
    for name in SAMPLERS:
        found = [
            model.propose(
                query(), kernel(WALL, POST), 4, sampling=Sampling(name, 5, 1.0, guidance),
                generator=np.random.default_rng(4),
            ).control
            for guidance in (Guidance(gamma=0.0, scaling=scaling), Guidance(gamma=0.0), Guidance(1.0, active_below=0.0))
        ]  # fmt: skip
        np.testing.assert_array_equal(found[0], found[1])
        np.testing.assert_array_equal(found[0], found[2])


def test_the_gradient_of_the_cost_is_that_of_finite_differences() -> None:
    rng, among = np.random.default_rng(0), kernel(WALL, POST)
    paths = Spline(states=16).path(some_paths().control(slice(0, 6)))
    cost, slope = collision_cost(among, paths, 0.1)
    assert (cost > 0).any() and slope.shape == paths.shape
    for _ in range(10):
        direction = rng.normal(size=paths.shape)
        step = 1e-6
        up, down = (collision_cost(among, paths + s * direction, 0.1)[0] for s in (step, -step))
        np.testing.assert_allclose((up - down) / (2 * step), (slope * direction).sum(axis=(1, 2)), rtol=2e-3, atol=2e-4)


@pytest.mark.parametrize("parts", [{}, VARIATIONAL], ids=["linear", "variational"])
def test_the_gradient_goes_through_decoder_and_kernel(parts: dict[str, object]) -> None:
    model, among, guidance = network(**parts), kernel(WALL, POST), Guidance(margin=0.1, samples=32)
    ends = tuple(torch.tensor(e, dtype=torch.float64)[None].repeat(3, 1) for e in (query().start, query().goal))
    latent = 0.5 * torch.randn(3, *model.latent, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    function = partial(_likely, model.double(), among, ends, guidance)
    slope = gradient(function, latent)
    direction = torch.randn(latent.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    difference = (function(latent + 1e-6 * direction) - function(latent - 1e-6 * direction)) / 2e-6
    torch.testing.assert_close((slope * direction).flatten(1).sum(dim=1), difference, rtol=5e-3, atol=5e-4)


def _likely(model: LatentDiffusion, among: Kernel, ends: tuple, guidance: Guidance, z: torch.Tensor) -> torch.Tensor:
    return log_likelihood(model.autoencoder, among, z, ends, guidance)


def test_guided_paths_stay_near_where_little_is_left_of_the_sample() -> None:
    """At the first steps almost all is noise, and whatever is divided by what is left of the sample grows large."""
    model, sizes = TorchModel(network(noise=NoiseConfig(most=4.0)), {}), []
    for gamma in (0.0, 1.0):
        guidance = Guidance(gamma, "noise", active_below=1.0)
        for steps in (1, 2, 8):
            found = model.propose(query(), kernel(WALL, POST), 4, sampling=Sampling("ddim", steps, 1.0, guidance))
            sizes.append(float(found.latent.abs().max()))
    assert max(sizes) <= 4.0
    control = some_paths().control(slice(0, 4))
    ends = Query(control[0, 0], control[0, -1], np.zeros(3), ObstacleSet.from_rows([]))
    sampling = Sampling("ddim", 4, 1.0, Guidance(1.0, "noise"))
    again = model.renoise(ends, kernel(WALL, POST), control, 100, sampling=sampling)
    assert np.isfinite(again.control).all() and float(again.latent.abs().max()) <= 4.0


def test_threads_propose_what_one_does() -> None:
    model = TorchModel(network(), {})

    def proposed(seed: int) -> np.ndarray:
        return model.propose(query(), kernel(WALL), 3, generator=np.random.default_rng(seed)).control

    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(proposed, range(12)))
    for seed, control in enumerate(found):
        np.testing.assert_array_equal(control, proposed(seed))


def test_a_latent_space_that_the_unet_cannot_halve_is_named() -> None:
    with pytest.raises(ParameterError, match="length of the latent space: expected 4 times a whole number, got 10"):
        UNetDenoiser(4, 12, 8, (1, 2, 4))(torch.zeros(1, 4, 10), torch.zeros(1), torch.zeros(1, 12))


@pytest.mark.parametrize("scaling", ["noise", "clean"])
@pytest.mark.parametrize("name", SAMPLERS)
def test_guidance_lowers_the_collision_cost_on_average(name: str, scaling: str) -> None:
    model, among = TorchModel(network(), {}), kernel(WALL, POST)
    costs = []
    for gamma in (0.0, 3.0):
        guidance, total = Guidance(gamma, scaling, clip=1.0, active_below=0.6), 0.0
        for seed in range(3):
            found = model.propose(
                query(seed), among, 8, sampling=Sampling(name, 8, 1.0, guidance),
                generator=np.random.default_rng(seed),
            )  # fmt: skip
            total += collision_cost(among, model.spline.path(found.control)[:, ::4], 0.03)[0].mean()
        costs.append(total)
    assert costs[1] < 0.9 * costs[0]


def test_faulty_guidance_is_refused() -> None:
    for name, value in (("gamma", -1.0), ("clip", np.nan), ("margin", 0.0), ("samples", 1)):
        with pytest.raises(ParameterError, match=name):
            Guidance(**{name: value})
    with pytest.raises(UnknownNameError, match="scaling of guidance 'none', did you mean 'noise'"):
        Guidance(scaling="none")
    with pytest.raises(UnknownNameError, match="sampler 'ddmp', did you mean 'ddpm'"):
        Sampling("ddmp")
    with pytest.raises(ParameterError, match="temperature"):
        Sampling(temperature=-1.0)
