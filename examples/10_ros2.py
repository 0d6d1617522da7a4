"""A camera of your own in the closed loop over ROS 2: a ball goes up and down before a robot with two controllers.

Usage: python examples/10_ros2.py    (needs the extra "ros2"; beside controllers named left and right)
"""

from apex_ompl import LoopSettings, Obstacle, load_problem, load_robot, run
from apex_ompl.drivers import Ros2Driver
from apex_ompl.loop import Observation

PREFIX = "r_"  # of joints in ROS


class Camera:
    """Sees a ball 30 times a second, which moves at 0.2 m/s."""

    seen = -1.0

    def read(self, now: float) -> Observation | None:
        """Return what it sees, or None where it saw everything before."""
        if now < self.seen + 1.0 / 30.0:
            return None
        self.seen, height = now, 0.6 + 0.5 * abs(0.4 * now % 2.0 - 1.0)
        ball = Obstacle(name="ball", sphere={"radius": 0.05}, position=(0.5, 0.0, height))
        return Observation(now, now, (ball,))


problem = load_problem("vertical/free/800001")
robot = load_robot(problem.robot)
left = [name for name in robot.joint_names if name.startswith("left")]
controllers = {"left": left, "right": [name for name in robot.joint_names if name not in left]}
driver = Ros2Driver(robot, controllers, renamed={name: PREFIX + name for name in robot.joint_names}, started=60.0)
start = dict(zip(robot.joint_names, driver.state().positions.tolist(), strict=True))
problem = problem.model_copy(update={"start": start})  # the robot starts where it is
settings = LoopSettings(error=0.01, fastest=0.3, period=0.025)
result = run(problem, clock="real", sensor=Camera(), driver=driver, settings=settings)
print(result.outcome, result.reason)
driver.close()
