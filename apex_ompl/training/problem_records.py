"""Records of problems: as data sets hold them, and as tables of the kernel."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from apex_ompl import problems
from apex_ompl.collision.shapes import held_extent
from apex_ompl.errors import UnknownNameError
from apex_ompl.model.geometry import SHAPES, ObstacleRecord
from apex_ompl.ompl.process import quiet_ompl
from apex_ompl.ompl.setup import assemble
from apex_ompl.problems.broad_representation import part_of
from apex_ompl.problems.generator import SuiteError
from apex_ompl.problems.suite_robot import robot
from apex_ompl.scene.bodies import AttachedObject, Obstacle
from apex_ompl.scene.problem import Problem
from apex_ompl.training.engine import ProblemRecord
from apex_ompl.training.kernel_problems import KernelProblem
from apex_ompl.training.units import Unit


def kernel_problems(unit: Unit) -> list[KernelProblem]:
    """Return the problems of a unit as tables of the kernel, for machines without Pinocchio, Coal and OMPL.

    There obstacles are primitives, which contain the meshes and the points that a problem has.
    """
    found = []
    with quiet_ompl():
        for seed in unit.seeds:
            try:
                problem = problems.load(f"{unit.suite}/{unit.level}/{seed}")
            except SuiteError:
                continue
            scene = problems.primitives(problem, enclosing=True)
            setup = assemble(problem.model_copy(update={"scene": scene}), robot())
            kernel, start, goal = setup.checker.kernel, setup.start, setup.goals[0]
            points = np.stack([setup.checker.obstacle_point(start), setup.checker.obstacle_point(goal)])
            names, record = (unit.name, unit.suite, unit.level, unit.strategy), problem_record(problem, seed)
            found.append(KernelProblem(*names, record, kernel.robot, kernel.scene, start, goal, points))
    return found


def problem_record(problem: Problem, seed: int) -> ProblemRecord:
    """Return the record of a problem in a data set: its obstacles as primitives, whatever they are given as.

    The primitives contain the meshes and the balls around points. Held meshes are named by their files, without
    folders; each held object has its ``extent``, see :func:`apex_ompl.collision.shapes.held_extent`.
    """
    scene = problems.primitives(problem, enclosing=True)
    return ProblemRecord(seed, held_text(problem.attached), [_obstacle_record(obstacle) for obstacle in scene])


def held_text(attached: Sequence[AttachedObject]) -> str:
    """Return held objects as JSON, as data sets store them."""
    bodies = [h.model_dump(mode="json", exclude_defaults=True) for h in attached]
    for body, held in zip(bodies, attached, strict=True):
        if "mesh" in body:
            body["mesh"]["file"] = Path(body["mesh"]["file"]).name
        body["extent"] = np.round(held_extent(held), 4).tolist()
    return json.dumps(bodies)


def _obstacle_record(obstacle: Obstacle) -> ObstacleRecord:
    """Return shape index, position, orientation and size of an obstacle.

    Raises:
        UnknownNameError: The obstacle is a mesh or a half-space.
    """
    if obstacle.shape not in SHAPES:
        raise UnknownNameError("shape of an obstacle in a data set", obstacle.shape, SHAPES)
    part = part_of(obstacle)
    return part.kind, obstacle.position, obstacle.orientation, part.size
