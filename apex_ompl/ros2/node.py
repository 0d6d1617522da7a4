"""The node: topics in, a goal at a time to its end, and what is told about it."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from apex_ompl.drivers.guard import Guard
from apex_ompl.drivers.ros2 import Ros2Driver
from apex_ompl.errors import ApexError, DriverError, ParameterError
from apex_ompl.goals.pose_goal import PoseGoal
from apex_ompl.planning.planner import MotionPlanner
from apex_ompl.ros2.following import Ended, Follower
from apex_ompl.ros2.frames import Frames
from apex_ompl.ros2.library import ros2
from apex_ompl.ros2.messages import Drawing, joint_goal, pose_target
from apex_ompl.ros2.move_group import MotionPlanService
from apex_ompl.ros2.parameters import Parameters, joints_by_controller
from apex_ompl.ros2.scene import CLOUD, Goal, Inbox, Scene
from apex_ompl.scene.problem import PoseTarget, Problem
from apex_ompl.timing import Trajectory
from apex_ompl.types import Array
from apex_ompl.util.validation import check_name

NAME = "apex_ompl"
STARTED = 60.0  # time to wait for the clock, the controllers and the robot's state [s]
SPUN = 0.05  # longest time between two looks of the executor at whether to end [s]
IDLE = 0.2  # longest time between two looks at the world while there is no goal [s]
TOLD = 1.0  # time between diagnostics [s]
DEPTH = 10  # messages that wait
STATES = 50  # states of a motion whose path is drawn
GREY, RED, BLUE, GREEN = (0.6, 0.6, 0.6, 0.8), (0.9, 0.2, 0.1, 0.8), (0.1, 0.4, 0.9, 1.0), (0.1, 0.7, 0.2, 0.9)
"""Colors of obstacles that stand, observed obstacles, paths, and goals."""
LEVELS = {"failed": 1, "refused": 1, "aborted": 2}
"""Levels of diagnostics by how the last goal ended: 1 warns, 2 is an error."""
Wanted = dict[str, float] | list[PoseTarget]
"""A goal: a state by joint names, or poses."""


class ApexNode:
    """A node of ROS 2 that moves a robot to goals.

    ``run`` returns once :meth:`end` was called. A thread takes messages; all else happens in the thread of ``run``.
    """

    def __init__(self, planner: MotionPlanner, problem: Problem | None = None, arguments: Sequence[str] = ()) -> None:
        """Start the node, and wait for controllers and joint states.

        Args:
            planner: Plans; its world is that of the node.
            problem: Obstacles, held objects and pairs that may touch; its start and goal are left out.
            arguments: Arguments of ROS, such as ``-p speed:=0.3``.

        Raises:
            ApexError: A parameter is faulty, the extra ``ros2`` is not installed, or the robot does not answer.
        """
        self._ros, self._planner, self._closed = ros2(), planner, False
        self._context = self._ros.Context()
        try:
            self._ros.init(args=["--ros-args", *arguments], context=self._context)
        except Exception as error:  # rclpy has a class for each fault
            raise ParameterError("--ros-args", " ".join(arguments), f"arguments of ROS 2; {error}") from error
        try:
            self._node = self._ros.create_node(NAME, context=self._context)
            self._parameters = Parameters(self._ros, self._node)
            self._set_up(problem)
        except BaseException:
            self.close()
            raise

    def _set_up(self, problem: Problem | None) -> None:
        ros, node, planner, settings = self._ros, self._node, self._planner, self._parameters.now
        robot, controllers = planner.robot, joints_by_controller(settings.controllers, planner.robot)
        if problem is not None:
            planner.world.load(problem)
        for name in filter(None, settings.tracked):
            check_name(name, "obstacle of the problem", planner.world.obstacles)
        self._inbox, self._frames = Inbox(), Frames(robot, settings.world_frame, settings.poses())
        tracked = {name: planner.world.obstacles[name] for name in settings.tracked if name}
        self._scene = Scene(planner, self._frames, self._inbox, tracked, self._warn)
        self._goal_frames = tuple(filter(None, settings.goal_frames)) or tuple(robot.hands) or robot.last_links
        held, origin = tuple(planner.world.held.values()), (0.0, 0.0, 0.0)
        targets = [PoseTarget(frame=name, position=origin) for name in self._goal_frames]
        self._tools = PoseGoal(robot, targets, held, robot.home)  # which tells where they are
        self._publish, self._timers, self._doing, self._last = self._publishers(), list[Any](), "starting", Ended("")
        self._goal_points = np.zeros((0, 3))
        self._subscribe([*tracked])
        self._executor = ros.SingleThreadedExecutor(context=self._context)
        self._executor.add_node(node)
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()
        self._wait_for_time()
        renamed = settings.ros_names()
        self._driver = Ros2Driver(
            robot, controllers, renamed=renamed, node=node, started=STARTED, action=settings.action,
            guard=Guard(*4 * (settings.tolerance,)),
        )  # fmt: skip
        self._joints = {renamed.get(name, name): name for name in robot.joint_names}
        self._follower = Follower(self._driver, self._scene, self._inbox, lambda: self._parameters.now, self._tell)
        self._warm_up()
        if ros.GetMotionPlan is not None:
            MotionPlanService(
                ros, node, self._executor, planner, settings=lambda: self._parameters.now,
                state=lambda: self._driver.commanded(self._driver.end)[0], renamed=renamed,
            )  # fmt: skip
        self._timers.append(node.create_timer(TOLD, self._diagnose))

    def _publishers(self) -> dict[str, Any]:
        ros, node = self._ros, self._node
        kept = ros.QoSProfile(depth=1, durability=ros.DurabilityPolicy.TRANSIENT_LOCAL)
        return {
            "markers": node.create_publisher(ros.MarkerArray, "~/markers", kept),
            "outcome": node.create_publisher(ros.String, "~/outcome", DEPTH),
            "diagnostics": node.create_publisher(ros.DiagnosticArray, "/diagnostics", DEPTH),
        }

    def _subscribe(self, tracked: Sequence[str]) -> None:
        ros, node, inbox, sensor = self._ros, self._node, self._inbox, self._ros.qos_profile_sensor_data
        node.create_subscription(ros.JointState, "~/goal/joints", partial(self._take_goal, ()), DEPTH)
        for frame in self._goal_frames:
            node.create_subscription(ros.PoseStamped, f"~/goal/{frame}", partial(self._take_goal, (frame,)), DEPTH)
        poses = partial(self._take_goal, self._goal_frames)
        node.create_subscription(ros.PoseArray, "~/goal/poses", poses, DEPTH)
        node.create_subscription(ros.MarkerArray, "~/world", lambda m: inbox.put(lambda: inbox.world.append(m)), DEPTH)
        node.create_subscription(ros.MarkerArray, "~/obstacles", partial(self._take_seen, ""), sensor)
        node.create_subscription(ros.PointCloud2, "~/points", self._take_cloud, sensor)
        for name in tracked:
            node.create_subscription(ros.PoseStamped, f"~/object/{name}", partial(self._take_seen, name), sensor)
        if ros.TFMessage is not None:
            kept = ros.QoSProfile(depth=100, durability=ros.DurabilityPolicy.TRANSIENT_LOCAL)
            for topic, quality in (("/tf", 100), ("/tf_static", kept)):
                node.create_subscription(ros.TFMessage, topic, lambda m: self._frames.take(m.transforms), quality)

    def _take_goal(self, frames: tuple[str, ...], message: Any) -> None:
        self._inbox.put(lambda: setattr(self._inbox, "goal", Goal(frames, message)))

    def _take_cloud(self, message: Any) -> None:
        received = self._node.get_clock().now().nanoseconds
        self._inbox.put(lambda: self._inbox.add_cloud(received, message))

    def _take_seen(self, name: str, message: Any) -> None:
        received = self._node.get_clock().now().nanoseconds
        self._inbox.put(lambda: self._inbox.seen.append((received, message, name)))

    def _spin(self) -> None:
        while not self._closed:
            self._executor.spin_once(timeout_sec=SPUN)

    def _wait_for_time(self) -> None:
        """Wait for the first time on ``/clock`` where that counts (``use_sim_time``)."""
        end = time.monotonic() + STARTED
        while not self._node.get_clock().now().nanoseconds:
            if time.monotonic() > end:
                raise DriverError(f"no time came on /clock in {STARTED:g} s")
            time.sleep(0.01)

    def _warm_up(self) -> None:
        """Plan once, so that the first goal does not wait for code to be loaded."""
        settings, start = self._parameters.now, self._driver.commanded(self._driver.time)[0]
        self._planner.plan(start, start, timeout=settings.planning_time, name="warm_up")

    def run(self) -> None:
        """Go to goals until the node is to end; a robot that moves then comes to rest."""
        self._tell("waiting for a goal")
        self._draw(None)
        while not self._inbox.ended:
            goal = self._inbox.take_goal()
            if goal is not None:
                self._go(goal)
            elif self._follower.refresh():
                self._draw(None)
            self._inbox.wait(IDLE)

    def end(self) -> None:
        """Let ``run`` return soon; may be called from a signal handler, and from any thread."""
        self._inbox.put(lambda: setattr(self._inbox, "ended", True))

    def close(self) -> None:
        """End the node."""
        if self._closed:
            return
        self._closed = True
        if hasattr(self, "_thread"):  # whose callbacks use the driver
            self._thread.join()
            self._executor.shutdown()
        if hasattr(self, "_driver"):
            self._driver.close()
        if hasattr(self, "_node"):
            self._node.destroy_node()
        self._context.try_shutdown()

    def _go(self, goal: Goal) -> None:
        """Go to a goal, and tell how that ended."""
        try:
            self._follower.synchronize()  # joints that the goal leaves out stay where they are
            self._follower.refresh()
            target = self._target(goal)
            self._draw(target)
            ended = self._follower.follow(target)
        except ApexError as error:
            ended = Ended("refused", str(error))
        self._last = ended
        self._publish["outcome"].publish(self._ros.String(data=ended.text))
        self._tell(f"waiting for a goal; the last one: {ended.text}")
        self._diagnose()

    def _target(self, goal: Goal) -> Wanted:
        """Return a goal as the planner takes it.

        Raises:
            ApexError: It is faulty.
        """
        follower, message = self._follower, goal.message
        if not goal.frames:
            state = follower.driver.commanded(follower.driver.end)[0].tolist()
            return dict(zip(self._planner.robot.joint_names, state, strict=True)) | joint_goal(message, self._joints)
        poses = message.poses if hasattr(message, "poses") else [message.pose]
        if len(poses) != len(goal.frames):
            raise ParameterError("goal", f"{len(poses)} poses", f"one for each of {', '.join(goal.frames)}")
        base = self._frames.pose(message.header.frame_id, follower.state_at(0))
        return [pose_target(pose, frame, base) for pose, frame in zip(poses, goal.frames, strict=True)]

    def _warn(self, text: str) -> None:
        self._node.get_logger().warning(f"refused: {text}", throttle_duration_sec=1.0)

    def _tell(self, text: str) -> None:
        self._doing = text
        self._node.get_logger().info(text)
        if text.startswith("following"):
            self._draw(None)

    def _diagnose(self) -> None:
        """Publish what the node does, and the counts of what went wrong."""
        ros, follower = self._ros, self._follower
        try:
            age, silent = follower.driver.time - follower.driver.state().stamp, ""
        except DriverError as error:
            age, silent = np.inf, str(error)
        values = {
            "last goal": self._last.text, "obstacles": len(self._planner.world.obstacles),
            "observed obstacles": len(self._scene.observed), "points": len(self._scene.cloud),
            "refused messages": self._scene.refused, "late commands": follower.late,
            "age of the state [s]": f"{age:.3f}",
        }  # fmt: skip
        level = 2 if silent else LEVELS.get(self._last.outcome, 0)
        status = ros.DiagnosticStatus(
            level=bytes([level]), name=f"{NAME}: motion", hardware_id=self._planner.robot.name,
            message=silent or self._doing, values=[ros.KeyValue(key=k, value=str(v)) for k, v in values.items()],
        )  # fmt: skip
        message = ros.DiagnosticArray(status=[status])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publish["diagnostics"].publish(message)

    def _draw(self, target: Wanted | None) -> None:
        """Publish the obstacles, the path of the hands and the goal as markers."""
        scene, settings = self._scene, self._parameters.now
        drawing = Drawing(self._ros, settings.world_frame, self._node.get_clock().now().to_msg())
        for name, obstacle in scene.planner.world.obstacles.items():
            if name != CLOUD and name not in scene.observed:
                drawing.add_obstacle("world", obstacle, GREY)
        for _, obstacle in scene.observed.values():
            drawing.add_obstacle("observed", obstacle, RED)
        if len(scene.cloud):
            drawing.add_balls("points", scene.cloud, settings.cell, GREY)
        motion = self._follower.motion
        if motion is not None:
            for path in self._paths(motion):
                drawing.add_line("path", path, 0.005, BLUE)
        if target is not None:
            self._goal_points = self._points_of(target)
        if len(self._goal_points):
            drawing.add_balls("goal", self._goal_points, 0.04, GREEN)
        self._publish["markers"].publish(drawing.message)

    def _paths(self, motion: Trajectory) -> list[Array]:
        """Return the paths of the goal frames along a motion, each of shape (N, 3) [m]."""
        return [*np.array([self._places(q) for q in motion(np.linspace(0.0, motion.duration, STATES))]).swapaxes(0, 1)]

    def _places(self, q: Array) -> Array:
        """Return where the goal frames are at a state, shape (frames, 3) [m]."""
        return np.array([pose[:3, 3] for pose in self._tools.placements(q)])

    def _points_of(self, target: Wanted) -> Array:
        """Return where the goal frames are to be, shape (N, 3) [m]."""
        if isinstance(target, dict):
            return self._places(np.array([target[name] for name in self._planner.robot.joint_names]))
        return np.array([one.position for one in target])
