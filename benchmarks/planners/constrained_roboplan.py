"""RoboPlan's constrained RRT-Connect (CBiRRT2 by projection) on problems with constraints.

Its scene is that of :mod:`benchmarks.planners.peers`: the same bodies and pairs, checked by itself. Frames of
constraints are links that are added to the URDF. A closed chain is the pose of one hand's frame in the other's, and an
upright axis a box of roll and pitch inside of its cone. Its shortcuts know no constraints, so that its paths are left
as they are.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass
from dataclasses import replace as replaced
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
from roboplan.core import JointConfiguration
from roboplan.rrt import RRT, ConstraintProjectorOptions, PoseConstraint, RRTOptions

from apex_ompl.constraints.constraint_set import ConstraintSet
from apex_ompl.constraints.frames import frame_of
from apex_ompl.errors import ParameterError
from apex_ompl.evaluation.rows import Job
from apex_ompl.evaluation.runs import NO_PROBLEM, Run
from apex_ompl.ompl.setup import PlanningSetup, assemble
from apex_ompl.paths.path import SEARCH_RESOLUTION
from apex_ompl.scene.constraints import RelativePose, Upright
from apex_ompl.types import Array
from apex_ompl.util.clocks import timed
from benchmarks.planners.constrained_check import FrameReader, all_constraints, arm_joints, columns, problem_of
from benchmarks.planners.peers import NODES, representable, roboplan_scene

RUNNER = f"{__name__}:plan_with_roboplan"
GROUP = "arms"
WIDE = 100.0  # bound of what is free [m or rad]
ANGLE = 0.005  # default tolerance of angles beyond their bounds [rad]
PATIENCE = 4.0  # of its clock, times the limit, where CPU times count: later paths do not
PROJECTION = ("path_step_size", "max_iters", "correction_step_size", "damping", "convergence_ratio")


@dataclass(frozen=True, eq=False)
class Box:
    """A constraint as RoboPlan takes it.

    Attributes:
        frame: Name of the frame.
        pose: Pose of the frame in its link, shape (4, 4) [m].
        link: The link.
        reference: Name of the link that the region is given in; the world where it is empty.
        region: Pose of the region there, shape (4, 4) [m].
        bound: Largest displacement along and about its axes, shape (6,) [m, rad].
        tolerance: Of positions [m] and angles [rad] beyond the bounds.
    """

    frame: str
    link: str
    pose: Array
    reference: str
    region: Array
    bound: Array
    tolerance: tuple[float, float]


def boxes(ready: PlanningSetup) -> list[Box]:
    """Return the constraints of a problem.

    Raises:
        ParameterError: It has another constraint than closed chains and upright axes.
    """
    held = {body.name: body for body in ready.problem.attached}
    reader, found = FrameReader(ready.robot, ready.problem), list[Box]()
    for k, constraint in enumerate(all_constraints(ready.problem)):
        if isinstance(constraint, Upright):
            frame = frame_of(ready.robot, constraint.frame, held)
            turn = np.eye(4)
            turn[:3, :3] = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), np.array(constraint.axis)).matrix()
            region = np.eye(4)
            region[:3, :3] = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), np.array(constraint.up)).matrix()
            angle = max(0.0, constraint.angle / np.sqrt(2.0) - ANGLE)
            bound = np.array([WIDE, WIDE, WIDE, angle, angle, WIDE])
            found.append(Box(f"constrained_{k}", frame.link, frame.pose @ turn, "", region, bound, (1e-3, ANGLE)))
        elif isinstance(constraint, RelativePose) and not constraint.free and constraint.pose is None:
            poses = reader(ready.start, (constraint.first, constraint.second))
            region = np.linalg.inv(poses[constraint.first]) @ poses[constraint.second]
            tolerance = (constraint.tolerance.position, constraint.tolerance.angle)
            bound = np.zeros(6)
            found.append(
                Box(f"constrained_{k}", constraint.second, np.eye(4), constraint.first, region, bound, tolerance)
            )
        else:
            raise ParameterError("constraint", type(constraint).__name__, "a closed chain or an upright axis")
    return found


def with_frames(urdf: str, frames: Iterable[Box]) -> str:
    """Return a URDF with a link for each frame."""
    root = ElementTree.fromstring(urdf)
    for one in frames:
        ElementTree.SubElement(root, "link", name=one.frame)
        joint = ElementTree.SubElement(root, "joint", name=f"{one.frame}_joint", type="fixed")
        ElementTree.SubElement(joint, "parent", link=one.link)
        ElementTree.SubElement(joint, "child", link=one.frame)
        turn = " ".join(map(repr, pin.rpy.matrixToRpy(one.pose[:3, :3]).tolist()))
        ElementTree.SubElement(joint, "origin", xyz=" ".join(map(repr, one.pose[:3, 3].tolist())), rpy=turn)
    return ElementTree.tostring(root, encoding="unicode")


def plan_with_roboplan(job: Job) -> Run:
    """Return the columns of a run; parameters are those of ``RRTOptions`` and of ``ConstraintProjectorOptions``."""
    problem = problem_of(job)
    if not representable(problem):
        return {"solved": False, "status": NO_PROBLEM, "reason": "it has shapes that RoboPlan has not"}
    ready = assemble(problem, seed=job.seed)
    constraints = ConstraintSet.of(ready.robot, problem.constraints, problem.attached, ready.start)
    wanted = boxes(ready)
    machine = replaced(ready.robot, urdf=with_frames(ready.robot.urdf, wanted))
    scene = roboplan_scene(replaced(ready, robot=machine))
    links = scene_links(ready)
    for body in problem.attached:
        for holder in body.holders[1:]:
            scene.setCollisions([(body.name, link) for link in ready.robot.hand_of(holder) if link in links], False)
    names = [ready.robot.joint_names[k] for k in arm_joints(ready)]
    scene.addGroup(GROUP, names)
    scene.setJointPositions(ready.robot.to_pinocchio(ready.start))
    rules = [
        PoseConstraint(
            scene, GROUP, one.frame, -one.bound, one.bound, np.asfortranarray(one.region), one.reference,
            *one.tolerance,
        )
        for one in wanted
    ]  # fmt: skip
    projection = {name: value for name, value in job.params.items() if name in PROJECTION}
    rest = {name: value for name, value in job.params.items() if name not in PROJECTION}
    patience = PATIENCE if time.perf_counter is time.process_time else 1.0
    options = RRTOptions(
        group_name=GROUP, max_nodes=NODES, max_planning_time=patience * job.timeout, rrt_connect=True,
        constraint_projection=ConstraintProjectorOptions(**projection),
        **{"collision_check_step_size": SEARCH_RESOLUTION, **rest},
    )  # fmt: skip
    planner = RRT(scene, options)
    planner.setRngSeed(job.seed)
    joints = arm_joints(ready)
    start, goal = (JointConfiguration(names, q[joints]) for q in (ready.start, ready.goals[0]))
    times: dict[str, float] = {}
    try:
        with timed(times, "solve"):
            path = planner.plan(start, goal, rules)
    except RuntimeError as error:
        return columns(ready, constraints, (), times, limit=job.timeout, reason=str(error)[:80])
    order = [list(path.joint_names).index(name) for name in names]
    states = np.repeat(ready.start[None], len(path.positions), axis=0)
    states[:, joints] = np.array(path.positions)[:, order]
    states[0], states[-1] = ready.start, ready.goals[0]
    return columns(ready, constraints, [states], times, limit=job.timeout)


def scene_links(ready: PlanningSetup) -> set[str]:
    """Return the links of a robot that have geometry."""
    model, items = ready.robot.model, ready.robot.geometry.geometryObjects
    return {model.frames[item.parentFrame].name for item in items}
