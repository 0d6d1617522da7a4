"""Tables of robots in the user's cache: the same as those made anew, whatever has become of the files."""

from __future__ import annotations

import logging
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from apex_ompl.collision import CollisionChecker, tables
from apex_ompl.collision.exact_shapes import PlacedShape, shape_arrays
from apex_ompl.collision.path_proof import _shapes_of_bodies
from apex_ompl.kernel.tables import RobotTables
from apex_ompl.robot import Robot, load_robot
from apex_ompl.robot.config import DATA, read_config
from apex_ompl.robot.model import build_robot
from apex_ompl.scene.bodies import AttachedObject
from apex_ompl.util import cache

HELD = AttachedObject(name="bar", link="left_hand_palm", box=(0.03, 0.03, 0.2), position=(0.0, 0.02, -0.05))

CASES = [("dual_panda_softhand", ""), ("dual_panda_softhand", HELD.link), ("baxter", ""), ("baxter", "left_gripper")]


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "apex_ompl" / "robots"


def fresh(name: str = "dual_panda_softhand") -> Robot:
    """A robot that no table is known of in this process."""
    tables._inner.clear()
    path = DATA / f"{name}.robot.yaml"
    return build_robot(read_config(path), path)


def tables_of(robot: Robot, *held: AttachedObject) -> tuple[RobotTables, Any]:
    checker = CollisionChecker(robot, (), held)
    checker.prepare()
    kernel = checker.kernel
    return kernel.robot, _shapes_of_bodies(robot, checker._spheres.scene, kernel)


def files_in(folder: Path) -> list[str]:
    """Kinds of the files in a folder."""
    return sorted(file.name.split("-")[0] for file in folder.glob("*.npz"))


def assert_same(found: tuple[RobotTables, Any], wanted: tuple[RobotTables, Any]) -> None:
    assert vars(found[0]).keys() == vars(wanted[0]).keys()
    for name in ("name", "joint_names", "body_names", "numbers"):
        assert getattr(found[0], name) == getattr(wanted[0], name)
    for mine, theirs in (
        (found[0].arrays, wanted[0].arrays),
        (found[1], wanted[1]),
        (found[0].packed, wanted[0].packed),
    ):
        for a, b in zip(mine, theirs, strict=True):
            assert a.shape == b.shape and a.dtype == b.dtype and a.tobytes() == b.tobytes()
            assert a.flags.carray, "compiled code takes others for another type"


