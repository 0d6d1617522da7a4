"""Obstacle guidance: denoising along the gradient of the decoded path's collision cost (section III-C of the paper).

By Bayes, grad log p(z | g) = grad log p(z) + gamma grad log p(g | z) (equation 6), where log p(g | z) is minus the
collision cost of the decoded path.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apex_ompl.kernel import Kernel
from apex_ompl.model.diffusion import Estimate, NoiseSchedule, Predict
from apex_ompl.model.geometry import Numbers, array_module
from apex_ompl.types import Array
from apex_ompl.util.validation import check_integer, check_name, check_number, check_positive

SCALINGS = ("noise", "clean")


@dataclass(frozen=True)
class Guidance:
    """Parameters of obstacle guidance.

    Attributes:
        gamma: Guidance scale; 0 gives the unguided model, bit for bit.
        scaling: ``noise`` subtracts gamma sqrt(1 - abar_t) times the gradient from the noise (equation 7); ``clean``
            adds gamma times the gradient to the clean sample at every noise level.
        clip: Largest norm of the gradient, in standard deviations of the latent space.
        active_below: Guidance acts at steps t < active_below * T; 1 means all. Two deterministic steps over T = 256
            are t = 255 and 127, of which the default guides the second.
        margin: Clearance below which a state has a cost [m].
        samples: Number of states of a path at which the cost is taken.
    """

    gamma: float = 1.0
    scaling: str = "clean"
    clip: float = 1.0
    active_below: float = 0.6
    margin: float = 0.03
    samples: int = 64

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ParameterError: A number is out of range.
            UnknownNameError: There is no such scaling.
        """
        check_name(self.scaling, "scaling of guidance", SCALINGS)
        for name, value in (("gamma", self.gamma), ("clip", self.clip), ("active_below", self.active_below)):
            check_number(value, name, 0.0)
        check_positive(self.margin, "margin")
        check_integer(self.samples, "samples", 2)

    def states(self, count: int) -> NDArray[np.int64]:
        """Return the indices of the states of a path, of ``count`` states, at which the cost is taken."""
        return np.linspace(0, count - 1, self.samples).round().astype(np.int64)


EQUATION_7 = Guidance(gamma=64.0, scaling="noise", active_below=0.5)
"""Guidance of the paper, for the model apex-paper. The paper gives no gamma. With this one most proposals for
validation problems are valid; without guidance hardly any is (benchmarks/model/guidance.py)."""
GUIDANCES = {"clean": Guidance(), "noise": EQUATION_7}
"""Parameters by scaling."""


def collision_cost(kernel: Kernel, paths: Array, margin: float) -> tuple[Array, Array]:
    """Return the collision cost of paths, shape (B,), and its gradient, shape (B, N, dof) [1/rad].

    cost = 1 / (2 N) sum_i sum_k max(0, 1 - d_k(q_i) / margin)^2

    d_0 is the smallest distance of the robot to the obstacles, d_1 that between its own links. The cost is
    -log p(g | x) of equation 6 of the paper, up to a constant.

    Args:
        kernel: The robot among its obstacles.
        paths: Shape (B, N, dof) [rad].
        margin: Clearance below which a state has a cost [m].
    """
    count, states, dof = paths.shape
    lower, upper = kernel.robot.arrays.lower, kernel.robot.arrays.upper
    inside = np.clip(paths.reshape(-1, dof), lower, upper)
    clearance, jacobian = kernel.clearance_gradient(inside, margin)
    violation = np.where(np.isfinite(clearance), np.maximum(margin - clearance, 0.0), 0.0) / margin
    cost = 0.5 * (violation**2).sum(axis=1).reshape(count, states).mean(axis=1)
    rows = -(violation[:, :, None] * np.nan_to_num(jacobian)).sum(axis=1) / margin
    return cost, rows.reshape(count, states, dof) / states


def guided(
    predict: Predict, score: Callable[[Numbers], Numbers], schedule: NoiseSchedule, guidance: Guidance,
    most: float | None = None,
) -> Predict:  # fmt: skip
    """Return a guided denoiser.

    With ``scaling="noise"``, equation 7 of the paper, with abar_t under the root as in Dhariwal and Nichol (2021):

    epsilon_guided = epsilon - gamma sqrt(1 - abar_t) grad_{z_t} log p(g | z_0(z_t))

    The gradient is taken at the estimated clean sample z_0. It goes through decoder and kernel but not through the
    denoiser: of d z_0 / d z_t only the factor 1 / sqrt(abar_t) is kept. With ``scaling="clean"``,

    z_0_guided = z_0 + gamma grad_{z_0} log p(g | z_0)

    Both clip the gradient's norm at ``guidance.clip``, and recompute the other half of the estimate.

    Args:
        predict: The unguided denoiser.
        score: Returns grad log p(g | z_0) at clean samples, of their shape.
        schedule: The noise schedule.
        guidance: Scale of the guidance, and steps at which it acts.
        most: Limit at which clean samples are clipped, as those of the unguided denoiser; None for no clipping.
    """
    if guidance.gamma == 0.0:
        return predict

    def predict_guided(sample: Numbers, t: int) -> Estimate:
        estimate = predict(sample, t)
        if t >= guidance.active_below * schedule.steps:
            return estimate
        signal, sigma = schedule.scale(t)
        direction = score(estimate.clean)
        if guidance.scaling == "noise":
            noise = estimate.noise - guidance.gamma * sigma * clip_norm(direction / signal, guidance.clip)
            clean = (sample - sigma * noise) / signal
        else:
            clean = estimate.clean + guidance.gamma * clip_norm(direction, guidance.clip)
            noise = (sample - signal * clean) / sigma
        return schedule.clipped(Estimate(noise, clean), sample, t, most)

    return predict_guided


def clip_norm(gradients: Numbers, most: float) -> Numbers:
    """Return gradients (B, ...) scaled down to norm ``most`` where they exceed it."""
    rows = gradients.reshape(len(gradients), -1)
    norm = array_module(rows).sqrt((rows * rows).sum(1)).clip(min=1e-12)
    share = (most / norm).clip(max=1.0)
    return gradients * share.reshape(-1, *[1] * (gradients.ndim - 1))
