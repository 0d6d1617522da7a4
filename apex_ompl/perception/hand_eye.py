"""Hand-eye calibration: where a camera is on a robot, from images of a board in many states.

The board is on a link and the camera stands still, or the camera is on a link, or both are on links. Unknown are the
pose X of the camera on its mount, the pose Y of the board on its mount, and constant offsets of joints. A first
estimate solves A X = X B for pairs of views (F. Park and B. Martin, "Robot sensor calibration: solving AX = XB on the
Euclidean group", 1994), several times on a few views each, since the pose of a small tag may be its mirror image; then
the distances in the images between the corners that were found and those that are predicted are minimized, with Huber's
weights.

An offset of the first joint of an arm is a turn of the camera about its axis, and one of the last joint a turn of the
board: images do not tell which, so offsets are sought of the joints in between. Where images tell nothing of an offset,
its standard deviation stays the one assumed beforehand.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from apex_ompl.errors import ParameterError, UnknownNameError
from apex_ompl.perception.boards import Board
from apex_ompl.perception.camera import Camera
from apex_ompl.perception.library import least_squares, opencv
from apex_ompl.robot.model import Robot
from apex_ompl.types import Array
from apex_ompl.util.display import fields_line
from apex_ompl.util.validation import check_array, check_seed, check_states, finite_array, number_array

FEWEST_VIEWS, FEWEST_CORNERS = 4, 4
LEAST_TURN = np.deg2rad(5.0)  # about a second axis, below which the position is not known
LARGEST_RESIDUAL = 3.0  # root mean square [pixels]
STARTS, VIEWS_OF_START = 8, 5
OFFSET_SPREAD = np.deg2rad(1.0)  # standard deviation of joint offsets beforehand
GOOD_RESIDUAL = 1.0  # root mean square, with which no other start is tried [pixels]
HUBER = 1.0  # distance from which weights decrease [pixels]
PRIOR_NOISE, LEAST_NOISE = 0.3, 0.05  # of corners in each direction, beside that of offsets; and at least [pixels]
FIRST_STEPS, STEPS = 20, 100  # of a start, and of the best one
STEP = 1e-6  # of offsets, for derivatives of mounts [rad]
BEHIND = 1e3  # distance of corners that are predicted behind the camera [pixels]


class View(NamedTuple):
    """What one image shows of the board.

    Attributes:
        state: State of the robot, shape (dof,).
        pixels: The corners of the board, shape (N, 2) [pixels]; NaN for those that are not seen.
    """

    state: Array
    pixels: Array


@dataclass(frozen=True, eq=False)
class Calibration:
    """A calibrated camera.

    Attributes:
        camera: The camera with its pose, and the standard deviations of the pose.
        board: Pose of the board on its link, or in the world, shape (4, 4) [m].
        offsets: Joint -> what is to be added to its reading [rad].
        residual: Root mean square of the distances in the images [pixels].
        covariance: Of the camera's pose: of a small translation [m] and rotation [rad] in the optical frame, of shape
            (6, 6).
        offset_spreads: Joint -> standard deviation of its offset [rad].
    """

    camera: Camera
    board: Array
    offsets: Mapping[str, float]
    residual: float
    covariance: Array
    offset_spreads: Mapping[str, float]

    __repr__ = fields_line

    def corrected(self, joints: Mapping[str, float]) -> dict[str, float]:
        """Return joint readings with the offsets added."""
        return {name: value + self.offsets.get(name, 0.0) for name, value in joints.items()}


def calibrate(
    robot: Robot, camera: Camera, board: Board, views: Sequence[View], *, board_link: str | None,
    offsets: Sequence[str] = (), seed: int = 0,
) -> Calibration:  # fmt: skip
    """Find the pose of a camera by what it sees of a board.

    Args:
        robot: The robot.
        camera: The camera with its intrinsics; its ``link`` is the one that carries it, or None; its pose is not used.
        board: The board.
        views: States and corners in the images, 4 or more; about 20 with turns of half a radian give a millimeter.
        board_link: The link that carries the board, or None where it stands still.
        offsets: Joints whose readings may be off by a constant.
        seed: Seed of the choice of views for first estimates.

    Raises:
        ParameterError: Too few views or corners, states or corners of another shape, views that hardly turn about a
            second axis, or that do not fit together.
        UnknownNameError: There is no such link or joint.
        MissingFileError: The extra ``perception`` is not installed.
    """
    check_seed(seed)
    if camera.link is None and board_link is None:
        raise ParameterError("board_link", board_link, "the link that carries the board, or a camera on a link")
    if camera.link == board_link:
        raise ParameterError("board_link", board_link, "a board that moves before the camera")
    for name in offsets:
        if name not in robot.joint_names:
            raise UnknownNameError("joint", name, robot.joint_names)
    if not isinstance(views, Sequence):
        raise ParameterError("views", views, "a list of views")
    kept = _checked(robot, board, views)
    fit = _Fit(robot, camera, board, kept, board_link=board_link, offsets=tuple(dict.fromkeys(offsets)))
    return fit.solved(np.random.default_rng(seed))


def _checked(robot: Robot, board: Board, views: Sequence[View]) -> list[View]:
    """Return the views that show the board, as arrays."""
    count, kept = len(board.corners), []
    for k, view in enumerate(views):
        if not isinstance(view, View):
            raise ParameterError(f"view {k}", view, "a View: a state, and pixels of corners")
        state, pixels = view
        q, found = finite_array(state, f"state of view {k}"), number_array(pixels, f"corners of view {k}")
        check_states(q[None], len(robot.joint_names), f"state of view {k}")
        check_array(found, (count, 2), f"corners of view {k}")
        if np.isfinite(found).all(axis=1).sum() >= FEWEST_CORNERS:
            kept.append(View(q, found))
    if len(kept) < FEWEST_VIEWS:
        what = f"{FEWEST_VIEWS} or more that show {FEWEST_CORNERS} corners or more"
        raise ParameterError("views", f"{len(kept)} of {len(views)}", what)
    return kept


class _Fit:
    """The least squares problem. Unknowns are small motions of X and Y in their own frames, and offsets of joints."""

    def __init__(
        self, robot: Robot, camera: Camera, board: Board, views: list[View], *, board_link: str | None,
        offsets: tuple[str, ...],
    ) -> None:  # fmt: skip
        """Keep what :func:`calibrate` is given."""
        self.robot, self.camera, self.board, self.views = robot, camera, board, views
        self.links, self.joints = (camera.link, board_link), offsets
        self._columns = [robot.joint_names.index(name) for name in offsets]
        self._seen = [np.isfinite(view.pixels).all(axis=1) for view in views]
        self._pixels = np.concatenate([view.pixels[seen] for view, seen in zip(views, self._seen, strict=True)])
        self._x, self._y = np.eye(4), np.eye(4)

    def solved(self, rng: np.random.Generator) -> Calibration:
        """Return the best of several solutions."""
        mounts, boards = self._mounts(np.zeros(len(self.joints))), [self._board_pose(k) for k in range(len(self.views))]
        turn = _second_turn(mounts)
        if turn < LEAST_TURN:
            raise ParameterError(
                "views", f"turns of {np.rad2deg(turn):.1f} degrees about a second axis",
                f"{np.rad2deg(LEAST_TURN):g} degrees or more, without which the position of the camera is not known",
            )  # fmt: skip
        everyone, best = np.arange(len(self.views)), np.inf
        for k in range(STARTS):
            few = min(VIEWS_OF_START, len(everyone))
            chosen = everyone if k == 0 else rng.choice(everyone, few, replace=False)
            x = _park_martin([mounts[i] for i in chosen], [boards[i] for i in chosen])
            poses = [np.linalg.inv(mounts[i]) @ x @ boards[i] for i in chosen]
            found = self._improved(x, _mean_pose(poses), np.zeros(len(self.joints)), FIRST_STEPS)
            if found[0] < best:
                best, solution = found
            if np.sqrt(best) < GOOD_RESIDUAL:
                break
        best, solution = self._improved(*solution, STEPS)
        self._x, self._y, offsets = solution
        if not np.sqrt(best) < LARGEST_RESIDUAL:
            raise ParameterError(
                "views", f"{np.sqrt(best):.3g} pixels between corners as found and as predicted",
                f"at most {LARGEST_RESIDUAL:g}: states and images that belong together, and the board as it is",
            )  # fmt: skip
        return self._calibration(offsets, best)

    def _improved(self, x: Array, y: Array, offsets: Array, steps: int) -> tuple[float, tuple[Array, Array, Array]]:
        """Return the mean square of distances [pixels^2] and the solution next to an estimate."""
        self._x, self._y = x, y
        solve, first = least_squares(), np.concatenate([np.zeros(12), offsets])
        found = solve(
            self._residuals, first, self._jacobian, loss="huber", f_scale=HUBER, x_scale="jac", max_nfev=steps
        ).x
        x, y, offsets = x @ _motion(found[:6]), y @ _motion(found[6:12]), found[12:]
        self._x, self._y = x, y
        distances = self._distances(np.concatenate([np.zeros(12), offsets]))
        return float(np.square(distances).sum(axis=1).mean()), (x, y, offsets)

    def _calibration(self, offsets: Array, mean_square: float) -> Calibration:
        """Return the calibration of a solution, with the covariance of its linearization."""
        at = np.concatenate([np.zeros(12), offsets])
        jacobian = self._jacobian(at)
        spread = max(np.sqrt(mean_square / 2.0), LEAST_NOISE)
        information = jacobian.T @ jacobian / spread**2
        information[12:, 12:] += np.eye(len(offsets)) * (
            1.0 / OFFSET_SPREAD**2 - (PRIOR_NOISE / OFFSET_SPREAD / spread) ** 2
        )
        covariance = np.linalg.inv(information)
        spreads = np.sqrt(np.diag(covariance))
        camera = self.camera.placed(self._x).model_copy(
            update={
                "position_spread": float(np.sqrt(np.square(spreads[:3]).mean())),
                "angle_spread": float(np.sqrt(np.square(spreads[3:6]).mean())),
            }
        )
        return Calibration(
            camera, self._y, dict(zip(self.joints, map(float, offsets), strict=True)), float(np.sqrt(mean_square)),
            covariance[:6, :6], dict(zip(self.joints, map(float, spreads[12:]), strict=True)),
        )  # fmt: skip

    def _mounts(self, offsets: Array) -> list[Array]:
        """Return the pose of the board's mount in the frame of the camera's mount for each view, shape (4, 4) each."""
        found = []
        for view in self.views:
            q = view.state.copy()
            q[self._columns] += offsets
            camera, board = (np.eye(4) if link is None else self.robot.link_pose(q, link) for link in self.links)
            found.append(np.linalg.inv(camera) @ board)
        return found

    def _distances(self, unknowns: Array) -> Array:
        """Return from corners as found to those that are predicted, shape (N, 2) [pixels]."""
        inverse, y = np.linalg.inv(self._x @ _motion(unknowns[:6])), self._y @ _motion(unknowns[6:12])
        poses, corners = [inverse @ mount @ y for mount in self._mounts(unknowns[12:])], self.board.corners
        local = [
            corners[seen] @ pose[:3, :3].T + pose[:3, 3] for pose, seen in zip(poses, self._seen, strict=True)
        ]  # fmt: skip
        predicted = self.camera.project(np.concatenate(local))
        return np.asarray(np.nan_to_num(predicted - self._pixels, nan=BEHIND))

    def _jacobian(self, unknowns: Array) -> Array:
        """Return the derivatives of the residuals by the unknowns, shape (2 N + offsets, 12 + offsets)."""
        x, y, count = self._x @ _motion(unknowns[:6]), self._y @ _motion(unknowns[6:12]), len(self.joints)
        mounts, corners = self._mounts(unknowns[12:]), self.board.corners
        turned = [self._mounts(unknowns[12:] + step) for step in STEP * np.eye(count)]
        inverse, parts = np.linalg.inv(x), []
        turns = [_small_turn(unknowns[3:6]), _small_turn(unknowns[9:12])]
        for k, (mount, seen) in enumerate(zip(mounts, self._seen, strict=True)):
            given, before = corners[seen], inverse @ mount
            pose = before @ y
            local = given @ pose[:3, :3].T + pose[:3, 3]
            rows = np.zeros((len(local), 3, 12 + count))
            rows[:, :, :3] = -inverse[:3, :3] @ self._x[:3, :3]
            rows[:, :, 3:6] = _crosses(local) @ turns[0]
            rows[:, :, 6:9] = before[:3, :3] @ self._y[:3, :3]
            rows[:, :, 9:12] = -pose[:3, :3] @ _crosses(given) @ turns[1]
            for j, others in enumerate(turned):
                change = inverse @ (others[k] - mount) @ y / STEP
                rows[:, :, 12 + j] = given @ change[:3, :3].T + change[:3, 3]
            parts.append(self.camera.projection_jacobian(local) @ rows)
        prior = np.zeros((count, 12 + count))
        prior[:, 12:] = np.eye(count) * (PRIOR_NOISE / OFFSET_SPREAD)
        return np.concatenate([np.concatenate(parts).reshape(-1, 12 + count), prior])

    def _residuals(self, unknowns: Array) -> Array:
        """Return distances [pixels], and the offsets of joints at the weight of their standard deviation."""
        return np.concatenate([self._distances(unknowns).ravel(), unknowns[12:] * (PRIOR_NOISE / OFFSET_SPREAD)])

    def _board_pose(self, k: int) -> Array:
        """Return the pose of the board in the optical frame in one view, shape (4, 4)."""
        cv2 = opencv()
        seen = self._seen[k]
        flat = self.camera.rays(self.views[k].pixels[seen])
        method = cv2.SOLVEPNP_IPPE if self.board.kind == "tag" else cv2.SOLVEPNP_ITERATIVE
        try:
            found, turn, shift = cv2.solvePnP(self.board.corners[seen], flat, np.eye(3), None, flags=method)
        except cv2.error as error:
            raise ParameterError(
                f"corners of view {k}", "corners of no board", "corners that are not in line"
            ) from error
        if not found:
            raise ParameterError(f"corners of view {k}", "corners of no board", "corners of the board")
        return _pose(pin.exp3(turn[:, 0]), shift[:, 0])


def _pose(turn: Array, shift: Array) -> Array:
    """Return a homogeneous transform, shape (4, 4)."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, shift
    return pose


