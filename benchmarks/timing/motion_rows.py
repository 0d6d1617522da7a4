"""Rows of benchmarks/timing/motions.py: planners of this package, and rivals with the timing that they come with.

Each function makes one run for ``apex_ompl.evaluation.bench``. Durations are those of motions that passed the full
check; a motion that did not, or that exceeds a limit, is a fault, and its run counts as failed.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pinocchio as pin
import ruckig
import yaml
from ompl import geometric as og

from apex_ompl import load_problem, plan
from apex_ompl.errors import ParameterError
from apex_ompl.evaluation.rows import Job
from apex_ompl.evaluation.runs import NO_PROBLEM, Run
from apex_ompl.goals.pose_goal import PoseGoal
from apex_ompl.ompl.process import quiet_ompl
from apex_ompl.ompl.setup import PlanningSetup, assemble
from apex_ompl.ompl.space import array_to_path, path_to_array
from apex_ompl.ompl.tuned import TUNED
from apex_ompl.ompl.validity import full_check
from apex_ompl.paths.path import SEARCH_RESOLUTION
from apex_ompl.planning import steps
from apex_ompl.problems.suite_robot import robot
from apex_ompl.result import PlanResult
from apex_ompl.robot import Robot
from apex_ompl.scene.problem import Alignment, Goal, PoseTarget, Problem
from apex_ompl.timing import Timing, Trajectory
from apex_ompl.timing.ruckig_method import calculate, knots
from apex_ompl.types import Array
from apex_ompl.util.clocks import Deadline
from benchmarks.timing.exported_motions import followed, largest, read_points
from benchmarks.timing.motion_figures import motion_fault, smoothness, torque_use

SUFFIXES = (".npz", ".csv", ".traj.yaml", ".traj.json")  # of saved motions
DENSE = 1e-3  # spacing of the states of a followed motion that are checked [rad, max-norm]
CALLS = 2  # equal ones, of which the cheaper counts
SEEDS = 8  # of a problem whose goal has many states
SMOOTH_FROM = 1.0  # shortest duration of motions whose smoothness counts [s]
PAYLOADS = (0.0, 2.0)  # in each hand [kg]
SPACINGS = (np.inf, 0.4, 0.2, 0.1, 0.05)  # of the points of TOPP-RA's spline besides the corners [rad]
LEAST_POINTS = 2  # of a segment
SAMPLING = 0.002  # of rivals' motions for the full check [s]
ARMS = "arms"  # RoboPlan's group of their joints
ROBOPLAN_ERRORS = (RuntimeError, IndexError)
DT = 0.01  # of RoboPlan's motion, its default [s]
FIRST_OBJECTS = ("lower", "cup", "block")  # of the suites of aligned objects


@dataclass
class Cost:
    """What a call costs: CPU time of the process and time on the clock [s]."""

    cpu: float = 0.0
    wall: float = 0.0


@contextmanager
def measured(cost: Cost) -> Iterator[None]:
    """Add what the block takes to a cost."""
    cpu, wall = time.process_time(), time.perf_counter()
    try:
        yield
    finally:
        cost.cpu += time.process_time() - cpu
        cost.wall += time.perf_counter() - wall


@dataclass
class Call:
    """A call of ``plan``: its result, its cost, and the part of that for the motion."""

    result: PlanResult
    whole: Cost
    motion: Cost


def called(problem: Problem, planner: str, calls: int = 1, **options: Any) -> Call:
    """Plan a problem, and measure the call and its last step, in which the motion is made.

    Args:
        problem: The problem.
        planner: Name of the planner.
        calls: Number of equal calls; the one with the least CPU time counts, since the first one in a process makes
            what others reuse, such as covers of meshes.
        **options: Options of ``plan``.
    """
    made = list[Call]()
    for _ in range(calls):
        whole, motion, step = Cost(), Cost(), steps.time

        def timed_step(*given: Any, cost: Cost = motion, step: Any = step) -> PlanResult:
            with measured(cost):
                return step(*given)

        with mock.patch.object(steps, "time", timed_step), measured(whole):
            result = plan(problem, planner, **options)
        made.append(Call(result, whole, motion))
    return min(made, key=lambda call: call.whole.cpu)


def lower_bound(setup: PlanningSetup) -> float:
    """Return the least duration of a motion to any goal of a problem, obstacles ignored [s]."""
    return min(direct_motion(setup, goal).duration for goal in setup.valid_goals)


def direct_motion(setup: PlanningSetup, goal: Array) -> Trajectory:
    """Return Ruckig's motion from the start to a goal, all joints at rest at both ends and in the same time."""
    limits, solver, task = setup.robot.limits, ruckig.Ruckig(setup.robot.dof), ruckig.InputParameter(setup.robot.dof)
    for name in ("velocity", "acceleration", "jerk"):
        setattr(task, f"max_{name}", getattr(limits, name).tolist())
    task.current_position, task.target_position = setup.start.tolist(), goal.tolist()
    made = ruckig.Trajectory(setup.robot.dof)
    calculate(solver, task, made)
    times, positions, velocities, accelerations = knots(made)
    positions[0], positions[-1] = setup.start, goal  # without rounding
    return Trajectory(times, positions, velocities, accelerations, setup.robot.joint_names)


