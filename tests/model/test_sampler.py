"""Noise and samplers, against other implementations and closed forms."""

from __future__ import annotations

from functools import partial
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from apex_ompl.errors import ParameterError, UnknownNameError
from apex_ompl.model.diffusion import PREDICTIONS, SAMPLERS, SCHEDULES, Estimate, NoiseSchedule, ddim, ddpm, dpm_solver
from apex_ompl.training.latent_diffusion import TrainingSchedule

# Noise


@pytest.mark.parametrize("kind", SCHEDULES)
@pytest.mark.parametrize("steps", [64, 256, 1000])
def test_noise_grows_from_almost_none_to_almost_all(kind: str, steps: int) -> None:
    left = NoiseSchedule(steps, kind).alpha_bar
    assert all(a > b for a, b in pairwise(left.tolist()))
    assert left[0] > 0.97 and left[-1] < 1e-3


@given(st.sampled_from(PREDICTIONS), st.sampled_from(SCHEDULES), st.integers(1, 254), st.integers(0, 2**31))
def test_what_a_perfect_network_says_gives_sample_and_noise_back(kind: str, name: str, t: int, seed: int) -> None:
    schedule, g = TrainingSchedule(256, name), torch.Generator().manual_seed(seed)
    clean, noise = (torch.randn(3, 5, generator=g, dtype=torch.float64) for _ in range(2))
    sample = schedule.add_noise(clean, noise, t)
    found = schedule.estimate(kind, sample, schedule.target(kind, clean, noise, torch.full((3,), t)), t)
    torch.testing.assert_close(found.clean, clean, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(found.noise, noise, atol=1e-4, rtol=1e-4)


@given(st.integers(0, 255), st.data())
def test_steps_fall_from_the_first(first: int, data: st.DataObject) -> None:
    count = data.draw(st.integers(1, first + 1))
    times = NoiseSchedule(256).timesteps(count, first)
    assert len(times) == count and times[0] == first and times[-1] >= 0
    assert all(a > b for a, b in pairwise(times))
    if count == first + 1:
        assert times == list(range(first, -1, -1))


def test_bad_schedules_are_named() -> None:
    with pytest.raises(UnknownNameError, match="noise schedule 'cosin', did you mean 'cosine'"):
        NoiseSchedule(256, "cosin")
    with pytest.raises(
        ParameterError, match="number of denoising steps: expected a whole number from 1 to 256, got 257"
    ):
        NoiseSchedule(256).timesteps(257)
    with pytest.raises(ParameterError, match="times"):
        ddim(lambda z, t: Estimate(z, z), torch.zeros(1, 2), NoiseSchedule(8), [1, 3])


# Samplers, against the schedulers of diffusers


def blurred(schedule: NoiseSchedule) -> partial[Estimate]:
    """A denoiser that is not linear, and the same for both implementations."""

    def predict(sample: torch.Tensor, t: int) -> Estimate:
        noise = torch.tanh(sample * (0.5 + t / 512)) + 0.1 * torch.sin(3.0 * sample)
        return schedule.estimate("noise", sample, noise, t)

    return partial(predict)


@pytest.mark.parametrize("kind", SCHEDULES)
@pytest.mark.parametrize(
    ("name", "steps"), [*[("ddim", n) for n in (1, 2, 8, 32)], *[("dpm_solver", n) for n in (1, 2, 5, 8, 40)]]
)
def test_deterministic_samplers_are_those_of_diffusers(name: str, steps: int, kind: str) -> None:
    """Where DDIM's steps do not divide 256, diffusers takes other ones than those it lists."""
    diffusers = pytest.importorskip("diffusers")
    schedule = NoiseSchedule(256, kind)
    betas = schedule.betas.astype(np.float32)
    rest = {"num_train_timesteps": 256, "trained_betas": betas, "timestep_spacing": "trailing"}
    if name == "ddim":
        theirs = diffusers.DDIMScheduler(**rest, clip_sample=False, set_alpha_to_one=True)
    else:
        theirs = diffusers.DPMSolverMultistepScheduler(
            **rest, algorithm_type="dpmsolver++", solver_order=2, final_sigmas_type="zero", lower_order_final=True
        )
    theirs.set_timesteps(steps)
    predict = blurred(schedule)
    start = torch.randn(4, 7, generator=torch.Generator().manual_seed(steps))
    times = schedule.timesteps(steps)
    assert times == theirs.timesteps.tolist()
    mine = SAMPLERS[name](predict, start, schedule, times)
    sample = start
    for t in theirs.timesteps:
        sample = theirs.step(predict(sample, int(t)).noise, t, sample).prev_sample
    torch.testing.assert_close(mine, sample, atol=2e-3 * float(sample.abs().max()), rtol=2e-3)


@pytest.mark.parametrize("kind", SCHEDULES)
def test_ancestral_sampling_is_that_of_diffusers(kind: str) -> None:
    diffusers = pytest.importorskip("diffusers")
    schedule = NoiseSchedule(64, kind)
    theirs = diffusers.DDPMScheduler(64, trained_betas=schedule.betas.astype(np.float32), clip_sample=False)
    theirs.set_timesteps(64)
    predict = blurred(schedule)
    start = torch.randn(4, 7, generator=torch.Generator().manual_seed(1))
    mine = ddpm(predict, start, schedule, schedule.timesteps(64), generator=np.random.default_rng(2))
    sample, g = start, np.random.default_rng(2)
    for t in theirs.timesteps:
        noise = torch.from_numpy(g.standard_normal(tuple(start.shape), np.float32)) if t else torch.zeros_like(start)
        step = theirs.step(predict(sample, int(t)).noise, t, sample, generator=torch.Generator().manual_seed(int(t)))
        drawn = torch.randn(start.shape, generator=torch.Generator().manual_seed(int(t)))
        deviation = theirs._get_variance(int(t)) ** 0.5  # noqa: SLF001 - its noise cannot be given
        sample = step.prev_sample + deviation * (noise - drawn) if t else step.prev_sample
    torch.testing.assert_close(mine, sample, atol=2e-3 * float(sample.abs().max()), rtol=2e-3)


@pytest.mark.parametrize("name", SAMPLERS)
def test_samplers_find_the_only_point_there_is(name: str) -> None:
    """Where all data are one point, the perfect denoiser is known, and every sampler ends there."""
    schedule, point = NoiseSchedule(256), torch.tensor([0.3, -1.2, 2.0])

    def predict(sample: torch.Tensor, t: int) -> Estimate:
        signal, sigma = schedule.scale(t)
        return Estimate((sample - signal * point) / sigma, point.expand_as(sample))

    g = np.random.default_rng(0)
    seen: list[int] = []
    found = SAMPLERS[name](
        predict, torch.from_numpy(g.standard_normal((5, 3), np.float32)), schedule, schedule.timesteps(6),
        callback=lambda t, z, e: seen.append(t),
        **({"generator": g} if name == "ddpm" else {}),
    )  # fmt: skip
    torch.testing.assert_close(found, point.expand(5, 3))
    assert seen == schedule.timesteps(6)


def test_samples_of_a_normal_distribution_are_normal() -> None:
    """Of data from N(m, s^2) the perfect denoiser is linear; samples must have that mean and spread."""
    schedule, mean, spread = NoiseSchedule(256), 1.5, 0.4

    def predict(sample: torch.Tensor, t: int) -> Estimate:
        signal, sigma = schedule.scale(t)
        clean = mean + signal * spread**2 / (signal**2 * spread**2 + sigma**2) * (sample - signal * mean)
        return Estimate((sample - signal * clean) / sigma, clean)

    g = np.random.default_rng(0)
    first = torch.from_numpy(g.standard_normal((20_000, 1)))
    for found in (
        ddpm(predict, first, schedule, schedule.timesteps(256), generator=g),
        ddim(predict, first, schedule, schedule.timesteps(128)),
        dpm_solver(predict, first, schedule, schedule.timesteps(32)),
    ):
        assert float(found.mean()) == pytest.approx(mean, abs=0.02)
        assert float(found.std()) == pytest.approx(spread, abs=0.02)


def test_two_orders_are_better_than_one() -> None:
    """The second-order solver is nearer to many steps of DDIM than as few steps of DDIM itself."""
    schedule = NoiseSchedule(256)

    def predict(sample: torch.Tensor, t: int) -> Estimate:
        clean = torch.tanh(2.0 * sample * schedule.scale(t)[0])
        return schedule.estimate("clean", sample, clean, t)

    first = torch.randn(50, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    wanted = ddim(predict, first, schedule, schedule.timesteps(256))
    one = ddim(predict, first, schedule, schedule.timesteps(32))
    two = dpm_solver(predict, first, schedule, schedule.timesteps(32))
    assert (two - wanted).norm() < 0.8 * (one - wanted).norm()
