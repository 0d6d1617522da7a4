"""Obstacles of a color in drawn frames, against the truth."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import coal
import numpy as np
import pinocchio as pin
import pytest

from apex_ompl.errors import ParameterError
from apex_ompl.perception.camera import Camera, DepthErrors, look_at
from apex_ompl.perception.registration import CorrectedFrame, Registration
from apex_ompl.perception.rendering import DepthSensor, Light, Part, ZBuffer, colors
from apex_ompl.perception.synthetic import solid_part

pytest.importorskip("cv2")

from apex_ompl.perception import solid_fit  # noqa: E402
from apex_ompl.perception.color_parts import Color, color_parts  # noqa: E402
from apex_ompl.perception.obstacle_settings import ObstacleSettings  # noqa: E402
from apex_ompl.perception.obstacles import ObstacleFinder, SeenObstacle  # noqa: E402
from apex_ompl.perception.solid_fit import Estimate, KnownSize, mixture  # noqa: E402
from apex_ompl.perception.solid_pixels import Patch  # noqa: E402
from apex_ompl.perception.solid_starts import Solid, resized, starts  # noqa: E402

CAMERA = Camera(width=320, height=240, focal=(232.0, 232.0), center=(159.5, 119.5), depth=DepthErrors())
EYE = look_at((1.0, 0.1, 0.9), (0.3, 0.0, 0.3))
RED, GREEN, GRAY = (0.75, 0.06, 0.06), (0.1, 0.6, 0.1), (0.6, 0.6, 0.6)
LIGHT = Light((-0.3, -0.5, -0.8), 0.4, (1.0, 1.0, 1.0), 1.0)


def placed(x: float, y: float, z: float, turn: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    return np.asarray(pin.SE3(pin.exp3(np.array(turn)), np.array([x, y, z])).homogeneous)


def found_in(
    parts: list[Part], settings: ObstacleSettings | None = None, *, gain: float = 0.5, seed: int = 0,
    known: Sequence[KnownSize] = (), others: Sequence[tuple[np.ndarray, np.ndarray]] = (),
) -> tuple[SeenObstacle, ...]:  # fmt: skip
    rng = np.random.default_rng(seed)
    floor = solid_part(coal.Box(4.0, 4.0, 0.02), placed(0.0, 0.0, 0.0), 9, GRAY)
    everything = [*parts, floor]
    view = ZBuffer().draw(everything, CAMERA, EYE)
    depth = DepthSensor(gain=gain).measure(view, CAMERA, rng)[0]
    registered = Registration(EYE, 1.0, np.zeros(0), np.diag([1e-4] * 3 + [3e-4] * 3 + [1e-4]) ** 2, 0, 0)
    seen = CorrectedFrame(CAMERA, depth, registered, gain * CAMERA.depth.noise)
    return ObstacleFinder(settings).find(seen, colors(view, everything, LIGHT, rng), others, known)


CASES = {
    "cube": (coal.Box(0.12, 0.12, 0.12), placed(0.3, 0.0, 0.3, (0.0, 0.0, 0.5)), (0.12, 0.12, 0.12)),
    "lying box": (coal.Box(0.1, 0.25, 0.15), placed(0.3, 0.1, 0.3, (0.6, 0.3, 0.2)), (0.1, 0.25, 0.15)),
    "standing cylinder": (coal.Cylinder(0.06, 0.2), placed(0.3, -0.1, 0.2), (0.12, 0.12, 0.2)),
    "lying cylinder": (coal.Cylinder(0.05, 0.22), placed(0.3, 0.0, 0.2, (1.2, 0.4, 0.0)), (0.1, 0.1, 0.22)),
}


@pytest.mark.parametrize("case", CASES)
def test_solids_are_found_whatever_their_turn(case: str) -> None:
    solid, pose, size = CASES[case]
    (found,) = found_in([solid_part(solid, pose, 5, RED)])
    assert found.kind == ("box" if isinstance(solid, coal.Box) else "cylinder")
    assert np.linalg.norm(found.pose[:3, 3] - pose[:3, 3]) < 0.012
    np.testing.assert_allclose(np.sort(found.size), np.sort(size), atol=0.012)
    assert not found.cut
    off = found.pose[:3, 3] - pose[:3, 3]
    assert off @ np.linalg.solve(found.covariance[3:6, 3:6], off) < 25.0
    assert 1e-4 < found.place_spread < 0.02


def test_a_cube_s_axes_are_those_of_the_truth() -> None:
    solid, pose, _ = CASES["cube"]
    (found,) = found_in([solid_part(solid, pose, 5, RED)])
    along = np.abs(found.pose[:3, :3].T @ pose[:3, :3])
    np.testing.assert_allclose(np.sort(along, axis=1)[:, 2], 1.0, atol=0.005)


def test_other_colors_are_no_obstacles_and_other_red_things_are_others() -> None:
    solid, pose, _ = CASES["cube"]
    parts = [
        solid_part(solid, pose, 5, RED),
        solid_part(coal.Box(0.1, 0.1, 0.1), placed(0.1, -0.35, 0.2), 6, GREEN),
        solid_part(coal.Box(0.1, 0.1, 0.1), placed(0.1, 0.35, 0.1), 7, RED),
    ]
    found = found_in(parts)
    assert len(found) == 2
    assert np.linalg.norm(found[0].pose[:3, 3] - pose[:3, 3]) < 0.01
    assert np.linalg.norm(found[1].pose[:3, 3] - (0.1, 0.35, 0.1)) < 0.015
    (green,) = found_in(parts, ObstacleSettings(hue=120.0, hue_width=25.0))
    assert np.linalg.norm(green.pose[:3, 3] - (0.1, -0.35, 0.2)) < 0.015


def test_what_has_its_center_in_another_body_is_no_obstacle_and_what_is_beside_it_is_one() -> None:
    solid, pose, size = CASES["cube"]
    half = 0.5 * np.asarray(size)
    for shift, count in ((0.0, 0), (2.0, 1)):
        held = pose.copy()
        held[:3, 3] += shift * half[0] * pose[:3, 0]
        assert len(found_in([solid_part(solid, pose, 5, RED)], others=[(held, np.stack([-half, half]))])) == count


def test_a_bar_before_an_obstacle_does_not_divide_it() -> None:
    solid, pose, size = CASES["lying box"]
    bar = solid_part(coal.Box(0.02, 0.02, 0.6), placed(0.55, 0.1, 0.45), 6, GRAY)
    found = found_in([solid_part(solid, pose, 5, RED), bar])
    assert len(found) == 1
    assert np.linalg.norm(found[0].pose[:3, 3] - pose[:3, 3]) < 0.02
    np.testing.assert_allclose(np.sort(found[0].size), np.sort(size), atol=0.03)


def test_obstacles_beside_an_occluder_are_no_single_one() -> None:
    """The bar hides what is between them; one solid does not explain both."""
    first, second = placed(0.3, -0.11, 0.3, (0.0, 0.0, 0.5)), placed(0.42, 0.1, 0.28, (0.3, 0.0, 0.2))
    middle = (first + second)[:3, 3] / 2.0
    bar = solid_part(coal.Box(0.02, 0.05, 0.4), placed(*(middle + 0.4 * (EYE[:3, 3] - middle))), 7, GRAY)
    cubes = [solid_part(coal.Box(0.12, 0.12, 0.12), pose, 5 + k, RED) for k, pose in enumerate((first, second))]
    found = found_in([*cubes, bar])
    assert len(found) == 2
    for pose in (first, second):
        assert min(np.linalg.norm(one.pose[:3, 3] - pose[:3, 3]) for one in found) < 0.02


def test_what_one_solid_does_not_explain_is_not_known() -> None:
    """Two boxes that touch are one part of the image."""
    pose = placed(0.3, 0.0, 0.3)
    upper, right = pose.copy(), pose.copy()
    upper[2, 3] += 0.12
    right[1, 3] += 0.12
    parts = [solid_part(coal.Box(0.12, 0.12, 0.12), one, 5, RED) for one in (pose, upper, right)]
    (whole,) = found_in(parts[:1])
    (found,) = found_in(parts)
    assert whole.place_spread < 0.005
    assert found.place_spread > 0.05
    assert (np.sqrt(found.covariance.diagonal()[6:]) > 0.05).all()


def test_what_the_image_cuts_and_what_is_too_large_or_elsewhere() -> None:
    (cut,) = found_in([solid_part(coal.Box(0.2, 0.2, 0.2), placed(0.3, 0.5, 0.3), 5, RED)])
    assert cut.cut
    assert found_in([solid_part(coal.Box(0.02, 1.5, 0.8), placed(0.0, 0.0, 0.4), 5, RED)]) == ()
    solid, pose, _ = CASES["cube"]
    assert found_in([solid_part(solid, pose, 5, RED)], ObstacleSettings(high=(0.2, 1.0, 1.0))) == ()
    assert found_in([]) == ()


def test_an_obstacle_grows_by_the_deviations_of_its_ends() -> None:
    solid, pose, _ = CASES["lying box"]
    (found,) = found_in([solid_part(solid, pose, 5, RED)])
    assert found.obstacle("red").box == pytest.approx(tuple(found.size))
    np.testing.assert_allclose(found.obstacle("red").pose, found.pose, atol=1e-9)
    known = found.covariance.copy()
    known[:3] = known[:, :3] = 0.0  # without turns, whose effect is bounded only
    still = replace(found, covariance=known)
    rotation, zero, unit = found.pose[:3, :3], np.zeros((3, 3)), np.eye(3) / 2.0
    ends = np.block([[zero, rotation.T, -unit], [zero, rotation.T, unit]])
    deviations = np.sqrt(np.diag(ends @ known @ ends.T))
    wide = still.obstacle("red", 2.0)
    assert wide.box is not None
    own = (wide.pose[:3, 3] - found.pose[:3, 3]) @ rotation
    np.testing.assert_allclose((found.size - wide.box) / 2.0 + own, -2.0 * deviations[:3], atol=1e-9)
    np.testing.assert_allclose((wide.box - found.size) / 2.0 + own, 2.0 * deviations[3:], atol=1e-9)
    turned = found.obstacle("red", 2.0).box
    assert turned is not None
    assert (np.array(turned) >= wide.box).all()


def test_growth_holds_turned_solids_and_is_bounded() -> None:
    pose, size = placed(0.3, 0.1, 0.3, (0.6, 0.3, 0.2)), np.array([0.1, 0.25, 0.15])
    for angle in (0.02, 0.1, 2.0):
        covariance = np.zeros((9, 9))
        covariance[:3, :3] = angle**2 * np.eye(3)
        wide = SeenObstacle("box", pose, size, covariance, False, 100).obstacle("red", 1.0)
        corners = np.array(np.meshgrid(*[[-0.5, 0.5]] * 3)).reshape(3, -1).T * size
        assert wide.box is not None
        assert max(wide.box) <= np.linalg.norm(size) + 1e-9
        for axis in np.eye(3):
            turned = corners @ np.asarray(pin.exp3(angle * axis)).T
            assert (np.abs(turned) <= np.array(wide.box) / 2.0 + angle**2 * 0.1).all()


FACING = placed(0.3, 0.0, 0.3) @ np.array([[*EYE[:3, 2], 0], [*EYE[:3, 0], 0], [*EYE[:3, 1], 0], [0, 0, 0, 1]]).T
"""A pose whose x is the line of sight."""


def test_a_depth_that_is_not_seen_is_in_the_covariance() -> None:
    size = np.array([0.09, 0.15, 0.2])
    (found,) = found_in([solid_part(coal.Box(*size), FACING, 5, RED)])
    sight, off = EYE[:3, 2], found.pose[:3, 3] - FACING[:3, 3]
    deviation = np.sqrt(sight @ found.covariance[3:6, 3:6] @ sight)
    assert deviation > 0.02
    assert abs(off @ sight) < 2.5 * deviation
    across = off - (off @ sight) * sight
    assert np.linalg.norm(across) < 0.005
    front = found.pose[:3, 3] - found.size[axis_of(found)] / 2.0 * sight
    assert abs((front - FACING[:3, 3]) @ sight + size[0] / 2.0) < 0.006
    (end,) = (one.box for one in [found.obstacle("red", 2.0)])
    assert end is not None
    assert max(end) > 0.2


def axis_of(found: SeenObstacle) -> int:
    """Return the axis that is most along the line of sight."""
    return int(np.argmax(np.abs(found.pose[:3, :3].T @ EYE[:3, 2])))


def test_an_end_behind_an_occluder_is_not_known() -> None:
    size = np.array([0.06, 0.06, 0.3])
    pose = placed(0.3, 0.0, 0.3, (np.pi / 2.0, 0.0, 0.0))
    cylinder = solid_part(coal.Cylinder(size[0] / 2.0, size[2]), pose, 5, RED)
    (whole,) = found_in([cylinder])
    end = pose[:3, 3] + 0.11 * pose[:3, 2]
    hiding = solid_part(coal.Box(0.02, 0.1, 0.2), placed(*(end + 0.25 * (EYE[:3, 3] - end))), 6, GRAY)
    (partly,) = found_in([cylinder, hiding])
    known, unknown = (np.sqrt(one.covariance[8, 8]) for one in (whole, partly))
    assert known < 0.01
    assert unknown > 0.03
    off = partly.pose[:3, 3] - pose[:3, 3]
    assert off @ np.linalg.solve(partly.covariance[3:6, 3:6], off) < 12.0
    other = -np.sign(partly.pose[:3, 2] @ pose[:3, 2]) * partly.size[2] / 2.0 * partly.pose[:3, 2] + partly.pose[:3, 3]
    np.testing.assert_allclose(other, pose[:3, 3] - 0.15 * pose[:3, 2], atol=0.01)


def test_specks_of_the_color_do_not_widen_an_obstacle() -> None:
    rng = np.random.default_rng(0)
    own = np.zeros((60, 80), bool)
    own[20:40, 30:50] = True
    image = np.where((own | (rng.random(own.shape) < 0.15))[..., None], (190, 10, 10), (90, 90, 90)).astype(np.uint8)
    depth = np.where(own, 1.0, 2.0)
    (part,) = color_parts(image, depth, Color(0.0, 18.0, 0.55, 0.08), noise=0.003, least=60, largest=0.6)
    found = np.zeros_like(own)
    found[part.top : part.top + part.own.shape[0], part.left : part.left + part.own.shape[1]] = part.own
    assert np.count_nonzero(found & ~own) == 0
    assert np.count_nonzero(own & ~found) <= 4


def own_columns(depth: np.ndarray, red: np.ndarray) -> tuple[int, int]:
    """Return the first and the last column of the nearest part of the color, of depths in a wider image."""
    image = np.where(np.pad(red, 20)[..., None], (190, 10, 10), (90, 90, 90)).astype(np.uint8)
    depths = np.pad(depth, 20, constant_values=2.0)
    parts = color_parts(image, depths, Color(0.0, 18.0, 0.55, 0.08), noise=0.003, least=60, largest=0.3)
    near = min(parts, key=lambda one: one.depth)
    columns = np.flatnonzero(near.own.sum(axis=0) > 10) + near.left - 20
    return int(columns[0]), int(columns[-1])


def test_pixels_without_depth_are_no_part_of_the_nearer_of_two_surfaces() -> None:
    """A stereo camera has no depth of what one of its eyes does not see: the farther surface, beside the nearer one."""
    depth, red = np.full((40, 90), 1.5), np.ones((40, 90), bool)
    depth[:, 20:30], depth[:, 30:60] = 0.0, 1.0
    first, last = own_columns(depth, red)
    assert 27 <= first <= 30
    assert 59 <= last <= 61
    red[:, :20] = False  # all that is seen of the farther surface is of another color
    assert 27 <= own_columns(depth, red)[0] <= 30
    depth[:, :20] = 0.7  # an occluder, which hides the part itself
    assert 19 <= own_columns(depth, red)[0] <= 21


def test_a_box_is_searched_again_where_a_cube_explains_it_better(monkeypatch: pytest.MonkeyPatch) -> None:
    solid, pose, size = CASES["cube"]
    searched = solid_fit._searched

    def too_long(patch: Patch) -> Any:
        best = searched(patch)
        assert best is not None
        axis = solid_fit._front(best.solid)
        return solid_fit._held(resized(best.solid, axis, 1.1 * float(best.solid.size[axis])), axis, patch.fine)

    monkeypatch.setattr(solid_fit, "_searched", too_long)
    (found,) = found_in([solid_part(solid, pose, 5, RED)], ObstacleSettings(cubes=1e-30))
    np.testing.assert_allclose(found.size, size, atol=0.004)
    off = found.pose[:3, 3] - pose[:3, 3]
    assert off @ np.linalg.solve(found.covariance[3:6, 3:6], off) < 12.0


def test_a_square_front_is_a_cube_as_far_as_cubes_are_expected() -> None:
    parts = [solid_part(coal.Box(0.15, 0.15, 0.15), FACING, 5, RED)]
    (expected,) = found_in(parts, ObstacleSettings(cubes=0.5))
    np.testing.assert_allclose(expected.size, 0.15, atol=0.008)
    assert expected.place_spread < 0.03
    (open_minded,) = found_in(parts, ObstacleSettings(cubes=0.0))
    assert open_minded.place_spread > 0.02
    assert np.sort(open_minded.covariance.diagonal()[6:])[-1] > 0.03**2


def test_an_obstacle_of_known_size_is_placed_by_its_front() -> None:
    size = np.array([0.09, 0.15, 0.2])
    parts = [solid_part(coal.Box(*size), FACING, 5, RED)]
    (found,) = found_in(parts, known=[KnownSize("box", size[[2, 0, 1]]), KnownSize("cylinder", size)])
    assert np.linalg.norm(found.pose[:3, 3] - FACING[:3, 3]) < 0.005
    np.testing.assert_allclose(np.sort(found.size), size, atol=0.002)
    assert found.place_spread < 0.01
    (other,) = found_in(parts, known=[KnownSize("box", np.full(3, 0.3))])
    np.testing.assert_allclose(np.sort(np.delete(other.size, axis_of(other))), size[1:], atol=0.01)


def test_a_narrow_strip_of_a_side_tells_the_depth() -> None:
    """Without noise: pixels that a drawing does not cover lengthen that side, they do not widen the front."""
    pose = FACING.copy()
    pose[:3, :3] = pose[:3, :3] @ np.asarray(pin.exp3(np.array([0.0, 0.3, 0.0])))
    size = np.array([0.2, 0.12, 0.16])
    (found,) = found_in([solid_part(coal.Box(*size), pose, 5, RED)], gain=0.05)
    np.testing.assert_allclose(np.sort(found.size), np.sort(size), atol=0.01)


def test_a_mixture_has_the_moments_of_its_samples() -> None:
    rng, parts, samples = np.random.default_rng(5), [], []
    for odds, length, deviation in ((1.0, 0.1, 0.01), (3.0, 0.16, 0.03)):
        pose = np.eye(4)
        pose[:3, 3] = 0.0, length, 1.0
        covariance = np.diag([0.01] * 3 + [deviation] * 3 + [0.05] * 3) ** 2
        parts.append((np.log(odds), Estimate(Solid("box", np.array([0.1, length, 0.2]), pose), covariance)))
        size = rng.normal(0.0, 0.05, (int(odds * 40000), 3)) * (0.1, length, 0.2) + (0.1, length, 0.2)
        samples.append(np.hstack([rng.normal(0.0, deviation, size.shape) + pose[:3, 3], size]))
    found = mixture(parts)
    assert found is not None
    drawn = np.concatenate(samples)
    np.testing.assert_allclose([*found.solid.pose[:3, 3], *found.solid.size], drawn.mean(axis=0), atol=1e-3)
    scale = np.array([1.0, 1.0, 1.0, *found.solid.size])
    np.testing.assert_allclose(found.covariance[3:, 3:] * np.outer(scale, scale), np.cov(drawn.T), atol=3e-5)


@pytest.mark.parametrize("direction", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.3, -0.2, 0.5)])
def test_starts_on_points_of_a_line_are_solids(direction: tuple[float, float, float]) -> None:
    """A strip of one row of pixels: its planes have no normal of their own."""
    places = np.array([0.1, 0.0, 0.8]) + np.linspace(0.0, 0.05, 12)[:, None] * np.array(direction)
    for normals in (np.tile([0.0, 0.0, -1.0], (12, 1)), np.eye(3)[[0] * 6 + [2] * 6], np.zeros((0, 3))):
        given = places if len(normals) else places[:0]
        for one in starts(places, given, normals):
            assert np.allclose(one.pose[:3, :3] @ one.pose[:3, :3].T, np.eye(3), atol=1e-9)
            assert np.linalg.det(one.pose[:3, :3]) > 0.0 and (one.size > 0.0).all() and np.isfinite(one.pose).all()


def test_hues_are_those_of_colorsys() -> None:
    rng = np.random.default_rng(3)
    image = rng.integers(0, 256, (40, 50, 3), np.uint8)
    for hue in (0.0, 100.0, 350.0):
        settings = ObstacleSettings(hue=hue, hue_width=20.0)
        mask = ObstacleFinder(settings).colored(image)
        for row, column in rng.integers(0, (40, 50), (200, 2)):
            h, s, v = colorsys.rgb_to_hsv(*(image[row, column] / 255.0))
            apart = abs((360.0 * h - hue + 180.0) % 360.0 - 180.0)
            margins = np.array([20.0 - apart, 100.0 * (s - settings.saturation), 100.0 * (v - settings.value)])
            if np.abs(margins).min() > 3.0:  # steps of 8 bits
                assert mask[row, column] == (margins > 0.0).all()


def test_bad_sizes_are_refused() -> None:
    for kind, size, spread in (
        ("ball", (1.0, 1.0, 1.0), 0.1),
        ("box", (1.0, 0.0, 1.0), 0.1),
        ("box", (1.0, 1.0, 1.0), 0.0),
    ):
        with pytest.raises(ParameterError):
            KnownSize(kind, np.array(size), spread)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "fields",
    [
        {"hue": 400.0}, {"hue_width": 0.0}, {"largest": -1.0}, {"largest": 0.01}, {"high": (0.0, -2.0, 0.0)},
        {"low": (0.0, 0.0)}, {"low": ("a", 0.0, 0.0)}, {"high": 1.0}, {"cubes": 1.0}, {"most_points": 0.5},
    ],
)  # fmt: skip
def test_bad_settings_are_refused(fields: dict[str, float]) -> None:
    with pytest.raises(ParameterError, match=next(iter(fields))):
        ObstacleSettings(**fields)  # type: ignore[arg-type]
