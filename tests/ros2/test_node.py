"""The node over the real middleware, in a thread here, against controllers in processes of their own."""

from __future__ import annotations

import re
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from support import benchmark_script

from apex_ompl import MotionPlanner, Obstacle, Problem
from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ApexError
from apex_ompl.robot import Robot
from apex_ompl.timing import time_path
from apex_ompl.types import Array

pytest.importorskip("rclpy")

from geometry_msgs.msg import Pose, PoseArray, PoseStamped  # noqa: E402 - without rclpy there are no messages
from rcl_interfaces.srv import SetParameters  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402
from visualization_msgs.msg import MarkerArray  # noqa: E402

from apex_ompl.ros2.node import ApexNode  # noqa: E402

ALIKE = 1e-6  # of measured positions to a goal [rad]
client_of, stand_ins_of = benchmark_script("physics.ros2_client"), benchmark_script("physics.stand_ins")
BALL = Obstacle(name="ball", sphere={"radius": 0.06}, position=(2.0, 0.0, 1.0))


@pytest.fixture(scope="module")
def node(robot: Robot, stand_ins: Any) -> Iterator[ApexNode]:
    home = dict(zip(robot.joint_names, robot.home.tolist(), strict=True))
    problem = Problem(name="ball", robot=robot.name, scene=(BALL,), start=home, goal={"joints": home})
    given = [
        *stand_ins.parameters(),
        "-p",
        "speed:=1.0",
        "-p",
        "tracked:=[ball]",
        "-p",
        "closed_loop:=never",
        "-p",
        "frames:=['camera=0 0 1 0 0 0 1']",
    ]
    found = ApexNode(MotionPlanner(robot), problem, given)
    thread = threading.Thread(target=found.run)
    thread.start()
    yield found
    found.end()
    thread.join()
    found.close()


@pytest.fixture(scope="module")
def client(node: ApexNode) -> Iterator[Any]:
    found = client_of.Client()
    found.matched()
    yield found
    found.close()


@pytest.fixture(autouse=True)
def _at_home(request: pytest.FixtureRequest, robot: Robot) -> None:
    """Start each test from home in an empty world."""
    if "client" in request.fixturenames:
        client = request.getfixturevalue("client")
        client.publishers["world"].publish(MarkerArray(markers=[deleted()]))
        client.publishers["points"].publish(client_of.cloud_of(np.zeros((0, 3))))
        assert client.go("goal/joints", joints(robot, robot.home)) == "reached"


def deleted() -> Any:
    marker = client_of.marker_of(1, (0.1, 0.1, 0.1), (0.0, 0.0, 0.0))
    marker.action = 3
    return marker


def joints(robot: Robot, q: Array) -> JointState:
    return JointState(name=[stand_ins_of.PREFIX + name for name in robot.joint_names], position=q.tolist())


def set_parameter(client: Any, name: str, value: Any) -> Any:
    """Set a parameter of the node, and return its answer."""
    service = client.node.create_client(SetParameters, "/apex_ompl/set_parameters")
    try:
        assert service.wait_for_service(timeout_sec=30.0)
        request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
        answer = service.call_async(request)
        (result,) = client.wait(lambda: answer.result() if answer.done() else None).results
        return result
    finally:
        client.node.destroy_client(service)


@contextmanager
def changed(client: Any, name: str, value: Any, usual: Any) -> Iterator[None]:
    """Give a parameter of the node another value inside the block."""
    assert set_parameter(client, name, value).successful
    try:
        yield
    finally:
        assert set_parameter(client, name, usual).successful


def slow(client: Any) -> Any:
    """Let the node plan slow motions inside the block."""
    return changed(client, "speed", 0.15, 1.0)


@contextmanager
def seen_by(look: Callable[[], None], rate: float) -> Iterator[None]:
    """Call a camera at a rate [Hz] inside the block, in a thread of its own."""
    over = threading.Event()

    def run() -> None:
        while not over.wait(1.0 / rate):
            look()

    camera = threading.Thread(target=run)
    camera.start()
    try:
        yield
    finally:
        over.set()
        camera.join()


def reached_state(robot: Robot, stand_ins: Any) -> Array:
    """The last state that the controllers wrote, shape (dof,)."""
    time.sleep(0.1)
    _, states = stand_ins.followed()
    return np.array([column[~np.isnan(column)][-1] for column in states.T])


