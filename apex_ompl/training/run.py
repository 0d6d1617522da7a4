"""A training run: its steps, its log, as CSV and for TensorBoard, and the state from which it is resumed."""

from __future__ import annotations

import csv
import io
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Generic, Self, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from apex_ompl.errors import ApexError, FileFormatError, MissingFileError
from apex_ompl.training.config import TrainingFile
from apex_ompl.util.files import check_writable, is_file, read_text, write_atomically

FIELDS = ("phase", "step", "loss", "held_out", "rate", "seconds", "sampled", "repaired", "levels")
PLOTTED = ("loss", "held_out", "rate", "sampled", "repaired")
FILE = "log.csv"
STATE = "state.pt"
EXPECTED = "expected the state of a training run"
MAX_SKIPPED = 20  # steps in a row whose gradient is not finite
Network = TypeVar("Network", bound=nn.Module)


class TrainingError(ApexError):
    """A training run cannot continue."""


class TrainingRun(ABC, Generic[Network]):
    """Training of a network by AdamW, resumed from the state in its folder where there is one.

    Weights of matrices decay. A subclass sets ``network`` and the digest of what determines its weights, and gives the
    loss of each step.

    Attributes:
        config: Configuration of the run.
        folder: Folder of the run.
        device: Device of torch's that the network is on.
        network: Network in training.
        averaged: Exponential moving average of its weights, by name.
        phase: What is trained.
        step: Number of steps done in the phase.
        seconds: Time of all steps [s].
    """

    phase: str
    network: Network
    _digest: str

    def __init__(self, config: TrainingFile, folder: Path, device: torch.device) -> None:
        """Start at step 0.

        Raises:
            MissingFileError: The folder cannot be written to.
        """
        self.folder, self.device, self._settings = folder, device, config
        check_writable(folder / STATE)
        self.step, self.seconds, self._skipped = 0, 0.0, 0

    @property
    @abstractmethod
    def steps(self) -> int:
        """Number of steps of the phase."""

    @property
    def done(self) -> bool:
        """Whether the training is complete."""
        return self.step >= self.steps

    @abstractmethod
    def _rate(self) -> float:
        """Return the learning rate of the next step."""

    @abstractmethod
    def _loss(self) -> Tensor:
        """Return the loss of the next step's batch."""

    @abstractmethod
    def _log(self, loss: float, last: bool) -> None:
        """Append a row with a mean loss to the log; the last step of the phase may be done."""

    @abstractmethod
    def save(self) -> None:
        """Write the state of the run, and the averaged network as a checkpoint."""

    def _optimize(self, named: Iterable[tuple[str, nn.Parameter]]) -> None:
        """Make the optimizer of some parameters, and start the averages of all weights."""
        some = dict(named)
        self._names, self._parameters = list(some), list(some.values())
        self.averaged = {name: p.detach().clone() for name, p in self.network.named_parameters()}
        self._optimizer = torch.optim.AdamW(
            [
                {"params": [p for p in self._parameters if p.ndim > 1], "weight_decay": self._settings.decay},
                {"params": [p for p in self._parameters if p.ndim <= 1], "weight_decay": 0.0},
            ],
            lr=self._rate(), betas=(0.9, 0.99), fused=self.device.type == "cuda",
        )  # fmt: skip

    def advance(self) -> float:
        """Do one step of AdamW, and return its loss; a step whose gradient is not finite changes no weight.

        The average w' of the weights w follows as w' <- d w' + (1 - d) w with d = min(ema, (1 + step) / (10 + step)).

        Raises:
            TrainingError: The gradients of many steps in a row were not finite.
        """
        started = time.perf_counter()
        for group in self._optimizer.param_groups:
            group["lr"] = self._rate()
        loss = self._loss()
        self._optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        norm = nn.utils.clip_grad_norm_(self._parameters, self._settings.clip)
        self.step += 1
        if torch.isfinite(norm):  # the same in all processes, as gradients are shared
            self._skipped = 0
            self._optimizer.step()
            with torch.no_grad():
                share = 1.0 - min(self._settings.ema, (1.0 + self.step) / (10.0 + self.step))
                torch._foreach_lerp_([self.averaged[name] for name in self._names], list(self._parameters), share)
        else:
            self._skipped += 1
            if self._skipped >= MAX_SKIPPED:
                raise TrainingError(f"{self.phase}, step {self.step}: {MAX_SKIPPED} gradients in a row are not finite")
        self.seconds += time.perf_counter() - started
        return float(loss.detach())

    def run(self, seconds: float = math.inf, watch: Callable[[Self, float], None] | None = None) -> None:
        """Train to the end, or for some seconds; log and save at the configured intervals.

        Args:
            seconds: Time limit [s].
            watch: Called after each step with this run and the loss.
        """
        started = saved = time.perf_counter()
        losses: list[float] = []
        while not self.done and not self._any(time.perf_counter() - started >= seconds):
            losses.append(self.advance())
            if watch is not None:
                watch(self, losses[-1])
            last = self.step == self.steps
            if self.step % self._settings.log_every == 0 or last:
                self._log(float(np.mean(losses)), last)
                losses = []
            if time.perf_counter() - saved > self._settings.save_every:
                self.save()
                saved = time.perf_counter()
        self.save()

    def _any(self, flag: bool) -> bool:
        """Return whether a flag is set in any of the processes that train together."""
        return flag

    def _row(self, loss: float) -> dict[str, Any]:
        """Return a row of the log."""
        row: dict[str, Any] = {"phase": self.phase, "step": self.step, "loss": f"{loss:.6f}"}
        return row | {"rate": f"{self._rate():.3g}", "seconds": f"{self.seconds:.1f}"}

    def _write_state(self, number: int = 0, left: int = 0) -> None:
        """Write the state of the run; ``number`` and ``left`` tell where it is in its data."""
        state = {
            "phase": self.phase, "step": self.step, "number": number, "left": left, "seconds": self.seconds,
            "network": self.network.state_dict(), "averaged": self.averaged, "optimizer": self._optimizer.state_dict(),
        }  # fmt: skip
        stream = io.BytesIO()
        torch.save({"essence": self._digest, **state}, stream)
        write_atomically(self.folder / STATE, stream.getvalue())

    def _load_state(self) -> dict[str, Any] | None:
        """Go on from the state of the run where there is one, and return it.

        Raises:
            FileFormatError: The file is damaged, or of a run with other settings or data.
        """
        path = self.folder / STATE
        if not is_file(path):
            return None
        try:
            state: dict[str, Any] = torch.load(path, map_location=self.device, weights_only=True)
            found = state["essence"]
        except Exception as error:  # zipfile and pickle let many kinds through
            raise FileFormatError(str(path), "", type(error).__name__, EXPECTED) from error
        if found != self._digest:
            expected = "expected the state of a run with this configuration and these data; take another folder"
            raise FileFormatError(str(path), "essence", found[:12], expected)
        try:
            self.network.load_state_dict(state["network"])
            self._go_to(state["phase"])
            averaged = {name: state["averaged"][name].to(self.device) for name in self.averaged}
            self._optimizer.load_state_dict(state["optimizer"])
            self.step, self.seconds, self.averaged = state["step"], state["seconds"], averaged
            return {name: state[name] for name in ("number", "left")}
        except (AttributeError, KeyError, RuntimeError, TypeError, ValueError) as error:
            raise FileFormatError(str(path), "", type(error).__name__, EXPECTED) from error

    def _go_to(self, phase: str) -> None:
        """Go to the phase of a state that is loaded."""
        self.phase = phase


