"""Training of the model: what the paper's Algorithm 1 calls train, made to go on after any interruption."""

from __future__ import annotations

import hashlib
import io
import json
import math
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, distributed, nn

from apex_ompl.datasets.cases import WrittenCase
from apex_ompl.diffusion.autoencoder import LinearLatent, VariationalLatent
from apex_ompl.diffusion.checkpoint import save_model
from apex_ompl.diffusion.conditions import Conditions
from apex_ompl.diffusion.config import TrainingConfig
from apex_ompl.diffusion.data import Supply
from apex_ompl.diffusion.model import LatentDiffusion, ModelConfig, SplineConfig
from apex_ompl.diffusion.objective import Objective, Place
from apex_ompl.diffusion.proposals import Sampling, TrajectoryModel
from apex_ompl.diffusion.runlog import RunLog
from apex_ompl.diffusion.validation import judged
from apex_ompl.errors import ApexError, FileFormatError
from apex_ompl.kernel import RobotTables
from apex_ompl.util.files import check_writable, is_file, write_atomically

WATCHED = 2048  # held-out paths that the validation loss is taken on, at most
PHASES = ("autoencoder", "denoiser")
STATE, STATE_EXPECTED = "state.pt", "expected the state of a training run"
MOST_SPOILT = 20  # steps in a row whose gradient is not finite


class TrainingError(ApexError):
    """A training that cannot go on."""


