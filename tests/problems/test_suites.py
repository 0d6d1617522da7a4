"""The suites: problems are drawn by seed alone; starts and goals have the documented margins."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from apex_ompl import problems
from apex_ompl.api import load_problem
from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ApexError, ParameterError, UnknownNameError
from apex_ompl.goals.alignment import AlignmentGoal
from apex_ompl.problems import alignment, scenes
from apex_ompl.problems.catalogue import SPLITS, ProblemId
from apex_ompl.problems.frozen import digest
from apex_ompl.robot import Robot
from apex_ompl.scene.problem import Alignment, Problem
from apex_ompl.scene.scripts import obstacle_at

SUITE_LEVELS = [(suite, level) for suite, levels in problems.suites().items() for level in levels]
EXTREME = ("shelf", "bins", "wall", "swap", "clutter")
HARD = ("shelf", "bins", "cage", "posts", "wall", "swap", "clutter")
LEVELS = ["free", "small", "large", "moving-medium-0.2", "moving-huge-0.4"]
HARD_LEVELS = [pair for pair in SUITE_LEVELS if pair[0] in HARD]
FACES = {"vertical": [("lower", "upper")], "horizontal": [("cup", "ball"), ("block", "peg")]}


def ends(problem: Problem, robot: Robot) -> np.ndarray:
    names = robot.joint_names
    return np.stack([problem.start_state(names), problem.goal_states(names)[0]])


def box_corners(robot: Robot, problem: Problem, q: np.ndarray) -> list[np.ndarray]:
    """Corners of the held boxes at a state, by Pinocchio, each of shape (8, 3)."""
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T / 2.0
    corners = []
    for body in problem.attached:
        pose = robot.link_pose(q, body.link) @ body.pose
        corners.append(signs * body.box @ pose[:3, :3].T + pose[:3, 3])
    return corners


def test_the_suites_and_levels_are_those_of_the_contract() -> None:
    suites = problems.suites()
    assert set(suites) == {"vertical", "horizontal", *HARD}
    for suite in HARD:
        assert suites[suite] == ("easy", "medium", "hard", *(("extreme",) if suite in EXTREME else ()))
    moving = {f"moving-{size}-{speed}" for size in alignment.SIZES for speed in ("0.1", "0.2", "0.4")}
    for suite in ("vertical", "horizontal"):
        assert set(suites[suite]) == {"free", *alignment.SIZES, "extreme"} | moving and len(moving) == 15


@settings(max_examples=25)
@given(which=st.sampled_from(SUITE_LEVELS), seed=st.integers(0, 799_999), other=st.integers(0, 799_999))
def test_the_same_seed_gives_the_same_problem(which: tuple[str, str], seed: int, other: int) -> None:
    suite, level = which
    first = problems.sample(suite, level=level, seed=seed)
    problems.sample(suite, level=level, seed=other)  # has no influence on the next draw
    again = problems.load(f"{suite}/{level}/{seed}")
    assert again == first and digest(again) == digest(first) and first.name == f"{suite}/{level}/{seed}"
    if other != seed:
        assert problems.sample(suite, level=level, seed=other).start != first.start


def test_another_process_draws_the_same() -> None:
    name = "horizontal/moving-large-0.2/4321"
    code = "from apex_ompl import problems; from apex_ompl.problems.frozen import digest; "
    code += f"print(digest(problems.load({name!r})))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == digest(problems.load(name))


@pytest.mark.parametrize(("suite", "level"), HARD_LEVELS)
def test_every_scene_can_be_built(suite: str, level: str) -> None:
    """For any random numbers: every body has a positive thickness, and names are unique."""
    for seed in range(60):
        task = scenes.SUITES[suite](np.random.default_rng([9, seed]), level)
        assert len({body.name for body in task.scene}) == len(task.scene)
        for region in (*task.start, *task.goal):
            assert all(low <= high for low, high in (region.x, region.y, region.z)) and region.fingers


@pytest.mark.parametrize(("suite", "level"), HARD_LEVELS)
def test_starts_and_goals_of_the_hard_suites_have_a_clearance_of_a_centimeter(
    robot: Robot, suite: str, level: str
) -> None:
    """By Coal's distances, the links against each other included; the hands hold nothing."""
    for seed in range(1 + (level == "easy")):
        problem = problems.sample(suite, level=level, seed=seed)
        checker = CollisionChecker(robot, problem.scene, proofs=False)
        for q in ends(problem, robot):
            assert robot.limit_fault(q) is None and checker.is_free(q) and checker.clearance(q) >= 0.01
            assert (q[robot.groups["hands"]] <= 0.4).all()
        if suite == "clutter":
            assert len(problem.scene) == {"easy": 10, "medium": 20, "hard": 30, "extreme": 45}[level]


@pytest.mark.parametrize("level", [*LEVELS, "extreme"])
@pytest.mark.parametrize("suite", ["vertical", "horizontal"])
def test_alignment_problems_satisfy_the_definition_of_the_paper(robot: Robot, suite: str, level: str) -> None:
    held, free = set(), level == "free"
    for seed in range(8 if free else 3):
        problem = problems.sample(suite, level=level, seed=seed)
        start, goal = ends(problem, robot)
        names = tuple(body.name for body in problem.attached)
        held.add(names)
        assert names in FACES[suite]
        task = AlignmentGoal(robot, Alignment(kind=suite, first=names[0], second=names[1]), problem.attached, start)
        assert task.is_satisfied(goal) and not task.is_satisfied(start)
        assert np.array_equal(start[robot.groups["hands"]], goal[robot.groups["hands"]])
        bare = CollisionChecker(robot, (), problem.attached, proofs=False)
        assert bare.is_free(start) and bare.is_free(goal)
        assert min(bare.distance(q, fixtures=True).value for q in (start, goal)) >= 0.01
        assert bare.clearance(start) >= 0.01  # of every pair of bodies; at the goal the two objects may be closer
        if suite == "vertical":
            corners = box_corners(robot, problem, start)
            assert min(c[:, 2].min() for c in corners) >= 0.08
            assert np.linalg.norm(corners[0].mean(axis=0) - corners[1].mean(axis=0)) >= 0.4
    assert not free or held == set(FACES[suite])


