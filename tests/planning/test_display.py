"""How objects show themselves: at a prompt, in a terminal, in a notebook and in ``help``."""

from __future__ import annotations

import copy
import inspect
import pickle
import pydoc
import re
from dataclasses import dataclass, field, replace
from html.parser import HTMLParser
from pathlib import Path as FilePath
from typing import Any, NamedTuple

import numpy as np
import pytest
from runs import run_by_hand

import apex_ompl
from apex_ompl import Alignment, MotionPlanner, Obstacle, PlanResult, PoseTarget, Problem, RunResult, Timing, Trajectory
from apex_ompl.cli import run as run_command
from apex_ompl.collision import CollisionChecker
from apex_ompl.loop import Sensor, SensorStream
from apex_ompl.model.checkpoint import CheckpointConfig
from apex_ompl.moving import DynamicObstacles
from apex_ompl.ompl import assemble
from apex_ompl.paths import Optimizer, Spline
from apex_ompl.problems import witness, worlds
from apex_ompl.robot import Robot
from apex_ompl.robot.config import RobotConfig
from apex_ompl.robot.identity import _spelled
from apex_ompl.scene import AttachedObject, Goal
from apex_ompl.scene.bodies import Body
from apex_ompl.training import Paths
from apex_ompl.util.display import WIDTH, Summary, fields_line, html_table, one_line
from apex_ompl.util.schema import StrictModel

SCRIPT = "<script>alert('&')</script>"


@pytest.fixture(scope="module")
def result() -> PlanResult:
    return apex_ompl.plan("ball_in_cup", timeout=30.0)


@pytest.fixture(scope="module")
def run(robot: Robot) -> RunResult:
    return run_by_hand(robot)


