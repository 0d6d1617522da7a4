"""The robots of the benchmark of robots: of the PyPI package example-robot-data, and a planar one made here."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path

import apex_ompl
from apex_ompl.robot.new import new_robot, sources_of
from apex_ompl.util.files import write_atomically
from apex_ompl.util.schema import dump_yaml, read_yaml

PACKAGE = "package://example-robot-data/robots"
BAXTER = Path(apex_ompl.__file__).parent / "robot" / "data" / "baxter.robot.yaml"
OPEN = 0.05  # place of a finger of an open gripper [m]
PLANAR = "planar.urdf"
SIZES = (0.4, 0.3, 0.25, 0.2)  # lengths of the planar arm's links [m]

Place = tuple[float, float, float, float]


@dataclass(frozen=True)
class Cell:
    """A robot of one or more equal arms.

    Attributes:
        urdf: URDF in the package, or ``PLANAR``.
        srdf: SRDF in the package, or an empty string.
        places: x, y, z [m] and yaw [rad] of each arm.
        torso: Joint that is planned, too, which ``robot new`` locks, or an empty string.
    """

    urdf: str
    srdf: str = ""
    places: tuple[Place, ...] = ((0.0, 0.0, 0.0, 0.0),)
    torso: str = ""


PANDA = "panda_description/urdf/panda.urdf", "panda_description/srdf/panda.srdf"
UR5 = "ur_description/urdf/ur5_robot.urdf", "ur_description/srdf/ur5.srdf"
XARM7 = "xarm_description/urdf/xarm7.urdf", "xarm_description/srdf/xarm7.srdf"
PR2 = "pr2_description/urdf/pr2.urdf", "pr2_description/srdf/pr2.srdf"
CELLS = {
    "panda": Cell(*PANDA),
    "xarm7": Cell(*XARM7),
    "kinova": Cell("kinova_description/robots/kinova.urdf", "kinova_description/srdf/kinova.srdf"),
    "planar": Cell(PLANAR, "", ((0.0, 0.0, 0.0, 0.0), (1.2, 0.0, 0.0, 2.1), (0.6, 1.0, 0.0, -math.pi / 2.0))),
    "dual_ur5": Cell(*UR5, ((0.0, 0.5, 0.0, 0.0), (0.0, -0.5, 0.0, 0.0))),
    "dual_panda": Cell(*PANDA, ((0.0, 0.4, 0.0, 0.0), (0.0, -0.4, 0.0, 0.0))),
    "three_xarm7": Cell(*XARM7, ((0.0, 0.6, 0.0, 0.0), (0.0, -0.6, 0.0, 0.0), (0.9, 0.0, 0.0, math.pi))),
    "four_xarm7": Cell(
        *XARM7,
        ((0.0, 0.5, 0.0, 0.0), (0.0, -0.5, 0.0, 0.0), (0.9, 0.5, 0.0, math.pi), (0.9, -0.5, 0.0, math.pi)),
    ),
    "pr2": Cell(*PR2),
    "pr2_torso": Cell(*PR2, torso="torso_lift_joint"),
    "tiago_pro": Cell("tiago_pro_description/robots/tiago_pro.urdf"),
    "tiago_dual": Cell("tiago_description/robots/tiago_dual.urdf"),
    "talos": Cell("talos_data/robots/talos_reduced.urdf", "talos_data/srdf/talos.srdf"),
    "g1": Cell("g1_description/urdf/g1_29dof_rev_1_0.urdf"),
}
"""The robots by name, those of few joints first."""


def planar_arm() -> str:
    """Return the URDF of a planar arm of four revolute joints."""
    parts = ['<robot name="planar"><link name="base"><collision><geometry>'
             '<cylinder radius="0.08" length="0.1"/></geometry></collision></link>']  # fmt: skip
    above, origin = "base", "0 0 0.1"
    for k, size in enumerate(SIZES, 1):
        parts.append(
            f'<joint name="joint{k}" type="revolute"><parent link="{above}"/><child link="link{k}"/>'
            f'<origin xyz="{origin}"/><axis xyz="0 0 1"/>'
            '<limit lower="-2.8" upper="2.8" velocity="2" effort="50"/></joint>'
            f'<link name="link{k}"><collision><origin xyz="{size / 2} 0 0"/>'
            f'<geometry><box size="{size} 0.08 0.06"/></geometry></collision></link>'
        )
        above, origin = f"link{k}", f"{size} 0 0.08"
    return "\n".join([*parts, "</robot>", ""])


def robot_file(name: str, folder: Path) -> Path:
    """Return the robot file of a robot in its own folder, which is written where it is missing."""
    file, cell = folder / name / f"{name}.robot.yaml", CELLS[name]
    if file.exists():
        return file
    file.parent.mkdir(parents=True, exist_ok=True)
    urdf, srdfs = f"{PACKAGE}/{cell.urdf}", [f"{PACKAGE}/{cell.srdf}"] if cell.srdf else []
    if cell.urdf == PLANAR:
        urdf = str(file.parent / PLANAR)
        write_atomically(Path(urdf), planar_arm().encode())
    places = cell.places if len(cell.places) > 1 else ()
    made = new_robot(sources_of([urdf] * len(cell.places), srdfs, places), file).file
    if cell.torso:  # by hand, as a comment in the file has it
        text = made.read_text().replace(f"  # {cell.torso}: {{", f"  {cell.torso}: {{")
        write_atomically(made, re.sub(rf"(?m)^  {cell.torso}: [^{{\n]*\n", "", text).encode())
    return made


def open_baxter(file: Path) -> Path:
    """Write the robot file of the Baxter that ships with its grippers open, as MotionBenchMaker has it; return it."""
    data = read_yaml(BAXTER, "robot file")
    for side in "lr":
        for finger, sign in (("l", 1.0), ("r", -1.0)):
            data["locked"][f"{side}_gripper_{finger}_finger_joint"] = sign * OPEN
    covers = BAXTER.with_name(data["covers"])
    write_atomically(file.with_name(covers.name), covers.read_bytes())  # tables are written beside them
    write_atomically(file, dump_yaml(data).encode())
    return file
