from __future__ import annotations

import os
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pinocchio as pin
import pytest
import trimesh
from support import ROOT

from apex_ompl import MotionPlanner, PlanStatus, plan
from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ApexError, FileFormatError, MissingFileError, RobotError, UnknownNameError
from apex_ompl.robot import Robot, load_robot, robot_names
from apex_ompl.robot.config import DATA, read_config, resolve
from apex_ompl.robot.model import build_robot
from apex_ompl.scene.problem import Problem

PANDA = "package://example-robot-data/robots/panda_description/urdf/panda.urdf"
ARM = [f"joint{k}" for k in range(1, 8)]


def test_state_order_and_limits_are_the_contract(robot: Robot) -> None:
    expected = [f"left_{j}" for j in ARM] + [f"right_{j}" for j in ARM] + ["left_hand_synergy", "right_hand_synergy"]
    assert list(robot.joint_names) == expected
    lower = [-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973]
    upper = [2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973]
    np.testing.assert_allclose(robot.limits.lower, lower * 2 + [0, 0])
    np.testing.assert_allclose(robot.limits.upper, upper * 2 + [1, 1])
    np.testing.assert_allclose(robot.limits.velocity, ([2.175] * 4 + [2.61] * 3) * 2 + [1.5] * 2)
    np.testing.assert_allclose(robot.limits.acceleration, [15, 7.5, 10, 12.5, 15, 20, 20] * 2 + [10] * 2)
    np.testing.assert_allclose(robot.limits.jerk, [7500, 3750, 5000, 6250, 7500, 10000, 10000] * 2 + [200] * 2)


@pytest.mark.parametrize(("side", "y"), [("left", 0.5), ("right", -0.5)])
def test_each_arm_moves_as_the_plain_panda(robot: Robot, side: str, y: float) -> None:
    path = resolve(PANDA, Path.cwd(), "URDF")
    panda = pin.buildModelFromUrdf(str(path))
    data = panda.createData()
    rng = np.random.default_rng(0)
    for q in robot.random_state(rng, 20):
        full = pin.neutral(panda)
        full[:7] = q[robot.groups[f"{side}_arm"]]
        pin.framesForwardKinematics(panda, data, full)
        expected = data.oMf[panda.getFrameId("panda_link8")].homogeneous.copy()
        expected[1, 3] += y
        np.testing.assert_allclose(robot.link_pose(q, f"{side}_link8"), expected, atol=1e-12)


def test_the_synergy_drives_nineteen_joints_by_their_ratios(robot: Robot) -> None:
    tree = ET.parse(DATA / "softhand2_right.urdf")
    ratios = {
        j.get("name"): float(j.find("mimic").get("multiplier"))
        for j in tree.iter("joint")
        if j.find("mimic") is not None
    }
    assert len(ratios) == 19
    assert sum(abs(r) != 1.57 for r in ratios.values()) == 5  # abductions
    q = robot.home.copy()
    before, after = (robot.link_pose(q_with(q, robot, s), "right_hand_index_proximal") for s in (0.0, 1.0))
    parent = [robot.link_pose(q_with(q, robot, s), "right_hand_index_knuckle") for s in (0.0, 1.0)]
    turn = (np.linalg.inv(parent[0]) @ before)[:3, :3].T @ (np.linalg.inv(parent[1]) @ after)[:3, :3]
    assert np.linalg.norm(pin.log3(turn)) == pytest.approx(1.57)


def q_with(q: np.ndarray, robot: Robot, synergy: float) -> np.ndarray:
    q = q.copy()
    q[robot.groups["hands"]] = synergy
    return q


def test_open_hand_has_the_size_of_the_real_one(robot: Robot) -> None:
    q = q_with(robot.home, robot, 0.0)
    base = np.linalg.inv(robot.link_pose(q, "right_hand_base"))
    tip = np.array([0.022 + 0.007, 0.0, 0.0, 1.0])  # end of the last capsule
    middle = base @ robot.link_pose(q, "right_hand_middle_distal") @ tip
    thumb = base @ robot.link_pose(q, "right_hand_thumb_distal") @ tip
    assert middle[2] == pytest.approx(0.24, abs=0.005)
    assert thumb[0] == pytest.approx(-0.13, abs=0.005)


