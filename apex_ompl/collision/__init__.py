"""Collision checking and distances of a robot in a scene."""

from apex_ompl.collision.checker import CollisionChecker
from apex_ompl.collision.hull_distance import Distance
from apex_ompl.collision.mesh_stage import Contact

__all__ = ["Contact", "Distance", "CollisionChecker"]
