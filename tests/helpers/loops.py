"""Runs of the loop with replanners made by hand, among boxes that cross the straight line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from apex_ompl import problems
from apex_ompl.loop.clocks import simulate
from apex_ompl.loop.control import RunRecord
from apex_ompl.loop.referee import RefereeReport, judge
from apex_ompl.loop.sensor import Sensor, SensorStream
from apex_ompl.moving.compute_costs import ComputeBudget
from apex_ompl.moving.context import Following, RunContext
from apex_ompl.moving.replanner import Answer, Request
from apex_ompl.moving.settings import LoopSettings
from apex_ompl.ompl.setup import PlanningSetup, assemble
from apex_ompl.problems.worlds import DynamicEnvironment, environment_of
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.timing import Timing, Trajectory, time_path
from apex_ompl.timing.spline_method import least_knot_spacing
from apex_ompl.timing.timed_spline import Start, TimedSpline

PROBLEM, BLOCKED = "vertical/free/1", "vertical/free/0"  # the straight line is free, and meets what stands still
Find = Callable[[RunContext, Request], Following | None]
FAR = Obstacle(name="far", box=(0.1, 0.1, 0.1), position=(2.0, 2.0, 1.0), velocity=(0.0, 0.01, 0.0))


class ByHand:
    """A replanner that answers what a function says."""

    def __init__(self, find: Find, seconds: float = 0.03) -> None:
        self.find, self.seconds, self.asked = find, seconds, []

    def prepare(self, context: RunContext) -> None:
        """Nothing is needed."""

    def replan(self, context: RunContext, request: Request, budget: ComputeBudget) -> Answer:
        self.asked.append(request)
        budget.spent += self.seconds
        return Answer(self.find(context, request), "by hand", budget)


@cache
def setup_of(name: str) -> PlanningSetup:
    return assemble(problems.load(name).still, seed=0)


def line(context: RunContext, request: Request) -> Following:
    """The straight line to the goal, whatever is in its way."""
    start, goal = request.following.at(request.join), context.goals[0]
    return Following(line_from(context, start, goal), request.join, to_goal=True)


def line_from(context: RunContext, start: Start, goal: np.ndarray) -> Trajectory:
    if not np.stack(start)[1:].any():
        return time_path(np.stack([start.position, goal]), context.limits, context.names).trajectory
    spline = TimedSpline.along(np.linspace(start.position, goal, 32), 0.8, start, goal)
    for _ in range(20):
        least = least_knot_spacing(spline.control, context.limits)
        if least <= spline.spacing:
            break
        spline = spline.lasting(max(least, 1.05 * spline.spacing))
    return spline.trajectory(context.names)


def context_of(name: str, *, speed: float = 1.0, **parameters: Any) -> RunContext:
    """What a run keeps ready."""
    setup, share = setup_of(name), 1.0 - 1e-6
    limits = Timing(velocity_scale=speed).limits(setup.robot.limits, setup.robot.joint_names)
    kinds = ("velocity", "acceleration", "jerk")
    limits = replace(limits, **{kind: share * getattr(limits, kind) for kind in kinds})
    settings = LoopSettings(**{"timeout": 3.0, "hastens": False, **parameters}).completed(error=0.024, fastest=0.4)
    return RunContext(setup, limits, limits, settings)


def world_of(name: str, *obstacles: Obstacle) -> DynamicEnvironment:
    """A problem's world with obstacles that move."""
    problem = problems.load(name).still
    return environment_of(problem.model_copy(update={"scene": (*problem.scene, *(obstacles or (FAR,)))}))


def go(
    replanner: Any, *obstacles: Obstacle, name: str = PROBLEM, speed: float = 1.0, sensor: Sensor | None = None,
    **parameters: Any,
) -> tuple[RunRecord, RefereeReport]:  # fmt: skip
    """A run, and what the referee says of it."""
    context, world = context_of(name, speed=speed, **parameters), world_of(name, *obstacles)
    stream = SensorStream(sensor or Sensor(), world, context.settings.watched)
    done = simulate(world, context, replanner, stream, seed=0)
    truth = problems.load(name).still
    truth = truth.model_copy(update={"scene": (*truth.scene, *world.script())})
    return done, judge(context.setup.robot, truth, done.trajectory, goals=context.goals)


def boxes(seed: int, fastest: float) -> list[Obstacle]:
    """Boxes that go to where the straight line is, and turn or not, no faster than allowed."""
    rng, setup = np.random.default_rng(seed), setup_of(PROBLEM)
    found = []
    for k in range(3):
        share, edge = rng.random(), rng.uniform(0.05, 0.15)
        q = setup.start + share * (setup.valid_goals[0] - setup.start)
        side = ("left", "right")[int(rng.integers(2))]
        target = setup.robot.link_pose(q, f"{side}_hand_palm")[:3, 3]
        place, time = target + rng.uniform(-0.5, 0.5, 3), 0.0
        rows = [(time, *place)]
        while time < 6.0:
            way = target + rng.uniform(-0.3, 0.3, 3) - place
            lasts = np.linalg.norm(way) / (fastest * rng.uniform(0.3, 1.0))
            lasts, way = (lasts, way) if rng.random() < 0.5 else (0.5 * lasts, 0.5 * way)
            place, time = place + way, time + lasts
            rows.append((time, *place))
        rows = tuple(tuple(map(float, row)) for row in rows)
        found.append(Obstacle(name=f"box_{k}", box=(edge,) * 3, position=rows[0][1:], trajectory=rows))
    return found


def crossing(setup: PlanningSetup) -> Obstacle:
    """A box that comes into the straight line soon after the robot set out."""
    middle = 0.4 * setup.start + 0.6 * setup.valid_goals[0]
    links = ("left_hand_palm", "right_hand_palm")
    moves = [np.linalg.norm(setup.robot.link_pose(setup.start, n)[:3, 3] - setup.robot.link_pose(middle, n)[:3, 3])
             for n in links]  # fmt: skip
    target = setup.robot.link_pose(middle, links[int(np.argmax(moves))])[:3, 3]
    begin = target + (0.0, 0.0, 0.45)
    rows = ((0.0, *begin), (1.0, *target), (9.0, *target))
    rows = tuple(tuple(map(float, row)) for row in rows)
    return Obstacle(name="box", box=(0.1, 0.1, 0.1), position=rows[0][1:], trajectory=rows)