def followed_since(stand_ins: Any, since: int) -> tuple[Array, Array]:
    """Times since a time, shape (N,) [ns], and the states of both controllers then, shape (N, dof)."""
    times, states = stand_ins.followed()
    late = times >= since
    times, states = times[late], states[late]
    found = []
    for column in states.T:
        known = ~np.isnan(column)
        found.append(np.interp(times, times[known], column[known]))
    return times, np.stack(found, axis=1)


def swung(robot: Robot, by: float) -> Array:
    q = robot.home.copy()
    q[0] += by
    return q


def test_goals_of_joints_are_reached_and_told(robot: Robot, stand_ins: Any, client: Any) -> None:
    goal = robot.home + np.where(np.arange(robot.dof) < 7, 0.1, 0.0)
    assert client.go("goal/joints", joints(robot, goal)) == "reached"
    assert np.abs(reached_state(robot, stand_ins) - goal).max() <= ALIKE
    one = JointState(name=[stand_ins_of.PREFIX + "right_joint1"], position=[0.3])  # the others stay
    assert client.go("goal/joints", one) == "reached"
    goal[robot.joint_names.index("right_joint1")] = 0.3
    assert np.abs(reached_state(robot, stand_ins) - goal).max() <= ALIKE
    status = client.wait(lambda: [one for one in client.diagnostics if "reached" in one.message])[-1]
    assert status.name == "apex_ompl: motion" and status.level == bytes([0])
    assert {marker.ns for marker in client.wait(lambda: client.markers)} >= {"path", "goal", "world"}


def test_a_robot_that_others_moved_goes_on_from_there(robot: Robot, stand_ins: Any, client: Any) -> None:
    other, there = stand_ins.driver(), swung(robot, 0.4)
    motion = time_path(np.stack([robot.home, there]), robot.limits, robot.joint_names).trajectory
    other.send(motion, other.time + 0.2)
    client.wait(lambda: np.abs(reached_state(robot, stand_ins) - there).max() <= ALIKE)
    other.close()
    time.sleep(0.3)
    assert np.abs(reached_state(robot, stand_ins) - there).max() <= ALIKE  # the node does not pull it back
    assert (
        client.go("goal/joints", JointState(name=[stand_ins_of.PREFIX + "right_joint1"], position=[0.3])) == "reached"
    )
    there[robot.joint_names.index("right_joint1")] = 0.3
    assert np.abs(reached_state(robot, stand_ins) - there).max() <= ALIKE


def test_goals_as_poses_are_reached_in_their_frames(robot: Robot, stand_ins: Any, client: Any) -> None:
    hand = robot.hands["left_hand"]
    goal = PoseStamped(pose=Pose())
    goal.header.frame_id = "camera"  # 1 m above the world's origin
    goal.pose.position.x, goal.pose.position.y, goal.pose.position.z = 0.5, 0.3, -0.5
    goal.pose.orientation.w = 0.0  # any
    assert client.go("goal/left_hand", goal) == "reached"
    palm = robot.link_pose(reached_state(robot, stand_ins), hand.palm)
    assert np.allclose(palm[:3, :3] @ hand.point + palm[:3, 3], (0.5, 0.3, 0.5), atol=2e-3)
    base = PoseStamped(pose=goal.pose)
    base.header.frame_id = "left_link0"  # a link of the robot
    at = np.linalg.inv(robot.link_pose(robot.home, "left_link0")) @ (0.5, 0.35, 0.5, 1.0)
    base.pose.position.x, base.pose.position.y, base.pose.position.z = at[:3].tolist()
    assert client.go("goal/left_hand", base) == "reached"
    palm = robot.link_pose(reached_state(robot, stand_ins), hand.palm)
    assert np.allclose(palm[:3, :3] @ hand.point + palm[:3, 3], (0.5, 0.35, 0.5), atol=2e-3)
    both = PoseArray(poses=[Pose(), Pose()])
    for pose, y in zip(both.poses, (0.3, -0.3), strict=True):
        pose.position.x, pose.position.y, pose.position.z, pose.orientation.w = 0.5, y, 0.6, 0.0
    assert client.go("goal/poses", both) == "reached"
    q = reached_state(robot, stand_ins)
    for hand, y in zip(robot.hands.values(), (0.3, -0.3), strict=True):
        palm = robot.link_pose(q, hand.palm)
        assert np.allclose(palm[:3, :3] @ hand.point + palm[:3, 3], (0.5, y, 0.6), atol=2e-3)


