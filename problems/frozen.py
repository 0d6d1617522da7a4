"""The frozen problems: the first validation and test problems of every suite and level, each with a witness.

They lie in ``problems/frozen``, a file per suite and level (JSON, compressed by LZMA), and are what counts: nothing
draws them again. ``SHA256SUMS`` holds the hashes of the files. A witness is a path that passed the full check; for
levels with moving obstacles it is a timed one. Its states between start and goal are stored in ten-thousandths of a
radian.
"""

from __future__ import annotations

import hashlib
import json
import lzma
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apex_ompl.errors import FileFormatError, MissingFileError
from apex_ompl.problem import Problem, located
from apex_ompl.problems.catalogue import LEVELS, SPLITS, ProblemId
from apex_ompl.problems.objects import DATA
from apex_ompl.problems.reach import ROBOT, robot
from apex_ompl.schema import validate, write_atomically

Array = NDArray[np.float64]

FOLDER = Path(__file__).parent / "frozen"
SUMS = "SHA256SUMS"
SCHEMA = "apex-ompl/frozen/1"
COUNTS = {"validation": (30, 10), "test": (100, 20)}  # of static levels, and of moving ones
GRAIN, TICK = 1e-4, 1e-3  # of the states of witnesses [rad], and of their times [s]


@dataclass(frozen=True, eq=False)
class Witness:
    """A proof that a problem can be solved.

    Attributes:
        path: States from start to goal, shape (N, dof).
        times: When they are passed, shape (N,) [s]; None where nothing moves.
    """

    path: Array
    times: Array | None = None

    def rounded(self) -> Witness:
        """Return the witness as its file will hold it."""
        path = self.path.copy()
        path[1:-1] = _counts(path[1:-1], GRAIN) * GRAIN
        return Witness(path, None if self.times is None else _ticks(self.times))


@dataclass(frozen=True, eq=False)
class Frozen:
    """A frozen problem.

    Attributes:
        problem: The problem.
        witness: Its witness.
        number: Which draw of its seed it is.
        digest: The first 16 digits of the SHA-256 of the problem.
    """

    problem: Problem
    witness: Witness
    number: int

    @property
    def digest(self) -> str:
        """The first 16 digits of the SHA-256 of the problem."""
        return digest(self.problem)


def is_frozen(which: ProblemId) -> bool:
    """Whether a problem is among the frozen ones."""
    return any(which.seed in frozen_seeds(which.level, split) for split in COUNTS)


def frozen_seeds(level: str, split: str) -> range:
    """Return the seeds of the frozen problems of a level in a split."""
    first, count = SPLITS[split].start, COUNTS[split][level.startswith("moving-")]
    return range(first, first + count)


def load(which: ProblemId) -> Frozen:
    """Return a frozen problem.

    Raises:
        MissingFileError: Its file is missing.
        FileFormatError: Its file is not the one that was frozen.
    """
    head, rows = _file(which.suite, which.level)
    if which.seed not in rows:
        raise FileFormatError(_name(which.suite, which.level), "problems", which.seed, "expected the frozen seeds")
    row, joints = rows[which.seed], head["joints"]
    held = [{**body} for body in head["held"][row["held"]]]
    start, goal = (dict(zip(joints, row[key], strict=True)) for key in ("start", "goal"))
    fields = {
        "schema": "apex-ompl/problem/1", "name": str(which), "robot": head["robot"], "scene": row["scene"],
        "attached": held, "start": start, "goal": {"joints": goal},
    }  # fmt: skip
    problem = validate(Problem, fields, str(which))
    problem = problem.model_copy(update={"attached": tuple(located(body, DATA) for body in problem.attached)})
    inner = np.array(row["path"], float).reshape(-1, len(joints)) * GRAIN
    path = np.concatenate([[row["start"]], inner, [row["goal"]]])
    times = np.array(row["times"], float) * TICK if "times" in row else None
    return Frozen(problem, Witness(path, times), row["draw"])


def exists(suite: str, level: str) -> bool:
    """Whether the problems of a suite and level have been frozen."""
    return (FOLDER / _name(suite, level)).is_file()


