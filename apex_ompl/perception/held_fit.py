"""Fit of the known surface of a held object to its pixels, from several starts.

The fit of surfaces (:mod:`apex_ompl.kernel.perception`) goes on from few points with a wide cutoff, and then, for what
may be the answer, with more points and a narrower one. The covariance holds the noise, the prior, the camera's
remaining error, and other minima of nearly the same cost.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from apex_ompl.kernel.perception import FitSettings, SurfaceFit, fit_surface
from apex_ompl.perception.held_pixels import Pixels, Surroundings
from apex_ompl.perception.held_settings import HeldSettings
from apex_ompl.perception.held_shapes import Expected
from apex_ompl.perception.registration import CorrectedFrame
from apex_ompl.types import Array

MISFIT, GROWTH = 1.0, 1.5  # mean squared error of points over that of noise above which variances grow, and its power
ALONE = 0.33  # share of the contour's measurements in one frame, in which depths at edges are missing
STEPS = 4, 3  # from each start, and in a round of what was found from there
ROUNDS = 3  # at most
SETTLED = 0.3  # squared change in a round, in units of its covariance, below which a fit has settled
LITTLE = 5e-5  # shift of a step that is the last one of a fit [m]
TUKEY = 3.3  # standard deviations of a point from which it does not count in the end
LAST = 0.018  # residual from which points do not count in fits from the starts [m]
SAME_FIT = 9.0, 0.1  # squared difference of fits in units of their own and of grasps' spread within which they are one
HOPELESS = 60.0, 1.3  # cost above which a fit is not refined, and its part that grows with that of the best one
MOST_FITS, UNLIKELY = 2, 20.0  # fits that are refined, and difference of costs from which the worse one is not
FIRST, REACH = 0.03, 0.02  # residuals from which points at the first step, and contours, do not count [m]
NEGLIGIBLE = 1e-3  # weight below which another minimum does not count
OUTSIDE = (-1e3, 0.0, 1e2)
"""A point of the outline that no image shows [m].

