"""Boards in drawn images, and hand-eye calibration against the truth that its views were made from."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from apex_ompl.errors import ApexError, ParameterError
from apex_ompl.perception import (
    Board,
    Calibration,
    Camera,
    Frame,
    View,
    calibrate,
    look_at,
    measured_depths,
    save_sequence,
)
from apex_ompl.perception.hand_eye import _Fit
from apex_ompl.robot import Robot

cv2: Any = pytest.importorskip("cv2")

CAMERA = Camera(width=640, height=480, focal=(465.0, 465.0), center=(319.5, 239.5))
BOARD, TAG = Board(columns=9, rows=6), Board(kind="tag", square=0.06)
LARGE = Board(columns=5, rows=4, square=0.06)
LINK = "left_hand_palm"
OFF = {"left_joint2": 0.004, "left_joint4": -0.003, "left_joint6": 0.002}
CELL = 40  # pixels of a drawn square


def moved(turn: tuple[float, float, float], place: tuple[float, float, float]) -> np.ndarray:
    return np.asarray(pin.SE3(pin.exp3(np.array(turn)), np.array(place)).homogeneous)


def drawing(board: Board) -> tuple[np.ndarray, np.ndarray, float]:
    """Return a drawing of a board, the place of its first pixel's corner on it [m], and the size of a pixel [m]."""
    markers = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_250)
    size = board.square / CELL
    if board.kind == "tag":
        image = np.pad(cv2.aruco.generateImageMarker(markers, 0, CELL), CELL, constant_values=255)
        return image, board.corners[0, :2] - board.square, size
    columns, rows = board.columns + 1, board.rows + 1
    if board.kind == "charuco":
        made = cv2.aruco.CharucoBoard((columns, rows), board.square, board.square * board.marker, markers)
        return made.generateImage((columns * CELL, rows * CELL)), board.corners[0, :2] - board.square, size
    squares = (np.add.outer(np.arange(rows), np.arange(columns)) % 2 * 255).astype(np.uint8)
    image = np.pad(np.kron(squares, np.ones((CELL, CELL), np.uint8)), CELL, constant_values=255)
    return image, board.corners[0, :2] - 2.0 * board.square, size


def picture(board: Board, pose: np.ndarray) -> np.ndarray:
    """Return what the camera sees of a board, shape (height, width, 3)."""
    image, first, size = drawing(board)
    rows, columns = image.shape
    pixels = np.array([[0, 0], [columns, 0], [columns, rows], [0, rows]]) - 0.5
    flat = np.concatenate([(pixels + 0.5) * size + first, np.zeros((4, 1))], axis=1)
    seen = CAMERA.project(flat @ pose[:3, :3].T + pose[:3, 3])
    warp = cv2.getPerspectiveTransform(pixels.astype(np.float32), seen.astype(np.float32))
    gray = cv2.warpPerspective(image, warp, (640, 480), flags=cv2.INTER_AREA, borderValue=128)
    return np.repeat(gray[..., None], 3, axis=2)


@pytest.mark.parametrize("upside_down", [False, True])
@pytest.mark.parametrize("board", [Board(kind="chessboard"), BOARD, TAG], ids=lambda board: board.kind)
def test_corners_are_found_in_a_drawn_image(board: Board, upside_down: bool) -> None:
    pose = moved((0.3, -0.2, 0.1), (0.02, -0.01, 0.6)) @ moved((0.0, 0.0, np.pi * upside_down), (0.0, 0.0, 0.0))
    found = board.find(picture(board, pose))
    assert found is not None
    expected = CAMERA.project(board.corners @ pose[:3, :3].T + pose[:3, 3])
    assert np.abs(found - expected).max() < 0.8


def test_a_board_may_be_seen_in_part_or_not_at_all() -> None:
    pose = moved((0.0, 0.0, 0.0), (0.3, 0.0, 0.6))
    found = BOARD.find(picture(BOARD, pose))
    assert found is not None and 0 < np.isnan(found).any(axis=1).sum() < len(found)
    gray = np.full((480, 640, 3), 128, np.uint8)
    assert all(board.find(gray) is None for board in (BOARD, TAG, Board(kind="chessboard")))


@pytest.mark.parametrize(
    "call",
    [
        lambda: Board(kind="chessboard", columns=9, rows=7),
        lambda: BOARD.find(np.zeros((4, 4, 3))),
        lambda: BOARD.find(np.zeros((0, 0, 3), np.uint8)),
        lambda: Board(dictionary="DICT_9X9").find(np.zeros((40, 40, 3), np.uint8)),
    ],
)
def test_faulty_boards_and_images_are_refused(call: Any) -> None:
    with pytest.raises(ApexError):
        call()


