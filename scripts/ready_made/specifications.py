"""Specifications of the ready-made problems and of the example for Baxter: scenes, hand poses, held objects."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from apex_ompl.goals.grasp import HandObjects
from apex_ompl.problems.objects import bar, block_and_peg, boxes, cup_and_ball, parcels, two_cups
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Alignment

FORWARD, DOWN = (1.0, 0.0, 0.0), (0.0, 0.0, -1.0)
Point = tuple[float, float, float]


@dataclass(frozen=True)
class HandPose:
    """Position of a hand's grasp point in the world [m], and direction of its fingers."""

    point: tuple[float, float, float]
    fingers: tuple[float, float, float]


@dataclass(frozen=True)
class ReachSpecification:
    """Reaching problem between poses of both hands (left, right), with held objects or with synergies of the hands."""

    file: str
    robot: str
    scene: Callable[[], Sequence[Obstacle]]
    start: tuple[HandPose, HandPose]
    goal: tuple[HandPose, HandPose]
    held: Callable[[], HandObjects] = tuple
    synergies: tuple[float, ...] = ()


@dataclass(frozen=True)
class AlignmentSpecification:
    """Alignment problem: two held objects are brought together."""

    file: str
    scene: Callable[[], Sequence[Obstacle]]
    held: Callable[[], HandObjects]
    alignment: Alignment
    seed: int = 0


@dataclass(frozen=True)
class CarrySpecification:
    """Problem with a constraint: a loaded tray in both hands stays level, or a cup in each hand upright.

    Attributes:
        file: File of the problem.
        scene: Its obstacles.
        start: Middle of the tray, or grasp points of the left and the right hand, or middles of cups in GRASPS [m].
        goal: The same at the goal.
        yaws: Of the fingers of both hands with cups, at start and goal [rad].
        seed: Of inverse kinematics.
    """

    file: str
    scene: Callable[[], Sequence[Obstacle]]
    start: tuple[Point, ...]
    goal: tuple[Point, ...]
    yaws: tuple[tuple[float, float], tuple[float, float]] = ((0.0, 0.0), (0.0, 0.0))
    seed: int = 0


def shelf() -> list[Obstacle]:
    """A shelf of three columns and three levels in front of both arms: nine boards 2 cm thick."""
    board, depth, front = 0.02, 0.36, 0.56
    columns, levels = (-0.72, -0.24, 0.24, 0.72), (0.12, 0.42, 0.72, 1.02)
    middle = front + depth / 2
    height, center = levels[-1] - levels[0] + board, (levels[0] + levels[-1]) / 2
    width = columns[-1] - columns[0] + board
    uprights = [
        Obstacle(name=f"upright_{k}", box=(depth, board, height), position=(middle, y, center))
        for k, y in enumerate(columns)
    ]
    shelves = [
        Obstacle(name=f"board_{k}", box=(depth, width, board), position=(middle, 0.0, z)) for k, z in enumerate(levels)
    ]
    back = Obstacle(name="back", box=(board, width, height), position=(front + depth + board / 2, 0.0, center))
    return [*uprights, *shelves, back]


def posts() -> list[Obstacle]:
    """A post between the arms and one in front of each."""
    return [
        Obstacle(name="post", cylinder={"radius": 0.06, "length": 0.9}, position=(0.45, 0.0, 0.45)),
        Obstacle(name="left_post", box=(0.08, 0.08, 0.7), position=(0.5, 0.45, 0.35)),
        Obstacle(name="right_post", box=(0.08, 0.08, 0.7), position=(0.5, -0.45, 0.35)),
    ]


def table() -> list[Obstacle]:
    """A table in front of Baxter with three posts on it."""
    return [
        Obstacle(name="table", box=(0.7, 1.8, 0.04), position=(0.85, 0.0, -0.22)),
        Obstacle(name="middle_post", box=(0.06, 0.06, 0.4), position=(0.75, 0.0, 0.0)),
        Obstacle(name="left_post", cylinder={"radius": 0.04, "length": 0.5}, position=(0.75, 0.38, 0.05)),
        Obstacle(name="right_post", cylinder={"radius": 0.04, "length": 0.5}, position=(0.75, -0.38, 0.05)),
    ]


def bin_between() -> list[Obstacle]:
    """An open bin on the tables between the arms."""
    (x, y), (long, wide, high), wall = (0.55, 0.0), (0.4, 0.6, 0.2), 0.02
    return [
        Obstacle(name="bin_bottom", box=(long, wide, wall), position=(x, y, wall / 2)),
        Obstacle(name="bin_near", box=(wall, wide, high), position=(x - long / 2, y, high / 2)),
        Obstacle(name="bin_far", box=(wall, wide, high), position=(x + long / 2, y, high / 2)),
        Obstacle(name="bin_left", box=(long, wall, high), position=(x, y + wide / 2, high / 2)),
        Obstacle(name="bin_right", box=(long, wall, high), position=(x, y - wide / 2, high / 2)),
    ]


def wall_between(height: float = 0.62) -> Callable[[], list[Obstacle]]:
    """A wall that stands between the two hands, and a lamp that hangs over it."""

    def scene() -> list[Obstacle]:
        lamp = Obstacle(name="lamp", sphere={"radius": 0.12}, position=(0.5, 0.0, 1.0))
        return [Obstacle(name="wall", box=(0.7, 0.06, height), position=(0.55, 0.0, height / 2)), lamp]

    return scene


