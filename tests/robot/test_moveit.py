from __future__ import annotations

import base64
from pathlib import Path

import numpy as np
import pytest
from moveit_files import REQUEST, SCENE
from scipy.spatial.transform import Rotation
from support import CUBE_OBJ

from apex_ompl import load_problem
from apex_ompl.errors import ApexError, FileFormatError
from apex_ompl.robot import Robot, load_robot
from apex_ompl.robot.config import DATA
from apex_ompl.robot.moveit import Conversion, convert
from apex_ompl.scene.constraints import FixedOrientation, ToolRegion, Upright
from apex_ompl.scene.grids import parse_octomap

JOINTS = {f"panda_joint{k}": f"left_joint{k}" for k in range(1, 8)}
FRAMES = {"base_link": "world", "palm": "left_hand_palm"}


def converted(folder: Path, robot: Robot, scene: str = SCENE, request: str = REQUEST) -> Conversion:
    (folder / "scene0001.yaml").write_text(scene)
    (folder / "request0001.yaml").write_text(request)
    (folder / "rock.obj").write_text(CUBE_OBJ)
    return convert(folder / "scene0001.yaml", folder / "request0001.yaml", robot, JOINTS, FRAMES)


def test_every_shape_lands_where_the_messages_put_it(robot: Robot, tmp_path: Path) -> None:
    done = converted(tmp_path, robot)
    bodies = {b.name: b for b in done.problem.scene}
    assert set(bodies) == {"base/0", "base/1", "pillar", "rock"}
    turn = Rotation.from_euler("z", 90, degrees=True)
    assert bodies["base/0"].box == (0.4, 0.1, 0.2)
    np.testing.assert_allclose(bodies["base/0"].pose[:3, :3], turn.as_matrix(), atol=1e-6)
    expected = np.array([0.5, 0.0, 0.1]) + turn.apply([0.1, 0.0, 0.2])  # object pose, then primitive pose
    np.testing.assert_allclose(bodies["base/1"].position, expected, atol=1e-6)
    assert bodies["base/1"].sphere.radius == 0.05
    assert (bodies["pillar"].cylinder.radius, bodies["pillar"].cylinder.length) == (0.04, 0.6)
    np.testing.assert_allclose(bodies["pillar"].position, [0.45, 0.1, 0.3])
    assert bodies["rock"].mesh.file == str(tmp_path / "rock.obj") and bodies["rock"].mesh.scale == (0.1, 0.1, 0.1)
    (cup,) = done.problem.attached
    assert cup.link == "left_hand_palm" and cup.cylinder.radius == 0.03
    np.testing.assert_allclose(cup.position, [0.0, 0.02, -0.04])


def test_joints_come_by_the_map_and_the_rest_stays_home(robot: Robot, tmp_path: Path) -> None:
    problem = converted(tmp_path, robot).problem
    start = problem.start_state(robot.joint_names)
    expected = robot.home.copy()
    expected[[0, 1, 3, 14]] = 0.6, 0.3, -1.6, 0.2
    np.testing.assert_array_equal(start, expected)
    expected[0] = -1.35
    np.testing.assert_array_equal(problem.goal_states(robot.joint_names), [expected])


def test_what_is_left_out_is_named(robot: Robot, tmp_path: Path) -> None:
    notes = "\n".join(converted(tmp_path, robot).notes)
    for word in ("'finger'", "unheard_of", "planner_id: not used", "taken at home"):
        assert word in notes


