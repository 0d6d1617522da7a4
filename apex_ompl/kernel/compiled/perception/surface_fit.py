"""Fit of a surface to depth: points that a hand's object may have, the silhouette, and Gauss-Newton steps.

At each step the surface is drawn at its pose. A measured point belongs to the triangle that is seen at its pixel, or
to the nearest one that is seen beside it, so that a thin wall never takes the points of its other side. The contour of
the drawing must not reach beyond the pixels that the object may cover (``beyond``). Unknowns are a turn w and a shift t
of the surface, x -> x + t + w x (x - origin), in the axes of the optical frame, and logarithms of its scales.
"""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.compilation import entry_point, inlined, outlined
from apex_ompl.kernel.compiled.geometry.triangles import closest_shares
from apex_ompl.kernel.compiled.layout import Floats, Integers
from apex_ompl.kernel.compiled.perception.rasterizer import draw
from apex_ompl.kernel.compiled.perception.registration import unit_normal

CAMERA = 7  # turn, shift, scale of depth
AXIS, BALL = 1, 2  # symmetries: of a body of revolution about its z, and of a ball
REACH = 8  # pixels beside a drawing within which points belong to it
DIAGONAL = math.sqrt(2.0)
LARGEST_TURN = 0.3  # of a step [rad]
LARGEST_GROWTH = 0.15  # of the logarithm of a length in a step
SETTLED_TURN = 10.0  # turn, and logarithm of a length, for each meter of the shift that is the last step's [1/m]


@entry_point
def select_points(
    measured: Floats, robot: Floats, near_robot: Floats, left: int, top: int, stride: int, lens: Floats,
    center: Floats, radius: float, noise: float, slack: float, points: Floats, beyond: Floats,
) -> int:  # fmt: skip
    """Put the points of a ball that are not the robot's into place, and the distances of pixels from the covered ones.

    An object may cover pixels with a point of the ball or of the robot, without depth, or with a surface before
    the ball.

    Args:
        measured: Depths of the whole image, shape (height, width) [m].
        robot: Depths of the robot in a window, infinite where there is none, shape (h, w) [m].
        near_robot: The same of a robot that is thicker all around.
        left: First column of the window [pixels].
        top: First row of the window [pixels].
        stride: Pixels from one of the window to the next.
        lens: Of the whole image, shape (4,) [pixels].
        center: Center of the ball in the optical frame, shape (3,) [m].
        radius: Its radius [m].
        noise: Standard deviation of depth z is ``noise`` z^2 [1/m].
        slack: Difference from the robot's depth within which points are the robot's, beside the noise [m].
        points: Gets the points, shape (h w, 3) [m].
        beyond: Gets the distances of pixels from the nearest that the object may cover, shape (h, w) [window pixels].

    Returns:
        Number of points.
    """
    height, width = robot.shape
    n, front = 0, center[2] - radius
    for i in range(height):
        for j in range(width):
            z = measured[top + i * stride, left + j * stride]
            beyond[i, j] = 0.0
            if not z > 0.0:
                continue
            allowed = slack + noise * z * z
            if near_robot[i, j] - allowed < z < robot[i, j] + allowed or abs(z - near_robot[i, j]) < allowed:
                continue
            x, y = (left + j * stride - lens[2]) / lens[0] * z, (top + i * stride - lens[3]) / lens[1] * z
            ex, ey, ez = x - center[0], y - center[1], z - center[2]
            if ex * ex + ey * ey + ez * ez > radius * radius:
                if z >= front:
                    beyond[i, j] = math.inf
                continue
            points[n, 0], points[n, 1], points[n, 2] = x, y, z
            n += 1
    _chamfer(beyond)
    return n