def two_walls() -> list[Obstacle]:
    """A wall on the inner side of each hand."""
    size = (0.7, 0.04, 0.5)
    return [
        Obstacle(name=f"{side}_wall", box=size, position=(0.5, y, 0.25)) for side, y in (("left", 0.2), ("right", -0.2))
    ]


def counter() -> list[Obstacle]:
    """A low wall between two places of a counter, a shade that hangs over it, and a stand for a tray."""
    shade = Obstacle(name="shade", cylinder={"radius": 0.12, "length": 0.2}, position=(0.5, 0.0, 0.95))
    stand = Obstacle(name="stand", box=(0.16, 0.16, 0.24), position=(0.5, -0.42, 0.12))
    return [Obstacle(name="wall", box=(0.7, 0.04, 0.34), position=(0.55, 0.0, 0.17)), shade, stand]


GRASPS: Mapping[str, Mapping[str, tuple[Point, tuple[float, float, float, float]]]] = {
    "ball_in_cup": {"ball": ((0.028, 0.02, -0.041), (0.0, 0.0, 0.0, 1.0))},
    "stack_boxes": {
        "lower": ((0.0305, -0.0046, -0.0451), (0.652896, 0.328218, -0.626318, 0.271524)),
        "upper": ((-0.0329, -0.0023, -0.0441), (-0.271131, -0.646378, -0.29065, 0.651311)),
    },
    "pour": {
        "empty": ((0.0227, -0.0202, -0.0484), (0.213629, -0.674368, 0.439452, 0.553599)),
        "full": ((-0.0184, -0.0208, -0.0494), (0.193693, 0.690061, -0.421072, 0.555875)),
    },
    "pour_upright": {
        "left_cup": ((0.0219, -0.0202, -0.0488), (0.596345, 0.387858, -0.630315, 0.310873)),
        "right_cup": ((-0.0219, -0.0202, -0.0488), (0.596345, -0.387858, 0.630315, 0.310873)),
    },
}
"""Poses of objects in the palms that differ from those of the suites: position [m], quaternion xyzw. Friction holds the
boxes and the cups in them (``find_grasps.py``); the ball is between two fingers, which open clear of it."""

SPECIFICATIONS: tuple[ReachSpecification | AlignmentSpecification | CarrySpecification, ...] = (
    ReachSpecification(
        "problems/data/shelf_swap.yaml", "dual_panda_softhand", shelf,
        (HandPose((0.68, 0.06, 0.87), FORWARD), HandPose((0.68, -0.48, 0.27), FORWARD)),
        (HandPose((0.68, 0.48, 0.27), FORWARD), HandPose((0.68, -0.06, 0.87), FORWARD)),
        synergies=(0.3, 0.3),
    ),
    ReachSpecification(
        "problems/data/reach_past_post.yaml", "dual_panda_softhand", posts,
        (HandPose((0.55, 0.72, 0.20), DOWN), HandPose((0.55, -0.72, 0.20), DOWN)),
        (HandPose((0.55, 0.16, 0.20), DOWN), HandPose((0.55, -0.16, 0.20), DOWN)),
        synergies=(0.0, 0.0),
    ),
    ReachSpecification(
        "problems/data/pack_bin.yaml", "dual_panda_softhand", bin_between,
        (HandPose((0.55, 0.52, 0.22), DOWN), HandPose((0.55, -0.52, 0.22), DOWN)),
        (HandPose((0.55, 0.13, 0.16), DOWN), HandPose((0.55, -0.13, 0.16), DOWN)),
        held=parcels,
    ),
    ReachSpecification(
        "examples/baxter_table.yaml", "baxter", table,
        (HandPose((0.75, 0.62, 0.0), DOWN), HandPose((0.75, -0.62, 0.0), DOWN)),
        (HandPose((0.75, 0.14, 0.0), DOWN), HandPose((0.75, -0.14, 0.0), DOWN)),
    ),
    AlignmentSpecification(
        "problems/data/stack_boxes.yaml", wall_between(), boxes,
        Alignment(kind="vertical", first="lower", second="upper"),
    ),
    AlignmentSpecification(
        "problems/data/ball_in_cup.yaml", two_walls, cup_and_ball,
        Alignment(kind="horizontal", first="cup", second="ball"),
    ),
    AlignmentSpecification(
        "problems/data/peg_in_hole.yaml", two_walls, partial(block_and_peg, "chamfered_block.obj"),
        Alignment(kind="horizontal", first="block", second="peg", distance=0.02),
    ),
    AlignmentSpecification(
        "problems/data/pour.yaml", wall_between(), two_cups,
        Alignment(kind="pour", first="full", second="empty", tilt=(1.0, 1.3)),
    ),
    AlignmentSpecification(
        "problems/data/handover.yaml", wall_between(), bar,
        Alignment(kind="handover", first="bar", second="right_hand"),
    ),
    CarrySpecification("problems/data/carry_tray.yaml", counter, ((0.5, 0.42, 0.28),), ((0.5, -0.42, 0.28),)),
    CarrySpecification(
        "problems/data/pour_upright.yaml", wall_between(0.4),
        ((0.48, 0.3, 0.25), (0.48, -0.3, 0.25)), ((0.5, 0.1, 0.455), (0.5, -0.1, 0.585)),
        ((0.4, -0.4), (-0.5, 0.5)),
    ),
)  # fmt: skip
