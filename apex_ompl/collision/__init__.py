"""Collision: the checker over Coal's meshes, distances by GJK, shapes, containment."""

from apex_ompl.collision.broadphase import Contact
from apex_ompl.collision.checker import CollisionChecker
from apex_ompl.collision.distance import Distance

__all__ = ["Contact", "Distance", "CollisionChecker"]
