"""Depth images of triangles, drawn by a z-buffer with homogeneous edge functions, which need no clipping.

A ray d = (x, y, 1) through a pixel meets the triangle a, b, c where d . (b x c), d . (c x a) and d . (a x b) have the
sign of det(a, b, c), at the depth det(a, b, c) / (the sum of the three) (Olano, Greer: Triangle scan conversion using
2D homogeneous coordinates, 1997).
"""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.compilation import entry_point, inlined
from apex_ompl.kernel.compiled.layout import Floats, Integers

NEAR = 0.02  # depth below which nothing is drawn [m]
NARROW = 6  # columns up to which all pixels of a row are tested
EDGE_ON = 1e-15  # determinant of a triangle seen from its edge [m^3]


@entry_point
def place_vertices(vertices: Floats, part: Integers, poses: Floats, placed: Floats) -> None:
    """Put vertices of parts into the frame of the parts' poses.

    Args:
        vertices: Shape (V, 3) [m].
        part: Part of each vertex, shape (V,).
        poses: Poses of the parts, shape (P, 4, 4) [m].
        placed: Gets the vertices, shape (V, 3) [m].
    """
    for k in range(len(vertices)):
        i = part[k]
        x, y, z = vertices[k, 0], vertices[k, 1], vertices[k, 2]
        for r in range(3):
            placed[k, r] = poses[i, r, 0] * x + poses[i, r, 1] * y + poses[i, r, 2] * z + poses[i, r, 3]


@inlined
def _inside(slope: float, offset: float, fx: float, cx: float, start: int, end: int) -> tuple[int, int]:
    """Return the columns, and one beside them, where slope (column - cx) / fx + offset is not positive."""
    if slope == 0.0:
        return start, end
    border = min(max(cx - fx * offset / slope, start - 1.0), end + 1.0)
    if slope > 0.0:
        return start, min(end, int(math.floor(border)) + 1)
    return max(start, int(math.ceil(border)) - 1), end


@inlined
def draw(vertices: Floats, faces: Integers, lens: Floats, depth: Floats, index: Integers) -> None:
    """Draw triangles, see :func:`draw_triangles`."""
    height, width = depth.shape
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    across = 1.0 / fx
    for k in range(len(faces)):
        a, b, c = faces[k, 0], faces[k, 1], faces[k, 2]
        ax, ay, az = vertices[a, 0], vertices[a, 1], vertices[a, 2]
        bx, by, bz = vertices[b, 0], vertices[b, 1], vertices[b, 2]
        cx_, cy_, cz = vertices[c, 0], vertices[c, 1], vertices[c, 2]
        if max(az, bz, cz) <= NEAR:
            continue
        ux, uy, uz = by * cz - bz * cy_, bz * cx_ - bx * cz, bx * cy_ - by * cx_
        det = ax * ux + ay * uy + az * uz
        if not det < -EDGE_ON:  # seen from behind, from the edge, or not finite
            continue
        vx, vy, vz = cy_ * az - cz * ay, cz * ax - cx_ * az, cx_ * ay - cy_ * ax
        wx, wy, wz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        left, right, top, bottom = 0, width - 1, 0, height - 1
        if min(az, bz, cz) > NEAR:
            pa, pb, pc = fx * ax / az, fx * bx / bz, fx * cx_ / cz
            qa, qb, qc = fy * ay / az, fy * by / bz, fy * cy_ / cz
            low, high = min(pa, pb, pc) + cx, max(pa, pb, pc) + cx
            if high < 0.0 or low > width - 1:
                continue
            left, right = max(0, math.ceil(low)), min(width - 1, math.floor(high))
            low, high = min(qa, qb, qc) + cy, max(qa, qb, qc) + cy
            if high < 0.0 or low > height - 1:
                continue
            top, bottom = max(0, math.ceil(low)), min(height - 1, math.floor(high))
        for row in range(top, bottom + 1):
            y = (row - cy) / fy
            us, vs, ws = uy * y + uz, vy * y + vz, wy * y + wz
            start, end = left, right
            if right - left > NARROW:
                start, end = _inside(ux, us, fx, cx, start, end)
                start, end = _inside(vx, vs, fx, cx, start, end)
                start, end = _inside(wx, ws, fx, cx, start, end)
            for column in range(start, end + 1):
                x = (column - cx) * across
                u, v, w = ux * x + us, vx * x + vs, wx * x + ws
                if u <= 0.0 and v <= 0.0 and w <= 0.0:
                    z = det / (u + v + w)
                    if z > NEAR and (index[row, column] < 0 or z < depth[row, column]):
                        depth[row, column] = z
                        index[row, column] = k


@entry_point
def draw_triangles(vertices: Floats, faces: Integers, lens: Floats, depth: Floats, index: Integers) -> None:
    """Draw the triangles that face a camera into a depth image.

    Args:
        vertices: In the optical frame, shape (V, 3) [m].
        faces: Corners of triangles, counter-clockwise from outside, shape (F, 3).
        lens: Focal lengths and principal point, shape (4,) [pixels].
        depth: Depths, which are replaced where a triangle is nearer, shape (height, width) [m].
        index: Triangle seen at each pixel, -1 for none, whose depth is not read, shape (height, width).
    """
    draw(vertices, faces, lens, depth, index)
