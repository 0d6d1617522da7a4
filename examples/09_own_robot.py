"""A camera and a robot of your own in the closed loop, by the wall clock: a ball goes up and down before the robot."""

import time

from apex_ompl import ApexError, LoopSettings, Obstacle, Trajectory, load_problem, load_robot, run
from apex_ompl.drivers import DriverState
from apex_ompl.loop import Observation


class Camera:
    """Sees a ball that moves at 0.2 m/s."""

    def read(self, now: float) -> Observation:
        """Return what it sees, once in each period; None where there is nothing new."""
        ball = Obstacle(name="ball", sphere={"radius": 0.05}, position=(0.5, 0, 0.6 + 0.5 * abs(0.4 * now % 2 - 1)))
        return Observation(now, now, (ball,), errors={"ball": 0.01})


class Robot:
    """Follows each motion from its time on, to its end at rest."""

    time, fault = property(lambda self: time.monotonic()), ""  # why it stopped
    end = property(lambda self: self.sent[-1][0] + self.sent[-1][1].duration)  # of the last motion

    def __init__(self, problem):
        """Rest at the start."""
        model = load_robot(problem.robot)
        q = problem.start_state(model.joint_names)
        self.names, self.limits = model.joint_names, model.limits
        self.sent = [(0.0, Trajectory([0], [q], [0 * q], [0 * q], self.names))]

    def state(self) -> DriverState:
        """Return the measured state: here it is where it should be."""
        now = self.time
        at, motion = next((at, motion) for at, motion in self.sent[::-1] if at <= now)
        return DriverState(now, motion(now - at), motion(now - at, 1))

    def send(self, motion, at: float) -> None:
        """Take a motion in place of what would be done from a time on."""
        if at < self.time:
            raise ApexError("the motion comes too late")
        self.sent.append((at, motion))


problem, settings = load_problem("vertical/free/800001"), LoopSettings(error=0.01, fastest=0.3, period=0.025)
print(run(problem, clock="real", sensor=Camera(), driver=Robot(problem), settings=settings))
