"""Looks fused: against the exact posterior of a linear model, chi-squared, and looks that contradict each other."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pinocchio as pin
import pytest

from apex_ompl.errors import ParameterError
from apex_ompl.perception import Camera, Frame
from apex_ompl.perception.camera import DepthErrors
from apex_ompl.perception.frames import looks_of, mean_frame
from apex_ompl.perception.fusion import Sighting, fused
from apex_ompl.perception.held import HeldObject
from apex_ompl.perception.held_pixels import NOT_THERE
from apex_ompl.perception.held_settings import HeldSettings
from apex_ompl.perception.registration import CorrectedFrame, Registration
from apex_ompl.scene.bodies import AttachedObject

SETTINGS = HeldSettings(grasp_turn=(1.0, 1.0, 2.0), grasp_shift=(0.008, 0.008, 0.003))
SPREAD = np.array([*np.radians(SETTINGS.grasp_turn), *SETTINGS.grasp_shift])
BODY = AttachedObject(name="box", link="palm", box=(0.06, 0.06, 0.12), position=(0.0, 0.02, -0.04))
CAMERA = Camera(
    width=64, height=48, focal=(60.0, 60.0), center=(31.5, 23.5), position_spread=0.003, angle_spread=0.004,
    depth=DepthErrors(scale_spread=0.002),
)  # fmt: skip
CALIBRATION = np.array([0.004] * 3 + [0.003] * 3 + [0.002])


class Look(NamedTuple):
    """A linear look: z = H x + J (e - e_found) + v, and a registration that saw e with noise, or not at all."""

    h: np.ndarray
    j: np.ndarray
    noise: np.ndarray
    registered: np.ndarray


def drawn_look(rng: np.random.Generator, *, registered: bool) -> Look:
    h = rng.uniform(2.0, 5.0, (6, 1)) * np.linalg.qr(rng.normal(size=(6, 6)))[0] / SPREAD
    j = rng.normal(size=(6, 7)) / CALIBRATION
    return Look(h, j, rng.uniform(0.5, 2.0, 6), rng.uniform(0.2, 1.0, 7) if registered else np.full(7, 1e6))


def sighting(look: Look, x: np.ndarray, e: np.ndarray, rng: np.random.Generator, link: np.ndarray) -> Sighting:
    """What a fit to the look finds, which takes the camera as the registration has it."""
    seen = 1.0 / (look.registered * CALIBRATION) ** 2
    left = np.linalg.inv(np.diag(CALIBRATION**-2.0 + seen))
    found = left @ (seen * (e + look.registered * CALIBRATION * rng.normal(size=7)))
    z = look.h @ x + look.j @ (e - found) + look.noise * rng.normal(size=6)
    weighted = look.h.T / look.noise**2
    own = np.linalg.inv(np.diag(SPREAD**-2.0) + weighted @ look.h)
    mean, lever = own @ weighted @ z, own @ weighted @ look.j
    covariance = own + lever @ left @ lever.T
    turn = np.kron(np.eye(2), link[:3, :3])
    pose = BODY.pose
    pose[:3, :3], pose[:3, 3] = pin.exp3(mean[:3]) @ pose[:3, :3], pose[:3, 3] + mean[3:]
    held = HeldObject(BODY, "", link @ pose, turn @ covariance @ turn.T, lever=turn @ lever)
    registration = Registration(np.eye(4), 1.0, np.zeros(2), left, 100, 0)
    return Sighting(held, link, CorrectedFrame(CAMERA, np.zeros((48, 64)), registration, 0.004))


def off(pose: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Turn and shift of a pose in the frame of the link from the true one."""
    turn = pin.log3(pin.exp3(x[:3]) @ BODY.pose[:3, :3] @ pose[:3, :3].T)
    return np.concatenate([turn, BODY.pose[:3, 3] + x[3:] - pose[:3, 3]])


def random_link(rng: np.random.Generator) -> np.ndarray:
    link = np.eye(4)
    link[:3, :3], link[:3, 3] = pin.exp3(rng.normal(size=3)), rng.normal(size=3)
    return link


def test_the_covariance_is_that_of_the_joint_posterior() -> None:
    rng = np.random.default_rng(3)
    looks = [drawn_look(rng, registered=True), drawn_look(rng, registered=False), drawn_look(rng, registered=True)]
    found = fused([sighting(one, np.zeros(6), np.zeros(7), rng, np.eye(4)) for one in looks], np.eye(4), SETTINGS)
    # all measurements of all looks at once: of the object, the camera, and its registrations
    information = np.diag([*SPREAD**-2.0, *CALIBRATION**-2.0])
    for one in looks:
        seen = (one.registered * CALIBRATION) ** 2
        left = 1.0 / (CALIBRATION**-2.0 + 1.0 / seen)
        # e - e_found = left / CALIBRATION^2 e - noise, whose variance is (left / seen)^2 seen
        rows = np.hstack([one.h, one.j * (left / CALIBRATION**2)])
        noise = np.diag(one.noise**2) + (one.j * (left**2 / seen)) @ one.j.T
        information += rows.T @ np.linalg.solve(noise, rows)
    expected = np.linalg.inv(information)[:6, :6]
    deviations = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        found.covariance / np.outer(deviations, deviations), expected / np.outer(deviations, deviations),
        atol=1e-3,
    )  # fmt: skip


