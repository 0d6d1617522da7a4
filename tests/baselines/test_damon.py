"""DAMON: its autoencoder and graph, made small from the tests' data, its search, and the planner."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ompl import base as ob
from planning import EXACT, solved, within
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from support import DATA, ROOT

from apex_ompl import plan, planners
from apex_ompl.baselines import weights_folder
from apex_ompl.baselines.damon.latent_graph import (
    Damon,
    consecutive,
    farthest_points,
    free_of_self_collision,
    neighbors,
)
from apex_ompl.baselines.damon.lazy_search import Graph, LazySearch
from apex_ompl.baselines.damon.manifold import load_manifold, shared_manifold
from apex_ompl.baselines.damon.manifold_training import sample_states, split_sample
from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.discretization import sample_path
from apex_ompl.errors import FileFormatError, MissingFileError, ParameterError
from apex_ompl.kernel import Kernel, RobotTables
from apex_ompl.kernel.scene_builder import scene_tables
from apex_ompl.ompl.setup import PlanningSetup, assemble
from apex_ompl.ompl.space import motions_free
from apex_ompl.paths.path import SEARCH_RESOLUTION
from apex_ompl.problems import load as load_problem
from apex_ompl.robot import Robot
from apex_ompl.training.store import load
from apex_ompl.types import Array, Flags

SMALL = ["--states", "4000", "--nodes", "1200", "--epochs", "60", "--seed", "1"]
SHIPPED = ("damon-2", "damon-4", "damon-8")


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Manifolds of 2 and 8 dimensions, made by the script."""
    out = tmp_path_factory.mktemp("models")
    command = [sys.executable, ROOT / "scripts" / "train_damon.py", "--data", DATA, "--out", out, "--dims", "2", "8"]
    done = subprocess.run([*command, *SMALL], check=False, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return out


@settings(max_examples=30)
@given(seed=st.integers(0, 10_000), count=st.integers(2, 40), dim=st.integers(1, 4))
def test_farthest_points_are_spread(seed: int, count: int, dim: int) -> None:
    """No two chosen points are nearer to each other than any point is to the nearest chosen one."""
    points = np.random.default_rng(seed).normal(size=(150, dim))
    found = farthest_points(points, count)
    assert len(set(found.tolist())) == count
    away = np.linalg.norm(points[:, None] - points[found], axis=2)
    between = away[found] + np.where(np.eye(count, dtype=bool), np.inf, 0.0)
    assert between.min() >= away.min(axis=1).max() - 1e-5


@pytest.mark.parametrize("count", [3, 12])
def test_neighbors_are_the_nearest(count: int) -> None:
    """As by brute force: of the nearest in latent space, the nearest in joint space; and nodes along paths follow."""
    rng = np.random.default_rng(count)
    latent, states = rng.normal(size=(700, 2)), rng.normal(size=(700, 5))
    found = neighbors(latent, states, count)
    for k in range(0, 700, 37):
        away = np.linalg.norm(latent - latent[k], axis=1)
        pool = [j for j in np.argsort(away)[: 5 * count + 1] if j != k]
        wanted = sorted(pool, key=lambda j: float(np.linalg.norm(states[j] - states[k])))[:count]
        assert found[k].tolist() == wanted
    assert consecutive(np.array([0, 0, 3, 4, 4, 4])).tolist() == [[0, 1], [3, 4], [4, 5]]


def random_graph(rng: np.random.Generator, count: int) -> Graph:
    return Graph.of(rng.uniform(-1.0, 1.0, (count, 3)), rng.integers(0, count, (3 * count, 2)))


@settings(max_examples=40)
@given(seed=st.integers(0, 10_000), count=st.integers(3, 60))
def test_paths_are_the_shortest_of_the_free_ones(seed: int, count: int) -> None:
    """The length is that of scipy's Dijkstra without blocked nodes and edges, or neither finds a path."""
    rng = np.random.default_rng(seed)
    graph, starts, goals = random_graph(rng, count), rng.uniform(-1, 1, (2, 3)), rng.uniform(-1, 1, (2, 3))
    usable = rng.random(count) < 0.8
    firsts = graph.firsts
    assert np.array_equal(graph.ends[graph.twins], firsts)
    assert np.array_equal(graph.twins[graph.twins], np.arange(len(firsts)))

    def free(first: Array, last: Array) -> Flags:
        return np.asarray(np.sin(40.0 * (first + last).sum(axis=1)) > -0.5)  # the same both ways

    known = rng.random(count) < 0.5  # of the others it is found when a path uses them that some are blocked
    hidden = ~known & (rng.random(count) < 0.3)

    def nodes_free(states: Array) -> Flags:
        places = [int(np.flatnonzero((graph.states == q).all(axis=1))[0]) for q in states]
        assert not known[places].any()
        return np.asarray(~hidden[places])

    search = LazySearch(graph, usable, starts, goals, free_nodes=usable & known)
    before, usable = usable, usable & ~hidden
    matrix = np.zeros((count + 4, count + 4))
    open_edges = free(graph.states[firsts], graph.states[graph.ends]) & usable[firsts] & usable[graph.ends]
    matrix[firsts[open_edges], graph.ends[open_edges]] = graph.lengths[open_edges]
    for k, (row, which) in enumerate(((0, "start"), (1, "start"), (0, "goal"), (1, "goal"))):
        q = starts[row] if which == "start" else goals[row]
        nodes = np.flatnonzero(before & (rng.random(count) < 0.3))
        search.connect(**{which: row}, nodes=nodes)
        good = nodes[free(np.repeat(q[None], len(nodes), axis=0), graph.states[nodes]) & usable[nodes]]
        ways = np.linalg.norm(graph.states[good] - q, axis=1)
        if which == "start":
            matrix[count + k, good] = ways
        else:
            matrix[good, count + k] = ways
    away = dijkstra(csr_array(matrix), indices=[count, count + 1])[:, [count + 2, count + 3]].min()
    path = search.run(free, lambda: False, nodes_free=nodes_free)
    if path is None:
        assert np.isinf(away)
        return
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).sum() == pytest.approx(away)
    assert free(path[:-1], path[1:]).all()
    places = [int(np.flatnonzero((graph.states == q).all(axis=1))[0]) for q in path[1:-1]]
    assert usable[places].all()
    assert any(np.array_equal(path[0], q) for q in starts) and any(np.array_equal(path[-1], q) for q in goals)


