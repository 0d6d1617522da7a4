"""Rehearsals: the ends of the steps of a task by inverse kinematics, before motions are planned and proved.

A rehearsal goes through steps and later goals from one goal: lines are tracked and checked at states a centimeter
apart, hands are closed, and each further goal is reached by a few descents. What cannot be done that way is found in
milliseconds, and a grasp that no later place pose suits is never planned to. Motions between goals are not considered.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from apex_ompl.constraints.line import ToolPath, are_same
from apex_ompl.constraints.line_ends import dead_end
from apex_ompl.constraints.line_tracking import LineTracker, Track
from apex_ompl.goals.any_goal import AnyGoal
from apex_ompl.goals.goal_sampling import sample
from apex_ompl.ompl.setup import state_fault
from apex_ompl.planning.query import Group
from apex_ompl.planning.steps import assemble, query_fault
from apex_ompl.planning.task_goals import TaskGoal, task_goal
from apex_ompl.planning.task_steps import StepPlanner
from apex_ompl.planning.task_waypoints import StepFailed
from apex_ompl.planning.task_world import TaskWorld
from apex_ompl.scene.problem import AnyStep, MoveStep, Problem
from apex_ompl.scene.steps import BodiesStep, DetachStep, HandedStep, StraightStep, TogetherStep
from apex_ompl.types import Array
from apex_ompl.util.forking import unforked

BREADTH = 4  # goals of a later stage that are tried from one state
MOST_VISITS = 48  # goals that are tried in one rehearsal
UNREACHED = "no free state was found that reaches it"
FALLBACK = 4, 64  # states and descents for a goal that a few descents do not reach


class Stage(NamedTuple):
    """A motion to a goal, and the steps after it up to the next such motion.

    Attributes:
        move: The motion; its goal is that of the problem for the first one.
        steps: The steps.
    """

    move: MoveStep
    steps: tuple[AnyStep, ...]


def stages(problem: Problem) -> list[Stage]:
    """Return the stages of a task."""
    found = [Stage(MoveStep(goal=problem.goal), ())]
    for step in problem.after:
        if isinstance(step, MoveStep):
            found.append(Stage(step, ()))
        else:
            found[-1] = found[-1]._replace(steps=(*found[-1].steps, step))
    return found


class Rehearsal:
    """Goes through the steps of one task without planning motions."""

    def __init__(self, planner: StepPlanner, seed: int, stop: Callable[[], bool], group: Group | None = None) -> None:
        """Rehearse the task of a planner of steps.

        Args:
            planner: The planner; its checker is used.
            seed: Seed of the descents.
            stop: Whether no time is left.
            group: Joints that are planned where a motion names none.
        """
        self.planner, self.stages, self.seed, self.stop = planner, stages(planner.problem), seed, stop
        self._group = group
        self._visits, self._thorough, self._explains = 0, False, True
        self._reasons = dict[int, str]()  # of stages whose goals no state reaches

    def later_goals(self, k: int, world: TaskWorld, q: Array, thorough: bool = False) -> list[Array]:
        """Return goals of the stages after one, all of which can be reached and left by their steps.

        Args:
            k: Number of the stage.
            world: The world at its goal.
            q: Its goal, shape (dof,).
            thorough: Whether lines are led around obstacles and limits, by motions that keep the poses of their frames.

        Raises:
            StepFailed: There are none, as far as was tried.
        """
        self._visits, self._thorough, self._explains = 0, thorough, True
        return self._from(k, world, q)

    def _from(self, k: int, world: TaskWorld, q: Array) -> list[Array]:
        self._visits += 1
        world, q = self.done(self.stages[k].steps, world, q)
        if k + 1 == len(self.stages):
            return []
        move, failures = self.stages[k + 1].move, list[StepFailed]()
        for goal in self._goals(k + 1, world, q):
            if failures and (self._visits >= MOST_VISITS or self.stop()):
                break
            try:
                return [goal, *self._from(k + 1, world, goal)]
            except StepFailed as failure:
                failures.append(failure)
                self._explains = False  # the first failure is the one that is told
        raise failures[0] if failures else self._unreached(k + 1, world, q).of(move.title)

    def _unreached(self, k: int, world: TaskWorld, q: Array) -> StepFailed:
        """Return why no state reaches the goal of a stage, as a plan to it would say; it is looked for once."""
        if k not in self._reasons:
            move, checker = self.stages[k].move, self.planner.checker
            made = task_goal(checker.robot, world, self.planner.problem, move, q, group=self._group)
            self.planner.become(world)
            with unforked():
                setup = assemble(
                    made.problem, checker.robot, seed=self.seed, checker=checker, group=move.group or self._group
                )
            self._reasons[k] = query_fault(setup)[1] or UNREACHED
        return StepFailed(self._reasons[k], UNREACHED)

    def _goals(self, k: int, world: TaskWorld, q: Array) -> Array:
        """Return a few free states that reach the goal of a stage from a state, shape (N, dof)."""
        move = self.stages[k].move
        made = task_goal(self.planner.robot, world, self.planner.problem, move, q, group=self._group)
        self.planner.become(world)
        return reached(self.planner, made, np.random.default_rng([self.seed, k]))

    def done(self, steps: Sequence[AnyStep], world: TaskWorld, q: Array) -> tuple[TaskWorld, Array]:
        """Return the world and the state after steps, shape (dof,).

        Raises:
            StepFailed: One cannot be done; the message names it.
        """
        for step in steps:
            try:
                world, q = self._step(step, world, q)
            except StepFailed as failure:
                raise failure.of(step.title) from None
        return world, q

    def _step(self, step: AnyStep, world: TaskWorld, q: Array) -> tuple[TaskWorld, Array]:
        if isinstance(step, StraightStep):
            end = self._tracked(step, world, q)
            return world.after(step, end), end
        if isinstance(step, HandedStep):
            during = world.during(step, q)
            end = self.planner.hand_end(during, step, q)
            self.planner.proved(during, end[None])
            return world.after(step, end), end
        if isinstance(step, BodiesStep):
            after = world.after(step, q)
            self.planner.proved(world if isinstance(step, DetachStep) else after, q[None])
            return after, q
        if isinstance(step, TogetherStep):
            hands = [one for one in step.steps if isinstance(one, HandedStep)]
            if len(hands) == len(step.steps):  # proved at once
                ends = [self.planner.hand_end(world.during(one, q), one, q) for one in hands]
            else:
                ends = [self._step(one, world, q)[1] for one in step.steps]
            end = q + sum((one - q for one in ends), np.zeros(len(q)))
            if len(hands) == len(step.steps):
                self.planner.proved(world.during(step, q), end[None])
            return world.after(step, end), end
        return world.after(step, q), q

    def _tracked(self, step: StraightStep, world: TaskWorld, q: Array) -> Array:
        """Return the last state of straight lines, shape (dof,)."""
        query = self.planner.line_query(world, step, q, None)
        if are_same(query.poses):
            return q
        tracker = LineTracker(self.planner.checker, query.tools, ToolPath.through(query.poses, query.blend), self.stop)
        track = tracker.tracked(Track(tracker.grid[:1], q[None]))
        track = track.upto(tracker.free_count(track))
        if len(track.u) < len(tracker.grid) and self._thorough:
            track = tracker.follow(q)
        if len(track.u) < len(tracker.grid):
            if not self._explains:
                raise StepFailed("not tracked")
            end = dead_end(tracker, track)
            raise StepFailed(end.reason, " ".join((f"{end.end}", *end.names)))
        last: Array = track.states[-1]
        return last


def reached(planner: StepPlanner, made: TaskGoal, rng: np.random.Generator, count: int = BREADTH) -> Array:
    """Return free states of a goal, the nearest of each alternative in turn, shape (N, dof)."""
    checker = planner.checker
    if made.goal is None:
        inside = [q for q in made.states if not state_fault(checker, q)]
        return np.array(inside).reshape(-1, checker.robot.dof)
    goal = made.goal if isinstance(made.goal, AnyGoal) else AnyGoal(made.robot, [made.goal], made.states, made.start)
    checker.prepare()
    states = made.held_at_start(goal.nearest_states(checker, rng, count))
    if len(states):
        return states
    return made.held_at_start(sample(made.goal, checker, rng, *FALLBACK).states)
