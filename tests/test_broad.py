"""The suites ``broad`` and ``unseen``: parts and their algebra, grammars, drawn problems, and how scenes are given."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import trimesh
from support import ROOT

from apex_ompl import problems
from apex_ompl.api import load_problem
from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.shapes import coal_geometry
from apex_ompl.errors import ParameterError
from apex_ompl.generation.records import problem_record
from apex_ompl.generation.units import Unit, plan_units
from apex_ompl.kernel import Kernel
from apex_ompl.kernel.distance_grid import grid_of_triangles
from apex_ompl.problems.broad import built, shapes
from apex_ompl.problems.broad.composition import Composition, at, site
from apex_ompl.problems.broad.difficulty import difficulty, sprint
from apex_ompl.problems.broad.ends import clear_parts, scene_of
from apex_ompl.problems.broad.held import KINDS, OPEN, draw_held
from apex_ompl.problems.broad.levels import GRAMMARS
from apex_ompl.problems.broad.representation import (
    MESH,
    POINTS,
    SURFACE,
    Group,
    draw_plan,
    given,
    obstacles,
    part_of,
)  # fmt: skip
from apex_ompl.problems.broad.scattered import solid
from apex_ompl.problems.broad.surfaces import distances, mesh, surface_points, triangles
from apex_ompl.problems.catalogue import ProblemId
from apex_ompl.problems.frozen import digest
from apex_ompl.problems.generator import first_drawn
from apex_ompl.problems.suite_robot import empty_hand_tables
from apex_ompl.robot import Robot
from apex_ompl.scene.meshes import edges_of, is_watertight

LEVELS = [(suite, level) for suite, levels in GRAMMARS.items() for level in levels]
FREE = 800_500  # seeds of validation from here on are not frozen


def some_parts(count: int = 12, seed: int = 0) -> shapes.Parts:
    rng = np.random.default_rng(seed)
    return [
        p for _ in range(count) for p in shapes.place(solid(rng, 0.05, 0.3), shapes.shift(*rng.uniform(-0.4, 0.4, 3)))
    ]


def poses(parts: shapes.Parts) -> np.ndarray:
    return np.array([part.pose for part in parts])


def name_of(suite: str, level: str, seed: int) -> str:
    return f"{suite}/{level}/{seed + (suite == 'unseen') * FREE}"


def nearest(parts: shapes.Parts, points: np.ndarray) -> np.ndarray:
    return distances(parts, points).min(axis=0)


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
    for seed in range(60):
        rng = np.random.default_rng([5, seed])
        one = GRAMMARS[suite][level](rng)
        placed = one.placed(site(rng, one))
        assert 0 < len(one.parts) == len(placed.parts) and one.places
        sizes = np.array([[v for v in part.size if v] for part in one.parts], dtype=object)
        assert all(min(row) >= shapes.THINNEST and max(row) < 3.0 for row in sizes)
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
    assert problems.load(name) == problem and problem.name == name
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
    names = [name_of(*pair, 4) for pair in LEVELS[::8]]
    code = "import sys; from apex_ompl import problems; from apex_ompl.problems.frozen import digest\n"
    code += "print([digest(problems.load(name)) for name in sys.argv[1:]])"
    done = subprocess.run([sys.executable, "-c", code, *names[::-1]], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == str([digest(problems.load(name)) for name in names[::-1]])


def test_combinators_agree_with_closed_forms() -> None:
    parts = some_parts()
    for axis in range(3):
        once = shapes.mirror(parts, axis)
        assert np.array_equal(poses(shapes.mirror(once, axis)), poses(parts))
        points = np.random.default_rng(1).uniform(-0.6, 0.6, (200, 3))
        flipped = points * np.where(np.arange(3) == axis, -1.0, 1.0)
        np.testing.assert_allclose(distances(once, flipped), distances(parts, points), atol=1e-12)
        np.testing.assert_allclose(np.linalg.det(poses(once)[:, :3, :3]), 1.0)
    pose = shapes.shift(0.1, 0.2, 0.3) @ shapes.turn((1, 2, 3), 0.7)
    back = shapes.place(shapes.place(parts, pose), np.linalg.inv(pose))
    np.testing.assert_allclose(poses(back), poses(parts), atol=1e-12)
    np.testing.assert_allclose(
        nearest(shapes.scale(parts, 2.0), 2.0 * points), 2.0 * nearest(parts, points), atol=1e-12
    )
    box = shapes.bounds(shapes.nest(parts, low := np.array([0.1, 0.2, 0.3]), high := np.array([0.4, 0.8, 0.5])))
    assert (box[0] >= low - 1e-9).all() and (box[1] <= high + 1e-9).all()
    assert np.isclose((box[1] - box[0]) / (high - low), 1.0).any()
    left = shapes.extents(shapes.without(parts, -0.2 * np.ones(3), 0.2 * np.ones(3)))
    assert 0 < len(left) < len(parts) and ((left[:, 0] >= 0.2) | (left[:, 1] <= -0.2)).any(axis=1).all()
    rings = shapes.circle(7, 0.5)
    np.testing.assert_allclose([np.hypot(*p[:2, 3]) for p in rings], 0.5)
    np.testing.assert_allclose(sum(p[:2, 3] for p in rings), 0.0, atol=1e-12)
    assert len(shapes.grid((2, 3, 4), (1, 1, 1))) == 24
    np.testing.assert_allclose(sum(p[:3, 3] for p in shapes.grid((2, 3, 4), (1, 2, 3))), 0.0, atol=1e-12)
    extents = shapes.extents(parts)
    for k, part in enumerate(parts):
        on = surface_points(part, 0.01)
        assert (on >= extents[k, 0] - 1e-9).all() and (on <= extents[k, 1] + 1e-9).all()
        np.testing.assert_allclose([on.min(axis=0), on.max(axis=0)], extents[k], atol=0.012)


def test_windows_shells_tubes_and_curves_are_where_they_are_said_to_be() -> None:
    rng = np.random.default_rng(2)
    panel = built.window(1.0, 0.8, 0.02, (-0.2, -0.1), (0.15, 0.3))
    inside = np.column_stack([np.zeros(300), rng.uniform(-0.2, 0.15, 300), rng.uniform(-0.1, 0.3, 300)])
    assert len(panel) == 4 and (nearest(panel, inside) >= -1e-9).all()
    outside = np.column_stack([np.zeros(300), rng.uniform(-0.5, 0.5, 300), rng.uniform(0.31, 0.4, 300)])
    assert (nearest(panel, outside) < 0.0).all()
    shell = built.hollow_box(0.3, 0.4, 0.5, 0.02, ("near", "top"))
    assert len(shell) == 4 and nearest(shell, np.zeros((1, 3)))[0] == pytest.approx(0.15)
    assert nearest(shell, np.array([[-0.2, 0.0, 0.0]]))[0] > 0.1 and nearest(shell, np.array([[0.16, 0.0, 0.0]]))[0] < 0
    pipe = built.tube(0.2, 0.6, 0.01, 12)
    angles = rng.uniform(0.0, 2.0 * np.pi, 200)
    around = np.column_stack([np.cos(angles), np.sin(angles), rng.uniform(-0.29, 0.29, 200)])
    assert (nearest(pipe, around * (0.199, 0.199, 1.0)) > 0.0).all()
    assert (nearest(pipe, around * (0.2085, 0.2085, 1.0)) < 0.0).all()
    through = rng.uniform(-0.3, 0.3, (5, 3))
    curve = built.smooth(through, 41)
    np.testing.assert_allclose(curve[::10], through, atol=1e-12)
    assert (nearest(built.bend(curve, 0.02), curve) <= -0.02 + 1e-9).all()
    hung = built.sagging((0, 0, 1), (1, 0, 1), 0.25, 11)
    assert hung[5, 2] == pytest.approx(0.75) and hung[0, 2] == hung[-1, 2] == 1.0
    two = Composition(panel, [at(0.1, 0.2, 0.3, (0.0, 1.0, 0.0))]).mirrored()
    assert two.places[0].fingers == (0.0, -1.0, 0.0) and two.places[0].point.tolist() == [0.1, -0.2, 0.3]


def test_meshes_and_points_agree_with_the_parts_that_they_are_made_from() -> None:
    parts = [*some_parts(9), *shapes.ball(0.25), *shapes.rod((0.0, 0.0, 0.0), (0.1, 0.2, 0.4), 0.04)]
    rng = np.random.default_rng(3)
    around = rng.uniform(-0.8, 0.8, (300, 3))
    away = around[nearest(parts, around) > 0.01]
    for is_open in (False, True):
        vertices, faces = mesh(parts, is_open=is_open)
        corners = vertices[faces]
        assert is_open or is_watertight(corners)
        assert not (is_open and not len(edges_of(vertices, faces).open))
        on = rng.dirichlet((1, 1, 1), (len(faces), 20))
        samples = np.einsum("tsk,tkd->tsd", on, corners).reshape(-1, 3)
        gaps = np.linalg.norm(away[:, None] - samples[None, ::7], axis=2).min(axis=1)
        assert (gaps > nearest(parts, away) - 1e-6).all(), "a mesh lies in its parts"
        closest = trimesh.triangles.closest_point(
            np.tile(corners, (12, 1, 1)), np.repeat(away[:12], len(faces), axis=0)
        )
        gaps = np.linalg.norm(closest.reshape(12, -1, 3) - away[:12, None], axis=2).min(axis=1)
        np.testing.assert_allclose(gaps, nearest(parts, away[:12]), atol=0.02 * 0.25)
        grid = grid_of_triangles(corners, solid=not is_open)
        assert grid.box[0] == pytest.approx(shapes.bounds(parts)[0], abs=0.01)
    for part in parts:
        vertices, faces = triangles(part)
        assert is_watertight(vertices[faces])
        assert np.abs(distances([part], vertices)).max() < 1e-9
        middles = vertices[faces].mean(axis=1)
        assert -0.03 * max(part.size) < distances([part], middles).min() and distances([part], middles).max() < 1e-9
        a, b, c = np.moveaxis(vertices[faces] - part.pose[:3, 3], 1, 0)
        assert np.einsum("ij,ij->", a, np.cross(b, c)) > 0.0, "outwards"
        cloud, fine = surface_points(part, 0.02), surface_points(part, 0.012)
        assert np.linalg.norm(fine[:, None] - cloud[None], axis=2).min(axis=1).max() <= 0.75 * 0.02
        assert np.abs(distances([part], cloud)).max() < 1e-9


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
    plans = [draw_plan(rng) for _ in range(400)]
    shares = [sum(set(plan.forms) == forms for plan in plans) / 400 for forms in ({""}, {MESH}, {SURFACE}, {POINTS})]
    assert 0.6 < shares[0] < 0.8 and min(shares[1:]) > 0.03
    for plan in plans:
        found = plan.groups(170)
        assert all(0 <= group.first < group.last <= 170 and group.last - group.first <= 170 for group in found)
        assert plan.swelling > 0.0 or all(group.form != POINTS for group in found)


def test_parts_near_the_ends_are_left_out(robot: Robot) -> None:
    parts = some_parts(200, 7)
    placed = shapes.place(parts, shapes.shift(0.4, 0.3, 0.4))
    ends = np.stack([robot.home, robot.home + 0.1])
    tables = empty_hand_tables().both
    left = clear_parts(tables, placed, ends, 0.01)
    assert 0 < len(left) < len(placed)
    kernel = Kernel(tables, scene_of(left))
    assert kernel.clearance(ends, 0.02)[:, 0].min() >= 0.01
    chosen = {id(part) for part in left}
    gone = [part for part in placed if id(part) not in chosen]
    for part in gone[:10]:
        assert Kernel(tables, scene_of([part])).clearance(ends, 0.05)[:, 0].min() < 0.02


def test_classes_of_difficulty_are_in_order(robot: Robot) -> None:
    tables = empty_hand_tables().both
    drawn = first_drawn(ProblemId("broad", "boulders", 3))[1]
    ends = np.stack([drawn.start, drawn.goal])
    free = Kernel(tables, scene_of(()))
    near = np.stack([robot.home, robot.home + 0.05])
    rng = np.random.default_rng(0)
    assert difficulty(free, near, rng) == 0 and sprint(free, near, rng)
    shut = built.hollow_box(0.9, 1.2, 1.2, 0.05, ())
    walls = Kernel(tables, scene_of(shapes.place(shut, shapes.shift(0.75, 0.9, 0.5))))
    found = [difficulty(walls, ends, np.random.default_rng(1), wanted) for wanted in range(4)]
    assert found == sorted(found) and all(value <= wanted for wanted, value in enumerate(found))
    assert found == [difficulty(walls, ends, np.random.default_rng(1), wanted) for wanted in range(4)]


def test_held_objects_are_of_all_kinds_and_free_of_the_fingers(robot: Robot) -> None:
    seen, hands = set(), []
    for seed in range(60):
        held = draw_held(np.random.default_rng([2, seed]))
        hands.append(len({body.link for body in held.attached}))
        seen |= {kind for kind in KINDS for body in held.attached if kind in body.name}
        assert (held.low <= held.high).all() and held.tables.both.dof == robot.dof
    assert seen == set(KINDS)
    assert 0.3 < hands.count(0) / 60 < 0.65 and hands.count(1) > 5 and hands.count(2) > 5


def test_broad_units_have_a_strategy_of_their_own() -> None:
    assert Unit("broad", "arches", 2, 3).strategy == "broad" and Unit("vertical", "free", 0).strategy == "open"
