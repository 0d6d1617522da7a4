"""A small robot of boxes and its SRDF: an arm of four joints on a stand, with a gripper of two fingers."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

AXES = ("0 0 1", "0 1 0", "0 1 0", "0 1 0")
LIMIT = '<limit lower="-2" upper="2" velocity="2" effort="10"/>'
SHAPE = '<collision><origin xyz="0 0 {middle}"/><geometry><box size="{size}"/></geometry></collision>'
BOX = '<link name="{name}">' + SHAPE + "</link>"
SRDF = """<robot name="toy">
<group name="manipulator"><chain base_link="stand" tip_link="part4"/></group>
<group name="gripper"><joint name="grip1"/></group>
<group_state name="folded" group="manipulator"><joint name="joint1" value="0"/><joint name="joint2" value="0.9"/>
<joint name="joint3" value="-1.1"/><joint name="joint4" value="0.7"/></group_state>
<end_effector name="tool" parent_link="part4" group="gripper"/>
<disable_collisions link1="stand" link2="part1" reason="Adjacent"/>
</robot>"""


def toy_urdf(edits: Mapping[str, str] | None = None) -> str:
    """Return the URDF with some texts replaced by others."""
    links = [BOX.format(name="stand", middle=0.1, size="0.2 0.2 0.2")]
    links += [BOX.format(name=f"part{k}", middle=0.14, size="0.06 0.06 0.2") for k in (1, 2, 3, 4)]
    links += [BOX.format(name=f"finger{k}", middle=0.03, size="0.01 0.02 0.04") for k in (1, 2)]
    joints = []
    for k, axis in enumerate(AXES):
        above = f"part{k}" if k else "stand"
        joints.append(
            f'<joint name="joint{k + 1}" type="revolute"><parent link="{above}"/><child link="part{k + 1}"/>'
            f'<origin xyz="0 0 {0.28 if k else 0.22}"/><axis xyz="{axis}"/>{LIMIT}</joint>'
        )
    for k, side in ((1, 1), (2, -1)):
        mimic = '<mimic joint="grip1" multiplier="-1"/>' if k == 2 else ""
        limit = '<limit lower="-0.02" upper="0.02" velocity="0.1" effort="1"/>'
        joints.append(
            f'<joint name="grip{k}" type="prismatic"><parent link="part4"/><child link="finger{k}"/>'
            f'<origin xyz="{0.03 * side} 0 0.25"/><axis xyz="1 0 0"/>{limit}{mimic}</joint>'
        )
    text = '<robot name="toy">\n' + "\n".join([*links, *joints]) + "\n</robot>\n"
    for old, new in (edits or {}).items():
        assert old in text, old
        text = text.replace(old, new, 1)
    return text


def write_toy(folder: Path, edits: Mapping[str, str] | None = None) -> Path:
    """Write the URDF and the SRDF, and return the URDF."""
    (folder / "toy.urdf").write_text(toy_urdf(edits))
    (folder / "toy.srdf").write_text(SRDF)
    return folder / "toy.urdf"