def columns_of(call: Call, setup: PlanningSetup, timing: Timing) -> Run:
    """Return the columns of a call of ``plan``."""
    result, motion, limits = call.result, call.result.trajectory, setup.robot.limits
    found = {"cpu": call.whole.cpu, "total": call.whole.wall, "motion_cpu": call.motion.cpu, "solved": False}
    found |= {"direct": lower_bound(setup), "reason": result.reason, "fault": ""}
    if motion is None:
        return found
    found["fault"] = fault = motion_fault(setup, motion, timing.limits(limits, setup.robot.joint_names))
    calm = smoothness(motion, limits) if motion.duration >= SMOOTH_FROM else None
    return found | {
        "solved": not fault, "reason": fault, "duration": motion.duration, "length": result.length,
        "by": result.solved_by, "method": result.timing_method,
        "pulses": None if calm is None else calm.pulses.tolist(),
        "rms_jerk": None if calm is None else calm.rms_jerk, "knots": None if calm is None else calm.knots,
        "torque": [torque_use(motion, setup.robot, payload) for payload in PAYLOADS],
    }  # fmt: skip


def by_plan(job: Job) -> Run:
    """Return a run by ``plan``; parameters are its ``objective`` and those of ``Timing``, as ``timing.method``."""
    objective = job.params.get("objective", "time")
    timing = Timing(**{k.removeprefix("timing."): v for k, v in job.params.items() if k.startswith("timing.")})
    problem = load_problem(job.problem)
    params = TUNED.get(job.planner) if job.planner != "apex" else None
    call = called(
        problem, job.planner, CALLS, params=params, timeout=job.timeout, seed=job.seed, objective=objective,
        timing=timing,
    )  # fmt: skip
    return columns_of(call, assemble(problem, robot(), job.seed), timing)


def with_goal(problem: Problem, kind: str) -> Problem:
    """Return a problem with its own goal (``given``), the alignment of its objects, or the poses of its hands there.

    Args:
        problem: A problem of a suite, with one goal in joint space, unless the kind is ``given``.
        kind: ``given``, ``alignment`` or ``pose``.
    """
    if kind == "given":
        return problem
    if kind == "alignment":
        names = [held.name for held in problem.attached]
        first = next(name for name in names if name in FIRST_OBJECTS)
        second = next(name for name in names if name != first)
        suite = "vertical" if first == "lower" else "horizontal"
        return problem.model_copy(update={"goal": Goal(alignment=Alignment(kind=suite, first=first, second=second))})
    machine = robot()
    start, goal = problem.start_state(machine.joint_names), problem.goal_states(machine.joint_names)[0]
    frames = [PoseTarget(frame=hand, position=(0.0, 0.0, 0.0)) for hand in machine.hands]
    placements = PoseGoal(machine, frames, problem.attached, start).placements(goal)
    poses = tuple(
        PoseTarget(
            frame=frame.frame, position=tuple(pose[:3, 3].tolist()),
            orientation=tuple(pin.Quaternion(pose[:3, :3]).coeffs().tolist()),
        )
        for frame, pose in zip(frames, placements, strict=True)
    )  # fmt: skip
    return problem.model_copy(update={"goal": Goal(poses=poses)})


