"""What models of scene ``clearances`` see, against the kernel's clearances, mirror images and other representations."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from geometry_files import bumpy_sphere
from models import CLEARANCES, HANDS, kernel, keys, query, some_paths
from models import config as model_config
from support import ROOT
from trainings import HERE, config, query_from_path

from apex_ompl import load_model, plan, problems
from apex_ompl.apex.models import make_query
from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import FileFormatError
from apex_ompl.kernel import Kernel
from apex_ompl.kernel.scene_distances import nearest_points
from apex_ompl.model.array_model import ArrayModel
from apex_ompl.model.config import PIECES
from apex_ompl.model.query import MAX_DISTANCE, ObstacleSet, Probes
from apex_ompl.model.scene_encoding import KEY_RANGE, SceneEncoding, arms
from apex_ompl.problems.objects import bar, two_cups
from apex_ompl.problems.suite_robot import robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.training.conditions import EncodedPaths, batch_queries
from apex_ompl.training.data import Mirror
from apex_ompl.training.records import DatasetError, held_extents
from apex_ompl.training.scene_encoding import TorchSceneEncoding
from apex_ompl.training.store import save
from apex_ompl.training.torch_model import load_torch_model
from apex_ompl.training.training import Trainer

ALONG = 3
MIRROR = Mirror(**yaml.safe_load((ROOT / "scripts" / "configs" / "apex.yaml").read_text())["mirror"])
ROWS = [
    (0, (0.5, 0.1, 0.5), (0, 0, 0, 1), (0.1, 0.7, 0.5)), (1, (0.4, -0.4, 0.8), (0, 0, 0, 1), (0.1, 0.0, 0.0)),
    (3, (0.3, 0.5, 0.3), (0.5, 0.5, 0.5, 0.5), (0.05, 0.4, 0.0)),
]  # fmt: skip


@pytest.fixture(scope="module")
def encoding() -> SceneEncoding:
    return SceneEncoding(keys(), Probes.from_robot(kernel().robot, ALONG), HANDS)


def test_arms_at_key_states_are_in_their_balls(encoding: SceneEncoding) -> None:
    """Clearances at key states are lower bounds of the kernel's, whose fingers are as far closed, and near to them."""
    tables, scene = kernel().robot, ObstacleSet.from_rows(ROWS).tables()
    assert [len(group) for group in arms(tables)] == [7, 7]
    found = encoding.at_keys(encoding.balls(kernel()), scene, None).reshape(-1, 2) * KEY_RANGE
    states = encoding.keys.state.copy()
    states[:, 14:] = 0.5 * (tables.arrays.lower + tables.arrays.upper)[14:]
    for side, joints in enumerate(((*range(7), 14), (*range(7, 14), 15))):
        exact = Kernel(tables.restricted_to(joints), scene).clearance(states)[:, 0]
        exact = np.clip(exact, -KEY_RANGE, KEY_RANGE)
        assert (found[:, side] <= exact + 1e-6).all()
        assert (found[:, side] > exact - 0.09).all() and np.median(exact - found[:, side]) < 0.04
    assert np.ptp(found, axis=0).min() > 0.1


def test_key_states_are_apart_and_survive_half_precision() -> None:
    state, ball = keys().state, keys().ball
    assert len(np.unique(state, axis=0)) == len(state)
    assert np.array_equal(state, state.astype(np.float16)) and np.array_equal(ball, ball.astype(np.float16))
    assert ball.shape == (2, 7, 1 + PIECES, 4)


def test_features_along_the_line_are_distances_of_the_probes(encoding: SceneEncoding) -> None:
    mine = query(3)
    found = encoding.features([mine], kernel())[0]
    assert found.shape == (model_config(**CLEARANCES).scene_features,)
    points = encoding.probes.positions(kernel(), mine.start[None], mine.goal[None])[0].reshape(-1, 3)
    scene, _ = mine.obstacle_tables()
    count, keyed = len(points), keys().state.shape[0] * 2
    distances = found[keyed + 3 * count : keyed + 4 * count] * MAX_DISTANCE
    slopes = found[keyed + 4 * count : keyed + 7 * count].reshape(-1, 3)
    step = 1e-4
    there, _ = nearest_points(scene, points + step * slopes)
    near = (distances > -0.3) & (distances < 0.3)
    assert near.sum() > 10
    rise = (there - distances)[near] / step
    assert np.mean(np.abs(rise - 1.0) < 0.05) > 0.9, "distances grow along their gradients"
    assert found[-14:-7].tolist() == [0.0] * 7 and found[-7] == 1.0, "the right hand holds something"


