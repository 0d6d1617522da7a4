"""Collision checking and distances of a robot in a scene."""

from apex_ompl.collision.checker import CollisionChecker
from apex_ompl.collision.mesh_stage import Contact
from apex_ompl.collision.solids import Distance

__all__ = ["Contact", "Distance", "CollisionChecker"]
