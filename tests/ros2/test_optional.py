"""The node with packages that have no wheels: actions, MoveIt's motion plan service, and transforms.

These tests are skipped without ``control_msgs``, ``moveit_msgs`` and ``tf2_msgs``, as a ROS 2 of the system has them.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from support import benchmark_script

from apex_ompl import MotionPlanner, Obstacle
from apex_ompl.collision import CollisionChecker
from apex_ompl.drivers import Ros2Driver
from apex_ompl.errors import DriverError
from apex_ompl.robot import Robot
from apex_ompl.timing import Trajectory, time_path

pytest.importorskip("rclpy")
pytest.importorskip("control_msgs")
pytest.importorskip("moveit_msgs")
pytest.importorskip("tf2_msgs")

from geometry_msgs.msg import Pose, PoseStamped, TransformStamped  # noqa: E402 - without rclpy there are no messages
from moveit_msgs.msg import (  # noqa: E402
    Constraints,
    JointConstraint,
    MotionPlanRequest,
    MoveItErrorCodes,
    OrientationConstraint,
    PositionConstraint,
)
from moveit_msgs.srv import GetMotionPlan  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402
from shape_msgs.msg import SolidPrimitive  # noqa: E402
from tf2_msgs.msg import TFMessage  # noqa: E402
from visualization_msgs.msg import MarkerArray  # noqa: E402

from apex_ompl.ros2.node import ApexNode  # noqa: E402

client_of, stand_ins_of = benchmark_script("physics.ros2_client"), benchmark_script("physics.stand_ins")


@pytest.fixture(scope="module")
def node(robot: Robot, stand_ins: Any) -> Iterator[ApexNode]:
    given = [*stand_ins.parameters(), "-p", "speed:=1.0", "-p", "action:=true", "-p", "closed_loop:=never"]
    found = ApexNode(MotionPlanner(robot), None, given)
    thread = threading.Thread(target=found.run)
    thread.start()
    yield found
    found.end()
    thread.join()
    found.close()


@pytest.fixture(scope="module")
def client(node: ApexNode) -> Iterator[Any]:
    with client_of.Client(("goal/joints", "goal/left_hand", "world")).running() as found:
        found.matched()
        yield found


def joints(robot: Robot, by: float) -> JointState:
    names = [stand_ins_of.PREFIX + name for name in robot.joint_names]
    return JointState(name=names, position=[robot.home[0] + by, *robot.home[1:].tolist()])


def first_joint(stand_ins: Any) -> float:
    _, states = stand_ins.followed()
    return float(states[~np.isnan(states[:, 0]), 0][-1])


def test_motions_go_as_actions_and_are_replaced(robot: Robot, stand_ins: Any, client: Any) -> None:
    client.trajectories_of([])  # nothing by topic
    assert client.go("goal/joints", joints(robot, 0.5)) == "reached"
    time.sleep(0.1)
    assert abs(first_joint(stand_ins) - robot.home[0] - 0.5) <= 1e-6
    count = len(client.outcomes)
    client.publishers["goal/joints"].publish(joints(robot, -0.5))
    client.wait(lambda: abs(first_joint(stand_ins) - robot.home[0] - 0.5) > 0.1)
    client.publishers["goal/joints"].publish(joints(robot, 0.0))
    assert client.wait(lambda: client.outcomes[count + 1 :]) == ["reached"]
    time.sleep(0.1)
    assert abs(first_joint(stand_ins) - robot.home[0]) <= 1e-6


def test_what_a_controller_answers_is_an_error_of_the_driver(robot: Robot, stand_ins: Any, client: Any) -> None:
    """A controller rejects a motion of joints in another order; the next motion that it takes makes that good."""
    left, right = stand_ins.joints["left"], stand_ins.joints["right"]
    renamed = {name: stand_ins_of.PREFIX + name for name in robot.joint_names}
    driver = Ros2Driver(robot, {"left": left[::-1], "right": right}, renamed=renamed, node="other", action=True)
    q = driver.commanded(driver.time)[0]
    motion = time_path(np.stack([q, q + 0.01]), robot.limits, robot.joint_names).trajectory
    driver.send(motion, driver.time + 0.05)

    def fault() -> str:
        try:
            driver.state()
        except DriverError as error:
            return str(error)
        return ""

    assert client.wait(fault) == "/left/follow_joint_trajectory rejected a motion"
    driver.close()
    time.sleep(motion.duration + 0.2)


def asked(client: Any, request: MotionPlanRequest) -> Any:
    service = client.node.create_client(GetMotionPlan, "/plan_kinematic_path")
    assert service.wait_for_service(10.0)
    answer = service.call_async(GetMotionPlan.Request(motion_plan_request=request))
    return client.wait(lambda: answer.result() if answer.done() else None).motion_plan_response


def joint_request(robot: Robot, by: float, **fields: Any) -> MotionPlanRequest:
    position = robot.home[0] + by
    one = JointConstraint(joint_name="r_left_joint1", position=position, tolerance_above=0.01, tolerance_below=0.01)
    return MotionPlanRequest(goal_constraints=[Constraints(joint_constraints=[one])], **fields)


def motion_of(robot: Robot, answer: Any) -> Trajectory:
    """The motion of all joints in an answer of those of a group, or of all."""
    message = answer.trajectory.joint_trajectory
    ours = [name.removeprefix(stand_ins_of.PREFIX) for name in message.joint_names]
    columns = [robot.joint_names.index(name) for name in ours]
    times = np.array([p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in message.points])
    states = np.zeros((3, len(times), robot.dof))
    states[0] = answer.trajectory_start.joint_state.position
    for k, name in enumerate(("positions", "velocities", "accelerations")):
        states[k][:, columns] = [getattr(point, name) for point in message.points]
    return Trajectory(times, *states, robot.joint_names)


def test_the_service_of_move_group_plans_in_the_world(robot: Robot, client: Any) -> None:
    """From a given start, around an obstacle in the straight way, for a group, at a share of the speed."""
    middle = robot.link_pose(robot.home, "left_hand_palm")[:3, 3]
    box = Obstacle(name="box", box=(0.06, 0.06, 0.06), position=tuple(middle))
    request = joint_request(robot, -0.5, group_name="left_arm", max_velocity_scaling_factor=0.5)
    request.start_state.joint_state = JointState(name=["r_left_joint1"], position=[robot.home[0] + 0.5])
    free = motion_of(robot, asked(client, request))
    client.publishers["world"].publish(MarkerArray(markers=[client_of.marker_of(1, box.box, middle)]))
    time.sleep(0.5)
    answer = asked(client, request)
    assert answer.error_code.val == MoveItErrorCodes.SUCCESS and answer.group_name == "left_arm"
    assert len(answer.trajectory.joint_trajectory.joint_names) == 7
    motion, checker = motion_of(robot, answer), CollisionChecker(robot, [box])
    assert abs(motion.positions[0, 0] - robot.home[0] - 0.5) <= 1e-9
    assert abs(motion.positions[-1, 0] - robot.home[0] + 0.5) <= 1e-6
    states = motion(np.linspace(0.0, motion.duration, 100))
    assert all(checker.is_free(q) for q in states)
    assert not all(checker.is_free(q) for q in free(np.linspace(0.0, free.duration, 100)))
    assert motion.use(robot.limits)["velocity"] <= 0.5 + 1e-6
    marker = client_of.marker_of(1, box.box, middle)
    marker.action = 3
    client.publishers["world"].publish(MarkerArray(markers=[marker]))
    time.sleep(0.5)


def test_the_service_takes_poses(robot: Robot, client: Any) -> None:
    """A ball for the position and tolerances for the orientation, as MoveIt makes them of a pose."""
    hand = robot.hands["left_hand"]
    wanted = robot.link_pose(robot.home, hand.palm)
    place = PositionConstraint(link_name=hand.palm)
    place.header.frame_id = "world"
    place.constraint_region.primitives = [SolidPrimitive(type=SolidPrimitive.SPHERE, dimensions=[1e-3])]
    pose = Pose()
    pose.position.x, pose.position.y, pose.position.z = (wanted[:3, 3] + (0.0, 0.0, 0.1)).tolist()
    place.constraint_region.primitive_poses = [pose]
    turn = OrientationConstraint(link_name=hand.palm)
    turn.absolute_x_axis_tolerance = turn.absolute_y_axis_tolerance = turn.absolute_z_axis_tolerance = 0.01
    turn.header.frame_id = "world"
    q = pin.Quaternion(wanted[:3, :3])
    turn.orientation.x, turn.orientation.y, turn.orientation.z, turn.orientation.w = q.x, q.y, q.z, q.w
    goal = Constraints(position_constraints=[place], orientation_constraints=[turn])
    answer = asked(client, MotionPlanRequest(goal_constraints=[goal]))
    assert answer.error_code.val == MoveItErrorCodes.SUCCESS, answer.error_code
    reached = robot.link_pose(motion_of(robot, answer).positions[-1], hand.palm)
    assert np.abs(reached[:3, 3] - wanted[:3, 3] - (0.0, 0.0, 0.1)).max() <= 1.1e-3
    assert np.abs(reached[:3, :3] - wanted[:3, :3]).max() <= 0.011


def test_faulty_requests_have_codes_and_sentences(robot: Robot, client: Any) -> None:
    unknown = MotionPlanRequest(goal_constraints=[Constraints(joint_constraints=[JointConstraint(joint_name="elbow")])])
    nan = joint_request(robot, 0.1)
    nan.start_state.joint_state = JointState(name=["r_left_joint1"], position=[np.nan])
    for request, code in (
        (joint_request(robot, 0.1, group_name="legs"), MoveItErrorCodes.INVALID_GROUP_NAME),
        (MotionPlanRequest(), MoveItErrorCodes.INVALID_GOAL_CONSTRAINTS),
        (unknown, MoveItErrorCodes.INVALID_GOAL_CONSTRAINTS),
        (joint_request(robot, 9.0), MoveItErrorCodes.GOAL_STATE_INVALID),
        (nan, MoveItErrorCodes.INVALID_ROBOT_STATE),
    ):
        answer = asked(client, request)
        assert answer.error_code.val == code, answer.error_code
        assert answer.error_code.message and "\n" not in answer.error_code.message
        assert not answer.trajectory.joint_trajectory.points


def test_goals_in_frames_of_tf(robot: Robot, stand_ins: Any, client: Any) -> None:
    """The camera hangs below a rig, which stands in the world."""
    publisher = client.node.create_publisher(TFMessage, "/tf", 10)
    client.wait(publisher.get_subscription_count)
    chain = []
    for parent, child, z in (("world", "rig", 0.4), ("rig", "camera", 0.6)):
        one = TransformStamped(child_frame_id=child)
        one.header.frame_id, one.transform.translation.z, one.transform.rotation.w = parent, z, 1.0
        chain.append(one)
    publisher.publish(TFMessage(transforms=chain))
    time.sleep(0.3)
    goal = PoseStamped()
    goal.header.frame_id = "camera"
    goal.pose.position.x, goal.pose.position.y, goal.pose.position.z, goal.pose.orientation.w = 0.5, 0.3, -0.5, 0.0
    assert client.go("goal/left_hand", goal) == "reached"
    time.sleep(0.1)
    _, states = stand_ins.followed()
    q = np.array([column[~np.isnan(column)][-1] for column in states.T])
    hand = robot.hands["left_hand"]
    palm = robot.link_pose(q, hand.palm)
    assert np.allclose(palm[:3, :3] @ hand.point + palm[:3, 3], (0.5, 0.3, 0.5), atol=2e-3)
