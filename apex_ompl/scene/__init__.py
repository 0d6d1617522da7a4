"""Planning problems and their files: bodies, meshes, points, start and goal."""

from apex_ompl.scene.points import points_from_depth

__all__ = ["points_from_depth"]
