"""Train an imitation policy, the planners ``il`` and ``il-paper``; the same command resumes an interrupted run.

The run's folder receives ``checkpoint``, ``log.csv``, TensorBoard event files, and ``state.pt``, from which the run is
resumed. When the training is complete, ``--save`` copies the checkpoint to the folder in which the planners look for
it. Neither Pinocchio nor OMPL is needed; torch computes on a GPU where there is one, else by one thread.

Usage: python scripts/train_il.py scripts/configs/il.yaml [--out FOLDER] [--set KEY=VALUE ...] [--minutes M] [--save]
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from apex_ompl.util.entry_point import run_script
from apex_ompl.util.files import locked, make_folder
from apex_ompl.util.validation import key_value, positive_number

SAVED = Path(__file__).resolve().parents[1] / "benchmarks" / "baselines"


def train(args: argparse.Namespace) -> None:
    """Train to the end, or to the time limit."""
    import torch
    from tqdm import tqdm

    from apex_ompl.baselines.imitation.checkpoint import save_policy
    from apex_ompl.baselines.imitation.config import ImitationConfig
    from apex_ompl.baselines.imitation.training import ImitationTrainer
    from apex_ompl.util.process import one_torch_thread

    name = Path(args.config).stem
    config = ImitationConfig.read(args.config, dict(args.set))
    folder = make_folder(args.out or Path("runs") / name, "folder of a training run")
    with locked(folder), one_torch_thread():
        trainer = ImitationTrainer(config, folder, torch.device("cuda" if torch.cuda.is_available() else "cpu"))
        bar: Any = tqdm(total=config.steps, initial=trainer.step, unit="step", disable=args.quiet)

        def watch(at: ImitationTrainer, loss: float) -> None:
            bar.set_postfix_str(f"loss {loss:.4f}", refresh=False)
            bar.update()

        with bar:
            trainer.run(60.0 * args.minutes, watch)
        network = trainer.averaged_network()
        if args.save and trainer.done:
            about = trainer.about(network)
            save_policy(SAVED / name, network, trainer.robot, trainer.data.joints, about)
    print(f"{folder / 'checkpoint'}: step {trainer.step} of {config.steps}")


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("config", metavar="CONFIG.yaml")
    parser.add_argument("--out", help="folder of the run (default: runs/CONFIG)")
    parser.add_argument(
        "--set", type=key_value, action="append", default=[], metavar="KEY=VALUE", help="for example network.layers=3"
    )
    parser.add_argument(
        "--minutes", type=positive_number, default=float("inf"), help="time limit; the same command resumes the run"
    )
    parser.add_argument(
        "--save", action="store_true", help="write the trained policy to benchmarks/baselines/CONFIG, too"
    )
    parser.add_argument("--quiet", action="store_true", help="show no progress")
    args = parser.parse_args()
    train(args)


if __name__ == "__main__":
    run_script(main, "train")
