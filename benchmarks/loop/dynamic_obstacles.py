"""Obstacles that move, in the kernel: soundness and cost of proofs, blocked intervals, stops and retiming.

Motions are random ones of the two Pandas, free of themselves and of the tables, at half of the velocity limits; dynamic
obstacles are boxes, balls, cylinders and capsules that come near a link at a random moment. A motion that is proved
apart from its dynamic obstacle is checked by the meshes at 100 moments; where it is not proved, the meshes say whether
there is contact in 20 ms from there. Motions of the table of costs last 3 s.

Usage: python -m benchmarks.loop.dynamic_obstacles [-n 10000] [--costs 300]
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from apex_ompl.collision import CollisionChecker
from apex_ompl.moving.dynamic_obstacles import DynamicObstacles, clearance_in_time, curve_of, prove_motion
from apex_ompl.moving.retime import blocked, retime
from apex_ompl.moving.stopping import stop, stop_along
from apex_ompl.problems.suite_robot import robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.scripts import obstacle_at
from apex_ompl.timing import Timing, Trajectory, time_path
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import one_or_more
from benchmarks.lib import record

DEPENDS = ("@checking", "apex_ompl/moving", "apex_ompl/timing")
MOMENTS, PIECES, LONG = 100, 256, 3.0
MOTIONS = 200  # different ones
SHAPES = [
    {"box": (0.12, 0.1, 0.08)}, {"sphere": {"radius": 0.06}}, {"cylinder": {"radius": 0.05, "length": 0.15}},
    {"capsule": {"radius": 0.05, "length": 0.1}},
]  # fmt: skip
LINKS = ("left_hand_palm", "right_hand_palm", "left_link6", "right_link4")


def motion_of(checker: CollisionChecker, rng: np.random.Generator, duration: float = 0.0) -> Trajectory:
    """Return a random motion that is free, stretched to a duration [s] if one is given."""
    arm, limits = checker.robot, checker.robot.limits
    while True:
        path = arm.home + np.cumsum(rng.normal(0.0, 0.3, (5, arm.dof)), axis=0)
        path = np.clip(path, limits.lower + 0.01, limits.upper - 0.01)
        timing = Timing(method="spline", velocity_scale=0.5, minimum_duration=duration)
        motion = time_path(path, limits, arm.joint_names, timing).trajectory
        if (not duration or motion.duration < 1.01 * duration) and checker.prove(curve_of(motion), tolerance=0.0):
            return motion


def dynamic_obstacle_near(motion: Trajectory, rng: np.random.Generator, name: str) -> Obstacle:
    """Return an obstacle that comes near a link at a random moment of a motion."""
    moment, velocity = rng.uniform(0.0, motion.duration), rng.normal(0.0, 0.25, 3)
    there = robot().link_pose(motion(moment), LINKS[rng.integers(len(LINKS))])[:3, 3]
    at = there + rng.normal(0.0, 0.2, 3) - velocity * moment
    shape = SHAPES[rng.integers(len(SHAPES))]
    return Obstacle.model_validate({"name": name, "position": at.tolist(), "velocity": velocity.tolist(), **shape})


def soundness(checker: CollisionChecker, motions: list[Trajectory], count: int) -> dict[str, int]:
    """Return how many motions are proved, proved in spite of a contact, and not proved without one near."""
    rng = np.random.default_rng(1)
    found = {"n": count, "proved": 0, "falsely proved": 0, "open without contact": 0}
    for k in range(count):
        motion = motions[k % len(motions)]
        dynamic_obstacle = dynamic_obstacle_near(motion, rng, "dynamic_obstacle")
        conflict = prove_motion(checker.kernel, DynamicObstacles([dynamic_obstacle]), motion)
        exact = CollisionChecker(checker.robot, [dynamic_obstacle], proofs=False)

        def touches(moments: np.ndarray, motion=motion, dynamic_obstacle=dynamic_obstacle, exact=exact) -> bool:
            for moment in moments.tolist():
                exact.move("dynamic_obstacle", obstacle_at(dynamic_obstacle, moment).position)
                if not exact.is_free(motion(moment)):
                    return True
            return False

        if conflict:
            near = np.linspace(conflict.time, min(conflict.time + 0.02, motion.duration), 6)
            found["open without contact"] += not touches(near)
        else:
            found["proved"] += 1
            found["falsely proved"] += touches(np.linspace(0.0, motion.duration, MOMENTS))
    return found


def timed(call: Callable[[], Any]) -> float:
    """Return the least time of a call [s], the first one apart."""
    call()
    return record.fastest(call, 3)


def costs(checker: CollisionChecker, count: int) -> dict[str, list[float]]:
    """Return times of calls [s] by what they do."""
    rng, kernel, limits = np.random.default_rng(2), checker.kernel, checker.robot.limits
    names, found = checker.robot.joint_names, dict[str, list[float]]()
    motions = [motion_of(checker, rng, LONG) for _ in range(20)]
    for number in (1, 3, 10):
        for k in range(count):
            motion = motions[k % len(motions)]
            dynamic = DynamicObstacles(
                [dynamic_obstacle_near(motion, rng, f"dynamic_obstacle{j}") for j in range(number)]
            )
            proof = prove_motion(kernel, dynamic, motion)
            what = f"proof of 3 s among {number}" + ("" if proof else ", proved")
            for key in {what, f"proof of 3 s among {number}"}:
                found.setdefault(key, []).append(timed(lambda m=dynamic, q=motion: prove_motion(kernel, m, q)))
            if number == 3:
                ends = np.linspace(0.0, motion.duration, PIECES + 1)
                places = np.stack([ends[:-1], ends[1:]], axis=1)
                states, moments = motion(ends), ends
                for name, call in (
                    ("blocked intervals of 256 pieces among 3",
                     lambda m=dynamic, q=motion, p=places: blocked(kernel, m, q, p, start=0.0, end=10.0)),
                    ("retiming among 3", lambda m=dynamic, q=motion: retime(kernel, m, q, limits)),
                    ("clearance of 257 states among 3",
                     lambda m=dynamic, s=states, t=moments: clearance_in_time(kernel, m, s, t, 0.1)),
                    ("update of one",
                     lambda m=dynamic: m.update("dynamic_obstacle1", (0, 0, 1), (0, 0, 0.1), stamp=0.5)),
                ):  # fmt: skip
                    found.setdefault(name, []).append(timed(call))
            moment = float(rng.uniform(0.0, motion.duration))
            state = tuple(motion(moment, order) for order in range(3))
            found.setdefault("stop, joint by joint", []).append(timed(lambda s=state: stop(limits, names, *s)))
            along = timed(lambda q=motion, t=moment: stop_along(q, t, limits))
            found.setdefault("stop along the path", []).append(along)
    return found


def main() -> None:
    """Measure, and write the results."""
    parser = record.parser(__doc__)
    parser.add_argument(
        "-n", type=one_or_more, default=10_000, help="motions and dynamic obstacles (default: %(default)s)"
    )
    parser.add_argument("--costs", type=one_or_more, default=300, help="runs of each cost (default: %(default)s)")
    args = parser.parse_args()
    checker, rng = CollisionChecker(robot()), np.random.default_rng(0)
    motions = [motion_of(checker, rng) for _ in range(MOTIONS)]
    sound = soundness(checker, motions, args.n)
    spent = {name: record.percentiles(times, 50, 99) for name, times in costs(checker, args.costs).items()}
    rows = [["motions and dynamic obstacles", *list(sound)[1:]], ["---:"] * len(sound), list(sound.values()), []]
    rows += [["what", "p50", "p99"], ["---", "---:", "---:"]]
    rows += [[name, *(f"{1e6 * v:.0f} us" for v in both)] for name, both in spent.items()]
    table = "\n".join(record.row(row) if row else "" for row in rows)
    record.write("dynamic_obstacles", {"soundness": sound, "p50 and p99 [s]": spent}, table, seed=0, n=args.n)


if __name__ == "__main__":
    run_script(main)
