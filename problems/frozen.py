"""The frozen problems: the first validation and test problems of every suite and level, each with a witness.

They are stored in ``problems/frozen``, a file per suite and level (JSON, compressed by LZMA), and are read, never drawn
again. Of ``unseen`` only validation problems are frozen. ``SHA256SUMS`` holds the hashes of the files. A witness is a
path that passed the full check; it has times where obstacles move. Its states between start and goal are stored as
multiples of 1e-4 rad. For obstacles that are meshes or points, the primitives that they are made from are stored.
"""

from __future__ import annotations

import hashlib
import json
import lzma
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apex_ompl.constraints.constraint_set import ConstraintSet
from apex_ompl.errors import FileFormatError, MissingFileError, ParameterError
from apex_ompl.paths.path import states_between
from apex_ompl.problems.broad_representation import Group, given
from apex_ompl.problems.catalogue import CONSTRAINED, LEVELS, SPLITS, VALIDATION, ProblemId
from apex_ompl.problems.objects import DATA
from apex_ompl.problems.suite_robot import ROBOT, robot
from apex_ompl.scene.bodies import Obstacle, located
from apex_ompl.scene.problem import Problem
from apex_ompl.types import Array
from apex_ompl.util.display import fields_line
from apex_ompl.util.files import write_atomically
from apex_ompl.util.schema import validate

FOLDER = Path(__file__).parent / "frozen"
SUMS = "SHA256SUMS"
SCHEMA = "apex-ompl/frozen/1"
COUNTS = {
    "validation": {"static": 30, "extreme": 20, "moving": 10, "unseen": 50, "constrained": 0, "unseen constrained": 75},
    "test": {"static": 100, "extreme": 30, "moving": 20, "unseen": 0, "constrained": 17, "unseen constrained": 0},
}  # problems of a level of each kind
FROZEN = {
    suite: (*levels, *CONSTRAINED.get(suite, ())) for suite, levels in {**LEVELS, **VALIDATION}.items()
}  # fmt: skip
BETWEEN = 0.01  # spacing of the states of a witness under constraints, between those that are stored [rad, max-norm]
STATE_STEP, TIME_STEP = 1e-4, 1e-3  # quantization of the states of witnesses [rad] and of their times [s]


@dataclass(frozen=True, eq=False)
class Witness:
    """A proof that a problem can be solved.

    Under constraints its states, and those of the straight lines between them, are moved onto the constraints, see
    :func:`on_constraints`.

    Attributes:
        path: States from start to goal, shape (N, dof).
        times: Times of the states, shape (N,) [s]; None where no obstacle moves.
    """

    path: Array
    times: Array | None = None

    __repr__ = fields_line

    def rounded(self) -> Witness:
        """Return the witness quantized as in its file."""
        path = self.path.copy()
        path[1:-1] = _quantized(path[1:-1], STATE_STEP) * STATE_STEP
        times = None if self.times is None else np.asarray(_quantized(self.times, TIME_STEP) * TIME_STEP, np.float64)
        return Witness(path, times)


@dataclass(frozen=True, eq=False)
class FrozenProblem:
    """A problem with its witness.

    Attributes:
        problem: The problem.
        witness: Its witness.
        draw_number: Number of the draw, see :func:`apex_ompl.problems.generator.draw`.
        primitives: Obstacles before some of them are given as meshes or points; None where all obstacles are
            primitives.
        groups: Obstacles that are given together.
    """

    problem: Problem
    witness: Witness
    draw_number: int
    primitives: tuple[Obstacle, ...] | None = None
    groups: tuple[Group, ...] = ()

    __repr__ = fields_line

    @property
    def digest(self) -> str:
        """The first 16 digits of the SHA-256 of the problem."""
        return digest(self.problem)


def on_constraints(problem: Problem, path: Array) -> Array | None:
    """Return the states of a witness, and further ones between them, moved onto the constraints of its problem.

    Args:
        problem: The problem.
        path: States of the witness, shape (N, dof).

    Returns:
        Shape (M, dof), ``BETWEEN`` apart before they are moved, the ends as they are; None where one cannot be moved.
    """
    constraints = ConstraintSet.of(robot(), problem.constraints, problem.attached, path[0])
    rows = [path[:1], *(np.concatenate([states_between(a, b, BETWEEN), b[None]]) for a, b in pairwise(path))]
    states = np.concatenate(rows)
    moved, arrived = constraints.project(states[1:-1])
    return np.concatenate([path[:1], moved, path[-1:]]) if arrived.all() else None