@pytest.mark.parametrize("how", ["motion", "node"])
def test_what_is_blocked_stays_so_where_more_nodes_are_connected(how: str) -> None:
    graph = Graph.of(np.array([[0.5, 0.5], [1.0, 0.0]]), np.array([[0, 1]]))
    starts, goals, usable = np.array([[0.0, 1.0]]), np.array([[1.0, 1.0]]), np.ones(2, bool)
    search = LazySearch(graph, usable, starts, goals, free_nodes=np.array([how == "motion", True]))

    def found() -> Array | None:
        clear, hit = (lambda a, b: np.ones(len(a), bool)), (lambda states: np.zeros(len(states), bool))
        return search.run(clear, lambda: False, nodes_free=hit)

    if how == "motion":
        search.block(("start", 0, 0))
    search.connect(start=0, nodes=np.array([0]))
    search.connect(goal=0, nodes=np.array([0]))
    assert found() is None
    before = search.searches
    search.connect(start=0, nodes=np.array([0, 1]))
    search.connect(goal=0, nodes=np.array([0, 1]))
    path = found()
    assert path is not None and np.array_equal(path, [[0.0, 1.0], [1.0, 0.0], [1.0, 1.0]])
    assert search.searches == before + 1, "nothing that is blocked was tried again"


def test_a_search_ends_when_it_is_told_to() -> None:
    rng = np.random.default_rng(0)
    graph = random_graph(rng, 50)
    search = LazySearch(graph, np.ones(50, bool), np.zeros((1, 3)), np.ones((1, 3)))
    search.connect(start=0, nodes=np.arange(25))
    search.connect(goal=0, nodes=np.arange(25, 50))
    assert search.run(lambda a, b: np.zeros(len(a), bool), lambda: search.checked >= 3) is None
    assert search.checked == 3


def test_reconstruction_is_better_in_more_dimensions(models: Path) -> None:
    """By the model as it is stored, on states of paths that were not trained on; both beat the mean state."""
    data = load(DATA / "paths.zip")
    few, many = (load_manifold(str(models / f"damon-{dim}")) for dim in (2, 8))
    joints = np.array([data.about["joints"].index(name) for name in few.config.joints])
    assert len(joints) == 14, "hands are no part of it"
    sample, held_out = split_sample(sample_states(data, joints, 4000, 16, seed=1))
    assert not set(sample.paths) & set(held_out.paths) and len(held_out.states) >= 64

    def error(rebuilt: Array) -> float:
        return float(np.sqrt(np.mean(np.square(rebuilt - held_out.states))))

    errors = [error(m.autoencoder.decode(m.autoencoder.encode(held_out.states))) for m in (few, many)]
    assert errors[1] < 0.9 * errors[0] < 0.9 * error(sample.states.mean(axis=0))
    assert errors == pytest.approx([m.config.trained["held_out_error_rad"] for m in (few, many)], abs=1e-4)