def read_log(folder: Path) -> list[dict[str, str]]:
    """Return the rows of a run's log.

    Raises:
        MissingFileError: The file cannot be read.
        FileFormatError: It is not a log.
    """
    path = folder / FILE
    if not is_file(path):
        return []
    rows = list(csv.DictReader(io.StringIO(read_text(path, "log of a training run"), newline="")))
    if any(not (row.get("step") or "").isdecimal() or not row.get("phase") for row in rows):
        raise FileFormatError(str(path), "step", "no number", "expected the log of a training run")
    return rows


class RunLog:
    """Rows of numbers by phase and step."""

    def __init__(self, folder: Path, progress: Mapping[str, int]) -> None:
        """Append to the log in a folder; rows beyond the progress of a phase are removed.

        Args:
            folder: Folder of the run.
            progress: Last step of each phase.

        Raises:
            FileFormatError: The existing file is not a log.
            MissingFileError: It cannot be written.
        """
        self._path = folder / FILE
        rows = read_log(folder)
        kept = [row for row in rows if int(row["step"]) <= progress.get(row["phase"], -1)]
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, FIELDS, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(kept)
        write_atomically(self._path, text.getvalue().encode())
        self._board: Any = None
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            return
        self._board = SummaryWriter(str(folder / "tensorboard"), purge_step=max(progress.values(), default=0) + 1)

    def add(self, row: Mapping[str, str | int]) -> None:
        """Add a row.

        Raises:
            MissingFileError: It cannot be written.
        """
        try:
            with self._path.open("a", newline="") as file:
                csv.DictWriter(file, FIELDS).writerow(row)
        except OSError as error:
            raise MissingFileError(str(self._path), "log of a training run", str(error.strerror).lower()) from error
        if self._board is not None:
            for name in PLOTTED:
                if name in row:
                    self._board.add_scalar(f"{row['phase']}/{name}", float(row[name]), int(row["step"]))
            self._board.flush()
