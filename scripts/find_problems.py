"""Find and check the ready-made problems and the example for Baxter, and write their files.

Reaching problems give poses of both hands at start and goal; alignment problems give objects in the hands and
how they are to meet; carry problems give the places of a level tray or of upright cups. States are found by inverse
kinematics from seeded random states. A problem is kept when its start (and goal) is free with a clearance of 1 cm, no
straight line to a goal is free for seed 0, and rrtconnect, or apex under constraints, finds a path that passes the full
check for three seeds.

Usage: python scripts/find_problems.py [NAME ...]
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from ready_made.meshes import block_obj, cup_obj
from ready_made.specifications import (
    GRASPS,
    SPECIFICATIONS,
    AlignmentSpecification,
    CarrySpecification,
    HandPose,
    Point,
    ReachSpecification,
)

from apex_ompl.api import load_problem, plan
from apex_ompl.collision import CollisionChecker
from apex_ompl.constraints.constraint_set import ConstraintSet
from apex_ompl.constraints.links import Links, in_world
from apex_ompl.goals.grasp import HandObjects, close_hands, grasp
from apex_ompl.goals.state_sampling import scene_kernel
from apex_ompl.kernel import offset_target, opposition_target
from apex_ompl.ompl.setup import assemble
from apex_ompl.ompl.validity import full_check
from apex_ompl.problems.broad_parts import shift
from apex_ompl.problems.constrained_ends import PalmSampler, line_is_free, palms_at, palms_with_cups
from apex_ompl.problems.constrained_held import TraySize, carried_tray, held_cups
from apex_ompl.problems.objects import DATA
from apex_ompl.problems.suite_robot import DrawnProblem
from apex_ompl.robot import Robot, load_robot
from apex_ompl.scene.bodies import AttachedObject
from apex_ompl.scene.constraints import WORLD, Pose, PoseTolerance, RelativePose
from apex_ompl.scene.problem import Goal, Problem
from apex_ompl.util.entry_point import run_script

ROOT = Path(__file__).resolve().parent.parent
MARGIN = 0.01  # [m]
CHAMFER = 0.006, 0.01  # width and depth of that of the hole of peg_in_hole [m]
LINE = 200  # states of the straight line from start to goal, which collides
PLACED = PoseTolerance(position=0.01, angle=0.05)  # of cups from their places
REGRASPS, NEAR, FAR = 200, 0.02, 1.0  # tries of a state with other grasps, and how far they are from the state [rad]
WIDE, FROM_LIMITS, SEEDS = (
    0.025,
    0.1,
    20,
)  # of these states: clearance [m], distance of joints from their limits [rad], searches


def hold(robot: Robot, held: HandObjects) -> tuple[tuple[AttachedObject, ...], np.ndarray]:
    """Return the held objects and a home state whose hands hold them; print the grasps."""
    objects, home, grasps = close_hands(robot, held)
    for closed in grasps:
        print(f"  {closed.held.name}: synergy {closed.synergy:.3f}, first touch {closed.touched or 'none'}")
    return objects, home


def hand_states(
    robot: Robot,
    checker: CollisionChecker,
    home: np.ndarray,
    poses: tuple[HandPose, HandPose],
    *,
    seed: int,
    count: int,
) -> list[np.ndarray]:
    """Return free states with both hands at their poses."""
    rng, links = np.random.default_rng(seed), Links.of(robot)
    targets = []
    fixed = [robot.joint_names.index(h.synergy) for h in robot.hands.values() if h.synergy]
    for hand, pose in zip(robot.hands.values(), poses, strict=True):
        targets.append(offset_target(in_world(pose.point), links.point(hand.palm, hand.point)))
        targets.append(opposition_target(links.direction(hand.palm, hand.fingers), in_world(pose.fingers), -1.0))
    inverse = links.inverse(targets, fixed)
    found: list[np.ndarray] = []
    for _ in range(4000):
        q0 = home + rng.normal(0.0, 0.6, robot.dof)
        q0[fixed] = home[fixed]
        end = inverse.descend(q0)
        q = end.states[0]
        if end.errors[0] < 1e-3 and checker.is_free(q) and checker.clearance(q) > MARGIN:
            found.append(np.round(q, 4))
            if len(found) == count:
                break
    return found


def named(robot: Robot, q: np.ndarray) -> dict[str, float]:
    """Return a state as joint name -> value."""
    return dict(zip(robot.joint_names, q.tolist(), strict=True))


def is_hard_enough(problem: Problem, robot: Robot) -> bool:
    """Whether no straight line solves a problem for seed 0, while rrtconnect solves it for three seeds."""
    ready = assemble(problem, robot, seed=0)
    lines = [np.array([ready.start, goal]) for goal in ready.goals]
    if not lines or any(full_check(ready.checker, line) for line in lines):
        return False
    results = [plan(problem, "rrtconnect", timeout=10.0, seed=seed) for seed in range(3)]
    print("  " + ", ".join(f"{r.status} {r.times['total']:.2f} s {r.reason}" for r in results), flush=True)
    return all(results)


def find_reach(specification: ReachSpecification) -> Problem:
    """Return the problem of a reaching specification."""
    robot = load_robot(specification.robot)
    scene = tuple(specification.scene())
    attached, home = hold(robot, specification.held())
    for joint, value in zip((h.synergy for h in robot.hands.values()), specification.synergies, strict=False):
        home[robot.joint_names.index(str(joint))] = value
    checker = CollisionChecker(robot, scene, attached)
    starts = hand_states(robot, checker, home, specification.start, seed=1, count=6)
    goals = hand_states(robot, checker, home, specification.goal, seed=2, count=6)
    print(f"  {len(starts)} starts, {len(goals)} goals")
    pairs = sorted((float(np.linalg.norm(a - b)), i, j) for i, a in enumerate(starts) for j, b in enumerate(goals))
    for _, i, j in pairs:
        problem = Problem(
            name=Path(specification.file).stem, robot=robot.name, scene=scene, attached=attached,
            start=named(robot, starts[i]), goal=Goal(joints=(named(robot, goals[j]),)),
        )  # fmt: skip
        if is_hard_enough(problem, robot):
            return problem
    raise SystemExit("no pair of start and goal will do")


def find_alignment(specification: AlignmentSpecification) -> Problem:
    """Return the problem of an alignment specification, with a random free start whose hands are far apart."""
    robot = load_robot("dual_panda_softhand")
    scene = tuple(specification.scene())
    attached, home = hold(robot, specification.held())
    checker = CollisionChecker(robot, scene, attached)
    rng = np.random.default_rng(specification.seed)
    fixed = [robot.joint_names.index(str(h.synergy)) for h in robot.hands.values()]
    palms = [h.palm for h in robot.hands.values()]
    for _ in range(4000):
        start = home + rng.normal(0.0, 0.35, robot.dof)
        start[fixed] = home[fixed]
        start = np.round(np.clip(start, robot.limits.lower, robot.limits.upper), 4)
        left, right = (robot.link_pose(start, palm)[:3, 3] for palm in palms)
        apart = np.linalg.norm(left - right) > 0.4 and 0.1 < min(left[2], right[2]) and max(left[2], right[2]) < 0.4
        if not apart or not checker.is_free(start) or checker.clearance(start) < MARGIN:
            continue
        problem = Problem(
            name=Path(specification.file).stem, robot=robot.name, scene=scene, attached=attached,
            start=named(robot, start), goal=Goal(alignment=specification.alignment),
        )  # fmt: skip
        if is_hard_enough(problem, robot):
            return problem
    raise SystemExit("no start will do")


def find_carried(specification: CarrySpecification) -> Problem:
    """Return the problem of a carry specification; of pairs of states the nearest whose straight line collides."""
    robot, scene, name = load_robot("dual_panda_softhand"), tuple(specification.scene()), Path(specification.file).stem
    has_tray = len(specification.start) == 1
    carried = carried_tray(TraySize(0.2, 0.26, 0.6), loaded=True) if has_tray else held_cups()
    tables = scene_kernel(robot, carried.held.tables.whole, scene).scene
    sampler, rng = PalmSampler(carried, tables, MARGIN), np.random.default_rng(specification.seed)

    def states(points: Sequence[tuple[float, float, float]], yaws: tuple[float, float], near: np.ndarray | None = None):
        if has_tray:
            return sampler.sample(rng, palms_at(carried, shift(*points[0])), near)
        return sampler.sample(rng, palms_with_cups([np.array(point) for point in points], yaws), near)

    for start in states(specification.start, specification.yaws[0]):
        goals = states(specification.goal, specification.yaws[1], start)
        print(f"  {len(goals)} goals")
        for goal in sorted(goals, key=lambda q: float(np.abs(q - start).max())):
            if line_is_free(carried, tables, np.stack([start, goal])):
                continue
            problem = DrawnProblem(scene, start, goal, carried.held.attached, (), carried.constraints)
            found = problem.to_problem(name, robot)
            results = [plan(found, timeout=10.0, seed=seed) for seed in range(3)]
            print("  " + ", ".join(f"{r.status} {r.times['total']:.2f} s {r.reason}" for r in results), flush=True)
            if all(results):
                return found
    raise SystemExit("no pair of start and goal will do")


def regrasped(
    problem: Problem, specification: ReachSpecification | AlignmentSpecification | CarrySpecification
) -> Problem:
    """Return a problem with the poses in :data:`GRASPS`, and where cups are carried with states in which they hold."""
    robot, poses, synergies, attached = load_robot(problem.robot), GRASPS.get(problem.name, {}), {}, []
    for held in problem.attached:
        if held.name not in poses:
            attached.append(held)
            continue
        hand = next(name for name, one in robot.hands.items() if one.palm == held.link)
        position, orientation = poses[held.name]
        attached.append(held.model_copy(update={"position": position, "orientation": orientation}))
        closed = grasp(robot, hand, attached[-1])
        synergies[str(closed.synergy_joint)] = float(np.floor(closed.synergy * 1e3) / 1e3)
    made = problem.model_copy(update={"attached": tuple(attached), "start": problem.start | synergies})
    if not poses or not isinstance(specification, CarrySpecification):
        return made
    for seed in range(SEEDS):
        start = _with_cups(made, specification.start, problem.start_state(robot.joint_names), synergies, seed)
        goal = None if start is None else _with_cups(made, specification.goal, start, synergies, seed)
        if start is None or goal is None:
            continue
        checker = CollisionChecker(robot, made.scene, made.attached)
        if not all(checker.is_free(start + t * (goal - start)) for t in np.linspace(0.0, 1.0, LINE)):
            goals = Goal(joints=(named(robot, goal),))
            return made.model_copy(update={"start": named(robot, start), "goal": goals})
    raise SystemExit("no states will do with the other grasps")


def _with_cups(
    problem: Problem, points: Sequence[Point], q: np.ndarray, synergies: dict[str, float], seed: int
) -> np.ndarray | None:
    """Return a free state near a state, with the middles of upright cups at points [m], and with synergies."""
    places = []
    for held, (x, y, z) in zip(problem.attached, points, strict=True):
        assert held.contact is not None  # the middle of the opening, whose frame a constraint is about
        pose = Pose(position=(x, y, z + float(np.linalg.norm(held.contact.point))))
        places.append(RelativePose(first=WORLD, second=held.name, pose=pose, free=("rz",), tolerance=PLACED))
    robot, rng = load_robot(problem.robot), np.random.default_rng(seed)
    hands = [robot.joint_names.index(name) for name in synergies]
    arms = [k for k in range(robot.dof) if k not in hands]
    q = q.copy()
    q[hands] = list(synergies.values())
    bound = ConstraintSet.of(robot, (*problem.constraints, *places), problem.attached, q)
    checker = CollisionChecker(robot, problem.scene, problem.attached)
    for k in range(REGRASPS):
        off = rng.normal(0.0, NEAR + (FAR - NEAR) * k / REGRASPS, robot.dof)
        off[hands] = 0.0
        found = bound.project((q + off)[None])
        state = np.round(found.states[0], 4)
        room = np.minimum(state - robot.limits.lower, robot.limits.upper - state)[arms].min()
        if found.ok[0] and room > FROM_LIMITS and checker.is_free(state) and checker.clearance(state) > WIDE:
            return state
    return None


def with_relative_meshes(problem: Problem) -> Problem:
    """Return the problem with its meshes named from the folder of the file."""

    def moved(body: AttachedObject) -> AttachedObject:
        if body.mesh is None:
            return body
        return body.model_copy(update={"mesh": body.mesh.model_copy(update={"file": Path(body.mesh.file).name})})

    return problem.model_copy(update={"attached": tuple(moved(body) for body in problem.attached)})


def _found(specification: ReachSpecification | AlignmentSpecification | CarrySpecification) -> Problem:
    if isinstance(specification, CarrySpecification):
        return find_carried(specification)
    if isinstance(specification, ReachSpecification):
        return find_reach(specification)
    return find_alignment(specification)


def main() -> None:
    """Write the meshes, and find the named problems, or all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*")
    parser.add_argument("--regrasp", action="store_true", help="change the grasps of the files, and search nothing")
    given = parser.parse_args()
    names = given.names
    (DATA / "cup.obj").write_text(cup_obj())
    (DATA / "block.obj").write_text(block_obj())
    (DATA / "chamfered_block.obj").write_text(block_obj(chamfer=CHAMFER))
    for specification in SPECIFICATIONS:
        name = Path(specification.file).stem
        if not names or name in names:
            print(name, flush=True)
            file = ROOT / specification.file
            before = load_problem(file) if file.exists() else None
            problem = regrasped(before if given.regrasp and before else _found(specification), specification)
            after = before.after if before else ()
            with_relative_meshes(problem).model_copy(update={"after": after}).save(file)


if __name__ == "__main__":
    run_script(main)