def test_features_are_those_of_the_mirror_image() -> None:
    """But for the hands, which are not quite alike; arms change places, and y its sign."""
    encoding = SceneEncoding(keys(), Probes.from_robot(kernel().robot, ALONG), HANDS)
    image = replace(encoding.keys, state=MIRROR.states(encoding.keys.state))
    mine = replace(query(5), held=())
    flip = np.array([1.0, -1.0, 1.0])
    rows = [(s, tuple(flip * p), (-q[0], q[1], -q[2], q[3]), size) for s, p, q, size in ROWS]
    theirs = replace(mine, known=ObstacleSet.from_rows(rows), start=MIRROR.states(mine.start))
    theirs = replace(theirs, goal=MIRROR.states(mine.goal))
    found = encoding.features([replace(mine, known=ObstacleSet.from_rows(ROWS))], kernel())[0]
    there = replace(encoding, keys=image).features([theirs], kernel())[0]
    keyed, points = 2 * len(keys().state), ALONG * 14

    def swapped(values: np.ndarray, width: int) -> np.ndarray:
        return values.reshape(-1, 2, width)[:, ::-1].ravel()

    off = np.abs(swapped(there[:keyed], 1) - found[:keyed]) * KEY_RANGE
    assert np.median(off) < 0.02 and off.max() < 0.1
    line = slice(keyed + 3 * points, keyed + 4 * points)
    off = np.abs(swapped(there[line], 7) - found[line]) * MAX_DISTANCE
    assert np.median(off) < 0.015 and off.max() < 0.06
    assert np.median(np.abs(there[line] - found[line])) * MAX_DISTANCE > 0.05, (
        "arms that keep their places are not alike"
    )


def test_what_obstacles_are_made_of_does_not_matter(encoding: SceneEncoding) -> None:
    """A box as it is, in two halves, as a mesh, and as points on its surface, whose balls it is thinner by."""
    whole = Obstacle.model_validate({"name": "b", "box": (0.1, 0.7, 0.5), "position": (0.5, 0.1, 0.5)})
    halves = [
        Obstacle.model_validate({"name": f"h{k}", "box": (0.1, 0.35, 0.5), "position": (0.5, 0.1 + y, 0.5)})
        for k, y in enumerate((-0.175, 0.175))
    ]
    mine = query(1)
    found = []
    for scene in ([whole], halves):
        asked = make_query(CollisionChecker(robot(), scene), mine.start, mine.goal, point=False)
        assert asked.scene is not None and asked.scene[1].sum() == len(scene) < len(asked.scene[1]), "but for tables"
        found.append(encoding.features([asked], kernel())[0])
    keyed, points = 2 * len(keys().state), ALONG * 14
    np.testing.assert_allclose(found[0][:keyed], found[1][:keyed], atol=0.35)  # the depth inside is another
    outside = found[0] > 0.05
    outside[keyed : keyed + 3 * points] = outside[keyed + 4 * points :] = False
    np.testing.assert_allclose(found[0][outside], found[1][outside], atol=1e-6)


def test_a_ball_is_seen_alike_as_a_mesh_and_as_points(encoding: SceneEncoding, tmp_path: Path) -> None:
    radius, middle, thick = 0.2, (0.5, 0.1, 0.6), 0.01
    vertices, faces = bumpy_sphere(24, radius, 0.0)
    lines = [f"v {x} {y} {z}" for x, y, z in vertices] + [f"f {a} {b} {c}" for a, b, c in faces + 1]
    (tmp_path / "ball.obj").write_text("\n".join(lines))
    rng = np.random.default_rng(0)
    cloud = rng.normal(size=(6000, 3))
    np.save(tmp_path / "ball.npy", cloud / np.linalg.norm(cloud, axis=1, keepdims=True) * (radius - thick))
    shapes = [
        {"sphere": {"radius": radius}}, {"mesh": {"file": str(tmp_path / "ball.obj")}},
        {"points": {"file": str(tmp_path / "ball.npy"), "radius": thick}},
    ]  # fmt: skip
    found, mine, keyed = [], query(1), 2 * len(keys().state)
    for shape in shapes:
        ball = Obstacle.model_validate({"name": "ball", "position": middle, **shape})
        asked = make_query(CollisionChecker(robot(), [ball]), mine.start, mine.goal, point=False)
        found.append(encoding.features([asked], kernel())[0][:keyed] * KEY_RANGE)
    outside = found[0] > 0.0
    assert outside.sum() > 10 and np.ptp(found[0]) > 0.1
    for other in found[1:]:
        assert np.abs(other - found[0])[outside].max() < 0.03 and np.median(np.abs(other - found[0])) < 0.01


