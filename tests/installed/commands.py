"""Calls of every command of the command line, with every option."""

from __future__ import annotations

import argparse
import signal
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import apex_ompl
from apex_ompl.cli.parser import _parser
from apex_ompl.perception import Camera, Frame, look_at, save_sequence

ELSEWHERE = {"--address"}  # needs a Ray cluster
BLOCK = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 0.1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"
SCENE = """
robot_state: {joint_state: {name: [panda_joint1], position: [0.0]}}
world:
  collision_objects:
    - id: pillar
      header: {frame_id: base_link}
      primitives: [{type: 1, dimensions: [0.1, 0.1, 0.1]}]
      primitive_poses: [{position: {x: 0.6, y: 0.0, z: 0.3}, orientation: {w: 1.0}}]
"""
REQUEST = "goal_constraints: [{joint_constraints: [{joint_name: panda_joint1, position: -0.5}]}]\n"

CALLS: tuple[tuple[tuple[int, ...], str], ...] = (  # exit codes that may be, and arguments
    ((0,), "--version"),
    ((0,), "problems"),
    ((0,), "planners"),
    ((0,), "info"),
    ((0,), "schema"),
    ((0,), "check own.yaml"),
    ((0,), "sequence pick_and_hand_over --asynchronous --timeout 30"),
    *(
        ((0,), f"{command} {rest}")
        for command in ("plan", "sequence")
        for rest in (
            "own.yaml --model apex --timeout 20 --out plan.npz --snapshot --leave-contact 0.001",
            "own.yaml --planner rrtconnect --params params.yaml --set range=0.7 --seed 1 --timeout 20 --no-simplify "
            "--timing-method spline --velocity-scale 0.9 --acceleration-scale 0.9 --jerk-scale 0.9 "
            "--max-velocity left_joint1=1.5 --max-acceleration left_joint1=10 --max-jerk left_joint1=1000 "
            "--minimum-duration 2.5 --out motion.traj.yaml --controllers --json",
            "own.yaml --timeout 20 --out sampled.csv --rate 1000 --joints left_arm,right_hand_synergy",
            "ball_in_cup --timeout 20 --no-timing --out path.json",
            "ball_in_cup --timeout 20 --objective calm --calm-factor 1.3 --max-tool-speed 1.0 --payload left_hand=0.5 "
            "--torque-scale 0.9 --max-torque left_joint1=80",
            "ball_in_cup --timeout 20 --objective length --no-torque-limits",
        )
    ),
    (
        (0, 1),
        "run popup/vertical/large/12 --method no-network --clock sim --prediction cv --speed 0.9 --budget 0.05 "
        "--latency 0.05 --timeout 4 --evade risk --seed 1 --out run.npz --json",
    ),
    ((0, 1), "run own.yaml --clock real --timeout 3 --out real.json"),
    ((0, 1), "run own.yaml --driver kinematic --timeout 3"),
    (
        (0, 1, 2),
        "run own.yaml --driver mujoco --asynchronous --seed 1 --timeout 20 --out task.npz --json",
    ),  # 2 without MuJoCo
    ((2,), "run own.yaml --driver mujoco --film task.gif"),
    ((0, 1), "run interceptor/vertical/small/800000 --method no-network --camera --cameras eye.yaml --timeout 2"),
    ((0, 1, 2, 3), "run own.yaml --camera --cubes 1 --timeout 20"),  # 2 without MuJoCo or OpenGL
    ((2,), "ros2 own.yaml --ros-args -p speed:=7.0"),  # without ROS as well as with a faulty parameter
    ((0,), "render plan.npz --out plan.png --azimuth 10"),
    ((0,), "plot plan.npz --out plan.svg"),
    ((0,), "plot run.npz --out run.png"),
    ((0,), "view own.yaml plan.npz run.npz --out page.html --cover"),
    (
        (0,),
        "convert scene.yaml request.yaml --out converted.yaml --robot dual_panda_softhand "
        "--joint panda_joint1=left_joint1 --frame base_link=world",
    ),
    ((0,), "check converted.yaml"),
    (
        (0,),
        "calibrate frames --board charuco:5x4:0.06 --board-link left_hand_palm --offsets left_joint2 --camera eye.yaml "
        "--robot dual_panda_softhand --out camera.yaml",
    ),
    ((0,), "calibrate others --board charuco:5x4:0.06 --camera-link left_hand_palm --out carried.yaml"),
    ((1,), "see frames others --robot dual_panda_softhand --out seen.png --json"),  # whose frames have no depths
    ((1,), "see frames --problem stack_boxes"),
    (
        (0,),
        "bench posts/easy --planners apex,rrtconnect --runs 1 --timeout 5 --seed 1 --split validation --no-simplify "
        "--jobs 1 --keep --quiet --out results",
    ),
    ((0,), "report results --out report"),
    (
        (0,),
        "robot new arm.urdf --srdf arm.srdf --at 0.1,0,0,1.5 --package meshes=. --out arm.robot.yaml",
    ),
    ((0,), "robot check arm.robot.yaml --samples 100 --json"),
    (
        (0,),
        "robot prepare arm.robot.yaml --budget 120 --jobs 2 --effort 1 --samples 600 --margin 0.01 --seed 1 --soft arm "
        "--graze 0",
    ),
    ((0,), "robot check arm.robot.yaml"),
    ((0,), "robot train arm.robot.yaml --hours 0.001 --jobs 1 --seed 1 --out training"),
    ((2,), "robot train arm.robot.yaml --hours 0"),
    ((2,), "robot new gone.urdf"),
)
WRITTEN = (
    "plan.npz", "motion.traj.yaml", "path.json", "run.npz", "real.json", "plan.png", "plan.svg", "run.png", "page.html",
    "arm.robot.yaml", "arm.spheres.json", "arm.model/README.md", "converted.yaml", "camera.yaml", "carried.yaml",
    "seen.png", "report/report.html", "report/report.md",
)  # fmt: skip