def by_seeds(job: Job) -> Run:
    """Return the durations of a problem with several seeds, NaN where there is none; ``goal`` tells which goal."""
    problem = with_goal(load_problem(job.problem), str(job.params["goal"]))
    durations, costs, faults = list[float | None](), list[float](), list[str]()
    for seed in range(SEEDS):
        call = called(problem, job.planner, timeout=job.timeout, seed=seed, objective=job.params["objective"])
        motion, setup = call.result.trajectory, assemble(problem, robot(), seed)
        fault = "" if motion is None else motion_fault(setup, motion, setup.robot.limits)
        faults += [fault] if fault else []
        durations.append(None if motion is None or fault else motion.duration)
        costs.append(call.whole.cpu)
    solved = all(duration is not None for duration in durations)
    return {"solved": solved, "reason": "; ".join(faults), "fault": "; ".join(faults), "durations": durations,
            "cpu": float(np.median(costs))}  # fmt: skip


def shortened_path(job: Job) -> tuple[PlanningSetup, Call]:
    """Return the set-up of a problem, and the call of tuned rrtconnect, whose path OMPL shortens, without a motion."""
    problem = load_problem(job.problem)
    call = called(
        problem, "rrtconnect", CALLS, params=TUNED["rrtconnect"], timeout=job.timeout, seed=job.seed, timing=False
    )
    return assemble(problem, robot(), job.seed), call


def fastest_valid(
    setup: PlanningSetup, cost: Cost, choices: Iterator[Callable[[], tuple[Array, float] | None]]
) -> Run:  # fmt: skip
    """Return the columns of a rival: the shortest duration of those choices whose states pass the full check.

    Args:
        setup: The problem.
        cost: What planning took; of all choices only the chosen one's cost is added.
        choices: Each returns the states of a motion, shape (N, dof), and its duration [s], or None.
    """
    best: tuple[float, Cost] | None = None
    reason = "no motion"
    for choice in choices:
        one = Cost(cost.cpu, cost.wall)
        with measured(one):
            made = choice()
        if made is None:
            continue
        states, duration = made
        states[0], states[-1] = setup.start, setup.goals[0]
        check = full_check(setup.checker, states, setup.start, setup.goals)
        reason = check.reason or reason
        if check and (best is None or duration < best[0]):
            best = duration, one
    found: Run = {"direct": lower_bound(setup), "fault": "", "solved": best is not None}
    if best is None:
        return found | {"cpu": cost.cpu, "total": cost.wall, "reason": reason}
    spent = best[1]
    motion_cpu = spent.cpu - cost.cpu
    return found | {"cpu": spent.cpu, "total": spent.wall, "motion_cpu": motion_cpu, "duration": best[0]}


def by_toppra(job: Job) -> Run:
    """Return a run of rrtconnect, shortened by OMPL, and TOPP-RA along a cubic spline.

    The spline interpolates the path smoothed by OMPL's B-spline, or the path's corners and points between them at one
    of several spacings; the fastest valid motion counts. The limits are those of velocity and acceleration; TOPP-RA has
    none of jerk.
    """
    import toppra

    from benchmarks.timing.timing_methods import optimum

    toppra.setup_logging("ERROR")
    setup, call = shortened_path(job)
    path = call.result.path
    if path is None or not call.result:
        return {"solved": False, "reason": call.result.reason, "cpu": call.whole.cpu, "total": call.whole.wall}

    with quiet_ompl():
        smooth = smoothed(setup, path.states)

    def motion(points: Array) -> tuple[Array, float] | None:
        made = optimum(points)
        if made is None:
            return None
        times = np.linspace(0.0, made[1], max(2, int(np.ceil(made[1] / SAMPLING))))
        return np.asarray(made[0](times)), made[1]

    curves = [smooth, *(through_corners(path.states, spacing) for spacing in SPACINGS)]
    return fastest_valid(setup, call.whole, (lambda points=points: motion(points) for points in curves))


