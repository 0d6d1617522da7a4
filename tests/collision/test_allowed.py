"""Pairs of bodies that may touch: in the checker, in plans, in files, and from MoveIt's matrix."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from apex_ompl import MotionPlanner, Problem, load_problem, plan
from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import FileFormatError, SceneError, UnknownNameError
from apex_ompl.paths.path import SEARCH_RESOLUTION
from apex_ompl.robot import Robot
from apex_ompl.robot.moveit import allowed_pairs
from apex_ompl.robot.moveit_messages import MessageReader
from apex_ompl.scene.bodies import AttachedObject, Obstacle


def around(robot: Robot, link: str, name: str = "box", size: float = 0.1) -> Obstacle:
    """A box around the origin of a link at home."""
    at = robot.link_pose(robot.home, link)[:3, 3]
    return Obstacle(name=name, box=(size, size, size), position=tuple(at.tolist()))


def in_hand(name: str = "pen") -> AttachedObject:
    return AttachedObject(
        name=name, link="right_hand_palm", cylinder={"radius": 0.01, "length": 0.3}, position=(0, 0, 0.1)
    )


@pytest.fixture
def crowded(robot: Robot) -> CollisionChecker:
    scene = [around(robot, "right_hand_palm"), around(robot, "left_link5", "post", 0.2)]
    return CollisionChecker(robot, scene, [in_hand()])


def names(checker: CollisionChecker, q: np.ndarray) -> set[frozenset[str]]:
    return {frozenset((c.first, c.second)) for c in checker.contacts(q)}


def test_an_allowed_pair_is_not_checked_by_either_stage(crowded: CollisionChecker, robot: Robot) -> None:
    home, checker = robot.home, crowded
    rng = np.random.default_rng(0)
    states = np.clip(home + 0.2 * rng.normal(size=(12, robot.dof)), robot.limits.lower, robot.limits.upper)
    touching, deep = names(checker, home), checker.kernel.clearance(home[None], 1.0)[0, 0]
    assert touching and not checker.is_free(home)
    before = {k: names(checker, q) for k, q in enumerate(states)}
    for pair in sorted(map(sorted, touching)):
        checker.allow(*pair)
        allowed = {frozenset(p) for p in checker.allowed}
        alone = CollisionChecker(
            robot, checker.obstacles.values(), checker.held.values(), checker.allowed, proofs=False
        )
        for k, q in enumerate(states):
            assert names(checker, q) == before[k] - allowed
            assert checker.is_free(q) == alone.is_free(q) == (not before[k] - allowed)
            assert bool(checker.prove(q[None], tolerance=0.0)) <= checker.is_free(q)
    assert checker.is_free(home) and checker.clearance(home) > 0.0 and checker.prove(home[None])
    near = checker.kernel.clearance(home[None], 1.0)[0, 0]
    assert deep < -0.02 and near > -0.005, "the spheres' clearance, by which paths are optimized, leaves pairs out, too"
    motion = np.stack([home, home + 1e-4])
    assert checker.first_collision(motion, SEARCH_RESOLUTION) is None
    for pair in checker.allowed:
        checker.allow(*pair, allowed=False)
    assert names(checker, home) == touching and not checker.is_free(home)


def test_pairs_of_links_and_held_objects(robot: Robot) -> None:
    checker = CollisionChecker(
        robot, (), [in_hand("pen"), in_hand("rod").model_copy(update={"link": "left_hand_palm"})]
    )
    rng, seen = np.random.default_rng(1), set[frozenset[str]]()
    for q in robot.random_state(rng, 300):
        hits = names(checker, q)
        if len(hits) != 1 or hits <= seen:
            continue
        (pair,) = hits
        checker.allow(*sorted(pair))
        assert checker.is_free(q) and not checker.contacts(q) and checker.clearance(q) > 0.0
        checker.allow(*sorted(pair), allowed=False)
        assert not checker.is_free(q) and names(checker, q) == hits
        seen |= hits
    links = set(robot.link_names)
    assert any(pair <= links for pair in seen) and any(not pair <= links for pair in seen)


def test_a_pair_is_forgotten_with_its_bodies(robot: Robot) -> None:
    with MotionPlanner(robot) as planner:
        planner.world.add(around(robot, "right_hand_palm"))
        planner.world.attach(in_hand())
        planner.world.allow("box", "right_hand_palm")
        planner.world.allow("pen", "box")
        planner.world.allow("left_link5", "right_link5")
        assert pickle.loads(pickle.dumps(planner)).world.allowed == planner.world.allowed
        planner.world.detach("pen")
        assert planner.world.allowed == (("box", "right_hand_palm"), ("left_link5", "right_link5"))
        planner.world.remove("box")
        assert planner.world.allowed == (("left_link5", "right_link5"),)
        planner.world.clear()
        assert planner.world.allowed == ()


def test_unknown_bodies_are_named(robot: Robot) -> None:
    with MotionPlanner(robot) as planner:
        planner.world.add(around(robot, "right_hand_palm"))
        with pytest.raises(UnknownNameError, match="unknown body 'bix', did you mean 'box'"):
            planner.world.allow("bix", "right_hand_palm")
        with pytest.raises(SceneError, match="not checked against itself"):
            planner.world.allow("box", "box")
        assert planner.world.allowed == ()


def test_a_problem_with_allowed_pairs_is_planned_and_kept(robot: Robot, tmp_path: Path) -> None:
    free = load_problem("shelf/medium/800001")
    box = around(robot, "left_link1", "pedestal", 0.2)
    links = ("left_link1", "left_link2", "left_link3")
    hit = [tuple(sorted(("pedestal", link))) for link in links]
    checker = CollisionChecker(robot, (*free.scene, box), free.attached)
    ends = (free.start_state(robot.joint_names), *free.goal_states(robot.joint_names))
    assert all(names(checker, q) and names(checker, q) <= set(map(frozenset, hit)) for q in ends)
    data = {**free.as_dict(), "scene": [*free.as_dict()["scene"], box.model_dump(exclude_none=True)]}
    file = tmp_path / "problem.yaml"
    file.write_text(yaml.safe_dump({**data, "allowed": [list(pair) for pair in hit]}))
    loaded = Problem.load(file)
    assert loaded.allowed == tuple(hit)
    assert plan(loaded, timeout=20.0)
    file.write_text(yaml.safe_dump({**data, "allowed": [["left_link1", "nobody"]]}))
    with pytest.raises(UnknownNameError, match="unknown body 'nobody'"):
        plan(file)
    file.write_text(yaml.safe_dump({**data, "allowed": [["left_link1"]]}))
    with pytest.raises(FileFormatError, match=r"allowed\.0"):
        Problem.load(file)


def matrix(names: list[str], allowed: list[tuple[str, str]], **defaults: bool) -> dict[str, Any]:
    rows = [[(a, b) in allowed or (b, a) in allowed for b in names] for a in names]
    return {
        "entry_names": names, "entry_values": [{"enabled": row} for row in rows],
        "default_entry_names": list(defaults), "default_entry_values": list(defaults.values()),
    }  # fmt: skip


def test_moveits_matrix_is_read(robot: Robot) -> None:
    def read(data: dict[str, Any], bodies: list[str]) -> tuple[list[tuple[str, str]], list[str]]:
        return allowed_pairs(MessageReader(Path("scene.yaml")), data, robot, bodies, {"tool": "left_hand_palm"})

    assert read({}, ["box"]) == ([], [])
    links = ["left_link5", "right_link5", "left_link6", "camera"]
    few = [("left_link5", "right_link5"), ("left_link5", "box"), ("left_link5", "left_link6"), ("camera", "box")]
    pairs, unknown = read(matrix([*links, "box"], few), ["box"])
    assert pairs == [("box", "left_link5"), ("left_link5", "right_link5")], "links that are never checked are left out"
    assert unknown == ["camera"]
    bare = matrix([*links, "box"], few)
    bare["entry_values"] = [row["enabled"] for row in bare["entry_values"]]
    assert read(bare, ["box"]) == (pairs, unknown), "rows without a key, as MotionBenchMaker writes them"
    pairs, _ = read(matrix(["tool", "rack"], [("tool", "rack")]), ["rack/0", "rack/1"])
    assert pairs == [("left_hand_palm", "rack/0"), ("left_hand_palm", "rack/1")]
    pairs, _ = read(matrix(["rug", "left_link5"], [], rug=True), ["rug", "box"])
    assert ("box", "rug") in pairs and ("left_link4", "rug") in pairs and ("left_link5", "rug") not in pairs
    broken = matrix(["a", "b"], [])
    broken["entry_values"].pop()
    mixed = matrix(["a", "b"], [])
    mixed["entry_values"][0] = [False, False]
    with pytest.raises(FileFormatError, match=r"entry_values\.0: expected a mapping"):
        read(mixed, [])
    with pytest.raises(FileFormatError, match="expected 2 rows of 2 values"):
        read(broken, [])
    with pytest.raises(FileFormatError, match="default_entry_values"):
        read({"default_entry_names": ["a"]}, [])


@pytest.mark.parametrize("value", ["false", "true", 0, 1, None])
@pytest.mark.parametrize("key", ["entry_values", "default_entry_values"])
def test_what_is_neither_true_nor_false_allows_nothing(robot: Robot, key: str, value: object) -> None:
    data = matrix(["box", "left_hand_palm"], [], box=False)
    if key == "entry_values":
        data[key][0]["enabled"][1] = value
    else:
        data[key][0] = value
    entry = r"0\.1 \(box, left_hand_palm\)" if key == "entry_values" else r"0 \(box\)"
    with pytest.raises(FileFormatError, match=rf"{key}\.{entry}: expected true or false, got {value!r}"):
        allowed_pairs(MessageReader(Path("scene.yaml")), data, robot, ["box"], {})
