"""The simulated clock: steps at its period, whatever they take, with work that is charged by counts."""

from __future__ import annotations

from itertools import count

from apex_ompl.loop.cycle import Eyes, Loop, RunRecord
from apex_ompl.loop.late_steps import Decided
from apex_ompl.loop.replanning import AtOnce
from apex_ompl.moving.ready import Ready
from apex_ompl.moving.request import Replanner
from apex_ompl.problems.worlds import World
from apex_ompl.util.process import running


def simulate(world: World, ready: Ready, replanner: Replanner, eyes: Eyes, seed: int) -> RunRecord:
    """Run the loop in a world until the robot stands at a goal, or time is up.

    Args:
        world: What truly happens.
        ready: The robot among what stands still.
        replanner: How motions are planned anew.
        eyes: What observes the world.
        seed: Of random choices.
    """
    loop = Loop(world, ready, AtOnce(ready, replanner), eyes, seed)
    with running(loop.abort):
        for k in count():
            now, before = k * ready.settings.period, Decided.of(loop.executor)
            try:
                loop.advance(now)
                loop.observe(now)
                ended = loop.step(now)
                if ended is not None:
                    return ended
                loop.set_out(now)
            except KeyboardInterrupt:
                loop.interrupt(now, before)
    raise AssertionError("unreachable")
