"""Training data: mirror images, held-out problems, shards, weights."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from support import DATA, ROOT
from trainings import HERE, config, query_from_path

from apex_ompl.errors import ParameterError
from apex_ompl.kernel import Kernel, RobotTables
from apex_ompl.kernel.arrays import BOX
from apex_ompl.kernel.scene_builder import Primitive, scene_tables
from apex_ompl.training.data import Mirror, is_held_out, shard_paths, split
from apex_ompl.training.records import Paths
from apex_ompl.training.store import Store, save
from apex_ompl.training.training import Trainer


def test_mirror_images_are_valid_where_paths_are(paths: Paths) -> None:
    """But for a few: the Panda's fifth link is not quite symmetric."""
    mirror = Mirror(**yaml.safe_load((ROOT / "scripts" / "configs" / "apex.yaml").read_text())["mirror"])
    robot = RobotTables.load(DATA / "robot.npz")
    image = mirror.paths(paths, Kernel(robot, scene_tables([])))
    assert 0.2 * len(paths) < len(image) < len(paths)
    twice = mirror.paths(image, Kernel(robot, scene_tables([])))
    assert len(twice) > 0.9 * len(image)
    np.testing.assert_allclose(mirror.states(mirror.states(paths.control())), paths.control(), atol=1e-12)
    proven, near = [], []
    for k in range(0, len(image), 4):
        query = query_from_path(image, k)
        obstacles = query.obstacles
        solids = []
        columns = (obstacles.shape, obstacles.position, obstacles.rotation, obstacles.size)
        for shape, position, rotation, size in zip(*columns, strict=True):
            if shape != 0:
                break
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = rotation, position
            solids.append((len(solids), Primitive(BOX, pose, tuple(size))))
        else:
            states = image.spline.path(image.control(slice(k, k + 1))[0])
            clearance = Kernel(robot, scene_tables(solids)).clearance(states[::5])
            proven.append(clearance.min() > -0.01)
            near.append(abs(clearance.min() - image.arrays["clearance"][k]) < 0.01)
    assert len(proven) > 50 and np.mean(proven) > 0.9 and np.mean(near) > 0.75


def test_problems_are_held_out_whole(paths: Paths) -> None:
    train, out = split(paths, 0.3)
    names = [{part.problem_name(k) for k in range(part.problems)} for part in (train, out)]
    assert not names[0] & names[1] and len(train) + len(out) == len(paths)
    assert 0.15 < len(names[1]) / paths.problems < 0.45
    assert all(is_held_out(name, 0.3) for name in names[1]) and not any(is_held_out(name, 0.3) for name in names[0])


def test_every_pass_goes_through_all_units_once(paths: Paths, tmp_path: Path) -> None:
    store = Store.create(tmp_path, {"robot": "x"}, [])
    for k in range(5):
        store.write(f"unit-{k}", paths.subset([k]))
    found = [shard_paths([str(tmp_path)], 3, 2, number) for number in range(9)]
    assert all(shards == 3 for _, shards in found)
    both, _ = shard_paths([str(tmp_path), str(tmp_path)], 0, 100, 0)
    assert both.problems == 10
    names = [[p.problem_name(k) for k in range(p.problems)] for p, _ in found]
    passes = [sum(names[k : k + 3], []) for k in (0, 3, 6)]
    assert all(sorted(one) == sorted(passes[0]) and len(set(one)) == 5 for one in passes)
    assert len({tuple(one) for one in passes}) > 1


def test_weights_say_how_often_paths_are_drawn(paths: Paths, few: Path, tmp_path: Path) -> None:
    file = tmp_path / "data.zip"
    save(file, paths)
    trainer = Trainer(config(file, weights={"shelf/*": 0.0, "*/hard": 5.0}), tmp_path, HERE)
    shard = trainer.data.shard
    drawn = shard.sample(100_000, torch.Generator().manual_seed(0))
    assert (np.diff(drawn) >= 0).all()
    a = paths.arrays
    levels = [
        f"{paths.names['suite'][a['suite'][p]]}/{paths.names['level'][a['level'][p]]}" for p in a["problem"].tolist()
    ]
    weight = np.array([0.0 if v.startswith("shelf") else 5.0 if v.endswith("hard") else 1.0 for v in levels])
    shares = np.bincount(drawn, minlength=len(paths)) / len(drawn)
    np.testing.assert_allclose(shares, weight / weight.sum(), atol=5e-3)
    with pytest.raises(ParameterError, match="training data: expected paths, some of them with a positive weight"):
        Trainer(config(few, weights={"*": 0.0}), tmp_path, HERE)
