"""Hand-eye calibration on synthetic corners: errors of the camera relative to the arm.

The camera stands 1 to 1.4 m in front of the left hand, which carries the board; or it is carried by the left hand, and
the board stands still. States are drawn about home, so that all corners are in the image. Errors are those of the pose
of the arm's sixth link in the camera's frame in 20 new states: largest position error of a trial [mm] and rotation
error [degrees]; p95 of the trials. "own sd" is the position's standard deviation by the covariance, "within" the share
of the trials whose error of the camera's pose is within the 95 % ellipsoid of the covariance.

Usage: python -m benchmarks.perception.hand_eye [-n 100]
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from tqdm import tqdm

from apex_ompl.errors import ParameterError
from apex_ompl.perception import Board, Calibration, Camera, View, calibrate, look_at
from apex_ompl.problems.suite_robot import robot
from apex_ompl.robot import Robot
from apex_ompl.util.entry_point import run_script
from benchmarks.lib import record

DEPENDS = (
    "apex_ompl/perception/boards.py", "apex_ompl/perception/camera.py", "apex_ompl/perception/hand_eye.py",
    "apex_ompl/robot/model.py",
)  # fmt: skip
CAMERA = Camera(
    width=640, height=480, focal=(465.0, 465.0), center=(319.5, 239.5), distortion=(0.05, -0.1, 1e-3, -5e-4, 0.0)
)
BOARD, TAG = Board(columns=9, rows=6, square=0.025), Board(kind="tag", square=0.06)
LINK, SIXTH = "left_hand_palm", "left_link6"
MIDDLE = tuple(f"left_joint{k}" for k in range(2, 7))
CHI_SQUARED = 12.592  # 95 % of six degrees of freedom
MARGIN = 5.0  # of corners from the image's border [pixels]


@dataclass(frozen=True)
class Case:
    """A row: the board, what errors there are, and what is found."""

    name: str
    board: Board = BOARD
    poses: int = 20
    pixels: float = 0.3
    turn: float = 0.6  # standard deviation of the joints [rad]
    off: float = 0.0  # standard deviation of the offsets of joints 2 to 6 [degrees]
    ends_off: float = 0.0  # of joints 1 and 7 [degrees]
    found: tuple[str, ...] = ()
    on_hand: bool = False
    focal: float = 1.0  # true over assumed
    shifted: bool = False  # states and images by one


CASES = (
    Case("board"), Case("10 poses", poses=10), Case("5 poses", poses=5), Case("tag of 60 mm", TAG),
    Case("camera on the hand", on_hand=True), Case("offsets of .2 deg, not sought", off=0.2),
    Case("offsets of .2 deg, found", off=0.2, found=MIDDLE), Case("no offsets, sought", found=MIDDLE),
    Case("offsets of .2 deg, 40 poses", poses=40, off=0.2, found=MIDDLE),
    Case("the same, joints 1 and 7 off as well", poses=40, off=0.2, ends_off=0.2, found=MIDDLE),
    Case("focal length off .5 %", focal=1.005), Case("turns of 1 deg", turn=0.017),
    Case("states and images shifted by one", shifted=True),
)  # fmt: skip


@dataclass
class Truth:
    """What is to be found: the camera, the board on its mount, and offsets of joints, shape (dof,) [rad]."""

    camera: Camera
    board: np.ndarray
    offsets: np.ndarray


def drawn(case: Case, rng: np.random.Generator, made: Robot) -> tuple[Truth, list[View]]:
    """Return the truth and the views of a trial."""
    home = made.home.copy()
    palm = made.link_pose(home, LINK)
    around, above = rng.uniform(-0.7, 0.7), rng.uniform(0.1, 0.9)
    away = np.array([np.cos(around) * np.cos(above), np.sin(around) * np.cos(above), np.sin(above)])
    eye = palm[:3, 3] + rng.uniform(1.0, 1.4) * away
    camera = look_at(eye, palm[:3, 3])
    board = pin.SE3(pin.exp3(rng.normal(0.0, 0.2, 3)), rng.normal(0.0, 0.04, 3)).homogeneous
    seen = np.linalg.inv(palm) @ _at(camera[:3, :3], palm[:3, 3]) @ board
    if case.on_hand:
        mounted = np.linalg.inv(palm) @ look_at(palm[:3, 3], palm[:3, 3] + 0.7 * away)
        seen = _at(look_at(palm[:3, 3], palm[:3, 3] + away)[:3, :3], palm[:3, 3] + 0.7 * away) @ board
        true = CAMERA.model_copy(update={"link": LINK}).placed(mounted)
    else:
        true = CAMERA.placed(camera)
    offsets = np.zeros(len(home))
    offsets[1:6] = np.deg2rad(case.off) * rng.normal(size=5)
    offsets[[0, 6]] = np.deg2rad(case.ends_off) * rng.normal(size=2)
    wide = true.model_copy(update={"focal": tuple(case.focal * f for f in true.focal)})
    truth, views = Truth(true, seen, offsets), []
    while len(views) < case.poses:
        q = home.copy()
        q[:7] += rng.normal(0.0, case.turn, 7)
        pixels = None if made.limit_fault(q) else _corners(case, truth, wide, made, q)
        if pixels is not None:
            views.append(View(q, pixels + rng.normal(0.0, case.pixels, pixels.shape)))
    if case.shifted:
        states = [view.state for view in views]
        views = [View(q, view.pixels) for q, view in zip(states[1:] + states[:1], views, strict=True)]
    return truth, views


def _at(turn: np.ndarray, place: np.ndarray) -> np.ndarray:
    return np.asarray(pin.SE3(turn, place).homogeneous)


def _corners(case: Case, truth: Truth, camera: Camera, made: Robot, q: np.ndarray) -> np.ndarray | None:
    """Return the corners in the image, or None where some are outside or the board is seen from the side."""
    hand, corners = made.link_pose(q + truth.offsets, LINK), case.board.corners
    pose = (
        np.linalg.inv(hand @ camera.pose) @ truth.board
        if case.on_hand
        else np.linalg.inv(camera.pose) @ hand @ truth.board
    )
    if pose[2, 2] < 0.5 or pose[2, 3] < 0.3:
        return None
    pixels = camera.project(corners @ pose[:3, :3].T + pose[:3, 3])
    size = (camera.width - MARGIN, camera.height - MARGIN)
    return pixels if (pixels > MARGIN).all() and (pixels < size).all() else None


def errors(case: Case, truth: Truth, found: Calibration, made: Robot, rng: np.random.Generator) -> dict[str, float]:
    """Return the errors of a trial."""
    places, turns = [], []
    offsets = np.zeros(len(made.home))
    for name, value in found.offsets.items():
        offsets[made.joint_names.index(name)] = value
    for _ in range(20):
        q = made.home.copy()
        q[:7] += rng.normal(0.0, 0.4, 7)
        q = np.clip(q, made.limits.lower, made.limits.upper)
        true, seen = (
            np.linalg.inv(camera.pose_at(made, q + off))
            @ (np.eye(4) if case.on_hand else made.link_pose(q + off, SIXTH))
            for camera, off in ((truth.camera, truth.offsets), (found.camera, offsets))
        )
        if case.on_hand:  # of a point of the board
            true, seen = (m @ b for m, b in ((true, truth.board), (seen, found.board)))
        places.append(np.linalg.norm(seen[:3, 3] - true[:3, 3]))
        turns.append(np.linalg.norm(pin.log3(true[:3, :3].T @ seen[:3, :3])))
    apart = np.linalg.inv(found.camera.pose) @ truth.camera.pose
    off = np.concatenate([apart[:3, 3], pin.log3(apart[:3, :3])])
    within = float(off @ np.linalg.solve(found.covariance, off) < CHI_SQUARED)
    missed = [abs(np.rad2deg(truth.offsets - offsets))[1:6].max()] if found.offsets else [np.nan]
    return {
        "mm": 1e3 * max(places), "deg": float(np.rad2deg(max(turns))), "rms": found.residual,
        "sd": 1e3 * found.camera.position_spread, "within": within,
        "offset": float(missed[0]),
    }  # fmt: skip


def main() -> None:
    """Measure, and write the results."""
    parser = record.parser(__doc__ or "")
    parser.add_argument("-n", type=int, default=100, help="trials of a row (default: %(default)s)")
    given, made = parser.parse_args(), robot()
    head = (
        "case", "N", "refused", "position p50 mm", "p95", "rotation p50 deg", "p95", "offsets off by deg p95", "rms px",
        "own sd mm", "within", "s",
    )  # fmt: skip
    lines, rows = [record.row(list(head)), record.row(["---"] * len(head))], []
    for case in tqdm(CASES):
        rng, kept, refused, started = np.random.default_rng(7), [], [], time.process_time()
        for _ in range(given.n):
            truth, views = drawn(case, rng, made)
            camera = CAMERA.model_copy(update={"link": truth.camera.link})
            try:
                found = calibrate(
                    made, camera, case.board, views, board_link=None if case.on_hand else LINK, offsets=case.found
                )
            except ParameterError as error:
                refused.append(str(error))
            else:
                kept.append(errors(case, truth, found, made, rng))
        spent = (time.process_time() - started) / given.n
        cells: list[Any] = [case.name, given.n, len(refused)]
        if kept:
            column = {name: np.array([one[name] for one in kept]) for name in kept[0]}
            cells += [f"{np.percentile(column['mm'], k):.2f}" for k in (50, 95)]
            cells += [f"{np.percentile(column['deg'], k):.3f}" for k in (50, 95)]
            cells += [f"{np.percentile(column['offset'], 95):.3f}" if case.found else ""]
            cells += [
                f"{np.median(column['rms']):.2f}",
                f"{np.median(column['sd']):.2f}",
                f"{column['within'].mean():.2f}",
            ]
        else:
            cells += [""] * 8
        lines.append(record.row([*cells, f"{spent:.2f}"]))
        rows.append({"case": case.name, "trials": kept, "refused": refused, "cpu_s": spent})
    record.write("perception_hand_eye", {"rows": rows}, "\n".join(lines), n=given.n)


if __name__ == "__main__":
    run_script(main)
