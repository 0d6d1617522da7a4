"""Robot and scene as flat arrays, the only form in which compiled code knows them; without Pinocchio.

A robot is a tree of joints. Bodies are fixed to joints and covered by trees of spheres (:mod:`apex_ompl.collision`
makes them and proves that they contain the solids). Bodies that move together, or nearly so (a hand with its fingers),
form a cluster inside one ball, which is tested first. Every joint frame is rotated so that its axis is z.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

from apex_ompl.kernel.compiled.layout import Floats, Integers, Singles, table_view

FIXED, REVOLUTE, PRISMATIC = 0, 1, 2
BOX, SPHERE, CYLINDER, CAPSULE, HALF_SPACE = range(5)
GRID_ROW = 8  # numbers of a grid's row
GRID = 6  # of distances; 5 is a hull, among the exact shapes
RUN = 8  # pairs that are examined together
BINS = 16  # ranges of values of a joint that drives inner ones which have balls of their own
LIMIT_SLACK = 1e-9  # by which clusters' balls hold beyond the limits: motions are bounded with rounding [rad]

Pairs = Annotated[Integers, 2]
Spans = Annotated[Integers, 2]  # first and number
Vectors = Annotated[Floats, 3]
Rotations = Annotated[Floats, 3, 3]
Balls = Annotated[Floats, 4]  # center and radius


class RobotArrays(NamedTuple):
    """Arrays of a robot: J joints (0 is the world), C clusters, B bodies, N spheres, P pairs of clusters, Q parts.

    Joints come after their parents. ``joint_rotation`` and ``joint_offset`` place a joint in its parent; its value is
    ``joint_ratio * q[joint_source] + joint_shift`` (mimic joints share a source), about or along z. ``eager`` joints
    are placed at every state, ``lazy`` ones, which are inner joints of clusters, only where balls around cluster and
    part are not enough.

    ``weight`` is what a unit of each planned joint counts in distances between states [rad/rad, rad/m]; ``continuous``
    is 1 for those after a whole turn of which the robot is as it was.

    ``cluster_ball`` holds center and radius of a ball around all of a cluster's solids in the frame of
    ``cluster_joint``, for all values of its inner joints; ``cluster_outer`` is the radius around its leaf spheres,
    ``cluster_spread`` the largest distance of a sphere's center from the ball's, ``cluster_speed`` the largest speed
    of such a center in that frame, per unit of ``q[cluster_dof]``.

    A cluster is made of parts, ``cluster_parts``: the bodies that are fixed to its joint, and each finger, or all as
    one. ``part_ball`` and ``part_outer`` are what ``cluster_ball`` and ``cluster_outer`` are, around a part alone, for
    each of BINS ranges of equal length of values of ``q[cluster_dof]``; ``cluster_range`` is the lowest value, and the
    number of ranges per unit, or 0. ``part_lazy`` are the inner joints of a part, ``part_bodies`` its bodies.

    A node is a sphere (``node_center`` in the frame of its body's joint, ``node_radius``) around the part of the solid
    that the leaves below cover; ``node_outer`` is a radius around the leaves themselves. ``body_inner`` are the first
    and number of those of ``inner_ball`` that are inside of a body's solid, in the frame of its joint.

    ``pair_ball`` holds, for both clusters of a pair, what ``cluster_ball`` does, around the bodies alone that the pair
    is about, ``pair_outer`` the radius around their leaf spheres: fingers are checked against a wrist, the palm, which
    is fixed to it, is not. ``pair_parts`` has a bit for each part of these clusters that the pair is about.
    ``run_pairs`` are runs of at most RUN pairs of a cluster with others that follow each other: that cluster, the first
    of the others, the first pair, and their number.

    ``bodies_table`` is the clearance table of each of ``bodies``, or -1, see
    :mod:`apex_ompl.kernel.compiled.check.clearance_table`. ``table_joints`` are the one to three planned joints that it
    depends on (else negative), ``table_cells`` its first byte and number of cells along each axis, ``table_range`` for
    each joint the lowest value and cells per unit (a whole turn of a continuous one), ``table_bytes`` eight bytes in
    each number.
    """

    joint_parent: Integers
    joint_kind: Integers
    joint_source: Integers
    eager: Integers
    lazy: Integers
    cluster_joint: Integers
    cluster_lazy: Spans
    cluster_dof: Integers
    cluster_bodies: Spans
    cluster_meets_scene: Integers
    cluster_parts: Spans
    part_lazy: Spans
    part_bodies: Spans
    body_joint: Integers
    body_root: Integers
    node_first: Integers
    node_count: Integers
    pair_clusters: Pairs
    pair_common: Integers
    pair_bodies: Spans
    bodies: Pairs
    joint_rotation: Rotations
    joint_offset: Vectors
    joint_ratio: Floats
    joint_shift: Floats
    lower: Floats
    upper: Floats
    weight: Floats
    continuous: Integers
    cluster_ball: Balls
    cluster_outer: Floats
    part_ball: Annotated[Floats, BINS, 4]
    part_outer: Annotated[Floats, BINS]
    cluster_spread: Floats
    cluster_speed: Floats
    cluster_range: Annotated[Floats, 2]
    node_center: Vectors
    node_radius: Floats
    node_outer: Floats
    body_inner: Spans
    inner_ball: Balls
    pair_ball: Annotated[Floats, 2, 4]
    pair_outer: Annotated[Floats, 2]
    pair_parts: Pairs
    run_pairs: Annotated[Integers, 4]
    bodies_table: Integers
    table_joints: Annotated[Integers, 3]
    table_cells: Pairs
    table_range: Annotated[Floats, 3, 2]
    table_bytes: Integers


class SceneArrays(NamedTuple):
    """Arrays of a scene: obstacles, sorted so that each leaf of a tree of boxes holds a range of them.

    ``kind`` is one of BOX ... HALF_SPACE or GRID, ``owner`` the number of the obstacle that a solid is part of.
    ``size`` holds half edges, or radius and half length; a half-space has its unit normal in ``offset`` and its
    distance in ``size``. ``exact`` is 1 where it is the shape of that part, 0 where it only contains it. A grid has its
    first node at ``offset``, and in ``size`` its spacing, by how much its values were lowered, and the radius of the
    balls around points. ``grid`` says which of ``values`` are its own: the first, and how many along each axis; then
    where the tree over its points or triangles starts, its levels, and the number of these and of the numbers of each,
    see :mod:`apex_ompl.kernel.compiled.geometry.bounding_trees`.
    Nodes of the tree are in depth-first order: ``tree_skip`` is the next node outside of a node's subtree,
    ``tree_range`` first obstacle and number of them (0 for inner nodes). The last ``open`` (1,) obstacles are
    half-spaces, which no box holds. ``allowed`` are pairs of a body and an owner that may touch.
    """

    kind: Integers
    owner: Integers
    exact: Integers
    tree_skip: Integers
    tree_range: Spans
    open: Integers
    allowed: Pairs
    rotation: Rotations
    offset: Vectors
    size: Vectors
    tree_low: Vectors
    tree_high: Vectors
    grid: Annotated[Integers, GRID_ROW]
    values: Singles


robot_view = table_view(RobotArrays)
scene_view = table_view(SceneArrays)
