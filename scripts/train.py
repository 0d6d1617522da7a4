"""Train a latent diffusion model; the same command resumes an interrupted run.

The run's folder receives ``checkpoint`` (read it by ``apex_ompl.load_model``), ``log.csv``, TensorBoard event files,
and ``state.pt``, from which the run is resumed. Several GPUs, or processes, train together by
``torchrun --nproc-per-node N scripts/train.py CONFIG.yaml``. Neither Pinocchio nor OMPL is needed.

Usage: python scripts/train.py CONFIG.yaml [--out FOLDER] [--set KEY=VALUE ...] [--minutes M]
"""

from __future__ import annotations

import argparse
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from apex_ompl.util.entry_point import run_script
from apex_ompl.util.files import locked, make_folder
from apex_ompl.util.validation import key_value, positive_number


def train(args: argparse.Namespace) -> None:
    """Train to the end, or to the time limit."""
    from tqdm import tqdm

    from apex_ompl.training.config import TrainingConfig
    from apex_ompl.training.kernel_problems import load_kernel_problems
    from apex_ompl.training.training import DistributedProcess, Trainer

    config = TrainingConfig.read(args.config, dict(args.set))
    folder = make_folder(args.out or Path("runs") / Path(args.config).stem, "folder of a training run")
    validation = load_kernel_problems(config.cases) if config.cases is not None else []
    process = DistributedProcess.current()
    bars: dict[str, Any] = {}

    def watch(at: Trainer, loss: float) -> None:
        if at.phase not in bars:  # a phase has a speed of its own
            for bar in bars.values():
                bar.close()
            quiet = args.quiet or process.rank != 0
            bars[at.phase] = tqdm(total=at.steps, initial=at.step - 1, unit="step", desc=at.phase, disable=quiet)
        bars[at.phase].set_postfix_str(f"loss {loss:.4f}", refresh=False)
        bars[at.phase].update()

    try:
        with locked(folder) if process.rank == 0 else nullcontext():
            trainer = Trainer(config, folder, process, validation, tqdm.write)
            trainer.run(60.0 * args.minutes, watch)
    finally:
        for bar in bars.values():
            bar.close()
        process.close()
    if process.rank == 0:
        print(f"{folder / 'checkpoint'}: {trainer.phase}, step {trainer.step} of {trainer.steps}")


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("config", metavar="CONFIG.yaml")
    parser.add_argument("--out", help="folder of the run (default: runs/CONFIG)")
    parser.add_argument(
        "--set", type=key_value, action="append", default=[], metavar="KEY=VALUE", help="for example latent.dim=96"
    )
    parser.add_argument(
        "--minutes", type=positive_number, default=float("inf"), help="time limit; the same command resumes the run"
    )
    parser.add_argument("--quiet", action="store_true", help="show no progress")
    args = parser.parse_args()
    train(args)


if __name__ == "__main__":
    run_script(main, "train")