def test_faulty_goals_are_refused_in_a_sentence(robot: Robot, client: Any) -> None:
    pose = PoseStamped()
    pose.header.frame_id = "kitchen"
    nan, turned = PoseStamped(), PoseStamped()
    nan.pose.position.x = np.nan
    turned.pose.orientation.w = 2.0
    for topic, message, why in (
        ("goal/joints", JointState(name=["elbow"], position=[0.0]), "expected joints of the robot"),
        ("goal/joints", JointState(name=["r_left_joint1"], position=[np.nan]), "expected a finite number"),
        ("goal/joints", JointState(name=["r_left_joint1"] * 2, position=[0.0] * 2), "expected each joint once"),
        ("goal/joints", JointState(name=["r_left_joint1"]), "0 positions"),
        ("goal/left_hand", pose, "frame_id: expected world, a link of dual_panda_softhand, .* got 'kitchen'"),
        ("goal/left_hand", nan, "expected finite numbers"),
        ("goal/left_hand", turned, "expected a unit quaternion"),
        ("goal/poses", PoseArray(poses=[Pose()]), "expected one for each of left_hand, right_hand"),
    ):
        said = client.go(topic, message)
        assert said.startswith("refused: ") and "\n" not in said
        assert re.search(why, said), said
    far = JointState(name=["r_left_joint1"], position=[9.0])
    assert client.go("goal/joints", far).startswith("failed: invalid goal, ")
    assert client.wait(lambda: [one for one in client.diagnostics if one.level == bytes([1])])


def test_motions_keep_clear_of_markers_and_clouds(robot: Robot, stand_ins: Any, client: Any) -> None:
    """The straight way between two states is blocked, by a box that a marker or a cloud shows."""
    first, second = swung(robot, 0.5), swung(robot, -0.5)
    places = CollisionChecker(robot)
    middle = robot.link_pose(robot.home, "left_hand_palm")[:3, 3]
    size = np.array([0.06, 0.06, 0.06])
    box = Obstacle(name="box", box=tuple(size), position=tuple(middle))
    assert places.is_free(first) and not CollisionChecker(robot, [box]).is_free(robot.home)
    assert client.go("goal/joints", joints(robot, first)) == "reached"
    client.publishers["world"].publish(MarkerArray(markers=[client_of.marker_of(1, size, middle, space="my box")]))
    since = time.time_ns()
    time.sleep(0.2)
    assert client.go("goal/joints", joints(robot, second)) == "reached"
    checker = CollisionChecker(robot, [box])
    _, states = followed_since(stand_ins, since)
    assert len(states) > 100 and all(checker.is_free(q) for q in states[::5])
    assert any(marker.ns == "world" and marker.type == 1 for marker in client.wait(lambda: client.markers))
    client.publishers["world"].publish(MarkerArray(markers=[deleted()]))
    corners = middle + (np.random.default_rng(0).random((2000, 3)) - 0.5) * size
    client.publishers["points"].publish(client_of.cloud_of(corners - (0.0, 0.0, 1.0), "camera"))
    since = time.time_ns()
    time.sleep(0.3)
    assert client.go("goal/joints", joints(robot, first)) == "reached"
    _, states = followed_since(stand_ins, since)
    assert len(states) > 100 and all(checker.is_free(q) for q in states[::5])