def test_left_hand_is_the_mirror_of_the_right(robot: Robot) -> None:
    """Every link of the left hand lies where reflection x -> -x puts the right hand's."""
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0])
    for synergy in (0.0, 0.37, 1.0):
        q = q_with(robot.home, robot, synergy)
        left, right = (np.linalg.inv(robot.link_pose(q, f"{side}_hand_base")) for side in ("left", "right"))
        for link in robot.part_links["right_hand"]:
            if link.endswith("actuator"):  # the synergy's own link: no geometry, only a number
                continue
            a = right @ robot.link_pose(q, link)
            b = left @ robot.link_pose(q, link.replace("right", "left"))
            np.testing.assert_allclose(b, mirror @ a @ mirror, atol=1e-8)


def test_the_two_palms_face_each_other_at_home(robot: Robot) -> None:
    left, right = (robot.link_pose(robot.home, f"{side}_hand_palm") for side in ("left", "right"))
    closing = [-pose[:3, 2] for pose in (left, right)]  # the side on which fingers and thumb close
    between = right[:3, 3] - left[:3, 3]
    assert closing[0] @ between > 0 > closing[1] @ between


def test_committed_hands_are_what_the_script_makes() -> None:
    import runpy

    script = runpy.run_path(str(ROOT / "scripts" / "make_softhand_urdf.py"))
    for side in ("right", "left"):
        assert script["hand_urdf"](side) == (DATA / f"softhand2_{side}.urdf").read_text()


def test_arms_use_the_real_meshes(robot: Robot) -> None:
    meshes = [g for g in robot.geometry.geometryObjects if g.meshPath.endswith(".stl")]
    assert len(meshes) == 16
    assert all(Path(g.meshPath).is_file() for g in meshes)
    assert all(200 <= g.geometry.num_tris <= 300 for g in meshes)


def test_pinocchio_order_is_a_permutation(robot: Robot, baxter: Robot) -> None:
    for some in (robot, baxter):
        q = np.arange(some.dof, dtype=float)
        for k, name in enumerate(some.joint_names):
            joint = some.model.joints[some.model.getJointId(name)]
            assert some.to_pinocchio(q)[joint.idx_q] == k
        batch = np.stack([q, q + 1])
        np.testing.assert_array_equal(some.to_pinocchio(batch)[1], some.to_pinocchio(q + 1))


def test_baxter_has_two_arms_and_locked_joints(baxter: Robot) -> None:
    assert baxter.dof == 14 and baxter.model.nq == 14
    assert robot_names() == ("baxter", "dual_panda_softhand", "panda")
    assert not any("gripper" in n or "head" in n for n in baxter.joint_names)


def test_the_single_panda_has_an_open_gripper_and_frankas_limits() -> None:
    """Limits and home by Franka's table; at home the gripper points down, 0.1034 m above its tip."""
    panda = load_robot("panda")
    gripper = ("panda_hand", "panda_leftfinger", "panda_rightfinger")
    assert panda.dof == 7 and set(gripper) < set(panda.hand_of("panda_hand"))
    lower = [-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973]
    upper = [2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973]
    np.testing.assert_allclose([panda.limits.lower, panda.limits.upper], [lower, upper])
    np.testing.assert_allclose(panda.limits.velocity, [2.175] * 4 + [2.61] * 3)
    hand, left, right = (panda.link_pose(panda.home, link) for link in gripper)
    np.testing.assert_allclose(hand[:3, 2], (0.0, 0.0, -1.0), atol=1e-9)
    assert np.linalg.norm(left[:3, 3] - right[:3, 3]) == pytest.approx(0.08)  # two fingers open by 4 cm each
    tip = hand @ [*panda.hands["hand"].point, 1.0]
    assert hand[2, 3] - tip[2] == pytest.approx(0.1034)
    assert CollisionChecker(panda).is_free(panda.home)


