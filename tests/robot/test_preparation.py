from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from toy_robot import LIMIT, write_toy

from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.cover import pairs, preparation
from apex_ompl.collision.cover.neighbors import GRAZING, apart_over, reason_of_neighbors, taken_in
from apex_ompl.collision.cover.pairs import PairSearch
from apex_ompl.collision.cover.preparation import Preparation, prepare
from apex_ompl.collision.cover.spheres import make_cover, read_covers, read_efforts, unproved
from apex_ompl.collision.cover.survey import survey
from apex_ompl.errors import ParameterError, UnknownNameError
from apex_ompl.robot import load_robot
from apex_ompl.robot.config import read_disabled_pairs, read_disabled_pairs_file
from apex_ompl.robot.model import bare_robot
from apex_ompl.robot.new import new_robot, sources_of
from apex_ompl.robot.self_collision import SelfCollision, enabled_pairs, links_of_pair

QUICK = Preparation(effort=1, pairs=PairSearch(samples=600))
BAR = '<collision><geometry><box size="0.05 0.05 0.2"/></geometry></collision>'
TURN = '<origin xyz="0 0 0.3"/><axis xyz="0 1 0"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint>'
BARS = f"""<robot name="my"><link name="base">{BAR}</link><link name="on">{BAR}</link><link name="tip">{BAR}</link>
<joint name="one" type="revolute"><parent link="base"/><child link="on"/>{TURN}
<joint name="two" type="revolute"><parent link="on"/><child link="tip"/>{TURN}</robot>"""
FILE = """schema: apex-ompl/robot/1
name: my
parts: [{name: arm, urdf: my.urdf}]  # of bars
joints:
  one: {acceleration: 1, jerk: 9}
  two: {acceleration: 1, jerk: 9}
"""


def write_bars(folder: Path, more: str = "") -> Path:
    """Write a robot of three bars that never touch."""
    (folder / "my.urdf").write_text(BARS)
    (folder / "my.robot.yaml").write_text(FILE + more)
    return folder / "my.robot.yaml"


def write_arm(folder: Path, edits: dict[str, str] | None = None) -> Path:
    return new_robot(sources_of([str(write_toy(folder, edits))]), folder / "toy.robot.yaml").file


@pytest.mark.parametrize("named", [False, True])
def test_a_prepared_robot_names_its_files_and_keeps_its_comments(tmp_path: Path, named: bool) -> None:
    pairs_file, covers = ("a.yaml", "b.json") if named else ("my.pairs.yaml", "my.spheres.json")
    path = write_bars(tmp_path, f"disabled_pairs: {pairs_file}\ncovers: {covers}\n" * named)
    for _ in range(2):
        done = prepare(path, QUICK)
        assert done.thorough and done.pairs == 3 and done.covers == {1: 1} and done.missing == 0
        text = path.read_text()
        lines = sorted(text.removeprefix(FILE).splitlines())
        assert text.startswith(FILE) and lines == [f"covers: {covers}", f"disabled_pairs: {pairs_file}"]
        robot = load_robot(path)
        assert robot.covers == tmp_path / covers and not robot.geometry.collisionPairs
        assert read_disabled_pairs(tmp_path / pairs_file) == [("base", "on"), ("base", "tip"), ("on", "tip")]
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted({"my.urdf", "my.robot.yaml", pairs_file, covers})


def test_covers_are_proved_and_one_for_each_shape(tmp_path: Path) -> None:
    path = write_arm(tmp_path)
    done = prepare(path, QUICK)
    robot, covers = load_robot(path), read_covers(tmp_path / "toy.spheres.json")
    assert done.covers == {1: 3} and len(covers) == 3  # stand, parts and fingers
    for item in robot.geometry.geometryObjects:
        key = preparation.shape_key(item.geometry)
        assert not len(unproved(item.geometry, covers[key]))


