"""A camera and a robot of your own in the closed loop, by the wall clock: a ball goes up and down before the robot.

Usage: python examples/09_own_robot.py
"""

import time

from apex_ompl import Loop, LoopSettings, Obstacle, load_problem
from apex_ompl.loop import Command


def look(now: float) -> list[Obstacle]:
    """Return what the camera sees."""
    height = 0.6 + 0.5 * abs(0.4 * now % 2.0 - 1.0)  # at 0.2 m/s
    return [Obstacle(name="ball", sphere={"radius": 0.05}, position=(0.5, 0.0, height))]


class Robot:
    """Follows the last command that came in time, to its end at rest."""

    command: Command | None = None

    def state(self, now: float):
        """Return the measured positions of the joints; None before the first command."""
        return self.command and self.command.motion(min(max(now - self.command.at, 0.0), self.command.motion.duration))


with Loop(load_problem("vertical/free/800001"), settings=LoopSettings(error=0.01, fastest=0.3)) as loop:
    robot = Robot()
    while loop.outcome is None:
        now = time.monotonic()
        loop.observe(now, look(now))
        command = loop.step(now, robot.state(now))
        if command is not None and time.monotonic() < command.at:
            robot.command = command
        elif command is not None:
            loop.missed()
        time.sleep(0.002)
    print(loop.outcome, loop.reason, f"{now - loop.events[0].time:.2f} s")
