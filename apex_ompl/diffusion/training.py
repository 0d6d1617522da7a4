"""Training of the model: what the paper's Algorithm 1 calls train, made to go on after any interruption."""

from __future__ import annotations

import hashlib
import json
import math
import os
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, distributed, nn

from apex_ompl.cases import WrittenCase
from apex_ompl.diffusion.autoencoder import LinearLatent, VariationalLatent
from apex_ompl.diffusion.checkpoint import save_model
from apex_ompl.diffusion.conditions import Conditions, Probes
from apex_ompl.diffusion.config import TrainingConfig
from apex_ompl.diffusion.data import Mirror, Window, split, window_paths
from apex_ompl.diffusion.model import LatentDiffusion, ModelConfig, SplineConfig
from apex_ompl.diffusion.proposals import TrajectoryModel
from apex_ompl.diffusion.runlog import RunLog
from apex_ompl.diffusion.validation import judged
from apex_ompl.errors import FileFormatError, ParameterError
from apex_ompl.files import is_file
from apex_ompl.kernel import Kernel, RobotTables
from apex_ompl.kernel.scene import scene_tables

MEASURED = 100_000  # paths that the latent space is measured on, at most
WATCHED = 2048  # held-out paths that the validation loss is taken on, at most
PASSES = 4  # over a window before the next, when there are several
PHASES = ("autoencoder", "denoiser")


@dataclass(frozen=True)
class Place:
    """One of the processes that train together.

    Attributes:
        rank: Its number.
        world: How many there are.
        device: Where it computes.
    """

    rank: int
    world: int
    device: torch.device

    @classmethod
    def here(cls) -> Place:
        """Return this process, joined to the others that ``torchrun`` started if it did."""
        rank, world, local = (int(os.environ.get(k, d)) for k, d in (("RANK", 0), ("WORLD_SIZE", 1), ("LOCAL_RANK", 0)))
        cuda = torch.cuda.is_available()
        device = torch.device("cuda", local) if cuda else torch.device("cpu")
        if cuda:
            torch.cuda.set_device(device)
        if world > 1 and not distributed.is_initialized():
            distributed.init_process_group("nccl" if cuda else "gloo")
        return cls(rank, world, device)


