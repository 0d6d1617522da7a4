"""Ready-made problems by name, and benchmark suites of generated problems.

The id of a problem of a suite is ``suite/level/seed``, for example ``shelf/hard/900012``. Seeds 0 to 799 999 are for
training, 800 000 to 899 999 for validation, 900 000 to 999 999 for tests.

- ``catalogue``: suites, levels, splits and ids; ``generator`` draws a problem by its id.
- ``scenes``, ``alignment``, ``broad``: the generators of the suites; ``objects``: their obstacles and held objects.
  ``broad`` is for training alone, and ``unseen``, which it draws too, for validation alone.
- ``broad_parts``: parts of scenes and their algebra; ``broad_furniture``, ``broad_structures``, ``broad_unseen``: the
  grammars; ``broad_tasks``, ``broad_representation``: held objects, ends, difficulty, and how a scene is given.
- ``constrained``: levels with constraints along the path, ``shelf/tray/900012``; ``constrained_held``,
  ``constrained_scenes``, ``constrained_ends``: trays and cups, scenes for trays, starts and goals.
- ``frozen``: the stored problems of validation and test, with their witnesses.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from apex_ompl.errors import ParameterError, UnknownNameError
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Problem
from apex_ompl.util.validation import check_name

if TYPE_CHECKING:
    from apex_ompl.problems.frozen import Witness

DATA = Path(__file__).parent / "data"
ID = re.compile(r"([A-Za-z_]+)/([A-Za-z0-9_.-]+)/(0|[1-9][0-9]{0,19})")  # suite, level and seed


def names() -> tuple[str, ...]:
    """Names of the ready-made problems."""
    return tuple(sorted(path.stem for path in DATA.glob("*.yaml")))


def suites() -> Mapping[str, tuple[str, ...]]:
    """Return the suites, each with its levels."""
    from apex_ompl.problems.catalogue import LEVELS

    return dict(LEVELS)


def load(name: str) -> Problem:
    """Return a ready-made problem, or one of a suite by its id, for example ``shelf/hard/900012``.

    Raises:
        UnknownNameError: No such problem; the message lists the known ones.
        ParameterError: The seed is not from 0 to 999 999.
        SuiteError: No problem can be drawn for that seed.
        MissingFileError: The file of a frozen problem cannot be read.
        FileFormatError: The hash or the content of the file of a frozen problem is wrong.
    """
    if is_id(name):
        suite, level, seed = name.split("/")
        return sample(suite, level=level, seed=int(seed))
    if name not in names():
        raise UnknownNameError("problem", name, names())
    return Problem.load(DATA / f"{name}.yaml")


def is_id(text: str) -> bool:
    """Whether a text has the form of an id of a problem of a suite."""
    return ID.fullmatch(text) is not None


def sample(suite: str, *, level: str, seed: int) -> Problem:
    """Return a problem of a suite; the same seed gives the same problem.

    Start and goal are free by a margin of 1 cm; two held objects that are aligned at the goal may be closer there. A
    moving obstacle keeps clear of the start at time 0, and of the goal at the time when the straight line ends there at
    a quarter of the velocity limits; at earlier times it may overlap the goal. Frozen problems, the first problems of
    validation and test, are read from files and have a witness; others are drawn, and may have no solution.

    Args:
        suite: See :func:`suites`.
        level: One of its levels.
        seed: 0 to 999 999.

    Raises:
        UnknownNameError: No such suite or level.
        ParameterError: The seed is not from 0 to 999 999.
        SuiteError: No problem can be drawn for that seed.
        MissingFileError: The file of a frozen problem cannot be read.
        FileFormatError: The hash or the content of the file of a frozen problem is wrong.
    """
    from apex_ompl.problems import frozen
    from apex_ompl.problems.catalogue import ProblemId, first_draw

    problem_id = ProblemId(suite, level, seed)
    return frozen.load(problem_id).problem if frozen.is_frozen(problem_id) else first_draw(problem_id)[1]


def primitives(problem: Problem, *, enclosing: bool = False) -> tuple[Obstacle, ...]:
    """Return the obstacles of a problem as primitives, from which meshes and points of a suite were made.

    They are the obstacles of the problem itself, unless its name is an id of ``broad`` or ``unseen``. There they
    contain the meshes, and are thinner than the balls around points by their radius.

    Args:
        problem: The problem.
        enclosing: Whether primitives of points are enlarged, so that they contain the balls.

    Raises:
        SuiteError: No problem can be drawn for that seed.
        MissingFileError: The file of a frozen problem cannot be read.
        FileFormatError: The hash or the content of the file of a frozen problem is wrong.
    """
    from apex_ompl.problems import frozen
    from apex_ompl.problems.broad import LEVELS
    from apex_ompl.problems.broad_representation import swollen
    from apex_ompl.problems.catalogue import ProblemId, first_drawn

    problem_id = ProblemId.parse(problem.name) if is_id(problem.name) else None
    if problem_id is None or problem_id.suite not in LEVELS:
        return problem.scene
    if frozen.is_frozen(problem_id):
        kept = frozen.load(problem_id)
        scene, groups = kept.problem.scene if kept.primitives is None else kept.primitives, kept.groups
    else:
        drawn = first_drawn(problem_id)[1]
        scene, groups = drawn.scene, drawn.groups
    return swollen(scene, groups) if enclosing else scene


def frozen_names(suite: str, level: str, split: str = "test") -> tuple[str, ...]:
    """Return the ids of the frozen problems of a suite and level, of the split ``validation`` or ``test``.

    Raises:
        UnknownNameError: No such suite, level or split.
    """
    from apex_ompl.problems import frozen
    from apex_ompl.problems.catalogue import SPLITS, ProblemId

    ProblemId(suite, level, SPLITS["validation"].start)
    check_name(split, "split with frozen problems", frozen.COUNTS)
    return tuple(f"{suite}/{level}/{seed}" for seed in frozen.frozen_seeds(suite, level, split))


def witness(name: str) -> Witness:
    """Return the witness of a frozen problem: a path that passed the full check.

    Raises:
        ParameterError: The problem is not a frozen one.
        MissingFileError: Its file cannot be read.
        FileFormatError: The hash or the content of its file is wrong.
    """
    from apex_ompl.problems import frozen
    from apex_ompl.problems.catalogue import ProblemId

    problem_id = ProblemId.parse(name)
    if problem_id is None or not frozen.is_frozen(problem_id):
        raise ParameterError("problem", name, "a frozen problem of a suite")
    return frozen.load(problem_id).witness


__all__ = ["frozen_names", "is_id", "load", "names", "primitives", "sample", "suites", "witness"]
