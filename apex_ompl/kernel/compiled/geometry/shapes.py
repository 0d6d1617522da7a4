"""Exact shapes of bodies and obstacles as flat arrays, for distances that a sphere cover only bounds."""

from __future__ import annotations

from typing import Annotated, NamedTuple

from apex_ompl.kernel.compiled.arrays import Balls, Rotations, Spans, Vectors
from apex_ompl.kernel.compiled.compilation import inlined
from apex_ompl.kernel.compiled.layout import Floats, Integers, buffer_view, table_view

TRIANGLE = 3  # corners
POINT = -2  # and less, in ``corner``: -2 - the place of a point
HULL = 5  # kind of a convex hull of points, besides BOX ... HALF_SPACE
MOST_NODES = 512  # pairs of nodes that wait in a traversal of two trees of triangles


class ShapeArrays(NamedTuple):
    """Arrays of S shapes; those of bodies are fixed to joints, those of obstacles to the world, joint 0.

    ``kind`` is one of BOX ... HALF_SPACE or HULL, with ``size`` as in
    :class:`apex_ompl.kernel.compiled.arrays.SceneArrays`. ``rotation`` and ``offset`` place the shape's frame in the
    joint's. ``ball`` (in the joint's frame) contains the solid. Hulls have their corners in ``points``.

    A mesh that is not convex is a HULL, which bounds its distance, with the root of a binary tree of balls around its
    triangles in ``root`` (else -1). An inner node has its first child in ``child``, the second follows it; a leaf
    has -1 there, and the first of its three corners in ``corner``, or POINT less the place of a single point. A hull
    may be that of balls around points, whose radius is its ``size``. Balls of nodes are in the shape's frame, with the
    half edges of the nodes' bounding boxes around the same centers in ``node_half``. Triangles lie at most ``depth``
    below the hull [m].

    A hull of many corners has the place of its first corner in ``edge_first`` as its ``graph`` (else -1). The
    neighbors of corner k, which count from 0 as the corners do, are those from ``edge_first[graph + k]`` to
    ``edge_first[graph + k + 1]`` in ``edge_end``.

    Bodies come first, in the order of the robot's tables.
    """

    kind: Integers
    joint: Integers
    points_of: Spans
    root: Integers
    child: Integers
    corner: Integers
    graph: Integers
    edge_first: Integers
    edge_end: Integers
    rotation: Rotations
    offset: Vectors
    size: Vectors
    ball: Balls
    depth: Floats
    node_ball: Balls
    node_half: Vectors
    points: Vectors


class Corners(NamedTuple):
    """Corners of hulls and triangles, and the neighbors of those of large hulls, see :class:`ShapeArrays`."""

    points: Vectors
    edge_first: Integers
    edge_end: Integers


@inlined
def corners_of(h: ShapeArrays) -> Corners:
    """Return the corners of shapes."""
    return Corners(h.points, h.edge_first, h.edge_end)


class PairBuffers(NamedTuple):
    """Memory for the distance and the relative motion of one pair; rows 0 and 1 are its two sides.

    Attributes:
        kind: Kind of the convex piece that is examined on a side.
        first: First of its points.
        corners: Number of its points.
        graph: Place of the neighbors of its points, -1 where it has none.
        at: The point that was found last.
        nodes: Pairs of nodes that wait in a traversal.
        chain: Joints between the two sides.
        rotation: Rotations of the shapes in the world.
        origin: Origins of the shapes in the world [m].
        center: Centers of the pieces in the world, those of hulls are origins of their frames [m].
        size: Sizes of the pieces.
        normal: Unit vector from side 0 to side 1 that separates the pieces.
        simplex: Points of the difference of the pieces [m].
        ball: Centers and radii of the balls around the shapes in the world [m].
        velocity: Displacement of the center of a side's ball as seen from the other side, to first order [m].
        turn: Rotation of a side as seen from the other side, to first order.
        arc_bound: Bound on the displacement of a side's points as seen from the other side [m].
        remainder: Bound on what that displacement differs from the first order by [m].
    """

    kind: Annotated[Integers, 2]
    first: Annotated[Integers, 2]
    corners: Annotated[Integers, 2]
    graph: Annotated[Integers, 2]
    at: Annotated[Integers, 2]
    nodes: Annotated[Integers, MOST_NODES, 2]
    chain: Annotated[Integers, 256]
    rotation: Annotated[Floats, 2, 3, 3]
    origin: Annotated[Floats, 2, 3]
    center: Annotated[Floats, 2, 3]
    size: Annotated[Floats, 2, 3]
    normal: Annotated[Floats, 3]
    simplex: Annotated[Floats, 4, 3]
    ball: Annotated[Floats, 2, 4]
    velocity: Annotated[Floats, 2, 3]
    turn: Annotated[Floats, 2, 3]
    arc_bound: Annotated[Floats, 2]
    remainder: Annotated[Floats, 2]


shapes_view = table_view(ShapeArrays)
pair_view = buffer_view(PairBuffers, ())