def test_a_locked_joint_stands_at_its_value(baxter: Robot, tmp_path: Path) -> None:
    config = read_config(DATA / "baxter.robot.yaml")
    turned = config.model_copy(update={"locked": {**config.locked, "head_pan": 0.5, "l_gripper_l_finger_joint": 0.01}})
    other = build_robot(turned, DATA / "baxter.robot.yaml")
    a, b = (r.link_pose(r.home, "head") for r in (baxter, other))
    assert np.linalg.norm(pin.log3(a[:3, :3].T @ b[:3, :3])) == pytest.approx(0.5)
    a, b = (r.link_pose(r.home, "l_gripper_l_finger") for r in (baxter, other))
    assert np.linalg.norm(a[:3, 3] - b[:3, 3]) == pytest.approx(0.01)


def test_limit_fault_names_joint_value_and_limit(robot: Robot) -> None:
    q = robot.home.copy()
    assert robot.limit_fault(q) is None
    q[3] = 0.5
    assert robot.limit_fault(q) == "left_joint4 = 0.5 is outside its limits [-3.0718, -0.0698]"
    q[3] = robot.limits.upper[3] + 1e-9
    assert robot.limit_fault(q) == "left_joint4 = -0.0698 is 1e-09 outside its limits [-3.0718, -0.0698]"
    q[3] = -90.0
    assert (robot.limit_fault(q) or "").endswith("; in degrees it would be inside, and angles are radians")
    q[3] = np.nan
    assert "left_joint4" in (robot.limit_fault(q) or "")
    assert "(16,)" in (robot.limit_fault(q[:5]) or "")


SMALL = """schema: apex-ompl/robot/1
name: small
parts:
  - {{name: arm, urdf: {urdf}}}
joints:
  shoulder: {{home: 0.1, acceleration: 1, jerk: 10{extra}}}
"""
URDF = """<robot name="small"><link name="base"/>
<link name="tip"><collision><geometry>{geometry}</geometry></collision></link>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="tip"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1" velocity="1" effort="1"/></joint></robot>"""


def write_small(folder: Path, geometry: str = '<box size="1 1 1"/>', extra: str = "") -> Path:
    (folder / "small.urdf").write_text(URDF.format(geometry=geometry))
    path = folder / "small.robot.yaml"
    path.write_text(SMALL.format(urdf="small.urdf", extra=extra))
    return path


def test_any_urdf_loads_from_a_short_file(tmp_path: Path) -> None:
    small = load_robot(write_small(tmp_path))
    assert small.joint_names == ("shoulder",)
    assert small.home.tolist() == [0.1]


@pytest.mark.parametrize("jerk", [".inf", "1e12"])
def test_a_robot_may_have_no_limit_of_jerk(jerk: str, tmp_path: Path) -> None:
    path = write_small(tmp_path, '<sphere radius="0.05"/>')
    path.write_text(path.read_text().replace("jerk: 10", f"jerk: {jerk}"))
    assert load_robot(path).limits.jerk.tolist() == [1e6], "the acceleration, 1, is reached in a microsecond"
    with MotionPlanner(path) as planner:
        result = planner.plan([0.1], [0.5])
    assert result and result.trajectory.duration == pytest.approx(2.0 * np.sqrt(0.4), rel=5.1e-3)


def test_a_robot_names_the_files_that_it_was_read_from(robot: Robot, tmp_path: Path) -> None:
    path = write_small(tmp_path)
    assert load_robot(path).files == (path, tmp_path / "small.urdf")
    endings = {file.suffix for file in robot.files}
    assert all(file.is_file() for file in robot.files) and {".yaml", ".urdf", ".srdf"} < endings and len(endings) > 4