def test_what_is_done_is_not_done_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, made = write_arm(tmp_path), []

    def one_at_a_time(shapes, effort, jobs, deadline):  # type: ignore[no-untyped-def]
        made.append((list(shapes), effort))
        return real(dict(list(shapes.items())[:1]), effort, jobs, deadline)

    real = preparation._made
    monkeypatch.setattr(preparation, "make_cover", lambda shape, effort: make_cover(shape, effort=1))
    monkeypatch.setattr(preparation, "_made", one_at_a_time)  # as if stopped after one
    for left in (1, 0):  # after quick covers at first, and again with the time that is left
        done = prepare(path, QUICK)
        assert done.missing == left and done.thorough == (left == 0)
    assert [len(keys) for keys, _ in made] == [3, 2, 1] and set(made[2][0]) < set(made[1][0]) < set(made[0][0])
    prepare(path, QUICK)
    assert made[3] == ([], 1)
    done = prepare(path, Preparation(effort=2, pairs=QUICK.pairs))
    assert done.covers == {1: 2, 2: 1} and not done.thorough
    assert sorted(read_efforts(tmp_path / "toy.spheres.json").values()) == [1, 1, 2]


def test_a_budget_that_is_used_up_leaves_whole_files_and_a_robot_to_plan_for(tmp_path: Path) -> None:
    path = write_arm(tmp_path)
    done = prepare(path, Preparation(budget=1e-6))
    assert not done.thorough and done.missing == 3
    assert CollisionChecker(load_robot(path)).is_free(load_robot(path).home)
    again = prepare(path, QUICK)
    assert again.thorough and again.pairs > done.pairs


def test_a_changed_robot_gets_its_pairs_anew(tmp_path: Path) -> None:
    path = write_bars(tmp_path)
    prepare(path, QUICK)
    before = read_disabled_pairs_file(tmp_path / "my.pairs.yaml").robot
    (tmp_path / "my.urdf").write_text(BARS.replace('xyz="0 0 0.3"', 'xyz="0 0 0.15"'))  # the bars touch now
    assert prepare(path, QUICK).pairs < 3
    assert read_disabled_pairs_file(tmp_path / "my.pairs.yaml").robot != before


def test_disabled_pairs_touch_at_no_random_state_or_at_all(tmp_path: Path) -> None:
    path = write_arm(tmp_path)
    prepare(path, QUICK)
    robot, _, _ = bare_robot(str(path))
    checks = SelfCollision(robot)
    hits = checks.hits(robot.random_state(np.random.default_rng(7), 2000)).mean(axis=0)
    disabled = set(read_disabled_pairs(tmp_path / "toy.pairs.yaml"))
    assert disabled
    for pair, share in zip(checks.pairs, hits, strict=True):
        assert links_of_pair(robot, pair) not in disabled or share in (0.0, 1.0)
        assert links_of_pair(robot, pair) in disabled or share < 1.0


@pytest.mark.parametrize("reach", [1.2, 2.6])
def test_neighbors_are_proved_apart_over_a_joint_as_by_brute_force(tmp_path: Path, reach: float) -> None:
    limit = LIMIT.replace('"-2"', f'"-{reach}"').replace('"2"', f'"{reach}"', 1)
    path = write_arm(tmp_path, {f'<axis xyz="0 1 0"/>{LIMIT}': f'<axis xyz="0 1 0"/>{limit}'})
    robot = load_robot(path)
    for pair in enabled_pairs(robot):
        links = links_of_pair(robot, pair)
        if links != ("part1", "part2"):
            continue
        checks = SelfCollision(robot, [pair])
        states = np.tile(robot.home, (2000, 1))
        states[:, 1] = np.linspace(robot.limits.lower[1], robot.limits.upper[1], 2000)
        assert apart_over(robot, pair) == ("" if checks.hits(states).any() else "joint2")
        assert checks.hits(states).any() == (reach > 2.0)


def write_cubes(folder: Path, gap: float) -> Path:
    """Write two cubes that turn against each other, some millimeters apart, or in contact below 0."""
    cube = "".join(f"v {x} {y} {z}\n" for x in (0, 0.1) for y in (0, 0.1) for z in (0, 0.1))
    sides = ("1 2 4 3", "5 7 8 6", "1 5 6 2", "3 4 8 7", "1 3 7 5", "2 6 8 4")
    faces = "".join(f"f {a} {b} {c}\nf {a} {c} {d}\n" for a, b, c, d in map(str.split, sides))
    (folder / "cube.obj").write_text(cube + faces)
    body = '<collision><geometry><mesh filename="cube.obj"/></geometry></collision>'
    text = BARS.replace(BAR, body).replace('xyz="0 0 0.3"', f'xyz="0 0 {0.1 + 1e-3 * gap}"')
    (folder / "my.robot.yaml").write_text(FILE)
    (folder / "my.urdf").write_text(text.replace('axis xyz="0 1 0"', 'axis xyz="0 0 1"'))
    return folder / "my.robot.yaml"


