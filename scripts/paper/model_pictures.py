"""How a model denoises a trajectory, and how diverse its trajectories are, drawn as the paper's figures are.

``denoising`` shows the paths of both hands at t = 0, 64, 128 and 256 of the reverse process (section IV-A), from above
and from the side, the obstacles as gray outlines. ``diversity`` shows valid trajectories of one problem: x and y of
both hands over the path, from start to goal (section IV-D).
"""

from __future__ import annotations

from argparse import Namespace
from typing import Any

import numpy as np
from paper.figure import Made, blank

from apex_ompl import load_model, load_problem
from apex_ompl.apex.models import make_query
from apex_ompl.evaluation.metrics import diversity as mean_distance
from apex_ompl.evaluation.summary import Table
from apex_ompl.kernel import Kernel
from apex_ompl.kernel.arrays import BOX, HALF_SPACE, SPHERE
from apex_ompl.model.guidance import EQUATION_7, Guidance
from apex_ompl.model.proposals import Sampling
from apex_ompl.ompl.setup import PlanningSetup, assemble
from apex_ompl.ompl.validity import full_check
from apex_ompl.paths.candidates import first_valid
from apex_ompl.paths.optimizer import Optimizer
from apex_ompl.paths.path import path_length
from apex_ompl.problems.suite_robot import robot

DENOISED, DENOISER = "horizontal/large/900003", "apex-paper"
MANY, PROPOSER = "posts/hard/900004", "apex"
SEED = 0
TRIES = 4  # proposals for each path wanted
MOMENTS = (0.0, 0.25, 0.5, 1.0)  # as shares of the reverse process
HANDS = {"left_hand_palm_0": "tab:blue", "right_hand_palm_0": "tab:orange"}


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


def denoising(args: Namespace) -> Made:
    """Return the decoded samples at some steps of the reverse process."""
    ready, model = assemble(load_problem(DENOISED), robot()), load_model(DENOISER)
    kernel, steps = ready.checker.kernel, model.schedule.steps
    snapshots, ends = {}, (ready.start[None], ready.goals[0][None])
    moments = [round(share * steps) for share in MOMENTS]

    def keep(t: int, sample: Any, estimate: Any) -> None:
        del estimate
        if steps - 1 - t in moments:
            snapshots[steps - 1 - t] = model.spline.path(model.control(sample, ends))[0]

    query, generator = make_query(ready.checker, ready.start, ready.goals[0]), np.random.default_rng(SEED)
    sampling = Sampling("ddpm", steps, guidance=EQUATION_7)
    made = model.propose(query, kernel, 1, sampling=sampling, generator=generator, callback=keep)
    snapshots[steps] = model.spline.path(model.control(made.latent, ends))[0]
    picture = blank(12, 6.2)
    axes = picture.subplots(2, len(MOMENTS), sharex=True, sharey="row")
    for column, moment in enumerate(moments):
        for row, (first, second) in enumerate(((0, 1), (0, 2))):
            at = axes[row, column]
            outlines(at, ready, first, second)
            for body, line in palm_positions(kernel, snapshots[moment]).items():
                hand = body.partition("_palm")[0].replace("_", " ")
                at.plot(line[:, first], line[:, second], color=HANDS[body], lw=1.2, label=hand)
                at.plot(*line[0, [first, second]], "P", color=HANDS[body], ms=7)
                at.plot(*line[-1, [first, second]], "v", color=HANDS[body], ms=7)
            at.set_aspect("equal")
            at.set(xlim=(-0.3, 1.3), ylim=(-1.1, 1.1) if second == 1 else (-0.1, 1.5))
        axes[0, column].set_title(f"t = {moment}")
        axes[1, column].set_xlabel("x m")
    axes[0, 0].set_ylabel("y m")
    axes[1, 0].set_ylabel("z m")
    axes[0, -1].legend(loc="lower right", fontsize=8)
    lengths = {str(moment): path_length(snapshots[moment]) for moment in moments}
    table = Table("Denoising", ["t", "model", "S_r rad"], [[t, DENOISER, f"{x:.2f}"] for t, x in lengths.items()])
    how = f"DDPM, {steps} steps, guided in the last {EQUATION_7.active_below:.0%} of them"
    notes = [("Problem", DENOISED), ("Seed", SEED), ("Sampling", how)]
    return Made({"S_r": lengths, "problem": DENOISED}, [table], notes, picture)


def diversity(args: Namespace) -> Made:
    """Return valid trajectories of one problem, and how far they are apart."""
    ready, model = assemble(load_problem(MANY), robot()), load_model(PROPOSER)
    kernel, optimizer = ready.checker.kernel, Optimizer(model.spline)
    query, found = make_query(ready.checker, ready.start, ready.goals[0]), []

    def is_valid(path: np.ndarray) -> bool:
        return bool(full_check(ready.checker, path, ready.start, [ready.goals[0]]))

    generator, tried = np.random.default_rng(SEED), 0
    sampling = Sampling("ddim", 8, guidance=Guidance(1.0))
    for control in model.propose(query, kernel, TRIES * args.n, sampling=sampling, generator=generator).control:
        if len(found) == args.n:
            break
        tried += 1
        repaired = first_valid(optimizer, kernel, control[None], is_valid)
        if repaired is not None:
            found.append(optimizer.spline.path(repaired))
    picture = blank(9, 5.5)
    axes = picture.subplots(2, 2, sharex=True)
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
    apart = mean_distance(found) if found else None
    data = {"valid": len(found), "proposals": tried, "mean distance rad": apart, "problem": MANY}
    cells = [MANY, PROPOSER, str(tried), str(len(found)), "-" if apart is None else f"{apart:.2f}"]
    table = Table("Diversity", ["problem", "model", "proposals", "valid", "mean distance rad"], [cells])
    notes = [
        ("Seed", SEED),
        ("Sampling", "DDIM, 8 steps, guided; each proposal is repaired by trajectory optimization"),
    ]
    return Made(data, [table], notes, picture)