def is_frozen(problem_id: ProblemId) -> bool:
    """Whether a problem is among the frozen ones; levels with constraints are drawn until they have a file."""
    seeds = (frozen_seeds(problem_id.suite, problem_id.level, split) for split in COUNTS)
    suite, level = problem_id.suite, problem_id.level
    if level not in FROZEN.get(suite, ()) or (level in CONSTRAINED.get(suite, ()) and not exists(suite, level)):
        return False
    return any(problem_id.seed in some for some in seeds)


def frozen_seeds(suite: str, level: str, split: str) -> range:
    """Return the seeds of the frozen problems of a suite and level in a split."""
    kind = "extreme" if level == "extreme" else "moving" if level.startswith("moving-") else "static"
    if level in CONSTRAINED.get(suite, ()):
        kind = "unseen constrained" if suite in VALIDATION else "constrained"
    elif suite in VALIDATION:
        kind = "unseen"
    first = SPLITS[split].start
    return range(first, first + COUNTS[split][kind])


def load(problem_id: ProblemId) -> FrozenProblem:
    """Return a frozen problem.

    Raises:
        MissingFileError: Its file cannot be read.
        FileFormatError: The hash of its file is another one, or the file holds something else.
    """
    path = FOLDER / _name(problem_id.suite, problem_id.level)
    head, rows = _file(path, problem_id.suite, problem_id.level)
    if problem_id.seed not in rows:
        raise FileFormatError(str(path), "problems", f"none with seed {problem_id.seed}", "expected the frozen seeds")
    row, joints = rows[problem_id.seed], head["joints"]
    try:
        start, goal = (dict(zip(joints, row[key], strict=True)) for key in ("start", "goal"))
        fields = {
            "schema": "apex-ompl/problem/1", "name": str(problem_id), "robot": head["robot"], "scene": row["scene"],
            "attached": head["held"][row["held"]], "start": start, "goal": {"joints": goal},
            "constraints": head.get("constraints", ()),
        }  # fmt: skip
        inner = np.array(row["path"], float).reshape(-1, len(joints)) * STATE_STEP
        states = np.concatenate([[row["start"]], inner, [row["goal"]]])
        times = np.array(row["times"], float) * TIME_STEP if "times" in row else None
        number = int(row["draw"])
        groups = tuple(Group(*group) for group in row.get("groups", ()))
    except (KeyError, IndexError, TypeError, ValueError) as error:
        seed = f"problems, seed {problem_id.seed}"
        raise FileFormatError(str(path), seed, repr(error), "expected a problem and its witness") from error
    problem = validate(Problem, fields, f"{path}, {problem_id}")
    primitives, scene = problem.scene, given(problem.scene, groups)
    attached = tuple(located(body, DATA) for body in problem.attached)
    problem = problem.model_copy(update={"scene": scene, "attached": attached})
    return FrozenProblem(problem, Witness(states, times), number, primitives if groups else None, groups)


def load_level(suite: str, level: str) -> tuple[dict[int, FrozenProblem], int]:
    """Return the frozen problems of a suite and level by seed, and the number of draws without a witness.

    Raises:
        MissingFileError: Their file cannot be read.
        FileFormatError: The hash of the file is another one, or the file holds something else.
    """
    head, rows = _file(FOLDER / _name(suite, level), suite, level)
    return {seed: load(ProblemId(suite, level, seed)) for seed in rows}, int(head["dropped"])


def exists(suite: str, level: str) -> bool:
    """Whether the problems of a suite and level have been frozen."""
    return (FOLDER / _name(suite, level)).is_file()


def save(suite: str, level: str, frozen: Mapping[int, FrozenProblem], dropped: int, *, replace: bool = False) -> int:
    """Write the frozen problems of a suite and level, by seed, and the hash of their file.

    Args:
        suite: The suite.
        level: Its level.
        frozen: The problems by seed.
        dropped: Number of draws without a witness, which were left out.
        replace: Whether to replace a file that exists; published results refer to its problems.

    Returns:
        The size of the file in bytes.

    Raises:
        ParameterError: The file exists and ``replace`` is False.
    """
    if exists(suite, level) and not replace:
        raise ParameterError("replace", replace, f"True, since {_name(suite, level)} exists")
    joints = robot().joint_names
    held: list[Any] = []
    rows, constraints = [], list[Any]()
    for seed, item in sorted(frozen.items()):
        data = item.problem.as_dict()
        constraints = data.get("constraints", [])  # the same of all problems of a level
        attached = [_with_mesh_name(body) for body in data.get("attached", [])]
        if attached not in held:
            held.append(attached)
        start, goal = item.problem.start_state(joints), item.problem.goal_states(joints)[0]
        row: dict[str, Any] = {
            "seed": seed, "draw": item.draw_number, "held": held.index(attached), "scene": _primitives(item),
            "start": start.tolist(), "goal": goal.tolist(),
            "path": _quantized(item.witness.path[1:-1], STATE_STEP).tolist(),
        }  # fmt: skip
        if item.groups:
            row["groups"] = [list(group) for group in item.groups]
        if item.witness.times is not None:
            row["times"] = _quantized(item.witness.times, TIME_STEP).tolist()
        rows.append(row)
    head: dict[str, Any] = {
        "schema": SCHEMA, "suite": suite, "level": level, "robot": ROBOT, "joints": list(joints),
    }  # fmt: skip
    head |= {"constraints": constraints} if constraints else {}
    text = json.dumps({**head, "dropped": dropped, "held": held, "problems": rows}, separators=(",", ":"))
    content = lzma.compress(text.encode(), preset=9 | lzma.PRESET_EXTREME)
    FOLDER.mkdir(exist_ok=True)
    write_atomically(FOLDER / _name(suite, level), content)
    sums = {**_sums(), _name(suite, level): hashlib.sha256(content).hexdigest()}
    lines = [f"{sums[name]}  {name}\n" for name in sorted(sums)]
    write_atomically(FOLDER / SUMS, "".join(lines).encode())
    clear_cache()
    return len(content)


