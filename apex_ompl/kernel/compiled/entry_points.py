"""Compiled functions that Python calls, and the types of their arguments.

Types are written as numba writes them: ``f8[:, ::1]`` is an array of shape (N, M).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

ROBOT = "i8[::1], f8[::1], "
WORKSPACE = BUFFERS = ROBOT
SCENE = DYNAMIC = ROBOT + "f4[::1], "
TREES = "f8[:, ::1], f8, f8, f8[:, :, ::1], i8[:, ::1], i8[::1], i8[::1], f8[::1], f8[::1], "
PROOF = "f8[:, ::1], i8[::1], i8[:, ::1], i8[::1], f8[::1], i8[:, ::1], i8[::1]"
CURVE = "f8[::1], f8[:, ::1], f8[:, ::1], f8, f8, f8, f8, i8"
KNOTS = "f8[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1]"
SETTINGS = "Tuple((f8, f8, f8, f8, f8, f8, i8))"

Functions = Mapping[str, tuple[str, int]]
"""Functions: name below this package -> types of the arguments, and typical time to compile [s]."""


@dataclass(frozen=True, eq=False)
class Group:
    """Functions that are needed together.

    Attributes:
        what: What they are.
        seconds: Typical time to compile them by two processes [s].
        parts: Those that one process compiles, as what they call is the same: as many processes as there are parts, or
            fewer that take several parts in turn.
    """

    what: str
    seconds: int
    parts: tuple[Functions, ...]

    @property
    def functions(self) -> Functions:
        """All of them."""
        return {name: one for part in self.parts for name, one in part.items()}

    def shares(self, count: int) -> list[list[str]]:
        """Return names of functions for at most ``count`` processes, the parts in their order."""
        many = min(count, len(self.parts))
        found: list[list[str]] = [[] for _ in range(many)]
        for k, part in enumerate(self.parts):
            found[k * many // len(self.parts)] += part
        return found


PLANS = Group(
    "its collision kernel",
    40,
    (
        {
            "check.motion_proof.prove_path": (ROBOT + SCENE + WORKSPACE + PROOF, 10),
            "path.search.grow_trees": (ROBOT + SCENE + WORKSPACE + TREES + PROOF, 4),
            "path.shortcutting.shortcut_path": (
                ROBOT + SCENE + WORKSPACE + "f8[:, ::1], f8, f8[:, ::1], i8[::1], " + PROOF,
                4,
            ),
        },
        {
            "check.queries.check_states": (ROBOT + SCENE + WORKSPACE + "f8[:, ::1], i8[:, :, ::1], i8[::1]", 2),
            "check.queries.clearances": (ROBOT + SCENE + WORKSPACE + "f8[:, ::1], f8, f8[:, ::1], f8[:, :, ::1]", 6),
            "path.path_optimization.optimize_path": (
                ROBOT
                + SCENE
                + WORKSPACE
                + f"f8[:, ::1], i8[::1], f8[:, ::1], i8, f8[:, ::1], {SETTINGS}, i8[::1], f8[::1]",
                8,
            ),
        },
        {
            "check.curve_proof.prove_curve": (ROBOT + SCENE + ROBOT + "i8[::1], " + 3 * ROBOT + CURVE, 18),
            "timing.duration_optimization.lower_duration": (
                ROBOT
                + SCENE
                + WORKSPACE
                + "f8[:, ::1], i8[::1], f8[:, ::1], f8[:, ::1], i8, f8, f8[:, ::1], "
                + "Tuple((f8, f8, f8, f8, f8, f8, f8, f8, f8, i8)), i8[::1], f8[::1]",
                8,
            ),
        },
        {
            "check.queries.joint_frames": (ROBOT + WORKSPACE + "f8[:, ::1], f8[:, :, :, ::1], f8[:, :, ::1]", 2),
            "geometry.bounding_trees.median_order": ("f8[:, ::1], i8[::1], i8[:, ::1]", 1),
            "geometry.bounding_trees.node_balls": ("f8[:, :, ::1], i8[::1], i8[::1], f8[:, ::1], f8[:, ::1]", 1),
            "geometry.convex_distance.farthest_points": ("f8[:, ::1], f8[:, ::1], i8[::1], f8[:, ::1], f8, i8[::1]", 1),
            "check.motion_proof.lay_grid": ("f8[:, ::1], f8, i8[::1]", 1),
            "timing.jerk_profiles.join_profiles": (
                "f8[:, :, ::1], f8[:, :, ::1], i8[::1], f8[:, :, ::1], i8[:, :, ::1], f8[:, :, :, ::1], i8[::1], "
                "f8[::1], f8[:, :, ::1]",
                2,
            ),
            "timing.cubic_pieces.sample_motion": (KNOTS + ", f8[::1], i8, f8[:, :, ::1]", 1),
            "timing.cubic_pieces.motion_extremes": (KNOTS + ", f8[:, ::1]", 1),
            "timing.cubic_pieces.relative_gap": (KNOTS, 1),
            "timing.cubic_pieces.cubic_rates": (KNOTS + ", f8[:, ::1]", 1),
            "timing.time_parameterization.max_distance": ("f8[:, ::1], f8[::1], f8[:, ::1], f8[::1], f8", 1),
            "timing.time_parameterization.max_path_speeds": (
                "f8[:, ::1], f8[:, ::1], f8[::1], f8[:, ::1], f8[:, ::1], f8, f8[::1]",
                1,
            ),
            "timing.time_parameterization.sample_times": ("f8[::1], f8, f8, f8[::1]", 1),
            "geometry.scene_distance.nearest_points": (SCENE + "i8[::1], f8[:, ::1], f8, f8[::1], f8[:, ::1]", 2),
            "geometry.scene_distance.group_clearances": (
                SCENE + "i8[::1], f8[:, :, ::1], f8[:, :, :, ::1], f8, f8[:, ::1], f8[::1]",
                2,
            ),
            "robot.kinematics.joint_pushes": (
                ROBOT
                + "f8[:, :, :, ::1], f8[:, :, ::1], i8[::1], f8[:, :, ::1], f8[:, ::1], f8[:, :, ::1], f8, f8[:, ::1]",
                1,
            ),
            "geometry.triangles.surface_distances": (
                "f8[:, ::1], f8[:, :, ::1], f8[:, ::1], i8[::1], i8[::1], i8[::1], f8, f8[::1]",
                1,
            ),
            "geometry.cloud_distance.primitive_distances": ("f8[:, ::1], i8, f8[::1], f8[::1]", 1),
            "geometry.triangles.encloses": ("f8[:, :, ::1], f8[:, ::1], b1, f8, f8, f8", 1),
            "packet.matrix_products.matrix_products": ("f8[:, :, ::1], f8[:, :, ::1], f8[:, :, ::1]", 1),
            "packet.matrix_products.factorize": ("f8[:, ::1], f8[:, ::1]", 1),
            "packet.matrix_products.solve_factored": ("f8[:, ::1], f8[:, ::1]", 1),
            "network.dense_layer.dense_layer": ("i1[:, ::1], f4[::1], f4[::1], f4[:, ::1], f4[:, ::1]", 1),
        },
    ),
)
"""What every plan needs."""

RUNS = Group(
    "what runs among dynamic obstacles need",
    25,
    (
        {
            "moving.motion_optimization.optimize_motion": (
                ROBOT
                + SCENE
                + DYNAMIC
                + WORKSPACE
                + "f8[:, ::1], f8[:, ::1], i8[::1], f8[:, ::1], f8[::1], f8[:, ::1], f8, f8[:, ::1], i8, f8[:, ::1], "
                + f"{SETTINGS}, i8[::1], f8[::1], f8[::1]",
                16,
            ),
        },
        {
            "moving.dynamic_obstacles.clearances_in_time": (
                ROBOT + DYNAMIC + WORKSPACE + "f8[:, ::1], f8[::1], f8, f8[:, ::1], f8[::1], f8[:, ::1]",
                2,
            ),
            "moving.dynamic_obstacles.first_conflict": (
                ROBOT
                + DYNAMIC
                + WORKSPACE
                + "f8[::1], f8[:, ::1], f8[:, ::1], f8, f8, f8, f8, f8, f8[:, ::1], f8[::1], "
                "i8[::1]",
                6,
            ),
        },
        {
            "moving.blocked_intervals.blocked_intervals": (
                ROBOT + DYNAMIC + WORKSPACE + "f8[::1], f8[:, ::1], f8[:, ::1], f8, f8[:, ::1], f8, f8, f8[::1], "
                "f8[:, :, ::1], i8[::1]",
                14,
            ),
            "moving.stop_proof.first_unproved_stop": (
                ROBOT
                + DYNAMIC
                + WORKSPACE
                + "f8[:, ::1], f8[:, ::1], f8[::1], f8, f8[::1], f8[:, ::1], f8[:, ::1], f8, "
                "f8[:, :, ::1], " + 5 * "f8[::1], " + "f8, f8[::1], i8[::1], f8, f8, f8, f8[:, ::1], f8[::1], i8[::1], "
                "f8[:, ::1], f8[:, ::1], f8[::1], f8[::1], f8[:, :, ::1], f8[::1], f8[:, :, ::1], f8[:, ::1], "
                "f8[:, ::1]",
                8,
            ),
        },
        {
            "moving.speed_search.earliest_arrivals": (
                "f8[:, :, ::1], i8[::1], f8[:, :, ::1], i8[::1], f8[:, ::1], f8[:, ::1], f8[::1], f8, i8, b1, i8, f8, "
                "f8, f8, f8[:, :, :, ::1], i8[:, ::1], f8[:, :, ::1], i8[::1], f8[:, ::1], f8[::1], i8[::1], "
                "f8[:, ::1]",
                4,
            ),
            "moving.speed_profile.push_bounds": (
                "f8[:, :, ::1], f8[::1], f8[::1], f8[::1], f8, f8, f8[::1], f8[:, ::1], f8[:, ::1]",
                1,
            ),
            "moving.speed_profile.profile_places": ("f8[::1], f8, f8, i8[::1], f8[:, ::1], f8, f8, f8[::1]", 1),
            "moving.speed_profile.follow_profile": (
                "f8[::1], f8[:, :, ::1], f8, f8[::1], f8, "
                + 5 * "f8[::1], "
                + "f8[:, ::1], f8[:, ::1], f8[::1], f8[::1], "
                "f8[:, :, ::1]",
                3,
            ),
            "moving.speed_profile.first_blocked": (
                "f8[:, ::1], f8[:, :, ::1], i8[::1], f8[::1], f8[:, :, ::1], i8[::1], f8[::1], f8, f8",
                1,
            ),
            "moving.stops.stop_on_path": (
                "f8[::1], f8[:, :, ::1], f8, f8[:, ::1], "
                + 5 * "f8[::1], "
                + "f8, f8[:, ::1], f8[::1], f8[::1], f8[::1], "
                "f8[:, :, ::1]",
                4,
            ),
            "moving.stops.stop_joints": (
                7 * "f8[::1], " + "f8[:, ::1], f8[:, ::1], f8[::1], f8[:, :, ::1], f8[::1]",
                3,
            ),
        },
    ),
)
"""What a run of the closed loop needs in addition."""

ROWS = "f8[:, ::1], f8, f8, i8, i8[::1], i8[::1], f8[::1], i8"

CONSTRAINED = Group(
    "what plans under constraints need",
    25,
    (
        {
            "constraint.projection.project_states": (ROBOT + WORKSPACE + ROBOT + ROWS, 3),
            "constraint.projection.constraint_norms": (
                ROBOT + WORKSPACE + ROBOT + "f8[:, ::1], f8[:, ::1], i8[::1], f8[::1], i8",
                2,
            ),
            "constraint.projection.constraint_rows": (
                ROBOT + WORKSPACE + ROBOT + "f8[::1], f8, i8[::1], f8[::1], i8",
                2,
            ),
            "constraint.proof.prove_constraints": (
                ROBOT + WORKSPACE + ROBOT + f"{KNOTS}, i8[::1], f8[::1], i8, i8[::1], f8[::1]",
                3,
            ),
            "constraint.search.grow_constrained_trees": (
                ROBOT + SCENE + WORKSPACE + TREES + PROOF + ", " + ROBOT + "i8, i8, i8[::1], f8[::1], f8[:, ::1]",
                8,
            ),
            "constraint.search.connect_states": (
                ROBOT
                + SCENE
                + WORKSPACE
                + "f8[::1], f8, f8, f8[::1], f8[:, ::1], "
                + PROOF
                + ", "
                + ROBOT
                + "i8, i8, i8[::1], f8[::1], f8[:, ::1]",
                4,
            ),
        },
        {
            "constraint.duration.lower_constrained_duration": (
                ROBOT
                + SCENE
                + WORKSPACE
                + "f8[:, ::1], i8[::1], f8[:, ::1], f8[:, ::1], i8, f8, f8[:, ::1], "
                + "Tuple((f8, f8, f8, f8, f8, f8, f8, f8, f8, i8)), i8[::1], f8[::1], "
                + ROBOT
                + "f8, f8, i8, i8[::1], f8[::1]",
                12,
            ),
            "constraint.path_optimization.optimize_constrained_path": (
                ROBOT
                + SCENE
                + WORKSPACE
                + f"f8[:, ::1], i8[::1], f8[:, ::1], i8, f8[:, ::1], {SETTINGS}, i8[::1], f8[::1], "
                + ROBOT
                + "f8, f8, i8, i8[::1], f8[::1]",
                12,
            ),
        },
    ),
)
"""What plans under constraints need in addition."""

OTHERS: Functions = {
    "check.box_bound.box_bounds": (
        2 * ROBOT + WORKSPACE + 2 * BUFFERS + "i8, i8, f8[:, ::1], f8[::1], f8, f8, i8, f8[::1]",
        6,
    ),
    "geometry.cloud_distance.near_mesh": (
        "f8[:, :, ::1], f8[:, ::1], f8[:, ::1], i8[::1], i8[::1], f8[:, :, ::1], f8[:, ::1], f8[:, ::1], i8[::1], "
        "i8[::1], f8[:, ::1], f8, i8[:, ::1]",
        3,
    ),
    "geometry.cloud_distance.any_inside": (
        "f8[:, :, ::1], f8[:, ::1], i8[::1], i8[::1], f8[:, :, ::1], f8[:, ::1], b1, f8[:, ::1], f8[::1], "
        "f8[:, ::1], i8[:, ::1]",
        2,
    ),
    "geometry.cloud_distance.near_primitive": (
        "f8[:, :, ::1], f8[:, ::1], i8[::1], i8[::1], i8, f8[::1], f8[:, ::1], f8, i8[:, ::1]",
        2,
    ),
    "path.search.shortest_path": (
        "i8[::1], i8[::1], f8[::1], i8[::1], f8[::1], f8[::1], f8[::1], f8[::1], i8[::1], f8[::1], i8[::1]",
        1,
    ),
    "geometry.grid_regions.label_regions": ("i8[:, :, ::1], i8[::1]", 1),
    "geometry.grid_regions.add_up": ("i8[:, :, ::1], i8[:, :, ::1]", 1),
    "geometry.grid_regions.best_box": ("i8[:, :, ::1], i8[:, :, ::1], i8[:, ::1], f8, i8[:, ::1], i8[:, ::1]", 2),
    "geometry.grid_building.tabulate_points": (
        "f8[:, ::1], f8, f8, f8, f8, f4[:, :, ::1], f4[:, :, ::1], f8[::1], i8[::1], f8[::1]",
        2,
    ),
    "geometry.grid_building.tabulate_triangles": (
        "f8[:, :, ::1], b1, f8, f8, f8, f8, f8, f4[:, :, ::1], f4[:, :, ::1], f8[::1], i8[::1], f8[::1]",
        3,
    ),
    "robot.inverse_kinematics.descend": (
        ROBOT
        + WORKSPACE
        + "i8[::1], i8[::1], i8[::1], f8[::1], f8[:, ::1], f8[::1], i8[::1], f8, i8, f8, i8[::1], f8[::1]",
        4,
    ),
    "robot.inverse_kinematics.approach": (
        ROBOT
        + WORKSPACE
        + "i8[::1], i8[::1], i8[::1], f8[::1], f8[::1], f8[::1], i8, f8, f8[:, ::1], f8[::1], i8[::1], i8, "
        + "i8[::1], f8[::1]",
        3,
    ),
    "robot.inverse_kinematics.residual_and_jacobian": (
        ROBOT + WORKSPACE + "i8[::1], i8[::1], f8[::1], f8[::1], f8[::1], f8[:, ::1], i8[::1], f8[::1]",
        2,
    ),
    "robot.tool_poses.close_tools": (
        ROBOT
        + WORKSPACE
        + "i8[::1], i8[::1], f8[::1], i8[:, ::1], f8[:, :, ::1], f8[:, ::1], i8[::1], i8, i8[::1], f8[::1]",
        3,
    ),
    "geometry.enclosing_ball.enclose": ("f8[:, :, ::1], i8[::1], f8[::1], f8[::1], f8[::1]", 1),
    "geometry.bounding_trees.order_items": ("f8[:, :, ::1], f8[::1], f8, i8[:, ::1], i8[::1], f4[:, ::1]", 1),
    "geometry.bounding_trees.fill_boxes": ("f4[:, ::1], i8, f4[:, ::1]", 1),
    "geometry.scene_distance.nearest_of_scenes": (
        SCENE + "i8[::1], f8[:, :, ::1], f8, f8[:, ::1], f8[:, :, ::1]",
        1,
    ),
    "geometry.scene_distance.least_distances": (SCENE + "i8[::1], f8[:, :, ::1], f8[::1], f8[::1]", 1),
    "geometry.scene_distance.clearances_alone": (
        SCENE + "f8[:, :, ::1], f8[:, :, :, ::1], f8, f8[:, ::1], f8[:, ::1]",
        1,
    ),
    "path.path_cost.path_cost": (
        ROBOT
        + SCENE
        + WORKSPACE
        + f"f8[:, ::1], i8[::1], f8[:, ::1], i8, f8[:, ::1], {SETTINGS}, i8[::1], f8[::1], f8[::1]",
        5,
    ),
    "moving.state_costs.state_costs": (
        ROBOT
        + SCENE
        + DYNAMIC
        + WORKSPACE
        + "f8[:, ::1], f8[:, ::1], f8[::1], f8, f8, f8[::1], f8[:, ::1], f8[:, ::1], f8[:, :, ::1]",
        6,
    ),
    "perception.rasterizer.place_vertices": ("f8[:, ::1], i8[::1], f8[:, :, ::1], f8[:, ::1]", 1),
    "perception.rasterizer.draw_triangles": ("f8[:, ::1], i8[:, ::1], f8[::1], f8[:, ::1], i8[:, ::1]", 1),
    "perception.registration.register_rows": (
        "f8[:, ::1], f8[:, ::1], i8[:, ::1], f8[:, ::1], i8[:, ::1], f8[:, :, ::1], f8[::1], i8, f8[::1], f8, f8, f8, "
        "f8, f8[:, ::1], f8[::1], f8[::1]",
        1,
    ),
    "perception.surface_fit.select_points": (
        "f8[:, ::1], f8[:, ::1], f8[:, ::1], i8, i8, i8, f8[::1], f8[::1], f8, f8, f8, f8[:, ::1], f8[:, ::1]",
        1,
    ),
    "perception.surface_fit.fit_surface": (
        "f8[:, ::1], i8, f8[:, ::1], f8[::1], f8[:, ::1], i8[:, ::1], i8[::1], i8, f8[:, ::1], f8[::1], f8[::1], "
        "f8[:, ::1], f8[::1], f8[:, ::1], Tuple((f8, f8, f8, f8, f8, f8, f8, f8, f8)), i8, f8[:, ::1], "
        "f8[:, ::1], i8[:, ::1], f8[:, ::1], f8[:, ::1], f8[::1], f8[:, ::1], f8[::1], f8[::1]",
        3,
    ),
    "perception.depth_windows.cell_depths": ("f4[::1], i8[::1], i1[::1], f8, f8, f8, f4[:, :, ::1], f4[:, ::1]", 1),
    "perception.depth_windows.mark_inside": (
        "f4[::1], f4[:, ::1], i8[::1], f8[:, ::1], i8, f8[:, ::1], f4[:, ::1], i1[::1]",
        1,
    ),
    "perception.voxels.fill_voxels": (
        "i1[:, :, ::1], i1[:, :, ::1], i8[::1], f4[::1], f4[:, ::1], i1[::1], f8, f8, f8[:, ::1], f8[::1], "
        + "f8, f8, f8, f8, f8, i8, i8",
        1,
    ),
    "perception.voxels.clear_voxels": (
        "i1[:, :, ::1], i1[:, :, ::1], f4[:, :, ::1], f4[:, ::1], f8[:, ::1], f8[::1], f8[::1], i1[::1], f4[:, ::1]",
        2,
    ),
    "perception.voxels.forget_hits": ("i1[:, :, ::1], i8[::1]", 1),
    "perception.depth_windows.supported_depths": ("f4[:, ::1], f8, f8, i8, f4[:, ::1]", 1),
    "perception.voxels.mark_near": ("i1[:, :, ::1], f8[:, ::1], f8[::1], f8", 1),
    "geometry.triangles.column_boxes": ("f8[:, :, ::1], f8[::1], f8[::1], f8, f8[:, :, ::1], f8[:, :, :, :, ::1]", 1),
}
"""What clouds, grids, depth images, inverse kinematics, roadmaps and trainings call; else compiled at need."""

ALL: Functions = {**PLANS.functions, **RUNS.functions, **CONSTRAINED.functions, **OTHERS}
"""All functions that Python calls."""
