"""States of joints that turn without end are drawn within a turn, and scaled by one, wherever that is done."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from small_arm import JOINT, write_endless

from apex_ompl.baselines.damon.latent_graph import Damon
from apex_ompl.baselines.damon.lazy_search import Graph
from apex_ompl.baselines.drrt.replanner import DynamicRRTReplanner
from apex_ompl.collision import CollisionChecker
from apex_ompl.goals.pose_goal import PoseGoal
from apex_ompl.kernel import Kernel
from apex_ompl.kernel.scene_builder import scene_tables
from apex_ompl.model.config import ConditionConfig, DenoiserConfig, LatentConfig, ModelConfig, NoiseConfig
from apex_ompl.model.proposals import Sampling
from apex_ompl.model.query import ObstacleSet, Probes, Query, encoded_range, turned_back
from apex_ompl.ompl.space import state_space
from apex_ompl.planning.while_executing import moved_links
from apex_ompl.problems.robot_problems import LEVELS, drawn_for
from apex_ompl.robot import Robot, load_robot
from apex_ompl.scene.problem import PoseTarget
from apex_ompl.training.latent_diffusion import LatentDiffusion
from apex_ompl.training.torch_model import TorchModel
from apex_ompl.types import Array

TURN = 2.0 * math.pi


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    """The small arm, two of its joints without end."""
    folder = tmp_path_factory.mktemp("endless")
    file = write_endless(folder, ("turn", "elbow"))
    pairs = [f"{{links: [{a}, {b}], reason: adjacent}}" for a, b in (("base", "column"), ("column", "upper"))]
    pairs.append("{links: [upper, lower], reason: adjacent}")
    (folder / "pairs.yaml").write_text(f"schema: apex-ompl/disabled-pairs/1\npairs: [{', '.join(pairs)}]\n")
    file.write_text(file.read_text() + "disabled_pairs: pairs.yaml\n")
    return load_robot(file)


@pytest.mark.parametrize("level", [LEVELS[0], LEVELS[-1], "posts"])
def test_drawn_problems_go_the_shorter_way(robot: Robot, level: str) -> None:
    drawn = [drawn_for(robot, level, 800_000 + k) for k in range(30)]
    starts, goals = (np.array([getattr(one, name) for one in drawn]) for name in ("start", "goal"))
    endless = robot.continuous
    assert np.abs(starts[:, endless]).max() <= math.pi + 1e-6  # drawn from the limits, some are 1000 turns away
    assert np.abs(goals - starts)[:, endless].max() <= math.pi + 1e-6
    assert np.ptp(starts[:, endless], axis=0).min() > 0.5


def model_of(robot: Robot, kernel: Kernel) -> TorchModel:
    """A small model with random weights."""
    torch.manual_seed(0)
    tables = kernel.robot
    probes = Probes.from_robot(tables, 3)
    network = LatentDiffusion(
        ModelConfig(
            robot=tables.name, joints=tables.joint_names, probes=len(probes.joint), arms=(0, 0),
            latent=LatentConfig(dim=12, width=16), condition=ConditionConfig(width=16, out=32, along=3),
            denoiser=DenoiserConfig(width=32, blocks=2), noise=NoiseConfig(),
        )
    )  # fmt: skip
    network.probe_joint.copy_(torch.from_numpy(probes.joint))
    network.probe_offset.copy_(torch.from_numpy(probes.offset))
    network.encoder.set_limits(*(torch.tensor(v, dtype=torch.float32) for v in encoded_range(tables)))
    for parameter in network.denoiser.parameters():
        if not parameter.detach().any():
            torch.nn.init.normal_(parameter, std=0.05)
    points = network.config.spline.points
    ends = np.random.default_rng(0).uniform(-1.0, 1.0, (200, points, robot.dof))
    network.autoencoder.fit(torch.tensor(ends, dtype=torch.float32))
    return TorchModel(network, {})


def test_proposals_turn_with_the_start(robot: Robot) -> None:
    """A model sees the same where start and goal differ by whole turns; and it does see where a joint is."""
    kernel = Kernel(CollisionChecker(robot).kernel.robot, scene_tables([]))
    model, none = model_of(robot, kernel), ObstacleSet.from_rows([])

    def proposed(start: Array, goal: Array) -> Array:
        query = Query(start, goal, np.zeros(3), none)
        return model.propose(query, kernel, 4, sampling=Sampling("ddim", 3), generator=np.random.default_rng(1)).control

    start, goal, by = np.array([2.0, 0.4, -3.0]), np.array([2.6, 0.7, -3.5]), TURN * np.array([7.0, 0.0, -31.0])
    paths = proposed(start, goal)
    np.testing.assert_allclose(proposed(start + by, goal + by) - by, paths, atol=1e-4)
    half = np.array([2.0, 0.0, 0.0])
    moved = proposed(start + half, goal + half) - half
    assert np.abs(moved - paths).max() > 1e-3
    lower, upper = encoded_range(kernel.robot)
    np.testing.assert_allclose(upper, [TURN, robot.limits.upper[1], TURN])
    np.testing.assert_allclose(lower, [-TURN, robot.limits.lower[1], -TURN])
    (back,) = turned_back([Query(start + by, goal + by, np.zeros(3), none)], kernel.robot)
    np.testing.assert_allclose(np.stack([back.start, back.goal]), np.stack([start, goal]) + [0, 0, 0], atol=1e-9)


def test_samples_of_trees_are_near_the_start(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    start, drawn = np.array([50.0, 0.4, -20.0]), list[Array]()

    def grow(tree: Any, starts: Array, sample: Any, **more: Any) -> None:
        drawn.extend(sample() for _ in range(300))

    replanner = DynamicRRTReplanner()
    monkeypatch.setattr(type(replanner.search), "grow", staticmethod(grow))
    budget = SimpleNamespace(spend=lambda *_: None, over=lambda: False)
    context = SimpleNamespace(setup=SimpleNamespace(robot=robot), fingers=[])
    search: Any = SimpleNamespace(
        start=SimpleNamespace(position=start), rng=np.random.default_rng(0), context=context, budget=budget
    )
    replanner._grown(search, None, SimpleNamespace(edges=None))  # type: ignore[arg-type]
    away = np.abs(np.array(drawn) - start)[:, robot.continuous]
    assert len(drawn) == 300 and (away <= TURN).all() and (away.max(axis=0) > math.pi).all()


def test_a_space_without_bounds_is_a_turn_to_either_side(robot: Robot) -> None:
    box = state_space(robot).getBounds()
    np.testing.assert_allclose(np.array(box.high), [TURN, 2.0, TURN])
    np.testing.assert_allclose(np.array(box.low), [-TURN, -2.0, -TURN])


def test_poses_far_round_get_their_hint(robot: Robot) -> None:
    """Descents from the whole of +-1e4 end wherever; near the start, a pose in millimeters is recognized."""
    place = 1e3 * robot.link_pose(np.array([2.0, 0.9, 1.2]), "lower")[:3, 3]
    goal = PoseGoal(robot, [PoseTarget(frame="lower", position=tuple(place.tolist()))], (), np.array([60.0, 0.4, 0.6]))
    assert "in millimeters" in goal.hint()


def test_a_graph_is_turned_to_the_start(robot: Robot) -> None:
    """Nodes that follow a start by whole turns keep their edges, and are encoded where they were made."""
    nodes = np.random.default_rng(0).uniform(-1.0, 1.0, (40, 3))
    seen = list[Array]()

    def encode(q: Array) -> Array:
        seen.append(q)
        return q[:, :2]

    manifold: Any = SimpleNamespace(latent=nodes[:, :2], autoencoder=SimpleNamespace(encode=encode))
    graph = Graph.of(nodes, np.array([[k, k + 1] for k in range(39)]))
    damon = Damon(manifold, "stored", graph, np.arange(3), robot.continuous, 5)
    start = np.array([3 * TURN + 0.2, 0.1, -2 * TURN - 0.3])
    goal = start + [0.5, 0.3, 0.4]
    states = damon.states(start)
    np.testing.assert_allclose(states, nodes + [3 * TURN, 0.0, -2 * TURN])
    search = damon.search(states, np.ones(40, bool), start[None], goal[None])
    path = search.run(lambda first, last: np.ones(len(first), bool), lambda: False)
    assert path is not None and np.abs(np.diff(path, axis=0)).max() < math.pi
    np.testing.assert_allclose(np.concatenate(seen), [[0.2, 0.1, -0.3], [0.7, 0.4, 0.1]], atol=1e-9)


def test_what_an_endless_joint_moves_and_what_follows_it(tmp_path: Path, robot: Robot) -> None:
    assert moved_links(robot, (2,)) == {"lower"} and moved_links(robot, (0,)) == {"column", "upper", "lower"}
    # A bar that follows an endless joint gets a ball of its own size, not of all that it may sweep in 1e4 rad.
    bar = '<collision><geometry><box size="0.05 0.05 0.1"/></geometry></collision>'
    more = f'<link name="pointer">{bar}</link>' + JOINT.format(
        name="follow", axis="0 0 1", at=0.4, above="lower", below="pointer"
    ).replace('type="revolute"', 'type="continuous"').replace("</joint>", '<mimic joint="elbow"/></joint>')
    made = load_robot(write_endless(tmp_path, ("elbow",), more))
    arrays = CollisionChecker(made).kernel.robot.arrays
    assert (arrays.cluster_ball[:, 3] < 0.5).all()
