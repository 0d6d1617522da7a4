"""Registration of a depth image to the predicted surface of the robot: the normal equations of one step."""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.compilation import entry_point, inlined
from apex_ompl.kernel.compiled.layout import Floats, Integers

POSE = 7  # unknowns of the camera: turn, shift, scale of depth


@inlined
def unit_normal(vertices: Floats, a: int, b: int, c: int) -> tuple[float, float, float]:
    """Return the unit normal of a triangle, given by numbers of its corners."""
    ax, ay, az = vertices[a, 0], vertices[a, 1], vertices[a, 2]
    ex, ey, ez = vertices[b, 0] - ax, vertices[b, 1] - ay, vertices[b, 2] - az
    fx, fy, fz = vertices[c, 0] - ax, vertices[c, 1] - ay, vertices[c, 2] - az
    nx, ny, nz = ey * fz - ez * fy, ez * fx - ex * fz, ex * fy - ey * fx
    norm = math.sqrt(nx * nx + ny * ny + nz * nz)
    return nx / norm, ny / norm, nz / norm


@entry_point
def register_rows(
    measured: Floats, predicted: Floats, index: Integers, vertices: Floats, faces: Integers, velocities: Floats,
    lens: Floats, stride: int, unknowns: Floats, noise: float, floor: float, gate: float, cutoff: float,
    matrix: Floats, vector: Floats, row: Floats,
) -> int:  # fmt: skip
    """Add the normal equations of point-to-plane residuals r = n . (p + w x p + t + s p - q) to a matrix and a vector.

    Residuals have Tukey's weight (Beaton, Tukey 1974) over their variance.

    Args:
        measured: Depths of the whole image, shape (height, width) [m].
        predicted: Depths of the robot at every ``stride``-th pixel, shape (h, w) [m].
        index: Triangle seen there, or -1, shape (h, w).
        vertices: In the optical frame, shape (V, 3) [m].
        faces: Triangles, shape (F, 3).
        velocities: Derivatives of the vertices by other unknowns, such as joint offsets, shape (K, V, 3).
        lens: Of the predicted image, shape (4,) [pixels].
        stride: Pixels from one to the next.
        unknowns: Turn [rad], shift [m], scale and others, at which residuals are taken, shape (7 + K,).
        noise: Standard deviation of depth z is ``noise`` z^2 [1/m].
        floor: Standard deviation of the surface [m].
        gate: Largest difference of measured and predicted depths [m].
        cutoff: Residual from which points do not count, or 4 standard deviations where that is more [m].
        matrix: Shape (7 + K, 7 + K).
        vector: Shape (7 + K,).
        row: Room, shape (7 + K,).

    Returns:
        Number of pixels that count.
    """
    count, n = 0, len(unknowns)
    for i in range(1, predicted.shape[0] - 1):
        for j in range(1, predicted.shape[1] - 1):
            k = index[i, j]
            if k < 0:
                continue
            z = measured[i * stride, j * stride]
            if not (z > 0.0 and abs(z - predicted[i, j]) < gate):
                continue
            a, b, c = faces[k, 0], faces[k, 1], faces[k, 2]
            nx, ny, nz = unit_normal(vertices, a, b, c)
            x, y = (j - lens[2]) / lens[0] * z, (i - lens[3]) / lens[1] * z
            along = nx * x + ny * y + nz * z
            cosine = -along / math.sqrt(x * x + y * y + z * z)
            if cosine < 0.3:  # grazing
                continue
            row[0], row[1], row[2] = y * nz - z * ny, z * nx - x * nz, x * ny - y * nx
            row[3], row[4], row[5], row[6] = nx, ny, nz, along
            for m in range(POSE, n):
                o = m - POSE
                sx = velocities[o, a, 0] + velocities[o, b, 0] + velocities[o, c, 0]
                sy = velocities[o, a, 1] + velocities[o, b, 1] + velocities[o, c, 1]
                sz = velocities[o, a, 2] + velocities[o, b, 2] + velocities[o, c, 2]
                row[m] = -(nx * sx + ny * sy + nz * sz) / 3.0
            residual = along - nx * vertices[a, 0] - ny * vertices[a, 1] - nz * vertices[a, 2]
            for m in range(n):
                residual += row[m] * unknowns[m]
            spread = noise * z * z * cosine
            variance = spread * spread + floor * floor
            limit = max(cutoff, 4.0 * math.sqrt(variance))
            share = residual / limit
            if abs(share) >= 1.0:
                continue
            count += 1
            weight = (1.0 - share * share) * (1.0 - share * share) / variance
            for m in range(n):
                if row[m] != 0.0:
                    vector[m] -= weight * residual * row[m]
                    for o in range(n):
                        matrix[m, o] += weight * row[m] * row[o]
    return count