@inlined
def _chamfer(distance: Floats) -> None:
    """Put the distances from the nearest zero into place (two passes; Borgefors 1986)."""
    height, width = distance.shape
    for i in range(height):
        for j in range(width):
            best = distance[i, j]
            if i > 0:
                best = min(best, distance[i - 1, j] + 1.0)
                if j > 0:
                    best = min(best, distance[i - 1, j - 1] + DIAGONAL)
                if j < width - 1:
                    best = min(best, distance[i - 1, j + 1] + DIAGONAL)
            if j > 0:
                best = min(best, distance[i, j - 1] + 1.0)
            distance[i, j] = best
    for i in range(height - 1, -1, -1):
        for j in range(width - 1, -1, -1):
            best = distance[i, j]
            if i < height - 1:
                best = min(best, distance[i + 1, j] + 1.0)
                if j > 0:
                    best = min(best, distance[i + 1, j - 1] + DIAGONAL)
                if j < width - 1:
                    best = min(best, distance[i + 1, j + 1] + DIAGONAL)
            if j < width - 1:
                best = min(best, distance[i, j + 1] + 1.0)
            distance[i, j] = best


@inlined
def _seen_beside(index: Integers, row: int, column: int) -> tuple[int, int, float]:
    """Return row and column of the drawn pixel nearest to a pixel, -1 for none within ``REACH``, and its distance."""
    height, width = index.shape
    best, line, place = REACH * REACH + 1, -1, -1
    for r in range(REACH + 1):
        if r * r >= best:
            break
        for side in range(4):
            for o in range(-r, r + 1):
                i = row + (-r if side == 0 else r if side == 1 else o)
                j = column + (o if side < 2 else -r if side == 2 else r)
                if 0 <= i < height and 0 <= j < width and index[i, j] >= 0:
                    apart = (i - row) * (i - row) + (j - column) * (j - column)
                    if apart < best:
                        best, line, place = apart, i, j
    return line, place, math.sqrt(best)


