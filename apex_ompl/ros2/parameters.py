"""The parameters of the node: declared with their ranges, checked as a whole, and changed while the node runs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from apex_ompl.errors import ApexError, ParameterError
from apex_ompl.loop.replan.methods import names as methods
from apex_ompl.moving.settings import LoopSettings
from apex_ompl.robot.model import Robot
from apex_ompl.scene.bodies import pose_matrix
from apex_ompl.types import Array
from apex_ompl.util.validation import check_name, check_number

CLOSED_LOOP = ("auto", "always", "never")
BUDGET = 0.05  # of a replan, or the nearest multiple of the period [s]
POSE_NUMBERS = 7  # position and quaternion xyzw


def _known(default: Any, text: str, low: float | None = None, high: float | None = None, fixed: bool = False) -> Any:
    """Return a parameter with its description, its range, and whether it stays as it is at the start."""
    return field(default=default, metadata={"text": text, "range": (low, high), "fixed": fixed})


@dataclass(frozen=True)
class NodeSettings:
    """Values of the parameters of the node.

    Attributes:
        controllers: The joint trajectory controllers, see :func:`joints_by_controller`.
        renamed: Joints whose names differ in ROS, ``OURS=THEIRS``.
        world_frame: Name of the robot's world in headers.
        frames: Poses of frames in the world, ``NAME=x y z qx qy qz qw``.
        goal_frames: Hands, links or held objects that take goals as poses.
        tracked: Obstacles of the problem whose poses come on topics.
        tolerance: Largest distance of a joint from where it should be [rad].
        action: Whether motions go to the controllers as actions.
        closed_loop: One of ``CLOSED_LOOP``.
        method: Replanner of the closed loop.
        error: Largest error of observed places [m].
        fastest: Largest speed of obstacles [m/s].
        timeout: Time after which the closed loop gives up [s].
        stuck: Time of rest after which the closed loop gives up [s].
        period: Time between two commands of the closed loop [s].
        speed: Share of the velocity limits.
        planning_time: Time for a plan [s].
        lead: Time between a plan and the start of its motion [s].
        cell: Edge of the cells that point clouds are thinned by [m].
        margin: Distance from the robot up to which points are its own [m].
        seed: Seed of random choices.
    """

    controllers: tuple[str, ...] = _known(
        ("joint_trajectory_controller",), "NAME for all joints, or NAME=JOINT,GROUP,... for each", fixed=True
    )
    renamed: tuple[str, ...] = _known(("",), "joints whose names differ in ROS, OURS=THEIRS", fixed=True)
    world_frame: str = _known("world", "name of the robot's world in headers", fixed=True)
    frames: tuple[str, ...] = _known(("",), "poses of frames in the world, NAME=x y z qx qy qz qw", fixed=True)
    goal_frames: tuple[str, ...] = _known(
        ("",), "hands, links or held objects that take goals as poses; the hands by default", fixed=True
    )
    tracked: tuple[str, ...] = _known(("",), "obstacles of the problem whose poses come on ~/object/NAME", fixed=True)
    tolerance: float = _known(0.05, "largest distance of a joint from where it should be [rad]", 1e-4, 3.0, fixed=True)
    action: bool = _known(False, "send motions as FollowJointTrajectory actions, not by topic", fixed=True)
    closed_loop: str = _known("auto", f"use of the closed loop: {', '.join(CLOSED_LOOP)}")
    method: str = _known("apex", "replanner of the closed loop")
    error: float = _known(0.02, "largest error of observed places [m]", 0.0, 0.5)
    fastest: float = _known(0.5, "largest speed of obstacles [m/s]", 0.0, 5.0)
    timeout: float = _known(60.0, "time after which the closed loop gives up [s]", 0.1, 600.0)
    stuck: float = _known(10.0, "time of rest after which the closed loop gives up [s]", 0.1, 600.0)
    period: float = _known(0.025, "time between two commands of the closed loop [s]", 0.005, 0.1)
    speed: float = _known(0.5, "share of the velocity limits", 0.001, 1.0)
    planning_time: float = _known(5.0, "time for a plan [s]", 0.01, 600.0)
    lead: float = _known(0.05, "time between a plan and the start of its motion [s]", 0.005, 10.0)
    cell: float = _known(0.02, "edge of the cells that point clouds are thinned by [m]", 0.001, 0.5)
    margin: float = _known(0.02, "distance from the robot up to which points are its own [m]", 0.0, 0.5)
    seed: int = _known(0, "seed of random choices", 0, 2**31 - 1)

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ApexError: A name is unknown, or a number is out of its range.
        """
        check_name(self.closed_loop, "use of the closed loop", CLOSED_LOOP)
        check_name(self.method, "replanner", methods())
        for one in fields(self):
            low, high = one.metadata["range"]
            if low is not None:
                check_number(getattr(self, one.name), one.name, low, high)
        if self.action and self.closed_loop != "never":
            raise ParameterError("closed_loop", self.closed_loop, "never where motions go as actions")
        self.poses()
        self.ros_names()

    @property
    def loop(self) -> LoopSettings:
        """Settings of the closed loop."""
        return LoopSettings(
            error=self.error, fastest=self.fastest, timeout=self.timeout, stuck=self.stuck, period=self.period,
            budget=self.period * max(1, round(BUDGET / self.period)),
        )  # fmt: skip

    def poses(self) -> dict[str, Array]:
        """Return the poses of frames in the world, shape (4, 4) [m].

        Raises:
            ParameterError: One is not given as NAME and seven numbers.
        """
        return {name: _pose(name, numbers) for name, numbers in _pairs("frames", self.frames)}

    def ros_names(self) -> dict[str, str]:
        """Return the names in ROS of the joints that have others.

        Raises:
            ParameterError: One is not given as OURS=THEIRS.
        """
        return dict(_pairs("renamed", self.renamed))


