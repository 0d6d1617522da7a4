"""A trained model evaluated by NumPy and the kernel: ready without torch, whose import takes longer than most plans.

It evaluates models of a linear latent space and an MLP denoiser. Names of weights are those of the torch module
:class:`apex_ompl.training.latent_diffusion.LatentDiffusion`, where the layers are explained.

Large matrices of weights are int8 with a scale for each row: symmetric linear quantization (Jacob et al., CVPR 2018,
with a zero point of 0). Reading weights from memory takes most of the time of a few proposals. NumPy's models compute
with the bytes (:func:`apex_ompl.kernel.products.dense_layer`), torch's with the expanded matrices.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apex_ompl.kernel import Kernel
from apex_ompl.kernel.products import dense_layer, product
from apex_ompl.model.config import OBSTACLE_SCENES, ModelConfig, key_shapes
from apex_ompl.model.geometry import SHAPES, signed_distances
from apex_ompl.model.guidance import Guidance, collision_cost
from apex_ompl.model.proposals import TrajectoryModel
from apex_ompl.model.query import MAX_DISTANCE, ObstacleSet, Probes, Query
from apex_ompl.paths.spline import Spline
from apex_ompl.types import Array
from apex_ompl.util.validation import check_integer

SUFFIX = ".scale"
LEAST = 2**12  # size from which a matrix is quantized
MOST = 127
Single = NDArray[np.float32]
STEP_SIZE = 128  # of the embedding of a step
EPSILON = 1e-5  # of the layer normalization, as in torch


def quantized(weights: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return weights whose large matrices of layers are int8, with scales of their rows as ``NAME.scale``.

    Weights that are int8 already stay as they are.
    """
    found = {}
    for name, values in weights.items():
        if (
            not name.endswith("weight")
            or values.ndim != 2
            or values.size < LEAST
            or not np.issubdtype(values.dtype, np.floating)
        ):
            found[name] = values
            continue
        wide = values.astype(np.float32)
        scale = np.maximum(np.abs(wide).max(axis=1), np.finfo(np.float32).tiny) / MOST
        found[name] = np.round(wide / scale[:, None]).astype(np.int8)
        found[name + SUFFIX] = scale
    return found


def is_scale(name: str, weights: Mapping[str, NDArray[Any]]) -> bool:
    """Whether a name is that of the scales of a matrix in eight bits."""
    matrix = weights.get(name.removesuffix(SUFFIX)) if name.endswith(SUFFIX) else None
    return matrix is not None and matrix.dtype == np.int8


def check_scales(weights: Mapping[str, NDArray[Any]]) -> None:
    """Check that there is a scale for each row of the matrices in eight bits.

    Raises:
        ValueError: Scales are missing, or are not one for each row.
    """
    for name, values in weights.items():
        scale = weights.get(name + SUFFIX)
        if values.dtype == np.int8 and (scale is None or scale.shape != values.shape[:1]):
            raise ValueError(f"{name}: expected a scale for each row of a matrix in eight bits")


