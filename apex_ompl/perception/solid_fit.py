"""Fit of boxes and cylinders of unknown pose and size to the pixels of an obstacle.

The fit of surfaces (:mod:`apex_ompl.kernel.perception`) finds pose and size from several starts
(:mod:`apex_ompl.perception.solid_starts`). Hypotheses that differ in the length that is seen least, and
that of a cube, are a mixture: its mean and covariance are the answer (Laplace's approximation of their evidence,
MacKay 2003, chapter 27).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import permutations
from typing import NamedTuple, get_args

import numpy as np
import pinocchio as pin

from apex_ompl.errors import ParameterError
from apex_ompl.kernel.perception import AXIS, SurfaceFit, fit_surface
from apex_ompl.perception.obstacle_settings import ObstacleSettings
from apex_ompl.perception.registration import CorrectedFrame
from apex_ompl.perception.solid_pixels import FINE_STEPS, Level, Patch
from apex_ompl.perception.solid_starts import Kind, Solid, resized, starts
from apex_ompl.perception.surfaces import Surface, body_surface
from apex_ompl.scene.bodies import Body
from apex_ompl.types import Array
from apex_ompl.util.validation import check_array, check_positive, finite_array

FIRST_STEPS, COARSE_STEPS, PROFILE_STEPS = 2, 4, 2
HOPELESS = 2.2  # cost over the least, after the first steps, from which a start is given up
DOUBTED = 1.0  # misfit above which the other kind is tried, too
RIVALS, RIVAL = 2, 1.3  # fits that are refined at most, and their largest cost over the least
GROWN = 1.06  # ratio of lengths of a last start to those of the best fit, which may be too short
FRONT = 0.6  # share of the side that is seen most above which its depth has a mixture
SAME_PLACE, SAME_SIZE = 0.004, 0.05  # differences of fits that are the same [m], of logarithms of lengths
STEP = 0.22  # of the logarithm of a length from one of the mixture to the next
UNLIKELY, MOST_LENGTHS = 14.0, 8  # cost above the least where lengths of the mixture end, and their number
SHARP = 0.09  # standard deviation of the logarithm of a length below which it has no mixture
VAGUE = 0.04  # standard deviation of the logarithm of a length above which it has a mixture of its own
KNOWN = 1e8  # information of what is no unknown
HELD = 1e6  # of the logarithm of a length that is held
UNEXPLAINED = 0.4  # standard deviation of ends of what one solid does not explain, over its largest length
EXPLAINED, SUDDEN = 0.8, 0.5  # shares of the largest misfit: where that spread comes, and over which it grows
PLACE, TURN, SIZE = 0.1, 0.4, 0.6  # standard deviations before the fit: [m], [rad], of logarithms of sizes
LONGER = 1.3  # ratio of lengths that tells whether one is
NEGLIGIBLE = 9.0  # logarithm of odds beyond which a hypothesis does not count
NOT_SQUARE = 0.06  # logarithm of the ratio of sides from which on a box is no cube, beside the errors
SLICES = 32
TIES = {"box": np.array([0, 1, 2]), "cylinder": np.array([0, 0, 2])}  # unknown of the length along each axis
ORDERS = tuple(permutations(range(3)))  # of known lengths along the axes of a box


@dataclass(frozen=True, eq=False)
class KnownSize:
    """The size of an obstacle that is known before it is seen.

    Attributes:
        kind: ``box`` or ``cylinder`` along z.
        size: Lengths along its axes, of a cylinder diameter, diameter and length, shape (3,) [m].
        spread: Standard deviation of each length [m].
    """

    kind: Kind
    size: Array
    spread: float = 0.001

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ParameterError: The kind is another, or lengths are not positive.
        """
        if self.kind not in get_args(Kind):
            raise ParameterError("kind", self.kind, f"one of {', '.join(get_args(Kind))}")
        size = finite_array(self.size, "size")
        check_array(size, (3,), "size")
        if not (size > 0.0).all():
            raise ParameterError("size", size.tolist(), "three positive lengths")
        object.__setattr__(self, "size", size)
        check_positive(self.spread, "spread")


