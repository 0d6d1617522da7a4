"""``planner.ik``, ``planner.fk`` and named poses, against Pinocchio and a dense search."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from scipy.optimize import least_squares
from small_arm import write_arm

from apex_ompl import (
    ApexError,
    MotionPlanner,
    PoseTarget,
    Problem,
    Robot,
    load_problem,
    load_robot,
    plan,
    plan_task,
)
from apex_ompl.api import load_environment
from apex_ompl.collision import CollisionChecker
from apex_ompl.goals.self_motions import SPACING
from apex_ompl.planning.inverse_kinematics import IKResult


@pytest.fixture(scope="module")
def panda() -> Robot:
    return load_robot("panda")


def pinocchio_pose(robot: Robot, q: np.ndarray, hand: str) -> pin.SE3:
    """The pose of a hand, by Pinocchio alone."""
    data, record = robot.model.createData(), robot.hands[hand]
    pin.forwardKinematics(robot.model, data, robot.to_pinocchio(q))
    pin.updateFramePlacements(robot.model, data)
    return data.oMf[robot.model.getFrameId(record.palm)] * pin.SE3(np.eye(3), np.array(record.point))


def jacobian(robot: Robot, pose: pin.SE3, q: np.ndarray) -> np.ndarray:
    """The derivative of the logarithm of a hand's pose relative to another one, by Pinocchio, shape (6, dof)."""
    point = pin.SE3(np.eye(3), np.array(robot.hands["hand"].point))
    frame = robot.model.getFrameId(robot.hands["hand"].palm)
    palm = pin.computeFrameJacobian(robot.model, robot.model.createData(), robot.to_pinocchio(q), frame, pin.LOCAL)
    off = pose.actInv(pinocchio_pose(robot, q, "hand"))
    return pin.Jlog6(off) @ point.toActionMatrixInverse() @ palm[:, np.argsort(robot.state_order)]


def target(frame: str, pose: pin.SE3) -> PoseTarget:
    xyzw = tuple(pin.Quaternion(pose.rotation).coeffs())
    return PoseTarget(frame=frame, position=tuple(pose.translation), orientation=xyzw)


def check_solutions(robot: Robot, found: IKResult, wanted: dict[str, pin.SE3]) -> None:
    limits, checker = robot.limits, CollisionChecker(robot)
    for one in found:
        assert (limits.lower <= one.state).all() and (one.state <= limits.upper).all()
        assert checker.is_free(one.state) and one.clearance > 0.0
        for hand, pose in wanted.items():
            off = pin.log6(pose.actInv(pinocchio_pose(robot, one.state, hand))).vector
            assert np.abs(off).max() < 1e-6


@pytest.mark.parametrize("seed", [3, 4, 5])
def test_nearly_all_branches_of_a_dense_search_are_found(panda: Robot, seed: int) -> None:
    rng = np.random.default_rng(seed)
    pose = pinocchio_pose(panda, panda.random_state(rng), "hand")
    with MotionPlanner(panda) as planner:
        found = planner.ik(target("hand", pose), count=1000)
        check_solutions(panda, found, {"hand": pose})
    checker, limits = CollisionChecker(panda), panda.limits
    dense = list[np.ndarray]()
    for q in panda.random_state(rng, 30):  # by SciPy's optimizer and Pinocchio, from random starts
        off = least_squares(
            lambda q: pin.log6(pose.actInv(pinocchio_pose(panda, q, "hand"))).vector, q,
            lambda q: jacobian(panda, pose, q), bounds=(limits.lower, limits.upper), xtol=1e-12, max_nfev=30,
        )  # fmt: skip
        if np.abs(off.fun).max() < 1e-7 and checker.is_free(off.x):
            dense.append(off.x)
    near = [len(found) and np.abs(found.states - q).max(axis=1).min() < SPACING for q in dense]
    assert np.mean(near) >= 0.95 if near else not found


def test_states_of_a_branch_are_apart_and_without_gaps(panda: Robot) -> None:
    with MotionPlanner(panda) as planner:
        found = planner.ik(target("hand", pinocchio_pose(panda, panda.home, "hand")), near="home", count=1000)
    assert found[0].distance < 0.1 and [one.distance for one in found] == sorted(one.distance for one in found)
    first = np.array([one.state for one in found if one.branch == found[0].branch])
    apart = np.abs(first[:, None] - first[None]).max(axis=2)
    np.fill_diagonal(apart, np.inf)
    assert len(first) > 10 and apart.min() > SPACING / 16.0 and apart.min(axis=1).max() < 2.0 * SPACING


