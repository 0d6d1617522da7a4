"""``apex-ompl run PROBLEM --driver mujoco``: a task in physics."""

from __future__ import annotations

import argparse
import json

from apex_ompl.errors import ParameterError
from apex_ompl.physics.film import FILMS, save_film
from apex_ompl.physics.result import SUFFIXES, UNPLANNED
from apex_ompl.physics.runner import TaskRunner
from apex_ompl.scene.problem import Problem
from apex_ompl.util.files import check_writable, suffix_of

SIZE = (640, 480)  # of films [pixels]


def execute(problem: Problem, parsed: argparse.Namespace) -> int:
    """Execute the task, write its log and film, print the outcome, and return the exit code."""
    for file, known in ((parsed.out, SUFFIXES), (parsed.film, FILMS)):
        if file is not None:
            suffix_of(file, known)
            check_writable(file)
    runner = TaskRunner(problem, timeout=parsed.timeout)
    result, frames = runner.run(parsed.seed, SIZE if parsed.film is not None else None)
    if parsed.out is not None:
        result.save(parsed.out)
    if parsed.film is not None:
        if not frames:
            raise ParameterError("--film", str(parsed.film), f"a task that was planned; {result.reason}")
        save_film(parsed.film, frames)
    if parsed.json:
        print(json.dumps(result.as_dict()))
    else:
        print(result)
        for check in result.checks:
            print(f"  {'yes' if check.passed else 'NO '}  {check.name}: {check.found}")
    if result.outcome == UNPLANNED:
        return 3
    return 0 if result else 1