class Estimate(NamedTuple):
    """A solid that was fitted, in the optical frame.

    Attributes:
        solid: The solid.
        covariance: Of turn, shift and logarithms of lengths, shape (9, 9).
        misfit: Mean squared error of points over that of noise.
    """

    solid: Solid
    covariance: Array
    misfit: float = 1.0


class _Found(NamedTuple):
    """A fit from a start."""

    start: Solid
    fit: SurfaceFit
    prior: Array
    unknowns: list[int]  # of turn, shift and each length

    @property
    def solid(self) -> Solid:
        """The solid that was found."""
        return Solid(self.start.kind, self.start.size * self.fit.scale, self.fit.pose)

    @property
    def evidence(self) -> float:
        """Logarithm of the evidence by Laplace's approximation."""
        spread = np.linalg.slogdet(self.fit.information)[1] - np.linalg.slogdet(self.prior)[1]
        return -(self.fit.cost + float(spread)) / 2.0


def fitted(
    patch: Patch, seen: CorrectedFrame, settings: ObstacleSettings, known: Sequence[KnownSize] = ()
) -> Estimate | None:
    """Return the solid of a patch; None where no fit found any.

    Args:
        patch: Its pixels.
        seen: The frame.
        settings: How much measurements say.
        known: Sizes that it may have, or others.
    """
    best = _searched(patch)
    if best is None:
        return None
    factor = settings.inflation / settings.tempering
    sized = _of_known_size(best, patch, known)
    if sized is not None:
        return _honest(_estimate(sized, factor, seen), _misfit(sized, patch), settings)
    parts = _hypotheses(best, factor, patch, seen, settings)
    if best.start.kind == "box" and settings.cubes > 0.0 and _square(parts[0][1]):
        cube = _cube(best, patch)
        if cube.fit.cost < best.fit.cost:  # cubes are boxes: the search ended in another minimum
            best = min(best, _run(cube.solid, patch.fine, FINE_STEPS), key=_cost)
            parts, cube = _hypotheses(best, factor, patch, seen, settings), _cube(best, patch)
        parts = [(one + float(np.log(1.0 - settings.cubes)), solid) for one, solid in parts]
        parts.append((cube.evidence + float(np.log(settings.cubes)), _estimate(cube, factor, seen)))
    return _honest(mixture(parts), _misfit(best, patch), settings)


def _misfit(found: _Found, patch: Patch) -> float:
    """Return the mean squared error of points over that of noise."""
    return float(found.fit.cost / (patch.fine.settings.point_share * patch.fine.measured))


def _honest(one: Estimate, misfit: float, settings: ObstacleSettings) -> Estimate:
    """Return an estimate with the errors that do not average out, and those of a solid that does not explain points.

    Errors of both ends of an axis are independent: the center has half the variance of an end, the length twice that.
    """
    share = min(1.0, max(0.0, misfit / settings.most_misfit - EXPLAINED) / SUDDEN)
    unexplained = UNEXPLAINED * float(one.solid.size.max()) * share
    variance = settings.systematic**2 + unexplained**2
    more = np.diag(np.concatenate([np.zeros(3), np.full(3, variance / 2.0), 2.0 * variance / one.solid.size**2]))
    return Estimate(one.solid, one.covariance + more, misfit)


def _hypotheses(
    best: _Found, factor: float, patch: Patch, seen: CorrectedFrame, settings: ObstacleSettings
) -> list[tuple[float, Estimate]]:  # fmt: skip
    """Return estimates of different lengths along the axis that is known least, with logarithms of their evidence."""
    alone = _estimate(best, factor, seen)
    end = _hidden_end(best, patch) if patch.hidden else None
    axis, side = end if end is not None else (_vague_axis(alone), 0.0)
    if axis is None:
        return [(best.evidence, alone)]
    held, deviation = _profile(best, axis, side, patch, settings)
    if len(held) < 2 or deviation <= SHARP:
        more = factor * deviation**2 - alone.covariance[6 + axis, 6 + axis]
        return [(best.evidence, _spread(alone, axis, max(0.0, more)))]
    lengths = best.solid.size if end is not None else np.delete(best.solid.size, axis)
    odds = _odds(held, axis, float(np.log(lengths[axis] if end is not None else lengths).mean()))
    likely = [k for k, one in enumerate(odds) if one > max(odds) - NEGLIGIBLE]
    return [(odds[k], _spread(_estimate(held[k], factor, seen), axis, STEP**2 / 12.0, side)) for k in likely]


