"""Records: what is wrong with their values is one sentence of this package's, whichever way they are made."""

from __future__ import annotations

import copy
import pickle
import pkgutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib import import_module
from typing import Any

import pytest
from pydantic import ValidationError

import apex_ompl
from apex_ompl import Alignment, PoseTarget, Problem
from apex_ompl.errors import FileFormatError
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Goal
from apex_ompl.util.schema import StrictModel

POSE = {"frame": "left_hand_palm", "position": (0.4, 0.4, 0.4)}
FAULTS: dict[str, tuple[Callable[[], Any], str]] = {
    "not a unit quaternion": (
        lambda: PoseTarget(**POSE, orientation=(0, 0, 0, 2)),
        "PoseTarget: orientation: expected a unit quaternion [x, y, z, w], got (0, 0, 0, 2)",
    ),
    "not finite": (
        lambda: PoseTarget(frame="palm", position=(0, 0, float("nan"))),
        "PoseTarget: position.2: input should be a finite number, got nan",
    ),
    "inside": (
        lambda: PoseTarget(**POSE, tolerance={"position": 0}),
        "PoseTarget: tolerance.position: input should be greater than 0, got 0",
    ),
    "two levels deep": (
        lambda: Goal(poses=({**POSE, "tolerance": {"angl": 1.0}},)),
        "Goal: poses.0.tolerance.angl: unknown key, did you mean 'angle'?, got 'angl'",
    ),
    "two values that do not fit": (
        lambda: Alignment(kind="pour", first="a", second="a"),
        "Alignment: first and second are the same, got {'kind': 'pour', 'first': 'a', 'second': 'a'}",
    ),
    "missing": (lambda: Problem(name="a"), "Problem: robot: required key is missing, got ['name']"),
    "too large for a float": (
        lambda: Obstacle(name="a", sphere={"radius": 10**400}),
        "Obstacle: sphere.radius: input should be a valid number, got 1000",
    ),
    "too large for a text": (
        lambda: Obstacle(name="a", sphere={"radius": 10**5000}),
        "Obstacle: sphere.radius: input should be a valid number, got <int object",
    ),
    "plain data": (lambda: Goal.model_validate({"joints": []}), "Goal: joints: expected 1 item or more, got []"),
    "json": (lambda: Goal.model_validate_json("{"), "Goal: invalid JSON: "),
    "a change": (
        lambda: setattr(PoseTarget(**POSE), "frame", "b"),
        "PoseTarget: frame: records do not change, expected a new one",
    ),
}


@pytest.mark.parametrize("case", FAULTS)
def test_a_fault_is_one_sentence_with_class_field_and_value(case: str) -> None:
    make, sentence = FAULTS[case]
    with pytest.raises(FileFormatError) as caught:
        make()
    assert str(caught.value).startswith(sentence) and "\n" not in str(caught.value)
    assert isinstance(caught.value.__cause__, ValidationError)


def records() -> Iterator[type[StrictModel]]:
    for module in pkgutil.walk_packages(apex_ompl.__path__, "apex_ompl."):
        if not module.name.startswith(("apex_ompl.cli.__main__", "apex_ompl.viz", "apex_ompl.evaluation")):
            import_module(module.name)
    left = [StrictModel]
    while left:
        found = left.pop().__subclasses__()
        yield from found
        left += found


def test_no_record_of_the_package_raises_an_error_of_another() -> None:
    found = set(records())
    assert len(found) > 30 and {PoseTarget, Alignment, Problem, Obstacle, Goal} <= found
    for record in found:
        with pytest.raises(FileFormatError, match=f"^{record.__name__}: nothing: unknown key, "):
            record(nothing=1)


def test_records_are_copied_and_pickled() -> None:
    goal = Goal(poses=(PoseTarget(**POSE, tolerance={"angle": 0.1}),))
    for same in (pickle.loads(pickle.dumps(goal)), copy.deepcopy(goal), copy.copy(goal), goal.model_copy()):
        assert same == goal and type(same.poses[0]) is PoseTarget


FIRST_USES = """
import os, sys, threading
sys.setswitchinterval(1e-6)
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Problem
faults, begin = [], threading.Barrier(9)

def use():
    begin.wait()
    try:
        Obstacle(name="a", box=(1.0, 1.0, 1.0)).model_dump_json()
        Obstacle.model_validate({"name": "b", "sphere": {"radius": 1.0}}).sphere.model_dump()
        Problem.model_json_schema(by_alias=True)
    except BaseException as error:
        faults.append(error)

threads = [threading.Thread(target=use) for _ in range(8)]
for thread in threads: thread.start()
begin.wait()
child = os.fork()
if not child:
    Problem.model_json_schema(by_alias=True)
    os._exit(0)
for thread in threads: thread.join()
print(os.waitpid(child, 0)[1], faults)
"""


def test_records_are_built_at_their_first_use_by_many_threads_and_in_a_child() -> None:
    command = [sys.executable, "-W", "ignore", "-c", FIRST_USES]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=60)
    assert done.stdout == "0 []\n", done.stdout + done.stderr
