from __future__ import annotations

import coal
import numpy as np
import pinocchio as pin
import pytest
from support import states_around_home

from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.checker import TESTED
from apex_ompl.errors import FileFormatError, MissingFileError, ParameterError, SceneError, UnknownNameError
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject, Obstacle
from apex_ompl.scene.meshes import triangles


def clutter(rng: np.random.Generator, count: int) -> list[Obstacle]:
    """Every kind of primitive in turn."""
    scene = []
    for k in range(count):
        position = tuple(rng.uniform([0.2, -0.8, 0.05], [0.9, 0.8, 0.9]))
        turn = rng.normal(size=4)
        turn = tuple(turn / np.linalg.norm(turn))
        shape = [
            {"box": tuple(rng.uniform(0.05, 0.3, 3))},
            {"sphere": {"radius": 0.08}},
            {"cylinder": {"radius": 0.05, "length": 0.3}},
            {"capsule": {"radius": 0.04, "length": 0.2}},
        ][k % 4]
        scene.append(Obstacle(name=f"o{k}", position=position, orientation=turn, **shape))
    scene.append(Obstacle(name="floor", half_space={"normal": (0.05, 0.0, 1.0), "offset": -0.03}))
    return scene


class Naive:
    """An independent loop over Coal without broadphase or Pinocchio collision code, for solids and meshes alike."""

    def __init__(self, checker: CollisionChecker) -> None:
        self.robot = checker.robot
        self.solids, self.pairs = checker.meshes.solids, checker.meshes.pairs
        self.data = self.robot.model.createData()

    def is_free(self, q: np.ndarray) -> bool:
        pin.forwardKinematics(self.robot.model, self.data, self.robot.to_pinocchio(q))
        poses = {k: self.data.oMi[solid.joint] * solid.placement for k, solid in self.solids.items()}
        for a, b in self.pairs:
            result = coal.CollisionResult()
            transforms = [coal.Transform3s(poses[i].rotation, poses[i].translation) for i in (a, b)]
            first, second = self.solids[a].shape, self.solids[b].shape
            coal.collide(first, transforms[0], second, transforms[1], coal.CollisionRequest(), result)
            if result.isCollision():
                return False
        return True


def near_contact(checker: CollisionChecker, rng: np.random.Generator, count: int) -> np.ndarray:
    """States on both sides of the border of collision, by bisection."""
    found: list[np.ndarray] = []
    while len(found) < count:
        a, b = states_around_home(checker.robot, rng, 2, 0.6)
        if checker.is_free(a) == checker.is_free(b):
            continue
        free_a = checker.is_free(a)
        for _ in range(12):
            middle = (a + b) / 2
            a, b = (middle, b) if checker.is_free(middle) == free_a else (a, middle)
        found += [a, b]
    return np.array(found[:count])


def test_broadphase_agrees_with_a_plain_loop(robot: Robot) -> None:
    rng = np.random.default_rng(3)
    held = AttachedObject(
        name="cup", link="left_hand_palm", cylinder={"radius": 0.035, "length": 0.11}, position=(0, 0.04, -0.05)
    )
    checker = CollisionChecker(robot, clutter(rng, 8), [held])
    naive = Naive(checker)
    states = np.concatenate(
        [states_around_home(robot, rng, 60), robot.random_state(rng, 40), near_contact(checker, rng, 60)]
    )
    ours = [checker.is_free(q) for q in states]
    assert 0.2 < np.mean(ours) < 0.8
    assert ours == [naive.is_free(q) for q in states]