def truth(robot: Robot, mount: str) -> tuple[Camera, np.ndarray]:
    """Return a camera with its true pose, and the pose of the board on its mount."""
    palm = robot.link_pose(robot.home, LINK)
    eye = palm[:3, 3] + [1.0, 0.2, 0.5]
    facing = look_at(eye, palm[:3, 3])
    on_palm = np.linalg.inv(palm) @ moved((0.0, 0.0, 0.0), tuple(palm[:3, 3]))
    on_palm[:3, :3] = palm[:3, :3].T @ facing[:3, :3]
    if mount == "board on the hand":
        return CAMERA.placed(facing), on_palm @ moved((0.1, 0.2, -0.1), (0.02, 0.03, -0.04))
    carried = CAMERA.model_copy(update={"link": LINK}).placed(np.linalg.inv(palm) @ look_at(palm[:3, 3], eye))
    board = look_at(palm[:3, 3], eye) @ moved((0.1, 0.1, 0.0), (0.0, 0.0, 0.8))
    return carried, board


def views(
    robot: Robot, mount: str, board: Board = BOARD, *, count: int = 20, turn: float = 0.4, noise: float = 0.0
) -> list[View]:
    """Return views in which all corners are in the image, of an arm whose joints are off by ``OFF``."""
    rng, (camera, pose) = np.random.default_rng(1), truth(robot, mount)
    off, found = np.array([OFF.get(name, 0.0) for name in robot.joint_names]), []
    while len(found) < count:
        q = robot.home.copy()
        q[:7] += rng.normal(0.0, turn, 7)
        true = np.linalg.inv(camera.pose_at(robot, q + off))
        seen = true @ (pose if camera.link else robot.link_pose(q + off, LINK) @ pose)
        pixels = camera.project(board.corners @ seen[:3, :3].T + seen[:3, 3])
        if seen[2, 2] > 0.5 and (pixels > 0.0).all() and (pixels < (640, 480)).all():
            found.append(View(q, pixels + rng.normal(0.0, noise, pixels.shape) if noise else pixels))
    return found


def calibrated(robot: Robot, mount: str, seen: list[View], board: Board = BOARD, **options: Any) -> Calibration:
    camera = CAMERA.model_copy(update={"link": truth(robot, mount)[0].link})
    return calibrate(robot, camera, board, seen, board_link=None if camera.link else LINK, **options)


@pytest.mark.parametrize("mount", ["board on the hand", "camera on the hand"])
def test_exact_views_give_the_pose_and_the_offsets(robot: Robot, mount: str) -> None:
    camera, board = truth(robot, mount)
    middle = [f"left_joint{k}" for k in range(2, 7)]
    seen = views(robot, mount)
    hidden = [View(seen[0].state, np.where(np.arange(54)[:, None] < 20, np.nan, seen[0].pixels)), *seen[1:]]
    found = calibrated(robot, mount, hidden, offsets=middle)
    np.testing.assert_allclose(found.camera.pose, camera.pose, atol=2e-4)
    np.testing.assert_allclose(found.board, board, atol=2e-4)
    np.testing.assert_allclose(
        [found.offsets[name] for name in middle], [OFF.get(name, 0.0) for name in middle], atol=1e-4
    )
    assert found.residual < 0.02
    assert found.corrected({"left_joint2": 1.0, "other": 2.0}) == {
        "left_joint2": 1.0 + found.offsets["left_joint2"],
        "other": 2.0,
    }
    rigid = calibrated(robot, mount, seen)
    assert rigid.residual > 10.0 * found.residual  # what joints are off by is seen where it is not sought


def test_a_small_tag_needs_several_starts_and_gets_its_covariance(robot: Robot) -> None:
    camera, _ = truth(robot, "board on the hand")
    off = OFF.copy()
    OFF.clear()
    try:
        seen = views(robot, "board on the hand", TAG, noise=0.3)
    finally:
        OFF.update(off)
    found = calibrated(robot, "board on the hand", seen, TAG)
    apart = np.linalg.inv(found.camera.pose) @ camera.pose
    error = np.concatenate([apart[:3, 3], pin.log3(apart[:3, :3])])
    assert error @ np.linalg.solve(found.covariance, error) < 22.5  # 99.9 % of six degrees of freedom
    assert np.linalg.norm(error[:3]) < 5e-3 and 1e-4 < found.camera.position_spread < 5e-3


