"""Tables of robots and scenes: read, saved, and cut to some joints or pairs."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import coal
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_robots import frames, random_hand, random_robot
from support import ROOT, states_around_home

from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.tables import joint_specs, primitives
from apex_ompl.errors import FileFormatError, MissingFileError, ParameterError, UnknownNameError
from apex_ompl.kernel import Kernel, joint_tree
from apex_ompl.kernel.compiled.arrays import BINS, FIXED, RUN
from apex_ompl.kernel.scene_builder import scene_tables
from apex_ompl.kernel.tables import RobotTables, pair_runs, with_pairs
from apex_ompl.robot import Robot, load_robot
from apex_ompl.scene.bodies import Obstacle


def test_tables_are_saved_and_loaded_without_pinocchio(robot: Robot, post: Obstacle, tmp_path: Path) -> None:
    kernel = CollisionChecker(robot, [post]).kernel
    states = states_around_home(robot, np.random.default_rng(1), 5)
    kernel.robot.save(tmp_path / "robot.npz")
    np.save(tmp_path / "states.npy", states)
    code = f"""
import sys, numpy as np
for name in ("pinocchio", "coal", "ompl"):
    sys.modules[name] = None
from apex_ompl.kernel import Kernel
from apex_ompl.kernel.scene_builder import Primitive, scene_tables
from apex_ompl.kernel.arrays import BOX
from apex_ompl.kernel.tables import RobotTables
at = np.eye(4)
at[:3, 3] = {list(post.position)}
box = Primitive(BOX, at, {tuple(e / 2 for e in post.box)})
kernel = Kernel(RobotTables.load({str(tmp_path / "robot.npz")!r}), scene_tables([(0, box)]))
np.save({str(tmp_path / "values.npy")!r}, kernel.clearance(np.load({str(tmp_path / "states.npy")!r})))
"""
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT, timeout=120)
    alone = Kernel(kernel.robot, scene_tables([(0, p) for p in primitives(coal.Box(*post.box), post.pose)]))
    assert np.array_equal(np.load(tmp_path / "values.npy"), alone.clearance(states))


def test_faulty_tables_are_refused(tmp_path: Path) -> None:
    tables, *_ = random_robot(0)
    tables.save(tmp_path / "good.npz")
    assert RobotTables.load(tmp_path / "good.npz").body_names == tables.body_names
    with pytest.raises(MissingFileError, match="no.npz"):
        RobotTables.load(tmp_path / "no.npz")
    (tmp_path / "text.npz").write_text("hello")
    with pytest.raises(FileFormatError, match=r"text.npz.*kernel tables"):
        RobotTables.load(tmp_path / "text.npz")
    (tmp_path / "short.npz").write_bytes((tmp_path / "good.npz").read_bytes()[:-400])
    with pytest.raises(FileFormatError, match="short.npz"):
        RobotTables.load(tmp_path / "short.npz")
    for name, wrong in {
        "joint_parent": tables.arrays.joint_parent + 7, "bodies": tables.arrays.bodies + 90,
        "node_radius": tables.arrays.node_radius * np.nan, "node_first": tables.arrays.node_first * 0,
        "pair_bodies": tables.arrays.pair_bodies + 50, "lower": tables.arrays.lower[:-1],
        "node_count": -tables.arrays.node_count, "node_outer": -tables.arrays.node_outer,
        "joint_source": np.full_like(tables.arrays.joint_source, -1), "eager": tables.arrays.eager[::-1].copy(),
        "pair_common": np.full_like(tables.arrays.pair_common, len(tables.arrays.joint_parent) - 1),
    }.items():  # fmt: skip
        bad = RobotTables("bad", tables.joint_names, tables.body_names, tables.numbers,
                          tables.arrays._replace(**{name: wrong}))  # fmt: skip
        bad.save(tmp_path / "bad.npz")
        with pytest.raises(FileFormatError, match=name):
            RobotTables.load(tmp_path / "bad.npz")


def test_damaged_tables_are_faults_and_no_crash(tmp_path: Path) -> None:
    tables, *_ = random_robot(1)
    tables.save(tmp_path / "good.npz")
    good, rng = (tmp_path / "good.npz").read_bytes(), np.random.default_rng(0)
    kernel = Kernel(tables, scene_tables([]))
    expected = kernel.clearance(np.zeros(tables.dof))
    for _ in range(200):
        bad = bytearray(good)
        for place in rng.integers(0, len(bad), 3):
            bad[place] = rng.integers(0, 256)
        (tmp_path / "bad.npz").write_bytes(bad)
        try:
            loaded = RobotTables.load(tmp_path / "bad.npz")
        except FileFormatError:
            continue
        assert np.array_equal(Kernel(loaded, scene_tables([])).clearance(np.zeros(tables.dof)), expected)
    np.save(tmp_path / "plain.npy", np.zeros(3))
    with pytest.raises(FileFormatError, match="kernel tables"):
        RobotTables.load(tmp_path / "plain.npy")


@pytest.mark.parametrize("ratio", [0.3, -1.57, 6.3, 10.0, -25.0, 40.0])
@pytest.mark.parametrize("driver", ["revolute", "prismatic"])
def test_mimic_ratios_are_read_as_they_are(ratio: float, driver: str) -> None:
    limit = '<limit lower="-2" upper="2" velocity="1" effort="1"/>'
    urdf = f"""<robot name="g">
      <link name="a"/><link name="b"/><link name="c"/>
      <joint name="slide" type="{driver}"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>{limit}</joint>
      <joint name="turn" type="revolute"><parent link="b"/><child link="c"/><origin xyz="0.1 0 0" rpy="0.3 0.2 0.1"/>
        <axis xyz="0 0.6 0.8"/>{limit}<mimic joint="slide" multiplier="{ratio}" offset="0.2"/></joint></robot>"""
    model = pin.buildModelFromXML(urdf, mimic=True)
    limits = SimpleNamespace(lower=np.array([-2.0]), upper=np.array([2.0]))
    robot = SimpleNamespace(model=model, dof=1, limits=limits, to_pinocchio=lambda q: np.asarray(q, float))
    specs = joint_specs(robot)  # type: ignore[arg-type]
    assert specs[2].ratio == pytest.approx(abs(ratio), rel=1e-9)
    data = model.createData()
    for value in (-2.0, -0.7, 0.0, 0.3, 1.9):
        pin.forwardKinematics(model, data, np.array([value]))
        assert frames(specs, np.array([value]))[2] == pytest.approx(data.oMi[2].homogeneous, abs=1e-8)


@settings(max_examples=60)
@given(seed=st.integers(0, 2**32 - 1))
def test_tables_for_one_side_check_that_side_alone(robot: Robot, seed: int) -> None:
    rng = np.random.default_rng(seed)
    ball = Obstacle(name="ball", sphere={"radius": 0.1}, position=tuple(rng.uniform([0.2, -0.6, 0.1], [0.7, 0.6, 0.8])))
    whole = CollisionChecker(robot, [ball]).kernel
    sides = [[k for k, name in enumerate(robot.joint_names) if name.startswith(side)] for side in ("left", "right")]
    kernels = [Kernel(whole.robot.restricted_to(joints), whole.scene) for joints in sides]
    q, other = states_around_home(robot, rng, 2)
    everything, parts = whole.clearance(q)[0], [kernel.clearance(q)[0] for kernel in kernels]
    assert everything[0] == min(parts[0][0], parts[1][0])  # all that moves is moved by one side or the other
    assert everything[1] <= min(parts[0][1], parts[1][1])
    for joints, kernel, part in zip(reversed(sides), kernels, parts, strict=True):
        mixed = q.copy()
        mixed[joints] = other[joints]  # the other side does not count
        assert np.array_equal(kernel.clearance(mixed)[0], part)


def test_pairs_between_the_sides_are_left_to_the_whole(robot: Robot) -> None:
    whole = CollisionChecker(robot).kernel
    sides = [[k for k, name in enumerate(robot.joint_names) if name.startswith(side)] for side in ("left", "right")]
    kernels = [Kernel(whole.robot.restricted_to(joints), whole.scene) for joints in sides]
    q = robot.home.copy()
    q[[0, 1, 7, 8]] = -1.2, 0.3, 1.2, 0.3  # the hands meet in the middle
    assert whole.clearance(q)[0, 1] < 0.0 < min(kernel.clearance(q)[0, 1] for kernel in kernels)


def test_a_pair_can_be_left_out(robot: Robot) -> None:
    whole = CollisionChecker(robot).kernel
    q = robot.home.copy()
    q[[0, 1, 7, 8]] = -1.5, 0.3, 1.5, 0.3
    found, counts = whole.unproved(q)
    assert counts[0] == 1 and whole.clearance(q)[0, 1] < 0.0
    a, b = (whole.robot.body_names[k] for k in found[0, 0])
    smaller = Kernel(whole.robot.without_pair(b, a), whole.scene)
    assert smaller.unproved(q)[1][0] == 0 and smaller.clearance(q)[0, 1] > 0.0
    for other in states_around_home(robot, np.random.default_rng(5), 50):  # elsewhere nothing changes
        assert np.array_equal(smaller.clearance(other), whole.clearance(other))
    right = [k for k, name in enumerate(robot.joint_names) if name.startswith("right")]
    side = whole.robot.restricted_to(right)
    tables = side, side.without_pair(a, b), whole.robot.without_pair(a, b).restricted_to(right)
    for state in states_around_home(robot, np.random.default_rng(6), 50, 1.0):
        values = [Kernel(some, whole.scene).clearance(state) for some in tables]  # the pair is not of one side
        assert np.array_equal(values[0], values[1]) and np.array_equal(values[0], values[2])
    with pytest.raises(UnknownNameError, match="body"):
        whole.robot.without_pair("no_such_body", a)
    with pytest.raises(ParameterError, match="joints"):
        whole.robot.restricted_to([99])


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from(["dual_panda_softhand", "baxter"]))
def test_balls_of_pairs_hold_the_bodies_that_they_are_about(seed: int, name: str) -> None:
    robot, rng = load_robot(name), np.random.default_rng(seed)
    tables = CollisionChecker(robot).kernel.robot
    a, kernel = tables.arrays, CollisionChecker(robot).kernel
    q = rng.uniform(a.lower, a.upper)[None]
    rotation, origin = (frames[0] for frames in kernel.joint_frames(q))
    ends = np.append(a.body_root, len(a.node_first))
    smaller = 0
    for p, clusters in enumerate(a.pair_clusters):
        first, count = a.pair_bodies[p]
        for side, cluster in enumerate(clusters):
            joint = a.cluster_joint[cluster]
            center = rotation[joint] @ a.pair_ball[p, side, :3] + origin[joint]
            smaller += a.pair_ball[p, side, 3] < 0.9 * a.cluster_ball[cluster, 3]
            for body in np.unique(a.bodies[first : first + count, side]):
                nodes = np.arange(ends[body], ends[body + 1])
                where = a.node_center[nodes] @ rotation[a.body_joint[body]].T + origin[a.body_joint[body]]
                away = np.linalg.norm(where - center, axis=1)
                assert away[0] + a.node_radius[nodes[0]] <= a.pair_ball[p, side, 3]
                leaves = a.node_count[nodes] == 0
                assert (away + a.node_radius[nodes])[leaves].max() <= a.pair_outer[p, side]
    assert smaller > 0 or name == "baxter"


def check_parts(tables: RobotTables, states: np.ndarray) -> None:
    """The spheres of each part are inside of its balls, and parts are what clusters are made of."""
    a, kernel = tables.arrays, Kernel(tables, scene_tables([]))
    rotation, origin = kernel.joint_frames(states)
    for c, (first, count) in enumerate(a.cluster_parts.tolist()):
        members = [b for p in range(first, first + count) for b in range(a.part_bodies[p, 0], sum(a.part_bodies[p]))]
        assert members == list(range(a.cluster_bodies[c, 0], sum(a.cluster_bodies[c])))
        top, dof = a.cluster_joint[c], a.cluster_dof[c]
        shares = (states[:, dof] - a.lower[dof]) / (a.upper[dof] - a.lower[dof]) if dof >= 0 else np.zeros(len(states))
        bins = np.clip(np.floor(BINS * shares), 0, BINS - 1).astype(int)
        for p in range(first, first + count):
            joints = set(a.lazy[a.part_lazy[p, 0] : sum(a.part_lazy[p])].tolist())
            balls = a.part_ball[p, bins]
            centers = np.einsum("nij,nj->ni", rotation[:, top], balls[:, :3]) + origin[:, top]
            for b in range(a.part_bodies[p, 0], sum(a.part_bodies[p])):
                joint, root = a.body_joint[b], a.body_root[b]
                assert joint == top or joint in joints
                placed = rotation[:, joint] @ a.node_center[root] + origin[:, joint]
                away = np.linalg.norm(placed - centers, axis=1)
                assert (away + a.node_radius[root] <= balls[:, 3]).all()
                assert (away + a.node_outer[root] <= a.part_outer[p, bins]).all()


@settings(max_examples=40)
@given(st.integers(0, 10**6))
def test_parts_of_clusters_are_inside_of_their_balls(seed: int) -> None:
    tables, *_ = random_hand(seed)
    states = np.random.default_rng(seed).uniform(tables.arrays.lower, tables.arrays.upper, (40, tables.dof))
    states[:2] = tables.arrays.lower, tables.arrays.upper
    check_parts(tables, states)


def test_hands_have_parts_and_loaded_tables_one_of_each_cluster(robot: Robot, tmp_path: Path) -> None:
    tables, rng = CollisionChecker(robot, []).kernel.robot, np.random.default_rng(0)
    states = rng.uniform(robot.limits.lower, robot.limits.upper, (400, robot.dof))
    states[:, -2:] = np.linspace(0.0, 1.0, 400)[:, None]
    check_parts(tables, states)
    hands = tables.arrays.cluster_dof >= 0
    assert tables.arrays.cluster_parts[hands, 1].tolist() == [6, 6], "the palm and five fingers"
    narrow = tables.arrays.part_ball[tables.arrays.cluster_parts[hands, 0][0] + 1, :, 3]
    assert (narrow < 0.6 * tables.arrays.cluster_ball[hands, 3][0]).all()
    tables.save(tmp_path / "robot.npz")
    loaded = RobotTables.load(tmp_path / "robot.npz")
    check_parts(loaded, states)
    assert (loaded.arrays.cluster_parts[:, 1] == 1).all()


def test_runs_of_pairs_are_the_pairs(robot: Robot) -> None:
    a = CollisionChecker(robot, []).kernel.robot.arrays
    chosen = np.random.default_rng(0).random(len(a.pair_common)) < 0.7
    for arrays in (a, with_pairs(a, chosen)):
        pairs = [
            (one, other + k, first + k) for one, other, first, count in arrays.run_pairs.tolist() for k in range(count)
        ]
        assert [(one, other) for one, other, _ in pairs] == [tuple(row) for row in arrays.pair_clusters.tolist()]
        assert [k for *_, k in pairs] == list(range(len(pairs)))
    assert len(a.run_pairs) < len(a.pair_common) / 3
    row = np.stack([np.zeros(20, int), np.arange(1, 21)], axis=1)
    assert pair_runs(row).tolist() == [[0, 1, 0, RUN], [0, 1 + RUN, RUN, RUN], [0, 1 + 2 * RUN, 2 * RUN, 4]]


def test_what_has_too_many_fingers_is_one_part(monkeypatch: pytest.MonkeyPatch) -> None:
    assert (random_hand(3)[0].arrays.cluster_parts[:, 1] > 1).any()
    monkeypatch.setattr(joint_tree, "MOST_PARTS", 1)
    tables, *_ = random_hand(3)
    assert (tables.arrays.cluster_parts[:, 1] == 1).all()
    check_parts(tables, np.random.default_rng(0).uniform(tables.arrays.lower, tables.arrays.upper, (40, tables.dof)))


def test_joint_frames_of_hands_are_those_of_the_tree() -> None:
    for seed in range(20):
        tables, specs, *_ = random_hand(seed)
        states = np.random.default_rng(seed).uniform(tables.arrays.lower, tables.arrays.upper, (5, tables.dof))
        rotation, origin = Kernel(tables, scene_tables([])).joint_frames(states)
        for q, turned, at in zip(states, rotation, origin, strict=True):
            wanted = frames(specs, q)
            np.testing.assert_allclose(at, [one[:3, 3] for one in wanted], atol=1e-12)
            axes = [one[:3, :3] @ spec.axis for one, spec in zip(wanted[1:], specs[1:], strict=True)]
            moving = np.array([spec.kind != FIXED for spec in specs[1:]])
            np.testing.assert_allclose(turned[1:, :, 2][moving], np.array(axes)[moving], atol=1e-12)


def test_tables_that_name_joints_too_often_are_refused(tmp_path: Path) -> None:
    tables, *_ = random_hand(0)
    for name in ("eager", "cluster_lazy"):
        array = getattr(tables.arrays, name)
        long = np.repeat(array, 1000) if name == "eager" else np.concatenate([[[0, 99]], array[1:]])
        RobotTables(
            tables.name, tables.joint_names, tables.body_names, tables.numbers, tables.arrays._replace(**{name: long})
        ).save(tmp_path / "bad.npz")
        with pytest.raises(FileFormatError, match=name):
            RobotTables.load(tmp_path / "bad.npz")
