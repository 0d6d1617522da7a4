"""A planner that is kept between plans, and the world that it plans in."""

from apex_ompl.session.planner import MotionPlanner, StateCheck, check_arguments
from apex_ompl.session.pool import kept_planner
from apex_ompl.session.world import World

__all__ = ["MotionPlanner", "StateCheck", "World", "check_arguments", "kept_planner"]