@pytest.mark.parametrize(("name", "link"), CASES)
def test_tables_from_the_cache_are_those_made_anew(
    name: str, link: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    held = (HELD.model_copy(update={"link": link}),) if link else ()
    made = tables_of(fresh(name), *held)
    assert files_in(folder) == ["inner", "shapes", "tables"]
    with monkeypatch.context() as patch:
        patch.setattr(tables, "make_tables", None)
        patch.setattr(tables, "shape_arrays", None)
        read = tables_of(fresh(name), *held)
    assert_same(read, made)
    monkeypatch.setenv("XDG_CACHE_HOME", "/dev/null")
    assert_same(tables_of(fresh(name), *held), made)


@pytest.mark.parametrize("damage", ["cut off", "empty", "a bit", "other content", "another archive", "a folder"])
def test_a_damaged_file_is_made_anew(damage: str, folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    made = tables_of(fresh())
    for file in folder.glob("*.npz"):
        content = bytearray(file.read_bytes())
        if damage == "another archive":
            np.savez(file, about=np.array("{}"), floats=np.zeros(3))
        elif damage == "a folder":
            file.unlink()
            file.mkdir()
        else:
            content[len(content) // 2] ^= 1
            pieces = {"cut off": content[: len(content) // 2], "empty": b"", "a bit": content, "other content": b"no"}
            file.write_bytes(pieces[damage])
    with caplog.at_level(logging.WARNING, "apex_ompl"):
        assert_same(tables_of(fresh()), made)
    wanted = 0 if damage == "a folder" else 3
    assert sum("makes a file of its cache anew" in record.message for record in caplog.records) == wanted
    caplog.clear()
    assert_same(tables_of(fresh()), made)
    assert not [record for record in caplog.records if record.levelno >= logging.WARNING], "they are whole again"


def test_a_cache_that_cannot_be_written_is_read_or_done_without(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    made = tables_of(fresh())

    def full(*_: Any, **__: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(cache.tempfile, "TemporaryFile", full)  # as where the folder is read-only
    assert_same(tables_of(fresh()), made)
    for file in folder.glob("*.npz"):
        file.unlink()
    assert_same(tables_of(fresh()), made)
    monkeypatch.undo()
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder.parent.parent))
    monkeypatch.setattr("apex_ompl.util.files.os.replace", full)  # the disk is full
    with caplog.at_level(logging.INFO, "apex_ompl"):
        assert_same(tables_of(fresh()), made)
    assert "cannot keep a file of its cache" in caplog.text and not files_in(folder)
    assert not list(folder.iterdir()), "nothing half-written is left"


def test_changed_inputs_make_other_tables(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Limits, meshes, covers, what is held and where, and the code."""
    robot = fresh()
    tables_of(robot)
    assert len(files_in(folder)) == 3
    moved = HELD.model_copy(update={"position": (0.0, 0.02, -0.06)})
    for count, held in ((4, HELD), (5, moved)):  # shapes of links are the same
        first = tables_of(fresh(), held)[0]
        assert len(files_in(folder)) == count
        assert "bar" in first.body_names
    config = read_config(DATA / "dual_panda_softhand.robot.yaml")
    slower = dict(config.joints)
    slower["left_joint1"] = slower["left_joint1"].model_copy(update={"lower": -1.0})
    changed = build_robot(config.model_copy(update={"joints": slower}), DATA / "dual_panda_softhand.robot.yaml")
    assert tables_of(changed)[0].arrays.lower[0] == -1.0
    assert files_in(folder).count("tables") == 4
    bare = build_robot(config.model_copy(update={"covers": None}), DATA / "dual_panda_softhand.robot.yaml")
    assert len(tables_of(bare)[0].arrays.node_radius) != len(tables_of(fresh())[0].arrays.node_radius)
    assert files_in(folder).count("tables") == 5
    monkeypatch.setattr(tables, "_code", lambda: b"other code")
    tables_of(fresh())
    assert files_in(folder).count("tables") == 6


def test_a_changed_mesh_makes_other_tables(folder: Path, tmp_path: Path) -> None:
    urdf = (
        '<robot name="arm"><link name="base"/><link name="rod"><collision><geometry>'
        '<mesh filename="rod.stl"/></geometry></collision></link>'
        '<joint name="turn" type="revolute"><parent link="base"/><child link="rod"/>'
        '<axis xyz="0 0 1"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint></robot>'
    )
    (tmp_path / "arm.urdf").write_text(urdf)
    (tmp_path / "arm.robot.yaml").write_text(
        "schema: apex-ompl/robot/1\nname: arm\nparts: [{name: arm, urdf: arm.urdf}]\n"
        "joints: {turn: {home: 0, acceleration: 1, jerk: 1}}\n"
    )
    import trimesh

    radii = []
    for length in (0.2, 0.4, 0.2):
        trimesh.creation.box((0.05, 0.05, length)).export(tmp_path / "rod.stl")
        radii.append(float(tables_of(load_robot(tmp_path / "arm.robot.yaml"))[0].arrays.node_radius[0]))
    assert radii[0] == radii[2] < radii[1]
    assert files_in(folder).count("tables") == 2


def test_only_the_first_tables_of_a_robot_are_kept(folder: Path) -> None:
    robot = fresh()
    tables_of(robot)
    assert "bar" in tables_of(robot, HELD)[0].body_names
    assert files_in(folder) == ["inner", "shapes", "tables"]


def test_bodies_have_the_shapes_of_links_and_held_objects() -> None:
    """In the order of the tables, as if the shapes were all made at once."""
    robot = fresh()
    checker = CollisionChecker(robot, (), (HELD,))
    checker.prepare()
    kernel, scene = checker.kernel, checker._spheres.scene
    found, turns = _shapes_of_bodies(robot, scene, kernel), [turn.T for turn in tables.joint_tree(robot).turns]
    solids = [scene.solids[number] for number in kernel.robot.numbers]
    wanted = shape_arrays([PlacedShape(s.shape, s.joint, turns[s.joint] @ s.placement.homogeneous) for s in solids])
    for name in ("kind", "joint", "rotation", "offset", "size", "ball", "depth"):
        np.testing.assert_allclose(getattr(found, name), getattr(wanted, name), atol=1e-14)
    assert kernel.robot.body_names.index("bar") < len(solids) - 1
    for k in range(len(solids)):
        assert (found.root[k] >= 0) == (wanted.root[k] >= 0) and (found.graph[k] >= 0) == (wanted.graph[k] >= 0)
        mine, theirs = (a.points[a.points_of[k, 0] :][: a.points_of[k, 1]] for a in (found, wanted))
        np.testing.assert_array_equal(mine, theirs)
        if wanted.root[k] >= 0:
            np.testing.assert_array_equal(found.node_ball[found.root[k]], wanted.node_ball[wanted.root[k]])


def test_the_files_used_least_lately_are_removed(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache, "MOST_FILES", 2)

    def one(name: str) -> dict[str, Any]:
        return cache.stored("robots", name, lambda: ({"name": name}, {"x": np.arange(3)}), lambda about, _: about)

    for age, name in enumerate("ab"):
        assert one(name) == {"name": name}
        os.utime(folder / f"{name}.npz", (age, age))
    one("a")  # is used
    one("c")
    assert files_in(folder) == ["a.npz", "c.npz"]


def test_threads_and_processes_share_a_file(folder: Path) -> None:
    def make() -> tuple[dict[str, Any], dict[str, Any]]:
        return {}, {"x": np.arange(10_000)}

    with ThreadPoolExecutor(8) as pool:
        calls = [pool.submit(cache.stored, "robots", "one", make, lambda _, arrays: arrays["x"]) for _ in range(64)]
        assert all(np.array_equal(call.result(), np.arange(10_000)) for call in calls)
    assert [file.name for file in folder.iterdir()] == ["one.npz"]