@pytest.mark.parametrize("proofs", [True, False])
def test_the_quick_test_finds_collisions_only_where_there_are_some(robot: Robot, proofs: bool) -> None:
    rng, found, colliding = np.random.default_rng(3), 0, 0
    for _ in range(3):
        checker = CollisionChecker(robot, clutter(rng, 4), proofs=proofs)
        for _ in range(8):
            path = states_around_home(robot, rng, 2, 0.5)
            states = path[0] + TESTED[:, None] * (path[1] - path[0])
            there, quick = not checker.are_free(states).all(), checker.collides_along(path)
            assert there or not quick
            found, colliding = found + quick, colliding + there
    assert colliding > 6 and found >= 0.9 * colliding
    assert not CollisionChecker(robot, proofs=proofs).collides_along(robot.home[None])
    with pytest.raises(ParameterError):
        checker.collides_along(np.zeros((2, 3)))


def test_home_is_free_and_nan_never(robot: Robot, baxter: Robot) -> None:
    for some in (robot, baxter):
        checker = CollisionChecker(some)
        assert checker.is_free(some.home)
        for k in range(some.dof):
            q = some.home.copy()
            q[k] = np.nan
            assert not checker.is_free(q)
        assert checker.check_counts.states == some.dof + 1


def test_contacts_name_the_pair_and_the_depth(robot: Robot) -> None:
    palm = robot.link_pose(robot.home, "left_hand_base")
    flange_radius = 0.0355
    # A box whose face cuts 4 mm into the flange cylinder, square to the cylinder's axis at home.
    side = palm[:3, 3] + palm[:3, :3] @ [flange_radius - 0.004 + 0.05, 0.0, 0.025]
    turn = pin.Quaternion(palm[:3, :3]).coeffs()
    box = Obstacle(name="wall", box=(0.1, 0.02, 0.02), position=tuple(side), orientation=tuple(turn))
    checker = CollisionChecker(robot, [box])
    contacts = checker.contacts(robot.home)
    assert [(c.first, c.second) for c in contacts] == [("left_hand_base", "wall")]
    assert contacts[0].depth == pytest.approx(0.004, abs=1e-5)
    assert str(contacts[0]) == "left_hand_base <-> wall, 4 mm deep"


def test_distance_is_that_of_closed_forms(robot: Robot) -> None:
    tip = robot.link_pose(robot.home, "left_hand_middle_distal") @ np.array([-0.022, 0.0, 0.0, 1.0])
    fingers = -robot.link_pose(robot.home, "left_hand_middle_distal")[:3, 0]  # the left hand is mirrored
    ball = Obstacle(name="ball", sphere={"radius": 0.01}, position=tuple(tip[:3] + 0.06 * fingers))
    checker = CollisionChecker(robot, [ball])
    found = checker.distance(robot.home)
    assert (found.first, found.second) == ("left_hand_middle_distal", "ball")
    assert found.value == pytest.approx(0.06 - 0.01 - 0.007, abs=1e-6)
    assert np.linalg.norm(found.points[0] - found.points[1]) == pytest.approx(found.value, abs=1e-6)
    assert checker.clearance(robot.home) <= found.value + 1e-9
    floor = Obstacle(name="floor", half_space={"normal": (0.0, 0.0, 2.0), "offset": -0.8})
    alone = CollisionChecker(robot, [floor]).distance(robot.home)
    assert alone.second == "floor" and alone.value < 0.8
    assert CollisionChecker(robot).distance(robot.home).value == np.inf
    assert CollisionChecker(robot).distance(robot.home, fixtures=True).second in ("table_left", "table_right")


def test_distance_is_positive_where_free_and_not_where_colliding(robot: Robot) -> None:
    rng = np.random.default_rng(8)
    checker = CollisionChecker(robot, clutter(rng, 6))
    for q in states_around_home(robot, rng, 60):
        clearance = checker.clearance(q)
        if checker.is_free(q):
            assert clearance > -1e-4  # hulls of the arms' convex meshes are the meshes
        else:
            assert clearance <= 1e-4


