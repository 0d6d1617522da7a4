"""Depth images of triangles, registration of a camera to surfaces that it sees, and fits of surfaces to depth.

A lens is the focal lengths fx, fy and the principal point cx, cy of a pinhole camera, shape (4,) [pixels]. The optical
frame has x to the right, y down and z forward.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from apex_ompl.kernel.compiled.layout import Integers
from apex_ompl.kernel.compiled.perception import rasterizer, registration, surface_fit
from apex_ompl.types import Array

AXIS, BALL = surface_fit.AXIS, surface_fit.BALL
POSE = registration.POSE  # unknowns of a camera: turn, shift, scale of depth


def place_vertices(vertices: Array, part: Integers, poses: Array) -> Array:
    """Return vertices of parts, shape (V, 3), in the frame of the parts' poses, shape (P, 4, 4) [m]."""
    placed = np.empty_like(vertices)
    rasterizer.place_vertices(vertices, part, np.ascontiguousarray(poses), placed)
    return placed


def draw_triangles(vertices: Array, faces: Integers, lens: Array, height: int, width: int) -> tuple[Array, Integers]:
    """Draw the triangles that face a camera.

    Args:
        vertices: In the optical frame, shape (V, 3) [m].
        faces: Corners of triangles, counter-clockwise from outside, shape (F, 3).
        lens: The lens.
        height: Rows [pixels].
        width: Columns [pixels].

    Returns:
        Depths, infinite where there is nothing, shape (height, width) [m], and the triangle seen, or -1, of that shape.
    """
    depth, index = np.full((height, width), np.inf), np.full((height, width), -1, np.int64)
    rasterizer.draw_triangles(np.ascontiguousarray(vertices), faces, lens, depth, index)
    return depth, index


class Drawn(NamedTuple):
    """A surface as a camera is expected to see it.

    Attributes:
        vertices: In the optical frame, shape (V, 3) [m].
        faces: Triangles, shape (F, 3).
        velocities: Derivatives of the vertices by other unknowns, shape (K, V, 3).
        depth: Depths at every ``stride``-th pixel, shape (h, w) [m].
        triangle: Triangle seen there, or -1, shape (h, w).
        lens: Lens of that image.
        stride: Pixels from one to the next.
    """

    vertices: Array
    faces: Integers
    velocities: Array
    depth: Array
    triangle: Integers
    lens: Array
    stride: int


def register_rows(
    measured: Array, drawn: Drawn, unknowns: Array, noise: float, floor: float, gate: float, cutoff: float
) -> tuple[Array, Array, int]:
    """Return the normal equations of a step of the registration of a depth image to a surface.

    Args:
        measured: Depths, shape (height, width) [m].
        drawn: The surface as it is expected.
        unknowns: Turn [rad] and shift [m] of measured points, scale of depth, and others, shape (7 + K,).
        noise: Standard deviation of depth z is ``noise`` z^2 [1/m].
        floor: Standard deviation of the surface [m].
        gate: Largest difference of measured and expected depths [m].
        cutoff: Residual from which points do not count, or 4 standard deviations where that is more [m].

    Returns:
        Matrix, shape (7 + K, 7 + K), right side, shape (7 + K,), and number of pixels that count.
    """
    n = len(unknowns)
    matrix, vector = np.zeros((n, n)), np.zeros(n)
    count = registration.register_rows(
        measured, drawn.depth, drawn.triangle, drawn.vertices, drawn.faces, drawn.velocities, drawn.lens, drawn.stride,
        unknowns, noise, floor, gate, cutoff, matrix, vector, np.empty(n),
    )  # fmt: skip
    return matrix, vector, int(count)


class Window(NamedTuple):
    """A part of an image: every ``stride``-th pixel from a corner on.

    Attributes:
        left: First column [pixels].
        top: First row [pixels].
        width: Number of columns.
        height: Number of rows.
        stride: Pixels from one to the next.
    """

    left: int
    top: int
    width: int
    height: int
    stride: int

    def lens(self, lens: Array) -> Array:
        """Return the lens of the window for that of the image."""
        return np.array([*lens[:2], lens[2] - self.left, lens[3] - self.top]) / self.stride


def select_points(
    measured: Array, robot: Array, near_robot: Array, window: Window, lens: Array, center: Array, radius: float,
    noise: float, slack: float,
) -> tuple[Array, Array]:  # fmt: skip
    """Return the points in a ball that are not the robot's, and the distances of pixels from those that may be covered.

    Args:
        measured: Depths of the whole image, 0 where there is none, shape (height, width) [m].
        robot: Expected depths of the robot in the window, infinite where there is none, shape (h, w) [m].
        near_robot: The same of a robot that is thicker all around.
        window: The window.
        lens: Lens of the image.
        center: Center of the ball in the optical frame, shape (3,) [m].
        radius: Its radius [m].
        noise: Standard deviation of depth z is ``noise`` z^2 [1/m].
        slack: Difference from the robot's depth within which points are the robot's, beside the noise [m].

    Returns:
        Points in the optical frame, shape (N, 3) [m], and distances from the nearest pixel with a point of the ball or
        the robot, without depth, or with something before the ball, shape (h, w) [pixels of the window].
    """
    points, beyond = np.empty((robot.size, 3)), np.empty(robot.shape)
    count = surface_fit.select_points(
        measured, robot, near_robot, window.left, window.top, window.stride, lens, np.ascontiguousarray(center), radius,
        noise, slack, points, beyond,
    )  # fmt: skip
    return points[:count], beyond