def run(_: Path) -> list[str]:
    """Run all calls in this folder, which holds nothing, and return the commands and options that none has."""
    _write_inputs()
    for codes, arguments in CALLS:
        done = subprocess.run(
            [_command(), *arguments.split()], check=False, capture_output=True, text=True, timeout=300
        )
        if done.returncode not in codes or "Traceback" in done.stderr:
            sys.exit(f"apex-ompl {arguments}: exit code {done.returncode}\n{done.stdout}{done.stderr}")
    for name in WRITTEN:
        if not Path(name).stat().st_size:
            sys.exit(f"{name} is empty")
    said = {word for _, arguments in CALLS for word in arguments.split()} | set(_serve())
    return [name for name in _known() if name not in said]


def _command() -> str:
    return str(Path(sys.executable).with_name("apex-ompl"))


def _write_inputs() -> None:
    """Write the files that commands read: a problem with a mesh, parameters, and a scene and request of MoveIt's."""
    robot = apex_ompl.load_robot("dual_panda_softhand")
    Path("block.obj").write_text(BLOCK)
    with apex_ompl.MotionPlanner() as planner:
        planner.world.add(name="post", box=(0.1, 0.1, 0.6), position=(0.5, 0.0, 0.3))
        planner.world.add(name="block", mesh={"file": "block.obj"}, position=(0.6, 0.4, 0.0))
        start, goal = robot.home.copy(), robot.home.copy()
        start[[0, 1, 3]], goal[[0, 1, 3]] = (0.1, 0.4, -1.6), (-0.6, 0.4, -1.6)
        planner.problem(start, goal, "own").save("own.yaml")
        home = dict(zip(robot.joint_names, robot.home.tolist(), strict=True))
    Path("params.yaml").write_text("range: 0.5\n")
    _write_arm()
    _write_frames(robot)
    names, values = ", ".join(["panda_joint1", *robot.joint_names[1:]]), ", ".join(map(str, home.values()))
    Path("scene.yaml").write_text(SCENE.replace("[panda_joint1]", f"[{names}]").replace("[0.0]", f"[{values}]"))
    Path("request.yaml").write_text(REQUEST)