@pytest.mark.parametrize(("gap", "reason"), [(0.05, "never, at"), (-0.3, "adjacent"), (-1.6, "")])
def test_neighbors_that_touch_as_bearings_do_are_told_from_others(tmp_path: Path, gap: float, reason: str) -> None:
    robot, _, _ = bare_robot(str(write_cubes(tmp_path, gap)))
    (pair,) = [p for p in enabled_pairs(robot) if links_of_pair(robot, p) == ("base", "on")]
    found, strict, lax = (reason_of_neighbors(robot, pair, graze) for graze in (1e-3, 0.0, 4e-3))
    assert found.startswith(reason) and bool(found) == bool(reason)
    assert strict == (found if gap > 0.0 else "")  # what touches is checked
    assert lax.startswith(GRAZING if gap < 0.0 else reason)
    mesh = robot.geometry.geometryObjects[0].geometry
    inner, outer = np.array(taken_in(mesh, 0.01).vertices()), np.array(mesh.vertices())
    assert np.allclose(np.linalg.norm(inner - outer, axis=1), 0.01) and (np.abs(inner - 0.05) < 0.0465).all()


def test_pairs_that_graze_are_named_and_may_be_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Cubes that are in contact at every angle are otherwise disabled as those that always touch."""
    monkeypatch.setattr(pairs, "ALWAYS", 1.1)
    file = write_cubes(tmp_path, -0.3)
    for graze in (1e-3, 0.0, 1e-3):  # another depth decides the pairs anew
        done = prepare(file, Preparation(effort=1, pairs=PairSearch(samples=500, graze=graze)))
        named = (("base", "on"), ("on", "tip")) if graze else ()
        assert done.grazing == named and survey(load_robot(file), 50).grazing == named
        assert (named == ()) == bool(enabled_pairs(load_robot(file)))
    for depth in (-1e-3, 0.02, math.nan):
        with pytest.raises(ParameterError, match="graze"):
            PairSearch(graze=depth)


def test_soft_parts_are_parts_of_the_robot(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="unknown part 'hand'"):
        prepare(write_bars(tmp_path), Preparation(pairs=PairSearch(soft=("hand",))))
    for faulty in ({"budget": 0.0}, {"budget": math.nan}, {"jobs": 0}, {"effort": 4}):
        with pytest.raises(ParameterError):
            Preparation(**faulty)


def test_a_survey_counts_what_meshes_and_covers_say(tmp_path: Path) -> None:
    robot = load_robot(write_arm(tmp_path))
    found = survey(robot, 400, seed=3)
    states = robot.random_state(np.random.default_rng(3), 400)
    slow = CollisionChecker(robot, proofs=False)
    free = [q for q in states if slow.is_free(q)]
    assert found.free == len(free) / 400 and found.home == "" and found.open_meshes == ()
    _, numbers = CollisionChecker(robot).kernel.unproved(np.array(free))
    assert found.proved == np.mean(numbers == 0) and max(found.spoilers.values()) <= 1.0 - found.proved + 1e-12
    assert not found.unlimited and len(found.never) + len(found.always) <= len(enabled_pairs(robot))


def test_a_cover_in_the_file_is_that_of_the_search(tmp_path: Path) -> None:
    box = '<box size="0.06 0.06 0.2"/>'
    (tmp_path / "t.obj").write_text("v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 0.1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n")
    path = write_arm(tmp_path, {box: '<mesh filename="t.obj"/>'})
    prepare(path, Preparation(effort=1, pairs=PairSearch(samples=500)))
    covers, efforts = read_covers(tmp_path / "toy.spheres.json"), read_efforts(tmp_path / "toy.spheres.json")
    assert set(efforts.values()) == {1} and efforts.keys() == covers.keys()
    (mesh,) = (item.geometry for item in load_robot(path).geometry.geometryObjects if item.name == "part1_0")
    again, kept = make_cover(mesh, effort=1), covers[preparation.shape_key(mesh)]
    assert np.array_equal(again.radii, kept.radii) and np.array_equal(again.centers, kept.centers)