def _searched(patch: Patch) -> _Found | None:
    """Return the best fit from all starts; those of the other kind are tried again where it explains too little."""
    found = [_run(one, patch.coarse, FIRST_STEPS) for one in starts(patch.extent, patch.places, patch.normals)]
    least = min((one.fit.cost for one in found), default=np.inf)
    if not np.isfinite(least):
        return None
    best = _refined([one for one in found if one.fit.cost < HOPELESS * least], patch)
    if best is None or _misfit(best, patch) > DOUBTED:
        other = _refined([one for one in found if best is None or one.start.kind != best.start.kind], patch)
        best = min((one for one in (best, other) if one is not None), key=_cost, default=None)
    return None if best is None else min(best, _run(_grown(best.solid, GROWN), patch.fine, FINE_STEPS), key=_cost)


def _refined(found: Sequence[_Found], patch: Patch) -> _Found | None:
    """Return the best of fits after more steps, the likely ones at full resolution."""
    late = patch.coarse._replace(settings=replace(patch.coarse.settings, first=patch.coarse.settings.last))
    found = sorted((_run(one.solid, late, COARSE_STEPS) for one in found), key=_cost)
    rivals: list[_Found] = []
    for one in found:
        if not one.fit.cost <= RIVAL * found[0].fit.cost or len(rivals) == RIVALS:
            break
        if not any(_alike(one.solid, other.solid) for other in rivals):
            rivals.append(one)
    refined = [_run(one.solid, patch.fine, FINE_STEPS) for one in rivals if np.isfinite(one.fit.cost)]
    return min((one for one in refined if np.isfinite(one.fit.cost)), key=_cost, default=None)


def _cost(one: _Found) -> float:
    """Return the cost of a fit."""
    return one.fit.cost


def _grown(solid: Solid, ratio: float) -> Solid:
    """Return a solid whose lengths are larger by a ratio, and whose near ends stay."""
    for axis in range(3) if solid.kind == "box" else (0, 2):
        solid = resized(solid, axis, ratio * float(solid.size[axis]))
    return solid


def _alike(first: Solid, second: Solid) -> bool:
    """Return whether two solids are nearly the same."""
    apart = np.abs(first.pose[:3, 3] - second.pose[:3, 3]).max()
    larger = np.abs(np.log(np.sort(first.size) / np.sort(second.size))).max()
    return first.kind == second.kind and bool(apart < SAME_PLACE and larger < SAME_SIZE)


def _run(
    start: Solid, level: Level, steps: int, prior: Array | None = None, ties: tuple[int, int, int] | None = None
) -> _Found:
    """Return the fit from a start."""
    surface = _unit(start.kind)
    symmetry = 0 if start.kind == "box" else AXIS
    tied = TIES[start.kind] if ties is None else np.array(ties)
    before = _prior(start.kind) if prior is None else prior
    fit = fit_surface(
        level.points, level.beyond, level.lens, surface.vertices * start.size, surface.faces, tied, symmetry,
        start.pose, start.pose, before, level.settings, level.measured, steps,
    )  # fmt: skip
    return _Found(start, fit, before, [*range(6), *(6 + tied)])


@cache
def _prior(kind: Kind) -> Array:
    """Return the information before a fit, shape (9, 9), which is not to be changed."""
    prior = np.diag([TURN**-2] * 3 + [PLACE**-2] * 3 + [SIZE**-2] * 3)
    if kind == "cylinder":  # both diameters are one unknown
        prior[7, 7] = KNOWN
    return prior


@cache
def _unit(kind: Kind) -> Surface:
    """Return the surface of a solid whose lengths are 1 m."""
    shape: dict[str, object] = {"box": (1.0, 1.0, 1.0)}
    if kind == "cylinder":
        shape = {"cylinder": {"radius": 0.5, "length": 1.0}}
    return body_surface(Body.model_validate({"name": "obstacle", **shape}), SLICES)


