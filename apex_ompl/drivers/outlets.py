"""Ways of a trajectory to a controller of ROS 2: its topic, or its action."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any

from apex_ompl.errors import MissingFileError
from apex_ompl.util.forking import unforked

DEPTH = 10  # messages that wait
ABORTED = 6  # status of a goal, as in action_msgs/GoalStatus
CODES = {-1: "invalid goal", -2: "invalid joints", -3: "old stamp", -4: "path tolerance", -5: "goal tolerance"}
"""Error codes of ``control_msgs/action/FollowJointTrajectory``."""


class TopicOutlet:
    """The topic ``/NAME/joint_trajectory`` of a controller."""

    def __init__(self, node: Any, kind: Any, name: str) -> None:
        """Publish messages of a kind."""
        self.place, self._node = f"/{name}/joint_trajectory", node
        self._publisher = node.create_publisher(kind, self.place, DEPTH)

    @property
    def heard(self) -> bool:
        """Whether the controller listens."""
        return bool(self._publisher.get_subscription_count() > 0)

    def send(self, message: Any) -> None:
        """Send a trajectory."""
        self._publisher.publish(message)

    def close(self) -> None:
        """End it."""
        self._node.destroy_publisher(self._publisher)


class ActionOutlet:
    """The action ``/NAME/follow_joint_trajectory`` of a controller, of which each goal replaces the one before."""

    def __init__(self, node: Any, name: str, fault: Callable[[str], None]) -> None:
        """Send goals, and tell why the last one failed.

        Raises:
            MissingFileError: ``control_msgs`` is not installed.
        """
        try:
            with unforked():
                self._kind = import_module("control_msgs.action").FollowJointTrajectory
        except ImportError as error:
            why = "it has no wheel; source a ROS 2 that has it"
            raise MissingFileError("control_msgs", "package for actions", why) from error
        self.place, self._fault, self._last = f"/{name}/follow_joint_trajectory", fault, 0
        self._client = import_module("rclpy.action").ActionClient(node, self._kind, self.place)

    @property
    def heard(self) -> bool:
        """Whether the controller offers the action."""
        return bool(self._client.server_is_ready())

    def send(self, message: Any) -> None:
        """Send a trajectory as a goal."""
        self._last += 1
        number = self._last
        sent = self._client.send_goal_async(self._kind.Goal(trajectory=message))
        sent.add_done_callback(lambda future: self._answered(number, future.result()))

    def _answered(self, number: int, goal: Any) -> None:
        if goal.accepted:
            goal.get_result_async().add_done_callback(lambda future: self._ended(number, future.result()))
        elif number == self._last:
            self._fault(f"{self.place} rejected a motion")

    def _ended(self, number: int, answer: Any) -> None:
        if number == self._last and answer.status == ABORTED:
            code = answer.result.error_code
            why = ", ".join(filter(None, (CODES.get(code, f"code {code}"), answer.result.error_string)))
            self._fault(f"{self.place} aborted a motion: {why}")

    def close(self) -> None:
        """End it."""
        self._client.destroy()
