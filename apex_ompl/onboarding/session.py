"""The training of a robot's model in a given time, in stages: data, training, validation.

All stages keep what they have in the folder of the session, with the time that they have taken, so that a session that
was stopped goes on where it was. The checkpoint is written at the end, with what its proposals gain.
"""

from __future__ import annotations

import itertools
import json
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from apex_ompl.apex.model_search import DIGEST, data_folder, robot_fault
from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.cover.preparation import name_in
from apex_ompl.errors import FileFormatError, MissingFileError, RobotError
from apex_ompl.onboarding import gain
from apex_ompl.onboarding.symmetry import mirror_of
from apex_ompl.planning.planner import MotionPlanner
from apex_ompl.problems.robot_cells import cell_of
from apex_ompl.problems.robot_problems import robot_of
from apex_ompl.robot.config import read_config
from apex_ompl.robot.identity import digest
from apex_ompl.robot.model import robot_names
from apex_ompl.training.generation import Generation, Work, generate
from apex_ompl.training.units import plan_robot_units, solve_unit
from apex_ompl.util.extras import import_extra
from apex_ompl.util.files import check_writable, is_file, locked, make_folder, write_atomically
from apex_ompl.util.validation import check_integer, check_positive

if TYPE_CHECKING:
    from apex_ompl.training.training import Trainer

SCHEMA = "apex-ompl/robot-training/1"
DATA, TRAINING, VALIDATION = "data", "training", "validation"
STATE = "session.json"
SHARES = {DATA: 0.4, TRAINING: 0.5, VALIDATION: 0.1}
"""Share of the time of each stage."""

FREE_SAMPLES = 500  # random states of which one must be free
UNIT_SIZES = ((1800.0, 16), (0.0, 4))  # least time of a session [s], and problems of its units
UNITS_A_SECOND = 4  # units that are solved in a second of a process, at most
LEAST_PATHS, LEAST_UNITS = 40, 40  # paths that a model is trained on; units among which there must be as many
LEAST_TRAINING = 3.0  # time for steps after data and networks are set up [s]
LEAST_PAIRS, MOST_PAIRS = 4, 400  # validation problems
TIMEOUT = 2.0  # of a plan in the validation [s]
EXPECTED = "expected the state of a training of this robot with these options; take another --out, or remove the folder"


