"""Drawing of problems by their ids: one id gives the same problem on every machine and in every process."""

from __future__ import annotations

import zlib
from functools import lru_cache

import numpy as np

from apex_ompl.errors import ApexError
from apex_ompl.goals.state_sampling import HandPoseSampler
from apex_ompl.problems import alignment, scenes
from apex_ompl.problems.broad import drawing, simple
from apex_ompl.problems.broad.levels import GRAMMARS, SUITE
from apex_ompl.problems.catalogue import ProblemId
from apex_ompl.problems.drawn_problem import MARGIN, DrawnProblem
from apex_ompl.problems.suite_robot import empty_hand_tables, robot
from apex_ompl.scene.problem import Problem

SYNERGIES = (0.0, 0.4)  # interval of the synergies of empty hands
MAX_DRAWS = 300  # for one id, before it is given up


class SuiteError(ApexError):
    """A problem of a suite that cannot be drawn."""


def draw(problem_id: ProblemId, number: int) -> DrawnProblem | None:
    """Return draw ``number`` of a problem, or None when that draw has no start or no goal."""
    level_hash = zlib.crc32(f"{problem_id.suite}/{problem_id.level}".encode())
    rng = np.random.default_rng([level_hash, problem_id.seed, number])
    if problem_id.suite in alignment.SAMPLERS:
        return alignment.draw(rng, problem_id.suite, problem_id.level)
    if problem_id.suite == SUITE and problem_id.level in simple.LEVELS:
        return simple.draw(rng, problem_id.level, SYNERGIES)
    if problem_id.suite in GRAMMARS:
        return drawing.draw(rng, problem_id.suite, problem_id.level)
    task = scenes.SUITES[problem_id.suite](rng, problem_id.level)
    poses = HandPoseSampler(empty_hand_tables(), task.scene, MARGIN)
    start = poses.sample(rng, task.start, SYNERGIES)
    goal = None if start is None else poses.sample(rng, task.goal, SYNERGIES)
    return None if start is None or goal is None else DrawnProblem(task.scene, start, goal)


@lru_cache(maxsize=64)
def _first_drawn(problem_id: ProblemId, after: int) -> tuple[int, DrawnProblem]:
    for number in range(after + 1, MAX_DRAWS):
        drawn = draw(problem_id, number)
        if drawn is not None:
            return number, drawn
    raise SuiteError(f"problem {problem_id}: none of {MAX_DRAWS} draws has a start and a goal")


def first_drawn(problem_id: ProblemId, after: int = -1) -> tuple[int, DrawnProblem]:
    """Return the number and the problem of the first draw after ``after`` that has a start and a goal, as it is drawn.

    The last ones are kept.

    Raises:
        SuiteError: None of the first ``MAX_DRAWS`` draws has.
    """
    return _first_drawn(problem_id, after)  # one spelling of the arguments, by which the cache knows them


def first_draw(problem_id: ProblemId, after: int = -1) -> tuple[int, Problem]:
    """Return the number and the problem of the first draw after ``after`` that has a start and a goal.

    Raises:
        SuiteError: None of the first ``MAX_DRAWS`` draws has.
    """
    number, drawn = first_drawn(problem_id, after)
    return number, drawn.to_problem(str(problem_id), robot())