def digest(problem: Problem) -> str:
    """Return the first 16 digits of the SHA-256 of a problem; of meshes and points only the file names enter."""
    data = problem.as_dict()
    data["attached"] = [_with_mesh_name(body) for body in data.get("attached", [])]
    data.update({"scene": [_with_mesh_name(body) for body in data["scene"]]} if "scene" in data else {})
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:16]


def _primitives(item: FrozenProblem) -> list[Any]:
    """Return the obstacles of a problem as they are stored: the primitives of meshes and points."""
    primitives = item.problem.scene if item.primitives is None else item.primitives
    found: list[Any] = item.problem.model_copy(update={"scene": primitives}).as_dict().get("scene", [])
    return found


def _with_mesh_name(body: Mapping[str, Any]) -> dict[str, Any]:
    """Return a body with the file name of its mesh or its points, if it has one, in place of the path."""
    files = {key: {**body[key], "file": Path(body[key]["file"]).name} for key in ("mesh", "points") if key in body}
    return {**body, **files}


def _quantized(values: Array, step: float) -> NDArray[np.int64]:
    """Return the integers round(values / step)."""
    return np.rint(np.asarray(values) / step).astype(np.int64)


def _name(suite: str, level: str) -> str:
    return f"{suite}-{level}.json.xz"


def _sums() -> dict[str, str]:
    """Return the hashes of ``SHA256SUMS`` by file name; the format is that of ``sha256sum``.

    Raises:
        MissingFileError: The file exists and cannot be read.
        FileFormatError: A line has another format, or a name occurs twice.
    """
    path = FOLDER / SUMS
    found: dict[str, str] = {}
    for line in _content(path).decode(errors="replace").splitlines() if path.exists() else ():
        match = re.fullmatch(r"([0-9a-f]{64})  (\S+)", line)
        if match is None or match[2] in found:
            raise FileFormatError(str(path), "", line, "expected a hash, two blanks and a name, each name once")
        found[match[2]] = match[1]
    return found


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise MissingFileError(str(path), "file of frozen problems", error.strerror or str(error)) from error


@lru_cache(maxsize=8)
def _file(path: Path, suite: str, level: str) -> tuple[dict[str, Any], dict[int, dict[str, Any]]]:
    content = _content(path)
    found, wanted = hashlib.sha256(content).hexdigest(), _sums().get(path.name, "")
    if found != wanted:
        raise FileFormatError(str(path), "SHA-256", found[:16], f"expected {wanted[:16] or 'an entry in ' + SUMS}")
    try:
        data = json.loads(lzma.decompress(content))
        listed = data.pop("problems")
        rows = {row["seed"]: row for row in listed}
    except (lzma.LZMAError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise FileFormatError(str(path), "", repr(error), "expected frozen problems (JSON, LZMA)") from error
    head = {"schema": SCHEMA, "suite": suite, "level": level, "robot": ROBOT, "joints": list(robot().joint_names)}
    for field, expected in head.items():
        if data.get(field) != expected:
            raise FileFormatError(str(path), field, data.get(field), f"expected {expected!r}")
    if len(rows) != len(listed) or not isinstance(data.get("held"), list):
        raise FileFormatError(str(path), "problems", len(listed), "expected each seed once, and a list of held objects")
    return data, rows


def clear_cache() -> None:
    """Drop the cache of the files that were read."""
    _file.cache_clear()


def suite_levels() -> Sequence[tuple[str, str]]:
    """Return every suite with each of its levels; each pair has a file."""
    return [(suite, level) for suite, levels in FROZEN.items() for level in levels]