def test_derivatives_are_those_of_differences(robot: Robot) -> None:
    seen, names = views(robot, "board on the hand", count=4), ("left_joint2", "left_joint5")
    fit = _Fit(robot, CAMERA, BOARD, seen, board_link=LINK, offsets=names)
    fit._x, fit._y = truth(robot, "board on the hand")[0].pose, truth(robot, "board on the hand")[1]
    at, step = np.random.default_rng(3).normal(0.0, 0.01, 14), 1e-6
    expected = [(fit._residuals(at + step * e) - fit._residuals(at - step * e)) / (2.0 * step) for e in np.eye(14)]
    np.testing.assert_allclose(fit._jacobian(at), np.stack(expected, axis=1), atol=2e-3)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda seen: seen[:3], "3 of 3"),
        (lambda seen: None, "views"),
        (lambda seen: [*seen, 1], "view 20"),
        (lambda seen: [View(one.state, one.pixels * np.nan) for one in seen], "0 of 20"),
        (lambda seen: [View(one.state[:5], one.pixels) for one in seen], "state of view 0"),
        (lambda seen: [View(one.state, one.pixels[:9]) for one in seen], "corners of view 0"),
        (
            lambda seen: [View(a.state, b.pixels) for a, b in zip(seen, seen[1:] + seen[:1], strict=True)],
            "belong together",
        ),
    ],
)
def test_views_that_do_not_do_are_refused(robot: Robot, change: Any, named: str) -> None:
    with pytest.raises(ParameterError, match=named):
        calibrated(robot, "board on the hand", change(views(robot, "board on the hand")))


def test_small_turns_are_refused(robot: Robot) -> None:
    with pytest.raises(ParameterError, match="second axis"):
        calibrated(robot, "board on the hand", views(robot, "board on the hand", turn=0.01))


@pytest.mark.parametrize(
    "options", [{"board_link": None}, {"board_link": "no_link"}, {"board_link": LINK, "offsets": ("no_joint",)}]
)
def test_unknown_links_and_joints_are_refused(robot: Robot, options: dict[str, Any]) -> None:
    with pytest.raises(ApexError):
        calibrate(robot, CAMERA, BOARD, views(robot, "board on the hand", count=4), **options)


def frames(robot: Robot, count: int = 8, scale: float = 1.0, noise: float = 0.0) -> list[Frame]:
    """Return frames of the board on the hand, of an arm without offsets, with a wall 20 cm behind the board.

    Args:
        robot: The robot.
        count: Number of frames.
        scale: Factor by which measured depths become true ones; 0 without depths.
        noise: Standard deviation of a depth z over z^2 [1/m].
    """
    off = OFF.copy()
    OFF.clear()
    try:
        seen = views(robot, "board on the hand", LARGE, count=count)
    finally:
        OFF.update(off)
    (camera, board), rng, made = truth(robot, "board on the hand"), np.random.default_rng(0), []
    for k, one in enumerate(seen):
        pose = np.linalg.inv(camera.pose) @ robot.link_pose(one.state, LINK) @ board
        depth = depths(pose, rng, noise) / scale if scale else np.zeros((480, 640))
        joints = dict(zip(robot.joint_names, one.state, strict=True))
        made.append(Frame(CAMERA, depth, picture(LARGE, pose), float(k), joints))
    return made


def depths(pose: np.ndarray, rng: np.random.Generator, noise: float) -> np.ndarray:
    """Return depths of a board that is 5 cm larger than its corners, before a wall, shape (480, 640) [m]."""
    corners = [[x, y, 0.0] for x, y in np.abs(LARGE.corners[:, :2]).max(axis=0) * [[-1, -1], [1, -1], [1, 1], [-1, 1]]]
    outline = CAMERA.project(1.3 * np.array(corners) @ pose[:3, :3].T + pose[:3, 3])
    inside = cv2.fillConvexPoly(np.zeros((480, 640), np.uint8), np.round(outline).astype(np.int32), 1).astype(bool)
    plane = (pose[:3, 2] @ pose[:3, 3]) / (CAMERA.grid @ pose[:2, 2] + pose[2, 2])
    true = np.where(inside, plane, plane.max() + 0.2)
    return true + noise * true**2 * rng.normal(size=true.shape)