@inlined
def _closest(placed: Floats, a: int, b: int, c: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return the point of a triangle that is closest to a point."""
    ax, ay, az = placed[a, 0], placed[a, 1], placed[a, 2]
    ux, uy, uz = placed[b, 0] - ax, placed[b, 1] - ay, placed[b, 2] - az
    vx, vy, vz = placed[c, 0] - ax, placed[c, 1] - ay, placed[c, 2] - az
    s, r = closest_shares(ux, uy, uz, vx, vy, vz, x - ax, y - ay, z - az)
    return ax + s * ux + r * vx, ay + s * uy + r * vy, az + s * uz + r * vz


@inlined
def _add(
    matrix: Floats, vector: Floats, cross: Floats, row: Floats, camera: Floats, weight: float, r: float, final: bool
) -> None:  # fmt: skip
    """Add a residual with its derivatives by unknowns to the normal equations, whose matrix gets its lower half.

    Those by the camera are added at the ``final`` step only.
    """
    for k in range(len(vector)):
        if row[k] == 0.0:
            continue
        scaled = weight * row[k]
        vector[k] -= scaled * r
        for m in range(k + 1):
            matrix[k, m] += scaled * row[m]
        if final:
            for m in range(CAMERA):
                cross[k, m] += scaled * camera[m]


@inlined
def _surface_row(
    row: Floats, rotation: Floats, position: Floats, ties: Integers, symmetry: int, x: float, y: float, z: float,
    gx: float, gy: float, gz: float,
) -> None:  # fmt: skip
    """Set the derivatives of a residual whose derivative by the surface point (x, y, z) is g.

    Turns that leave the body as it is have none, though the facets of a round surface would give some.
    """
    ex, ey, ez = x - position[0], y - position[1], z - position[2]
    row[0], row[1], row[2] = ey * gz - ez * gy, ez * gx - ex * gz, ex * gy - ey * gx
    if symmetry == AXIS:
        about = row[0] * rotation[0, 2] + row[1] * rotation[1, 2] + row[2] * rotation[2, 2]
        for k in range(3):
            row[k] -= about * rotation[k, 2]
    elif symmetry == BALL:
        row[0], row[1], row[2] = 0.0, 0.0, 0.0
    row[3], row[4], row[5] = gx, gy, gz
    if len(row) > 6:
        row[6], row[7], row[8] = 0.0, 0.0, 0.0
        for k in range(3):
            own = rotation[0, k] * ex + rotation[1, k] * ey + rotation[2, k] * ez
            row[6 + ties[k]] += own * (rotation[0, k] * gx + rotation[1, k] * gy + rotation[2, k] * gz)


@outlined
def _solve(matrix: Floats, vector: Floats) -> bool:
    """Solve a positive definite system in place by Cholesky's factors; False where it is none."""
    n = len(vector)
    for k in range(n):
        for m in range(k + 1):
            total = matrix[k, m]
            for o in range(m):
                total -= matrix[k, o] * matrix[m, o]
            if k > m:
                matrix[k, m] = total / matrix[m, m]
            elif total > 0.0:
                matrix[k, k] = math.sqrt(total)
            else:
                return False
    for k in range(n):
        for m in range(k):
            vector[k] -= matrix[k, m] * vector[m]
        vector[k] /= matrix[k, k]
    for k in range(n - 1, -1, -1):
        for m in range(k + 1, n):
            vector[k] -= matrix[m, k] * vector[m]
        vector[k] /= matrix[k, k]
    return True


@inlined
def _turn(rotation: Floats, x: float, y: float, z: float) -> None:
    """Turn a rotation by a rotation vector, by Rodrigues' formula, in place."""
    angle = math.sqrt(x * x + y * y + z * z)
    s = math.sin(angle) / angle if angle > 1e-9 else 1.0
    c = (1.0 - math.cos(angle)) / (angle * angle) if angle > 1e-9 else 0.5
    for k in range(3):
        ax, ay, az = rotation[0, k], rotation[1, k], rotation[2, k]
        bx, by, bz = y * az - z * ay, z * ax - x * az, x * ay - y * ax
        rotation[0, k] = ax + s * bx + c * (y * bz - z * by)
        rotation[1, k] = ay + s * by + c * (z * bx - x * bz)
        rotation[2, k] = az + s * bz + c * (x * by - y * bx)


@inlined
def _robust(residual: float, limit: float) -> tuple[float, float]:
    """Return Tukey's weight of a residual, and its cost over the square of the limit (Beaton, Tukey 1974)."""
    share = residual / limit
    rest = 1.0 - share * share
    return (rest * rest, (1.0 - rest * rest * rest) / 3.0) if rest > 0.0 else (0.0, 1.0 / 3.0)


@entry_point
def fit_surface(
    points: Floats, outline: int, beyond: Floats, lens: Floats, vertices: Floats, faces: Integers, ties: Integers,
    symmetry: int, rotation: Floats, position: Floats, scale: Floats, prior_rotation: Floats, prior_position: Floats,
    prior: Floats,
    settings: tuple[float, float, float, float, float, float, float, float, float], steps: int,
    placed: Floats, depth: Floats, index: Integers, matrix: Floats, factor: Floats, vector: Floats, cross: Floats,
    row: Floats, camera: Floats,
) -> float:  # fmt: skip
    """Fit pose and scales of a surface, and return its cost, infinite where it ends at no estimate.

    Args:
        points: Measured points in the optical frame, shape (N, 3) [m].
        outline: Points from this one on have the object's color but a depth that is guessed: they have to be inside the
            outline.
        beyond: Distances of pixels from what the object may cover, shape (h, w) [pixels].
        lens: Focal lengths and principal point of that window, shape (4,) [pixels].
        vertices: In the frame of the object, shape (V, 3) [m].
        faces: Triangles, shape (F, 3).
        ties: Unknown of the scale along each axis, 0 to 2, shape (3,).
        symmetry: ``AXIS``, ``BALL``, or 0 for none.
        rotation: Rotation of the object in the optical frame, at the start and at the end, shape (3, 3).
        position: Its origin there, shape (3,) [m].
        scale: Its scales, shape (3,).
        prior_rotation: Expected rotation, shape (3, 3).
        prior_position: Expected origin, shape (3,) [m].
        prior: Information of turn and shift from there, and of logarithms of the scales, shape (n, n); scales are
            unknown where n is 9, and known where it is 6.
        settings: Noise of depth z over z^2 [1/m], error of surfaces [m], error of the contour [pixels], information of
            a point and of a pixel of the contour, largest residual at the start and in the end [m], that of the
            contour [m], and shift of a step that is the last [m].
        steps: Number of steps at most.
        placed: Room, shape (V, 3).
        depth: Room, shape (h, w); has the surface at its pose in the end [m].
        index: Room, shape (h, w); has the triangles seen, or -1.
        matrix: Gets the information of all unknowns, shape (n, n).
        factor: Room, shape (n, n).
        vector: Room, shape (n,).
        cross: Gets the second derivatives by unknowns and the camera's turn, shift and scale, shape (n, 7).
        row: Room, shape (n,).
        camera: Room, shape (7,).
    """
    cost = math.inf
    first, last = settings[5], settings[6]
    settled = False
    for step in range(steps + 1):
        final = settled or step == steps
        _place(vertices, rotation, position, scale, placed)
        for i in range(index.shape[0]):
            for j in range(index.shape[1]):
                index[i, j] = -1
        draw(placed, faces, lens, depth, index)
        _copy(prior, matrix)
        for k in range(len(vector)):
            vector[k] = 0.0
            for m in range(CAMERA):
                cross[k, m] = 0.0
        cutoff = last if final else max(last, first * 0.7**step)
        cost = _add_points(
            points, outline, lens, faces, ties, symmetry, rotation, position, settings, cutoff, placed, depth, index,
            matrix, vector, cross, row, camera, final,
        )  # fmt: skip
        cost += _add_contour(
            beyond, outline < len(points), lens, ties, symmetry, rotation, position, settings, depth, index, matrix,
            vector, cross, row, camera, final,
        )  # fmt: skip
        cost += _add_prior(matrix, vector, prior, rotation, position, scale, ties, prior_rotation, prior_position, row)
        if final:
            for k in range(len(vector)):
                for m in range(k):
                    matrix[m, k] = matrix[k, m]
            break
        _copy(matrix, factor)
        if not _solve(factor, vector):
            return math.inf
        _move(vector, rotation, position, scale, ties)
        settled = cutoff == last and _settled(vector, settings[8])
    return cost


@inlined
def _settled(step: Floats, shift: float) -> bool:
    """Return whether a step is below that which is the last one's [m]."""
    for k in range(len(step)):
        if not abs(step[k]) < (shift if 3 <= k < 6 else SETTLED_TURN * shift):
            return False
    return True


@inlined
def _copy(source: Floats, target: Floats) -> None:
    """Copy a matrix."""
    for k in range(source.shape[0]):
        for m in range(source.shape[1]):
            target[k, m] = source[k, m]


@inlined
def _place(vertices: Floats, rotation: Floats, position: Floats, scale: Floats, placed: Floats) -> None:
    """Put the vertices of the scaled surface into the optical frame."""
    for k in range(len(vertices)):
        x, y, z = scale[0] * vertices[k, 0], scale[1] * vertices[k, 1], scale[2] * vertices[k, 2]
        for r in range(3):
            placed[k, r] = rotation[r, 0] * x + rotation[r, 1] * y + rotation[r, 2] * z + position[r]


@inlined
def _move(step: Floats, rotation: Floats, position: Floats, scale: Floats, ties: Integers) -> None:
    """Take a step, or the part of it that turns and grows by no more than is allowed."""
    n = len(step)
    angle = math.sqrt(step[0] * step[0] + step[1] * step[1] + step[2] * step[2])
    length = min(1.0, LARGEST_TURN / max(angle, 1e-12))
    for k in range(6, n):
        length = min(length, LARGEST_GROWTH / max(abs(step[k]), 1e-12))
    _turn(rotation, length * step[0], length * step[1], length * step[2])
    for k in range(3):
        position[k] += length * step[3 + k]
        if n > 6:
            scale[k] *= math.exp(length * step[6 + ties[k]])


@outlined
def _add_points(
    points: Floats, outline: int, lens: Floats, faces: Integers, ties: Integers, symmetry: int, rotation: Floats,
    position: Floats, settings: tuple[float, float, float, float, float, float, float, float, float], cutoff: float,
    placed: Floats, depth: Floats, index: Integers, matrix: Floats, vector: Floats, cross: Floats, row: Floats,
    camera: Floats, final: bool,
) -> float:  # fmt: skip
    """Add the residuals of points from the drawn surface to the normal equations, and return their cost."""
    noise, floor, edge, point_share, contour_share, _, last, reach, _ = settings
    height, width = index.shape
    cost = 0.0
    for p in range(len(points)):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        shrink = 1.0 / z
        column = math.floor(lens[0] * x * shrink + lens[2] + 0.5)
        line = math.floor(lens[1] * y * shrink + lens[3] + 0.5)
        inside = 0 <= line < height and 0 <= column < width
        k = index[line, column] if inside else -1
        seen = k >= 0
        if seen and p >= outline:
            continue
        share, largest = (point_share, cutoff) if p < outline else (contour_share, max(cutoff, reach))
        if inside and not seen:
            i, j, apart = _seen_beside(index, line, column)
            if i >= 0:
                k = index[i, j]
                if p >= outline:
                    cost += _add_uncovered(
                        i, j, line - i, column - j, apart, lens, ties, symmetry, rotation, position, settings, largest,
                        depth, matrix, vector, cross, row, camera, final,
                    )  # fmt: skip
                    continue
        if k < 0:
            cost += share / 3.0 * (last / (noise * z * z + floor)) ** 2
            continue
        a, b, c = faces[k, 0], faces[k, 1], faces[k, 2]
        if seen:
            nx, ny, nz = unit_normal(placed, a, b, c)
            r = nx * (x - placed[a, 0]) + ny * (y - placed[a, 1]) + nz * (z - placed[a, 2])
        else:
            qx, qy, qz = _closest(placed, a, b, c, x, y, z)
            nx, ny, nz = x - qx, y - qy, z - qz
            r = math.sqrt(nx * nx + ny * ny + nz * nz)
            if r < 1e-9:
                continue
            nx, ny, nz = nx / r, ny / r, nz / r
        cosine = (nx * x + ny * y + nz * z) / math.sqrt(x * x + y * y + z * z)
        across = edge * z / lens[0]
        variance = noise * noise * z * z * z * z * cosine * cosine + floor * floor
        variance += across * across * (1.0 - cosine * cosine)
        weight, loss = _robust(r, largest)
        cost += share * loss * largest * largest / variance
        if weight == 0.0:
            continue
        _surface_row(row, rotation, position, ties, symmetry, x - r * nx, y - r * ny, z - r * nz, -nx, -ny, -nz)
        camera[0], camera[1], camera[2] = y * nz - z * ny, z * nx - x * nz, x * ny - y * nx
        camera[3], camera[4], camera[5], camera[6] = nx, ny, nz, nx * x + ny * y + nz * z
        _add(matrix, vector, cross, row, camera, share * weight / variance, r, final)
    return cost


@inlined
def _add_uncovered(
    i: int, j: int, down: int, right: int, apart: float, lens: Floats, ties: Integers, symmetry: int, rotation: Floats,
    position: Floats, settings: tuple[float, float, float, float, float, float, float, float, float], largest: float,
    depth: Floats, matrix: Floats, vector: Floats, cross: Floats, row: Floats, camera: Floats, final: bool,
) -> float:  # fmt: skip
    """Add the residual of a pixel of the object that the drawing does not cover, and return its cost.

    The drawn pixel (i, j) is the nearest, and has to move towards that pixel in the image.
    """
    _, floor, edge, _, share, _, _, _, _ = settings
    z = depth[i, j]
    x, y = (j - lens[2]) / lens[0] * z, (i - lens[3]) / lens[1] * z
    pixel = z / lens[0]
    r = (apart - 0.5) * pixel  # the border is between the centers of pixels
    weight, loss = _robust(r, largest)
    variance = edge * edge * pixel * pixel + floor * floor
    if weight > 0.0:
        gu, gv = -right / apart, -down / apart
        _contour_row(row, camera, ties, symmetry, rotation, position, x, y, z, gu, gv)
        _add(matrix, vector, cross, row, camera, share * weight / variance, r, final)
    lost: float = share * loss * largest * largest / variance
    return lost


@inlined
def _contour_row(
    row: Floats, camera: Floats, ties: Integers, symmetry: int, rotation: Floats, position: Floats, x: float, y: float,
    z: float, gu: float, gv: float,
) -> None:  # fmt: skip
    """Set the derivatives of a residual that grows in the image along (gu, gv) with a point of the contour."""
    gz = -(gu * x + gv * y) / z
    _surface_row(row, rotation, position, ties, symmetry, x, y, z, gu, gv, gz)
    camera[0], camera[1], camera[2] = -(y * gz - z * gv), -(z * gu - x * gz), -(x * gv - y * gu)
    camera[3], camera[4], camera[5], camera[6] = -gu, -gv, -gz, 0.0


@outlined
def _add_contour(
    beyond: Floats, known: bool, lens: Floats, ties: Integers, symmetry: int, rotation: Floats, position: Floats,
    settings: tuple[float, float, float, float, float, float, float, float, float], depth: Floats, index: Integers,
    matrix: Floats, vector: Floats, cross: Floats, row: Floats, camera: Floats, final: bool,
) -> float:  # fmt: skip
    """Add the residuals of the drawing's contour from what may be covered, and return their cost.

    Where the outline is known, parts of the contour that agree with it and the border of the window count, too.
    """
    _, floor, edge, _, share, _, _, reach, _ = settings
    height, width = index.shape
    cost = 0.0
    for i in range(1, height - 1):
        for j in range(1, width - 1):
            if index[i, j] < 0 or (beyond[i, j] == 0.0 and not known):
                continue
            inner = index[i - 1, j] >= 0 and index[i + 1, j] >= 0 and index[i, j - 1] >= 0 and index[i, j + 1] >= 0
            if inner and not (known and (i == 1 or j == 1 or i == height - 2 or j == width - 2)):
                continue
            gu, gv = (beyond[i, j + 1] - beyond[i, j - 1]) / 2.0, (beyond[i + 1, j] - beyond[i - 1, j]) / 2.0
            if not (math.isfinite(gu) and math.isfinite(gv)):
                continue
            if beyond[i, j] == 0.0:
                steep = math.sqrt(gu * gu + gv * gv)
                if steep == 0.0:
                    continue
                gu, gv = gu / steep, gv / steep
            z = depth[i, j]
            x, y = (j - lens[2]) / lens[0] * z, (i - lens[3]) / lens[1] * z
            pixel = z / lens[0]
            r = max(0.0, beyond[i, j] - 0.5) * pixel  # the border is between the centers of pixels
            weight, loss = _robust(r, reach)
            variance = edge * edge * pixel * pixel + floor * floor
            cost += share * loss * reach * reach / variance
            if weight == 0.0:
                continue
            _contour_row(row, camera, ties, symmetry, rotation, position, x, y, z, gu, gv)
            _add(matrix, vector, cross, row, camera, share * weight / variance, r, final)
    return cost


@inlined
def _add_prior(
    matrix: Floats, vector: Floats, prior: Floats, rotation: Floats, position: Floats, scale: Floats, ties: Integers,
    prior_rotation: Floats, prior_position: Floats, row: Floats,
) -> float:  # fmt: skip
    """Add the prior's gradient, and return its cost; ``row`` gets the differences from what is expected."""
    n = len(vector)
    for k in range(3):
        row[k], row[3 + k] = 0.0, position[k] - prior_position[k]
    for m in range(3):  # half the skew part of R R0^T, which is the sine of the angle along the axis
        row[0] += (rotation[2, m] * prior_rotation[1, m] - rotation[1, m] * prior_rotation[2, m]) / 2.0
        row[1] += (rotation[0, m] * prior_rotation[2, m] - rotation[2, m] * prior_rotation[0, m]) / 2.0
        row[2] += (rotation[1, m] * prior_rotation[0, m] - rotation[0, m] * prior_rotation[1, m]) / 2.0
    sine = min(1.0, math.sqrt(row[0] * row[0] + row[1] * row[1] + row[2] * row[2]))
    grow = math.asin(sine) / sine if sine > 1e-9 else 1.0
    for k in range(3):
        row[k] *= grow
        if n > 6:
            row[6 + k] = 0.0
    if n > 6:
        for k in range(3):
            row[6 + ties[k]] = math.log(scale[k])
    cost = 0.0
    for k in range(n):
        for m in range(n):
            vector[k] -= prior[k, m] * row[m]
            cost += row[k] * prior[k, m] * row[m]
    return cost