def test_the_allowed_collision_matrix_becomes_pairs_of_the_problem(robot: Robot, tmp_path: Path) -> None:
    matrix = """
allowed_collision_matrix:
  entry_names: [palm, pillar, ghost]
  entry_values:
    - {enabled: [true, true, true]}
    - {enabled: [true, true, false]}
    - {enabled: [true, false, true]}
"""
    done = converted(tmp_path, robot, SCENE + matrix)
    assert done.problem.allowed == (("left_hand_palm", "pillar"),)
    assert any("neither links nor objects here, so left out: ghost" in note for note in done.notes)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("type: box", "type: cone", ["collision_objects.0.primitives.0.type", "'cone'", "cannot be read"]),
        ("[0.4, 0.1, 0.2]", "[0.4, 0.1]", ["primitives.0.dimensions", "3 numbers"]),
        ("frame_id: base_link", "frame_id: moon", ["'moon'", "--frame moon=LINK"]),
        ("resource: rock.obj", "resource: gone.obj", ["gone.obj", "no such file"]),
        ("{resource: rock.obj, dimensions: [0.1, 0.1, 0.1]}", "{vertices: []}", ["meshes.0", "mesh by path"]),
        ("position: [0.1, 0, 0.2]", "position: [0.1, 0]", ["primitive_poses.1.position", "3 finite numbers"]),
        (
            "dimensions: [0.05]",
            "dimensions: [.nan]",
            ["primitives.1.dimensions.0", "expected a finite number, got nan"],
        ),
        ("dimensions: [0.05]", "dimensions: [-1.0]", ["collision_objects.0.sphere.radius", "greater than 0"]),
        ("position: [0.2]", "position: [.nan]", ["joint_state.position.0", "expected a finite number, got nan"]),
        ("position: [0.2]", "position: 0.2", ["joint_state.position", "expected a list, got 0.2"]),
        (SCENE[SCENE.index("world:") :], "world: [1]", ["world", "expected a mapping of keys to values, got [1]"]),
        ("header: {frame_id: base_link}", "header: base_link", ["collision_objects.0.header", "expected a mapping"]),
        ("- {type: box, dimensions: [0.4, 0.1, 0.2]}", "- box", ["primitives.0", "expected a mapping", "'box'"]),
        ("resource: rock.obj, dimensions: [0.1, 0.1, 0.1]", "resource: rock.obj, scale: big", ["meshes.0.scale"]),
        ("position: [0.2]", "position: []", ["robot_state.joint_state", "expected 1 positions"]),
    ],
)
def test_what_matters_and_cannot_be_read_is_an_error(
    robot: Robot, tmp_path: Path, old: str, new: str, words: list[str]
) -> None:
    assert old in SCENE
    with pytest.raises(ApexError) as caught:
        converted(tmp_path, robot, scene=SCENE.replace(old, new))
    for word in words:
        assert word in str(caught.value)


def test_goals_of_the_wrong_form_are_errors(robot: Robot, tmp_path: Path) -> None:
    head = REQUEST.split("goal_constraints")[0] + "goal_constraints: "
    for goals, words in (
        ("{a: 1}", "goal_constraints: expected a list"),
        ("[1]", "goal_constraints.0: expected a mapping"),
        ("[{joint_constraints: [{joint_name: left_joint1, position: .inf}]}]", "0.position: expected a finite number"),
        ("[{joint_constraints: [{joint_name: left_joint1}]}]", "0.position: expected a finite number, got None"),
        ("[{joint_constraints: [{joint_name: j1}]}]", "joint_constraints: expected joints of dual_.* map.*, got 'j1'"),
    ):
        with pytest.raises(FileFormatError, match=words):
            converted(tmp_path, robot, request=head + goals)


@pytest.mark.parametrize(
    ("addition", "word"),
    [
        ("trajectory_constraints: {constraints: [{name: x}]}", "trajectory_constraints"),
    ],
)
def test_constraints_that_would_change_the_problem_are_errors(
    robot: Robot, tmp_path: Path, addition: str, word: str
) -> None:
    with pytest.raises(FileFormatError, match=word):
        converted(tmp_path, robot, request=REQUEST + addition)
    pose_goal = REQUEST.split("goal_constraints")[0] + "goal_constraints: [{position_constraints: [{link_name: x}]}]"
    with pytest.raises(FileFormatError, match="position_constraints"):
        converted(tmp_path, robot, request=pose_goal)
    with pytest.raises(FileFormatError, match="goal_constraints"):
        converted(tmp_path, robot, request=REQUEST.split("goal_constraints")[0])


