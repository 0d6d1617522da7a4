"""Reconstruction error of the latent spaces: held-out paths, encoded, decoded, and checked again.

Both latent spaces take the states of a path and give states back. Valid paths are those of the training split's
problems that were held out, which pass the full check before.

Usage: python -m benchmarks.model.reconstruction [-n 300] [--data FILE] [--models NAME|FOLDER ...]
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from apex_ompl import load_model, problems
from apex_ompl.model.checkpoint import shipped
from apex_ompl.ompl.setup import assemble
from apex_ompl.ompl.validity import full_check
from apex_ompl.problems.suite_robot import robot
from apex_ompl.training.autoencoder import LinearLatent
from apex_ompl.training.data import split
from apex_ompl.training.records import Paths
from apex_ompl.training.store import load
from apex_ompl.training.torch_model import load_torch_model
from apex_ompl.util.entry_point import run_script
from benchmarks.lib import record

DEPENDS = ("apex_ompl/model", "apex_ompl/paths", "apex_ompl/training", "data/dual_panda_softhand")
DATA = record.RESULTS.parent.parent / "data" / "dual_panda_softhand" / "paths.zip"


def lost(name: str, paths: Paths, which: np.ndarray) -> dict[str, Any]:
    """Return errors [rad] and the share of paths that stay valid."""
    network = load_torch_model(name).network
    autoencoder, spline = network.autoencoder, paths.spline
    control = torch.tensor(paths.control(which), dtype=torch.float32)
    with torch.no_grad():
        latent = autoencoder.encode(control)
        decoded = autoencoder.decode(latent, control[:, 0], control[:, -1]).double().numpy()
    wanted = spline.path(paths.control(which))
    apart = np.abs(decoded - wanted)
    kept = []
    for k, path in zip(which, decoded, strict=True):
        ready = assemble(problems.load(paths.problem_name(paths.arrays["problem"][k])), robot())
        ends = paths.start[k], paths.goal[k]
        limits = ready.robot.limits
        states = np.concatenate([ends[0][None], np.clip(path[1:-1], limits.lower, limits.upper), ends[1][None]])
        kept.append(bool(full_check(ready.checker, states)))
    linear = isinstance(autoencoder, LinearLatent)
    return {
        "latent": list(network.latent), "kind": "linear" if linear else "variational", "max_rad": float(apart.max()),
        "mean_of_max_rad": float(apart.max(axis=(1, 2)).mean()), "mean_rad": float(apart.mean()),
        "stay_valid": float(np.mean(kept)), "n": len(which),
    }  # fmt: skip


def main() -> None:
    """Measure, and write the results."""
    parser = record.parser(__doc__, n=300, of="paths")
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--models", nargs="*", default=list(shipped()), metavar="NAME|FOLDER")
    args = parser.parse_args()
    share = min(float(load_model(name).about["config"]["held_out"]) for name in args.models)
    paths = split(load(args.data), share)[1]
    which = np.sort(np.random.default_rng(0).choice(len(paths), min(args.n, len(paths)), replace=False))
    found = {name: lost(name, paths, which) for name in args.models}
    lines = [["model", "latent", "N", "mean error rad", "mean of the largest of a path", "largest", "stay valid"]]
    lines.append(["---", "---", *["---:"] * 5])
    for name, f in found.items():
        shape = " x ".join(map(str, f["latent"]))
        errors = [f"{f[key]:.4f}" for key in ("mean_rad", "mean_of_max_rad", "max_rad")]
        lines.append([Path(name).name, f"{f['kind']}, {shape}", f["n"], *errors, f"{f['stay_valid']:.2f}"])
    text = "\n".join(record.row(line) for line in lines)
    record.write("reconstruction", {"models": found}, text, seed=0, held_out=share)


if __name__ == "__main__":
    run_script(main)
