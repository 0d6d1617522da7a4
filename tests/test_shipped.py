"""The checkpoints in the package: what they are, and that they were trained."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from support import ROOT

from apex_ompl import load_model
from apex_ompl.datasets.kernel_problems import load_kernel_problems
from apex_ompl.diffusion.checkpoint import SHIPPED, shipped
from apex_ompl.diffusion.proposals import Sampling
from apex_ompl.diffusion.validation import query_from_problem
from apex_ompl.kernel import Kernel
from apex_ompl.problems.reach import robot
from apex_ompl.trajopt.candidates import first_valid
from apex_ompl.trajopt.optimizer import Optimizer
from apex_ompl.util.resolution import FULL_RESOLUTION
from apex_ompl.util.threads import one_torch_thread

CASES = load_kernel_problems(ROOT / "data" / "dual_panda_softhand" / "validation")


def test_what_ships_is_small_and_named() -> None:
    assert "apex" in shipped()
    assert sum(file.stat().st_size for file in SHIPPED.glob("*/*")) <= 24 * 2**20
    for name in shipped():
        assert {file.name for file in (SHIPPED / name).iterdir()} == {"README.md", "config.json", "model.safetensors"}
        model = load_model(name, robot=robot().name)
        assert model.network.config.joints == robot().joint_names
        assert model.about["phase"] == "denoiser" and model.about["step"] == model.about["config"]["steps"]


@pytest.mark.parametrize("name", shipped())
def test_a_sample_of_the_model_is_shorter_to_repair_than_the_line(name: str) -> None:
    """One proposal for each of some problems that no training saw, against the straight line, both repaired alike."""
    model, solved = load_model(name), {"model": 0, "line": 0}
    quick = Sampling("ddim", 8) if model.sampling.steps > 8 else None
    hard = [case for case in CASES if case.level == "hard" and case.suite != "bins"][::4]
    for case in hard:
        kernel = Kernel(case.robot, case.scene)
        generator = torch.Generator().manual_seed(1)
        with one_torch_thread():
            proposed = model.propose(query_from_problem(case), kernel, 1, sampling=quick, generator=generator)
        starts = {
            "model": proposed.control,
            "line": model.spline.line(case.start, case.goal)[None],
        }
        for kind, control in starts.items():

            def is_valid(path: np.ndarray, kernel: Kernel = kernel) -> bool:
                return kernel.proves(path, FULL_RESOLUTION)

            solved[kind] += first_valid(Optimizer(model.spline), kernel, control, is_valid) is not None
    assert solved["model"] > solved["line"], solved
