"""One step of a task after another: straight lines, hands that open and close, retreats and rests, each proved."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from math import isnan, nan

import numpy as np
import pinocchio as pin

from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.path_proof import PathProof
from apex_ompl.constraints.line import SAME_POINT
from apex_ompl.constraints.line_ends import LineEnd
from apex_ompl.errors import SceneError, TimingError
from apex_ompl.goals.grasp import grasp
from apex_ompl.ompl.validity import full_check
from apex_ompl.paths.path import Path, abreast
from apex_ompl.planning.line_query import LineQuery, line_query
from apex_ompl.planning.lines import plan_along
from apex_ompl.planning.task_constraints import StepConstraints
from apex_ompl.planning.task_departures import Departures
from apex_ompl.planning.task_waypoints import LATE, StepFailed, check_near, held_pose, waypoints
from apex_ompl.planning.task_world import TaskWorld
from apex_ompl.robot import Robot
from apex_ompl.scene.problem import AnyStep, MoveStep, Problem
from apex_ompl.scene.steps import (
    BodiesStep,
    DetachStep,
    GraspStep,
    HandedStep,
    LineStep,
    RetreatStep,
    StraightStep,
    TogetherStep,
    TurnStep,
    WaitStep,
)
from apex_ompl.timing import Timing, Trajectory, time_path
from apex_ompl.timing.combination import superposed
from apex_ompl.timing.trajectory import ROUNDING
from apex_ompl.types import Array
from apex_ompl.util.arrays import length
from apex_ompl.util.clocks import Deadline

BLEND = 0.4  # of the way between two poses of a turn
HAND_ROOM = 1e-4  # to the limits of a synergy, which motions at another rate need at rests


@dataclass(frozen=True, eq=False)
class StepPlan:
    """A step that was planned and proved.

    Attributes:
        step: The step.
        world: The world during it.
        after: The world after it.
        path: Its path.
        motion: Its timed motion from rest to rest, or None where it is not timed.
        clearance: Least distance of a checked pair along the motion, or else along the path [m].
        left: Time from which on, or state of the path from which on, hands touch nothing any more of what they
            released; NaN where they are not leaving anything.
        use: Largest share of each limit that the motion uses.
        deviation: Largest distance of the motion from the path [rad].
        parted: Hands that have left what they released when it starts.
    """

    step: AnyStep
    world: TaskWorld
    after: TaskWorld
    path: Path
    motion: Trajectory | None
    clearance: float
    left: float = nan
    use: Mapping[str, float] = field(default_factory=dict)
    deviation: float = 0.0
    parted: frozenset[str] = frozenset()

    @property
    def end(self) -> Array:
        """The last state, shape (dof,)."""
        last: Array = self.path.states[-1] if self.motion is None else self.motion.positions[-1]
        return last


class StepPlanner:
    """Plans steps of one problem with a checker of its own.

    Attributes:
        checker: The checker; each step changes its scene.
        problem: The problem.
        deadline: When what is planned is to be ready.
        departures: What hands may still touch of what they released.
    """

    def __init__(
        self, checker: CollisionChecker, problem: Problem, deadline: Deadline, pressed: Callable[[], bool]
    ) -> None:
        """Plan by ``checker`` until a deadline, or until ``pressed`` holds."""
        self.checker, self.problem = checker, problem
        self._constraints = StepConstraints(checker.robot, problem)
        self.deadline, self._pressed = deadline, pressed
        self.departures = Departures(self)

    def ends(self) -> bool:
        """Whether no time is left."""
        return self._pressed() or self.deadline.expired

    @property
    def robot(self) -> Robot:
        """The robot."""
        return self.checker.robot

    def follow(
        self, steps: Sequence[AnyStep], world: TaskWorld, q: Array, timing: Timing | None, deadline: Deadline
    ) -> list[StepPlan]:
        """Return the plans of steps, which are no motions to further goals, one after the other.

        Args:
            steps: The steps.
            world: The world before them.
            q: The state before them, shape (dof,).
            timing: How they are timed, or None for paths alone.
            deadline: When they are to be ready.

        Raises:
            StepFailed: One cannot be done; the message names it.
        """
        self.deadline, found = deadline, list[StepPlan]()
        for step in steps:
            try:
                found.append(self._constrained(self.plan(world, step, q, timing)))
            except StepFailed as failure:
                raise failure.of(step.title) from None
            world, q = found[-1].after, found[-1].end
        return found

    def _constrained(self, plan: StepPlan) -> StepPlan:
        """Return a step with the proof that the constraints hold along it.

        Raises:
            StepFailed: They do not.
        """
        kept = self._constraints.proved(plan.step, plan.world, plan.path.states, plan.motion)
        if kept is not None and not kept:
            raise StepFailed(kept.fault, kept.fault.split(",")[0])
        return plan

    def plan(self, world: TaskWorld, step: AnyStep, q: Array, timing: Timing | None) -> StepPlan:
        """Return a step from a state, shape (dof,).

        Raises:
            StepFailed: It cannot be done.
        """
        if isinstance(step, WaitStep):
            return self._wait(world, step, q, timing)
        if isinstance(step, RetreatStep):
            return self._retreat(world, step, q, timing)
        if isinstance(step, LineStep | TurnStep):
            return self.departures.kept(world, self._line(self.departures.parted(world, step, q), step, q, timing))
        if isinstance(step, TogetherStep):
            return self._together(world, step, q, timing)
        if isinstance(step, BodiesStep):
            during = world if isinstance(step, DetachStep) else world.after(step, q)
            return self._proved(StepPlan(step, during, world.after(step, q), Path(q[None]), None, nan), timing)
        assert not isinstance(step, MoveStep)
        return self._hand(world, step, q, timing)

    def become(self, world: TaskWorld, pairs: frozenset[tuple[str, str]] | None = None) -> None:
        """Put the bodies of a world into the checker, with other pairs that may touch if they are given."""
        self.checker.become(world.scene, world.held, world.pairs if pairs is None else pairs)

    def proved(self, world: TaskWorld, motion: Array | Trajectory) -> PathProof:
        """Return the proof of a path, shape (N, dof), or a motion in a world.

        Raises:
            StepFailed: It is not free, or not proved in time.
        """
        self.become(world)
        check = full_check(self.checker, motion, deadline=self.deadline.at)
        if check and check.proof is not None:
            return check.proof
        if check.timed_out:
            raise StepFailed(LATE)
        contacts = [] if check.proof is None else self.checker.contacts(check.proof.state)
        raise StepFailed(check.reason, f"collision {contacts[0].first} {contacts[0].second}" if contacts else "")

    def line_query(self, world: TaskWorld, step: StraightStep, q: Array, timing: Timing | None) -> LineQuery:
        """Return what a step along straight lines is about; the checker has the bodies of its world then.

        Raises:
            StepFailed: A held object is nearer to another body than the gap of the line.
        """
        poses = waypoints(world, step, q)
        self.become(world)
        return line_query(
            self.checker, q, list(poses), frame=None, blend=_blend(poses), speed=step.speed,
            timing=False if timing is None else timing_in(world, timing), problem=lambda goals: self.problem,
        )  # fmt: skip

    def _line(self, world: TaskWorld, step: StraightStep, q: Array, timing: Timing | None) -> StepPlan:
        """Return straight lines from poses of frames to poses, with blends between them."""
        query = self.line_query(world, step, q, timing)
        found = plan_along(self.checker, query, self.deadline, self.ends)
        if not found or found.path is None:
            cause = "" if found.end is LineEnd.REACHED else " ".join((f"{found.end}", *found.blocked_by))
            raise StepFailed(found.reason, cause)
        path = found.path
        if not np.array_equal(path.states[0], q):
            raise StepFailed("the line does not start in the state before it")
        clearance = found.clearance if found.trajectory is None else found.motion_clearance
        if np.isnan(clearance):  # the frames are there already
            clearance = self.checker.clearance(q)
        return StepPlan(
            step, world, world.after(step, path.states[-1]), path, found.trajectory, clearance, use=found.limit_use,
            deviation=0.0 if found.trajectory is None else found.deviation,
        )  # fmt: skip

    def _hand(
        self, world: TaskWorld, step: HandedStep, q: Array, timing: Timing | None, *, proves: bool = True
    ) -> StepPlan:  # fmt: skip
        """Return a hand that opens or closes, with its proof or without."""
        before, world = world, self.departures.parted(world, step, q)
        during = world.during(step, q)
        end = self.hand_end(during, step, q)
        states = np.stack([q, end]) if (end != q).any() else q[None]
        plan = StepPlan(step, during, world.after(step, end), Path(states), None, nan)
        if proves:
            plan = self._proved(plan, timing)
        elif timing is not None:
            plan = self._timed(plan, timing, proves=False)
        return self.departures.kept(before, plan)

    def hand_end(self, during: TaskWorld, step: HandedStep, q: Array) -> Array:
        """Return the state after a hand has opened or closed, shape (dof,).

        Raises:
            StepFailed: The open hand is in contact with what it is to hold, or far away from it.
        """
        if isinstance(step, GraspStep):
            check_near(self.checker, during, step, q)
        synergy, to, end = self.robot.hands[step.hand].synergy, step.to, q.copy()
        if isinstance(step, GraspStep) and to is None and synergy is not None:
            to = self._closed(during, step, q)
        if synergy is not None and to is not None:
            k, limits = self.robot.joint_names.index(synergy), self.robot.limits
            wanted = float(np.clip(to, limits.lower[k] + HAND_ROOM, limits.upper[k] - HAND_ROOM))
            end[k] = q[k] if abs(wanted - q[k]) <= HAND_ROOM else wanted
        return end

    def _proved(self, plan: StepPlan, timing: Timing | None) -> StepPlan:
        """Return a step with its clearance and its motion.

        Raises:
            StepFailed: It is not free, or not timed in time.
        """
        plan = replace(plan, clearance=self.proved(plan.world, plan.path.states).clearance)
        return plan if timing is None else self._timed(plan, timing)

    def _together(self, world: TaskWorld, step: TogetherStep, q: Array, timing: Timing | None) -> StepPlan:
        """Return steps that start at once, each planned while the others rest, and proved together."""
        hands = [one for one in step.steps if isinstance(one, HandedStep)]
        if len(hands) == len(step.steps):
            plans = [self._hand(world, one, q, timing, proves=False) for one in hands]
        else:
            plans = [self.plan(world, one, q, timing) for one in step.steps]
        columns = [set(np.flatnonzero((plan.path.states != q).any(axis=0)).tolist()) for plan in plans]
        shared = [k for k in range(len(q)) if sum(k in moved for moved in columns) > 1]
        if shared:
            raise StepFailed(f"two of them move {self.robot.joint_names[shared[0]]}")
        end = q + sum((plan.end - q for plan in plans), np.zeros(len(q)))
        parted = frozenset[str]().union(*(plan.parted for plan in plans))
        gone = {hand for plan in plans for hand in plan.world.leaving.keys() - plan.after.leaving.keys()}
        during, after = world.during(step, q).left(parted), world.after(step, end).left(parted | gone)
        motions = [plan.motion for plan in plans if plan.motion is not None]
        motion = superposed([(one, 0.0) for one in motions]) if len(motions) == len(plans) else None
        path = Path(abreast([plan.path.states for plan in plans]))
        clearance = self.proved(during, path.states if motion is None else motion).clearance
        lefts, use = [plan.left for plan in plans if not isnan(plan.left)], most_used(plan.use for plan in plans)
        if motion is not None and timing is not None:
            use |= self._kept_together(during, timing, motion)
        left = nan if not lefts else max(lefts) if motion is not None else float(len(path.states) - 1)
        return StepPlan(
            step, during, after, path, motion, clearance, left, use,
            max(plan.deviation for plan in plans), parted,
        )  # fmt: skip

    def _kept_together(self, world: TaskWorld, timing: Timing, motion: Trajectory) -> dict[str, float]:
        """Return the shares of limits of torques and tool speeds, where joints of one arm may move in several steps.

        Raises:
            StepFailed: One is exceeded.
        """
        more = timing_in(world, timing).motion_limits(self.robot, tuple(world.held.values()), self.problem.payload)
        if more is None:
            return {}
        if fault := more.fault(motion):
            raise StepFailed(fault, "limits of torques or tool speeds")
        return more.use(motion)

    def _closed(self, during: TaskWorld, step: GraspStep, q: Array) -> float:
        """Return the synergy at which a hand is just before contact with its object.

        Raises:
            StepFailed: The open hand is in contact with it.
        """
        one, palm = during.held[step.object], self.robot.hands[step.hand].palm
        pose = np.linalg.inv(self.robot.link_pose(q, palm)) @ held_pose(during, step.object, q)
        turn = pin.Quaternion(pose[:3, :3]).coeffs()
        placed = one.model_copy(
            update={"position": tuple(pose[:3, 3]), "orientation": tuple(turn), "links": None, "link": palm}
        )
        try:
            closed = grasp(self.robot, step.hand, placed)
        except SceneError as error:
            raise StepFailed(str(error)) from None
        return float(np.floor(closed.synergy * 1e3) / 1e3)

    def _timed(self, plan: StepPlan, timing: Timing, *, proves: bool = True) -> StepPlan:
        """Return a step with its motion, which is proved unless it is proved with others later.

        Raises:
            StepFailed: There is none in time.
        """
        world, states, limits = plan.world, plan.path.states, self.robot.limits
        how, clear = timing_in(world, timing), [nan]
        scaled = how.limits(limits, self.robot.joint_names)
        more = how.motion_limits(self.robot, tuple(world.held.values()), self.problem.payload)

        def fault(motion: Trajectory) -> str:
            over = [f"{name} {share:.4f}" for name, share in motion.use(scaled).items() if share > 1.0 + ROUNDING]
            if over:
                return f"the share of a limit that it uses is over 1: {', '.join(over)}"
            if not proves:
                return ""
            check = full_check(self.checker, motion, states[0], states[-1:], deadline=self.deadline.at)
            clear.append(nan if check.proof is None else check.proof.clearance)
            return check.reason

        try:
            made = time_path(states, limits, self.robot.joint_names, how, fault, stop=self.ends, motion_limits=more)
        except TimingError as error:
            raise StepFailed(f"it cannot be timed, {error}") from None
        motion = made.trajectory
        use = motion.use(limits) | ({} if more is None else more.use(motion))
        return replace(plan, motion=motion, clearance=clear[-1], use=use, deviation=made.deviation)

    def _wait(self, world: TaskWorld, step: WaitStep, q: Array, timing: Timing | None) -> StepPlan:
        """Return a rest."""
        found = self._proved(StepPlan(step, world, world, Path(q[None]), None, nan), None)
        if timing is None:
            return found
        still = np.zeros((2, len(q)))
        motion = Trajectory(
            np.array([0.0, step.seconds]), np.stack([q, q]), still, still.copy(), self.robot.joint_names
        )
        return replace(found, motion=motion)

    def _retreat(self, world: TaskWorld, step: RetreatStep, q: Array, timing: Timing | None) -> StepPlan:
        """Return a hand's way from what it released, which it may touch on the first part of the way only."""
        found = self._line(world, step, q, timing)
        if not world.leaving_pairs(step.hand):
            return replace(found, left=0.0)
        left, clearance = self.departures.left(found, step.hand)
        return replace(found, left=left, clearance=min(clearance, found.clearance))


def _blend(poses: Sequence[Mapping[str, Array]]) -> float:
    """Return the radius of blends between poses: a share of the shortest way of a frame from one to the next [m]."""
    ways = [
        length(following[name][:3, 3] - pose[:3, 3]) for one, following in pairwise(poses) for name, pose in one.items()
    ]
    return BLEND * min((way for way in ways if way > SAME_POINT), default=0.0)


def most_used(uses: Iterable[Mapping[str, float]]) -> dict[str, float]:
    """Return the largest share of each limit among the shares that several motions use."""
    found = dict[str, float]()
    for use in uses:
        found |= {name: max(found.get(name, 0.0), share) for name, share in use.items()}
    return found


def timing_in(world: TaskWorld, timing: Timing) -> Timing:
    """Return a timing of a step: from rest, and without tools that are not held then."""
    speeds = timing.max_tool_speed
    if isinstance(speeds, Mapping):
        known = {*world.held, *world.robot.hands, *world.robot.link_names}
        speeds = {name: speed for name, speed in speeds.items() if name in known} or None
    return replace(timing, minimum_duration=0.0, start_velocity=(), start_acceleration=(), max_tool_speed=speeds)