def test_training_is_repeatable_and_its_pieces_are_numpys(models: Path) -> None:
    torch = pytest.importorskip("torch")
    from apex_ompl.baselines.damon.manifold_training import StateNetwork, train

    one = load_manifold(str(models / "damon-2")).autoencoder
    network = StateNetwork(14, 64, 2)
    network.load_state_dict({name: torch.from_numpy(value) for name, value in one.weights.items()})
    states = np.random.default_rng(0).uniform(one.lower, one.upper, (50, 14))
    scaled = torch.tensor(2.0 * (states - one.lower) / (one.upper - one.lower) - 1.0, dtype=torch.float32)
    with torch.no_grad():
        latent = network.encoder(scaled)[:, :2].numpy()
        decoded = network.decoder(torch.from_numpy(latent)).numpy()
    assert np.allclose(one.encode(states), latent, atol=1e-4)
    wanted = one.lower + 0.5 * (np.clip(decoded, -1.0, 1.0) + 1.0) * (one.upper - one.lower)
    assert np.allclose(one.decode(latent.astype(float)), wanted, atol=1e-4)
    runs = [train(states, one.lower, one.upper, dim=2, epochs=2, seed=seed) for seed in (3, 3, 4)]
    same = [all(np.array_equal(runs[0][name], other[name]) for name in runs[0]) for other in runs[1:]]
    assert same == [True, False]


def test_edges_of_a_graph_are_free_of_self_collision(models: Path, robot: Robot) -> None:
    """Neighbors' straight motions, by the sphere cover at states along them; the rest follow each other on paths."""
    manifold = load_manifold(str(models / "damon-2"))
    tables = RobotTables.load(DATA / "robot.npz")
    kernel = Kernel(tables, scene_tables([]))
    joints = np.array([tables.joint_names.index(name) for name in manifold.config.joints])
    for kind in ("decoded", "stored"):
        states = np.repeat(robot.home[None], len(manifold.latent), axis=0)
        states[:, joints] = manifold.states(kind)
        assert (
            (manifold.states(kind) >= manifold.autoencoder.lower)
            & (manifold.states(kind) <= manifold.autoencoder.upper)
        ).all()
        pairs = manifold.pairs[kind]
        free = free_of_self_collision(kernel, states[pairs[:, 0]], states[pairs[:, 1]])
        assert (np.diff(pairs[~free], axis=1) == 1).all() and free.mean() > 0.9
        middle = 0.5 * (states[pairs[free, 0]] + states[pairs[free, 1]])
        assert np.quantile(kernel.clearance(middle, 0.01)[:, 1], 0.01) > 0.0


def free_by_meshes(setup: PlanningSetup, path: Array) -> bool:
    """Whether a path is free by exact shapes alone, in a checker made anew, at the resolution of the search."""
    problem = setup.problem
    meshes = CollisionChecker(setup.robot, problem.scene, problem.attached, problem.allowed, proofs=False)
    return bool(meshes.are_free(sample_path(path, SEARCH_RESOLUTION)[0]).all())


@pytest.mark.parametrize("nodes", ["decoded", "stored"])
def test_paths_are_free_and_hit_nodes_are_left_out(models: Path, nodes: str) -> None:
    """On problems with obstacles; those that are not solved say so."""
    solved_ones = 0
    for name in ("vertical/small/800003", "vertical/small/800004", "horizontal/small/800003"):
        setup = assemble(load_problem(name))
        si = setup.simple_setup.getSpaceInformation()
        planner = planners.make("damon", si, model=str(models / "damon-8"), nodes=nodes)
        path = solved(setup, planner)
        if path is None:
            assert "nodes by" in planner.report.reason
            continue
        solved_ones += 1
        assert np.array_equal(path[0], setup.start) and any(np.array_equal(path[-1], q) for q in setup.valid_goals)
        assert free_by_meshes(setup, path)
        again = planners.make("damon", si, model=str(models / "damon-8"), nodes=nodes)
        assert np.array_equal(path, solved(setup, again))
        hands = [k for k, joint in enumerate(setup.robot.joint_names) if joint.endswith("synergy")]
        assert (path[:-1, hands] == setup.start[hands]).all()
    assert solved_ones


def test_a_node_that_an_obstacle_hits_is_not_used_again(models: Path) -> None:
    setup = assemble(load_problem("vertical/small/800003"))
    cube = next(o for o in setup.problem.scene if o.box is not None)
    planner = planners.make(
        "damon", setup.simple_setup.getSpaceInformation(), model=str(models / "damon-8"), nodes="stored"
    )
    path = solved(setup, planner)
    assert path is not None and len(path) > 2
    for node in path[1:-1]:
        palm = setup.robot.link_pose(node, "left_hand_palm")[:3, 3]
        setup.checker.move(cube.name, palm)
        if setup.checker.is_free(setup.start) and setup.checker.is_free(setup.valid_goals[0]):
            break
    assert not setup.checker.is_free(node)
    other = solved(setup, planner)
    if other is not None:
        assert not (other == node).all(axis=1).any() and all(map(setup.checker.is_free, other))


