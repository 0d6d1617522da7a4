"""The motion plan service of MoveIt's move_group, where ``moveit_msgs`` is installed."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from apex_ompl.drivers.controllers import Controllers
from apex_ompl.errors import ApexError, FileFormatError, UnknownNameError
from apex_ompl.planning.planner import MotionPlanner
from apex_ompl.result import PlanResult, PlanStatus
from apex_ompl.robot.moveit import converted
from apex_ompl.ros2.parameters import NodeSettings
from apex_ompl.timing import Timing, Trajectory
from apex_ompl.timing.files import NANOSECONDS
from apex_ompl.types import Array

SERVICE = "/plan_kinematic_path"
CODES = {
    PlanStatus.EXACT_SOLUTION: "SUCCESS", PlanStatus.TIMEOUT: "TIMED_OUT",
    PlanStatus.INVALID_START: "START_STATE_INVALID", PlanStatus.INVALID_GOAL: "GOAL_STATE_INVALID",
}  # fmt: skip
"""Names of ``moveit_msgs/MoveItErrorCodes`` by status; others are PLANNING_FAILED."""


def plain(message: Any) -> Any:
    """Return a message as mappings, lists, texts and numbers."""
    if hasattr(message, "get_fields_and_field_types"):
        return {name: plain(getattr(message, name)) for name in message.get_fields_and_field_types()}
    if isinstance(message, bytes):
        return list(message)
    if hasattr(message, "tolist"):  # of arrays of numbers
        return message.tolist()
    return [plain(one) for one in message] if isinstance(message, (list, tuple)) else message


class MotionPlanService:
    """Answers ``moveit_msgs/srv/GetMotionPlan`` by plans in the node's world, each in a thread of its own."""

    def __init__(
        self, ros: Any, node: Any, executor: Any, planner: MotionPlanner, *, settings: Callable[[], NodeSettings],
        state: Callable[[], Array], renamed: Mapping[str, str],
    ) -> None:  # fmt: skip
        """Offer the service.

        Args:
            ros: The client library and messages.
            node: The node.
            executor: Its executor.
            planner: Plans; its world is that of the node.
            settings: Returns the values of the parameters.
            state: Returns the state of the robot, which counts where a request gives none, shape (dof,).
            renamed: Names of joints in ROS where they are others, by ours.
        """
        self._ros, self._executor, self._planner = ros, executor, planner
        self._settings, self._state, self._renamed = settings, state, dict(renamed)
        self._codes = type(ros.GetMotionPlan.Response().motion_plan_response.error_code)
        node.create_service(ros.GetMotionPlan, SERVICE, self._answer)

    async def _answer(self, request: Any, response: Any) -> Any:
        future = self._ros.Future(executor=self._executor)

        def work() -> None:
            try:
                self._plan(request.motion_plan_request, response.motion_plan_response)
            except Exception as error:  # the node lives on
                self._fail(response.motion_plan_response, "CRASH", f"{type(error).__name__}: {error}")
            future.set_result(response)

        threading.Thread(target=work, daemon=True).start()
        return await future

    def _fail(self, answer: Any, code: str, why: str) -> None:
        answer.error_code.val = getattr(self._codes, code)
        if hasattr(answer.error_code, "message"):
            answer.error_code.message = why

    def _plan(self, request: Any, answer: Any) -> None:
        """Plan, and write the motion or why there is none."""
        answer.group_name = request.group_name
        try:
            result = self._result(request)
        except UnknownNameError as error:
            code = "INVALID_GROUP_NAME" if error.kind == "group or joint" else "INVALID_GOAL_CONSTRAINTS"
            self._fail(answer, code, str(error))
            return
        except FileFormatError as error:
            starts = error.field.startswith("start_state")
            self._fail(answer, "INVALID_ROBOT_STATE" if starts else "INVALID_GOAL_CONSTRAINTS", str(error))
            return
        except ApexError as error:
            self._fail(answer, "PLANNING_FAILED", str(error))
            return
        answer.planning_time = float(result.times.get("total", 0.0))
        if not result or result.trajectory is None:
            self._fail(answer, CODES.get(result.status, "PLANNING_FAILED"), result.reason)
            return
        answer.error_code.val = self._codes.SUCCESS
        self._write(result.trajectory, request.group_name, answer)

    def _result(self, request: Any) -> PlanResult:
        robot, settings = self._planner.robot, self._settings()
        data = plain(request)
        names = [self._renamed.get(name, name) for name in robot.joint_names]
        given = data["start_state"]["joint_state"]
        start = dict(zip(names, self._state().tolist(), strict=True))
        start |= dict(zip(given["name"], given["position"], strict=False))
        data["start_state"]["joint_state"] = {"name": [*start], "position": [*start.values()]}
        if data["start_state"]["attached_collision_objects"]:
            expected = "expected none: held objects are those of the node"
            raise FileFormatError("request", "start_state.attached_collision_objects", "some", expected)
        theirs = {name: ours for ours, name in self._renamed.items()}
        problem = converted({}, data, robot, theirs, {settings.world_frame: "world"}).problem
        timing = Timing(
            velocity_scale=_share(request.max_velocity_scaling_factor) * settings.speed,
            acceleration_scale=_share(request.max_acceleration_scaling_factor),
        )
        return self._planner.plan(
            problem.start, problem.goal, timeout=request.allowed_planning_time or settings.planning_time,
            seed=settings.seed, timing=timing, group=request.group_name or None, constraints=problem.constraints,
            name="request",
        )  # fmt: skip

    def _write(self, motion: Trajectory, group: str, answer: Any) -> None:
        """Write a motion, of a group where one is given, and the state at its start."""
        robot = self._planner.robot
        (part,) = Controllers(motion.joint_names, "all", self._renamed).parts(motion)
        joints = robot.groups.get(group, np.arange(robot.dof))
        start, trajectory = answer.trajectory_start.joint_state, answer.trajectory.joint_trajectory
        start.name, start.position = part.joints, part.points[0][1]
        trajectory.joint_names = [part.joints[k] for k in joints]
        for tick, *rows in part.points:
            q, v, a = ([row[k] for k in joints] for row in rows)
            point = self._ros.JointTrajectoryPoint(positions=q, velocities=v, accelerations=a)
            point.time_from_start.sec, point.time_from_start.nanosec = divmod(tick, NANOSECONDS)
            trajectory.points.append(point)


def _share(factor: float) -> float:
    """Return a scaling factor of MoveIt, which is 1 where none is given."""
    return factor if 0.0 < factor <= 1.0 else 1.0
