"""APEX for OMPL: dual-arm planning with latent diffusion, real meshes and proven paths.

``plan`` solves a problem, ``run`` goes to a goal in closed loop while obstacles move, ``load_problem`` reads a problem,
``setup`` gives OMPL's SimpleSetup of one, ``load_model`` reads a trained model, ``time_path`` times any path, ``view``
shows results in the browser. Planners are in ``apex_ompl.planners``, ready-made problems in ``apex_ompl.problems``;
docs/README.md lists the other packages with public names.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from apex_ompl.util.lazy import lazy_names

if TYPE_CHECKING:
    from apex_ompl.api import load_problem, plan, run, setup
    from apex_ompl.collision.cloud_contact import filter_points
    from apex_ompl.errors import ApexError
    from apex_ompl.loop.result import RunResult
    from apex_ompl.loop.sensor import Sensor
    from apex_ompl.model.checkpoint import load_model
    from apex_ompl.moving.retime import retime
    from apex_ompl.moving.settings import LoopSettings
    from apex_ompl.paths.path import Path
    from apex_ompl.planning.planner import MotionPlanner
    from apex_ompl.planning.world import World
    from apex_ompl.result import PlanResult, PlanStatus
    from apex_ompl.robot import Limits, Robot, load_robot
    from apex_ompl.scene.bodies import AttachedObject, Obstacle
    from apex_ompl.scene.points import points_from_depth
    from apex_ompl.scene.problem import Alignment, PoseTarget, Problem
    from apex_ompl.timing import Timing, Trajectory, time_path
    from apex_ompl.viz.view import view

__version__ = "0.1.0"

_HOMES = {  # modules that public names are imported from when they are first used
    "Alignment": "scene.problem",
    "ApexError": "errors",
    "AttachedObject": "scene.bodies",
    "Limits": "robot",
    "LoopSettings": "moving.settings",
    "MotionPlanner": "planning.planner",
    "Obstacle": "scene.bodies",
    "Path": "paths.path",
    "PlanResult": "result",
    "PlanStatus": "result",
    "PoseTarget": "scene.problem",
    "Problem": "scene.problem",
    "Robot": "robot",
    "RunResult": "loop.result",
    "Sensor": "loop.sensor",
    "Timing": "timing",
    "Trajectory": "timing",
    "World": "planning.world",
    "filter_points": "collision.cloud_contact",
    "load_model": "model.checkpoint",
    "load_problem": "api",
    "load_robot": "robot",
    "plan": "api",
    "points_from_depth": "scene.points",
    "retime": "moving.retime",
    "run": "api",
    "setup": "api",
    "time_path": "timing",
    "view": "viz.view",
}

__all__ = [
    "Alignment",
    "ApexError",
    "AttachedObject",
    "Limits",
    "LoopSettings",
    "MotionPlanner",
    "Obstacle",
    "Path",
    "PlanResult",
    "PlanStatus",
    "PoseTarget",
    "Problem",
    "Robot",
    "RunResult",
    "Sensor",
    "Timing",
    "Trajectory",
    "World",
    "filter_points",
    "load_model",
    "load_problem",
    "load_robot",
    "plan",
    "points_from_depth",
    "retime",
    "run",
    "setup",
    "time_path",
    "view",
]


__getattr__, __dir__ = lazy_names(__name__, _HOMES, ("__version__",))