def test_clearances_of_many_states_are_those_of_coal(robot: Robot) -> None:
    rng = np.random.default_rng(9)
    checker = CollisionChecker(robot, clutter(rng, 6))
    states = states_around_home(robot, rng, 24, 0.6)
    free, found = checker.are_free(states), checker.clearances(states)
    assert 3 < free.sum() < len(states)
    naive, request = Naive(checker), coal.DistanceRequest()
    for q, clearance in zip(states[free][:6], found[free][:6], strict=True):  # a distance of all pairs takes long
        pin.forwardKinematics(robot.model, naive.data, robot.to_pinocchio(q))
        poses = {k: naive.data.oMi[solid.joint] * solid.placement for k, solid in naive.solids.items()}
        placed = {k: (naive.solids[k].shape, coal.Transform3s(p.rotation, p.translation)) for k, p in poses.items()}
        pairs = ((*placed[a], *placed[b]) for a, b in naive.pairs)
        least = min(coal.distance(*pair, request, coal.DistanceResult()) for pair in pairs)
        assert clearance == pytest.approx(least, abs=2e-5)
    np.testing.assert_allclose(found[~free], [checker.clearance(q) for q in states[~free]])
    assert (found[~free] <= 0.0).all() and checker.clearances(states[:0]).shape == (0,)
    with pytest.raises(ParameterError, match="states"):
        checker.clearances(states[:, :3])


def test_scene_changes_equal_a_scene_built_anew(robot: Robot) -> None:
    rng = np.random.default_rng(4)
    scene = clutter(rng, 5)
    changed = CollisionChecker(robot, scene[:3])
    changed.is_free(robot.home)
    for obstacle in scene[3:]:
        changed.add(obstacle)
    changed.remove("o1")
    changed.move("o0", (0.5, 0.2, 0.4))
    cup = AttachedObject(name="cup", link="right_hand_palm", box=(0.06, 0.06, 0.12), position=(0.0, 0.04, -0.05))
    changed.attach(cup)
    moved = scene[0].model_copy(update={"position": (0.5, 0.2, 0.4)})
    built = CollisionChecker(robot, [moved, *scene[2:]], [cup])
    states = states_around_home(robot, rng, 80)
    assert [changed.is_free(q) for q in states] == [built.is_free(q) for q in states]
    changed.detach("cup")
    bare = CollisionChecker(robot, [moved, *scene[2:]])
    assert [changed.is_free(q) for q in states] == [bare.is_free(q) for q in states]
    assert set(changed.obstacle_names) == {"o0", "o2", "o3", "o4", "floor"}


def test_a_held_object_touches_its_hand_only(robot: Robot) -> None:
    inside_hand = {"link": "left_hand_palm", "box": (0.05, 0.05, 0.05)}
    assert CollisionChecker(robot, (), [AttachedObject(name="cube", **inside_hand)]).is_free(robot.home)
    across = {"link": "left_hand_middle_distal", "box": (0.2, 0.2, 0.2)}
    assert not any(
        "left_hand" in str(c)
        for c in CollisionChecker(robot, (), [AttachedObject(name="c", **across)]).contacts(robot.home)
    )
    strict = AttachedObject(name="c", touch_links=("left_hand_middle_distal",), **across)
    touched = {c.first for c in CollisionChecker(robot, (), [strict]).contacts(robot.home)}
    assert "left_hand_index_distal" in touched and "left_hand_middle_distal" not in touched
    reach = AttachedObject(name="rod", link="left_hand_palm", box=(3.0, 0.02, 0.02))
    hit = {c.first for c in CollisionChecker(robot, (), [reach]).contacts(robot.home)}
    assert any(name.startswith("left_link") for name in hit) and not any(n.startswith("left_hand") for n in hit)


