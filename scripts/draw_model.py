"""Draw how a model denoises a trajectory, and how diverse its trajectories are, as the paper's figures do.

``denoising.png`` shows the paths of both hands at t = 0, 64, 128 and 256 of the reverse process (section IV-A), from
above and from the side, the obstacles as grey outlines. ``diversity.png`` shows valid trajectories of one problem: x
and y of both hands over the path, from start to goal (section IV-D).

Usage: python scripts/draw_model.py [--model apex-paper] [--problem NAME] [--folder docs/pictures]
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from apex_ompl import load_model, load_problem
from apex_ompl.apex.query import make_query
from apex_ompl.diffusion.guidance import Guidance
from apex_ompl.diffusion.proposals import Sampling
from apex_ompl.kernel import Kernel
from apex_ompl.kernel.compiled.arrays import BOX, HALF_SPACE, SPHERE
from apex_ompl.ompl_adapter.setup import PlanningSetup, assemble
from apex_ompl.ompl_adapter.validity import full_check
from apex_ompl.problems.suite_robot import robot
from apex_ompl.trajopt.candidates import first_valid
from apex_ompl.trajopt.optimizer import Optimizer
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.files import make_folder
from apex_ompl.util.validation import whole_number

MOMENTS = (0.0, 0.25, 0.5, 1.0)  # as shares of the reverse process
HANDS = {"left_hand_palm_0": "tab:blue", "right_hand_palm_0": "tab:orange"}
GUIDED = Guidance(1.0, "noise", active_below=0.25)


def palm_positions(kernel: Kernel, path: np.ndarray) -> dict[str, np.ndarray]:
    """Return the positions of the palms along a path, shape (N, 3) [m], by body."""
    tables = kernel.robot
    _, origin = kernel.joint_frames(path)
    return {name: origin[:, tables.arrays.body_joint[tables.body_names.index(name)]] for name in HANDS}


def outlines(axes: Any, ready: PlanningSetup, first: int, second: int) -> None:
    """Draw the obstacles' boxes onto two of the world's axes."""
    from matplotlib.patches import Rectangle

    scene = ready.checker.kernel.scene.arrays
    for kind, rotation, offset, size in zip(scene.kind, scene.rotation, scene.offset, scene.size, strict=True):
        if kind == HALF_SPACE:
            continue
        around = size if kind == BOX else np.array([size[0], size[0], size[0] if kind == SPHERE else size[1]])
        half = np.abs(rotation) @ around
        corner = offset[[first, second]] - half[[first, second]]
        sides = 2.0 * half[[first, second]]
        axes.add_patch(Rectangle(tuple(corner), *sides, facecolor="0.92", edgecolor="0.6", lw=0.6, zorder=0))


def denoising(name: str, ready: PlanningSetup, seed: int, file: Path) -> None:
    """Draw the decoded samples at some steps of the reverse process."""
    import matplotlib.pyplot as plt

    model, kernel = load_model(name), ready.checker.kernel
    snapshots, ends = {}, (ready.start[None], ready.goals[0][None])
    steps = model.schedule.steps
    moments = [round(share * steps) for share in MOMENTS]

    def keep(t: int, sample: Any, estimate: Any) -> None:
        del estimate
        if steps - 1 - t in moments:
            snapshots[steps - 1 - t] = model.spline.path(model.control(sample, ends))[0]

    query, generator = make_query(ready.checker, ready.start, ready.goals[0]), np.random.default_rng(seed)
    sampling = Sampling("ddpm", steps, guidance=GUIDED)
    made = model.propose(query, kernel, 1, sampling=sampling, generator=generator, callback=keep)
    snapshots[steps] = model.spline.path(model.control(made.latent, ends))[0]
    figure, axes = plt.subplots(2, len(MOMENTS), figsize=(12, 6.2), sharex=True, sharey="row", layout="constrained")
    for column, moment in enumerate(moments):
        for row, (first, second) in enumerate(((0, 1), (0, 2))):
            at = axes[row, column]
            outlines(at, ready, first, second)
            for body, line in palm_positions(kernel, snapshots[moment]).items():
                at.plot(line[:, first], line[:, second], color=HANDS[body], lw=1.2)
                at.plot(*line[0, [first, second]], "P", color=HANDS[body], ms=7)
                at.plot(*line[-1, [first, second]], "v", color=HANDS[body], ms=7)
            at.set_aspect("equal")
            at.set(xlim=(-0.3, 1.3), ylim=(-1.1, 1.1) if second == 1 else (-0.1, 1.5))
        axes[0, column].set_title(f"t = {moment}")
        axes[1, column].set_xlabel("x m")
    axes[0, 0].set_ylabel("y m")
    axes[1, 0].set_ylabel("z m")
    figure.savefig(file, dpi=110)
    plt.close(figure)


def diversity(name: str, ready: PlanningSetup, seed: int, file: Path, wanted: int = 12) -> int:
    """Draw valid trajectories of one problem; return how many there are."""
    import matplotlib.pyplot as plt

    model, kernel = load_model(name), ready.checker.kernel
    optimizer = Optimizer(model.spline)
    query, found = make_query(ready.checker, ready.start, ready.goals[0]), []

    def is_valid(path: np.ndarray) -> bool:
        return bool(full_check(ready.checker, path, ready.start, [ready.goals[0]]))

    generator = np.random.default_rng(seed)
    sampling = Sampling("ddim", 8, guidance=Guidance(1.0))
    for control in model.propose(query, kernel, 4 * wanted, sampling=sampling, generator=generator).control:
        if len(found) == wanted:
            break
        repaired = first_valid(optimizer, kernel, control[None], is_valid)
        if repaired is not None:
            found.append(optimizer.spline.path(repaired))
    figure, axes = plt.subplots(2, 2, figsize=(9, 5.5), sharex=True, layout="constrained")
    share = np.linspace(0.0, 1.0, optimizer.spline.states)
    for path in found:
        for column, line in enumerate(palm_positions(kernel, path).values()):
            for row in range(2):
                axes[row, column].plot(share, line[:, row], lw=1.0, alpha=0.8)
                axes[row, column].plot(0.0, line[0, row], "kP", ms=8)
                axes[row, column].plot(1.0, line[-1, row], "kv", ms=8)
    for column, title in enumerate(("left hand", "right hand")):
        axes[0, column].set_title(title)
        axes[1, column].set_xlabel("share of the path")
    axes[0, 0].set_ylabel("x m")
    axes[1, 0].set_ylabel("y m")
    figure.savefig(file, dpi=110)
    plt.close(figure)
    return len(found)


def main() -> None:
    """Draw both."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", default="apex-paper", help="for the denoising (default: %(default)s)")
    parser.add_argument("--diverse", default="apex", help="for the diversity (default: %(default)s)")
    parser.add_argument("--problem", default="horizontal/large/900003")
    parser.add_argument("--many", default="posts/hard/900004", help="problem of the diversity (default: %(default)s)")
    parser.add_argument("--seed", type=whole_number, default=0)
    parser.add_argument("--folder", type=Path, default=Path("docs/pictures"))
    args = parser.parse_args()
    make_folder(args.folder)
    one, many = (assemble(load_problem(name), robot()) for name in (args.problem, args.many))
    denoising(args.model, one, args.seed, args.folder / "denoising.png")
    count = diversity(args.diverse, many, args.seed, args.folder / "diversity.png")
    print(f"{args.folder}: denoising.png, diversity.png with {count} valid trajectories of {args.many}")


if __name__ == "__main__":
    run_script(main, "data")
