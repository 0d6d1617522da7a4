"""APEX for OMPL: dual-arm planning with latent diffusion, real meshes and proven paths.

``plan`` solves a problem, ``plan_task`` goes on with the steps after its goal, ``run`` goes to a goal in closed loop
while obstacles move, ``load_problem`` reads a problem, ``setup`` gives OMPL's SimpleSetup of one, ``load_model`` reads
a trained model, ``time_path`` times any path, ``view`` shows results in the browser. Planners are in
``apex_ompl.planners``, ready-made problems in ``apex_ompl.problems``; docs/README.md lists the other packages with
public names.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from apex_ompl.util.lazy import lazy_names

if TYPE_CHECKING:
    from apex_ompl.api import load_problem as load_problem
    from apex_ompl.api import plan as plan
    from apex_ompl.api import plan_task as plan_task
    from apex_ompl.api import run as run
    from apex_ompl.api import setup as setup
    from apex_ompl.collision.cloud_contact import filter_points as filter_points
    from apex_ompl.errors import ApexError as ApexError
    from apex_ompl.loop.loop import Loop as Loop
    from apex_ompl.loop.result import RunResult as RunResult
    from apex_ompl.loop.sensor import Sensor as Sensor
    from apex_ompl.model.checkpoint import load_model as load_model
    from apex_ompl.moving.retime import retime as retime
    from apex_ompl.moving.settings import LoopSettings as LoopSettings
    from apex_ompl.paths.path import Path as Path
    from apex_ompl.planning.planner import MotionPlanner as MotionPlanner
    from apex_ompl.planning.query import AnyOf as AnyOf
    from apex_ompl.planning.task_result import TaskResult as TaskResult
    from apex_ompl.planning.world import World as World
    from apex_ompl.result import PlanResult as PlanResult
    from apex_ompl.result import PlanStatus as PlanStatus
    from apex_ompl.robot import Limits as Limits
    from apex_ompl.robot import Robot as Robot
    from apex_ompl.robot import load_robot as load_robot
    from apex_ompl.scene.bodies import AttachedObject as AttachedObject
    from apex_ompl.scene.bodies import Obstacle as Obstacle
    from apex_ompl.scene.points import points_from_depth as points_from_depth
    from apex_ompl.scene.problem import Alignment as Alignment
    from apex_ompl.scene.problem import PoseTarget as PoseTarget
    from apex_ompl.scene.problem import Problem as Problem
    from apex_ompl.timing import Timing as Timing
    from apex_ompl.timing import Trajectory as Trajectory
    from apex_ompl.timing import time_path as time_path
    from apex_ompl.viz.view import view as view

__version__ = "0.1.0"

__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "api": "load_problem plan plan_task run setup",
        "collision.cloud_contact": "filter_points",
        "errors": "ApexError",
        "loop.loop": "Loop",
        "loop.result": "RunResult",
        "loop.sensor": "Sensor",
        "model.checkpoint": "load_model",
        "moving.retime": "retime",
        "moving.settings": "LoopSettings",
        "paths.path": "Path",
        "planning.planner": "MotionPlanner",
        "planning.query": "AnyOf",
        "planning.task_result": "TaskResult",
        "planning.world": "World",
        "result": "PlanResult PlanStatus",
        "robot": "Limits Robot load_robot",
        "scene.bodies": "AttachedObject Obstacle",
        "scene.points": "points_from_depth",
        "scene.problem": "Alignment PoseTarget Problem",
        "timing": "Timing Trajectory time_path",
        "viz.view": "view",
    },
    ("__version__",),
)
