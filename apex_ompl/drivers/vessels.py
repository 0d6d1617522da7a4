"""Vessels: held meshes with a cavity, and a liquid of balls in them."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice

import coal
import numpy as np

from apex_ompl.collision.shapes import coal_geometry, is_shell
from apex_ompl.scene.bodies import AttachedObject, pose_fields
from apex_ompl.scene.constraints import Upright
from apex_ompl.scene.meshes import triangles
from apex_ompl.scene.problem import Problem
from apex_ompl.types import Array, Flags
from apex_ompl.util.arrays import length

BALL_RADIUS = 0.006  # of the balls of a liquid [m]
BALLS = 20  # in a vessel
BALL_DENSITY = 1500.0  # [kg/m^3]
GAP = 0.001  # between balls, and to walls, at first [m]
SIDES = 8  # directions in which a wall must be


class Vessel:
    """The cavity of a held object, which opens along the axis of its contact face.

    Attributes:
        name: Name of the object.
        axis: Unit direction out of the opening in the frame of the object, shape (3,).
    """

    def __init__(self, held: AttachedObject) -> None:
        """Read the mesh of an object with a contact face."""
        assert held.contact is not None
        self.name, axis = held.name, np.asarray(held.contact.axis, float)
        self.axis = axis / length(axis)
        self._geometry = coal_geometry(held)
        vertices, faces = triangles(self._geometry)
        self._corners = vertices[faces]
        other = np.eye(3)[int(np.argmin(np.abs(self.axis)))]
        across = np.cross(self.axis, other)
        across /= length(across)
        turns = 2.0 * np.pi * (np.arange(SIDES) + 0.5) / SIDES  # between the edges of meshes of revolution
        both = np.stack([across, np.cross(self.axis, across)])
        self._across = both
        self._walls = np.stack([np.cos(turns), np.sin(turns)], axis=1) @ both

    def contains(self, points: Array) -> Flags:
        """Return whether points are in the cavity: below them and on all sides is a wall, and above them none.

        Args:
            points: In the frame of the object, shape (N, 3) [m].
        """
        inside = ~self._hit(points, self.axis)
        for direction in (-self.axis, *self._walls):
            inside[inside] = self._hit(points[inside], direction)
        return np.asarray(inside)

    def places(self, radius: float, count: int) -> Array:
        """Return the lowest centers of balls in the cavity that do not touch, at most ``count``, shape (N, 3) [m]."""
        low, high = self._corners.min(axis=(0, 1)), self._corners.max(axis=(0, 1))
        size, middle = float(np.linalg.norm(high - low)), (low + high) / 2.0
        step = 2.0 * radius + GAP
        line = step * np.arange(-int(size / step / 2), int(size / step / 2) + 1)
        grid = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)
        points = middle + grid @ np.stack([*self._across, self.axis])
        points = points[((points > low + radius) & (points < high - radius)).all(axis=1)]
        points = points[np.argsort(points @ self.axis, kind="stable")]
        clear = (point for point in points[self.contains(points)] if self._clearance(point) >= radius + GAP)
        return np.array(list(islice(clear, count))).reshape(-1, 3)

    def _hit(self, points: Array, direction: Array) -> Flags:
        """Return whether rays from points meet the mesh (Moeller and Trumbore 1997)."""
        a, b, c = np.moveaxis(self._corners, 1, 0)
        first, second = b - a, c - a
        normal = np.cross(np.broadcast_to(direction, second.shape), second)
        scale = np.einsum("ti,ti->t", first, normal)
        usable = np.abs(scale) > 1e-14
        inverse = np.where(usable, 1.0 / np.where(usable, scale, 1.0), 0.0)
        away = points[:, None] - a
        u = np.einsum("nti,ti->nt", away, normal) * inverse
        other = np.cross(away, first)
        v = (other @ direction) * inverse
        distance = np.einsum("nti,ti->nt", other, second) * inverse
        hit = usable & (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (distance > 0.0)
        return np.asarray(hit.any(axis=1))

    def _clearance(self, point: Array) -> float:
        result, ball = coal.DistanceResult(), coal.Sphere(1e-6)
        place = coal.Transform3s(np.eye(3), point)
        return float(
            coal.distance(ball, place, self._geometry, coal.Transform3s(), coal.DistanceRequest(), result)
        )  # fmt: skip


def vessels(problem: Problem) -> Iterator[Vessel]:
    """Yield the held objects of a problem that have a cavity."""
    for held in problem.attached:
        if held.contact is not None and held.mesh is not None and is_shell(coal_geometry(held)):
            vessel = Vessel(held)
            if len(vessel.places(BALL_RADIUS, 1)):
                yield vessel


def filled(problem: Problem) -> tuple[str, ...]:
    """Return the names of vessels that are full: those that stay upright, and what is poured from."""
    upright = {one.frame for one in problem.constraints if isinstance(one, Upright)}
    goal = problem.goal.alignment
    if goal is not None and goal.kind == "pour" and isinstance(goal.first, str):
        upright.add(goal.first)
    return tuple(vessel.name for vessel in vessels(problem) if vessel.name in upright)


def liquid(problem: Problem) -> tuple[AttachedObject, ...]:
    """Return the balls in the vessels that are full, named ``VESSEL/1`` and so on."""
    full, found = filled(problem), []
    held = {one.name: one for one in problem.attached}
    for vessel in vessels(problem):
        if vessel.name not in full:
            continue
        one = held[vessel.name]
        mass = 4.0 / 3.0 * np.pi * BALL_RADIUS**3 * BALL_DENSITY
        for k, point in enumerate(vessel.places(BALL_RADIUS, BALLS), 1):
            pose = one.pose.copy()
            pose[:3, 3] = one.pose[:3, :3] @ point + one.pose[:3, 3]
            ball = {"name": f"{one.name}/{k}", "sphere": {"radius": BALL_RADIUS}, "link": one.link, "touch_links": ()}
            found.append(AttachedObject.model_validate({**ball, "mass": mass, **pose_fields(pose)}))
    return tuple(found)