def smoothed(setup: PlanningSetup, states: Array) -> Array:
    """Return a path that OMPL's simplifier has smoothed by a B-spline."""
    si = setup.simple_setup.getSpaceInformation()
    work = array_to_path(si, states)
    og.PathSimplifier(si).smoothBSpline(work)
    return path_to_array(work, setup.robot.dof)


def through_corners(states: Array, spacing: float) -> Array:
    """Return the states of a path with further ones between them, at most a spacing apart [rad, max-norm]."""
    points = [states[:1]]
    for a, b in zip(states[:-1], states[1:], strict=True):
        count = max(LEAST_POINTS, int(np.ceil(np.abs(b - a).max() / spacing)))
        points.append(a + np.linspace(0.0, 1.0, count + 1)[1:, None] * (b - a))
    return np.concatenate(points)


def by_roboplan(job: Job) -> Run:
    """Return a run of RoboPlan: RRT-Connect with tuned parameters, its shortcuts, and its own TOPP-RA.

    The limits are this robot's of velocity and acceleration. RoboPlan times the arms alone (its TOPP-RA ends the
    process where a robot has mimic joints); the hands follow along the path, without limits. Of its ways to fit a
    spline the fastest valid one counts.
    """
    from roboplan.core import JointConfiguration, JointPath, PathShortcutter, PathShortcuttingOptions
    from roboplan.rrt import RRT, RRTOptions
    from roboplan.toppra import PathParameterizerTOPPRA, SplineFittingMode, TOPPRAOptions

    from benchmarks.planners.peers import NODES, representable, roboplan_scene

    problem = load_problem(job.problem)
    if not representable(problem):
        return {"solved": False, "status": NO_PROBLEM, "reason": "it has shapes that RoboPlan has not"}
    setup, cost = assemble(problem, robot(), job.seed), Cost()
    scene, machine, deadline = roboplan_scene(setup), setup.robot, Deadline(job.timeout)
    limit_accelerations(scene, machine)
    arms = add_group_of_arms(scene, machine)
    names = list(scene.getJointNames())
    options = RRTOptions(
        max_nodes=NODES, collision_check_step_size=SEARCH_RESOLUTION, max_planning_time=deadline.for_search,
        rrt_connect=True, **TUNED["roboplan"],
    )  # fmt: skip
    start, goal = (JointConfiguration(names, machine.to_pinocchio(q)) for q in (setup.start, setup.goals[0]))
    try:
        with measured(cost):
            planner = RRT(scene, options)
            planner.setRngSeed(job.seed)
            found = planner.plan(start, goal)
            shortcuts = PathShortcuttingOptions(max_step_size=SEARCH_RESOLUTION, seed=job.seed)
            short = PathShortcutter(scene, shortcuts).shortcut(found)
    except ROBOPLAN_ERRORS as error:
        return {"solved": False, "reason": str(error)[:80], "cpu": cost.cpu, "total": cost.wall}
    states = np.array(short.positions)[:, [names.index(joint) for joint in machine.joint_names]]
    path = JointPath()
    path.joint_names = arms
    path.positions = list(states[:, [machine.joint_names.index(joint) for joint in arms]])
    timer = PathParameterizerTOPPRA(scene, ARMS)

    def motion(mode: Any) -> tuple[Array, float] | None:
        try:
            made = timer.generate(path, TOPPRAOptions(dt=DT, mode=mode))
        except ROBOPLAN_ERRORS:
            return None
        return with_hands(np.array(made.positions), arms, states, machine.joint_names), float(made.times[-1])

    return fastest_valid(setup, cost, (lambda m=m: motion(m) for m in SplineFittingMode))