def test_plan_makes_a_robot_anew_whose_files_have_changed(tmp_path: Path) -> None:
    path = write_small(tmp_path, '<sphere radius="0.05"/>')
    wall = {"name": "wall", "box": [0.1, 0.1, 0.1], "position": [0.0, 0.0, 0.4]}
    fields = {"name": "swing", "robot": str(path), "scene": [wall], "start": {"shoulder": 0.1}}
    problem = Problem(**fields, goal={"joints": [{"shoulder": 0.5}]})
    assert plan(problem) and plan(problem)
    write_small(tmp_path, '<sphere radius="0.5"/>')
    os.utime(tmp_path / "small.urdf", ns=(0, 1))  # a clock that is too coarse to see it changes nothing
    assert plan(problem).status is PlanStatus.INVALID_START
    (tmp_path / "small.urdf").unlink()
    with pytest.raises(MissingFileError, match=r"small\.urdf"):
        plan(problem)


def test_faulty_robot_files_say_what_is_wrong(tmp_path: Path) -> None:
    cases: list[tuple[type[ApexError], str, object]] = [
        (UnknownNameError, "did you mean 'baxter'", "baxtr"),
        (MissingFileError, "nowhere.yaml", "nowhere.yaml"),
        (MissingFileError, "mesh of link 'tip'.*gone.stl", write_small(tmp_path, '<mesh filename="gone.stl"/>')),
    ]
    for error, match, name in cases:
        with pytest.raises(error, match=match):
            load_robot(name)  # type: ignore[arg-type]
    with pytest.raises(FileFormatError, match=r"joints\.shoulder: .*lower < upper"):
        load_robot(write_small(tmp_path, extra=", lower: 2"))
    with pytest.raises(FileFormatError, match=r"unknown key, did you mean 'upper'"):
        load_robot(write_small(tmp_path, extra=", uper: 2"))
    path = write_small(tmp_path)
    path.write_text(path.read_text().replace("  shoulder:", "  elbow:"))
    with pytest.raises(FileFormatError, match="elbow"):
        load_robot(path)
    path = write_small(tmp_path)
    path.write_text(path.read_text() + "locked: {elbow: 0}\n")
    with pytest.raises(RobotError, match="no joint 'elbow'"):
        load_robot(path)
    for lost in ('<box size="0.3,0.05,0.05"/>', '<box size="0.3 0.05"/>', "<ellipsoid/>"):
        with pytest.raises(RobotError, match="'tip'|cannot read"):
            load_robot(write_small(tmp_path, geometry=lost))


def test_meshes_of_fixtures_lie_beside_the_robot_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "deep"
    folder.mkdir()
    path = write_small(folder)
    path.write_text(path.read_text() + "fixtures: [{name: f, mesh: {file: t.obj}}]\n")
    monkeypatch.chdir(tmp_path)
    (fixture,) = load_robot("deep/small.robot.yaml").fixtures
    assert fixture.mesh is not None and fixture.mesh.file == str(folder / "t.obj")


def test_the_hand_of_a_link_is_what_hangs_together_with_it(robot: Robot, baxter: Robot) -> None:
    hand = robot.hand_of("left_hand_index_distal")
    assert hand == robot.hand_of("left_hand_palm") and set(robot.part_links["left_hand"]) <= set(hand)
    assert not any("right" in link for link in hand) and "left_link6" not in hand
    assert "left_wrist" in baxter.hand_of("left_gripper") and "left_lower_forearm" not in baxter.hand_of("left_gripper")
    assert not any("elbow" in link for link in baxter.hand_of("torso"))


ARM_URDF = """<robot name="small"><link name="base"/>
<link name="tip">{inertial}<collision>{origin}<geometry>{geometry}</geometry>
</collision></link><link name="end"/><joint name="shoulder" type="{kind}"><parent link="base"/><child link="tip"/>
<origin xyz="0 0 0.3"/><axis xyz="{axis}"/>{limit}</joint>
<joint name="elbow" type="prismatic"><parent link="tip"/><child link="end"/><axis xyz="1 0 0"/>
<limit lower="-9" upper="9" velocity="1" effort="1"/>{mimic}</joint></robot>"""
LIMIT = '<limit lower="-1" upper="1" velocity="1" effort="1"/>'