POSE_GOAL = """goal_constraints:
  - position_constraints:
      - header: {frame_id: base_link}
        link_name: palm
        constraint_region:
          primitives: [{type: 2, dimensions: [0.002]}]
          primitive_poses: [{position: {x: 0.5, y: 0.2, z: 0.6}, orientation: {w: 1.0}}]
    orientation_constraints:
      - header: {frame_id: base_link}
        link_name: palm
        orientation: {x: 1.0, y: 0.0, z: 0.0, w: 0.0}
        absolute_x_axis_tolerance: 0.05
        absolute_y_axis_tolerance: 0.03
        absolute_z_axis_tolerance: 0.04
"""


def test_a_goal_of_positions_and_orientations_is_one_of_poses(robot: Robot, tmp_path: Path) -> None:
    head = REQUEST.split("goal_constraints")[0]
    done = converted(tmp_path, robot, request=head + POSE_GOAL)
    goal = done.problem.goal
    assert goal.poses is not None and any("palm: its tolerances differ" in note for note in done.notes)
    (pose,) = goal.poses
    assert (pose.frame, pose.position) == ("left_hand_palm", (0.5, 0.2, 0.6))
    np.testing.assert_allclose(np.abs(pose.orientation), (1.0, 0.0, 0.0, 0.0), atol=1e-12)
    assert (pose.tolerance.position, pose.tolerance.angle) == (0.002, 0.03)
    alone = POSE_GOAL.partition("    orientation_constraints")[0]
    (free,) = converted(tmp_path, robot, request=head + alone).problem.goal.poses or ()
    assert free.orientation is None
    for change, word in (
        (("type: 2, dimensions: [0.002]", "type: 3, dimensions: [1, 1]"), "expected one sphere or box"),
        (("type: 2, dimensions: [0.002]", "type: 1, dimensions: [1, 1, 1]"), None),
        (("link_name: palm\n        orientation", "link_name: left_link5\n        orientation"), "a position for each"),
        (("link_name: palm", "link_name: nose"), "expected a link of"),
        (("tolerance: 0.04", "tolerance: 0"), "orientation_constraints of palm: expected three tolerances"),
        (("tolerance: 0.04", "tolerance: -1"), "orientation_constraints of palm: expected three tolerances"),
    ):
        changed = head + POSE_GOAL.replace(*change)
        if word is None:
            (box,) = converted(tmp_path, robot, request=changed).problem.goal.poses or ()
            assert (box.lower, box.upper) == ((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
            continue
        with pytest.raises(FileFormatError, match=word):
            converted(tmp_path, robot, request=changed)


def test_boxes_free_turns_and_several_goals_become_goals_of_which_any_will_do(robot: Robot, tmp_path: Path) -> None:
    head = REQUEST.split("goal_constraints")[0]
    quarter = "orientation: {x: 0.0, y: 0.0, z: 0.7071068, w: 0.7071068}"
    boxed = (
        POSE_GOAL.replace("type: 2, dimensions: [0.002]", "type: BOX, dimensions: [0.2, 0.1, 0.04]")
        .replace("orientation: {w: 1.0}", quarter)
        .replace("z_axis_tolerance: 0.04", "z_axis_tolerance: 3.2")
    )
    pose = (converted(tmp_path, robot, request=head + boxed).problem.goal.poses or ())[0]
    np.testing.assert_allclose(pose.upper, (0.05, 0.1, 0.02), atol=1e-12)
    assert pose.free_turn == "z" and pose.tolerance.angle == 0.03
    with pytest.raises(FileFormatError, match="along the axes of the wanted orientation"):
        converted(tmp_path, robot, request=head + boxed.replace(quarter, "orientation: {z: 0.38, w: 0.92}"))
    joints = REQUEST.partition("goal_constraints:\n")[2]
    both = converted(tmp_path, robot, request=head + POSE_GOAL + joints).problem.goal
    assert both.any_of is not None and len(both.any_of) == 2
    assert both.any_of[0].poses is not None and both.any_of[1].joints is not None


def test_the_command_converts_and_what_it_writes_plans(apex_cli, robot: Robot, tmp_path: Path) -> None:
    converted(tmp_path, robot)
    arguments = ["convert", tmp_path / "scene0001.yaml", tmp_path / "request0001.yaml", "-o", tmp_path / "p.yaml"]
    arguments += [word for pair in JOINTS.items() for word in ("--joint", "=".join(pair))]
    arguments += [word for pair in FRAMES.items() for word in ("--frame", "=".join(pair))]
    done = apex_cli(*arguments)
    assert done.returncode == 0 and done.stderr.count("note:") >= 3, done.stderr
    planned = apex_cli("plan", tmp_path / "p.yaml", "--timeout", 30)
    assert planned.returncode == 0, planned.stdout + planned.stderr
    by_file = apex_cli(*arguments, "--robot", DATA / "dual_panda_softhand.robot.yaml")
    assert by_file.returncode == 0, by_file.stderr
    assert load_robot(load_problem(tmp_path / "p.yaml").robot).joint_names == robot.joint_names
    wrong = apex_cli(*arguments[:3], "-o", tmp_path / "q.txt")
    assert wrong.returncode == 2 and "ending in .yaml" in wrong.stderr


def test_operations_are_carried_out_one_after_the_other(robot: Robot, tmp_path: Path) -> None:
    again = """    - {id: pillar, primitives: [{type: 1, dimensions: [0.1, 0.1, 0.1]}]}
"""
    removed = SCENE + "    - {id: base, operation: 1}\n" + again
    done = converted(tmp_path, robot, removed)
    bodies = {b.name: b for b in done.problem.scene}
    assert set(bodies) == {"pillar", "rock"}
    assert bodies["pillar"].box == (0.1, 0.1, 0.1), "what is added again takes the place of the one before"
    assert "collision_objects.3: removes 'base'" in done.notes
    done = converted(
        tmp_path, robot, SCENE + "    - {id: pebble, operation: 1}\n    - {id: '', operation: 1}\n" + again
    )
    assert [b.name for b in done.problem.scene] == ["pillar"], "REMOVE without a name removes all"


@pytest.mark.parametrize("value", ["1.5", "true", "2", "clear"])
def test_operations_are_constants_of_the_message(robot: Robot, tmp_path: Path, value: str) -> None:
    with pytest.raises(FileFormatError, match=r"collision_objects\.3\.operation: expected 0 or add .* or 1 or remove"):
        converted(tmp_path, robot, SCENE + f"    - {{id: base, operation: {value}}}\n")


@pytest.mark.parametrize("value", ["remove", "REMOVE", "'1'", '"\\x01"', "!!binary AQ=="])
def test_constants_are_numbers_or_words(robot: Robot, tmp_path: Path, value: str) -> None:
    scene = SCENE.replace("id: pillar", "operation: add\n      id: pillar").replace("type: 3", "type: '3'")
    done = converted(tmp_path, robot, scene + f"    - {{id: base, operation: {value}}}\n")
    assert [body.name for body in done.problem.scene] == ["pillar", "rock"]
    assert done.problem.scene[0].cylinder is not None


def test_an_octree_of_a_message_is_read_from_memory(robot: Robot, tmp_path: Path) -> None:
    data = [3, 0] * 15 + [2, 0]  # the first child of each node, down to one cell that is occupied
    tree = f"{{binary: true, id: OcTree, resolution: 0.1, data: {data}}}"
    octomap = f"  octomap: {{origin: {{position: {{x: 0.5}}}}, octomap: {tree}}}\n"
    made = converted(tmp_path, robot, SCENE + octomap).problem.scene[-1]
    assert made.name == "octomap" and made.voxels is not None and made.voxels.content is not None
    occupied, side, corner = parse_octomap(base64.b64decode(made.voxels.content), 10)
    assert occupied.shape == (1, 1, 1) and side == 0.1
    np.testing.assert_allclose(corner, [-3276.8] * 3)
    assert made.position == (0.5, 0.0, 0.0)
    with pytest.raises(FileFormatError, match="expected a binary map"):
        converted(tmp_path, robot, SCENE + octomap.replace("binary: true", "binary: false"))


def test_what_ros_prints_may_end_in_an_empty_document(robot: Robot, tmp_path: Path) -> None:
    done = converted(tmp_path, robot, SCENE + "---\n", "---\n" + REQUEST + "---\n---\n")
    assert len(done.problem.scene) == 4
    with pytest.raises(FileFormatError, match="expected one document of YAML, got '2 of them'"):
        converted(tmp_path, robot, SCENE + "---\n" + SCENE)


@pytest.mark.parametrize("value", ["['0', 0, 0]", "[true, 0, 0]", "{x: '1'}"])
def test_texts_are_no_numbers(robot: Robot, tmp_path: Path, value: str) -> None:
    with pytest.raises(FileFormatError, match=r"pose\.position: expected 3 finite numbers"):
        converted(tmp_path, robot, SCENE.replace("position: [0.5, 0.0, 0.1]", f"position: {value}"))


def along(folder: Path, robot: Robot, message: str) -> Conversion:
    return converted(folder, robot, request=REQUEST + "path_constraints:\n" + message)


def orientation(tolerances: str, more: str = "", turn: str = "[0, 0, 0.7071068, 0.7071068]") -> str:
    x, y, z = tolerances.split()
    return (
        f"  orientation_constraints:\n  - {{header: {{frame_id: base_link}}, link_name: palm, orientation: {turn}, "
        f"absolute_x_axis_tolerance: {x}, absolute_y_axis_tolerance: {y}, absolute_z_axis_tolerance: {z}{more}}}\n"
    )


def test_orientation_constraints_become_constraints_of_the_frame(robot: Robot, tmp_path: Path) -> None:
    turned = Rotation.from_euler("z", 90, degrees=True)
    (region,) = along(tmp_path, robot, orientation("0.2 0.2 0.2")).problem.constraints
    assert isinstance(region, ToolRegion) and region.frame == "left_hand_palm" and region.angle == 0.2
    assert region.lower == region.upper == (None, None, None)
    np.testing.assert_allclose(Rotation.from_quat(region.orientation).as_matrix(), turned.as_matrix(), atol=1e-6)
    (fixed,) = along(tmp_path, robot, orientation("0.01 0.01 0.01")).problem.constraints
    assert isinstance(fixed, FixedOrientation) and fixed.angle == 0.01
    np.testing.assert_allclose(Rotation.from_quat(fixed.orientation).as_matrix(), turned.as_matrix(), atol=1e-6)
    for k, tolerances in enumerate(("3.1416 0.1 0.1", "0.1 3.15 0.1", "0.1 0.1 6.3")):
        (upright,) = along(tmp_path, robot, orientation(tolerances)).problem.constraints
        assert isinstance(upright, Upright) and upright.angle == 0.1
        np.testing.assert_array_equal(upright.axis, np.eye(3)[k])
        np.testing.assert_allclose(upright.up, turned.as_matrix()[:, k], atol=1e-6)


def test_the_smallest_of_different_tolerances_holds_for_all(robot: Robot, tmp_path: Path) -> None:
    done = along(tmp_path, robot, orientation("0.1 0.3 0.2"))
    assert done.problem.constraints[0].angle == 0.1
    assert any("orientation_constraints.0: its tolerances differ" in note for note in done.notes)
    done = along(tmp_path, robot, orientation("4 4 4"))
    assert not done.problem.constraints
    assert any("not used, any orientation is within its tolerances" in note for note in done.notes)


@pytest.mark.parametrize("angle", [0.1, 0.7, 1.5])
def test_rotations_by_an_angle_are_within_moveits_tolerances(angle: float) -> None:
    """What the import relies on, for Euler angles and for rotation vectors."""
    axes = np.random.default_rng(0).normal(size=(500, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    turns = Rotation.from_rotvec(angle * axes)
    assert np.abs(turns.as_euler("XYZ")).max() <= angle + 1e-12
    assert np.abs(turns.as_rotvec()).max() <= angle + 1e-12
    for k, axis in ((2, (0.0, 0.0, 1.0)), (0, (1.0, 0.0, 0.0))):  # an axis tilts by the angle, turned about itself
        across = axes * (np.arange(3) != k)
        tilts = Rotation.from_rotvec(angle * across / np.linalg.norm(across, axis=1)[:, None])
        spun = tilts * Rotation.from_rotvec(np.linspace(-3.0, 3.0, 500)[:, None] * np.array(axis))
        others = [j for j in range(3) if j != k]
        assert np.abs(spun.as_euler("XYZ"))[:, others].max() <= angle + 1e-12


BOX = """  position_constraints:
  - header: {frame_id: world}
    link_name: palm
    constraint_region:
      primitives: [{type: 1, dimensions: [0.2, 0.4, 0.6]}]
      primitive_poses: [{position: [0.5, 0.1, 0.3], orientation: [0, 0, 0.7071068, 0.7071068]}]
"""


def test_a_box_for_a_position_becomes_a_region(robot: Robot, tmp_path: Path) -> None:
    (region,) = along(tmp_path, robot, BOX).problem.constraints
    assert isinstance(region, ToolRegion) and region.frame == "left_hand_palm" and region.angle is None
    np.testing.assert_allclose(region.upper, [0.1, 0.2, 0.3])
    np.testing.assert_allclose(region.lower, [-0.1, -0.2, -0.3])
    np.testing.assert_allclose(region.position, [0.5, 0.1, 0.3])
    np.testing.assert_allclose(region.orientation, [0, 0, 0.7071068, 0.7071068], atol=1e-7)
    point = list(robot.hands["left_hand"].point)
    (region,) = along(tmp_path, robot, BOX + f"    target_point_offset: {point}\n").problem.constraints
    assert region.frame == "left_hand"


def test_joint_constraints_are_dropped_where_the_limits_are_inside(robot: Robot, tmp_path: Path) -> None:
    text = "  joint_constraints: [{joint_name: panda_joint1, position: 0, tolerance_above: 3, tolerance_below: 3}]\n"
    done = along(tmp_path, robot, text)
    assert not done.problem.constraints
    assert "path_constraints.joint_constraints.0: not used, the limits of left_joint1 are inside" in done.notes
    done = along(tmp_path, robot, "  joint_constraints: [{joint_name: finger, position: 0}]\n")
    assert any("joint 'finger' is not planned" in note for note in done.notes)


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (orientation("0.1 4 4"), "orientation_constraints.0: cannot be read, expected at most one tolerance from pi"),
        (orientation("0.1 0.1 0"), "orientation_constraints.0: expected three tolerances of angles above 0"),
        (orientation("0.1 0.1 .nan"), "absolute_z_axis_tolerance: expected a finite number, got nan"),
        (
            orientation("0.1 0.1 0.1", turn="[1, 0]"),
            "orientation_constraints.0.orientation: expected 4 finite numbers",
        ),
        (orientation("0.1 0.1 0.1").replace("palm", "claw"), "link_name: expected a link of .*--frame claw=LINK"),
        (orientation("0.1 0.1 0.1").replace("base_link", "left_link4"), "expected a frame that does not move"),
        (orientation("0.1 0.1 0.1").replace("base_link", "moon"), "'moon'"),
        (
            BOX.replace("type: 1, dimensions: [0.2, 0.4, 0.6]", "type: 2, dimensions: [0.2]"),
            "expected one box, got 'sphere'",
        ),
        (
            BOX.replace("primitives: [", "primitives: [{type: 1, dimensions: [1, 1, 1]}, "),
            "primitive_poses: .*2 poses",
        ),
        (BOX.replace("primitive", "other"), "constraint_region.primitives: cannot be read, expected one box, got 0"),
        (BOX + "      meshes: [{resource: a.obj}]\n", "constraint_region.meshes: cannot be read, expected one box"),
        (BOX.replace("0.2, 0.4, 0.6", "0.2, 0.4, 0.0001"), "constraint_region: expected bounds of z .* apart"),
        (
            BOX + "    target_point_offset: [0, 0, 0.3]\n",
            "target_point_offset: cannot be read, expected 0, or the grasp",
        ),
        (
            "  joint_constraints: [{joint_name: panda_joint1, position: 0}]\n",
            "joint_constraints.0: .*range that holds the limits",
        ),
        (
            "  visibility_constraints: [{target_radius: 0.1}]\n",
            "path_constraints.visibility_constraints: cannot be read",
        ),
        ("  position_constraints: {a: 1}\n", "path_constraints.position_constraints: expected a list"),
    ],
)  # fmt: skip
def test_path_constraints_that_cannot_be_read_are_errors(
    robot: Robot, tmp_path: Path, message: str, words: str
) -> None:
    with pytest.raises(FileFormatError, match=words):
        along(tmp_path, robot, message)