def _estimate(found: _Found, factor: float, seen: CorrectedFrame) -> Estimate:
    """Return the solid that was found with its covariance; variances of measurements grow by a factor."""
    own = np.linalg.inv(found.prior + (found.fit.information - found.prior) / factor)
    lever = own @ found.fit.cross / factor
    covariance = own + lever @ seen.registration.covariance @ lever.T
    return Estimate(found.solid, covariance[np.ix_(found.unknowns, found.unknowns)])


def _vague_axis(one: Estimate) -> int | None:
    """Return the axis whose length is least known, or None where all are known.

    It is that of the side that is seen most, where this is most of what is seen.
    """
    solid, sight = one.solid, one.solid.pose[:3, 3]
    area = np.abs(solid.pose[:3, :3].T @ sight) * np.prod(solid.size) / solid.size
    if solid.kind == "cylinder":
        around = float(np.hypot(area[0], area[1]))
        return 2 if area[2] * np.pi / 4.0 > FRONT * (area[2] * np.pi / 4.0 + around) else None
    axis = int(np.argmax(area))
    spread = np.sqrt(np.diag(one.covariance)[6:])
    if area[axis] > FRONT * area.sum():
        return axis
    return int(np.argmax(spread)) if spread.max() > VAGUE else None


def _profile(
    best: _Found, axis: int, side: float, patch: Patch, settings: ObstacleSettings
) -> tuple[list[_Found], float]:
    """Return fits with lengths along an axis that are held, of which the end on a side moves.

    Lengths grow and, where the side is 0, fall from the best one by a ratio until their costs are too large. The second
    is the standard deviation of the logarithm of the length, by the costs of its neighbors.
    """
    first = best.solid.size[axis]
    found: list[_Found] = []
    least, rises = best.fit.cost, []
    for ratio in (np.exp(STEP), np.exp(-STEP)) if side == 0.0 else (np.exp(STEP),):
        solid, length = best.solid, first * ratio
        for k in range(MOST_LENGTHS):
            if not 0.5 * settings.smallest < length < settings.largest:
                break
            one = _held(resized(solid, axis, length, side), axis, patch.fine)
            if k == 0:
                rises.append(one.fit.cost - best.fit.cost)
            if not one.fit.cost < least + UNLIKELY:
                break
            found.append(one)
            solid, least, length = one.solid, min(least, one.fit.cost), length * ratio
    deviation = STEP / np.sqrt(max(min(rises, default=0.0), 1e-6))
    if deviation > SHARP:
        found.append(_held(best.solid, axis, patch.fine))
    return found, deviation


def _odds(found: Sequence[_Found], axis: int, middle: float) -> list[float]:
    """Return the logarithms of the evidence of fits with lengths that are held, with the density of these.

    Their logarithms are normal around ``middle``.
    """
    evidence = []
    for one in found:
        off = (np.log(one.solid.size[axis]) - middle) / SIZE
        evidence.append(one.evidence - off * off / 2.0 + float(np.log(STEP / SIZE / np.sqrt(2.0 * np.pi))))
    return evidence


def _hidden_end(best: _Found, patch: Patch) -> tuple[int, float] | None:
    """Return the axis and the side of the end that may be farthest behind an occluder, or None where none may be."""
    ends = []
    for axis in range(3) if best.start.kind == "box" else (2,):
        for side in (-1.0, 1.0):
            longer = resized(best.solid, axis, LONGER * float(best.solid.size[axis]), side)
            ends.append((_held(longer, axis, patch.fine).fit.cost, axis, side))
    cost, axis, side = min(ends)
    return (axis, side) if cost < best.fit.cost + UNLIKELY / 2.0 else None


def _held(start: Solid, axis: int, level: Level) -> _Found:
    """Return the fit with a length that is held."""
    prior = _prior(start.kind).copy()
    prior[6 + axis, 6 + axis] = HELD
    return _run(start, level, PROFILE_STEPS, prior)