def write_arm(folder: Path, *, locked: str = "", joints: tuple[str, ...] = ("shoulder", "elbow"), **given: str) -> Path:
    usual = {
        "inertial": "",
        "origin": "",
        "geometry": '<box size="1 1 1"/>',
        "kind": "revolute",
        "axis": "0 1 0",
        "limit": LIMIT,
    }
    (folder / "small.urdf").write_text(ARM_URDF.format(**usual | {"mimic": ""} | given))
    path = folder / "small.robot.yaml"
    planned = "".join(f"  {joint}: {{acceleration: 1, jerk: 10}}\n" for joint in joints)
    path.write_text(
        f"schema: apex-ompl/robot/1\nname: small\nparts: [{{name: arm, urdf: small.urdf}}]\n{locked}joints:\n{planned}"
    )
    return path


@pytest.mark.parametrize(
    ("limit", "lower", "upper"),
    [
        ('<limit upper="1" velocity="1" effort="1"/>', 0.0, 1.0),
        ('<limit lower="-1" velocity="1" effort="1"/>', -1.0, 0.0),
        ('<limit lower="-1e8" upper="1e8" velocity="1" effort="1"/>', -1e4, 1e4),
        ('<limit lower="-1e16" upper="2" velocity="1" effort="1e30"/>', -1e4, 2.0),
    ],
)
def test_limits_that_are_omitted_or_stand_for_none(tmp_path: Path, limit: str, lower: float, upper: float) -> None:
    arm = load_robot(write_arm(tmp_path, limit=limit))
    assert (arm.limits.lower[0], arm.limits.upper[0]) == (lower, upper)
    checker = CollisionChecker(arm)
    assert checker.is_free(arm.home) and checker.prove(
        np.stack([arm.home, 0.5 * (arm.limits.lower + arm.limits.upper)])
    )


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"axis": "0 0 0"}, "joint 'shoulder': axis xyz: expected a direction, got '0 0 0'"),
        ({"axis": "0 1"}, "joint 'shoulder': axis xyz: expected 3 numbers, got '0 1'"),
        ({"kind": "hinge"}, "joint 'shoulder': type: expected one of revolute, .*, got 'hinge'"),
        ({"limit": LIMIT.replace('"1"', '"1o"', 1)}, "joint 'shoulder': limit upper: expected a number, got '1o'"),
        ({"limit": LIMIT.replace('"-1"', '"nan"')}, "joint 'shoulder': limit lower: expected a number, got 'nan'"),
        ({"limit": LIMIT.replace('"-1"', '"2"')}, "joint 'shoulder': limit: expected lower <= upper.* got 2 and 1"),
        ({"limit": '<limit lower="-1" upper="1" effort="1"/>'}, "joint 'shoulder': .*velocity is missing"),
        ({"limit": ""}, "joint 'shoulder': expected <limit> with velocity and effort"),
        ({"inertial": "<inertial/>"}, "link 'tip': inertial: expected <mass> with value, value is missing"),
        ({"inertial": '<inertial><mass value="1"/></inertial>'}, "link 'tip': inertial: expected <inertia> with ixx"),
        (
            {"inertial": '<inertial><mass value="1 kg"/></inertial>'},
            "link 'tip': inertial: mass value: expected a number",
        ),
        ({"geometry": '<sphere radius="5cm"/>'}, "link 'tip': collision: sphere radius: expected a number, got '5cm'"),
        ({"geometry": '<box size="1 1"/>'}, "link 'tip': collision: box size: expected 3 numbers, got '1 1'"),
        ({"mimic": '<mimic joint="shoulder" offset="x"/>'}, "joint 'elbow': mimic offset: expected a number, got 'x'"),
        ({"mimic": '<mimic joint="wrist"/>'}, "joint 'elbow' mimics 'wrist', which is no joint of the robot"),
    ],
)
def test_faults_of_a_urdf_name_the_element(tmp_path: Path, capfd, given: dict[str, str], words: str) -> None:
    with pytest.raises(RobotError, match=words) as error:
        load_robot(write_arm(tmp_path, **given))
    assert "small.urdf" in str(error.value) or "mimics" in words
    assert capfd.readouterr() == ("", "")  # the parser prints what it finds


