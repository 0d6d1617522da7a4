"""Ablation of the model: short trainings that differ in one setting each, evaluated on validation problems.

Every variant is trained by scripts/train.py for as many steps, on one thread, two at a time; what is trained already
is not trained again. Beside them stands the checkpoint that ships, which had more steps and more data. Then B = 1 and 8
proposals in two deterministic steps are repaired by the optimizer and checked by the kernel.

Usage: python -m benchmarks.model.model_sweep [--steps 3000] [--data FOLDER] [--runs FOLDER] [--only NAME ...]
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import torch

from apex_ompl.training.kernel_problems import load_kernel_problems
from apex_ompl.training.run import read_log
from apex_ompl.training.torch_model import load_torch_model
from apex_ompl.training.validation import success_rates
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import one_or_more
from benchmarks.lib import record

DEPENDS = ("apex_ompl/model", "apex_ompl/training", "scripts/train.py", "scripts/configs")
LOSSES = ("loss", "held_out")
ROOT = record.RESULTS.parent.parent
VARIANTS: dict[str, dict[str, Any]] = {
    "apex": {},
    "scene: set": {"condition.scene": "set"},
    "scene: none": {"condition.scene": "none"},
    "components: 128": {"latent.dim": 128},
    "width: 384": {"denoiser.width": 384},
    "denoiser: U-Net": {"denoiser.kind": "unet", "denoiser.width": 32},
    "data: 1/2": {"held_out": 0.5},
    "data: 1/4": {"held_out": 0.75},
    "no mirror images": {"mirror": "null"},
}


def trained(name: str, args: argparse.Namespace) -> Path:
    """Train a variant unless it is there; return its folder."""
    folder: Path = args.runs / name.replace(":", "").replace(" ", "-").replace("/", "-of-")
    settings = {"steps": args.steps, "validate_every": 10**9, "log_every": 500, "cases": "null", **VARIANTS[name]}
    if args.data is not None:
        settings["data"] = args.data
    config = ROOT / "scripts" / "configs" / "apex-distances.yaml"
    command = [sys.executable, str(ROOT / "scripts" / "train.py"), str(config), "--out", str(folder), "--quiet"]
    for key, value in settings.items():
        command += ["--set", f"{key}={value}"]
    environment = {**os.environ, "OMP_NUM_THREADS": str(args.threads)}
    subprocess.run(command, check=True, env=environment, cwd=ROOT, stdout=subprocess.DEVNULL)
    return folder


def figures(folder: Path | None, cases: list[Any]) -> dict[str, Any]:
    """Return the success rates of a variant; without a folder, of the checkpoint that ships."""
    model = load_torch_model("apex" if folder is None else folder / "checkpoint")
    last = {} if folder is None else read_log(folder)[-1]
    found: dict[str, Any] = {
        "steps": model.about["step"], "minutes": model.about["seconds"] / 60.0,
        **{key: float(last[key]) if last else None for key in LOSSES}, "paths": model.about["paths"],
        "weights": sum(p.numel() for p in model.network.parameters()),
    }  # fmt: skip
    for count in (1, 8):
        rates = success_rates(model, cases, count)
        hard = [value for name, value in rates.items() if name.endswith("/hard")]
        found[f"B{count}"] = {**rates, "hard": sum(hard) / len(hard)}
    return found


def table(rows: dict[str, dict[str, Any]]) -> str:
    """Return the Markdown table."""
    head = [
        "variant",
        "weights M",
        "paths",
        "steps",
        "min",
        "loss",
        "held out",
        "B = 1: valid",
        "repaired",
        "hard levels",
    ]
    head += ["B = 8: valid", "repaired", "hard levels"]
    lines = [record.row(head), record.row(["---", *["---:"] * (len(head) - 1)])]
    for name, f in rows.items():
        cells = [name, f"{f['weights'] / 1e6:.1f}", f["paths"], f["steps"], f"{f['minutes']:.0f}"]
        cells += ["-" if f[key] is None else f"{f[key]:.3f}" for key in LOSSES]
        for count in (1, 8):
            cells += [f"{f[f'B{count}'][key]:.2f}" for key in ("sampled", "repaired", "hard")]
        lines.append(record.row(cells))
    return "\n".join(lines)


def main() -> None:
    """Train, evaluate, and write the results."""
    parser = record.parser(__doc__)
    parser.add_argument("--steps", type=one_or_more, default=3000, help="of each (default: %(default)s)")
    parser.add_argument("--threads", type=one_or_more, default=1, help="of each (default: %(default)s)")
    parser.add_argument("--jobs", type=one_or_more, default=2, help="trained at a time (default: %(default)s)")
    parser.add_argument("--data", help="data set (default: the one that ships)")
    parser.add_argument("--runs", type=Path, default=record.RESULTS.parent / "runs" / "sweep")
    parser.add_argument("--only", nargs="*", default=list(VARIANTS), choices=list(VARIANTS), metavar="NAME")
    args = parser.parse_args()
    with ThreadPoolExecutor(args.jobs) as pool:
        folders = dict(zip(args.only, pool.map(lambda name: trained(name, args), args.only), strict=True))
    cases = load_kernel_problems(ROOT / "data" / "dual_panda_softhand" / "validation")
    torch.set_num_threads(1)
    rows = {name: figures(folder, cases) for name, folder in (*folders.items(), ("apex as it ships", None))}
    record.write(
        "model_sweep", {"variants": rows}, table(rows), steps=args.steps, threads=args.threads,
        data=Path(args.data).name if args.data else "that ships", n=len(cases), seed=0,
    )  # fmt: skip


if __name__ == "__main__":
    run_script(main)