def test_frames_are_calibrated_by_the_command_line(robot: Robot, tmp_path: Path, apex_cli: Any) -> None:
    blank = Frame(CAMERA, np.zeros((480, 640)), np.zeros((480, 640, 3), np.uint8), 100.0, frames(robot, 1)[0].joints)
    save_sequence([*frames(robot, scale=0.0), blank], tmp_path / "frames")
    board = ("--board", "charuco:5x4:0.06")
    done = apex_cli("calibrate", tmp_path / "frames", *board, "--board-link", LINK, "-o", tmp_path / "camera.yaml")
    assert done.returncode == 0 and "8 of 9 frames" in done.stdout and "depth       as before" in done.stdout
    found = Camera.load(tmp_path / "camera.yaml")
    true, _ = truth(robot, "board on the hand")
    assert np.linalg.norm(found.pose[:3, 3] - true.pose[:3, 3]) < 5e-3


def test_frames_of_two_cameras_are_refused(robot: Robot, tmp_path: Path, apex_cli: Any) -> None:
    seen = frames(robot, 4)
    other = CAMERA.model_copy(update={"focal": (470.0, 470.0)})
    save_sequence([*seen, Frame(other, seen[0].depth, seen[0].color, 9.0, seen[0].joints)], tmp_path / "frames")
    options = ("--board", "charuco:5x4:0.06", "--board-link", LINK, "-o", tmp_path / "camera.yaml")
    done = apex_cli("calibrate", tmp_path / "frames", *options)
    assert done.returncode == 2 and "frame 4: expected frames of one camera" in done.stderr


def test_scale_and_noise_of_depths_are_found(robot: Robot, tmp_path: Path, apex_cli: Any) -> None:
    seen = frames(robot, 8, scale=1.02, noise=0.004)
    found = calibrated(
        robot, "board on the hand", [View(f.state(robot.joint_names), LARGE.find(f.color)) for f in seen], LARGE
    )
    depth = measured_depths(found, robot, LARGE, seen, board_link=LINK)
    assert depth is not None and abs(depth.scale - 1.02) < 0.002 and 1e-4 <= depth.scale_spread < 0.002
    assert depth.noise == pytest.approx(0.004, rel=0.1)
    assert measured_depths(found, robot, LARGE, seen[:3], board_link=LINK) is None
    with pytest.raises(ParameterError, match="images of shape"):
        small = Camera(width=64, height=48, focal=(46.5, 46.5), center=(32.0, 24.0))
        measured_depths(
            found, robot, LARGE, [Frame(small, np.ones((48, 64)), None, 0.0, seen[0].joints)], board_link=LINK
        )
    save_sequence(seen, tmp_path / "frames")
    options = ("--board", "charuco:5x4:0.06", "--board-link", LINK, "-o", tmp_path / "camera.yaml")
    done = apex_cli("calibrate", tmp_path / "frames", *options)
    assert done.returncode == 0 and "depth       scale 1.0" in done.stdout
    assert abs(Camera.load(tmp_path / "camera.yaml").depth.scale - 1.02) < 0.002


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (("--board", "charuco:9x6"), "--board"),
        (("--board", "poster:9x6:0.02"), "kind"),
        (("--board", "chessboard:9x7:0.02"), "odd and an even"),
        (("--board-link", "no_link"), "no_link"),
        (("--board-link", LINK, "--offsets", "no_joint"), "no_joint"),
        (("--board-link", LINK, "--camera", "none.yaml"), "none.yaml"),
        (("--board-link", LINK, "--camera", "small.yaml"), "320 x 240"),
        (("--board-link", LINK, "--robot", "none"), "none"),
        ((), "board_link"),
        (("--board-link", LINK, "--board", "chessboard:9x6:0.03"), "0 of 4 show it"),
    ],
)
def test_faulty_options_are_named(
    robot: Robot, tmp_path: Path, apex_cli: Any, options: tuple[str, ...], named: str
) -> None:
    save_sequence(frames(robot, 4), tmp_path / "frames")
    Camera(width=320, height=240, focal=(232.0, 232.0), center=(159.5, 119.5)).save(tmp_path / "small.yaml")
    options = tuple(str(tmp_path / option) if option == "small.yaml" else option for option in options)
    board = ("--board", "charuco:5x4:0.06")
    done = apex_cli("calibrate", tmp_path / "frames", *board, *options, "-o", tmp_path / "camera.yaml")
    assert done.returncode == 2 and named in done.stderr and not (tmp_path / "camera.yaml").exists()
