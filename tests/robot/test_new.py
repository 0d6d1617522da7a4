from __future__ import annotations

import re
import sys
from pathlib import Path

import numpy as np
import pytest
from toy_robot import LIMIT, SRDF, toy_urdf, write_toy

from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ApexError, MissingFileError, ParameterError, RobotError
from apex_ompl.robot import load_robot, new
from apex_ompl.robot.description import read_description, read_semantics
from apex_ompl.robot.guesses import arms_of
from apex_ompl.robot.new import new_robot, sources_of

FIRST = f'<axis xyz="0 0 1"/>{LIMIT}'
FAULTS: dict[str, tuple[dict[str, str], str]] = {
    "no joints": ({}, "expected joints, found none"),
    "no links": ({}, "expected links, found none"),
    "two roots": ({"</robot>": '<link name="loose"/></robot>'}, "one root link, found stand, loose"),
    "cycle": ({"</robot>": "{loop}</robot>"}, "'a' is part of a cycle"),
    "unknown link": ({'child link="part1"': 'child link="nobody"'}, "joint 'joint1': expected links .* got 'nobody'"),
    "two parents": ({'child link="part2"': 'child link="part1"'}, "'part1' is that of the joint 'joint1' as well"),
    "missing mesh": ({'<box size="0.06 0.06 0.2"/>': '<mesh filename="gone.stl"/>'}, "mesh of link 'part1'"),
    "missing package": ({'<box size="0.06 0.06 0.2"/>': '<mesh filename="package://no/a.stl"/>'}, "package://no/a.stl"),
    "NaN": ({'xyz="0 0 0.22"': 'xyz="0 0 nan"'}, "joint 'joint1': origin xyz: expected 3 numbers"),
    "words": ({'size="0.2 0.2 0.2"': 'size="wide"'}, "link 'stand': collision: box size"),
    "turned limits": ({'lower="-2"': 'lower="5"'}, "joint 'joint1': limit: expected lower <= upper, got 5 and 2"),
    "negative velocity": ({'velocity="2"': 'velocity="-2"'}, "joint 'joint1': limit: .* not negative, got -2"),
    "unreadable mesh": (
        {'<box size="0.06 0.06 0.2"/>': '<mesh filename="toy.srdf"/>'},
        "mesh of link 'part1' cannot be read: .*toy.srdf",
    ),
    "mesh without triangles": (
        {'<box size="0.06 0.06 0.2"/>': '<mesh filename="points.obj"/>'},
        "mesh of link 'part1' cannot be read: .*points",
    ),
    "flat mesh": ({'<box size="0.06 0.06 0.2"/>': '<mesh filename="flat.obj"/>'}, "link 'part1' has vertices that all"),
    "no encoding": ({}, "not valid XML"),
    "negative size": (
        {'size="0.2 0.2 0.2"': 'size="0.2 0.2 -0.2"'},
        "link 'stand': collision: box size: expected leng",
    ),
    "negative mass": (
        {'link name="part1">': 'link name="part1">{inertial}'},
        "link 'part1': .* mass value: .* 0 or more",
    ),
    "NaN limit": ({'lower="-2"': 'lower="nan"'}, "joint 'joint1': limit lower: expected a number, got 'nan'"),
    "zero axis": ({'axis xyz="0 0 1"': 'axis xyz="0 0 0"'}, "joint 'joint1': axis xyz: expected a direction"),
    "unknown type": ({'type="revolute"': 'type="hinge"'}, "joint 'joint1': type: expected one of .* got 'hinge'"),
    "mimics nobody": ({'mimic joint="grip1"': 'mimic joint="grap"'}, "joint 'grip2' mimics 'grap'"),
    "mimics itself": ({'mimic joint="grip1"': 'mimic joint="grip2"'}, "which mimics a joint itself"),
    "joint twice": ({'name="joint2"': 'name="joint1"'}, "'joint1' is given twice"),
    "link twice": ({'link name="part2"': 'link name="part1"'}, "'part1' is given twice"),
    "no name": ({'joint name="joint2"': "joint"}, "expected a name of each joint"),
    "no parent": ({'<parent link="stand"/>': ""}, "joint 'joint1': expected a parent link"),
    "not XML": ({"</robot>": ""}, "not valid XML"),
    "empty": ({}, "not valid XML"),
    "another root": ({"<robot": "<sdf", "</robot>": "</sdf>"}, "expected the element <robot>, got <sdf>"),
    "no arm": ({}, "expected a chain of 2 or more joints"),
}
LOOP = (
    '<link name="a"/><link name="b"/><joint name="ab" type="fixed"><parent link="a"/><child link="b"/></joint>'
    '<joint name="ba" type="fixed"><parent link="b"/><child link="a"/></joint>'
)
INERTIAL = '<inertial><mass value="-1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
WHOLE = {"no joints": '<robot><link name="a"/></robot>', "no links": "<robot/>", "empty": "", "no arm": None}