def expanded(weights: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return weights with the matrices that are int8 as float32, without their scales.

    Raises:
        ValueError: Scales are missing, or are not one for each row.
    """
    check_scales(weights)
    found = {name: values for name, values in weights.items() if not is_scale(name, weights)}
    for name, values in found.items():
        if values.dtype == np.int8:
            found[name] = values.astype(np.float32) * weights[name + SUFFIX].astype(np.float32)[:, None]
    return found


def is_supported(config: ModelConfig) -> bool:
    """Whether NumPy can evaluate models of a configuration."""
    return config.latent.kind == "linear" and config.denoiser.kind in ("mlp", "regression")


class ArrayModel(TrajectoryModel):
    """Trained model whose networks NumPy evaluates, in single precision as torch does.

    Attributes:
        weights: Weights by their names in the checkpoint: matrices in eight bits with ``NAME.scale``, others in single
            precision.
    """

    def __init__(self, config: ModelConfig, weights: Mapping[str, NDArray[Any]], about: Mapping[str, Any]) -> None:
        """Use weights that fit a configuration, see :func:`is_supported`, in any precision."""
        joint, offset = weights["probe_joint"], np.asarray(weights["probe_offset"], float)
        probes = Probes(np.asarray(joint, np.int64), offset, config.condition.along)
        super().__init__(config, about, probes, {name: weights[name] for name in key_shapes(config)})
        self.weights: dict[str, NDArray[Any]] = {
            k: np.ascontiguousarray(v, np.int8 if v.dtype == np.int8 else np.float32)
            for k, v in quantized(weights).items()
        }
        half = STEP_SIZE // 2
        self._frequencies = np.exp(np.float32(-math.log(10_000.0)) * np.arange(half, dtype=np.float32) / half)
        self._mean = self.weights["autoencoder.mean"]
        self._decoder = np.ascontiguousarray(
            (self.weights["autoencoder.components"] * self.weights["autoencoder.deviations"]).T
        )
        self._basis = self.spline.basis(self.spline.parameters)
        self._shares = self.spline.line(np.zeros(1), np.ones(1))

    def one_thread(self) -> AbstractContextManager[None]:
        """Limit its networks to one thread inside a block; NumPy models always use one."""
        return nullcontext()

    def zeros(self, count: int) -> Single:
        """Return ``count`` latent vectors of zeros."""
        return np.zeros((count, self.config.latent.dim), np.float32)

    def encode(self, control: Array) -> Single:
        """Return the latent vectors of control points, shape (B, points, dof) [rad]."""
        line = self._lines(control[:, 0], control[:, -1])
        residual = (control - line)[:, self.spline.inner].reshape(len(control), -1).astype(np.float32)
        found = product(residual - self._mean, self.weights["autoencoder.components"])
        return np.asarray(found / self.weights["autoencoder.deviations"], np.float32)

    def condition(self, queries: Sequence[Query], kernel: Kernel) -> Single:
        """Return the encoded conditions of Q queries, shape (Q, out)."""
        lower, upper = self.weights["encoder.lower"], self.weights["encoder.upper"]
        ends = np.array([[q.start, q.goal] for q in queries], np.float32)
        scaled = np.asarray(2.0 * (ends - lower) / (upper - lower) - 1.0, np.float32)
        parts: list[Single] = [scaled.reshape(len(queries), -1)]
        if self.config.condition.point:
            parts.append(self._centered(np.array([q.point for q in queries], np.float32)))
        if self.scene_encoding is not None:
            parts.append(self.scene_encoding.features(queries, kernel))
        if self.config.condition.scene in OBSTACLE_SCENES:
            start, goal = (np.array([getattr(q, name) for q in queries], float) for name in ("start", "goal"))
            probes = self.probes.positions(kernel, start, goal)
            features = [self._obstacle_features(q.obstacles, points) for q, points in zip(queries, probes, strict=True)]
            parts.append(np.array(features, np.float32))
        return self._layers("encoder.phi", 3 if self.scene_encoding is not None else 2, np.concatenate(parts, axis=1))

    def refine(self, condition: Single, along: Single) -> Single:
        """Return encoded conditions refined by features along estimated paths, shape (B, F)."""
        return condition + self._layers("encoder.psi", 3, along)

    def denoise(self, latent: Single, t: int, condition: Single) -> Single:
        """Return the denoiser's output for latent vectors at a step, each with its condition, or one for all."""
        angles = np.float32(t) * self._frequencies
        step = self._linear("denoiser.step.1", np.concatenate([np.sin(angles), np.cos(angles)])[None])
        embedding = _silu(step + condition)
        x = self._linear("denoiser.enter", latent)
        for k in range(self.config.denoiser.blocks):
            block = f"denoiser.blocks.{k}"
            scale, shift = np.split(self._linear(f"{block}.modulation", embedding), 2, axis=-1)
            y = _normalized(x) * (1.0 + scale) + shift
            x = x + self._linear(f"{block}.second", _silu(self._linear(f"{block}.first", y)))
        return self._linear("denoiser.leave", _normalized(x))

    def score(self, latent: Single, kernel: Kernel, ends: tuple[Array, Array], guidance: Guidance) -> Single:
        """Return the gradient of log p(g | z) at latent vectors z, see :meth:`TrajectoryModel.score`."""
        basis = self._basis[guidance.states(self.spline.states)]
        _, slopes = collision_cost(kernel, product(basis, self.control(latent, ends)), guidance.margin)
        inner = product(basis[:, self.spline.inner].T, slopes).reshape(len(latent), -1)
        return -product(inner, self._decoder.T).astype(np.float32)

    def control(self, latent: Single, ends: tuple[Array, Array]) -> Array:
        """Return control points, shape (B, points, dof) [rad], of latent vectors between starts and goals."""
        control = self._lines(*ends)
        free = (self._mean + product(latent, self._decoder)).reshape(len(latent), self.spline.free, -1)
        control[:, self.spline.inner] += free
        return control

    def _lines(self, start: Array, goal: Array) -> Array:
        """Return the control points of straight lines between ends of shape (B, dof)."""
        return np.asarray(start)[:, None] + self._shares * (np.asarray(goal) - start)[:, None]

    def _centered(self, points: Single) -> Single:
        """Return points relative to the middle of the workspace, shape (..., 3)."""
        condition = self.config.condition
        return np.asarray((points - np.array(condition.center, np.float32)) / np.float32(condition.reach), np.float32)

    def _obstacle_features(self, obstacles: ObstacleSet, probes: Single) -> Single:
        """Return the obstacle features of a query, shape (features,), for probe points of shape (L, P, 3) [m]."""
        along, count = probes.shape[:2]
        position, size = (np.asarray(v, np.float32) for v in (obstacles.position, obstacles.size))
        rotation = np.asarray(obstacles.rotation, np.float32)
        kinds = np.eye(len(SHAPES), dtype=np.float32)[obstacles.shape]
        inputs, parts = [kinds, self._centered(position), rotation.reshape(-1, 9), size], []
        if self.config.condition.scene == "distances":
            points = np.broadcast_to(probes.reshape(1, -1, 3), (len(obstacles), along * count, 3))
            distances = signed_distances(obstacles.shape, position, rotation, size, points)
            distances = np.clip(distances, -MAX_DISTANCE, MAX_DISTANCE) / np.float32(MAX_DISTANCE)
            parts += [self._centered(probes).ravel(), distances.min(axis=0, initial=1.0)]
            few = distances.reshape(-1, along, count)[:, [0, along // 2, -1]]
            inputs.append(few.reshape(-1, 3 * count))
        tokens = np.concatenate(inputs, axis=1)
        tokens = _silu(self._linear("encoder.thing.0", tokens))
        tokens = self._linear("encoder.thing.4", _silu(self._linear("encoder.thing.2", tokens)))
        parts += [tokens.sum(axis=0) / np.float32(max(1, len(obstacles))), tokens.max(axis=0, initial=0.0)]
        return np.concatenate(parts)

    def _layers(self, name: str, count: int, values: Single) -> Single:
        """Return the output of an MLP of ``count`` layers."""
        for k in range(count):
            values = self._linear(f"{name}.{2 * k}", _silu(values) if k else values)
        return values

    def _linear(self, name: str, values: Single) -> Single:
        weight, bias = self.weights[f"{name}.weight"], self.weights[f"{name}.bias"]
        if weight.dtype != np.int8:
            return np.asarray(product(values, weight.T) + bias, np.float32)
        scale = self.weights[f"{name}.weight{SUFFIX}"]
        return dense_layer(weight, scale, bias, np.ascontiguousarray(values, np.float32))


def weight_shapes(config: ModelConfig) -> dict[str, tuple[int, ...]]:
    """Return the shapes of a model's weights by their names.

    Raises:
        ParameterError: There is no such model.
    """
    dof, condition, denoiser = len(config.joints), config.condition, config.denoiser
    spline = Spline(**config.spline.model_dump())
    dim, free = config.latent.dim, spline.free * dof
    check_integer(dim, "dimension of the latent space", 1, free)
    shapes: dict[str, tuple[int, ...]] = {
        "probe_joint": (config.probes,), "probe_offset": (config.probes, 3), "autoencoder.mean": (free,),
        "autoencoder.components": (free, dim), "autoencoder.deviations": (dim,),
        "encoder.lower": (dof,), "encoder.upper": (dof,), **key_shapes(config),
    }  # fmt: skip
    layers: list[tuple[str, int, int]] = []
    size = 2 * dof + 3 * condition.point
    if condition.scene in OBSTACLE_SCENES:
        features = len(SHAPES) + 15 + (3 * config.probes if condition.scene == "distances" else 0)
        layers += [("encoder.thing.0", features, condition.width)]
        layers += [(f"encoder.thing.{k}", condition.width, condition.width) for k in (2, 4)]
        size += 2 * condition.width
    if condition.scene == "distances":
        size += 4 * condition.along * config.probes
    hidden = 2 * condition.width
    layers.append(("encoder.phi.0", size + config.scene_features, hidden))
    if condition.scene == "clearances":
        layers += [("encoder.phi.2", hidden, hidden), ("encoder.phi.4", hidden, condition.out)]
    else:
        layers.append(("encoder.phi.2", hidden, condition.out))
    if condition.refined:
        layers += [("encoder.psi.0", config.along_size, hidden), ("encoder.psi.2", hidden, hidden)]
        layers.append(("encoder.psi.4", hidden, condition.out))
    width = denoiser.width
    layers += [("denoiser.step.1", STEP_SIZE, condition.out), ("denoiser.enter", dim, width)]
    layers += [("denoiser.leave", width, dim)]
    for k in range(denoiser.blocks):
        block = f"denoiser.blocks.{k}"
        layers += [(f"{block}.modulation", condition.out, 2 * width)]
        layers += [(f"{block}.{name}", width, width) for name in ("first", "second")]
    for name, before, after in layers:
        shapes |= {f"{name}.weight": (after, before), f"{name}.bias": (after,)}
    return shapes


def _silu(values: Single) -> Single:
    """Return x / (1 + exp(-x))."""
    with np.errstate(over="ignore"):  # x / inf is the limit, 0
        return np.asarray(values / (np.float32(1.0) + np.exp(-values)))


def _normalized(values: Single) -> Single:
    """Return rows shifted and scaled to mean 0 and variance 1."""
    centered = values - values.mean(axis=-1, keepdims=True)
    variance = np.square(centered).mean(axis=-1, keepdims=True)
    found: Single = centered / np.sqrt(variance + np.float32(EPSILON))
    return found
