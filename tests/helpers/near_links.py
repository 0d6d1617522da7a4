"""An arm whose links are close to those two joints away: a slide, a mesh, and a joint that follows another."""

from __future__ import annotations

from pathlib import Path

from support import STEP

ROBOT = """schema: apex-ompl/robot/1
name: near_links
parts:
  - {name: arm, urdf: near_links.urdf}
joints:
  turn: {home: 0.3, acceleration: 10, jerk: 200}
  lift: {home: 0.1, acceleration: 10, jerk: 200}
  bend: {home: 0.2, acceleration: 10, jerk: 200}
"""
BOX, STEPS = '<box size="{}"/>', '<mesh filename="{}" scale="0.4 0.4 0.4"/>'
LINK = '<link name="{}"><collision><origin xyz="{}"/><geometry>{}</geometry></collision></link>\n'
JOINT = """<joint name="{name}" type="{kind}"><parent link="{above}"/><child link="{below}"/>
<origin xyz="{at}"/><axis xyz="{axis}"/><limit lower="{low}" upper="{high}" velocity="3" effort="1"/>{more}</joint>
"""
LINKS = ("base", "column", "upper", "lower", "tip")


def write_arm(folder: Path) -> Path:
    """Write the robot and its URDF; return the robot's file."""
    (folder / "step.obj").write_text(STEP)
    shapes = [
        ("0 0 0.1", BOX.format("0.24 0.16 0.2")), ("0 0 0", '<sphere radius="0.05"/>'),
        ("0.15 0 0", STEPS.format(folder / "step.obj")), ("0.1 0 0.02", STEPS.format(folder / "step.obj")),
        ("0.05 0 0", '<cylinder radius="0.03" length="0.1"/>'),
    ]  # fmt: skip
    text = "".join(LINK.format(name, *shape) for name, shape in zip(LINKS, shapes, strict=True))
    joints = [
        ("turn", "revolute", "0 0 0.26", "0 0 1", -2.5, 2.5, ""),
        ("lift", "prismatic", "0 0 0.0", "0 0 1", -0.1, 0.3, ""),
        ("bend", "revolute", "0.3 0 0", "0 1 0", -2.0, 2.0, ""),
        ("follow", "revolute", "0.2 0 0", "0 1 0", -2.0, 2.0, '<mimic joint="bend" multiplier="0.7" offset="0.2"/>'),
    ]  # fmt: skip
    for k, (name, kind, at, axis, low, high, more) in enumerate(joints):
        text += JOINT.format(
            name=name, kind=kind, at=at, axis=axis, low=low, high=high, more=more, above=LINKS[k], below=LINKS[k + 1]
        )
    (folder / "near_links.urdf").write_text(f'<robot name="near_links">{text}</robot>')
    (folder / "near_links.robot.yaml").write_text(ROBOT)
    return folder / "near_links.robot.yaml"
