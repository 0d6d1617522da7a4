"""Draw the frozen validation and test problems of the suites, find a witness for each, and write their files.

Draws for which no witness is found are dropped and drawn anew. Existing problems are kept, since results refer to
them, and missing ones are added; --replace draws all again.
--mend finds new witnesses for the problems named, which stay as they are.

Witnesses among static obstacles are found by rrtconnect, and on ``extreme`` by apex, or else by rrtconnect
with a range of 0.7 rad, each in eight seconds. There they keep half a millimeter of clearance: obstacles are a
millimeter larger on each side for the planner, and the robot's own distances are looked up along its path.
Under constraints they are found by the trees of apex, in two seconds or five; their states are thinned out, as those
between are moved onto the constraints again.
On ``unseen`` apex, and else rrtconnect with its tuned range, each have ten seconds.

Usage: python scripts/freeze_problems.py [--replace] [--jobs 2] [SUITE/LEVEL ...]
       python scripts/freeze_problems.py --mend SUITE/LEVEL/SEED [SUITE/LEVEL/SEED ...]
"""

from __future__ import annotations

import argparse
import multiprocessing
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from apex_ompl.api import plan
from apex_ompl.collision import CollisionChecker
from apex_ompl.moving.timed_proof import check_timed_path, constant_velocity_times, inflated
from apex_ompl.ompl.setup import assemble
from apex_ompl.ompl.tuned import TUNED
from apex_ompl.ompl.validity import full_check
from apex_ompl.paths.path import SEARCH_RESOLUTION, states_between
from apex_ompl.problems import frozen
from apex_ompl.problems.alignment import VELOCITY_SCALE, straight_line_duration
from apex_ompl.problems.catalogue import VALIDATION, ProblemId, first_drawn
from apex_ompl.problems.frozen import FrozenProblem, Witness
from apex_ompl.problems.suite_robot import robot
from apex_ompl.scene.problem import Problem
from apex_ompl.scene.scripts import obstacle_at
from apex_ompl.types import Array
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import one_or_more

LIMITS = ((0, 10.0), (1, 20.0))  # seeds and time limits of rrtconnect [s]
FINDERS = (("apex", {}), ("rrtconnect", {"range": 0.7}))  # of witnesses on the level extreme
EXTREME_LIMIT = 8.0  # of each of them [s]
UNSEEN_FINDERS = (("apex", {}), ("rrtconnect", TUNED["rrtconnect"]))  # of witnesses of the suite unseen
UNSEEN_LIMIT = 10.0  # of each of them [s]
CONSTRAINED_LIMITS = ((0, 2.0), (1, 5.0))  # seeds and time limits of trees under constraints [s]
TREES = {"model": "none", "first": 0, "second": 0, "third": 0, "resample": 0, "line": False, "polish": False}
STRIDES = (16, 8, 4, 2, 1)  # a witness on extreme or unseen is every k-th state of a path, for the first k that will do
SCENE_GAP, OWN_GAP = 1e-3, 5e-4  # clearance of witnesses of extreme to obstacles, and of all other pairs [m]
GAP_SPACING = 0.03  # of the states at which the robot's own clearance is looked up [rad]
QUICK = 1.0  # time limit among obstacles that were stopped [s]
PACES = (VELOCITY_SCALE, 2.0 * VELOCITY_SCALE, VELOCITY_SCALE / 2.0)  # shares of the velocity limits
WAITS = (1.0, 2.0, 4.0, 8.0)  # [s]
ASIDE, HURRY = 60, 0.8  # random states to wait at, and the pace to get there


def witness(problem: Problem) -> Witness | None:
    """Return a witness for a problem, or None when none was found."""
    if problem.moving:
        return _timed_witness(problem)
    if is_constrained(problem):
        return _constrained_witness(problem)
    if problem.name.partition("/")[0] in VALIDATION:
        return _found_by(UNSEEN_FINDERS, problem, UNSEEN_LIMIT)
    return _extreme_witness(problem) if "/extreme/" in problem.name else _static_witness(problem)


def is_constrained(problem: Problem) -> bool:
    """Whether a problem of a suite has constraints, or an object in two hands."""
    return bool(problem.constraints) or any(body.links for body in problem.attached)


def _constrained_witness(problem: Problem) -> Witness | None:
    ready = assemble(problem)
    for seed, timeout in CONSTRAINED_LIMITS:
        result = plan(problem, timeout=timeout, seed=seed, params=TREES, timing=False)
        if not result or result.path is None:
            continue
        for stride in STRIDES:
            states = result.path.states
            found = Witness(np.concatenate([states[:-1:stride], states[-1:]])).rounded()
            path = frozen.on_constraints(problem, found.path)
            if path is not None and full_check(
                ready.checker, path, ready.start, ready.goals, constraints=ready.constraints
            ):
                return found
    return None