def write_faulty(folder: Path, name: str) -> Path:
    """Write a URDF with a fault."""
    urdf = write_toy(folder, FAULTS[name][0])
    (folder / "points.obj").write_text("v 0 0 0\nv 1 0 0\n")
    (folder / "flat.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    text = urdf.read_text().replace("{loop}", LOOP).replace("{inertial}", INERTIAL)
    if name == "no arm":
        text = text.replace('name="joint', 'name="leg_')
    if name == "no encoding":
        urdf.write_bytes(text.encode().replace(b"toy", b"t\xff"))
        return urdf
    urdf.write_text(WHOLE.get(name) if WHOLE.get(name) is not None else text)
    return urdf


@pytest.mark.parametrize("name", FAULTS)
def test_a_faulty_urdf_is_told_in_one_sentence_and_nothing_is_written(tmp_path: Path, capfd, name: str) -> None:
    urdf = write_faulty(tmp_path, name)
    before = sorted(tmp_path.iterdir())
    with pytest.raises(ApexError, match=FAULTS[name][1]) as error:
        new_robot(sources_of([str(urdf)]), tmp_path / "toy.robot.yaml")
    assert "\n" not in str(error.value) and sorted(tmp_path.iterdir()) == before
    assert capfd.readouterr() == ("", "")  # the parser prints what it finds


def test_groups_home_and_pairs_are_those_of_the_srdf(tmp_path: Path) -> None:
    urdf = write_toy(tmp_path)
    made = new_robot(sources_of([str(urdf)], [str(tmp_path / "toy.srdf")]), tmp_path / "mine.robot.yaml")
    robot = load_robot(made.file)
    assert robot.name == "mine" and robot.joint_names == ("joint1", "joint2", "joint3", "joint4")
    assert list(robot.groups) == ["manipulator"] and robot.hands["manipulator"].palm == "part4"
    assert np.allclose(robot.home, [0.0, 0.9, -1.1, 0.7]) and CollisionChecker(robot).is_free(robot.home)
    pairs = {(robot.geometry.geometryObjects[p.first].name, robot.geometry.geometryObjects[p.second].name)
             for p in robot.geometry.collisionPairs}  # fmt: skip
    assert ("stand_0", "part1_0") not in pairs and ("stand_0", "part2_0") in pairs
    assert "urdf: toy.urdf, srdf: toy.srdf" in made.file.read_text()


def test_without_an_srdf_arms_are_guessed_and_the_home_is_free_and_off_the_limits(tmp_path: Path) -> None:
    made = new_robot(sources_of([str(write_toy(tmp_path))]), tmp_path / "toy.robot.yaml")
    robot, text = load_robot(made.file), made.file.read_text()
    assert list(robot.groups) == ["arm"] and robot.dof == 4 and robot.hands["hand"].palm == "part4"
    assert robot.hands["hand"].axis == (0.0, 0.0, 1.0)  # the fingers are on either side of it
    assert CollisionChecker(robot).is_free(robot.home)
    room = np.minimum(robot.home - robot.limits.lower, robot.limits.upper - robot.home)
    assert (room >= 0.02 * 4.0 - 1e-3).all() and np.abs(robot.home).max() > 0.1
    assert "guessed" in text and "  grip1: 0" in text and "grip2" not in text.split("locked:")[1].split("groups:")[0]


def test_missing_limits_are_assumed_with_a_comment(tmp_path: Path) -> None:
    edits = {'type="revolute"': 'type="continuous"', '<axis xyz="0 1 0"/>' + LIMIT: '<axis xyz="0 1 0"/>'}
    made = new_robot(sources_of([str(write_toy(tmp_path, edits))]), tmp_path / "toy.robot.yaml")
    robot = load_robot(made.file)
    assert np.allclose(robot.limits.upper, [1e4, np.pi, 2.0, 2.0], atol=1e-5)
    assert list(robot.continuous) == [True, False, False, False] and abs(robot.home[0]) <= np.pi
    lines = {line.split(":")[0].strip(): line for line in made.file.read_text().splitlines()}
    assert "velocity: 2," in lines["joint1"] and "upper:" not in lines["joint1"].split("#")[0]
    assert "# turns without end; give lower and upper if" in lines["joint1"]
    assert "# no range in the URDF, assumed; no velocity in the URDF, assumed (guessed)" in lines["joint2"]
    assert "#" not in lines["joint3"]


def test_two_urdfs_stand_in_one_cell_with_names_of_their_sides(tmp_path: Path) -> None:
    urdf = str(write_toy(tmp_path))
    places = [(0.0, -0.5, 0.0, 0.0), (0.1, 0.5, 0.0, np.pi / 2)]
    made = new_robot(sources_of([urdf, urdf], [], places), tmp_path / "two.robot.yaml")
    robot = load_robot(made.file)
    assert list(robot.groups) == ["right_arm", "left_arm"] and robot.dof == 8
    pose = robot.link_pose(robot.home, "left_stand")
    assert np.allclose(pose[:3, 3], places[1][:3]) and np.allclose(pose[:3, 0], [0.0, 1.0, 0.0], atol=1e-9)
    assert np.array_equal(robot.home[:4], robot.home[4:])
    three = new_robot(sources_of([urdf] * 3, [], [(k, 0, 0, 0) for k in range(3)]), tmp_path / "three.robot.yaml")
    assert list(load_robot(three.file).groups) == ["a_arm", "b_arm", "c_arm"]


def test_two_kinds_of_arms_keep_both_groups_and_hands(tmp_path: Path) -> None:
    first = write_toy(tmp_path)
    other = re.sub(r'"(stand|part|finger|joint|grip)', r'"my_\1', toy_urdf()).replace(
        'robot name="toy"', 'robot name="my"'
    )
    (tmp_path / "my.urdf").write_text(other)
    places = [(0, -0.5, 0, 0), (0, 0.5, 0, 0)]
    made = new_robot(sources_of([str(first), str(tmp_path / "my.urdf")], [], places), tmp_path / "two.robot.yaml")
    robot = load_robot(made.file)
    assert {name: len(group) for name, group in robot.groups.items()} == {"right_arm": 4, "left_arm": 4}
    assert {name: hand.palm for name, hand in robot.hands.items()} == {
        "right_hand": "right_part4", "left_hand": "left_my_part4"
    }  # fmt: skip


def test_places_and_srdfs_fit_the_urdfs(tmp_path: Path) -> None:
    for srdfs, places in (([], [(0, 0, 0, 0)]), (["a", "b", "c"], [(0, 0, 0, 0)] * 2), ([], [])):
        with pytest.raises(ParameterError, match="one for each of 2 URDFs"):
            sources_of(["a", "b"], srdfs, places)
    with pytest.raises(ParameterError, match="finite numbers"):
        sources_of(["a"], [], [(0.0, np.nan, 0.0, 0.0)])


def test_a_file_that_exists_is_not_written_over(tmp_path: Path) -> None:
    (tmp_path / "toy.robot.yaml").write_text("mine")
    with pytest.raises(ParameterError, match="a new file, this one exists"):
        new_robot(sources_of([str(write_toy(tmp_path))]), tmp_path / "toy.robot.yaml")
    assert (tmp_path / "toy.robot.yaml").read_text() == "mine"


def test_a_link_may_be_called_world(tmp_path: Path) -> None:
    world = (
        '<link name="world"/><joint name="on" type="fixed"><parent link="world"/><child link="stand"/></joint></robot>'
    )
    made = new_robot(sources_of([str(write_toy(tmp_path, {"</robot>": world}))]), tmp_path / "toy.robot.yaml")
    assert {"world", "toy_world", "stand"} <= {*load_robot(made.file).link_names}


def test_a_mobile_base_stands_still(tmp_path: Path) -> None:
    base = '<link name="odom"/><joint name="drive" type="planar"><parent link="odom"/><child link="stand"/></joint>'
    base += "</robot>"
    made = new_robot(sources_of([str(write_toy(tmp_path, {"</robot>": base}))]), tmp_path / "toy.robot.yaml")
    assert "  drive: 0\n" in made.file.read_text() and load_robot(made.file).dof == 4
    assert any("toy stands still; planar: {x: " in note for note in made.notes)


def test_a_joint_that_carries_arms_is_a_commented_line_that_plans_it(tmp_path: Path) -> None:
    lift = '<link name="rail"/><joint name="lift" type="prismatic"><parent link="rail"/><child link="stand"/>'
    lift += '<axis xyz="0 0 1"/><limit lower="0.1" upper="0.4" velocity="0.05" effort="1"/></joint></robot>'
    urdf = str(write_toy(tmp_path, {"</robot>": lift}))
    made = new_robot(sources_of([urdf], [str(tmp_path / "toy.srdf")]), tmp_path / "toy.robot.yaml")
    text = made.file.read_text()
    assert "lift" not in load_robot(made.file).joint_names and any("lift carries arms" in one for one in made.notes)
    made.file.write_text(text.replace("  # lift: {", "  lift: {").replace("  lift: 0.1\n", ""))
    robot = load_robot(made.file)
    assert robot.joint_names[-1] == "lift" and robot.home[-1] == 0.1 and robot.weights[-1] > 1.0


def test_packages_are_found_above_the_urdf_beside_it_and_by_name(tmp_path: Path) -> None:
    tetra = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 0.1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"
    own, beside, far = tmp_path / "ws" / "own", tmp_path / "ws" / "beside", tmp_path / "far"
    for folder in (own / "urdf", beside, far):
        folder.mkdir(parents=True)
        (folder / "t.obj").write_text(tetra)
    box = '<box size="0.06 0.06 0.2"/>'
    for k, (uri, packages) in enumerate((
        ("package://own/urdf/t.obj", {}), ("package://beside/t.obj", {}), ("package://other/t.obj", {"other": far})
    )):  # fmt: skip
        urdf = write_toy(own / "urdf", {box: f'<mesh filename="{uri}"/>'})
        made = new_robot(sources_of([str(urdf)]), tmp_path / f"r{k}.robot.yaml", packages)
        assert any(file.name == "t.obj" for file in load_robot(made.file).files)


def test_xacro_is_asked_for_where_it_is_not_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "toy.urdf.xacro"
    file.write_text(toy_urdf())
    monkeypatch.setitem(sys.modules, "xacro", None)
    with pytest.raises(MissingFileError, match="package for xacro files"):
        new_robot(sources_of([str(file)]), tmp_path / "toy.robot.yaml")


def test_what_xacro_makes_is_written_beside_the_robot_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Document:
        def toprettyxml(self, indent: str) -> str:
            return toy_urdf()

    class Xacro:
        process_file = staticmethod(lambda path: Document())

    monkeypatch.setitem(sys.modules, "xacro", Xacro)  # type: ignore[arg-type]
    (tmp_path / "toy.urdf.xacro").write_text("<robot/>")
    made = new_robot(sources_of([str(tmp_path / "toy.urdf.xacro")]), tmp_path / "toy.robot.yaml")
    assert (tmp_path / "toy.urdf") in made.files and load_robot(made.file).dof == 4


def test_a_fault_in_what_xacro_makes_names_the_xacro_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "toy.urdf.xacro"
    file.write_text("<robot/>")
    monkeypatch.setattr(new, "expanded", lambda file: toy_urdf({'name="joint2"': 'name="joint1"'}))
    with pytest.raises(RobotError, match=f"^{file}: expected joints of different names, 'joint1' is given twice"):
        new_robot(sources_of([str(file)]), tmp_path / "toy.robot.yaml")


def test_limbs_are_found_without_fingers_and_legs(tmp_path: Path) -> None:
    def chain(name: str, count: int, root: str) -> str:
        text, above = "", root
        for k in range(count):
            text += f'<link name="{name}{k}"/><joint name="{name}_{k}" type="revolute"><parent link="{above}"/>'
            text += f'<child link="{name}{k}"/><axis xyz="0 0 1"/>{LIMIT}</joint>'
            above = f"{name}{k}"
        return text

    body = '<robot name="h"><link name="base"/>' + chain("torso", 2, "base")
    arms = chain("left_arm", 5, "torso1") + chain("right_arm", 5, "torso1") + chain("neck", 2, "torso1")
    hands = chain("left_thumb", 4, "left_arm4") + chain("left_index", 4, "left_arm4") + chain("left_leg", 6, "base")
    (tmp_path / "h.urdf").write_text(body + arms + hands + "</robot>")
    found = arms_of(read_description(tmp_path / "h.urdf"), None)
    assert [arm.group for arm in found] == ["left_arm", "right_arm"] and {len(arm.joints) for arm in found} == {5}
    assert found[0].palm == "left_arm4" and found[1].palm == "right_arm4"


def test_names_of_an_srdf_that_a_urdf_lacks_are_noted(tmp_path: Path) -> None:
    urdf = write_toy(tmp_path)
    text = SRDF.replace('link2="part1"', 'link2="part9"').replace('group="gripper"/>', 'group="claw"/>')
    (tmp_path / "off.srdf").write_text(
        text.replace('<joint name="joint4" value="0.7"/>', '<joint name="j9" value="0"/>')
    )
    made = new_robot(sources_of([str(urdf)], [str(tmp_path / "off.srdf")]), tmp_path / "a.robot.yaml")
    assert any(note.endswith("off.srdf names what the URDF does not have: j9, claw, part9") for note in made.notes)
    same = new_robot(sources_of([str(urdf)], [str(tmp_path / "toy.srdf")]), tmp_path / "b.robot.yaml")
    assert not any("does not have" in note for note in same.notes)


def test_groups_of_three_joints_are_arms_where_an_srdf_says_so(tmp_path: Path) -> None:
    """With an end effector beside other arms, else where nothing longer is there: heads and torsos are no arms."""
    urdf = write_toy(tmp_path)
    robot = read_description(urdf)
    three = '<group name="short"><joint name="joint2"/><joint name="joint3"/><joint name="joint4"/></group>'
    two = '<group name="head"><joint name="joint1"/><joint name="joint2"/></group>'
    tool = '<end_effector name="tool" parent_link="part4" group="gripper"/>'
    for text, expected in (
        (three + tool, {"short": 3}),
        (three + two + tool, {"short": 3}),
        (three, {"arm": 4}),  # of the URDF
        (SRDF.split(">", 1)[1].removesuffix("</robot>") + two, {"manipulator": 4}),
    ):
        (tmp_path / "g.srdf").write_text(f"<robot>{text}</robot>")
        arms = arms_of(robot, read_semantics(tmp_path / "g.srdf", robot))
        assert {arm.group: len(arm.joints) for arm in arms} == expected
    planar = read_description(write_toy(tmp_path, {'name="joint4" type="revolute"': 'name="joint4" type="fixed"'}))
    assert [(arm.group, len(arm.joints)) for arm in arms_of(planar, None)] == [("arm", 3)]
    (tmp_path / "g.srdf").write_text(f"<robot>{three.replace('joint4', 'joint1')}</robot>")
    arms = arms_of(planar, read_semantics(tmp_path / "g.srdf", planar))
    assert [(arm.group, arm.palm) for arm in arms] == [("short", "part4")]
    made = new_robot(sources_of([str(urdf)]), tmp_path / "toy.robot.yaml")
    assert load_robot(made.file).dof == 3 and "3 joints joint1 to joint3" in made.file.read_text()


def test_groups_of_an_srdf_are_joints_links_chains_and_groups(tmp_path: Path) -> None:
    robot = read_description(write_toy(tmp_path))
    (tmp_path / "g.srdf").write_text(
        '<robot><group name="links"><link name="part2"/><link name="part1"/></group><group name="both">'
        '<group name="links"/><joint name="joint4"/><joint name="grip2"/></group>'
        '<group name="itself"><group name="itself"/></group>'
        '<group_state name="s" group="both"><joint name="joint1" value="0.5"/><joint name="no" value="1"/>'
        "</group_state></robot>"
    )
    found = read_semantics(tmp_path / "g.srdf", robot)
    assert found.groups == {"links": ("joint1", "joint2"), "both": ("joint1", "joint2", "joint4"), "itself": ()}
    assert found.states == {"s": {"joint1": 0.5}}
    (tmp_path / "bad.srdf").write_text(SRDF.replace('value="0.9"', 'value="x"'))
    with pytest.raises(RobotError, match="joint2: expected a number, got 'x'"):
        new_robot(sources_of([str(tmp_path / "toy.urdf")], [str(tmp_path / "bad.srdf")]), tmp_path / "x.robot.yaml")