def test_poses_of_two_hands_are_combined_and_the_largest_clearance_comes_first(robot: Robot) -> None:
    poses = {hand: pinocchio_pose(robot, robot.home, hand) for hand in ("left_hand", "right_hand")}
    with MotionPlanner(robot) as planner:
        found = planner.ik([target(hand, pose) for hand, pose in poses.items()], count=20)
        check_solutions(robot, found, poses)
        rounded = [round(one.clearance, 3) for one in found]
        assert len(found) == 20 and rounded == sorted(rounded, reverse=True)
        alone = planner.ik(target("left_hand", poses["left_hand"]), group="left_arm", near="home", count=5)
        right = [k for k, name in enumerate(robot.joint_names) if not name.startswith("left_joint")]
        assert len(alone) == 5 and np.array_equal(alone.states[:, right], np.tile(robot.home[right], (5, 1)))
        assert np.array_equal(alone.states, planner.ik(
            target("left_hand", poses["left_hand"]), group="left_arm", near="home", count=5
        ).states)  # fmt: skip


def test_states_of_a_region_are_inside_of_it_and_all_over_it(panda: Robot) -> None:
    pose, turn = pinocchio_pose(panda, panda.home, "hand"), (0.4, 0.9)
    wanted = target("hand", pose)
    turned = wanted.model_copy(update={"free_turn": "z", "turn": turn})
    box = wanted.model_copy(update={"lower": (-0.1, 0.0, -0.05), "upper": (0.1, 0.0, 0.0)})
    with MotionPlanner(panda) as planner:
        offs = [pose.actInv(pinocchio_pose(panda, one.state, "hand")) for one in planner.ik(turned)]
        angles = np.array([pin.log3(off.rotation) for off in offs])
        assert len(angles) > 100 and np.abs(angles[:, :2]).max() < 1e-6
        assert turn[0] - 1e-6 <= angles[:, 2].min() < 0.45 and 0.85 < angles[:, 2].max() <= turn[1] + 1e-6
        offs = [pose.actInv(pinocchio_pose(panda, one.state, "hand")) for one in planner.ik(box)]
        places = np.array([off.translation for off in offs])
        assert max(np.linalg.norm(pin.log3(off.rotation)) for off in offs) < 1e-6
        assert (np.array(box.lower) - 1e-6 <= places).all() and (places <= np.array(box.upper) + 1e-6).all()
        assert np.ptp(places[:, 0]) > 0.15 and np.ptp(places[:, 2]) > 0.04


def test_a_region_is_not_out_of_reach_where_a_part_of_it_is_reached(panda: Robot) -> None:
    pose = target("hand", pinocchio_pose(panda, panda.home, "hand"))
    far = pose.model_copy(update={"position": (1.5, 0.0, 0.3), "lower": (-2.0, -0.5, -0.5), "upper": (0.0, 0.5, 0.5)})
    with MotionPlanner(panda) as planner:
        assert planner.ik(far)
        assert "out of reach" in planner.ik(far.model_copy(update={"lower": (-0.3, -0.1, -0.1)})).reason


def test_what_stands_in_the_way_is_named_by_share(panda: Robot) -> None:
    pose = pinocchio_pose(panda, panda.home, "hand")
    with MotionPlanner(panda) as planner:
        planner.world.add(name="block", box=(0.1, 0.1, 0.1), position=tuple(pose.translation))
        found = planner.ik(target("hand", pose))
        assert not found and found.causes.get("block", 0.0) > 0.9 and "block (" in found.reason
        assert "descents" in found.reason and found.reached > 0 and "out of reach" not in found.reason
        planner.world.clear()
        turned = pose * pin.SE3(pin.exp3(np.array([np.pi, 0.0, 0.0])), np.zeros(3))  # the hand from below
        turned.translation[:] = (0.0, 0.0, 0.7)
        limits = planner.ik(target("hand", turned))
        assert not limits and any(cause.startswith("limit of panda_joint") for cause in limits.causes)
        assert "out of reach" not in limits.reason


