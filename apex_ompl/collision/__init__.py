"""Collision: the verdict over Coal's meshes, distances by GJK, shapes, containment."""

from apex_ompl.collision.broadphase import Contact
from apex_ompl.collision.distance import Distance
from apex_ompl.collision.verdict import Verdict

__all__ = ["Contact", "Distance", "Verdict"]
