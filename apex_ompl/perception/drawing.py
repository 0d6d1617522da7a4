"""What was seen, drawn into the picture of the camera: outlines of objects and obstacles, contact faces, names."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from apex_ompl.kernel.perception import draw_triangles
from apex_ompl.perception.alignment import SeenTask
from apex_ompl.perception.camera import Camera
from apex_ompl.perception.frames import Frame
from apex_ompl.perception.library import opencv
from apex_ompl.perception.obstacles import SeenObstacle
from apex_ompl.perception.rendering import lens_of
from apex_ompl.perception.sight import Sight
from apex_ompl.perception.surfaces import Surface, body_surface, inverse
from apex_ompl.types import Array

OBJECT, UNSURE, OBSTACLE, MARGIN = (0, 160, 0), (230, 150, 0), (230, 0, 0), (255, 140, 140)  # colors, RGB
ARROW = 0.06  # length of the axis of a contact face [m]
FARTHEST = 3.0  # that is drawn in black where there are no colors [m]
DEVIATIONS = 2.0  # of the outline of an obstacle's margin


def picture_of(sight: Sight) -> NDArray[np.uint8]:
    """Return the color images, or depths in gray, side by side with what was found, shape (height, width, 3).

    Objects that were not found are drawn in orange where their grasps have them. The outer outline of an obstacle has
    lengths larger by two standard deviations.

    Raises:
        MissingFileError: The extra ``perception`` is not installed.
    """
    images = [_drawn(sight.task, frame, pose) for frame, pose in zip(sight.frames, sight.cameras, strict=True)]
    height = max(len(image) for image in images)
    padded = [np.pad(image, ((0, height - len(image)), (0, 0), (0, 0))) for image in images]
    return np.concatenate(padded, axis=1)


def _drawn(task: SeenTask, frame: Frame, pose: Array) -> NDArray[np.uint8]:
    """Return the image of a frame whose optical frame has a pose, shape (4, 4) [m], with what was found."""
    cv, to_camera = opencv(), inverse(pose)
    if frame.color is not None:
        image = np.array(frame.color)
    else:
        gray = np.where(frame.depth > 0.0, 255.0 * (1.0 - frame.depth / FARTHEST).clip(0.0, 1.0), 0.0)
        image = np.repeat(gray.astype(np.uint8)[..., None], 3, axis=2)
    for seen in task.seen:
        _outline(cv, image, _surface(seen, to_camera, DEVIATIONS), frame.camera, MARGIN)
        corner = _outline(cv, image, _surface(seen, to_camera, 0.0), frame.camera, OBSTACLE)
        _write(cv, image, corner, f"{seen.kind} {'x'.join(f'{100.0 * v:.0f}' for v in seen.size)} cm", OBSTACLE)
    for held in task.held:
        color = UNSURE if held.reason else OBJECT
        surface = body_surface(held.body)
        scaled = Surface(surface.vertices * held.scale, surface.faces).at(to_camera @ held.pose)
        _write(cv, image, _outline(cv, image, scaled, frame.camera, color), held.name, color)
        if held.body.contact is not None:
            ends = np.stack([held.face, held.face + ARROW * held.axis])
            _arrow(cv, image, ends @ to_camera[:3, :3].T + to_camera[:3, 3], frame.camera, color)
    return image


def _surface(seen: SeenObstacle, to_camera: Array, deviations: float) -> Surface:
    """Return the surface of an obstacle in the optical frame, larger by a number of standard deviations."""
    grown = seen.obstacle("seen", deviations)
    return body_surface(grown).at(to_camera @ grown.pose)


def _outline(
    cv: Any, image: NDArray[np.uint8], surface: Surface, camera: Camera, color: tuple[int, int, int]
) -> tuple[int, int] | None:
    """Draw the outline of a surface in the optical frame; return its upper left corner, None where it is not seen."""
    depth, _ = draw_triangles(surface.vertices, surface.faces, lens_of(camera), camera.height, camera.width)
    mask = np.isfinite(depth)
    if not mask.any():
        return None
    contours, _ = cv.findContours(mask.astype(np.uint8), cv.RETR_EXTERNAL, cv.CHAIN_APPROX_NONE)
    for contour in contours:
        flat = (contour.reshape(-1, 2) - camera.center) / camera.focal
        pixels = camera.project(np.column_stack([flat, np.ones(len(flat))]))  # with its distortion
        cv.polylines(image, [np.round(pixels).astype(np.int32)], isClosed=True, color=color, lineType=cv.LINE_AA)
    rows, columns = np.nonzero(mask)
    return int(columns.min()), int(rows.min())


def _write(
    cv: Any, image: NDArray[np.uint8], corner: tuple[int, int] | None, text: str, color: tuple[int, int, int]
) -> None:
    if corner is not None:
        place = corner[0], max(12, corner[1] - 4)
        cv.putText(image, text, place, cv.FONT_HERSHEY_SIMPLEX, 0.4, color, 1, cv.LINE_AA)


def _arrow(cv: Any, image: NDArray[np.uint8], ends: Array, camera: Camera, color: tuple[int, int, int]) -> None:
    pixels = camera.project(ends)
    if np.isfinite(pixels).all():
        tail, tip = np.round(pixels).astype(int).tolist()
        cv.arrowedLine(image, tail, tip, color, 2, cv.LINE_AA, tipLength=0.25)


def png_of(image: NDArray[np.uint8]) -> bytes:
    """Return an image, shape (height, width, 3), as PNG."""
    cv = opencv()
    return bytes(cv.imencode(".png", np.ascontiguousarray(image[..., ::-1]))[1].tobytes())