@pytest.mark.parametrize("level", LEVELS[1:])
def test_cubes_have_their_size_and_speed_and_are_clear_of_start_and_goal(robot: Robot, level: str) -> None:
    moving, _, rest = level.rpartition("moving-")
    size, _, speed = rest.partition("-")
    counts = set()
    for seed in range(3 if speed else 12):
        problem = problems.sample("vertical", level=level, seed=seed)
        start, goal = ends(problem, robot)
        duration = float(np.max(np.abs(goal - start) / robot.limits.velocity)) / 0.25
        counts.add(len(problem.scene))
        for cube in problem.scene:
            edge = {"small": 0.06, "medium": 0.10, "large": 0.15, "xlarge": 0.20, "huge": 0.30}[size or level]
            assert cube.box == (edge, edge, edge) and cube.moving == bool(speed)
            if speed:
                assert np.linalg.norm(cube.velocity) == pytest.approx(float(speed), abs=1e-4)
        for q, time in ((start, 0.0), (goal, duration)):
            scene = [obstacle_at(cube, time) for cube in problem.scene]
            assert CollisionChecker(robot, scene, problem.attached).distance(q).value >= 0.03
    assert counts == {1} if speed else 1 < len(counts) and counts <= {1, 2, 3}


@pytest.mark.parametrize(("suite", "count"), [("vertical", 100), ("horizontal", 70)])
def test_extreme_alignments_have_many_cubes_clear_of_start_and_goal(robot: Robot, suite: str, count: int) -> None:
    problem = problems.sample(suite, level="extreme", seed=3)
    assert len(problem.scene) == count and all(
        cube.box == (0.2, 0.2, 0.2) and not cube.moving for cube in problem.scene
    )
    checker = CollisionChecker(robot, problem.scene, problem.attached)
    assert min(checker.distance(q).value for q in ends(problem, robot)) >= 0.015


def test_splits_are_by_seed() -> None:
    bounds = {"train": (0, 799_999), "validation": (800_000, 899_999), "test": (900_000, 999_999)}
    assert {name: (seeds[0], seeds[-1]) for name, seeds in SPLITS.items()} == bounds
    for name, (first, last) in bounds.items():
        assert ProblemId("shelf", "hard", first).split == ProblemId("shelf", "hard", last).split == name


@pytest.mark.parametrize(
    ("name", "error", "message"),
    [
        ("shelv/hard/12", UnknownNameError, "did you mean 'shelf'"),
        ("shelf/hart/12", UnknownNameError, "did you mean 'hard'"),
        ("vertical/moving-huge-0.3/12", UnknownNameError, "moving-huge-0.4"),
        ("shelf/hard/1000000", ParameterError, "from 0 to 999999, got 1000000"),
        ("shelf/hard/" + "9" * 19, ParameterError, "from 0 to 999999"),
        ("shelf/hard/" + "9" * 5000, ParameterError, "an id such as shelf/easy/12"),
        ("shelf/hard", ParameterError, "an id such as shelf/easy/12"),
        ("shelf/hard/x12", ParameterError, "an id such as shelf/easy/12"),
        ("shelf/hard/007", ParameterError, "an id such as shelf/easy/12"),
        ("shelf/HARD/7", UnknownNameError, "did you mean 'hard'|known: cups, easy, extreme, hard, level, medium, tray"),
        ("there/is/none", ApexError, "no such file"),
    ],
)
def test_invalid_ids_are_reported(name: str, error: type[ApexError], message: str) -> None:
    with pytest.raises(error, match=message):
        load_problem(name)


def test_an_id_goes_before_a_file_of_that_name(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "posts" / "easy").mkdir(parents=True)
    (tmp_path / "posts" / "easy" / "7").write_text("something else")
    monkeypatch.chdir(tmp_path)
    assert load_problem("posts/easy/7").name == "posts/easy/7"


@pytest.mark.parametrize("seed", [-1, 1_000_000, 1.5, True, "7"])
def test_invalid_seeds_are_reported(seed: object) -> None:
    with pytest.raises(ParameterError, match="seed"):
        problems.sample("shelf", level="hard", seed=seed)  # type: ignore[arg-type]


def test_ids_work_at_the_command_line(apex_cli) -> None:
    done = apex_cli("check", "posts/easy/7")
    assert done.returncode == 0 and "posts/easy/7" in done.stdout and done.stdout.count("free") == 2
    done = apex_cli("check", "vertical/moving-huge-0.1/0")  # at time 0 the cube overlaps the goal
    assert done.returncode == 0 and "goal       free (without cube_0)" in done.stdout
    done = apex_cli("plan", "vertical/moving-huge-0.1/0", "--snapshot")
    assert done.returncode == 3 and "cube_0" in done.stdout
    done = apex_cli("plan", "vertical/small/11", "--json")
    assert done.returncode == 0 and '"EXACT_SOLUTION"' in done.stdout
    done = apex_cli("plan", "vertical/moving-medium-0.2/800000", "--timeout", "30")
    assert done.returncode == 0 and "obstacles  proved apart from cube_0 in time" in done.stdout
    done = apex_cli("plan", "shelf/hard/x12")
    assert done.returncode == 2 and len(done.stderr.strip().splitlines()) == 1
    listing = apex_cli("problems").stdout
    assert all(suite in listing for suite in problems.suites())
