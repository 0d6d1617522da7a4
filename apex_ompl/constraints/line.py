"""Straight lines of tools: poses of frames along a polyline of poses, with blends at its corners.

Between two poses (p_0, R_0) and (p_1, R_1) a frame is, at the share a of the segment, at

    p(a) = p_0 + a (p_1 - p_0),    R(a) = R_0 exp(a w),    w = log(R_0^T R_1),

so position and orientation go in step, the latter by the shortest turn. The parameter u of the whole path is its length
so far: that of a segment is the largest, over the frames, of |p_1 - p_0| and ``TURN`` |w|.

A blend replaces the last h of a segment and the first h of the next one. With tau from 0 to 1 along it, b_1 and b_2 the
shares of both segments that it replaces, and C the pose at the corner,

    p = p_C - (1 - tau)^2 b_1 (p_C - p_0) + tau^2 b_2 (p_2 - p_C),
    R = R_C exp(-(1 - tau)^2 b_1 w_1) exp(tau^2 b_2 w_2),

a parabola inside the triangle of its ends and the corner. Poses are continuously differentiable along u, except at
corners without a blend, where the tools stop.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from apex_ompl.errors import ParameterError
from apex_ompl.kernel.products import product
from apex_ompl.types import Array
from apex_ompl.util.arrays import distinct

TURN = 0.2  # length that counts as much as an angle [m/rad]
SAME_POINT, SAME_TURN = 1e-9, 1e-9  # lengths [m] and angles [rad] that count as none


class Piece(NamedTuple):
    """A segment of a path, or a blend between two, for F frames; see the module.

    Attributes:
        low: Parameter at its start.
        high: Parameter at its end.
        point: p_0 of a segment, p_C of a blend, shape (F, 3) [m].
        rotation: R_0, or R_C, shape (F, 3, 3).
        before: What a blend leaves: b_1 (p_C - p_0) and b_1 w_1, shape (F, 6); 0 of a segment.
        after: What comes: b_2 (p_2 - p_C) and b_2 w_2; of a segment p_1 - p_0 and w over all of it, shape (F, 6).
        blend: Whether it is a blend.
    """

    low: float
    high: float
    point: Array
    rotation: Array
    before: Array
    after: Array
    blend: bool

    @property
    def length(self) -> float:
        """Difference of the parameter."""
        return self.high - self.low


class Rates(NamedTuple):
    """Bounds for F frames over N stretches of a path.

    Attributes:
        acceleration: Of |d^2 p / du^2|, shape (N, F) [1/m].
        turn: Of the angular velocity d R / du, shape (N, F) [rad/m].
        turning: Of the derivative of the angular velocity in the frame, shape (N, F) [rad/m^2].
    """

    acceleration: Array
    turn: Array
    turning: Array


@dataclass(frozen=True, eq=False)
class ToolPath:
    """Poses of F frames along a polyline with blends.

    Attributes:
        pieces: Segments and blends in their order.
        stops: Parameters at which the tools stop: the ends, and the corners without a blend.
    """

    pieces: tuple[Piece, ...]
    stops: tuple[float, ...]

    @property
    def length(self) -> float:
        """Parameter at the end [m]."""
        return self.pieces[-1].high

    @property
    def ends(self) -> Array:
        """Parameters at the ends of all pieces, from 0, shape (pieces + 1,)."""
        return np.array([0.0, *(piece.high for piece in self.pieces)])

    @classmethod
    def through(cls, poses: Array, blend: float = 0.0) -> ToolPath:
        """Return the path through poses of F frames.

        Args:
            poses: Rigid poses, shape (K, F, 4, 4), K > 1 [m].
            blend: Radius around a corner inside of which frames may leave the line [m].

        Raises:
            ParameterError: The radius is larger than half a segment, or all poses are the same.
        """
        moves, lengths, size = _segments(poses)
        kept = np.flatnonzero(size > SAME_POINT)
        if not len(kept):
            raise ParameterError("pose", "the pose at the start", "poses that differ from it")
        for k in kept.tolist() if blend and len(kept) > 1 else ():
            for length in lengths[k][lengths[k] > SAME_POINT].tolist():
                if blend > 0.5 * length:
                    segment = f"segment {k + 1}, which is {length:.4g} m long"
                    raise ParameterError("blend", blend, f"at most half of {segment}")
        first = poses[kept]
        moves, lengths, size = moves[kept], lengths[kept], size[kept]
        cut = _cuts(lengths, size, blend)
        return cls(*_pieces(first, moves, size, cut))

    def poses(self, u: Array) -> tuple[Array, Array]:
        """Return rotations, shape (N, F, 3, 3), and origins, shape (N, F, 3) [m], at parameters of shape (N,)."""
        which, frames = self._which(u), len(self.pieces[0].point)
        rotation, point = np.empty((len(u), frames, 3, 3)), np.empty((len(u), frames, 3))
        for k in distinct(which).tolist():
            rows, piece = which == k, self.pieces[k]
            back, ahead = _shares(piece, u[rows])
            for f in range(frames):
                left, right = piece.before[f], piece.after[f]
                point[rows, f] = piece.point[f] - back[:, None] * left[:3] + ahead[:, None] * right[:3]
                turned = turns(right[3:], ahead)
                if piece.blend:
                    turned = product(turns(left[3:], -back), turned)
                rotation[rows, f] = product(piece.rotation[f], turned)
        return rotation, point

    def rates(self, u: Array) -> tuple[Array, Array]:
        """Return d p / du, shape (N, F, 3), and the angular velocity in the world, shape (N, F, 3) [rad/m]."""
        which, rotation = self._which(u), self.poses(u)[0]
        velocity, angular = np.empty((len(u), rotation.shape[1], 3)), np.empty((len(u), rotation.shape[1], 3))
        for k in distinct(which).tolist():
            rows, piece = which == k, self.pieces[k]
            tau = ((u[rows] - piece.low) / piece.length)[:, None]
            for f in range(rotation.shape[1]):
                left, right = piece.before[f], piece.after[f]
                back = 2.0 * (1.0 - tau) if piece.blend else np.zeros_like(tau)
                ahead = 2.0 * tau if piece.blend else np.ones_like(tau)
                velocity[rows, f] = (back * left[:3] + ahead * right[:3]) / piece.length
                own = product(turns(right[3:], -(tau[:, 0] ** 2)), left[3:, None])[..., 0] if piece.blend else 0.0
                body = (back * own + ahead * right[3:]) / piece.length
                angular[rows, f] = product(rotation[rows, f], body[..., None])[..., 0]
        return velocity, angular

    def bounds(self, low: Array, high: Array) -> Rates:
        """Return bounds over stretches from ``low`` to ``high``, each of shape (N,)."""
        found = np.zeros((3, len(low), len(self.pieces[0].point)))
        for piece in self.pieces:
            rows = (high >= piece.low) & (low <= piece.high)
            found[:, rows] = np.maximum(found[:, rows], _bounds(piece)[:, None])
        return Rates(*found)

    def freedom(self, u: Array) -> Array:
        """Return how far frames may be from the curve of a blend without leaving the ball around the corner, (N, F).

        With the radius r, |p - p_C| <= ((1 - tau)^2 + tau^2) r, so that 2 tau (1 - tau) r is left; a quarter of it
        counts. It is 0 along segments [m].
        """
        found, which = np.zeros((len(u), len(self.pieces[0].point))), self._which(u)
        for k, piece in enumerate(self.pieces):
            rows = which == k
            if piece.blend and rows.any():
                tau = (u[rows] - piece.low) / piece.length
                radius = np.maximum(_norms(piece.before[:, :3]), _norms(piece.after[:, :3]))
                found[rows] = (0.5 * tau * (1.0 - tau))[:, None] * radius
        return found

    def grid(self, spacing: float) -> Array:
        """Return parameters from 0 to the end with the ends of all pieces among them, at most ``spacing`` apart."""
        steps = [np.linspace(p.low, p.high, math.ceil(p.length / spacing) + 1)[1:] for p in self.pieces]
        return np.concatenate([[0.0], *steps])

    def _which(self, u: Array) -> Array:
        return np.clip(np.searchsorted(self.ends, u, side="right") - 1, 0, len(self.pieces) - 1)


def are_same(poses: Array) -> bool:
    """Whether poses of F frames, shape (K, F, 4, 4), count as one."""
    return not (_segments(poses)[2] > SAME_POINT).any()


def turns(vector: Array, shares: Array) -> Array:
    """Return the rotations exp(a w) for a rotation vector w, shape (3,), and shares a, shape (N,); shape (N, 3, 3)."""
    angle = float(_norms(vector))
    found = np.zeros((len(shares), 3, 3))
    found[:] = np.eye(3)
    if angle <= SAME_TURN:
        return found
    x, y, z = (vector / angle).tolist()
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    sines = np.array([[math.sin(a * angle), 2.0 * math.sin(0.5 * a * angle) ** 2] for a in shares.tolist()])
    found += sines[:, 0, None, None] * cross + sines[:, 1, None, None] * product(cross, cross)
    return found


def _norms(vectors: Array) -> Array:
    """Return the lengths of vectors along the last axis."""
    return np.asarray(np.sqrt((vectors * vectors).sum(axis=-1)))


def _segments(poses: Array) -> tuple[Array, Array, Array]:
    """Return the segments between poses of F frames, shape (K + 1, F, 4, 4).

    Returns:
        Translations and rotation vectors, shape (K, F, 6), lengths, shape (K, F) [m], and differences of u, shape (K,).
    """
    moves = np.stack([_moves(a, b) for a, b in zip(poses[:-1], poses[1:], strict=True)])
    lengths = _norms(moves[..., :3])
    return moves, lengths, np.maximum(lengths, TURN * _norms(moves[..., 3:])).max(axis=1)


def _moves(first: Array, second: Array) -> Array:
    """Return translation in the world and rotation vector in the frame between poses, shape (F, 4, 4); shape (F, 6)."""
    moved = np.empty((len(first), 6))
    for f, (a, b) in enumerate(zip(first, second, strict=True)):
        moved[f, :3] = b[:3, 3] - a[:3, 3]
        moved[f, 3:] = pin.log3(product(a[:3, :3].T, b[:3, :3]))
    return moved


def _cuts(lengths: Array, size: Array, blend: float) -> list[float]:
    """Return the length h of each corner's blend on both sides, 0 where there is none, shape (segments - 1,)."""
    cuts = []
    for k in range(len(size) - 1):
        sides = [blend * size[j] / length for j in (k, k + 1) for length in lengths[j] if length > SAME_POINT]
        turned = min(lengths[j].max() for j in (k, k + 1)) <= SAME_POINT  # no radius limits a turn on the spot
        cuts.append(0.0 if turned or not sides else float(min(sides)))
    return cuts


