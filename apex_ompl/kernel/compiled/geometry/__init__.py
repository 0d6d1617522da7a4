"""Distances between shapes, without a robot: primitives, grids, triangles, convex pieces, clouds and trees."""