def _write_arm() -> None:
    """Write the URDF and the SRDF of an arm of four bars."""
    bar = '<collision><origin xyz="0 0 0.1"/><geometry><cylinder radius="0.02" length="0.16"/></geometry></collision>'
    text = f'<link name="bar0">{bar}</link>'
    for k in range(1, 5):
        text += f'<link name="bar{k}">{bar}</link><joint name="turn{k}" type="revolute"><parent link="bar{k - 1}"/>'
        text += f'<child link="bar{k}"/><origin xyz="0 0 0.25"/><axis xyz="{k % 2} {1 - k % 2} 0"/>'
        text += '<limit lower="-1.5" upper="1.5" velocity="2" effort="1"/></joint>'
    Path("arm.urdf").write_text(f'<robot name="arm">{text}</robot>')
    chain = '<group name="arm"><chain base_link="bar0" tip_link="bar4"/></group>'
    Path("arm.srdf").write_text(f'<robot name="arm">{chain}</robot>')


def _write_frames(robot: apex_ompl.Robot) -> None:
    """Write frames of a board on the left hand, seen from the front, and of one that stands still, seen by the hand."""
    camera = Camera(width=640, height=480, focal=(465.0, 465.0), center=(319.5, 239.5))
    palm = robot.link_pose(robot.home, "left_hand_palm")
    before = look_at(palm[:3, 3] + [1.0, 0.2, 0.5], palm[:3, 3])
    facing = before.copy()
    facing[:3, 3] = palm[:3, 3]
    camera.placed(before).save("eye.yaml")
    for folder, carried in (("frames", False), ("others", True)):
        rng, frames = np.random.default_rng(0), []
        while len(frames) < 6:
            q = robot.home + rng.normal(0.0, 0.3, robot.dof) * (np.arange(robot.dof) < 7)
            moved = np.linalg.inv(palm) @ robot.link_pose(q, "left_hand_palm")  # of the hand, in its frame
            board = np.linalg.inv(before) @ palm @ (np.linalg.inv(moved) if carried else moved) @ np.linalg.inv(palm)
            color = _board_image(camera, board @ facing)
            joints = dict(zip(robot.joint_names, q.tolist(), strict=True))
            if color is not None:
                frames.append(Frame(camera, np.zeros((480, 640)), color, float(len(frames)), joints))
        save_sequence(frames, folder)


def _board_image(camera: Camera, pose: Any) -> Any:
    """Return the image of a board of 6 times 5 squares of 6 cm, or None where a part of it is outside."""
    import cv2  # here, since the words of the calls are read without it

    markers = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_250)
    board = cv2.aruco.CharucoBoard((6, 5), 0.06, 0.045, markers).generateImage((240, 200))
    ends = np.array([[0, 0], [240, 0], [240, 200], [0, 200]], np.float32)
    flat = np.concatenate([(ends - [120, 100]) * 0.06 / 40, np.zeros((4, 1))], axis=1)
    seen = camera.project(flat @ pose[:3, :3].T + pose[:3, 3])
    if not ((seen > 0.0) & (seen < (640, 480))).all() or pose[2, 2] < 0.5:
        return None
    warp = cv2.getPerspectiveTransform(ends - np.float32(0.5), seen.astype(np.float32))
    return cv2.cvtColor(cv2.warpPerspective(board, warp, (640, 480), borderValue=128), cv2.COLOR_GRAY2RGB)


def _serve() -> Iterator[str]:
    """Show a problem in a page that is served, load it, and stop; yield the words of the call."""
    words = ["view", "own.yaml", "--no-browser", "--port", "18231"]
    with subprocess.Popen([_command(), *words], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as server:
        assert server.stdout is not None
        address = next(word for word in server.stdout.readline().split() if word.startswith("http"))
        with urllib.request.urlopen(address, timeout=60) as answer:
            page = answer.read()
        server.send_signal(signal.SIGINT)
        server.communicate(timeout=60)
    if b"<html" not in page or server.returncode not in (0, 130):
        sys.exit(f"apex-ompl {' '.join(words)}: exit code {server.returncode}, {len(page)} bytes")
    yield from words


def _known() -> Iterator[str]:
    """Yield the names of all commands, and the longest name of each of their options."""
    yield from _words_of(_parser())


def _words_of(parser: argparse.ArgumentParser) -> Iterator[str]:
    """Yield the names of a parser's commands and options, and those of each of its commands."""
    actions: list[Any] = parser._actions
    for action in actions:
        if isinstance(action, argparse._SubParsersAction):
            yield from action.choices
            for inner in action.choices.values():
                yield from _words_of(inner)
            continue
        option = max(action.option_strings, key=len, default="")
        if option and option not in ELSEWHERE | {"--help"}:
            yield option
