"""The command ``apex-ompl robot train``."""

from __future__ import annotations

import argparse

from apex_ompl.cli.progress import progress_bars
from apex_ompl.onboarding.session import Session, Trained, train_robot
from apex_ompl.util.display import Summary, counted


def train(parsed: argparse.Namespace) -> int:
    """Train a model for a robot, and print what its proposals gain."""
    settings = Session(parsed.hours, parsed.jobs, parsed.seed)
    with progress_bars() as report:
        done = train_robot(parsed.robot, parsed.out, settings, report)
    print(_summary(parsed.robot, done))
    return 0


def _summary(name: str, done: Trained) -> Summary:
    told = done.validation
    times = [f"{a} s of CPU with the model, {b} s without ({of})" for of in ("p50", "p95") for a, b in (told[of],)]
    return Summary(name, [
        ("data", f"{counted(done.paths, 'path')} of {counted(done.problems, 'problem')}"),
        ("training", counted(done.steps, "step")),
        ("solved", f"{told['solved'][0]} of {told['problems']} with the model, {told['solved'][1]} without"),
        *(("time", text) for text in times),
        ("gain", told["verdict"]),
        ("file", str(done.model)),
    ])  # fmt: skip