class Objective(nn.Module):
    """The loss of a phase as a module, which is what several processes share gradients of."""

    def __init__(self, network: LatentDiffusion, divergence: float) -> None:
        """Train ``network``."""
        super().__init__()
        self.network, self.divergence = network, divergence

    def forward(self, phase: str, control: Tensor, given: Conditions, noise: Tensor, t: Tensor) -> Tensor:
        """Return the loss of paths, control points (B, points, dof)."""
        autoencoder = self.network.autoencoder
        if phase == "autoencoder":
            assert isinstance(autoencoder, VariationalLatent)
            return autoencoder.loss(control, noise, self.divergence)[0]
        with torch.no_grad():
            clean = autoencoder.encode(control)
        return self.network.loss(clean, noise, t, given)


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
        robot = RobotTables.load(config.robot)
        self._kernel = Kernel(robot, scene_tables([]))
        self._probes = Probes.of(robot, config.condition.along)
        self._number, self._left = 0, 0
        self._runlog = RunLog(folder)
        self._window, self._watched, spline = self._load_window(0)
        count = len(self._probes.joint)
        model = ModelConfig(
            robot=robot.name, joints=robot.joint_names, probes=count, spline=spline, latent=config.latent,
            condition=config.condition, denoiser=config.denoiser, noise=config.noise,
        )  # fmt: skip
        torch.manual_seed(config.seed)  # of the weights, which torch's layers draw from the global generator
        self.network = LatentDiffusion(model)
        self.network.probe_joint.copy_(torch.from_numpy(self._probes.joint))
        self.network.probe_offset.copy_(torch.from_numpy(self._probes.offset))
        limits = (torch.tensor(v, dtype=torch.float32) for v in (robot.arrays.lower, robot.arrays.upper))
        self.network.encoder.set_limits(*limits)
        autoencoder = self.network.autoencoder
        if isinstance(autoencoder, LinearLatent):
            autoencoder.fit(self._window.control[:MEASURED])
        self.network.to(place.device)
        self.phase = "autoencoder" if isinstance(autoencoder, VariationalLatent) else "denoiser"
        self.step, self.seconds = 0, 0.0
        self._begin_phase()
        self._load_state()
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
        """Do one step, and return its loss."""
        begin = time.perf_counter()
        if self.step >= self.steps:
            self._end_autoencoder()
        self._next_window()
        for group in self._optimizer.param_groups:
            group["lr"] = self._rate()
        loss = self._loss()
        self._optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self._parameters, self.config.clip)
        self._optimizer.step()
        self.step += 1
        self._left -= 1
        with torch.no_grad():
            share = 1.0 - min(self.config.ema, (1.0 + self.step) / (10.0 + self.step))
            torch._foreach_lerp_([self.averaged[name] for name in self._names], list(self._parameters), share)
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
        while not self.done and time.perf_counter() - begin < seconds:
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
            "config": _digest(self.config), "phase": self.phase, "step": self.step, "number": self._number,
            "left": self._left, "seconds": self.seconds, "network": self.network.state_dict(),
            "averaged": self.averaged, "optimizer": self._optimizer.state_dict(),
        }  # fmt: skip
        temporary = self.folder / ".state.pt.part"
        torch.save(state, temporary)
        os.replace(temporary, self.folder / "state.pt")
        save_model(self.folder / "checkpoint", self.averaged_network(), self.about(), self.card())

    def averaged_network(self) -> LatentDiffusion:
        """Return a model with the averaged weights."""
        network = LatentDiffusion(self.network.config)
        network.load_state_dict({**self.network.state_dict(), **self.averaged})
        return network.eval()

    def about(self) -> dict[str, Any]:
        """Return what a checkpoint says of its training."""
        config = self.config.model_dump(mode="json", by_alias=True)
        return {
            "phase": self.phase, "step": self.step, "seconds": round(self.seconds), "torch": torch.__version__,
            "paths": len(self._window), "config": config,
        }  # fmt: skip

    def card(self) -> str:
        """Return a model card."""
        model, count = self.network.config, sum(p.numel() for p in self.network.parameters())
        return "\n".join(
            [
                f"# A latent diffusion model of paths for {model.robot}",
                "",
                f"{count / 1e6:.2f} million weights; latent space {model.latent.kind} {self.network.latent}, denoiser "
                f"{model.denoiser.kind}, conditions {model.condition.scene}, {model.noise.prediction} prediction over "
                f"{model.noise.steps} steps.",
                "",
                f"Trained for {self.step} steps of {self.config.batch} paths in {self.seconds / 60:.0f} min, on "
                f"{len(self._window)} paths (with mirror images) of `{self.config.data}`, by `scripts/train.py`. The "
                "whole configuration is in `config.json`.",
                "",
                "It proposes paths; they are not valid until they are checked. Read it by `apex_ompl.load_model`.",
                "",
            ]
        )

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
        autoencoder.measure(self._window.control[:MEASURED].to(self.place.device))
        autoencoder.requires_grad_(False)
        self.phase, self.step = "denoiser", 0
        self._begin_phase()

    def _rate(self) -> float:
        top = self.config.autoencoder.rate if self.phase == "autoencoder" else self.config.rate
        rise = min(1.0, (self.step + 1) / self.config.warmup)
        return float(top * rise * 0.5 * (1.0 + math.cos(math.pi * min(1.0, self.step / self.steps))))

    def _loss(self) -> Tensor:
        config, place = self.config, self.place
        generator = torch.Generator().manual_seed(
            int(
                np.random.SeedSequence([config.seed, PHASES.index(self.phase), self.step, place.rank]).generate_state(
                    1
                )[0]
            )
        )
        control, given = self._window.batch(self._window.drawn(max(1, config.batch // place.world), generator))
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
        if self.place.rank != 0:
            return
        row: dict[str, Any] = {"phase": self.phase, "step": self.step, "loss": f"{loss:.6f}"}
        row |= {"rate": f"{self._rate():.3g}", "seconds": f"{self.seconds:.1f}"}
        network = self.averaged_network().to(self.place.device)
        if self._watched is not None:
            generator = torch.Generator().manual_seed(self.config.seed)
            control, given = self._watched.batch(np.arange(min(WATCHED, len(self._watched))))
            objective = Objective(network, self.config.autoencoder.divergence)
            with torch.no_grad():
                held = self._computed(objective, control, given, self._noise(len(control), generator))
            row["held_out"] = f"{float(held):.6f}"
        if self.phase == "denoiser" and self.cases and (self.step % self.config.validate_every == 0 or last):
            said = judged(TrajectoryModel(network, {}), self.cases, self.config.proposals)
            row |= {name: f"{said.pop(name):.4f}" for name in ("sampled", "repaired")}
            row["levels"] = json.dumps({k: round(v, 3) for k, v in said.items()})
            self.say(f"step {self.step}: {row['sampled']} sampled, {row['repaired']} repaired")
        self._runlog.add(row)

    def _next_window(self) -> None:
        if self._left > 0:
            return
        if self._windows > 1 and self.step + self._number > 0:
            self._number += 1
            self._window, self._watched, _ = self._load_window(self._number)
        self._left = PASSES * max(1, len(self._window) // self.config.batch) if self._windows > 1 else 2**31

    def _load_window(self, number: int) -> tuple[Window, Window | None, SplineConfig]:
        config = self.config
        paths, self._windows = window_paths(Path(config.data), config.seed, config.units, number)
        robot = self._kernel.robot
        if (paths.about["robot"], tuple(paths.about["joints"])) != (robot.name, robot.joint_names):
            raise ParameterError("data", paths.about["robot"], f"paths of {robot.name}, whose tables are given")
        train, out = split(paths, config.held_out)
        parts = [train]
        if config.mirror is not None:
            if len(config.mirror.order) != robot.dof:
                raise ParameterError("mirror", len(config.mirror.order), f"{robot.dof} joints")
            mirror = Mirror(**config.mirror.model_dump())
            parts.append(mirror.paths(train, self._kernel))
        window = Window(parts, self._probes, self._kernel, config.weights)
        watched = Window([out], self._probes, self._kernel, {}) if len(out) else None
        return window, watched, SplineConfig(**{k: paths.about[k] for k in SplineConfig.model_fields})

    def _load_state(self) -> None:
        path = self.folder / "state.pt"
        if not is_file(path):
            return
        try:
            state = torch.load(path, map_location=self.place.device, weights_only=True)
            config = state["config"]
        except Exception as error:  # zipfile and pickle let many kinds through
            raise FileFormatError(
                str(path), "", type(error).__name__, "expected the state of a training run"
            ) from error
        if config != _digest(self.config):
            expected = "expected the state of a run with this configuration; take another folder"
            raise FileFormatError(str(path), "config", config[:12], expected)
        self.network.load_state_dict(state["network"])
        if state["phase"] != self.phase:
            self.network.autoencoder.requires_grad_(False)
            self.phase = state["phase"]
            self._begin_phase()
        self.step, self.seconds = state["step"], state["seconds"]
        self.averaged = {name: tensor.to(self.place.device) for name, tensor in state["averaged"].items()}
        self._optimizer.load_state_dict(state["optimizer"])
        if state["number"] != self._number:
            self._window, self._watched, _ = self._load_window(state["number"])
        self._number, self._left = state["number"], state["left"]
        before = {"autoencoder": self.config.autoencoder.steps} if self.phase == "denoiser" else {}
        self._runlog.cut({**before, self.phase: self.step})


def _digest(config: TrainingConfig) -> str:
    return hashlib.sha256(config.model_dump_json().encode()).hexdigest()
