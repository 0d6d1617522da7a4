"""Planning: a planner that is kept with its world, and the five steps of a plan, each for itself.

``assemble -> check -> solve -> prove -> time``; see :mod:`apex_ompl.planning.steps`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from apex_ompl.util.lazy import lazy_names

if TYPE_CHECKING:
    from apex_ompl.planning.checks import ProofResult as ProofResult
    from apex_ompl.planning.checks import StateCheck as StateCheck
    from apex_ompl.planning.inverse_kinematics import IKResult as IKResult
    from apex_ompl.planning.inverse_kinematics import IKSolution as IKSolution
    from apex_ompl.planning.planner import MotionPlanner as MotionPlanner
    from apex_ompl.planning.query import GoalSampler as GoalSampler
    from apex_ompl.planning.schedule_records import ArmStep as ArmStep
    from apex_ompl.planning.schedule_records import Schedule as Schedule
    from apex_ompl.planning.schedules import replaced as replaced
    from apex_ompl.planning.schedules import schedule as schedule
    from apex_ompl.planning.step_records import FoundPath as FoundPath
    from apex_ompl.planning.step_records import PlanQuery as PlanQuery
    from apex_ompl.planning.step_records import ProvedPath as ProvedPath
    from apex_ompl.planning.steps import assemble as assemble
    from apex_ompl.planning.steps import check as check
    from apex_ompl.planning.steps import prove as prove
    from apex_ompl.planning.steps import solve as solve
    from apex_ompl.planning.steps import time as time
    from apex_ompl.planning.tasks import TaskSearch as TaskSearch
    from apex_ompl.planning.world import World as World

__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "checks": "ProofResult StateCheck",
        "inverse_kinematics": "IKResult IKSolution",
        "planner": "MotionPlanner",
        "query": "GoalSampler",
        "schedule_records": "ArmStep Schedule",
        "schedules": "replaced schedule",
        "step_records": "FoundPath PlanQuery ProvedPath",
        "steps": "assemble check prove solve time",
        "tasks": "TaskSearch",
        "world": "World",
    },
)