@dataclass(frozen=True)
class Session:
    """Settings of a session.

    Attributes:
        hours: Time for all stages by the wall clock [h].
        jobs: Processes that generate data; several are run by Ray.
        seed: Seed of all random choices.
    """

    hours: float
    jobs: int = 1
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the ranges."""
        check_positive(self.hours, "hours", "a positive number of hours")
        check_integer(self.jobs, "jobs", 1)
        check_integer(self.seed, "seed", 0)

    @property
    def seconds(self) -> float:
        """Time for all stages [s]."""
        return 3600.0 * self.hours


class Trained(NamedTuple):
    """Outcome of a session.

    Attributes:
        model: Folder of the checkpoint.
        paths: Number of paths of the data set.
        problems: Number of problems that they solve.
        steps: Number of steps of the training.
        validation: Figures of :func:`apex_ompl.onboarding.gain.summary`.
    """

    model: Path
    paths: int
    problems: int
    steps: int
    validation: dict[str, Any]


Report = Callable[[str, float, str], object]
"""Called with the name of a stage, the share of it that is done, and a word on how it goes."""


def train_robot(
    name: str, folder: Path | None, settings: Session, report: Report = lambda stage, share, text: None
) -> Trained:  # fmt: skip
    """Train a model for a robot, or go on with a training that was stopped.

    Args:
        name: The robot file, which is made to name the checkpoint, a folder beside it; or the name of a robot that
            ships, whose checkpoint is written into the user's data.
        folder: Folder of the session; by default one named after the robot file and beside it, or in the current
            folder.
        settings: Settings.
        report: Called with the progress.

    Raises:
        RobotError: The robot has no arms or no free states, or too few problems were solved.
        MissingFileError: A package for training is missing, or a folder cannot be written.
        FileFormatError: The folder is of another training.
        KeyboardInterrupt: Ctrl-C was pressed; what was done is kept.
    """
    for module in ("zarr", "torch"):
        import_extra(module, "training", "train")
    robot, file = robot_of(name), Path(name).absolute()
    stem = file.name.split(".")[0]
    if name in robot_names():
        home = data_folder()
        if home is None:
            raise MissingFileError("the home folder", "place of the user's data")
        folder, model = folder or Path(f"{stem}.training"), home / name
    else:
        model = file.parent / (read_config(file).model or f"{stem}.model")
        folder = folder or file.parent / f"{stem}.training"
        check_writable(file)
    check_writable(make_folder(folder, "folder of a training") / STATE)
    make_folder(model.parent, "folder for a checkpoint")
    cell_of(robot)  # or it has no arms
    states = robot.random_state(np.random.default_rng(0), FREE_SAMPLES)
    if not CollisionChecker(robot).are_free(states).any():
        raise RobotError(f"robot {robot.name!r} has no free state among {FREE_SAMPLES} random ones; see robot check")
    with locked(folder):
        done = _Stages(name if name in robot_names() else str(file), folder, model, settings, report).run()
    if name not in robot_names():
        name_in(file, {"model": model})
    return done


class _Stages:
    """The stages of a session, and its state on disk."""

    def __init__(self, file: str, folder: Path, model: Path, settings: Session, report: Report) -> None:
        """Read the state of the session, or start it.

        Raises:
            FileFormatError: The folder is of another training.
        """
        self.file, self.folder, self.model, self.settings, self.report = file, folder, model, settings, report
        self.robot, self.paths = robot_of(file), folder / "paths"
        self.size = next(size for least, size in UNIT_SIZES if settings.seconds >= least)
        same = {"schema": SCHEMA, "robot": digest(self.robot), "hours": settings.hours, "seed": settings.seed}
        self.state: dict[str, Any] = {
            **same,
            "spent": dict.fromkeys(SHARES, 0.0),
            "done": {},
            "config": None,
            "pairs": [],
        }
        path = folder / STATE
        if not is_file(path):
            return
        try:
            state = json.loads(path.read_bytes())
            fault = next((key for key, value in same.items() if state.get(key) != value), None)
        except (OSError, ValueError, AttributeError) as error:
            raise FileFormatError(str(path), "", type(error).__name__, EXPECTED) from error
        if fault is not None:
            raise FileFormatError(str(path), fault, state.get(fault), EXPECTED)
        self.state = state

    def run(self) -> Trained:
        """Do what is left of all stages, and write the checkpoint."""
        counts = self._done(DATA) or self._data()
        trained = self._done(TRAINING) or self._train()
        told = self._done(VALIDATION) or self._validate(trained)
        return Trained(self.model, counts["paths"], counts["solved"], trained["step"], told)

    def _done(self, stage: str) -> dict[str, Any] | None:
        found: dict[str, Any] | None = self.state["done"].get(stage)
        return found

    def _left(self, stage: str) -> float:
        """Return the time that a stage still has [s]: its share, and what earlier stages left; never less than 0."""
        whole, spent = self.settings.seconds, self.state["spent"]
        stages = list(SHARES)[: list(SHARES).index(stage) + 1]
        until = whole * sum(SHARES[one] for one in stages) - sum(spent[one] for one in stages)
        return float(max(0.0, whole * SHARES[stage] - spent[stage], until))

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        """Add the time of a block to a stage, also where it is interrupted."""
        started = time.monotonic()
        try:
            yield
        finally:
            self.state["spent"][stage] += time.monotonic() - started
            self._write()

    def _write(self) -> None:
        write_atomically(self.folder / STATE, (json.dumps(self.state, indent=1) + "\n").encode())

    def _end(self, stage: str, outcome: dict[str, Any]) -> dict[str, Any]:
        self.state["done"][stage] = outcome
        self._write()
        return outcome

    def _data(self) -> dict[str, Any]:
        """Generate the data set.

        Raises:
            RobotError: Too few paths were found.
        """
        seconds, jobs, robot = max(self._left(DATA), 1e-3), self.settings.jobs, self.robot
        most = math.ceil(UNITS_A_SECOND * jobs * self.settings.seconds) + 1
        units = {unit.name: unit for unit in itertools.islice(plan_robot_units(self.file, self.size), most)}
        about = {"robot": robot.name, "joints": list(robot.joint_names), "problems_per_unit": self.size}
        work = Work(solve_unit, units, about, cell_of(robot).tables.whole)
        settings = Generation(workers=jobs, seconds=seconds, least=(LEAST_PATHS, LEAST_UNITS))
        with self._timed(DATA):
            found = generate(
                self.paths, work, settings, lambda name, paths, spent: self.report(
                    DATA, min(1.0, spent / seconds), f"{paths} paths"
                )
            )  # fmt: skip
        total = found.total
        if total["paths"] < LEAST_PATHS:
            told = f"{total['paths']} paths of {total['solved']} of {total.get('drawn', 0)} problems in this time"
            expected = f"expected {LEAST_PATHS} paths or more: take more hours, or see what robot check says"
            raise RobotError(f"robot {robot.name!r}: {told}; {expected}")
        return self._end(DATA, {"paths": total["paths"], "solved": total["solved"]})

    def _train(self) -> dict[str, Any]:
        """Train the networks, and write the checkpoint without figures."""
        from apex_ompl.onboarding.sizes import training_config, with_steps
        from apex_ompl.training.config import TrainingConfig
        from apex_ompl.training.training import DistributedProcess, Trainer

        seconds, run = self._left(TRAINING), make_folder(self.folder / "run", "folder of a training run")
        started = time.monotonic()
        with self._timed(TRAINING):
            if self.state["config"] is None:
                cell = cell_of(self.robot)
                plain = training_config(cell, self.paths, seconds, seed=self.settings.seed, mirror=mirror_of(cell))
                self.state["config"] = with_steps(plain, seconds)
                self._write()
            trainer = Trainer(TrainingConfig.model_validate(self.state["config"]), run, DistributedProcess.current())
            left = max(seconds - (time.monotonic() - started), LEAST_TRAINING)
            try:
                trainer.run(left, self._watch)
            except KeyboardInterrupt:
                trainer.save()
                raise
            about = {**trainer.about(), DIGEST: digest(self.robot)}
        return self._end(TRAINING, about)

    def _watch(self, at: Trainer, loss: float) -> None:
        self.report(TRAINING, at.step / at.steps, f"loss {loss:.3f}")

    def _validate(self, trained: dict[str, Any]) -> dict[str, Any]:
        """Plan with the model and without, and write the checkpoint with the outcome."""
        from apex_ompl.training.torch_model import load_torch_model, save_model

        network = load_torch_model(self.folder / "run" / "checkpoint", robot=self.robot.name).network
        save_model(self.model, network, trained)
        fault = robot_fault(self.model, self.robot)
        if fault is not None:
            raise fault
        seconds, started = self._left(VALIDATION), time.monotonic()
        units = plan_robot_units(self.file, 1, "validation")
        found = [gain.Pair(*row) for row in self.state["pairs"]]
        with self._timed(VALIDATION):
            planner = MotionPlanner(self.file)
            for pair in gain.pairs(planner, str(self.model), units, TIMEOUT, {pair.problem for pair in found}):
                found.append(pair)
                self.state["pairs"] = found
                spent = time.monotonic() - started
                self.report(VALIDATION, min(1.0, max(spent / max(seconds, 1e-3), len(found) / MOST_PAIRS)), "")
                if len(found) >= MOST_PAIRS or (spent >= seconds and len(found) >= LEAST_PAIRS):
                    break
        told = gain.summary(found, TIMEOUT)
        save_model(self.model, network, {**trained, "validation": told})
        return self._end(VALIDATION, told)