def test_features_of_a_table_are_those_of_queries(encoding: SceneEncoding) -> None:
    paths = some_paths()
    with_images = [paths, MIRROR.paths(paths, kernel())]
    for some in with_images:
        which = np.random.default_rng(0).integers(len(some), size=40)
        table = EncodedPaths(some, TorchSceneEncoding(encoding, kernel(), torch.device("cpu")), None)
        control, found = table.batch(torch.from_numpy(which), torch.Generator())
        np.testing.assert_allclose(control.numpy(), some.control(which), atol=1e-6)
        held = some.arrays["held"][some.arrays["problem"][which]]
        extents = [held_extents(some.names["held"][h]) for h in held]
        asked = [replace(query_from_path(some, int(k)), held=e) for k, e in zip(which, extents, strict=True)]
        wanted = batch_queries(asked, encoding, kernel())
        np.testing.assert_allclose(found.features.numpy(), wanted.features.numpy(), atol=3e-4)
        np.testing.assert_allclose(found.start.numpy(), wanted.start.numpy(), atol=1e-6)


def test_extents_are_those_of_the_meshes() -> None:
    for link, held in two_cups() + bar():
        checker = CollisionChecker(robot())
        attached = held.model_copy(update={"link": f"{link}_palm"})
        checker.attach(attached)
        ((name, extent),) = checker.held_extents
        assert name == attached.link
        reach = extent - held.pose[:3, 3]
        assert (reach[0] < 0).all() and (reach[1] > 0).all()
        checker.detach(attached.name)
        assert checker.held_extents == ()
    np.testing.assert_allclose(extent, [[-0.28, 0.015, -0.039], [0.08, 0.045, -0.009]], atol=1e-3)
    with pytest.raises(DatasetError, match="make the data anew"):
        held_extents('[{"name": "a", "link": "l", "box": [1, 1, 1]}]')


@pytest.mark.parametrize("refined", [False, True])
def test_a_trained_model_is_read_by_both_and_plans(tmp_path: Path, refined: bool) -> None:
    file = tmp_path / "data.zip"
    save(file, some_paths())
    condition = {"scene": "clearances", "width": 32, "out": 64, "along": 3, "keys": 16, "hands": list(HANDS)}
    condition["refined"] = refined
    (tmp_path / "run").mkdir()
    settings = config(file, condition=condition, parts=0.5, mixed=0.5)
    trainer = Trainer(settings, tmp_path / "run", HERE)
    assert all(np.isfinite(trainer.advance()) for _ in range(12))
    trainer.save()
    again = Trainer(settings, tmp_path / "run", HERE)
    assert again.step == 12, "it resumes: key states are the same"
    mine, theirs = (load(tmp_path / "run" / "checkpoint") for load in (load_model, load_torch_model))
    assert isinstance(mine, ArrayModel) and mine.scene_encoding is not None
    proposed = [m.propose(query(2), kernel(), 3).control for m in (mine, theirs)]
    np.testing.assert_allclose(*proposed, atol=3e-4)
    varied = [m.renoise(query(2), kernel(), proposed[0], 100).control for m in (mine, theirs)]
    np.testing.assert_allclose(*varied, atol=3e-4)
    easy, model = problems.load("wall/easy/800001"), str(tmp_path / "run" / "checkpoint")
    assert plan(easy, "apex", params={"model": model}, timeout=10.0, seed=1)


def test_condition_configs_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="expected refined for the scene 'clearances' alone"):
        config(tmp_path, condition={"refined": True})
    for wrong in (
        {"parts": 0.5}, {"mixed": 0.5}, {"collision": 1.0},
        {"parts": 0.5, "condition": {"scene": "clearances", "point": True}},
    ):  # fmt: skip
        with pytest.raises(FileFormatError, match="expected parts, mixed and collision for the scene 'clearances'"):
            config(tmp_path, **wrong)
    made = model_config(**CLEARANCES)
    with pytest.raises(FileFormatError, match="expected arms"):
        type(made).model_validate({**made.model_dump(), "arms": (0, 0)})