@pytest.mark.parametrize("registered", [True, False])
def test_squared_errors_are_within_the_band_of_chi_squared(registered: bool) -> None:
    rng = np.random.default_rng(5)
    squared, naive, trials = [], [], 300
    for _ in range(trials):
        x, e = SPREAD * rng.normal(size=6), CALIBRATION * rng.normal(size=7)
        looks = [sighting(drawn_look(rng, registered=registered), x, e, rng, random_link(rng)) for _ in range(3)]
        now = random_link(rng)
        found = fused(looks, now, SETTINGS)
        turn = np.kron(np.eye(2), now[:3, :3])
        error = turn @ off(np.linalg.inv(now) @ found.pose, x)
        squared.append(float(error @ np.linalg.solve(found.covariance, error)))
        # looks as if nothing but the grasp were common to them
        total, vector = np.diag(SPREAD**-2.0), np.zeros(6)
        for one in looks:
            back = np.kron(np.eye(2), one.link[:3, :3].T)
            own = np.linalg.inv(back @ one.held.covariance @ back.T)
            total = total + own - np.diag(SPREAD**-2.0)
            vector = vector + own @ off(np.linalg.inv(one.link) @ one.held.pose, x)
        vector -= 2.0 * SPREAD**-2.0 * off(BODY.pose, x)
        error = np.linalg.solve(total, vector)
        naive.append(float(error @ total @ error))
    half = 1.96 * np.sqrt(2.0 / (6 * trials))
    assert abs(np.mean(squared) / 6.0 - 1.0) < half + 0.05  # some variances grow where looks differ by chance
    if not registered:
        assert np.mean(naive) / 6.0 > 1.0 + 3.0 * half


def two_looks(rng: np.random.Generator) -> tuple[np.ndarray, list[Sighting]]:
    x, e = SPREAD * rng.normal(size=6), CALIBRATION * rng.normal(size=7)
    return x, [sighting(drawn_look(rng, registered=True), x, e, rng, np.eye(4)) for _ in range(2)]


def test_an_object_that_has_moved_in_the_hand_is_named() -> None:
    rng = np.random.default_rng(7)
    _, looks = two_looks(rng)
    assert not fused(looks, np.eye(4), SETTINGS).reason
    moved = looks[1].held.pose.copy()
    moved[:3, 3] += 0.05
    looks[1] = looks[1]._replace(held=replace(looks[1].held, pose=moved))
    assert "'box' is not where it was seen before" in fused(looks, np.eye(4), SETTINGS).reason


def test_of_three_looks_one_that_is_wrong_does_not_count() -> None:
    rng = np.random.default_rng(7)
    x, looks = two_looks(rng)
    wrong = looks[0].held.pose.copy()
    wrong[:3, 3] += 0.05
    bad = looks[0]._replace(held=replace(looks[0].held, pose=wrong))
    found = fused([bad, *looks], np.eye(4), SETTINGS)
    assert not found.reason
    np.testing.assert_allclose(found.pose, fused(looks, np.eye(4), SETTINGS).pose, atol=1e-9)
    assert float(off(found.pose, x) @ np.linalg.solve(found.covariance, off(found.pose, x))) < 22.5


def test_looks_without_an_answer_do_not_count_but_an_empty_hand_does() -> None:
    rng = np.random.default_rng(9)
    _, (one, other) = two_looks(rng)
    hidden = other._replace(held=replace(other.held, reason="'box' is hidden"))
    found = fused([one, hidden], np.eye(4), SETTINGS)
    np.testing.assert_allclose(found.pose, one.held.pose)
    np.testing.assert_allclose(found.covariance, one.held.covariance)
    empty = other._replace(held=replace(other.held, reason=f"'box': {NOT_THERE}"))
    assert fused([one, empty], np.eye(4), SETTINGS).reason.endswith(NOT_THERE)
    assert not fused([empty, one], np.eye(4), SETTINGS).reason


def test_frames_are_grouped_into_looks() -> None:
    other = CAMERA.model_copy(update={"name": "other"})
    depth = np.ones((48, 64))

    def frame(camera: Camera, joint: float, stamp: float) -> Frame:
        return Frame(camera, depth, stamp=stamp, joints={"a": joint})

    frames = [frame(CAMERA, 0.0, 0.0), frame(other, 0.0, 0.1), frame(CAMERA, 1e-3, 0.2), frame(CAMERA, 0.5, 0.3),
              frame(other, 5e-4, 0.4)]  # fmt: skip
    looks = looks_of(frames)
    assert [[one.stamp for one in look] for look in looks] == [[0.0, 0.2], [0.3], [0.1, 0.4]]
    drift = looks_of([frame(CAMERA, 1.5e-3 * k, 0.1 * k) for k in range(4)])
    assert [mean_frame(look).stamp for look in drift] == pytest.approx([0.1, 0.3])  # none of which has moved
    with pytest.raises(ParameterError, match="one frame or more"):
        looks_of([])
    with pytest.raises(ParameterError, match="the same joints"):
        looks_of([frame(CAMERA, 0.0, 0.0), Frame(CAMERA, depth, joints={"b": 0.0})])
    with pytest.raises(ParameterError, match="frames"):
        looks_of([frame(CAMERA, 0.0, 0.0), "frame"])  # type: ignore[list-item]