def test_a_motion_stops_before_what_comes_into_its_way(robot: Robot, stand_ins: Any, client: Any) -> None:
    """An obstacle appears in the second half of the motion, which is planned again from where it stops."""
    first, second = swung(robot, 0.8), swung(robot, -0.8)
    assert client.go("goal/joints", joints(robot, first)) == "reached"
    at = robot.link_pose(swung(robot, -0.5), "left_hand_palm")[:3, 3]
    box = Obstacle(name="box", box=(0.06, 0.06, 0.06), position=tuple(at))
    count, since = len(client.outcomes), time.time_ns()
    with slow(client):  # so that there is time to stop on a busy machine
        client.publishers["goal/joints"].publish(joints(robot, second))
        client.wait(lambda: np.abs(reached_state(robot, stand_ins)[0] - first[0]) > 0.1)
        client.publishers["world"].publish(MarkerArray(markers=[client_of.marker_of(1, box.box, at)]))
        assert client.wait(lambda: client.outcomes[count:]) == ["reached"]
    checker = CollisionChecker(robot, [box])
    assert all(checker.is_free(q) for q in followed_since(stand_ins, since)[1][::5])
    assert np.abs(reached_state(robot, stand_ins) - second).max() <= ALIKE


def test_a_new_goal_replaces_the_one_before(robot: Robot, stand_ins: Any, client: Any) -> None:
    count = len(client.outcomes)
    with slow(client):
        client.publishers["goal/joints"].publish(joints(robot, swung(robot, 0.8)))
        client.wait(lambda: abs(reached_state(robot, stand_ins)[0] - robot.home[0]) > 0.05)
    client.publishers["goal/joints"].publish(joints(robot, swung(robot, -0.3)))
    assert client.wait(lambda: client.outcomes[count + 1 :]) == ["reached"]
    assert client.outcomes[count].startswith("replaced")
    assert np.abs(reached_state(robot, stand_ins) - swung(robot, -0.3)).max() <= ALIKE


class Ball:
    """Stands in a place, until it is told to rise at 0.2 m/s."""

    def __init__(self, place: Array) -> None:
        self.place, self.left = place, np.inf

    def at(self, now: float) -> Array:
        return self.place + (0.0, 0.0, 0.2 * max(0.0, now - self.left))

    def message(self, client: Any, topic: str) -> Any:
        stamp, at = client.node.get_clock().now(), self.at(time.time())
        if topic == "obstacles":
            marker = client_of.marker_of(2, (0.12, 0.12, 0.12), at, space="ball")
            marker.header.stamp = stamp.to_msg()
            return MarkerArray(markers=[marker])
        pose = PoseStamped()
        pose.header.frame_id, pose.header.stamp = "world", stamp.to_msg()
        pose.pose.position.x, pose.pose.position.y, pose.pose.position.z = at.tolist()
        return pose


@pytest.mark.parametrize("topic", ["obstacles", "object/ball"])
def test_the_closed_loop_waits_for_what_moves(robot: Robot, stand_ins: Any, client: Any, topic: str) -> None:
    """A ball that is observed 30 times a second stands in the way, and then leaves."""
    first, second = swung(robot, 0.5), swung(robot, -0.5)
    assert client.go("goal/joints", joints(robot, first)) == "reached"
    ball = Ball(robot.link_pose(robot.home, "left_hand_palm")[:3, 3])

    def look() -> None:
        client.publishers[topic].publish(ball.message(client, topic))

    with changed(client, "closed_loop", "auto", "never"), seen_by(look, 30.0):
        time.sleep(0.3)
        count, since = len(client.outcomes), time.time_ns()
        client.diagnostics.clear()
        client.publishers["goal/joints"].publish(joints(robot, second))
        client.wait(lambda: [one for one in client.diagnostics if one.message == "following the closed loop"])
        assert len(client.outcomes) == count
        ball.left = time.time()
        assert client.wait(lambda: client.outcomes[count:], 30.0) == ["reached"]
    assert np.abs(reached_state(robot, stand_ins) - second).max() <= 1e-3
    times, states = followed_since(stand_ins, since)
    moving = np.abs(np.gradient(states, axis=0)).max(axis=1) > 1e-9
    checker = CollisionChecker(robot, [BALL])
    assert moving.sum() > 50
    for k in np.flatnonzero(moving)[::10]:
        checker.move("ball", ball.at(1e-9 * times[k]).tolist())
        assert checker.is_free(states[k])
    assert {"observed"} <= {marker.ns for marker in client.markers}