def test_it_stops_with_its_condition(models: Path) -> None:
    setup = assemble(load_problem("vertical/small/800003"))
    planner = planners.make("damon", setup.simple_setup.getSpaceInformation(), model=str(models / "damon-2"))
    pdef = setup.simple_setup.getProblemDefinition()
    planner.setProblemDefinition(pdef)
    status = planner.solve(ob.plannerAlwaysTerminatingCondition())
    assert status.getStatus() == ob.PlannerStatus.TIMEOUT and "in the time given" in planner.report.reason


def test_faults_of_models_are_said_in_one_sentence(models: Path, tmp_path: Path) -> None:
    with pytest.raises(
        MissingFileError, match=r"'damon-3'.*scripts/train_damon.py.* makes damon-2, damon-4 and damon-8"
    ):
        load_manifold("damon-3")
    with pytest.raises(FileFormatError, match="robot: expected 'baxter', got 'dual_panda_softhand'"):
        load_manifold(str(models / "damon-2"), "baxter")
    with pytest.raises(ParameterError, match="decoded, stored"):
        planners.parameters("damon", nodes="encoded")
    copy = Path(shutil.copytree(models / "damon-2", tmp_path / "copy"))
    weights = copy / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-10])
    with pytest.raises(FileFormatError, match="damaged.*SHA-256"):
        load_manifold(str(copy))
    weights.unlink()
    with pytest.raises(MissingFileError, match="weights of a manifold"):
        load_manifold(str(copy))
    config = json.loads((copy / "config.json").read_text())
    (copy / "config.json").write_text(json.dumps(config | {"dim": 3}))
    shutil.copy(models / "damon-2" / "model.safetensors", weights)
    with pytest.raises(FileFormatError, match="encoder.4.weight.*expected arrays that fit config.json"):
        load_manifold(str(copy))
    (copy / "config.json").write_text(json.dumps(config | {"schema": "apex-ompl/model/1"}))
    with pytest.raises(FileFormatError, match="expected 'apex-ompl/manifold/1'"):
        load_manifold(str(copy))


def test_shipped_models_are_small_and_sound() -> None:
    size = sum(file.stat().st_size for name in SHIPPED for file in weights_folder(name).iterdir())
    assert size <= 6 * 2**20
    for name in SHIPPED:
        manifold = load_manifold(name, "dual_panda_softhand")
        assert manifold.config.dim == int(name.removeprefix("damon-")) and len(manifold.latent) == 20_000
        assert not list(weights_folder(name).glob("*.p*t*")) and (weights_folder(name) / "README.md").is_file()


def test_a_manifold_is_read_once_until_it_changes(models: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(models / "damon-2", tmp_path / "copy"))
    first = shared_manifold(str(copy))
    assert shared_manifold(str(copy)) is first and first.graph("stored") is first.graph("stored")
    shutil.copytree(models / "damon-8", copy, dirs_exist_ok=True, copy_function=shutil.copyfile)
    assert shared_manifold(str(copy)).config.dim == 8


def test_it_solves_what_is_easy() -> None:
    found = plan("vertical/small/800001", "damon", timeout=20.0, params={"model": "damon-8"})
    assert found and found.solved_by == "damon"


def test_more_connections_are_tried_where_the_first_lead_to_no_path() -> None:
    """One node beside the start and the goal is not enough, and is not all."""
    setup = assemble(load_problem("vertical/small/800001"))
    planner = planners.make("damon", setup.simple_setup.getSpaceInformation(), connections=1)
    narrow = planner.damon.search(*(query := _query(planner.damon, setup)))
    free = partial(motions_free, setup.simple_setup.getSpaceInformation())
    nodes_free = setup.checker.are_free
    narrow.more = lambda: False
    assert narrow.run(free, lambda: False, nodes_free=nodes_free) is None
    wide = planner.damon.search(*query)
    assert wide.run(free, lambda: False, nodes_free=nodes_free) is not None
    setup.simple_setup.setPlanner(planner)
    assert setup.simple_setup.solve(within(30.0)).getStatus() == EXACT and planner.report.candidates > 1


def _query(damon: Damon, setup: PlanningSetup) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Arguments of a search: states of the nodes, those that are free, the start and the goals."""
    states = damon.states(setup.start)
    return states, setup.checker.are_free(states), setup.start[None], setup.goals