def test_out_of_reach_is_said_where_the_links_are_too_short(panda: Robot) -> None:
    rng = np.random.default_rng(0)
    with MotionPlanner(panda) as planner:
        assert "out of reach" in planner.ik(PoseTarget(frame="hand", position=(1.5, 0.0, 0.3))).reason
        for q in panda.random_state(rng, 30):  # whatever is reached is not said to be out of reach
            pose = target("hand", pinocchio_pose(panda, q, "hand"))
            upside_down = target(
                "hand", pinocchio_pose(panda, q, "hand") * pin.SE3(pin.exp3(np.pi * np.eye(3)[0]), np.zeros(3))
            )
            turned = upside_down.model_copy(update={"free_turn": "x"})
            for one in (pose, pose.model_copy(update={"orientation": None}), turned):
                assert "out of reach" not in planner.ik(one, descents=1, count=1).reason


def test_poses_in_millimeters_or_with_w_first_get_a_hint(panda: Robot) -> None:
    up = PoseTarget(frame="hand", position=(0.2, 0.0, 1.0), orientation=(0.0, 0.0, 0.0, 1.0))
    with MotionPlanner(panda) as planner:
        assert planner.ik(up, descents=64)
        for given, words in (
            ({"position": (200.0, 0.0, 1000.0)}, "; in millimeters it could be reached, but here positions are meters"),
            ({"orientation": (1.0, 0.0, 0.0, 0.0)}, "; as a quaternion [w, x, y, z] it could be reached"),
        ):
            wrong = up.model_copy(update=given)
            assert words in planner.ik(wrong, descents=64).reason
            assert words in planner.plan("home", wrong, timeout=1.0).reason
        high = PoseTarget(frame="hand", position=(0.0, 0.0, 3.0))
        assert "could be reached" not in planner.ik(high).reason


def test_forward_kinematics_are_pinocchios_also_of_held_objects(panda: Robot) -> None:
    q = panda.random_state(np.random.default_rng(1))
    with MotionPlanner(panda) as planner:
        assert np.allclose(planner.fk(q, "hand"), pinocchio_pose(panda, q, "hand").homogeneous, atol=1e-12)
        planner.world.add(name="cup", box=(0.02, 0.02, 0.1), position=(0.55, 0.0, 0.3))
        at = pin.SE3(planner.fk("home", "hand"))
        planner.world.attach("cup", "panda_hand", at=panda.home)
        cup = pin.SE3(np.eye(3), np.array([0.55, 0.0, 0.3]))
        moved = pinocchio_pose(panda, q, "hand") * at.actInv(cup)
        assert np.allclose(planner.fk(q, "cup"), moved.homogeneous, atol=1e-9)
        assert planner.ik(target("cup", cup), near="home")[0].distance < 0.1


def test_named_poses_of_a_robot_file_are_states(tmp_path: Path) -> None:
    file = write_arm(tmp_path)
    file.write_text(file.read_text() + "poses: {ready: {turn: 0.5}}\n")
    robot = load_robot(file)
    assert np.array_equal(robot.poses["ready"], [0.5, 0.4, 0.6]) and robot.poses["home"] is robot.home
    with MotionPlanner(file) as planner:
        found = planner.plan("home", "ready", timeout=20.0)
        assert found and np.array_equal(found.path.states[-1], robot.poses["ready"])
        several = planner.plan("ready", ["ready", "home"], timeout=20.0)
        assert several and np.array_equal(several.path.states[-1], robot.poses["ready"])
        with pytest.raises(ApexError, match="did you mean 'ready'"):
            planner.check("redy")
    for faulty, words in (
        ("{ready: {trn: 0.5}}", "pose 'ready'"), ("{ready: {turn: 5}}", r"ready.turn: .*\], got 5\.0"),
        ("{ready: {turn: 90}}", "in degrees it would be inside.*got 90.0"),
        ("{ready: {turn: -400}}", r"\]; angles are radians, got -400\.0"), ("{home: {turn: 0.5}}", "poses"),
    ):  # fmt: skip
        file.write_text(file.read_text().rsplit("poses", 1)[0] + f"poses: {faulty}")
        with pytest.raises(ApexError, match=words):
            load_robot(file)


POSED = """schema: apex-ompl/problem/1
name: posed
robot: small_arm.robot.yaml
start: home
goal: {joints: ready}
after: [{kind: move, goal: {any_of: [{joints: [home, {turn: 0.1, shoulder: 0.4, elbow: 0.6}]}]}}]
"""