def _static_witness(problem: Problem) -> Witness | None:
    ready = assemble(problem)
    for seed, timeout in LIMITS:
        for shorter in (True, False):
            result = plan(problem, "rrtconnect", timeout=timeout, seed=seed, simplify=shorter)
            if not result or result.path is None:
                break
            found = Witness(result.path.states).rounded()
            if full_check(ready.checker, found.path, ready.start, ready.goals):
                return found
    return None


def _extreme_witness(problem: Problem) -> Witness | None:
    thicker = problem.model_copy(update={"scene": tuple(inflated(body, SCENE_GAP) for body in problem.scene)})
    return _found_by(FINDERS, thicker, EXTREME_LIMIT, lambda path: _own_clearance(problem, path) >= OWN_GAP)


def _found_by(
    finders: Sequence[tuple[str, Mapping[str, Any]]], problem: Problem, limit: float,
    is_clear: Callable[[Array], bool] = lambda _: True,
) -> Witness | None:  # fmt: skip
    """Return the first witness by one of some planners, with parameters, each with a time limit [s]."""
    ready = assemble(problem)
    for planner, params in finders:
        for shorter in (True, False):
            result = plan(problem, planner, timeout=limit, simplify=shorter, params=params, timing=False)
            if not result or result.path is None:
                break
            states = result.path.states
            for stride in STRIDES:
                found = Witness(np.concatenate([states[:-1:stride], states[-1:]])).rounded()
                if full_check(ready.checker, found.path, ready.start, ready.goals) and is_clear(found.path):
                    return found
    return None


def _own_clearance(problem: Problem, path: Array) -> float:
    """Return the least clearance along a path without the scene [m].

    Two held objects are not compared with each other: at the goal of an alignment they meet.
    """
    states = np.concatenate([path[:1], *(states_between(a, b, GAP_SPACING) for a, b in pairwise(path)), path[1:]])
    holding = [[body] for body in problem.attached] or [[]]
    checkers = [CollisionChecker(robot(), (), held) for held in holding]
    return min(checker.clearance(q) for checker in checkers for q in states)


def _timed_witness(problem: Problem) -> Witness | None:
    for path, times in _timed_paths(problem):
        found = Witness(path, times).rounded()
        assert found.times is not None
        if check_timed_path(robot(), problem, found.path, found.times):
            return found
    return None


def _timed_paths(problem: Problem) -> Iterator[tuple[Array, Array]]:
    """Yield timed paths to try: straight lines, paths around stopped obstacles, waits, and detours."""
    names = robot().joint_names
    line = np.stack([problem.start_state(names), problem.goal_states(names)[0]])
    for pace in PACES:
        yield line, constant_velocity_times(robot(), line, pace)
    lasts = straight_line_duration(line[0], line[1])
    for shares in ((0.5,), (0.25, 0.5, 0.75), (0.0, 0.25, 0.5, 0.75, 1.0), (0.0,), (1.0,), ()):
        stopped = [
            obstacle_at(obstacle, share * lasts).model_copy(update={"name": f"{obstacle.name}_{k}", "velocity": None})
            for obstacle in problem.scene
            for k, share in enumerate(shares)
        ]
        for seed in range(2):
            result = plan(problem.model_copy(update={"scene": tuple(stopped)}), "rrtconnect", timeout=QUICK, seed=seed)
            if not result or result.path is None:
                break
            for pace in PACES:
                yield result.path.states, constant_velocity_times(robot(), result.path.states, pace)
            for wait in WAITS:
                times = constant_velocity_times(robot(), result.path.states, VELOCITY_SCALE)
                yield np.concatenate([line[:1], result.path.states]), np.concatenate([[0.0], wait + times])
    yield from _ways_aside(problem, line)


def _ways_aside(problem: Problem, line: Array) -> Iterator[tuple[Array, Array]]:
    """Yield timed paths by way of random states, where they wait for the obstacles to pass."""
    some, rng = robot(), np.random.default_rng(0)
    checker = CollisionChecker(some, (), problem.attached)
    hands = some.groups["hands"]
    for k in range(ASIDE):
        via = (line[0] if k % 2 else some.home) + rng.normal(0.0, 0.5, some.dof)
        via[hands] = line[0, hands]
        via = np.clip(via, some.limits.lower, some.limits.upper)
        if checker.first_collision(np.stack([line[0], via, line[1]]), SEARCH_RESOLUTION) is not None:
            continue
        away, on = np.stack([line[0], via]), np.stack([via, line[1]])
        for wait in (0.01, *WAITS):
            first = constant_velocity_times(some, away, HURRY)
            second = first[-1] + wait + constant_velocity_times(some, on, 2.0 * VELOCITY_SCALE)
            yield np.concatenate([away, on]), np.concatenate([first, second])