def _pieces(
    first: Array, moves: Array, size: Array, cuts: Sequence[float]
) -> tuple[tuple[Piece, ...], tuple[float, ...]]:
    """Return the pieces of a path and its stops.

    Args:
        first: Poses at the starts of the segments, shape (S, F, 4, 4).
        moves: Their translations and rotation vectors, shape (S, F, 6).
        size: Their lengths, shape (S,).
        cuts: Lengths that blends take on both sides of the corners, shape (S - 1,).
    """
    ends = np.append(0.0, np.cumsum(size)).tolist()
    pieces, stops, none = list[Piece](), [0.0], np.zeros_like(moves[0])
    for k, length in enumerate(size.tolist()):
        head, tail = cuts[k - 1] if k else 0.0, cuts[k] if k < len(cuts) else 0.0
        points, rotations = first[k, :, :3, 3], first[k, :, :3, :3]
        if head + tail < length:
            skipped = np.stack([turns(w, np.array([head / length]))[0] for w in moves[k, :, 3:]])
            at, turned = points + (head / length) * moves[k, :, :3], product(rotations, skipped)
            rest = (length - head - tail) / length * moves[k]
            pieces.append(Piece(ends[k] + head, ends[k + 1] - tail, at, turned, none, rest, False))
        if k == len(cuts):
            break
        if tail:
            corner = first[k + 1]
            before, after = tail / length * moves[k], tail / float(size[k + 1]) * moves[k + 1]
            low, high = ends[k + 1] - tail, ends[k + 1] + tail
            pieces.append(Piece(low, high, corner[:, :3, 3], corner[:, :3, :3], before, after, True))
        else:
            stops.append(ends[k + 1])
    return tuple(pieces), (*stops, ends[-1])


def _shares(piece: Piece, u: Array) -> tuple[Array, Array]:
    """Return the factors on ``before``, negated, and on ``after`` at parameters, each of shape (N,)."""
    tau = (u - piece.low) / piece.length
    return ((1.0 - tau) ** 2, tau**2) if piece.blend else (np.zeros_like(tau), tau)


def _bounds(piece: Piece) -> Array:
    """Return the bounds of :class:`Rates` over a piece, shape (3, F)."""
    left, right = _norms(piece.before[:, 3:]), _norms(piece.after[:, 3:])
    if not piece.blend:
        return np.stack([np.zeros_like(right), right / piece.length, np.zeros_like(right)])
    bend = 2.0 * _norms(piece.after[:, :3] - piece.before[:, :3]) / piece.length**2
    turn = 2.0 * np.maximum(left, right) / piece.length
    turning = 2.0 * (left + right) / piece.length**2 + (2.0 * left / piece.length) * (2.0 * right / piece.length)
    return np.stack([bend, turn, turning])