def test_faulty_changes_say_what_is_wrong(robot: Robot, checker: CollisionChecker, post: Obstacle, tmp_path) -> None:
    cup = AttachedObject(name="cup", link="left_hand_plam", sphere={"radius": 0.03})
    with pytest.raises(SceneError, match="'post' is taken"):
        checker.add(post)
    with pytest.raises(SceneError, match="'left_link3' is taken"):
        checker.add(post.model_copy(update={"name": "left_link3"}))
    with pytest.raises(SceneError, match="no obstacle 'pst'; there are: .*post"):
        checker.remove("pst")
    with pytest.raises(SceneError, match="no held object 'cup'"):
        checker.detach("cup")
    with pytest.raises(UnknownNameError, match="did you mean 'left_hand_palm'"):
        checker.attach(cup)
    gone = Obstacle(name="bunny", mesh={"file": str(tmp_path / "bunny.stl")})
    with pytest.raises(MissingFileError, match="mesh of 'bunny'.*bunny.stl"):
        checker.add(gone)
    (tmp_path / "bunny.stl").write_text("not a mesh")
    with pytest.raises(FileFormatError, match=r"bunny.stl"):
        checker.add(gone)
    assert checker.is_free(robot.home)


def rotated_half_spaces(rng: np.random.Generator, count: int) -> list[Obstacle]:
    scene = []
    for k in range(count):
        turn = rng.normal(size=4)
        turn = tuple(turn / np.linalg.norm(turn))
        offset = -float(rng.uniform(0.5, 1.0))
        scene.append(Obstacle(name=f"h{k}", half_space={"normal": (0, 0, 1), "offset": offset}, orientation=turn))
    return scene


@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_several_turned_half_spaces_collide_by_their_definition(robot: Robot, count: int) -> None:
    """Coal's boxes around turned half-spaces overflow; here the vertices of the arms' meshes decide."""
    rng = np.random.default_rng(count)
    items = [g for g in robot.geometry.geometryObjects if g.meshPath.endswith("stl") and g.parentJoint > 0]
    clouds = [triangles(g.geometry)[0] for g in items]
    data = robot.model.createData()
    wrong = checked = 0
    for _ in range(12):
        scene = rotated_half_spaces(rng, count)
        checker = CollisionChecker(robot, scene)
        planes = [(s.pose[:3, :3] @ s.half_space.normal, s.half_space.offset) for s in scene]
        for q in states_around_home(robot, rng, 8):
            pin.forwardKinematics(robot.model, data, robot.to_pinocchio(q))
            poses = [data.oMi[g.parentJoint] * g.placement for g in items]
            low = min(
                float((cloud @ pose.rotation.T + pose.translation).dot(n).min() - d)
                for cloud, pose in zip(clouds, poses, strict=True)
                for n, d in planes
            )
            if low < -1e-3:
                checked += 1
                wrong += checker.is_free(q)
    assert checked > 10 and wrong == 0


def test_a_half_space_can_be_moved(robot: Robot) -> None:
    floor = Obstacle(name="floor", half_space={"normal": (0, 0, 1)}, position=(0, 0, -1))
    checker = CollisionChecker(robot, [floor])
    assert checker.is_free(robot.home)
    checker.move("floor", (0, 0, 0.2))
    assert not checker.is_free(robot.home)
    checker.move("floor", (0, 0, -0.5))
    assert checker.is_free(robot.home) and checker.distance(robot.home).second == "floor"


def test_what_a_fixed_link_holds_collides_with_the_arms(baxter: Robot) -> None:
    ball = AttachedObject(name="ball", link="torso", sphere={"radius": 0.9})
    assert not CollisionChecker(baxter, (), [ball]).is_free(baxter.home)
    held = AttachedObject(name="ball", link="left_gripper", sphere={"radius": 0.5})
    names = {c.first for c in CollisionChecker(baxter, (), [held]).contacts(baxter.home)}
    assert names and "left_wrist" not in names


def test_wrong_numbers_of_joints_and_places_are_named(robot: Robot, checker: CollisionChecker) -> None:
    for q in (np.zeros(5), np.zeros(20), np.float64(1.0)):
        with pytest.raises(ParameterError, match=r"state: expected an array of shape \(16,\)"):
            checker.is_free(q)
    for position in ((np.nan, 0.0, 0.0), (1.0, 2.0), (1e300, 0.0, 0.0)):
        with pytest.raises(FileFormatError, match="obstacle 'post': position"):
            checker.move("post", position)
    assert checker.is_free(robot.home)