def _motion(small: Array) -> Array:
    """Return the transform of a translation [m] and a rotation vector [rad], shape (6,)."""
    return _pose(pin.exp3(small[3:]), small[:3])


def _crosses(points: Array) -> Array:
    """Return the matrices of the cross products with vectors, shape (N, 3, 3)."""
    found = np.zeros((len(points), 3, 3))
    found[:, 0, 1], found[:, 0, 2], found[:, 1, 2] = -points[:, 2], points[:, 1], -points[:, 0]
    return found - found.transpose(0, 2, 1)


def _small_turn(vector: Array) -> Array:
    """Return the derivative of a rotation by its vector, as seen in the turned frame, shape (3, 3)."""
    return np.asarray(pin.Jexp3(vector))


def _mean_pose(poses: Sequence[Array]) -> Array:
    """Return a pose in the middle of some."""
    u, _, v = np.linalg.svd(np.sum([pose[:3, :3] for pose in poses], axis=0))
    return _pose(u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v, np.median([pose[:3, 3] for pose in poses], axis=0))


def _second_turn(mounts: Sequence[Array]) -> float:
    """Return the root mean square of the turns between views about their second axis [rad]."""
    turns = np.stack([pin.log3(a[:3, :3] @ b[:3, :3].T) for a, b in combinations(mounts, 2)])
    return float(np.linalg.svd(turns, compute_uv=False)[1] / np.sqrt(len(turns)))


def _park_martin(mounts: Sequence[Array], boards: Sequence[Array]) -> Array:
    """Return the X of A X = X B for all pairs of views, shape (4, 4)."""
    pairs = [
        (mounts[j] @ np.linalg.inv(mounts[i]), boards[j] @ np.linalg.inv(boards[i]))
        for i, j in combinations(range(len(mounts)), 2)
    ]
    correlation = sum(np.outer(pin.log3(a[:3, :3]), pin.log3(b[:3, :3])) for a, b in pairs)
    u, _, v = np.linalg.svd(correlation)
    turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v
    matrix = np.concatenate([a[:3, :3] - np.eye(3) for a, _ in pairs])
    right = np.concatenate([turn @ b[:3, 3] - a[:3, 3] for a, b in pairs])
    return _pose(turn, np.linalg.lstsq(matrix, right, rcond=None)[0])