def _spread(one: Estimate, axis: int, variance: float, side: float = 0.0) -> Estimate:
    """Return an estimate with a larger variance of the logarithm of a length, of which the end on a side moves."""
    lever, pose = np.zeros(9), one.solid.pose
    moving = side or np.sign(pose[:3, axis] @ pose[:3, 3])
    lever[3:6] = moving * one.solid.size[axis] / 2.0 * pose[:3, axis]
    lever[6 + axis] = 1.0
    return Estimate(one.solid, one.covariance + variance * np.outer(lever, lever))


def _front(solid: Solid) -> int:
    """Return the axis of the side that is seen most."""
    return int(np.argmax(np.abs(solid.pose[:3, :3].T @ solid.pose[:3, 3]) / solid.size))


def _square(one: Estimate) -> bool:
    """Return whether the side of a box that is seen most may be that of a cube."""
    first, second = (k for k in range(3) if k != _front(one.solid))
    size, variance = one.solid.size, np.diag(one.covariance)[6:]
    return bool(
        abs(np.log(size[first] / size[second])) < NOT_SQUARE + 4.0 * np.sqrt(variance[first] + variance[second])
    )


def _cube(best: _Found, patch: Patch) -> _Found:
    """Return the fit of a cube, whose front is that of a box."""
    solid = best.solid
    front = _front(solid)
    side = float(np.sqrt(np.delete(solid.size, front).prod()))
    return _run(
        Solid("box", np.full(3, side), resized(solid, front, side).pose), patch.fine, FINE_STEPS, ties=(0, 0, 0)
    )


def _of_known_size(best: _Found, patch: Patch, known: Sequence[KnownSize]) -> _Found | None:
    """Return the best fit of a known size, or None where none fits as well as a size of its own."""
    found: list[tuple[float, int, _Found, Array]] = []
    for one in known:
        if one.kind != best.start.kind:
            continue
        orders = ORDERS if one.kind == "box" else ORDERS[:1]
        for size in dict.fromkeys(tuple(one.size[list(order)].tolist()) for order in orders):
            start = best.solid
            for axis in range(3):
                start = resized(start, axis, float(size[axis]))
            prior = _prior(one.kind).copy()
            for axis in range(3) if one.kind == "box" else (0, 2):
                prior[6 + axis, 6 + axis] = (size[axis] / one.spread) ** 2
            coarse = _run(start, patch.coarse, PROFILE_STEPS, prior)
            found.append((coarse.fit.cost, len(found), coarse, prior))
    refined = [
        _run(Solid(one.start.kind, one.start.size, one.solid.pose), patch.fine, FINE_STEPS, prior)
        for cost, _, one, prior in sorted(found)[:RIVALS]
        if np.isfinite(cost)
    ]
    likely = [one for one in refined if one.fit.cost < best.fit.cost + UNLIKELY]
    return min(likely, key=lambda one: one.fit.cost) if likely else None


def mixture(parts: Sequence[tuple[float, Estimate]]) -> Estimate:
    """Return the mean and the covariance of hypotheses, one or more; turns are those of the most likely one."""
    if len(parts) == 1:
        return parts[0][1]
    evidence = np.array([one for one, _ in parts])
    parts = [one for one, value in zip(parts, evidence, strict=True) if value > evidence.max() - NEGLIGIBLE]
    evidence = np.array([one for one, _ in parts])
    weight = np.exp(evidence - evidence.max())
    weight /= weight.sum()
    best = parts[int(np.argmax(weight))][1].solid
    means = np.array(
        [
            [*pin.log3(one.solid.pose[:3, :3] @ best.pose[:3, :3].T), *one.solid.pose[:3, 3], *one.solid.size]
            for _, one in parts
        ]
    )
    mean = weight @ means
    covariance = np.zeros((9, 9))
    for share, value, (_, one) in zip(weight, means, parts, strict=True):
        scale = np.concatenate([np.ones(6), one.solid.size])
        off = value - mean
        covariance += share * (one.covariance * np.outer(scale, scale) + np.outer(off, off))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = pin.exp3(mean[:3]) @ best.pose[:3, :3], mean[3:6]
    scale = np.concatenate([np.ones(6), 1.0 / mean[6:]])
    return Estimate(Solid(best.kind, mean[6:], pose), covariance * np.outer(scale, scale))
