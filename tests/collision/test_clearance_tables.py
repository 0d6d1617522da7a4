"""Tables of clearances of links that are few joints apart, against Coal's distances and the meshes alone."""

from __future__ import annotations

from pathlib import Path

import coal
import numpy as np
import pinocchio as pin
import pytest
from near_links import write_arm

from apex_ompl import load_robot
from apex_ompl.collision import CollisionChecker, clearance_tables
from apex_ompl.collision.clearance_making import TableMaker, TableReport, make_clearances, prepare_clearances
from apex_ompl.collision.clearance_tables import clearance_file, near_pairs, read_clearances, table_of, write_clearances
from apex_ompl.collision.solids import transform
from apex_ompl.collision.tables import joint_tree
from apex_ompl.errors import FileFormatError
from apex_ompl.kernel import Kernel
from apex_ompl.kernel.clearance_table import THIN, UNIT
from apex_ompl.paths.path import Path as States
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import Obstacle


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A robot without tables, and the same with tables, in folders of their own."""
    folder = tmp_path_factory.mktemp("near")
    for name in ("bare", "tabled"):
        (folder / name).mkdir()
        write_arm(folder / name)
    assert prepare_clearances(robot_of(folder, "tabled")) == folder / "tabled" / "near_links.clearances.npz"
    return folder


def robot_of(folder: Path, name: str) -> Robot:
    return load_robot(str(folder / name / "near_links.robot.yaml"))


@pytest.fixture(scope="module")
def bare(folder: Path) -> Robot:
    return robot_of(folder, "bare")


@pytest.fixture(scope="module")
def tabled(folder: Path) -> Robot:
    return robot_of(folder, "tabled")


def distance(robot: Robot, pair: tuple[int, int], q: np.ndarray) -> float:
    """Coal's distance of two links."""
    items, data = [robot.geometry.geometryObjects[k] for k in pair], robot.model.createData()
    pin.forwardKinematics(robot.model, data, robot.to_pinocchio(q))
    poses = [transform(data.oMi[item.parentJoint] * item.placement) for item in items]
    shapes = [x for item, pose in zip(items, poses, strict=True) for x in (item.geometry, pose)]
    return float(coal.distance(*shapes, coal.DistanceRequest(), coal.DistanceResult()))


def names_of(robot: Robot, pair: tuple[int, int]) -> tuple[str, str]:
    return tuple(robot.geometry.geometryObjects[k].name.removesuffix("_0") for k in pair)  # type: ignore[return-value]


def pairs_of(robot: Robot) -> list[clearance_tables.NearPair]:
    stage = CollisionChecker(robot).meshes
    return near_pairs(robot, joint_tree(robot), [stage.solids[k] for k in range(stage.links)], stage.body_pairs)


def test_pairs_that_depend_on_one_to_three_planned_joints_are_found(bare: Robot) -> None:
    turn, lift, bend = range(3)
    found = {names_of(bare, pair.links): pair.sources for pair in pairs_of(bare)}
    assert {pair: set(sources) for pair, sources in found.items()} == {
        ("base", "column"): {turn},
        ("base", "upper"): {turn, lift},
        ("base", "lower"): {turn, lift, bend},
        ("base", "tip"): {turn, lift, bend},
        ("column", "upper"): {lift},
        ("column", "lower"): {lift, bend},
        ("column", "tip"): {lift, bend},  # the last joint follows the one before
        ("upper", "lower"): {bend},
        ("upper", "tip"): {bend},
        ("lower", "tip"): {bend},
    }


def test_a_box_is_never_nearer_than_its_bound(bare: Robot) -> None:
    maker, rng = TableMaker(bare), np.random.default_rng(0)
    near = positive = 0
    for pair in pairs_of(bare):
        for width in (0.02, 0.2, 0.6):
            half = np.zeros(bare.dof)
            half[list(pair.sources)] = width * rng.uniform(0.2, 1.0, len(pair.sources))
            middles = bare.random_state(rng, 12)
            bounds = maker.bounds(pair, middles, half, least=-1.0, need=1.0)
            for middle, bound in zip(middles, bounds, strict=True):
                corners = middle + half * rng.choice([-1.0, 0.0, 1.0], (8, bare.dof))
                states = np.concatenate([[middle], corners, middle + half * rng.uniform(-1.0, 1.0, (12, bare.dof))])
                least = min(distance(bare, pair.links, q) for q in states)
                assert bound <= least + 1e-7
                positive += bool(bound > 0.0)
                near += bool(width < 0.1 and least > 0.01 and bound > 0.5 * least)
    assert positive > 80  # the bounds are not trivial
    assert near > 40


def test_a_proved_cell_is_free_and_as_far_as_it_says(tabled: Robot) -> None:
    cells, rng, number = read_clearances(clearance_file(tabled)), np.random.default_rng(1), 0
    for pair in pairs_of(tabled):
        if pair.key not in cells:
            continue
        table, n = table_of(tabled, pair, cells[pair.key]), len(cells[pair.key])
        states = tabled.random_state(rng, 1500)
        values = states[:, list(pair.sources)]
        places = np.floor((values - table.lower) / (table.upper - table.lower) * n).astype(int)
        values = table.cells[tuple(places.T)]
        bounds = np.where(values == 1, THIN, values * UNIT)
        distances = np.array([distance(tabled, pair.links, q) for q in states])
        assert (bounds <= np.maximum(distances, 0.0) + 1e-9).all()
        assert (bounds[distances > 0.01] > 0.0).mean() > 0.95  # what is clearly free is proved
        number += 1
    assert number >= 3


