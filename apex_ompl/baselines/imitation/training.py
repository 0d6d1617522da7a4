"""Training of an imitation policy by teacher forcing, which resumes after an interruption."""

from __future__ import annotations

import hashlib
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from apex_ompl.baselines.imitation.checkpoint import load_policy_network, save_policy
from apex_ompl.baselines.imitation.config import ImitationConfig
from apex_ompl.baselines.imitation.data import WindowData, Windows
from apex_ompl.baselines.imitation.network import PolicyNetwork
from apex_ompl.kernel import RobotTables
from apex_ompl.training.run import RunLog, TrainingRun
from apex_ompl.util.provenance import commit, hardware

PHASE = "policy"
HELD_OUT_PATHS = 256  # most held-out paths on which the loss is taken
CPU = torch.device("cpu")
ROOT = Path(__file__).resolve().parents[3]


class ImitationTrainer(TrainingRun[PolicyNetwork]):
    """Training run of a policy, resumed from the state in its folder where there is one.

    The policy is trained by teacher forcing: it is shown states of stored paths, with noise, and not where it would
    have gone itself. The loss is the mean square error of the next states in standard deviations of the data. Each
    step draws its windows with a seed of its own, so that a resumed run ends with the same weights.

    Attributes:
        config: Configuration of the run.
        robot: Name of the robot.
        data: Training data.
    """

    phase = PHASE

    def __init__(self, config: ImitationConfig, folder: Path, device: torch.device = CPU) -> None:
        """Make a network on a device, or load the state of the run in ``folder``, which must exist.

        Raises:
            ApexError: Data, tables or state cannot be read or do not fit.
        """
        super().__init__(config, folder, device)
        self.config = config
        robot = RobotTables.load(config.robot)
        self.robot, self._commit = robot.name, commit(ROOT, ("apex_ompl", "scripts"))
        self.data = WindowData(config, robot)
        with torch.random.fork_rng(devices=[]):  # layers initialize their weights from the global generator
            torch.manual_seed(config.seed)
            self.network = PolicyNetwork(config.network)
        self.data.fit(self.network)
        first = "" if config.init is None else self._initialize(config.init)
        self.network.to(device)
        determining = f"{config.determining}{robot.name}{self.data.digest()}{first}"
        self._digest = hashlib.sha256(determining.encode()).hexdigest()
        self._optimize(self.network.named_parameters())
        self._load_state()
        self._runlog = RunLog(folder, {PHASE: self.step})
        held_out = self.data.held_out(HELD_OUT_PATHS)
        self._held_out = None if held_out is None else held_out.to(device)

    @property
    def steps(self) -> int:
        """Number of steps of the training."""
        return self.config.steps

    def _loss(self) -> Tensor:
        return self.loss(self.network, self.data.batch(self.step).to(self.device))

    def loss(self, network: PolicyNetwork, windows: Windows) -> Tensor:
        """Return the mean square error of the predicted next states, in standard deviations of the data."""
        bfloat16 = self.config.precision == "bfloat16"
        with torch.autocast(self.device.type, torch.bfloat16) if bfloat16 else nullcontext():
            found = network(windows.conditions, windows.state, windows.time)
        loss: Tensor = (((found - windows.following) / network.scale) ** 2).mean()
        return loss

    def _log(self, loss: float, last: bool) -> None:
        row = self._row(loss)
        if self._held_out is not None:
            row["held_out"] = f"{self._loss_held_out(self.averaged_network()):.6f}"
        self._runlog.add(row)

    def save(self) -> None:
        """Write the state of the run, and the averaged network as a checkpoint."""
        self._write_state()
        network = self.averaged_network()
        save_policy(self.folder / "checkpoint", network, self.robot, self.data.joints, self.about(network))

    def averaged_network(self) -> PolicyNetwork:
        """Return a network with the averaged weights."""
        with torch.random.fork_rng(devices=[]):
            network = PolicyNetwork(self.config.network)
        network.load_state_dict({**self.network.state_dict(), **self.averaged})
        return network.to(self.device).eval()

    def about(self, network: PolicyNetwork) -> dict[str, Any]:
        """Return the record of the training for a checkpoint of ``network``, ready for JSON."""
        config = self.config.model_dump(mode="json", by_alias=True)
        names = [Path(source).name for source in self.config.sources]  # names only: folders are private
        init = None if self.config.init is None else Path(self.config.init).name
        config |= {"data": names, "robot": Path(self.config.robot).name, "init": init}
        found: dict[str, Any] = {
            "step": self.step, "steps": self.config.steps, "seconds": round(self.seconds), "data": names,
            "windows": self.step * self.config.batch * self.config.windows, "paths": len(self.data.train),
            "torch": torch.__version__, "commit": self._commit, "hardware": self._hardware,
            "held_out": None, "line": None,
        }  # fmt: skip
        if self._held_out is not None:
            held_out, line = self._held_out, network.line
            straight = line(held_out.conditions.goal, held_out.state, held_out.time)
            off = (((straight - held_out.following) / network.scale) ** 2).mean()
            found |= {"held_out": round(self._loss_held_out(network), 4), "line": round(float(off), 4)}
        return {**found, "config": config}

    @property
    def _hardware(self) -> str:
        """What the training runs on."""
        if self.device.type == "cuda":
            return torch.cuda.get_device_name(self.device)
        return f"one thread of {hardware()}"

    def _rate(self) -> float:
        """Return the learning rate: rate min(1, (step + 1) / warmup, (steps - step) / cooldown)."""
        config = self.config
        share = min((self.step + 1) / config.warmup, (config.steps - self.step) / config.cooldown)
        return config.rate * min(1.0, max(0.0, share))

    @torch.no_grad()
    def _loss_held_out(self, network: PolicyNetwork) -> float:
        assert self._held_out is not None
        return float(self.loss(network, self._held_out))

    def _initialize(self, folder: str) -> str:
        """Take the weights and statistics of a policy where shapes agree, and return the digest of its file."""
        other, about = load_policy_network(folder, robot=self.robot)
        mine = self.network.state_dict()
        theirs = other.state_dict()
        same = [name for name, tensor in mine.items() if name in theirs and theirs[name].shape == tensor.shape]
        self.network.load_state_dict({**mine, **{name: theirs[name] for name in same}})
        return about.digest