def seeds(level: tuple[str, str]) -> set[int]:
    """Return the seeds of the problems of a suite and level that are to be frozen."""
    return {seed for split in frozen.COUNTS for seed in frozen.frozen_seeds(*level, split)}


def is_complete(level: tuple[str, str]) -> bool:
    """Whether all problems of a suite and level are frozen."""
    return frozen.exists(*level) and set(frozen.load_level(*level)[0]) == seeds(level)


def freeze(level: tuple[str, str], anew: bool) -> tuple[dict[int, FrozenProblem], int, float]:
    """Return the frozen problems of a level by seed, the number of draws without a witness, and the time taken.

    Those that exist are kept, unless all are to be drawn anew.
    """
    begin, kept = time.perf_counter(), frozen.exists(*level) and not anew
    found, dropped = frozen.load_level(*level) if kept else ({}, 0)
    for seed in sorted(seeds(level) - set(found)):
        found[seed], failures = freeze_problem(ProblemId(*level, seed))
        dropped += failures
    return found, dropped, time.perf_counter() - begin


def freeze_problem(problem_id: ProblemId) -> tuple[FrozenProblem, int]:
    """Return the first draw of a problem with a witness, and the number of draws before it."""
    number, dropped = -1, 0
    while True:
        number, drawn = first_drawn(problem_id, number)
        problem = drawn.to_problem(str(problem_id), robot())
        proof = witness(problem)
        if proof is not None:
            primitives = drawn.scene if drawn.groups else None
            return FrozenProblem(problem, proof, number, primitives, drawn.groups), dropped
        dropped += 1


def mend(names: Sequence[str]) -> bool:
    """Find new witnesses for frozen problems and write them; return whether all have one."""
    wanted: dict[tuple[str, str], list[ProblemId]] = {}
    for name in names:
        one = ProblemId.parse(name)
        if one is None or not frozen.is_frozen(one):
            raise SystemExit(f"{name!r} is not a frozen problem; expected SUITE/LEVEL/SEED")
        wanted.setdefault((one.suite, one.level), []).append(one)
    complete = True
    for (suite, level), ids in wanted.items():
        kept, dropped = frozen.load_level(suite, level)
        for one in ids:
            found = witness(kept[one.seed].problem)
            print(f"{one}: {'a new witness' if found else 'no witness found'}", flush=True)
            complete &= found is not None
            if found is not None:
                kept[one.seed] = replace(kept[one.seed], witness=found)
        frozen.save(suite, level, kept, dropped, replace=True)
    return complete


def main() -> None:
    """Freeze the levels named, or all that are missing."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("levels", nargs="*", metavar="SUITE/LEVEL")
    parser.add_argument("--replace", action="store_true", help="draw existing problems again, too")
    parser.add_argument("--mend", action="store_true", help="find new witnesses for the named problems")
    parser.add_argument("--jobs", type=one_or_more, default=2)
    args = parser.parse_args()
    if args.mend:
        raise SystemExit(0 if mend(args.levels) else 1)
    every = {f"{suite}/{level}": (suite, level) for suite, level in frozen.suite_levels()}
    for name in args.levels:
        if name not in every:
            raise SystemExit(f"unknown level {name!r}; known: {', '.join(every)}")
    wanted = [every[name] for name in args.levels or every]
    todo = [pair for pair in wanted if args.replace or not is_complete(pair)]
    todo.sort(key=lambda pair: pair[1] not in ("extreme", "hard", "medium"))  # the slowest levels first
    failed = 0
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(args.jobs, mp_context=context) as pool:
        jobs = {pool.submit(freeze, pair, args.replace): pair for pair in todo}
        for job in as_completed(jobs):
            name = "/".join(jobs[job])
            try:
                found, dropped, spent = job.result()
                size = frozen.save(*jobs[job], found, dropped, replace=True)
            except Exception as error:  # the other levels go on
                failed += 1
                print(f"{name}: {error!r}", flush=True)
                continue
            summary = f"{len(found)} problems, {dropped} draws without a witness, {size} bytes, {spent:.0f} s"
            print(f"{name}: {summary}", flush=True)
    raise SystemExit(1 if failed else 0)


if __name__ == "__main__":
    run_script(main)