def test_states_and_motions_are_free_exactly_where_the_meshes_say_so(tabled: Robot) -> None:
    checker, meshes = CollisionChecker(tabled), CollisionChecker(tabled, proofs=False)
    rng = np.random.default_rng(2)
    states = tabled.random_state(rng, 4000)
    free = meshes.are_free(states)
    np.testing.assert_array_equal(checker.are_free(states), free)
    proved = checker.kernel.unproved(states)[1] == 0
    assert not (proved & ~free).any()
    ends = tabled.random_state(rng, 1500)
    starts = states[: len(ends)] if free.all() else states[free][: len(ends)]
    steps, wrong, number = np.linspace(0.0, 1.0, 40)[:, None], 0, 0
    for a, b in zip(starts, a_little_further(starts, ends), strict=False):
        if checker.kernel.proves(np.stack([a, b]), 0.02):
            number += 1
            wrong += not meshes.are_free(a + steps * (b - a)).all()
    assert wrong == 0
    assert number > 300


def a_little_further(starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """States a fifth of the way to others."""
    return starts + 0.2 * (ends[: len(starts)] - starts)


def test_tables_prove_states_that_the_covers_leave_open(bare: Robot, tabled: Robot) -> None:
    states = bare.random_state(np.random.default_rng(3), 1000)
    free = CollisionChecker(bare, proofs=False).are_free(states)
    shares = [(CollisionChecker(r).kernel.unproved(states[free])[1] == 0).mean() for r in (bare, tabled)]
    assert shares[0] < 0.8
    assert shares[1] > 0.97


def test_clearances_of_the_kernel_stay_below_the_distances(bare: Robot, tabled: Robot) -> None:
    states, positive = tabled.random_state(np.random.default_rng(4), 200), []
    pairs = [(pair.first, pair.second) for pair in tabled.geometry.collisionPairs]
    pairs = [pair for pair in pairs if names_of(tabled, pair) != ("base", "column")]  # their covers meet, always
    true = np.array([min(distance(tabled, pair, q) for pair in pairs) for q in states])
    for robot in (bare, tabled):
        kernel = CollisionChecker(robot).kernel
        apart = Kernel(kernel.robot.without_pair("base_0", "column_0"), kernel.scene)
        own, gradient = (values[:, 1] for values in apart.clearance_gradient(states))
        assert (own <= np.maximum(true, 0.0) + 1e-9)[own > 0.0].all()
        assert np.isfinite(gradient).all()
        positive.append(int((own > 0.0).sum()))
    assert positive[0] + 10 < positive[1]


def test_proofs_of_paths_find_the_same_clearance(bare: Robot, tabled: Robot) -> None:
    states = bare.random_state(np.random.default_rng(5), 40)
    free = states[CollisionChecker(bare, proofs=False).are_free(states)]
    for a, b in zip(free[:-1], free[1:], strict=True):
        path = np.stack([a, a + 0.15 * (b - a)])
        one, two = (CollisionChecker(robot).prove(path) for robot in (bare, tabled))
        assert one.ok == two.ok
        if one.ok:
            assert one.clearance == pytest.approx(two.clearance, abs=3e-5)


def test_tables_of_other_shapes_joints_or_limits_are_not_used(folder: Path, tmp_path: Path) -> None:
    file = write_arm(tmp_path)
    keys = {names_of(robot, pair.links): pair.key for robot in [load_robot(str(file))] for pair in pairs_of(robot)}
    urdf = tmp_path / "near_links.urdf"
    text = urdf.read_text()
    for old, new, changed in (
        ('radius="0.05"', 'radius="0.06"', "column"), ('upper="2.5"', 'upper="2.4"', "base"),
        ('xyz="0.3 0 0"/><axis', 'xyz="0.31 0 0"/><axis', "lower"), ('multiplier="0.7"', 'multiplier="0.8"', "tip"),
    ):  # fmt: skip
        urdf.write_text(text.replace(old, new))
        robot = load_robot(str(file))
        now = {names_of(robot, pair.links): pair.key for pair in pairs_of(robot)}
        other = {pair for pair in keys if keys[pair] != now[pair]}
        assert other
        assert all(changed in pair or pair[1] in ("lower", "tip") for pair in other)


def test_a_budget_of_no_time_makes_no_tables_and_reports_tell_what_was_found(bare: Robot) -> None:
    reports: list[TableReport] = []
    assert make_clearances(bare, 0.0, reports.append) == {}
    assert all(not report.complete for report in reports)
    make_clearances(bare, 60.0, reports.append)
    last = reports[-1]
    assert last.complete
    assert 0.0 < last.proved <= 1.0
    assert " of the range proved" in str(last)


def test_a_second_preparation_keeps_the_tables_of_the_first(folder: Path) -> None:
    file, again = clearance_file(robot_of(folder, "tabled")), list[TableReport]()
    first = file.read_bytes()
    assert prepare_clearances(robot_of(folder, "tabled"), progress=again.append) == file
    assert file.read_bytes() == first
    assert not again


def test_a_file_gets_what_it_lacks_and_loses_what_is_of_another_robot(tmp_path: Path) -> None:
    robot, reports = load_robot(str(write_arm(tmp_path))), list[TableReport]()
    whole = make_clearances(robot)
    gone = next(iter(whole))
    path = clearance_file(robot)
    write_clearances(
        path, {key: cells for key, cells in whole.items() if key != gone} | {"other": np.zeros(8, np.uint8)}
    )
    assert prepare_clearances(robot, progress=reports.append) == path
    assert len(reports) == 1
    found = read_clearances(path)
    assert found.keys() == whole.keys()
    assert all((found[key] == whole[key]).all() for key in whole)


def test_a_file_with_other_cells_replaces_tables_that_are_kept(folder: Path, tmp_path: Path) -> None:
    file, proved = write_arm(tmp_path), []
    cells = read_clearances(clearance_file(robot_of(folder, "tabled")))
    for some in (cells, {key: 0 * one for key, one in cells.items()}):
        write_clearances(clearance_file(load_robot(str(file))), some)
        robot = load_robot(str(file))
        states = robot.random_state(np.random.default_rng(6), 200)
        proved.append((CollisionChecker(robot).kernel.unproved(states)[1] == 0).mean())
    assert proved[0] > proved[1]


@pytest.mark.parametrize("cells", [np.zeros(3, np.uint8), np.zeros(4), np.zeros((4, 2), np.uint8), np.uint8(1)])
def test_files_with_other_content_are_refused(tmp_path: Path, cells: np.ndarray) -> None:
    path = tmp_path / "a.clearances.npz"
    write_clearances(path, {"key": cells})
    with pytest.raises(FileFormatError, match="a power of two"):
        read_clearances(path)


def test_a_table_with_another_number_of_axes_than_joints_is_refused(folder: Path, tmp_path: Path) -> None:
    robot = load_robot(str(write_arm(tmp_path)))
    cells = read_clearances(clearance_file(robot_of(folder, "tabled")))
    write_clearances(clearance_file(robot), {key: np.zeros(8, np.uint8) for key in cells})
    with pytest.raises(FileFormatError, match=r"expected \d axes, one for each joint"):
        assert CollisionChecker(robot).kernel


def test_the_robot_of_the_tables_is_planned_for_with_them(tabled: Robot) -> None:
    arrays = CollisionChecker(tabled).kernel.robot.arrays
    assert (arrays.bodies_table >= 0).sum() == len(arrays.table_cells) >= 3


@pytest.mark.parametrize("gap", [5e-5, 5e-6, -1e-5])
def test_links_that_are_as_close_as_a_bearing_are_proved_apart_by_little(tmp_path: Path, gap: float) -> None:
    """Two disks that turn on each other keep the same distance at every angle: .05 mm is proved, .005 mm is not."""
    disk = '<collision><geometry><cylinder radius="0.05" length="0.1"/></geometry></collision>'
    (tmp_path / "disks.urdf").write_text(
        f'<robot name="disks"><link name="low">{disk}</link><link name="high">{disk}</link><joint name="turn" '
        f'type="revolute"><parent link="low"/><child link="high"/><origin xyz="0 0 {0.1 + gap}"/><axis xyz="0 0 1"/>'
        '<limit lower="-2" upper="2" velocity="1" effort="1"/></joint></robot>'
    )
    (tmp_path / "disks.robot.yaml").write_text(
        "schema: apex-ompl/robot/1\nname: disks\nparts: [{name: disks, urdf: disks.urdf}]\n"
        "joints: {turn: {home: 0.0, acceleration: 1, jerk: 9}}\n"
    )
    robot = load_robot(tmp_path / "disks.robot.yaml")
    made = make_clearances(robot, 20.0)
    if gap < THIN:
        assert not made
        return
    (cells,) = made.values()
    assert (cells == 1).all() and prepare_clearances(robot, 20.0) is not None
    checker, states = CollisionChecker(load_robot(tmp_path / "disks.robot.yaml")), np.linspace(-2, 2, 101)[:, None]
    assert (checker.kernel.unproved(states)[1] == 0).all() and checker.kernel.proves(np.array([[-2.0], [2.0]]), 0.01)
    assert (checker.kernel.clearance(states, 0.01)[:, 1] == 0.01).all()  # bearings do not count
    far = CollisionChecker(checker.robot, [Obstacle(name="box", position=(0.0, 0.0, 0.22 + gap), box=(0.4, 0.4, 0.1))])
    proof = far.prove(States(np.array([[-2.0], [2.0]])))
    assert proof and proof.pair == ("high", "box") and proof.clearance == pytest.approx(0.02, abs=1e-5)
    assert proof.intervals < 1000  # and not thousands, for the distance of the disks along the whole path
