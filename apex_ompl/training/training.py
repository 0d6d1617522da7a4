"""Training of the model (``train`` of the paper's Algorithm 1), which resumes after an interruption."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, distributed, nn

from apex_ompl.errors import ParameterError
from apex_ompl.kernel import RobotTables
from apex_ompl.model.config import ModelConfig, SplineConfig, key_shapes
from apex_ompl.model.proposals import Sampling
from apex_ompl.model.query import encoded_range
from apex_ompl.training.autoencoder import LinearLatent, VariationalLatent
from apex_ompl.training.conditions import Conditions
from apex_ompl.training.config import TrainingConfig
from apex_ompl.training.data import TrainingData
from apex_ompl.training.kernel_problems import KernelProblem
from apex_ompl.training.latent_diffusion import CollisionCost, Draws, FeaturesAlong, LatentDiffusion
from apex_ompl.training.run import RunLog, TrainingRun
from apex_ompl.training.torch_model import TorchModel, load_torch_model, save_model
from apex_ompl.training.validation import success_rates

NETWORKS = ("latent", "condition", "denoiser", "noise")  # parts of a model that a configuration sets
VALIDATION_PATHS = 2048  # most held-out paths on which the validation loss is taken
PHASES = ("autoencoder", "denoiser")


@dataclass(frozen=True)
class DistributedProcess:
    """One of the processes that train a model together (``torch.distributed``).

    Attributes:
        rank: Its rank, 0 to ``world_size - 1``.
        world_size: Number of processes.
        device: Device that it computes on.
    """

    rank: int
    world_size: int
    device: torch.device

    @classmethod
    def current(cls) -> DistributedProcess:
        """Return this process; where ``torchrun`` started it, join the process group."""
        rank, world_size, local = (
            int(os.environ.get(k, d)) for k, d in (("RANK", 0), ("WORLD_SIZE", 1), ("LOCAL_RANK", 0))
        )
        cuda = torch.cuda.is_available()
        device = torch.device("cuda", local) if cuda else torch.device("cpu")
        if cuda:
            torch.cuda.set_device(device)
        if world_size > 1 and not distributed.is_initialized():
            distributed.init_process_group("nccl" if cuda else "gloo")
        return cls(rank, world_size, device)

    def any(self, flag: bool) -> bool:
        """Return whether a flag is set in any of the processes; the same answer in all of them."""
        if self.world_size == 1:
            return flag
        value = torch.tensor(float(flag), device=self.device)
        distributed.all_reduce(value, distributed.ReduceOp.MAX)
        return bool(value > 0)

    def close(self) -> None:
        """Leave the process group."""
        if self.world_size > 1 and distributed.is_initialized():
            distributed.destroy_process_group()


class Objective(nn.Module):
    """Loss of a phase: the negative ELBO of the autoencoder, or the mean square error of the denoiser."""

    def __init__(
        self,
        network: LatentDiffusion,
        divergence: float,
        features_along: FeaturesAlong | None = None,
        collision_cost: CollisionCost | None = None,
    ) -> None:
        """Train a model.

        Args:
            network: The model.
            divergence: Weight of the autoencoder's Kullback-Leibler divergence.
            features_along: Returns features along paths, for a model that sees its own estimate.
            collision_cost: Returns the collision cost of paths; None to leave it out.
        """
        super().__init__()
        self.network, self.divergence = network, divergence
        self._features_along, self._collision_cost = features_along, collision_cost

    def forward(self, phase: str, control: Tensor, conditions: Conditions, draws: Draws) -> Tensor:
        """Return the loss of a batch of paths.

        Args:
            phase: ``autoencoder`` or ``denoiser``.
            control: Control points, shape (B, points, dof) [rad].
            conditions: Conditions of the paths.
            draws: Random numbers.
        """
        autoencoder = self.network.autoencoder
        if phase == "autoencoder":
            assert isinstance(autoencoder, VariationalLatent)
            return autoencoder.loss(control, draws.noise, self.divergence)[0]
        with torch.no_grad(), torch.autocast(control.device.type, enabled=False):
            clean = autoencoder.encode(control)
        return self.network.loss(clean, draws, conditions, self._features_along, self._collision_cost)


def initial_network(config: TrainingConfig, data: TrainingData, robot: RobotTables) -> LatentDiffusion:
    """Return a model with random weights, with the robot's limits and probe points, and a fitted linear latent space.

    Where the configuration names a checkpoint, all of these are the checkpoint's.

    Args:
        config: Configuration of the run; the same seed gives the same weights.
        data: Training data.
        robot: Kernel tables of the robot.

    Raises:
        ApexError: The checkpoint that the run starts with cannot be read, or is of another architecture.
    """
    probes, encoding = data.probes, data.scene_encoding
    arms = (0, 0) if encoding is None else encoding.keys.joint.shape
    model = ModelConfig(
        robot=robot.name, joints=robot.joint_names, probes=len(probes.joint), arms=arms,
        spline=SplineConfig(**data.spline), latent=config.latent, condition=config.condition, denoiser=config.denoiser,
        noise=config.noise, sampling=config.sampling,
    )  # fmt: skip
    if config.initial is not None:
        return _of_checkpoint(config.initial, model)
    with torch.random.fork_rng(devices=[]):  # torch's layers initialize their weights from the global generator
        torch.manual_seed(config.seed)
        network = LatentDiffusion(model)
    network.probe_joint.copy_(torch.from_numpy(probes.joint))
    network.probe_offset.copy_(torch.from_numpy(probes.offset))
    if encoding is not None:
        for name, values in zip(
            key_shapes(model), (encoding.keys.state, encoding.keys.joint, encoding.keys.ball), strict=True
        ):
            getattr(network, name).copy_(torch.from_numpy(values))
    network.encoder.set_limits(*(torch.tensor(v, dtype=torch.float32) for v in encoded_range(robot)))
    if isinstance(network.autoencoder, LinearLatent):
        network.autoencoder.fit(data.statistics_sample())
    return network


def _of_checkpoint(name: str, wanted: ModelConfig) -> LatentDiffusion:
    """Return the model of a checkpoint, ready to be trained on.

    Raises:
        ApexError: It cannot be read.
        ParameterError: It is of another architecture, the first difference of which is named.
    """
    network = load_torch_model(name, robot=wanted.robot).network
    found = network.config
    for field in (*NETWORKS, *(name for name in ModelConfig.model_fields if name not in (*NETWORKS, "sampling"))):
        theirs, ours = getattr(found, field), getattr(wanted, field)
        if theirs != ours:
            expected = f"a checkpoint with the {field} of this run, {ours!r}, not {theirs!r}"
            raise ParameterError("initial", name, expected)
    network.config = wanted
    return network.train().requires_grad_(True)


class Trainer(TrainingRun[LatentDiffusion]):
    """Training run of a model, resumed from the state in its folder where there is one.

    Each step samples its paths, noise and diffusion steps with a seed of its own. A resumed run therefore ends with the
    same weights as an uninterrupted one on the same machine.

    Attributes:
        config: Configuration of the run.
        folder: Folder of the run.
        process: This process among those that train together.
        problems: Validation problems.
        data: Training data.
        network: Model in training.
        phase: ``autoencoder`` or ``denoiser``.
    """

    def __init__(
        self, config: TrainingConfig, folder: Path, process: DistributedProcess,
        problems: Sequence[KernelProblem] = (), report: Callable[[str], None] = print,
    ) -> None:  # fmt: skip
        """Make a model, or load the state of the run in ``folder``.

        Args:
            config: Configuration of the run.
            folder: Folder of the run, which must exist.
            process: This process among those that train together.
            problems: Validation problems; none for no validation by proposals.
            report: Prints a line for each validation.

        Raises:
            ApexError: Data, tables or state cannot be read or do not fit.
        """
        super().__init__(config, folder, process.device)
        self.config, self.process, self.problems, self._report = config, process, problems, report
        robot = RobotTables.load(config.robot)
        self.data = TrainingData(config, robot, process.device)
        self.network = initial_network(config, self.data, robot).to(process.device)
        self.phase = self._first_phase
        self._digest = hashlib.sha256(f"{config.determining}{robot.name}{self.data.digest()}".encode()).hexdigest()
        self._start_phase()
        state = self._load_state()
        if state is not None:
            self.data.go_to(state["number"], state["left"])
        self._runlog = RunLog(folder, self.progress) if process.rank == 0 else None
        collision_cost = self._collision_cost if config.collision else None
        objective = Objective(self.network, config.autoencoder.divergence, self.data.features_along, collision_cost)
        self._objective: nn.Module = objective
        if process.world_size > 1:
            self._objective = nn.parallel.DistributedDataParallel(objective, find_unused_parameters=True)

    @property
    def steps(self) -> int:
        """Number of steps of the phase."""
        return self.config.autoencoder.steps if self.phase == "autoencoder" else self.config.steps

    @property
    def done(self) -> bool:
        """Whether the training is complete."""
        return self.phase == "denoiser" and super().done

    def advance(self) -> float:
        """Do one step as :meth:`TrainingRun.advance`; the first of the denoiser follows the last of the autoencoder."""
        if self.step >= self.steps:
            self._end_autoencoder()
        self.data.count_step()
        return super().advance()

    def _any(self, flag: bool) -> bool:
        return self.process.any(flag)

    def save(self) -> None:
        """Write the state of the run, and the averaged model as a checkpoint."""
        if self.process.rank != 0:
            return
        self._write_state(self.data.number, self.data.left)
        save_model(self.folder / "checkpoint", self.averaged_network(), self.about())

    def averaged_network(self) -> LatentDiffusion:
        """Return a model with the averaged weights."""
        with torch.random.fork_rng(devices=[]):
            network = LatentDiffusion(self.network.config)
        network.load_state_dict({**self.network.state_dict(), **self.averaged})
        return network.eval()

    def about(self) -> dict[str, Any]:
        """Return the record of the training for a checkpoint, ready for JSON."""
        config = self.config.model_dump(mode="json", by_alias=True)
        config["data"] = [Path(source).name for source in self.config.sources]  # names only: folders are private
        config["robot"] = Path(self.config.robot).name
        for name in ("cases", "initial"):
            config[name] = None if config[name] is None else Path(config[name]).name
        return {
            "phase": self.phase, "step": self.step, "seconds": round(self.seconds), "torch": torch.__version__,
            "paths": len(self.data.shard), "config": config,
        }  # fmt: skip

    def _start_phase(self) -> None:
        """Make the optimizer and the averaged weights of the phase."""
        network = self.network
        modules = [network.autoencoder] if self.phase == "autoencoder" else [network.encoder, network.denoiser]
        chosen = {id(p) for module in modules for p in module.parameters()}
        named = [(name, p) for name, p in self.network.named_parameters() if id(p) in chosen]
        self._optimize(named)

    def _end_autoencoder(self) -> None:
        """Take over the averaged autoencoder, fit the scale of its latent space, and start with the denoiser."""
        autoencoder = self.network.autoencoder
        assert isinstance(autoencoder, VariationalLatent)
        self.network.load_state_dict({**self.network.state_dict(), **self.averaged})
        autoencoder.fit_scale(self.data.statistics_sample().to(self.process.device))
        autoencoder.requires_grad_(False)
        self.phase, self.step = "denoiser", 0
        self._start_phase()

    def _rate(self) -> float:
        """Return the learning rate: rate min(1, (step + 1) / warmup) (1 + cos(pi step / steps)) / 2."""
        largest = self.config.autoencoder.rate if self.phase == "autoencoder" else self.config.rate
        rise = min(1.0, (self.step + 1) / self.config.warmup)
        return float(largest * rise * 0.5 * (1.0 + math.cos(math.pi * min(1.0, self.step / self.steps))))

    def _loss(self) -> Tensor:
        """Return the loss of this step's batch."""
        config, process = self.config, self.process
        numbers = [config.seed, PHASES.index(self.phase), self.step, process.rank]
        generator = torch.Generator().manual_seed(int(np.random.SeedSequence(numbers).generate_state(1)[0]))
        shard = self.data.shard
        which = shard.sample(max(1, config.batch // process.world_size), generator)
        control, conditions = shard.batch(which, generator)
        return self._evaluate(self._objective, control, conditions, generator)

    def _collision_cost(self, control: Tensor, conditions: Conditions, places: Tensor) -> Tensor:
        """Return the term of the loss that is due to collisions."""
        return self.config.collision * self.data.collision_cost(control, conditions, places)

    def _evaluate(
        self, objective: nn.Module, control: Tensor, conditions: Conditions, generator: torch.Generator
    ) -> Tensor:
        """Return an objective, evaluated on the device in the configured precision."""
        device = self.process.device
        draws = Draws(*(tensor.to(device) for tensor in self.network.draws(len(control), generator)))
        mixed = torch.autocast(device.type, torch.bfloat16) if self.config.precision == "bfloat16" else nullcontext()
        with mixed:
            loss: Tensor = objective(self.phase, control.to(device), conditions.to(device), draws)
        return loss

    def _log(self, loss: float, last: bool) -> None:
        """Append a row to the log, with the validation loss, and where it is time the success rates."""
        if self._runlog is None:
            return
        row = self._row(loss)
        network = self.averaged_network().to(self.process.device)
        validation = self.data.validation
        if validation is not None:
            generator = torch.Generator().manual_seed(self.config.seed)
            which = torch.randperm(len(validation), generator=generator)[:VALIDATION_PATHS].sort().values
            control, conditions = validation.batch(which.numpy(), generator)
            objective = Objective(network, self.config.autoencoder.divergence, self.data.features_along)
            with torch.no_grad():
                held_out = self._evaluate(objective, control, conditions, generator)
            row["held_out"] = f"{float(held_out):.6f}"
        if self.phase == "denoiser" and self.problems and (self.step % self.config.validate_every == 0 or last):
            sampling = Sampling(**self.config.validation_sampling.model_dump())
            model, count = TorchModel(network, {}), self.config.proposals
            rates = success_rates(model, self.problems, count, sampling=sampling)
            row |= {name: f"{rates.pop(name):.4f}" for name in ("sampled", "repaired")}
            row["levels"] = json.dumps({k: round(v, 3) for k, v in rates.items()})
            self._report(f"step {self.step}: {row['sampled']} sampled, {row['repaired']} repaired")
        self._runlog.add(row)

    @property
    def progress(self) -> dict[str, int]:
        """Number of steps done, by phase."""
        before = {"autoencoder": self.config.autoencoder.steps} if self.phase != self._first_phase else {}
        return {**before, self.phase: self.step}

    @property
    def _first_phase(self) -> str:
        return "autoencoder" if isinstance(self.network.autoencoder, VariationalLatent) else "denoiser"

    def _go_to(self, phase: str) -> None:
        if phase != self.phase:
            self.network.autoencoder.requires_grad_(False)
            self.phase = phase
            self._start_phase()
