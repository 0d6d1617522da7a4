"""One estimate of a held object from looks in several states and of several cameras.

An object does not move in its hand, so that its pose in the frame of the link is the same in all looks. Errors of two
looks have two parts in common: that of the grasp, which each fit has as its prior, and that of a camera's calibration,
as far as the robot's surface has not corrected it (:mod:`apex_ompl.perception.registration`). Both are unknowns here:

    y_k = x + G_k e + v_k,    x ~ N(grasp, P),    e ~ N(0, C),

with the pose x, the calibration error e of the camera, and what a look measured, y_k, without its prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from apex_ompl.perception.held import HeldObject, turned, twice
from apex_ompl.perception.held_pixels import NOT_THERE
from apex_ompl.perception.held_settings import HeldSettings
from apex_ompl.perception.registration import CorrectedFrame
from apex_ompl.perception.surfaces import inverse
from apex_ompl.types import Array

CAMERA = 7  # errors of a camera: turn, shift, scale of depths
MEASURED = 0.95  # share of the grasp's variance below which a look has measured a direction
ROUNDS = 3  # of the linearization of turns
LARGE = 1.5  # mean squared difference of looks above which their covariances are too small
APART = 4.0  # mean squared difference of looks over what their covariances explain above which one is wrong


class Sighting(NamedTuple):
    """An object in a look.

    Attributes:
        held: The object as it was found.
        link: Pose of the link that holds it in the world then, shape (4, 4) [m].
        seen: The look.
    """

    held: HeldObject
    link: Array
    seen: CorrectedFrame


class _Rows(NamedTuple):
    """What a look measured, in units of the grasp's standard deviations.

    Attributes:
        directions: Directions that it measured, shape (n, 6).
        camera: Derivatives by the errors of calibration, in units of their standard deviations, shape (n, 7).
        values: Shape (n,).
        information: Inverse of their covariance, shape (n, n).
    """

    directions: Array
    camera: Array
    values: Array
    information: Array


def fused(sightings: Sequence[Sighting], link: Array, settings: HeldSettings) -> HeldObject:
    """Return an object as several looks have it.

    Args:
        sightings: The object in each look, the last one last.
        link: Pose of its link in the world now, shape (4, 4) [m].
        settings: Settings of the fits.
    """
    last = sightings[-1].held
    answers = [one for one in sightings if not one.held.reason]
    if not answers or last.reason.endswith(NOT_THERE):
        return _moved_along(sightings[-1], link)
    if len(answers) == 1:
        return _moved_along(answers[0], link)
    spread = np.array([*np.radians(settings.grasp_turn), *settings.grasp_shift])
    pose, covariance, excess = _fused(answers, spread)
    if excess > APART and len(answers) > 2:
        parts = [[one for one in answers if one is not left] for left in answers]
        fits = [_fused(part, spread) for part in parts]
        least = min(range(len(fits)), key=lambda k: fits[k][2])
        answers, (pose, covariance, excess) = parts[least], fits[least]
    scale, size = _size([one.held for one in answers], settings)
    reason = ""
    if excess > APART:
        reason = f"{last.name!r} is not where it was seen before: it has moved in the hand, or was mistaken"
    return HeldObject(
        last.body, reason, link @ pose, turned(covariance, link[:3, :3]), scale, size,
        max(one.held.seen for one in answers), max(one.held.points for one in answers),
        min(one.held.misfit for one in answers),
    )  # fmt: skip


def _fused(answers: Sequence[Sighting], spread: Array) -> tuple[Array, Array, float]:
    """Return the pose in the frame of the link, its covariance, and the mean squared difference of the looks.

    Args:
        answers: The looks.
        spread: Standard deviations of the grasp's turn and shift along the axes of the link, shape (6,).
    """
    names = list(dict.fromkeys(one.seen.camera.name for one in answers))
    cameras = [names.index(one.seen.camera.name) for one in answers]
    best = min(answers, key=lambda one: float(np.trace(one.held.covariance / np.outer(spread, spread))))
    pose, information, excess = inverse(best.link) @ best.held.pose, np.eye(6), 1.0
    for _ in range(ROUNDS):
        expected = _off(best.held.body.pose, pose) / spread
        rows = [_rows(one, pose, expected, spread) for one in answers]
        solution, information, excess = _solved(rows, cameras, len(names), expected)
        pose = _shifted(pose, spread * solution)
    growth = excess if excess > LARGE else 1.0
    covariance = np.asarray(np.linalg.inv(information)[:6, :6] * np.outer(spread, spread) * growth, float)
    return pose, covariance, excess


def _moved_along(one: Sighting, link: Array) -> HeldObject:
    """Return an object of a look where its link is now."""
    motion = link @ inverse(one.link)
    held, rotation = one.held, motion[:3, :3]
    lever = twice(rotation) @ held.lever
    return replace(held, pose=motion @ held.pose, covariance=turned(held.covariance, rotation), lever=lever)


def _off(pose: Array, reference: Array) -> Array:
    """Return turn and shift of a pose from a reference, shape (6,)."""
    return np.concatenate([pin.log3(pose[:3, :3] @ reference[:3, :3].T), pose[:3, 3] - reference[:3, 3]])


def _shifted(pose: Array, step: Array) -> Array:
    """Return a pose after a turn and a shift, shape (6,)."""
    found = pose.copy()
    found[:3, :3] = pin.exp3(step[:3]) @ pose[:3, :3]
    found[:3, 3] = pose[:3, 3] + step[3:]
    return found


def _rows(one: Sighting, pose: Array, expected: Array, spread: Array) -> _Rows:
    """Return what a look measured, without the grasp, as differences from a pose in the frame of the link."""
    rotation = one.link[:3, :3].T
    covariance = turned(one.held.covariance, rotation) / np.outer(spread, spread)
    value = _off(inverse(one.link) @ one.held.pose, pose) / spread
    camera, calibration = one.seen.camera, one.seen.registration.covariance
    deviations = np.maximum(
        [*[camera.angle_spread] * 3, *[camera.position_spread] * 3, camera.depth.scale_spread], 1e-6
    )  # fmt: skip
    lever = twice(rotation) @ one.held.lever / spread[:, None]
    own = covariance - lever @ calibration @ lever.T
    variances, vectors = np.linalg.eigh((own + own.T) / 2.0)
    kept = variances < MEASURED
    variance, directions = np.maximum(variances[kept], 1e-6), vectors[:, kept].T
    precision = 1.0 / variance - 1.0  # without the grasp's
    values = (directions @ value / variance - directions @ expected) / precision
    slopes = directions @ lever / (variance * precision)[:, None]
    left = calibration / deviations  # of the calibration's errors, in units of their standard deviations
    noise = np.diag(1.0 / precision) + slopes @ (calibration - left @ left.T) @ slopes.T
    return _Rows(directions, slopes @ left, values, np.asarray(np.linalg.inv(noise), float))


def _solved(
    rows: Sequence[_Rows], cameras: Sequence[int], count: int, expected: Array
) -> tuple[Array, Array, float]:  # fmt: skip
    """Return pose [grasp's deviations], information of pose and cameras, and the mean squared difference of looks."""
    n = 6 + CAMERA * count
    information, vector = np.eye(n), np.zeros(n)
    vector[:6] = expected
    matrices = []
    for one, number in zip(rows, cameras, strict=True):
        matrix = np.zeros((len(one.values), n))
        matrix[:, :6] = one.directions
        first = 6 + CAMERA * number
        matrix[:, first : first + CAMERA] = one.camera
        information = information + matrix.T @ one.information @ matrix
        vector = vector + matrix.T @ one.information @ one.values
        matrices.append(matrix)
    solution = np.asarray(np.linalg.solve(information, vector), float)
    cost = float(np.sum((solution[:6] - expected) ** 2) + np.sum(solution[6:] ** 2))
    for one, matrix in zip(rows, matrices, strict=True):
        off = one.values - matrix @ solution
        cost += float(off @ one.information @ off)
    return solution[:6], information, cost / max(1, sum(len(one.values) for one in rows))


def _size(answers: Sequence[HeldObject], settings: HeldSettings) -> tuple[Array, Array]:
    """Return scales and standard deviations of their logarithms, shape (3,) each, of several answers."""
    if settings.size_spread <= 0.0:
        return answers[-1].scale, np.zeros(3)
    prior = settings.size_spread**-2
    information = np.array([one.size_spread**-2 for one in answers])
    total = prior + np.maximum(information - prior, 0.0).sum(axis=0)
    logarithms = np.log([one.scale for one in answers])  # whose prior has the mean 0
    return np.asarray(np.exp((information * logarithms).sum(axis=0) / total), float), total**-0.5