def test_what_mimics_a_locked_joint_stays_where_that_puts_it(tmp_path: Path) -> None:
    path = write_arm(
        tmp_path, mimic='<mimic joint="shoulder" multiplier="-2" offset="0.5"/>', locked="locked: {shoulder: 0.1}\n"
    )
    with pytest.raises(FileFormatError, match="locked: expected joints that are not planned .*, got 'shoulder'"):
        load_robot(path)
    text = (tmp_path / "small.urdf").read_text()
    extra = '<link name="hand"/><joint name="wrist" type="revolute"><parent link="end"/><child link="hand"/>'
    (tmp_path / "small.urdf").write_text(text.replace("</robot>", f"{extra}{LIMIT}</joint></robot>"))
    path.write_text(
        path.read_text().replace("  shoulder:", "  wrist:").replace("  elbow: {acceleration: 1, jerk: 10}", "")
    )
    arm = load_robot(path)
    assert arm.joint_names == ("wrist",)
    tip = pin.SE3(pin.exp3(np.array([0.0, 0.1, 0.0])), np.array([0.0, 0.0, 0.3]))
    end = tip * pin.SE3(np.eye(3), np.array([-2 * 0.1 + 0.5, 0.0, 0.0]))
    np.testing.assert_allclose(arm.link_pose(arm.home, "end"), end.homogeneous, atol=1e-12)


def test_links_are_in_metres_and_their_axes_are_those_of_the_link(tmp_path: Path) -> None:
    """COLLADA's unit counts and its up axis does not, as in RViz; glTF, whose up is y, is turned."""
    size = np.array([100.0, 200.0, 300.0])
    block = trimesh.creation.box(size)
    block.apply_translation(size / 2.0)
    text = block.export(file_type="dae").decode()
    unit = '<asset><unit name="mm" meter="0.001"/>'
    (tmp_path / "m.dae").write_text(text.replace("<asset>", unit))
    block.apply_scale(0.001)
    block.export(tmp_path / "m.glb")
    assert "<up_axis>Y_UP" in text
    origin = '<origin xyz="1 2 3" rpy="0 0 1.5707963267948966"/>'
    place = pin.SE3(pin.rpy.rpyToMatrix(0.0, 0.0, np.pi / 2), np.array([1.0, 2.0, 3.0]))
    for file, scale, corner in (
        ("m.dae", "1 1 1", (0.1, 0.2, 0.3)), ("m.dae", "1 2 3", (0.1, 0.4, 0.9)), ("m.glb", "1 2 3", (0.1, -0.6, 0.6)),
    ):  # fmt: skip
        geometry = f'<mesh filename="{file}" scale="{scale}"/>'
        (item,) = load_robot(write_arm(tmp_path, geometry=geometry, origin=origin)).geometry.geometryObjects
        within = place.inverse() * item.placement
        vertices = np.array(item.geometry.vertices()) @ within.rotation.T + within.translation
        found = np.stack([vertices.min(axis=0), vertices.max(axis=0)])
        np.testing.assert_allclose(found, [np.minimum(corner, 0.0), np.maximum(corner, 0.0)], atol=1e-6)


def test_links_that_are_too_small_are_refused(tmp_path: Path) -> None:
    trimesh.creation.box((1e-9, 1e-9, 1e-9)).export(tmp_path / "m.stl")
    with pytest.raises(RobotError, match="mesh of link 'tip' has vertices no more than 1e-09 m apart"):
        load_robot(write_arm(tmp_path, geometry='<mesh filename="m.stl"/>'))
