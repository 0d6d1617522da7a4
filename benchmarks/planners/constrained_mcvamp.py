"""McVAMP's public problems for one Panda (Iyer et al. 2026, arXiv 2604.13323): plane, line and maze, one second each.

Its problem files are read from a clone of its repository, with the submodule or the folder of its scenes; nothing of it
is part of this one. Its README reports plane 1000 of 1000 (0.34 ms), line 758 of 766 (0.11 ms) and maze 79 of 100
(4.4 ms), for spheres and states at discrete spacings, without timing; here meshes decide, and paths and motions are
proved. The limits of joints are those of its Panda, which are wider than Franka's, and the tool's point is 0.105 m in
front of the hand.

In ``plane`` and ``line`` the tool's point stays within 1 mm of a plane or a line, as its orientation bounds are opened.
In ``maze`` a pen, nine balls of 1 cm, stays within 1 cm of a plane, and within 0.01 rad of upright.

Usage: git clone https://github.com/CoMMALab/McVAMP FOLDER
       python -m benchmarks.planners.constrained_mcvamp FOLDER [plane line maze] [-n 1000]
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from apex_ompl.api import plan
from apex_ompl.errors import ApexError
from apex_ompl.robot import load_robot
from apex_ompl.robot.config import DATA
from apex_ompl.scene.bodies import AttachedObject, Obstacle, pose_fields, pose_matrix
from apex_ompl.scene.constraints import AnyConstraint, OnLine, OnPlane, ToolRegion, Upright
from apex_ompl.scene.problem import Goal, Problem
from apex_ompl.types import Array
from apex_ompl.util.entry_point import run_script
from benchmarks.lib import record
from benchmarks.planners.constrained_check import DENSE, dense_check

DEPENDS = ("@benchmark", "apex_ompl/constraints", "benchmarks/planners/constrained_check.py")
FOLDER = Path(__file__).parents[1] / "runs" / "mcvamp"
ASSETS = Path("experiments/assets")
FILES = {"plane": "plane_problems.json", "line": "line_problems.json", "maze": "maze_pen_problems.json"}
MAZE = ASSETS / "environments" / "maze" / "cuboids.json"
PUBLISHED = {"plane": (1000, 1000, 0.34), "line": (758, 766, 0.11), "maze": (79, 100, 4.4)}  # solved, of, median ms
LIMITS = {
    2: (-1.8326, 1.8326), 4: (-3.1416, 0.0), 6: (-0.0873, 3.8223), **dict.fromkeys((1, 3, 5, 7), (-2.9671, 2.9671)),
}  # fmt: skip
"""Number of a joint -> the limits of its Panda [rad]."""
TOOL = 0.105  # of the point that its constraints are about, along the hand's z axis [m]
FREE = 1.0  # from which on a bound is none [m]
TOLERANCE = 1e-3  # of a plane and a line, as its projection ends at a squared error of 1e-6 [m]
MAZE_POSE = (0.0, 1.0, 0.0, 0.0, 0.29276255, -0.55347496, 0.20607783)  # quaternion wxyz and position, as in its code
MAZE_HEIGHT, MAZE_ANGLE = 0.01, 0.01  # tolerances [m, rad]
PEN = tuple((0.02 * k, 0.01) for k in range(9))  # place along the hand's z axis beyond the point, and radius [m]
TIMEOUT = 1.0  # [s]


def robot_file(folder: Path = FOLDER) -> Path:
    """Write the robot file of its Panda, and return its path."""
    config = yaml.safe_load((DATA / "panda.robot.yaml").read_text())
    config["name"] = "panda_mcvamp"
    for number, (lower, upper) in LIMITS.items():
        config["joints"][f"panda_joint{number}"] |= {"lower": lower, "upper": upper}
    config["hands"]["hand"]["point"] = [0.0, 0.0, TOOL]
    if "covers" in config:
        config["covers"] = str(DATA / config["covers"])
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "panda_mcvamp.robot.yaml"
    path.write_text(yaml.safe_dump(config, sort_keys=False))
    return path


def frame(pose: Sequence[float]) -> Array:
    """Return the transform of a quaternion wxyz and a position, shape (4, 4) [m]; the quaternion is normalized."""
    w, x, y, z, *position = pose
    return pose_matrix(position, (x, y, z, w))


def constraint(reference: Array, lower: Sequence[float], upper: Sequence[float]) -> AnyConstraint:
    """Return the constraint of a task space region whose orientation is free: a plane, or a line.

    Args:
        reference: Pose of the region in the world, shape (4, 4) [m].
        lower: Least coordinates of the tool's point in it [m].
        upper: Largest ones.

    Raises:
        ApexError: One or two coordinates are not bounded.
    """
    bounded = [k for k in range(3) if upper[k] - lower[k] < FREE]
    (x, y, z), turn = reference[:3, 3], reference[:3, :3]
    point = (float(x), float(y), float(z))
    if len(bounded) == 1:
        normal = tuple(turn[:, bounded[0]].tolist())
        return OnPlane(frame="hand", normal=normal, point=point, tolerance=TOLERANCE)
    if len(bounded) == 2:
        free = next(k for k in range(3) if k not in bounded)
        return OnLine(frame="hand", direction=tuple(turn[:, free].tolist()), point=point, tolerance=TOLERANCE)
    raise ApexError(f"expected a plane or a line, found bounds of {len(bounded)} coordinates")


def maze_constraints() -> tuple[AnyConstraint, ...]:
    """Return the constraints of the maze."""
    pose = frame(MAZE_POSE)
    up = tuple(pose[:3, 2].tolist())
    place = {"position": pose_fields(pose)["position"], "orientation": pose_fields(pose)["orientation"]}
    region = ToolRegion(
        frame="hand", lower=(None, None, -MAZE_HEIGHT), upper=(None, None, MAZE_HEIGHT), **place  # type: ignore[arg-type]
    )  # fmt: skip
    return (region, Upright(frame="hand", axis=(0.0, 0.0, 1.0), up=up, angle=MAZE_ANGLE))


def pen() -> tuple[AttachedObject, ...]:
    """Return the balls of the pen."""
    return tuple(
        AttachedObject(
            name=f"pen_{k}", link="panda_hand", sphere={"radius": radius}, position=(0.0, 0.0, TOOL + along)
        )
        for k, (along, radius) in enumerate(PEN)
    )  # fmt: skip


def cuboids(rows: Sequence[Sequence[float]]) -> tuple[Obstacle, ...]:
    """Return boxes from rows of a center and half extents [m]."""
    found = []
    for k, (x, y, z, a, b, c) in enumerate(rows):
        found.append(Obstacle(name=f"box_{k}", box=(2.0 * a, 2.0 * b, 2.0 * c), position=(x, y, z)))
    return tuple(found)


def maze_scene(path: Path) -> tuple[Obstacle, ...]:
    """Return the boxes of the maze from its file: centers, edges and angles about fixed axes."""
    import pinocchio as pin

    found = []
    for k, one in enumerate(json.loads(path.read_text())):
        pose = np.eye(4)
        pose[:3, :3] = pin.rpy.rpyToMatrix(*(float(one.get(name, 0.0)) for name in ("roll", "pitch", "yaw")))
        pose[:3, 3] = one["x"], one["y"], one["z"]
        box = (one["dx"], one["dy"], one["dz"])
        found.append(Obstacle(name=f"box_{k}", box=box, **pose_fields(pose)))
    return tuple(found)


def problems_of(folder: Path, kind: str, robot: Path) -> Iterator[Problem]:
    """Yield the problems of a set, ``plane``, ``line`` or ``maze``, of a clone.

    Raises:
        ApexError: A file is missing.
    """
    path = folder / ASSETS / "problems" / "benchmark" / FILES[kind]
    if not path.is_file() or (kind == "maze" and not (folder / MAZE).is_file()):
        raise ApexError(f"{folder}: no {path.name if not path.is_file() else MAZE.name}, expected a clone of McVAMP")
    names = load_robot(str(robot)).joint_names
    scene = maze_scene(folder / MAZE) if kind == "maze" else ()
    for k, row in enumerate(json.loads(path.read_text())):
        if kind == "maze":
            held, rules = pen(), maze_constraints()
        else:
            held, scene = (), cuboids(row["cuboid_obstacles"])
            rules = (constraint(frame(row["eef_transforms"]), row["tsr_lower_bound"][:3], row["tsr_upper_bound"][:3]),)
        start, goal = (dict(zip(names, row[key], strict=True)) for key in ("problem_start", "problem_end"))
        yield Problem(
            name=f"mcvamp/{kind}/{k}", robot=str(robot), scene=scene, attached=held, start=start,
            goal=Goal(joints=(goal,)), constraints=rules,
        )  # fmt: skip


def on_constraints(problem: Problem) -> Problem:
    """Return a problem with start and goal moved onto its constraints, as McVAMP does; unchanged where that fails."""
    from apex_ompl.constraints.constraint_set import ConstraintSet

    robot = load_robot(problem.robot)
    ends = np.stack([problem.start_state(robot.joint_names), problem.goal_states(robot.joint_names)[0]])
    moved, arrived = ConstraintSet.of(robot, problem.constraints, problem.attached, ends[0]).project(ends)
    if not arrived.all():
        return problem
    start, goal = (dict(zip(robot.joint_names, q.tolist(), strict=True)) for q in moved)
    return problem.model_copy(update={"start": start, "goal": Goal(joints=(goal,))})


def run(problem: Problem) -> dict[str, Any]:
    """Return status, times and the dense check of a plan."""
    ready = on_constraints(problem)
    result = plan(ready, timeout=TIMEOUT)
    found: dict[str, Any] = {"problem": problem.name, "status": str(result.status), "reason": result.reason}
    found |= {
        "solved": bool(result),
        "total": result.times["total"] - result.times.get("setup", 0.0),
        "violation": None,
    }
    if result and result.path is not None and result.trajectory is not None:
        robot = load_robot(problem.robot)
        motion = result.trajectory.sample(DENSE / float(robot.limits.velocity.max())).position
        checks = [dense_check(robot, ready, states) for states in (result.path.states, motion)]
        found |= {"solved": all(checks), "violation": max(check.violation for check in checks)}
    return found


def main() -> None:
    """Run the problems of a clone, and write the table."""
    parser = record.parser(__doc__, n=1000, of="problems of a set, at most")
    parser.add_argument("folder", type=Path, help="clone of McVAMP")
    parser.add_argument("sets", nargs="*", metavar="SET", help=f"of {', '.join(FILES)} (default: all)")
    args = parser.parse_args()
    unknown = set(args.sets) - set(FILES)
    if unknown:
        parser.error(f"unknown set {min(unknown)!r}; known: {', '.join(FILES)}")
    robot, data = robot_file(), dict[str, Any]()
    head = [
        "set",
        "N",
        "solved",
        "p50 ms",
        "p95 ms",
        "largest violation / tolerance",
        "McVAMP's README: solved, p50 ms",
    ]
    lines = [record.row(head), record.row(["---"] * len(head))]
    for kind in args.sets or FILES:
        runs = [run(one) for one, _ in zip(problems_of(args.folder, kind, robot), range(args.n), strict=False)]
        data[kind] = runs
        solved = [one for one in runs if one["solved"]]
        times = [1e3 * v for v in record.percentiles([one["total"] for one in solved], 50, 95)]
        worst = max((one["violation"] for one in solved), default=float("nan"))
        known, of, median = PUBLISHED[kind]
        published = f"{known} of {of}, {median}"
        cells = [kind, len(runs), f"{len(solved)} of {len(runs)}", *(f"{v:.0f}" for v in times), f"{worst:.2f}"]
        lines.append(record.row([*cells, published]))
    record.write("constrained_mcvamp", {"runs": data}, "\n".join(lines), limit=f"{TIMEOUT:g} s")


if __name__ == "__main__":
    run_script(main)