class Trainer:
    """Trains a model, and goes on where it was interrupted.

    Every step draws its paths, noise and steps by a seed of its own, so that a run that was interrupted comes to the
    same weights as one that was not, on a machine that computes alike.

    Attributes:
        network: The model in training.
        averaged: Its averaged weights, by name.
        phase: ``autoencoder`` or ``denoiser``.
        step: Steps done in the phase.
    """

    def __init__(
        self, config: TrainingConfig, folder: Path, place: Place, cases: Sequence[WrittenCase] = (),
        say: Callable[[str], None] = print,
    ) -> None:  # fmt: skip
        """Make a model, or load what a run left in ``folder``.

        Raises:
            ApexError: Data, tables or state cannot be read or do not fit.
        """
        self.config, self.folder, self.place, self.cases, self.say = config, folder, place, cases, say
        check_writable(folder / STATE)
        robot = RobotTables.load(config.robot)
        self.supply = Supply(config, robot)
        probes = self.supply.probes
        model = ModelConfig(
            robot=robot.name, joints=robot.joint_names, probes=len(probes.joint),
            spline=SplineConfig(**self.supply.spline), latent=config.latent, condition=config.condition,
            denoiser=config.denoiser, noise=config.noise, sampling=config.sampling,
        )  # fmt: skip
        with torch.random.fork_rng(devices=[]):  # torch's layers draw their weights from the global generator
            torch.manual_seed(config.seed)
            self.network = LatentDiffusion(model)
        self.network.probe_joint.copy_(torch.from_numpy(probes.joint))
        self.network.probe_offset.copy_(torch.from_numpy(probes.offset))
        limits = (torch.tensor(v, dtype=torch.float32) for v in (robot.arrays.lower, robot.arrays.upper))
        self.network.encoder.set_limits(*limits)
        autoencoder = self.network.autoencoder
        if isinstance(autoencoder, LinearLatent):
            autoencoder.fit(self.supply.measured())
        self.network.to(place.device)
        self.phase = self._first_phase
        self.step, self.seconds, self._spoilt = 0, 0.0, 0
        self._essence = hashlib.sha256(f"{config.essence}{robot.name}{self.supply.digest()}".encode()).hexdigest()
        self._begin_phase()
        if is_file(folder / STATE):
            self._load_state()
        self._runlog = RunLog(folder, self.progress) if place.rank == 0 else None
        objective = Objective(self.network, config.autoencoder.divergence)
        self._objective: nn.Module = objective
        if place.world > 1:
            self._objective = nn.parallel.DistributedDataParallel(objective, find_unused_parameters=True)

    @property
    def steps(self) -> int:
        """Number of steps of the phase."""
        return self.config.autoencoder.steps if self.phase == "autoencoder" else self.config.steps

    @property
    def done(self) -> bool:
        """Whether nothing is left to do."""
        return self.phase == "denoiser" and self.step >= self.steps

    def advance(self) -> float:
        """Do one step, and return its loss; a step whose gradient is not finite changes nothing.

        Raises:
            TrainingError: Many in a row were not.
        """
        begin = time.perf_counter()
        if self.step >= self.steps:
            self._end_autoencoder()
        self.supply.spend()
        for group in self._optimizer.param_groups:
            group["lr"] = self._rate()
        loss = self._loss()
        self._optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        norm = nn.utils.clip_grad_norm_(self._parameters, self.config.clip)
        self.step += 1
        if torch.isfinite(norm):  # the same in all processes, as gradients are shared
            self._spoilt = 0
            self._optimizer.step()
            with torch.no_grad():
                share = 1.0 - min(self.config.ema, (1.0 + self.step) / (10.0 + self.step))
                torch._foreach_lerp_([self.averaged[name] for name in self._names], list(self._parameters), share)
        else:
            self._spoilt += 1
            if self._spoilt >= MOST_SPOILT:
                raise TrainingError(f"{self.phase}, step {self.step}: {MOST_SPOILT} gradients in a row are not finite")
        self.seconds += time.perf_counter() - begin
        return float(loss.detach())

    def run(self, seconds: float = math.inf, watch: Callable[[Trainer, float], None] | None = None) -> None:
        """Train until all is done, or for some seconds; log, save and validate on the way.

        Args:
            seconds: Longest time [s].
            watch: Called behind every step with this trainer and the loss.
        """
        begin = saved = time.perf_counter()
        losses: list[float] = []
        while not self.done and not self._anywhere(time.perf_counter() - begin >= seconds):
            losses.append(self.advance())
            if watch is not None:
                watch(self, losses[-1])
            last = self.step == self.steps
            if self.step % self.config.log_every == 0 or last:
                self._log(float(np.mean(losses)), last)
                losses = []
            if time.perf_counter() - saved > self.config.save_every:
                self.save()
                saved = time.perf_counter()
        self.save()

    def save(self) -> None:
        """Write what is needed to go on, and the averaged model as a checkpoint."""
        if self.place.rank != 0:
            return
        state = {
            "essence": self._essence, "phase": self.phase, "step": self.step, "number": self.supply.number,
            "left": self.supply.left, "seconds": self.seconds, "network": self.network.state_dict(),
            "averaged": self.averaged, "optimizer": self._optimizer.state_dict(),
        }  # fmt: skip
        stream = io.BytesIO()
        torch.save(state, stream)
        write_atomically(self.folder / STATE, stream.getvalue())
        save_model(self.folder / "checkpoint", self.averaged_network(), self.about())

    def averaged_network(self) -> LatentDiffusion:
        """Return a model with the averaged weights."""
        with torch.random.fork_rng(devices=[]):
            network = LatentDiffusion(self.network.config)
        network.load_state_dict({**self.network.state_dict(), **self.averaged})
        return network.eval()

    def about(self) -> dict[str, Any]:
        """Return what a checkpoint says of its training."""
        config = self.config.model_dump(mode="json", by_alias=True)
        config["data"] = [Path(source).name for source in self.config.sources]  # where they lay is nobody's business
        config["robot"] = Path(self.config.robot).name
        config["cases"] = None if self.config.cases is None else Path(self.config.cases).name
        return {
            "phase": self.phase, "step": self.step, "seconds": round(self.seconds), "torch": torch.__version__,
            "paths": len(self.supply.window), "config": config,
        }  # fmt: skip

    def _parts(self) -> list[nn.Module]:
        if self.phase == "autoencoder":
            return [self.network.autoencoder]
        return [self.network.encoder, self.network.denoiser]

    def _begin_phase(self) -> None:
        chosen = {id(p) for part in self._parts() for p in part.parameters()}
        named = [(name, p) for name, p in self.network.named_parameters() if id(p) in chosen]
        self._names, self._parameters = [name for name, _ in named], [p for _, p in named]
        self.averaged = {name: p.detach().clone() for name, p in self.network.named_parameters()}
        self._optimizer = torch.optim.AdamW(
            [
                {"params": [p for p in self._parameters if p.ndim > 1], "weight_decay": self.config.decay},
                {"params": [p for p in self._parameters if p.ndim <= 1], "weight_decay": 0.0},
            ],
            lr=self._rate(), betas=(0.9, 0.99),
        )  # fmt: skip

    def _end_autoencoder(self) -> None:
        """Keep the averaged autoencoder, measure its latent space, and begin with the denoiser."""
        autoencoder = self.network.autoencoder
        assert isinstance(autoencoder, VariationalLatent)
        self.network.load_state_dict({**self.network.state_dict(), **self.averaged})
        autoencoder.measure(self.supply.measured().to(self.place.device))
        autoencoder.requires_grad_(False)
        self.phase, self.step = "denoiser", 0
        self._begin_phase()

    def _rate(self) -> float:
        top = self.config.autoencoder.rate if self.phase == "autoencoder" else self.config.rate
        rise = min(1.0, (self.step + 1) / self.config.warmup)
        return float(top * rise * 0.5 * (1.0 + math.cos(math.pi * min(1.0, self.step / self.steps))))

    def _loss(self) -> Tensor:
        config, place = self.config, self.place
        numbers = [config.seed, PHASES.index(self.phase), self.step, place.rank]
        generator = torch.Generator().manual_seed(int(np.random.SeedSequence(numbers).generate_state(1)[0]))
        window = self.supply.window
        control, given = window.batch(window.drawn(max(1, config.batch // place.world), generator))
        arguments = self._noise(len(control), generator)
        return self._computed(self._objective, control, given, arguments)

    def _noise(self, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        noise = torch.randn(count, *self.network.latent, generator=generator)
        return noise, torch.randint(self.config.noise.steps, (count,), generator=generator)

    def _computed(
        self, objective: nn.Module, control: Tensor, given: Conditions, arguments: tuple[Tensor, Tensor]
    ) -> Tensor:
        device = self.place.device
        mixed = torch.autocast(device.type, torch.bfloat16) if self.config.precision == "bfloat16" else nullcontext()
        with mixed:
            moved = (argument.to(device) for argument in arguments)
            found: Tensor = objective(self.phase, control.to(device), given.to(device), *moved)
        return found

    def _log(self, loss: float, last: bool) -> None:
        if self._runlog is None:
            return
        row: dict[str, Any] = {"phase": self.phase, "step": self.step, "loss": f"{loss:.6f}"}
        row |= {"rate": f"{self._rate():.3g}", "seconds": f"{self.seconds:.1f}"}
        network = self.averaged_network().to(self.place.device)
        watched = self.supply.watched
        if watched is not None:
            generator = torch.Generator().manual_seed(self.config.seed)
            which = torch.randperm(len(watched), generator=generator)[:WATCHED].sort().values
            control, given = watched.batch(which.numpy())
            objective = Objective(network, self.config.autoencoder.divergence)
            with torch.no_grad():
                held = self._computed(objective, control, given, self._noise(len(control), generator))
            row["held_out"] = f"{float(held):.6f}"
        if self.phase == "denoiser" and self.cases and (self.step % self.config.validate_every == 0 or last):
            sampling = Sampling(**self.config.judged.model_dump())
            said = judged(TrajectoryModel(network, {}), self.cases, self.config.proposals, sampling=sampling)
            row |= {name: f"{said.pop(name):.4f}" for name in ("sampled", "repaired")}
            row["levels"] = json.dumps({k: round(v, 3) for k, v in said.items()})
            self.say(f"step {self.step}: {row['sampled']} sampled, {row['repaired']} repaired")
        self._runlog.add(row)

    @property
    def progress(self) -> dict[str, int]:
        """Steps that were done, by phase."""
        before = {"autoencoder": self.config.autoencoder.steps} if self.phase != self._first_phase else {}
        return {**before, self.phase: self.step}

    @property
    def _first_phase(self) -> str:
        return "autoencoder" if isinstance(self.network.autoencoder, VariationalLatent) else "denoiser"

    def _anywhere(self, over: bool) -> bool:
        """Whether the time is up for any of the processes, so that they end together."""
        if self.place.world == 1:
            return over
        flag = torch.tensor(float(over), device=self.place.device)
        distributed.all_reduce(flag, distributed.ReduceOp.MAX)
        return bool(flag > 0)

    def _load_state(self) -> None:
        path = self.folder / STATE
        try:
            state = torch.load(path, map_location=self.place.device, weights_only=True)
            essence = state["essence"]
        except Exception as error:  # zipfile and pickle let many kinds through
            raise FileFormatError(str(path), "", type(error).__name__, STATE_EXPECTED) from error
        if essence != self._essence:
            expected = "expected the state of a run with this configuration and these data; take another folder"
            raise FileFormatError(str(path), "essence", essence[:12], expected)
        try:
            self.network.load_state_dict(state["network"])
            if state["phase"] != self.phase:
                self.network.autoencoder.requires_grad_(False)
                self.phase = state["phase"]
                self._begin_phase()
            self.step, self.seconds = state["step"], state["seconds"]
            averaged = {name: state["averaged"][name].to(self.place.device) for name in self.averaged}
            self._optimizer.load_state_dict(state["optimizer"])
            number, left = state["number"], state["left"]
        except (AttributeError, KeyError, RuntimeError, TypeError, ValueError) as error:
            raise FileFormatError(str(path), "", type(error).__name__, STATE_EXPECTED) from error
        self.averaged = averaged
        self.supply.go_to(number, left)
