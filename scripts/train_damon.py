"""Make the manifolds of the planner ``damon``: autoencoders of states of the training paths, and their graphs.

Each dimension takes some minutes on one core; existing folders are kept, so that the command resumes where it was
stopped.

Usage: python scripts/train_damon.py [--dims 2 4 8] [--nodes 20000] [--neighbors 12] [--beta 1e-3] [--again]
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from apex_ompl.baselines import weights_folder
from apex_ompl.baselines.damon.latent_graph import chosen_nodes, consecutive, edges
from apex_ompl.baselines.damon.manifold import (
    DECODED,
    MOST_NODES,
    SCHEMA,
    STORED,
    Manifold,
    ManifoldConfig,
    StateAutoencoder,
    halved,
    save_manifold,
)  # fmt: skip
from apex_ompl.baselines.damon.manifold_training import sample_states, split_sample
from apex_ompl.kernel import Kernel, RobotTables
from apex_ompl.kernel.scene_builder import scene_tables
from apex_ompl.model.checkpoint import CONFIG
from apex_ompl.model.query import encoded_range
from apex_ompl.robot import load_robot
from apex_ompl.training.store import load
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import one_or_more

ROOT = Path(__file__).resolve().parents[1]


def make(args: argparse.Namespace, dim: int) -> None:
    """Write the manifold of one dimension."""
    import torch

    torch.set_num_threads(1)
    from apex_ompl.baselines.damon.manifold_training import train

    begin = time.perf_counter()
    tables = RobotTables.load(args.data / "robot.npz")
    robot = load_robot(tables.name)
    hands = {hand.synergy for hand in robot.hands.values()}  # they stay as at the start of a query
    joints = np.array([k for k, name in enumerate(tables.joint_names) if name not in hands])
    lower, upper = (ends[joints] for ends in encoded_range(tables))
    every = sample_states(load(args.data / "paths.zip"), joints, args.states, args.along, args.seed)
    sample, held_out = split_sample(every)

    def progress(epoch: int, loss: float) -> None:
        if (epoch + 1) % 10 == 0:
            print(f"{dim} dimensions, pass {epoch + 1}: loss {loss:.5f}", flush=True)

    weights = halved(
        train(
            sample.states, lower, upper, dim=dim, beta=args.beta, epochs=args.epochs, seed=args.seed, progress=progress
        )
    )
    autoencoder = StateAutoencoder(weights, lower, upper)
    rebuilt = autoencoder.decode(autoencoder.encode(held_out.states))
    error = float(np.sqrt(np.mean(np.square(rebuilt - held_out.states))))
    print(f"{dim} dimensions: error {error:.3f} rad (RMS a joint) of paths held out", flush=True)
    nodes = chosen_nodes(sample, autoencoder, args.nodes)
    stored = np.clip(sample.states[nodes].astype(np.float16).astype(float), lower, upper)
    latent = autoencoder.encode(stored).astype(np.float16).astype(float)
    kernel = Kernel(tables, scene_tables([]))
    along = consecutive(sample.paths[nodes])
    pairs = {}
    for kind, states in ((DECODED, autoencoder.decode(latent)), (STORED, stored)):
        near = edges(latent, states, args.neighbors, kernel=kernel, whole=robot.home, joints=joints)
        pairs[kind] = np.unique(np.concatenate([near, along]), axis=0)
    config = ManifoldConfig(
        schema_=SCHEMA, robot=tables.name, joints=tuple(tables.joint_names[k] for k in joints), dim=dim,
        hidden=weights["decoder.0.weight"].shape[0], digest="",
    )  # fmt: skip
    trained = {
        "seed": args.seed, "states": len(sample.states), "epochs": args.epochs, "beta": args.beta,
        "neighbors": args.neighbors, "held_out_error_rad": round(error, 4),
    }  # fmt: skip
    manifold = Manifold(config, autoencoder, latent, stored, pairs)
    save_manifold(args.out / f"damon-{dim}", manifold, trained)
    size = sum(file.stat().st_size for file in (args.out / f"damon-{dim}").iterdir()) / 2**20
    counts = ", ".join(f"{len(rows)} edges of {kind} nodes" for kind, rows in pairs.items())
    taken = time.perf_counter() - begin
    print(f"{args.out / f'damon-{dim}'}: {len(nodes)} nodes, {counts}, {size:.2f} MiB, {taken:.0f} s", flush=True)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    data = ROOT / "data" / "dual_panda_softhand"
    parser.add_argument("--data", type=Path, default=data, help="folder with paths.zip and robot.npz")
    parser.add_argument("--out", type=Path, default=weights_folder(), help="their folder (default: %(default)s)")
    parser.add_argument("--dims", type=one_or_more, nargs="+", default=[2, 4, 8], help="(default: %(default)s)")
    parser.add_argument("--states", type=one_or_more, default=200_000, help="number of states (default: %(default)s)")
    parser.add_argument("--along", type=one_or_more, default=16, help="states of a path (default: %(default)s)")
    parser.add_argument("--nodes", type=one_or_more, default=20_000, help="number of nodes (default: %(default)s)")
    parser.add_argument("--neighbors", type=one_or_more, default=12, help="neighbors of a node (default: %(default)s)")
    parser.add_argument("--beta", type=float, default=1e-3, help="weight of the divergence (default: %(default)s)")
    parser.add_argument("--epochs", type=one_or_more, default=20, help="passes over the states (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="seed of all random choices (default: %(default)s)")
    parser.add_argument("--again", action="store_true", help="replace existing folders")
    args = parser.parse_args()
    args.nodes = min(args.nodes, MOST_NODES)
    for dim in args.dims:
        if args.again or not (args.out / f"damon-{dim}" / CONFIG).is_file():
            make(args, dim)


if __name__ == "__main__":
    run_script(main, "data")