def joints_by_controller(controllers: Iterable[str], robot: Robot) -> Mapping[str, list[str]] | str:
    """Return the joints of each controller: ``NAME`` alone has all, ``NAME=JOINT,GROUP,...`` those it names.

    Raises:
        ParameterError: There is no controller, or one is named without joints beside others.
        UnknownNameError: A joint or group is unknown.
    """
    given = [one for one in controllers if one]
    if len(given) == 1 and "=" not in given[0]:
        return given[0]
    found = dict[str, list[str]]()
    for name, joints in _pairs("controllers", given):
        found[name] = []
        for one in filter(None, joints.split(",")):
            check_name(one, "joint or group", (*robot.joint_names, *robot.groups))
            group = robot.groups.get(one)
            found[name] += [one] if group is None else [robot.joint_names[k] for k in group]
    if not found:
        raise ParameterError("controllers", "none", "one or more")
    return found


def _pairs(name: str, given: Iterable[str]) -> list[tuple[str, str]]:
    """Return the entries NAME=VALUE of a parameter; empty ones are left out."""
    found = []
    for entry in filter(None, given):
        first, equals, second = (part.strip() for part in entry.partition("="))
        if not (first and equals and second):
            raise ParameterError(name, entry, "NAME=VALUE")
        found.append((first, second))
    return found


def _pose(name: str, numbers: str) -> Array:
    try:
        values = np.array([float(one) for one in numbers.replace(",", " ").split()])
    except ValueError:
        values = np.zeros(0)
    if values.shape != (POSE_NUMBERS,) or not np.isfinite(values).all() or abs(np.linalg.norm(values[3:]) - 1) > 1e-3:
        raise ParameterError(f"frames: {name}", numbers, "x y z qx qy qz qw with a unit quaternion")
    return pose_matrix(values[:3], values[3:])


class Parameters:
    """The parameters of a node by the means of ROS: files, ``--ros-args -p``, services.

    Attributes:
        now: Their values.
    """

    def __init__(self, ros: Any, node: Any) -> None:
        """Declare them.

        Raises:
            ApexError: A value that was given at the start is faulty.
        """
        self._ros, given = ros, dict[str, Any]()
        for one in fields(NodeSettings):
            default = list(one.default) if isinstance(one.default, tuple) else one.default
            try:
                given[one.name] = node.declare_parameter(one.name, default, self._descriptor(one)).value
            except Exception as error:  # rclpy has a class for each fault
                raise ParameterError(f"parameter {one.name}", str(error), one.metadata["text"]) from error
        self.now = _settings(given)
        node.add_on_set_parameters_callback(self._changed)

    def _descriptor(self, one: Any) -> Any:
        found = self._ros.ParameterDescriptor(description=one.metadata["text"], read_only=one.metadata["fixed"])
        low, high = one.metadata["range"]
        if isinstance(one.default, float):
            found.floating_point_range = [self._ros.FloatingPointRange(from_value=low, to_value=high)]
        elif isinstance(one.default, int) and low is not None:
            found.integer_range = [self._ros.IntegerRange(from_value=low, to_value=high)]
        return found

    def _changed(self, changed: Iterable[Any]) -> Any:
        """Take new values, all or none, or say in a sentence why not."""
        known = {one.name for one in fields(NodeSettings)}
        values = {one.name: one.value for one in changed if one.name in known}
        try:
            self.now = _settings({one: getattr(self.now, one) for one in known} | values)
        except ApexError as error:
            return self._ros.SetParametersResult(successful=False, reason=str(error))
        return self._ros.SetParametersResult(successful=True)


def _settings(values: Mapping[str, Any]) -> NodeSettings:
    given: dict[str, Any] = {name: tuple(v) if isinstance(v, (list, tuple)) else v for name, v in values.items()}
    return NodeSettings(**given)