def limit_accelerations(scene: Any, machine: Robot) -> None:
    """Give a scene of RoboPlan the robot's limits of acceleration and jerk, which URDF has not."""
    from roboplan.core import loadJointLimitsConfig

    limits = zip(machine.joint_names, machine.limits.acceleration, machine.limits.jerk, strict=True)
    given = {name: {"max_acceleration": [float(a)], "max_jerk": [float(j)]} for name, a, j in limits}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "limits.yaml"
        file.write_text(yaml.safe_dump({"joint_limits": given}))
        scene.importJointLimitsFromConfig(loadJointLimitsConfig(file))


def add_group_of_arms(scene: Any, machine: Robot) -> list[str]:
    """Add a group of all joints but those of the hands to a scene of RoboPlan, and return their names."""
    sides = [name.removesuffix("_hand") for name in machine.hands]
    for side in sides:
        scene.addGroupFromChain(side, f"{side}_link0", f"{side}_link8")
    scene.addGroupFromGroups(ARMS, sides)
    return list(scene.getJointGroupInfo(ARMS).joint_names)


def with_hands(motion: Array, arms: Sequence[str], path: Array, names: Sequence[str]) -> Array:
    """Return states of all joints for those of the arms; the others are where the path has them at that share of it.

    Args:
        motion: States of the arms, shape (N, arms).
        arms: Their names.
        path: States of all joints, shape (M, dof).
        names: Their names.
    """
    columns = [list(names).index(joint) for joint in arms]
    states = np.empty((len(motion), len(names)))
    states[:, columns] = motion
    shares = [along(some) for some in (motion, path[:, columns])]
    for column in sorted(set(range(len(names))) - set(columns)):
        states[:, column] = np.interp(*shares, path[:, column])
    return states


def along(states: Array) -> Array:
    """Return the share of a path's length up to each of its states, shape (N,)."""
    length = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(states, axis=0), axis=1)))
    return np.asarray(length / max(length[-1], 1e-12))


def by_export(job: Job) -> Run:
    """Return how motions fare that are saved, read back and followed as a controller does it.

    For each way to save, ``exports`` has the largest use of velocity, acceleration and jerk limits, whether a state of
    the followed motion collides, its distance from the start and the goal [rad], the size of the file, and its points;
    ``refused`` is why a rate is too low, and ``unreadable`` why a file cannot be followed. Parameters are the
    ``objective`` and the rates, ``rates``; 0 stands for the motion's own knots.
    """
    problem = load_problem(job.problem)
    call = called(problem, job.planner, timeout=job.timeout, seed=job.seed, objective=job.params["objective"])
    motion, setup = call.result.trajectory, assemble(problem, robot(), job.seed)
    found: Run = {"solved": motion is not None, "reason": call.result.reason, "fault": ""}
    if motion is None:
        return found
    exports = {}
    with tempfile.TemporaryDirectory() as folder:
        for rate in job.params["rates"]:
            for suffix in SUFFIXES:
                file = Path(folder) / f"motion{suffix}"
                try:
                    motion.save(file, **({"rate": rate, "limits": setup.robot.limits} if rate else {}))
                except ParameterError as error:  # a rate too low for the motion
                    exports[f"{suffix} {rate:g}"] = {"refused": str(error)}
                    continue
                exports[f"{suffix} {rate:g}"] = export_figures(file, setup)
    return found | {"duration": motion.duration, "exports": exports}


def export_figures(file: Path, setup: PlanningSetup) -> dict[str, Any]:
    """Return the figures of a saved motion, see :func:`by_export`."""
    limits, size = setup.robot.limits, file.stat().st_size
    try:
        points = read_points(file)
        used, states = largest(points), followed(points, DENSE)
    except ValueError as error:
        return {"unreadable": str(error), "bytes": size}
    columns = [points.joints.index(joint) for joint in setup.robot.joint_names]
    shares = used[:, columns] / [limits.velocity, limits.acceleration, limits.jerk]
    ends = points.states[0, [0, -1]][:, columns] - [setup.start, setup.goals[0]]
    moving = float(np.abs(points.states[1:, [0, -1]]).max())
    return {
        "use": shares.max(axis=1).tolist(), "collides": not setup.checker.are_free(states[:, columns]).all(),
        "off": float(np.abs(ends).max()), "moving": moving, "bytes": size, "points": len(points.nanoseconds),
    }  # fmt: skip
