"""A camera of your own in the closed loop over ROS 2: a ball goes up and down before a robot with two controllers.

Usage: python examples/10_ros2.py    (needs the extra "ros2"; beside controllers named left and right)
"""

import time

from apex_ompl import ApexError, Loop, LoopSettings, Obstacle, load_problem, load_robot
from apex_ompl.drivers import Ros2Driver

PREFIX = "r_"  # of joints in ROS


class Camera:
    """Sees a ball 30 times a second."""

    seen = -1.0

    def look(self, now: float) -> list[Obstacle] | None:
        """Return what it sees, or None where it saw everything before."""
        if now < self.seen + 1.0 / 30.0:
            return None
        self.seen, height = now, 0.6 + 0.5 * abs(0.4 * now % 2.0 - 1.0)  # at 0.2 m/s
        return [Obstacle(name="ball", sphere={"radius": 0.05}, position=(0.5, 0.0, height))]


problem, camera = load_problem("vertical/free/800001"), Camera()
robot = load_robot(problem.robot)
left = [name for name in robot.joint_names if name.startswith("left")]
controllers = {"left": left, "right": [name for name in robot.joint_names if name not in left]}
driver = Ros2Driver(robot, controllers, renamed={name: PREFIX + name for name in robot.joint_names}, started=60.0)
start = dict(zip(robot.joint_names, driver.state().positions.tolist(), strict=True))
problem = problem.model_copy(update={"start": start})  # the robot starts where it is
with Loop(problem, settings=LoopSettings(error=0.01, fastest=0.3, period=0.025)) as loop:
    while loop.outcome is None:
        now, state = driver.time, driver.state()
        if driver.fault:
            loop.abort(driver.fault)
        if (seen := camera.look(now)) is not None:
            loop.observe(now, seen)
        command = loop.step(now, state.positions + (now - state.stamp) * state.velocities)
        if command is not None and not (command.rests and driver.end <= command.at):
            try:
                driver.send(command.motion, command.at)
            except ApexError:  # its time is over
                loop.missed()
        time.sleep(0.001)
    print(loop.outcome, loop.reason)
driver.close()
