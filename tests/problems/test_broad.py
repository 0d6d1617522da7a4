"""The suites ``broad`` and ``unseen``: grammars, drawn problems, and how scenes are given."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from parts import poses, some_parts
from support import ROOT

from apex_ompl import problems
from apex_ompl.api import load_problem
from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.shapes import coal_geometry
from apex_ompl.errors import ParameterError
from apex_ompl.kernel import Kernel
from apex_ompl.problems import broad_parts, catalogue
from apex_ompl.problems.broad import GRAMMARS
from apex_ompl.problems.broad_parts import site
from apex_ompl.problems.broad_representation import (
    MESH,
    POINTS,
    SURFACE,
    Group,
    draw_representation,
    given,
    obstacles,
    part_of,
)  # fmt: skip
from apex_ompl.problems.broad_tasks import KINDS, OPEN, clear_parts, difficulty, draw_held, scene_of, sprint
from apex_ompl.problems.catalogue import ProblemId, first_drawn
from apex_ompl.problems.frozen import digest
from apex_ompl.problems.robot_cells import standard_cell
from apex_ompl.robot import Robot
from apex_ompl.training.units import Unit, plan_units, problem_record

LEVELS = [(suite, level) for suite, levels in GRAMMARS.items() for level in levels]
FREE = 800_500  # seeds of validation from here on are not frozen


def name_of(suite: str, level: str, seed: int) -> str:
    return f"{suite}/{level}/{seed + (suite == 'unseen') * FREE}"


def test_a_quarter_of_the_grammars_is_never_trained_with() -> None:
    trained, unseen = set(GRAMMARS["broad"]), set(GRAMMARS["unseen"])
    assert not trained & unseen and len(trained | unseen) >= 24
    assert len(unseen) >= 7 and len(unseen) >= (len(trained) + len(unseen)) / 4
    levels = {(unit.suite, unit.level) for unit in plan_units(5000, ["broad"])}
    assert levels == {("broad", v) for v in trained | {"free", "alignment"}}
    assert "unseen" not in {unit.suite for unit in plan_units(20_000)}
    share = sum(u.size for u in plan_units(40_000) if u.suite == "broad") / sum(u.size for u in plan_units(40_000))
    assert 0.6 < share < 0.73


def test_unseen_problems_are_refused_for_training() -> None:
    for only in ("unseen", "unseen/net", "unseen/nothing"):
        with pytest.raises(ParameterError, match="unseen is for validation only") as caught:
            plan_units(100, [only])
        assert "\n" not in str(caught.value)
    for seed in (0, 799_999, 900_000):
        with pytest.raises(ParameterError, match="unseen is for validation only"):
            ProblemId("unseen", "net", seed)
        with pytest.raises(ParameterError, match="unseen is for validation only"):
            load_problem(f"unseen/net/{seed}")
    units = plan_units(400, ["unseen"], "validation")
    assert {unit.level for unit in units} == set(GRAMMARS["unseen"])
    assert min(min(unit.seeds) for unit in units) >= 800_000 and max(max(unit.seeds) for unit in units) < 900_000
    script = [sys.executable, str(ROOT / "scripts" / "generate_data.py"), "nowhere", "unseen/net"]
    done = subprocess.run(script, check=False, capture_output=True, text=True)
    assert done.returncode == 2 and "validation only" in done.stderr and "Traceback" not in done.stderr


@pytest.mark.parametrize(("suite", "level"), LEVELS)
def test_every_grammar_gives_parts_and_places_for_any_random_numbers(suite: str, level: str) -> None:
    for seed in range(12):
        rng = np.random.default_rng([5, seed])
        one = GRAMMARS[suite][level](rng)
        placed = one.placed(site(rng, one))
        assert 0 < len(one.parts) == len(placed.parts) and one.places
        sizes = np.array([[v for v in part.size if v] for part in one.parts], dtype=object)
        assert all(min(row) >= broad_parts.THINNEST and max(row) < 3.0 for row in sizes)
        turns = poses(placed.parts)[:, :3, :3]
        np.testing.assert_allclose(turns @ turns.transpose(0, 2, 1), np.broadcast_to(np.eye(3), turns.shape), atol=1e-9)
        np.testing.assert_allclose(np.linalg.det(turns), 1.0)
        for where in placed.places:
            assert np.isfinite(where.point).all()
            assert where.fingers is None or np.linalg.norm(where.fingers) == pytest.approx(1.0)
        assert obstacles(placed.parts[:20])


@pytest.mark.parametrize(("suite", "level"), LEVELS)
def test_drawn_problems_keep_a_centimetre_at_both_ends(robot: Robot, suite: str, level: str) -> None:
    """By the distances of the exact shapes; aligned objects may touch each other at the goal."""
    name = name_of(suite, level, 3)
    problem = problems.load(name)
    assert problem.name == name
    ends = np.stack([problem.start_state(robot.joint_names), problem.goal_states(robot.joint_names)[0]])
    primitives = problems.primitives(problem)
    assert 0 < len(primitives) <= 300
    hands = [body.link for body in problem.attached]
    aligned = len(set(hands)) == 2 and any(body.contact for body in problem.attached)
    checker = CollisionChecker(robot, problem.scene, problem.attached, proofs=False)
    for q in ends:
        assert robot.limit_fault(q) is None and checker.is_free(q)
        assert (checker.obstacle_distance(q[None]) if aligned else checker.clearance(q)) >= 0.01
    for side, joint in enumerate(robot.groups["hands"]):
        hand = list(robot.hands.values())[side]
        holds = hand.palm in hands
        assert ends[0, joint] == ends[1, joint] if holds else (ends[:, joint] <= OPEN[1]).all()
    record = problem_record(problem, 3)
    assert len(record.obstacles) == len(primitives)


def test_another_process_draws_the_same() -> None:
    names = [name_of(*pair, 4) for pair in LEVELS[::4]]
    code = "import sys; from apex_ompl import problems; from apex_ompl.problems.frozen import digest\n"
    code += "print([digest(problems.load(name)) for name in sys.argv[1:]])"
    done = subprocess.run([sys.executable, "-c", code, *names[::-1]], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == str([digest(problems.load(name)) for name in names[::-1]])


def test_a_scene_is_given_as_files_of_its_parts() -> None:
    primitives = obstacles(some_parts(10))
    groups = (Group(MESH, 0, 4), Group(POINTS, 4, 6, 0.02), Group(SURFACE, 7, 9))
    scene = given(primitives, groups)
    assert [body.shape for body in scene] == [primitives[6].shape, primitives[9].shape, "mesh", "points", "mesh"]
    assert given(primitives, groups) == scene, "files are named by their content"
    for body in scene:
        coal_geometry(body)
    parts = [part_of(one) for one in primitives]
    np.testing.assert_allclose(poses(parts), poses(some_parts(10)), atol=3e-4)
    rng = np.random.default_rng(4)
    drawn = [draw_representation(rng) for _ in range(400)]
    shares = [sum(set(one.forms) == forms for one in drawn) / 400 for forms in ({""}, {MESH}, {SURFACE}, {POINTS})]
    assert 0.6 < shares[0] < 0.8 and min(shares[1:]) > 0.03
    for one in drawn:
        found = one.groups(170)
        assert all(0 <= group.first < group.last <= 170 and group.last - group.first <= 170 for group in found)
        assert one.swelling > 0.0 or all(group.form != POINTS for group in found)


def test_parts_near_the_ends_are_left_out(robot: Robot) -> None:
    parts = some_parts(200, 7)
    placed = broad_parts.place(parts, broad_parts.shift(0.4, 0.3, 0.4))
    ends = np.stack([robot.home, robot.home + 0.1])
    tables = standard_cell().tables.whole
    left = clear_parts(standard_cell(), tables, placed, ends, 0.01)
    assert 0 < len(left) < len(placed)
    kernel = Kernel(tables, scene_of(left))
    assert kernel.clearance(ends, 0.02)[:, 0].min() >= 0.01
    chosen = {id(part) for part in left}
    gone = [part for part in placed if id(part) not in chosen]
    for part in gone[:10]:
        assert Kernel(tables, scene_of([part])).clearance(ends, 0.05)[:, 0].min() < 0.02


def test_classes_of_difficulty_are_in_order(robot: Robot) -> None:
    tables = standard_cell().tables.whole
    drawn = first_drawn(ProblemId("broad", "boulders", 3))[1]
    ends = np.stack([drawn.start, drawn.goal])
    free = Kernel(tables, scene_of(()))
    near = np.stack([robot.home, robot.home + 0.05])
    rng = np.random.default_rng(0)
    assert difficulty(free, near, rng) == 0 and sprint(free, near, rng)
    shut = broad_parts.hollow_box(0.9, 1.2, 1.2, 0.05, ())
    walls = Kernel(tables, scene_of(broad_parts.place(shut, broad_parts.shift(0.75, 0.9, 0.5))))
    found = [difficulty(walls, ends, np.random.default_rng(1), wanted) for wanted in range(4)]
    assert found == sorted(found) and all(value <= wanted for wanted, value in enumerate(found))
    assert found == [difficulty(walls, ends, np.random.default_rng(1), wanted) for wanted in range(4)]


def test_obstacles_of_a_problem_as_primitives_are_not_drawn_again(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = problems.load("broad/boulders/7")
    monkeypatch.setattr(catalogue, "draw", None)
    assert len(problems.primitives(problem, enclosing=True)) > 0


def test_held_objects_are_of_all_kinds_and_free_of_the_fingers(robot: Robot) -> None:
    seen, hands = set(), []
    for seed in range(40):
        held = draw_held(np.random.default_rng([2, seed]))
        hands.append(len({body.link for body in held.attached}))
        seen |= {kind for kind in KINDS for body in held.attached if kind in body.name}
        assert (held.low <= held.high).all() and held.tables.whole.dof == robot.dof
    assert seen == set(KINDS)
    assert 0.3 < hands.count(0) / 40 < 0.65 and hands.count(1) > 4 and hands.count(2) > 4


def test_broad_units_have_a_strategy_of_their_own() -> None:
    assert Unit("broad", "arches", 2, 3).strategy == "broad" and Unit("vertical", "free", 0).strategy == "open"