def test_the_closed_loop_observes_clouds(robot: Robot, stand_ins: Any, client: Any) -> None:
    """A camera sees a box at the goal, then nothing; meanwhile an obstacle is added far away: the loop starts anew."""
    first, second = swung(robot, 0.5), swung(robot, -0.5)
    assert client.go("goal/joints", joints(robot, first)) == "reached"
    middle, size = robot.link_pose(second, "left_hand_palm")[:3, 3], np.full(3, 0.12)
    seen = middle + (np.random.default_rng(0).random((2000, 3)) - 0.5) * size
    gone = threading.Event()

    def look() -> None:
        cloud = client_of.cloud_of(seen[: 0 if gone.is_set() else None] - (0.0, 0.0, 1.0), "camera")
        cloud.header.stamp = client.node.get_clock().now().to_msg()
        client.publishers["points"].publish(cloud)

    with changed(client, "closed_loop", "always", "never"), seen_by(look, 20.0):
        time.sleep(0.3)
        count, since = len(client.outcomes), time.time_ns()
        client.diagnostics.clear()
        client.publishers["goal/joints"].publish(joints(robot, second))
        client.wait(lambda: [one for one in client.diagnostics if one.message == "following the closed loop"])
        far = client_of.marker_of(1, size, (3.0, 0.0, 0.5), space="far")
        client.publishers["world"].publish(MarkerArray(markers=[far]))
        time.sleep(0.3)
        assert len(client.outcomes) == count
        left = time.time_ns()
        gone.set()
        assert client.wait(lambda: client.outcomes[count:], 30.0) == ["reached"]
    assert np.abs(reached_state(robot, stand_ins) - second).max() <= 1e-3
    checker = CollisionChecker(robot, [Obstacle(name="box", box=tuple(size), position=tuple(middle))])
    times, states = followed_since(stand_ins, since)
    before = states[times < left]
    assert len(before) > 50 and all(checker.is_free(q) for q in before[::20]) and not checker.is_free(states[-1])


def test_a_robot_that_falls_silent_ends_the_motion(robot: Robot, stand_ins: Any, client: Any) -> None:
    assert client.go("goal/joints", joints(robot, swung(robot, -1.0))) == "reached"
    count = len(client.outcomes)
    client.publishers["goal/joints"].publish(joints(robot, swung(robot, 1.0)))
    time.sleep(0.3)  # of a motion of more than a second
    for process in stand_ins.processes:
        process.send_signal(signal.SIGSTOP)
    try:
        (said,) = client.wait(lambda: client.outcomes[count:])
    finally:
        for process in stand_ins.processes:
            process.send_signal(signal.SIGCONT)
    assert said.startswith("aborted: there were no joint states for")
    client.wait(lambda: [one for one in client.diagnostics if one.level == bytes([2])])


def test_parameters_are_checked_when_they_are_set(client: Any, robot: Robot) -> None:
    def told(name: str, value: Any) -> tuple[bool, str]:
        result = set_parameter(client, name, value)
        return result.successful, result.reason

    assert told("speed", 0.7) == (True, "") and told("speed", 1.0)[0]
    for name, value, why in (
        ("speed", 1.5, "range"), ("closed_loop", "sometimes", "unknown use of the closed loop 'sometimes'"),
        ("method", "apx", "did you mean 'apex'"), ("world_frame", "map", "read-only"), ("lead", "soon", "type"),
    ):  # fmt: skip
        done, reason = told(name, value)
        assert not done and why in reason.replace("read only", "read-only"), reason


def test_faulty_parameters_at_the_start_are_one_sentence(robot: Robot) -> None:
    for given, why in (
        (["-p", "speed:=7.0"], "parameter speed"),
        (["-p", "speed:=fast"], "parameter speed"),
        (["-p", "closed_loop:=sometimes"], "unknown use of the closed loop"),
        (["-p", "frames:=['camera=1 2 3']"], "frames: camera: expected x y z"),
        (["-p", "controllers:=['left=elbow']"], "unknown joint or group 'elbow'"),
        (["-p", "tracked:=[cup]"], "unknown obstacle of the problem 'cup'"),
        (["-p", "goal_frames:=[nose]"], "unknown frame of a pose 'nose'"),
        (["-p", "action:=true"], "closed_loop: expected never"),
        (["-p"], "--ros-args: expected arguments of ROS 2"),
    ):
        with pytest.raises(ApexError, match=why) as raised:
            ApexNode(MotionPlanner(robot), None, given)
        assert "\n" not in str(raised.value)