def save(suite: str, level: str, frozen: Mapping[int, Frozen], dropped: int) -> int:
    """Write the frozen problems of a suite and level, by seed, and the hash of their file.

    Args:
        suite: The suite.
        level: Its level.
        frozen: The problems.
        dropped: How many draws were left out because no witness was found.

    Returns:
        The size of the file in bytes.
    """
    some = robot()
    held: list[Any] = []
    rows = []
    for seed, item in sorted(frozen.items()):
        data = item.problem.as_dict()
        mine = [_with_short_mesh(body) for body in data.get("attached", [])]
        if mine not in held:
            held.append(mine)
        start, goal = item.problem.start_state(some.joint_names), item.problem.goal_states(some.joint_names)[0]
        row: dict[str, Any] = {
            "seed": seed, "draw": item.number, "held": held.index(mine), "scene": data.get("scene", []),
            "start": start.tolist(), "goal": goal.tolist(), "path": _counts(item.witness.path[1:-1], GRAIN).tolist(),
        }  # fmt: skip
        if item.witness.times is not None:
            row["times"] = _counts(item.witness.times, TICK).tolist()
        rows.append(row)
    head = {"schema": SCHEMA, "suite": suite, "level": level, "robot": ROBOT, "joints": list(some.joint_names)}
    text = json.dumps({**head, "dropped": dropped, "held": held, "problems": rows}, separators=(",", ":"))
    content = lzma.compress(text.encode(), preset=9 | lzma.PRESET_EXTREME)
    FOLDER.mkdir(exist_ok=True)
    write_atomically(FOLDER / _name(suite, level), content)
    sums = {**_sums(), _name(suite, level): hashlib.sha256(content).hexdigest()}
    lines = [f"{sums[name]}  {name}\n" for name in sorted(sums)]
    write_atomically(FOLDER / SUMS, "".join(lines).encode())
    forget()
    return len(content)


def digest(problem: Problem) -> str:
    """Return the first 16 digits of the SHA-256 of a problem, its meshes by their names alone."""
    data = problem.as_dict()
    data["attached"] = [_with_short_mesh(body) for body in data.get("attached", [])]
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:16]


def _with_short_mesh(body: Mapping[str, Any]) -> dict[str, Any]:
    """Return a held object whose mesh, if it has one, is named from the folder of the ready-made problems."""
    if "mesh" not in body:
        return dict(body)
    return {**body, "mesh": {**body["mesh"], "file": Path(body["mesh"]["file"]).name}}


def _counts(values: Array, unit: float) -> NDArray[np.int64]:
    return np.rint(np.asarray(values) / unit).astype(np.int64)


def _ticks(times: Array) -> Array:
    return np.asarray(_counts(times, TICK) * TICK, dtype=np.float64)


def _name(suite: str, level: str) -> str:
    return f"{suite}-{level}.json.xz"


def _sums() -> dict[str, str]:
    path = FOLDER / SUMS
    if not path.is_file():
        return {}
    pairs = (line.split() for line in path.read_text().splitlines())
    return {name: value for value, name in pairs}


@lru_cache(maxsize=8)
def _file(suite: str, level: str) -> tuple[dict[str, Any], dict[int, dict[str, Any]]]:
    path = FOLDER / _name(suite, level)
    if not path.is_file():
        raise MissingFileError(str(path), "file of frozen problems")
    content = path.read_bytes()
    found, wanted = hashlib.sha256(content).hexdigest(), _sums().get(path.name, "")
    if found != wanted:
        raise FileFormatError(str(path), "SHA-256", found[:16], f"expected {wanted[:16] or 'an entry in ' + SUMS}")
    data = json.loads(lzma.decompress(content))
    rows = {row["seed"]: row for row in data.pop("problems")}
    return data, rows


def forget() -> None:
    """Forget the files that were read."""
    _file.cache_clear()


def files() -> Sequence[tuple[str, str]]:
    """Return every suite and level."""
    return [(suite, level) for suite, levels in LEVELS.items() for level in levels]
