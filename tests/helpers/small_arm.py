"""An arm of three joints and plain shapes, which is drawn and planned for in no time."""

from __future__ import annotations

from pathlib import Path

from apex_ompl.scene.problem import Problem

ROBOT = """schema: apex-ompl/robot/1
name: small_arm
parts:
  - {name: arm, urdf: small_arm.urdf}
joints:
  turn: {home: 0.0, acceleration: 10, jerk: 200}
  shoulder: {home: 0.4, acceleration: 10, jerk: 200}
  elbow: {home: 0.6, acceleration: 10, jerk: 200}
"""
SHAPE = '<{kind}><origin xyz="0 0 {middle}"/><geometry>{shape}</geometry></{kind}>'
LINK = '<link name="{name}">' + SHAPE.replace("{kind}", "visual") + SHAPE.replace("{kind}", "collision") + "</link>\n"
JOINT = """<joint name="{name}" type="revolute"><parent link="{above}"/><child link="{below}"/><origin xyz="0 0 {at}"/>
<axis xyz="{axis}"/><limit lower="-2" upper="2" velocity="3" effort="1"/></joint>
"""
START, GOAL = ({"turn": turn, "shoulder": 0.4, "elbow": 0.6} for turn in (-0.9, 0.9))


def write_arm(folder: Path) -> Path:
    """Write the robot and its URDF; return the robot's file."""
    bar = '<box size="0.06 0.06 0.3"/>'
    links = [("base", 0.1, '<cylinder radius="0.1" length="0.2"/>'), ("column", 0.1, '<sphere radius="0.05"/>')]
    links += [("upper", 0.22, bar), ("lower", 0.22, bar)]
    joints = [("turn", "0 0 1", 0.25), ("shoulder", "0 1 0", 0.1), ("elbow", "0 1 0", 0.42)]
    text = "".join(LINK.format(name=name, middle=middle, shape=shape) for name, middle, shape in links)
    for k, (name, axis, at) in enumerate(joints):
        text += JOINT.format(name=name, axis=axis, at=at, above=links[k][0], below=links[k + 1][0])
    (folder / "small_arm.urdf").write_text(f'<robot name="small_arm">{text}</robot>')
    (folder / "small_arm.robot.yaml").write_text(ROBOT)
    return folder / "small_arm.robot.yaml"


def write_endless(folder: Path, joints: tuple[str, ...] = ("turn",), more: str = "") -> Path:
    """Write the small arm with continuous joints and further elements; return the robot's file."""
    file = write_arm(folder)
    urdf = folder / "small_arm.urdf"
    text = urdf.read_text()
    for name in joints:
        text = text.replace(f'name="{name}" type="revolute"', f'name="{name}" type="continuous"')
    urdf.write_text(text.replace("</robot>", more + "</robot>"))
    return file


def arm_problem(folder: Path) -> Problem:
    """A turn of the arm past a wall."""
    wall = {"name": "wall", "box": [0.3, 0.05, 1.0], "position": [0.45, 0.0, 0.5]}
    return Problem(name="past_a_wall", robot=str(write_arm(folder)), scene=[wall], start=START, goal={"joints": [GOAL]})