def test_named_poses_stand_for_joint_values_in_problem_files(tmp_path: Path) -> None:
    robot_file = write_arm(tmp_path)
    robot_file.write_text(robot_file.read_text() + "poses: {ready: {turn: 0.5}}\n")
    file = tmp_path / "posed.yaml"
    file.write_text(POSED)
    problem, robot = load_problem(file), load_robot(robot_file)
    assert np.array_equal(problem.start_state(robot.joint_names), robot.home)
    assert np.array_equal(problem.goal_states(robot.joint_names), [robot.poses["ready"]])
    assert problem.after[0].goal.any_of[0].joints[0] == dict(zip(robot.joint_names, robot.home, strict=True))
    done = plan_task(file, timeout=20.0)
    assert done and np.array_equal(done.path.states[0], robot.home) and done.steps[-1].kind == "move"
    assert "home" not in done.problem.to_yaml() and load_problem(file) == problem
    assert np.array_equal(load_environment(file).problem.start_state(robot.joint_names), robot.home)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("start: home", "start: hme", r"posed.yaml: start: unknown pose, did you mean 'home'\?, got 'hme'"),
        ("joints: ready", "joints: [ready, elsewhere]", r"goal.joints.1: unknown pose, known: home, ready"),
        ("[home, {turn", "[hme, {turn", r"after.0.goal.any_of.0.joints.0: unknown pose"),
        ("joints: ready", "any_of: []", "any_of: .*expected 1 item or more"),
        ("joints: ready", "any_of: [{joints: home}, {joints: {turn: 1.0}}]", "joint 'shoulder' is missing"),
        ("joints: ready", "any_of: [{any_of: [{joints: home}]}]", "no any_of inside of any_of"),
        ("joints: ready", "any_of: [hom]", "goal.any_of.0.joints.0: unknown pose, did you mean 'home'"),
        ("joints: ready", "any_of: [7]", "goal.any_of.0: .*got 7"),
        ("start: home", "start: [0.1, 0.2, 0.3]", "start: .*expected a mapping of keys"),
        ("small_arm.robot.yaml", "3", "posed.yaml: robot: "),
        ("small_arm.robot.yaml", "smal_arm", "unknown robot 'smal_arm'"),
    ],
)
def test_faulty_names_in_problem_files_are_named(tmp_path: Path, old: str, new: str, message: str) -> None:
    robot_file = write_arm(tmp_path)
    robot_file.write_text(robot_file.read_text() + "poses: {ready: {turn: 0.5}}\n")
    file = tmp_path / "posed.yaml"
    file.write_text(POSED.replace(old, new, 1))
    with pytest.raises(ApexError, match=message):
        plan(file, timeout=5.0)


def test_a_problem_that_knows_no_robot_says_who_reads_names() -> None:
    with pytest.raises(ApexError, match=r"start: expected values by joint name; .* apex_ompl.load_problem"):
        Problem.parse({"name": "posed", "robot": "panda", "start": "home", "goal": {"joints": "home"}}, "posed")


@pytest.mark.parametrize(
    ("arguments", "options", "message"),
    [
        ([[]], {}, "targets: expected a PoseTarget"),
        ([3], {}, "targets: expected a PoseTarget"),
        ([PoseTarget(frame="hnd", position=(0.5, 0, 0.5))], {}, "did you mean 'hand'"),
        ([PoseTarget(frame="hand", position=(0.5, 0, 0.5))], {"count": 0}, "count: expected"),
        ([PoseTarget(frame="hand", position=(0.5, 0, 0.5))], {"near": [1.0]}, "near: expected"),
        ([PoseTarget(frame="hand", position=(0.5, 0, 0.5))], {"near": "nowhere"}, "unknown pose"),
        ([PoseTarget(frame="panda_link0", position=(0.5, 0, 0.5))], {}, "joints that move the frame"),
        ([[PoseTarget(frame="hand", position=(0.5, 0, 0.5))] * 2], {}, "more than one pose"),
    ],
)
def test_faulty_input_is_named(panda: Robot, arguments: list[Any], options: dict[str, Any], message: str) -> None:
    with MotionPlanner(panda) as planner, pytest.raises(ApexError, match=message):
        planner.ik(*arguments, **options)