With one the contour resists where it touches what it must not cover. Otherwise steps overshoot there, as only those
pixels count that are covered already, and fits swing to and fro by several pixels.
"""


class HeldFit(NamedTuple):
    """An object in a frame, whose surface is fitted to its pixels.

    Attributes:
        one: The object as it is expected.
        seen: The frame.
        around: Depths around it.
        expected: Its expected pose in the optical frame, shape (4, 4) [m].
        prior: Information before, in the axes of the optical frame, shape (6, 6), or (9, 9) with sizes.
        settings: The settings.
    """

    one: Expected
    seen: CorrectedFrame
    around: Surroundings
    expected: Array
    prior: Array
    settings: HeldSettings

    def from_starts(self, pixels: Pixels) -> list[SurfaceFit]:
        """Return the fits from all starts."""
        few = pixels.at_most(self.settings.first_points)
        return [self._fit(few, start, STEPS[0]) for start in self._starts()]

    def largest_cost(self, points: Array) -> float:
        """Return the cost of a fit to points above which they are of another shape."""
        s, noise = self.settings, self.seen.noise
        outliers = 0.5 / 3.0 * (LAST / (noise * self.expected[2, 3] ** 2 + s.floor)) ** 2  # half of them, by Tukey
        return max(s.most_misfit, float(outliers)) * self.share(points)

    def refined(self, fits: Sequence[SurfaceFit], radius: float) -> tuple[list[SurfaceFit], float]:
        """Return likely fits after more steps, and the number of independent measurements of points.

        Args:
            fits: The fits from the starts.
            radius: Radius of the ball in which points may be the object's [m].
        """
        s, noise = self.settings, self.seen.noise
        last = TUKEY * float(np.hypot(noise * self.expected[2, 3] ** 2, s.floor))
        distinct = _different(fits, self.prior)[:MOST_FITS]
        every, wide = list[Pixels](), list[SurfaceFit]()
        for fit in distinct:
            every.append(self.around.pixels_of(fit, distinct[0].position, radius))
            wide.append(self._settled(every[-1].at_most(s.first_points), fit, LAST))
        least = min(fit.cost for fit in wide)
        found = [
            self._settled(mine.at_most(s.most_points), fit, last)
            for fit, mine in zip(wide, every, strict=True) if fit.cost <= least + UNLIKELY
        ]  # fmt: skip
        return found, self.share(every[0].points)

    def mixture(self, fits: Sequence[SurfaceFit], share: float) -> Mixture | None:
        """Return the best of some fits, with a covariance that the others make larger; None where none found a pose.

        Args:
            fits: The fits.
            share: Number of independent measurements of points.
        """
        best = min(fits, key=lambda fit: fit.cost)
        if not np.isfinite(best.cost):
            return None
        misfit = best.cost / max(share, 1e-9)
        factor = max(1.0, misfit / MISFIT) ** GROWTH  # of the variances of measurements
        n = len(best.information)
        covariance: Array = np.zeros((n, n))
        common: Array = np.zeros((n, 7))
        weights = np.exp(-0.5 * np.array([fit.cost - best.cost for fit in fits]))
        for fit, weight in zip(fits, weights / weights.sum(), strict=True):
            if weight < NEGLIGIBLE:
                continue
            own = np.linalg.inv(self.prior + (fit.information - self.prior) / factor)
            lever = own @ fit.cross / factor
            common = common + weight * lever
            away = np.zeros(n)
            away[:6] = _difference(fit, best)
            camera = lever @ self.seen.registration.covariance @ lever.T
            covariance = covariance + weight * (own + camera + np.outer(away, away))
        return Mixture(best, misfit, covariance, common)

    def share(self, points: Array) -> float:
        """Return the number of independent measurements of points, as pixels share their noise in patches."""
        patch = (self.seen.camera.depth.correlation / self.around.window.stride) ** 2
        return self.settings.point_share * len(points) / max(1.0, patch) / self._inflation

    @property
    def _alone(self) -> bool:
        """Whether the frame is no mean of several."""
        return self.seen.noise == self.seen.camera.depth.noise

    @property
    def _inflation(self) -> float:
        """Factor of the variances of measurements."""
        return self.one.shape.inflation[0 if self._alone else 1]

    def _starts(self) -> list[Array]:
        """Return the poses to start from, in the optical frame: turned about the axis about which grasps vary most."""
        values, vectors = np.linalg.eigh(self.one.covariance[:3, :3])
        axis = self.seen.registration.pose[:3, :3].T @ vectors[:, int(np.argmax(values))]
        starts = []
        for degrees in self.settings.starts:
            start = self.expected.copy()
            start[:3, :3] = pin.exp3(np.radians(degrees) * axis) @ self.expected[:3, :3]
            starts.append(start)
        return starts

    def _settled(self, pixels: Pixels, fit: SurfaceFit, cutoff: float) -> SurfaceFit:
        """Return a fit that goes on from another until it changes by little."""
        for _ in range(ROUNDS):
            before = fit
            fit = self._fit(pixels, fit.pose, STEPS[1], cutoff)
            if _distance(fit, before, before.information) < SETTLED:
                break
        return fit

    def _fit(self, pixels: Pixels, start: Array, steps: int, cutoff: float | None = None) -> SurfaceFit:
        """Return a fit to points and an outline.

        Args:
            pixels: What is fitted to.
            start: Pose to start from in the optical frame, shape (4, 4) [m].
            steps: Number of steps.
            cutoff: Residual from which points do not count [m]; by default one that becomes narrower.
        """
        shape, s, window = self.one.shape, self.settings, self.around.window
        settings = FitSettings(
            noise=self.seen.noise, floor=s.floor, edge=s.edge,
            point_share=pixels.stands_for * self.share(pixels.points) / max(1, len(pixels.points)),
            contour_share=s.contour_share * (ALONE if self._alone else 1.0) * window.stride / self._inflation,
            first=cutoff or FIRST, last=cutoff or LAST, reach=REACH, steps=steps, settled=LITTLE,
        )  # fmt: skip
        return fit_surface(
            np.vstack([pixels.points, OUTSIDE]), pixels.beyond, self.around.lens, shape.surface.vertices,
            shape.surface.faces, shape.ties, shape.symmetry, start, self.expected, self.prior, settings,
            len(pixels.points),
        )  # fmt: skip


class Mixture(NamedTuple):
    """A fit, and others that are nearly as likely.

    Attributes:
        best: The fit.
        misfit: Mean robust squared error of its points over what noise explains.
        covariance: Of turn and shift in the axes of the optical frame, and of logarithms of the scales where they are
            unknown, shape (n, n).
        lever: Their derivatives by turn, shift and scale of the camera's error, shape (n, 7).
    """

    best: SurfaceFit
    misfit: float
    covariance: Array
    lever: Array


def _different(fits: Sequence[SurfaceFit], prior: Array) -> list[SurfaceFit]:
    """Return the fits that are not the same as a better one, nor much worse than the best, the best first."""
    found: list[SurfaceFit] = []
    for fit in sorted(fits, key=lambda one: one.cost):
        if not np.isfinite(fit.cost) or (found and fit.cost > HOPELESS[0] + HOPELESS[1] * found[0].cost):
            break
        if not any(_same(fit, other, prior[:6, :6]) for other in found):
            found.append(fit)
    return found


def _same(fit: SurfaceFit, other: SurfaceFit, prior: Array) -> bool:
    """Whether two fits differ by little of what was measured, or of what grasps vary by."""
    told = _distance(fit, other, other.information[:6, :6] - prior)
    return told < SAME_FIT[0] or _distance(fit, other, prior) < SAME_FIT[1]


def _distance(fit: SurfaceFit, other: SurfaceFit, information: Array) -> float:
    """Return the squared difference of the poses of two fits by an information matrix."""
    off = _difference(fit, other)
    return float(off @ information[:6, :6] @ off)


def _difference(fit: SurfaceFit, other: SurfaceFit) -> Array:
    """Return the turn and the shift from one fit to another, shape (6,) [rad, m]."""
    return np.concatenate([pin.log3(fit.rotation @ other.rotation.T), fit.position - other.position])