class Cells(HTMLParser):
    """Texts and tags of a page."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.open, self.tags, self.texts = list[str](), set[str](), list[str]()
        self.feed(page)

    def handle_starttag(self, tag: str, _attributes: Any) -> None:
        self.open.append(tag)
        self.tags.add(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, text: str) -> None:
        self.texts.append(text)


def cells(page: str) -> list[str]:
    """The texts of a table that is well-formed and holds no other tags than those of tables."""
    read = Cells(page)
    assert not read.open and read.tags <= {"table", "caption", "b", "tr", "th", "td"}
    return read.texts


def test_a_plan_reads_as_the_command_line_prints_it(apex_cli, problem: Problem, tmp_path: FilePath) -> None:
    problem.save(tmp_path / "easy.yaml")
    done = apex_cli("plan", tmp_path / "easy.yaml", "--timeout", 30, "--out", tmp_path / "r.json")
    loaded = PlanResult.load(tmp_path / "r.json")
    assert done.stdout == f"{loaded}\n"
    assert cells(loaded._repr_html_())[0] == str(loaded).splitlines()[0]
    for line in str(loaded).splitlines()[1:]:
        assert line[13:] in cells(loaded._repr_html_())


def test_a_run_reads_as_the_command_line_prints_it(apex_cli, run: RunResult, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_command.api, "run", lambda *_, **__: run)
    done = apex_cli("run", "popup/vertical/large/12")
    assert done.stdout == f"{run}\n" and done.returncode == 0
    assert str(run).splitlines()[0] == "by-hand: reached"
    assert cells(run._repr_html_())[0] == "by-hand: reached"


def test_what_lacks_is_left_out_of_summaries(run: RunResult, result: PlanResult) -> None:
    bare = replace(run, metrics={})
    assert [line.split()[0] for line in str(bare).splitlines()] == ["by-hand:", "motion", "method"]
    failed = replace(result, status=apex_ompl.PlanStatus.TIMEOUT, reason="too late", path=None, trajectory=None)
    assert "  reason     too late" in str(failed).splitlines() and "length" not in str(failed)
    assert repr(replace(failed, solved_by="")) == "PlanResult(TIMEOUT, 'ball_in_cup', too late)"
    assert str(replace(failed, times={}))


def test_one_line_says_what_an_object_holds(result: PlanResult, run: RunResult, robot: Robot, paths: Paths) -> None:
    world = worlds.load("turning/vertical/large/12")
    planner = MotionPlanner()
    planner.world.add(name="post", box=(0.1, 0.1, 0.6), position=(0.5, 0.0, 0.3))
    motion, path = result.trajectory, result.path
    expected: dict[Any, str] = {
        result: f"PlanResult(EXACT_SOLUTION by {result.solved_by}, 'ball_in_cup', {result.length:.3f} rad over "
        f"{len(path)} states, motion {motion.duration:.3f} s)",
        run: f"RunResult(reached by {run.method}, 'by-hand', motion {run.trajectory.duration:.2f} s, sim clock)",
        robot: "Robot('dual_panda_softhand', 16 dof)",
        path: f"Path({len(path)} states, 16 joints, polyline)",
        motion: f"Trajectory(16 joints, {motion.duration:.3f} s, {len(motion.times)} knots)",
        planner: "MotionPlanner('dual_panda_softhand', planner apex, 1 obstacle)",
        planner.world: "World(1 obstacle)",
        planner.world.checker: "CollisionChecker('dual_panda_softhand', 1 obstacle)",
        assemble(result.problem, robot): "PlanningSetup('ball_in_cup', robot 'dual_panda_softhand', 4 goal states)",
        world: f"{type(world).__name__}('turning/vertical/large/12')",
        paths: f"Paths({len(paths)} paths of {paths.problems} problems)",
        witness("shelf/hard/900012"): f"Witness(path=array {witness('shelf/hard/900012').path.shape})",
        DynamicObstacles([Obstacle(name="a", sphere={"radius": 0.1}, velocity=(1, 0, 0))]): "DynamicObstacles(a)",
        Optimizer(Spline(10)): "Optimizer(spline=Spline(points=10, pinned=1, states=256, degree=5))",
        apex_ompl.load_model("apex"): "ArrayModel(robot 'dual_panda_softhand', 14 control points of 16 joints, scene "
        "'clearances')",
    }  # fmt: skip
    for one, text in expected.items():
        assert repr(one) == text and len(text) <= WIDTH
    held = "2 obstacles, 2 attached, goal alignment"
    assert repr(result.problem) == f"Problem('ball_in_cup', robot 'dual_panda_softhand', {held})"
    assert repr(robot.limits) == "Limits(16 joints, velocity 1.5 to 2.61 rad/s or m/s)"
    assert repr(Timing(velocity_scale=0.3)) == "Timing(velocity_scale=0.3)" and repr(Sensor()) == "Sensor()"
    assert repr(planner.check(robot.home)).startswith("StateCheck(valid, clearance ")
    assert repr(planner.check(robot.limits.upper + 1.0)).startswith("StateCheck(invalid: left_joint1 = ")
    planner.world.allow("post", "left_hand_palm")
    planner.world.attach({"name": "cup", "sphere": {"radius": 0.02}, "link": "right_hand_palm"})
    assert repr(planner.world) == "World(1 obstacle, 1 attached, 1 allowed pair)"
    assert repr(CollisionChecker(robot)) == "CollisionChecker('dual_panda_softhand', 0 obstacles)"


def test_arrays_are_never_printed_whole(result: PlanResult, run: RunResult, robot: Robot) -> None:
    kernel, optimizer = CollisionChecker(robot).kernel, Optimizer()
    line = optimizer.spline.line(robot.home, robot.home)[None]
    stream = SensorStream(Sensor(), worlds.load("turning/vertical/large/12"))
    shown = [
        result.trajectory.sample(0.1), next(result.trajectory.stream()), optimizer.improve(kernel, line, steps=1),
        apex_ompl.time_path(result.path, robot.limits, robot.joint_names), *run.events, stream,
        *stream.observations(0.0),
        result.problem.attached[0], Goal(joints=tuple({f"joint{k}": 0.1 for k in range(16)} for _ in range(50))),
        CollisionChecker(robot, result.problem.scene).distance(robot.home),
    ]  # fmt: skip
    for one in shown:
        assert len(repr(one)) <= WIDTH and "\n" not in repr(one) and "array([" not in repr(one)


def test_results_are_what_they_were(result: PlanResult, run: RunResult) -> None:
    for one in (result, run):
        again = pickle.loads(pickle.dumps(one))
        assert str(again) == str(one) and repr(copy.deepcopy(one)) == repr(one) and bool(again) is bool(one) is True
    assert Timing() == Timing() != Timing(velocity_scale=0.5)
    assert PoseTarget(frame="a", position=(0, 0, 1)) == PoseTarget(frame="a", position=(0, 0, 1))


def test_tables_of_notebooks_are_escaped(result: PlanResult, run: RunResult, robot: Robot) -> None:
    names = (SCRIPT, *robot.joint_names[1:])
    motion = result.trajectory
    shown = [
        replace(result, reason=SCRIPT), replace(run, reason=SCRIPT), replace(robot, name=SCRIPT, joint_names=names),
        Trajectory(motion.times, motion.positions, motion.velocities, motion.accelerations, names),
    ]  # fmt: skip
    for one in shown:
        assert any(SCRIPT in text for text in cells(one._repr_html_())), one
    rows = cells(robot._repr_html_())
    assert rows[0] == "dual_panda_softhand, 16 joints" and rows[7] == "left_joint1"
    assert {*robot.joint_names} <= {*rows} and "2.897" in rows
    assert cells(html_table(SCRIPT, [(SCRIPT, "1")], (SCRIPT, SCRIPT))) == [SCRIPT] * 4 + ["1"]


def test_lines_of_records() -> None:
    class Point(NamedTuple):
        x: np.ndarray
        name: str = "p"

        def __repr__(self) -> str:
            return fields_line(self)

    @dataclass(frozen=True)
    class Record:
        numbers: np.ndarray
        names: dict[str, int] = field(default_factory=dict)
        size: float = 1.0
        hidden: int = field(default=0, repr=False)

        __repr__ = fields_line

    big = np.zeros((9, 9))
    assert repr(Point(big)) == "Point(x=array (9, 9))"
    assert repr(Record(big)) == "Record(numbers=array (9, 9))"
    assert repr(Record(big, {"a": 1}, 2.0, 3)) == "Record(numbers=array (9, 9), names={'a': 1}, size=2.0)"
    long = one_line("Kind", "word\nword " * 100)
    assert len(long) == WIDTH and long.startswith("Kind(word word") and long.endswith("...)")
    assert str(Summary("title", [("time", "1 s")])) == "title\n  time       1 s"


def test_records_show_the_fields_that_were_given() -> None:
    post = Obstacle(name="post", box=(0.1, 0.1, 0.6), position=(0.5, 0.0, 0.3))
    assert repr(post) == str(post) == "Obstacle(name='post', box=(0.1, 0.1, 0.6), position=(0.5, 0.0, 0.3))"
    goal = Goal(alignment=Alignment(kind="pour", first="a", second="b"))
    assert repr(goal) == "Goal(alignment=Alignment(kind='pour', first='a', second='b'))"


def test_digests_of_robots_do_not_depend_on_how_records_show_themselves() -> None:
    ball = Body(name="a", sphere={"radius": 0.1})
    assert _spelled((("x",), [(1, 2)], (ball,))) == (
        "(('x',), [(1, 2)], (Body(name='a', box=None, sphere=Sphere(radius=0.1), cylinder=None, capsule=None, "
        "mesh=None, points=None, voxels=None, distance_grid=None, half_space=None, position=(0.0, 0.0, 0.0), "
        "orientation=(0.0, 0.0, 0.0, 1.0)),))"
    )


@pytest.mark.parametrize(
    "kind", [PoseTarget, Alignment, Obstacle, AttachedObject, Goal, RobotConfig, CheckpointConfig, Problem]
)
def test_help_of_a_record_fits_a_screen(kind: type[StrictModel]) -> None:
    text = pydoc.plain(pydoc.render_doc(kind))
    assert len(text.splitlines()) < (80 if kind is Problem else 50)
    assert "pydantic_" not in text and "model_" not in text
    assert {*inspect.signature(kind).parameters} == {one.alias or name for name, one in kind.model_fields.items()}


def test_the_signature_of_a_record_is_as_it_is_written() -> None:
    target = PoseTarget(frame="left_hand_palm", position=(0.5, 0.2, 0.4))  # after which pydantic has made its own
    assert str(inspect.signature(PoseTarget)) == (
        "(*, frame: Name, position: Vector, orientation: Quaternion | None = None, "
        "tolerance: PoseTolerance = PoseTolerance(), free_turn: Literal['x', 'y', 'z'] | None = None, "
        "turn: tuple[float, float] | None = None, lower: Vector = (0.0, 0.0, 0.0), "
        "upper: Vector = (0.0, 0.0, 0.0), approach: Approach | None = None)"
    )
    assert re.search(r"joints: tuple\[JointValues, \.\.\.\] \| None = None", str(inspect.signature(Goal)))
    assert "model_copy" in dir(target) and target.model_copy() == target
