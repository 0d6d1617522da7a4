"""A robot that follows the commands of the loop by steps, and the referee's report on what it did."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from loops import PROBLEM, setup_of

from apex_ompl import LoopSettings, problems
from apex_ompl.loop import Command
from apex_ompl.loop.referee import RefereeReport, judge
from apex_ompl.problems.worlds import DynamicEnvironment
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.timing import Trajectory
from apex_ompl.timing.rests import is_at_rest
from apex_ompl.timing.trajectory import joined
from apex_ompl.types import Array

SETTINGS = LoopSettings(error=0.024, fastest=0.4, timeout=6.0)
ZERO = 1000.0  # the caller's clock starts somewhere


@dataclass
class Robot:
    """Follows the commands that it is sent, and remembers what it did."""

    q: Array
    names: tuple[str, ...]
    commands: list[Command] = field(default_factory=list)

    def send(self, command: Command) -> None:
        if self.commands:
            jump = np.abs(self.state(command.at) - command.motion.positions[0]).max()
            assert jump < 1e-9, "the motion begins where the robot will be"
        assert is_at_rest(command.motion, command.motion.duration), "a robot that hears no more comes to rest"
        self.commands.append(command)

    def state(self, time: float) -> Array:
        known = [one for one in self.commands if one.at <= time + 1e-9]
        return self.q if not known else known[-1].motion(min(time - known[-1].at, known[-1].motion.duration))

    def done(self) -> Trajectory:
        """The motion from the first command on, to the end of the last one."""
        pieces = []
        for one, after in zip(self.commands, [*self.commands[1:], None], strict=True):
            until = one.motion.duration if after is None else after.at - one.at
            times = one.motion.times
            last = min(until, one.motion.duration)
            at = np.append(times[times < last - 1e-9], last)
            moving = Trajectory(at, *one.motion.states(at), self.names)
            if until > last + 1e-9:
                q, still = np.repeat(moving.positions[-1:], 2, axis=0), np.zeros((2, len(self.q)))
                rests = Trajectory(np.array([0.0, until - last]), q, still, still, self.names)
                moving = joined([moving, rests]) if last > 1e-9 else rests
            pieces.append(moving)
        return joined(pieces)


def judged(world: DynamicEnvironment, robot: Robot) -> RefereeReport:
    setup, problem = setup_of(PROBLEM), problems.load(PROBLEM).still
    moving = tuple(later(o, robot.commands[0].at - ZERO) for o in world.script())
    truth = problem.model_copy(update={"scene": (*problem.scene, *moving)})
    return judge(setup.robot, truth, robot.done(), goals=setup.valid_goals)


def later(o: Obstacle, shift: float) -> Obstacle:
    """An obstacle whose script starts when the robot gets its first command."""
    assert o.trajectory is not None
    rows = [(t - shift, *place) for t, *place in o.trajectory]
    early = [row for row in rows if row[0] < 0.0][-1:]
    late = [row for row in rows if row[0] >= 0.0]
    if early and late:
        share = -early[0][0] / (late[0][0] - early[0][0])
        late.insert(0, (0.0, *(a + share * (b - a) for a, b in zip(early[0][1:], late[0][1:], strict=True))))
    return o.model_copy(update={"trajectory": tuple(late or [(0.0, *early[0][1:])]), "position": tuple(late[0][1:])})