@dataclass(frozen=True)
class FitSettings:
    """Weights and limits of a fit.

    Attributes:
        noise: Standard deviation of depth z is ``noise`` z^2 [1/m].
        floor: Standard deviation of the surface [m].
        edge: Standard deviation of the contour [pixels].
        point_share: Independent measurements for each point.
        contour_share: Independent measurements for each pixel of the contour.
        first: Residual from which points do not count at the first step [m].
        last: The same at the end [m].
        reach: The same of the contour [m].
        steps: Number of steps at most.
        settled: Shift, and a tenth of the turn [rad] and of the growth, of a step that is the last one [m].
    """

    noise: float
    floor: float
    edge: float
    point_share: float
    contour_share: float
    first: float
    last: float
    reach: float
    steps: int
    settled: float = 0.0


class SurfaceFit(NamedTuple):
    """The pose that a fit found.

    Attributes:
        cost: Robust sum of squared errors, infinite where there is no estimate.
        rotation: In the optical frame, shape (3, 3).
        position: There, shape (3,) [m].
        scale: Along the axes of the object, shape (3,).
        information: Of turn and shift in the axes of the optical frame [rad, m], and of logarithms of the scales where
            they are unknown, shape (n, n).
        cross: Second derivatives by these, and by turn, shift and scale of the camera's error, shape (n, 7).
        depth: The surface at its pose where ``triangle`` is not negative, shape (h, w) [m].
        triangle: Triangle seen, or -1, shape (h, w).
    """

    cost: float
    rotation: Array
    position: Array
    scale: Array
    information: Array
    cross: Array
    depth: Array
    triangle: Integers

    @property
    def pose(self) -> Array:
        """Pose in the optical frame, shape (4, 4) [m]."""
        found = np.eye(4)
        found[:3, :3], found[:3, 3] = self.rotation, self.position
        return found


def fit_surface(
    points: Array, beyond: Array, lens: Array, vertices: Array, faces: Integers, ties: Integers, symmetry: int,
    start: Array, expected: Array, prior: Array, settings: FitSettings, outline: int | None = None,
    steps: int | None = None,
) -> SurfaceFit:  # fmt: skip
    """Fit the pose of a surface to points and to pixels that it must not cover.

    Args:
        points: Shape (N, 3) [m].
        beyond: Distances of pixels from those that may be covered, shape (h, w) [pixels].
        lens: Lens of that window.
        vertices: In the frame of the object, shape (V, 3) [m].
        faces: Triangles, shape (F, 3).
        ties: Unknown of the scale along each axis, 0 to 2, shape (3,).
        symmetry: ``AXIS`` of a body of revolution about its z, ``BALL``, or 0 for none.
        start: Pose to start from, shape (4, 4) [m].
        expected: Pose expected before, shape (4, 4) [m].
        prior: Information of turn and shift from there in the axes of the optical frame, shape (6, 6), and of the
            logarithms of the scales where these are unknown, shape (9, 9).
        settings: Weights and limits.
        outline: Points from this one on only have to be inside the outline; their depths are guessed.
        steps: Number of steps at most where it is another than that of the settings.
    """
    n = len(prior)
    rotation, position, scale = start[:3, :3].copy(), start[:3, 3].copy(), np.ones(3)
    shape = beyond.shape
    depth, index, matrix, cross = np.empty(shape), np.empty(shape, np.int64), np.empty((n, n)), np.empty((n, POSE))
    s, most = settings, settings.steps if steps is None else steps
    numbers = s.noise, s.floor, s.edge, s.point_share, s.contour_share, s.first, s.last, s.reach, s.settled
    cost = surface_fit.fit_surface(
        np.ascontiguousarray(points), len(points) if outline is None else outline, beyond, lens, vertices, faces,
        ties, symmetry, rotation, position, scale,
        expected[:3, :3].copy(), expected[:3, 3].copy(), prior, tuple(map(float, numbers)), most,
        np.empty_like(vertices), depth, index, matrix, np.empty((n, n)), np.empty(n), cross, np.empty(n),
        np.empty(POSE),
    )  # fmt: skip
    return SurfaceFit(float(cost), rotation, position, scale, matrix, cross, depth, index)
