"""Checkpoints in the package: their files, and that they were trained; and the data set that they learned from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support import DATA, ROOT, needs

from apex_ompl import load_model, load_problem
from apex_ompl.apex.models import make_query
from apex_ompl.kernel import Kernel
from apex_ompl.model.checkpoint import SHIPPED, shipped
from apex_ompl.model.guidance import EQUATION_7
from apex_ompl.model.proposals import Sampling
from apex_ompl.ompl.setup import assemble
from apex_ompl.ompl.validity import full_check
from apex_ompl.paths.candidates import first_valid
from apex_ompl.paths.optimizer import Optimizer
from apex_ompl.paths.path import FINE_RESOLUTION
from apex_ompl.problems.suite_robot import robot
from apex_ompl.training.kernel_problems import load_kernel_problems
from apex_ompl.training.store import load
from apex_ompl.training.validation import query_from_problem

FULL = ROOT / "data" / "dual_panda_softhand"


def test_what_ships_is_small_and_named() -> None:
    assert "apex" in shipped()
    assert sum(file.stat().st_size for file in SHIPPED.glob("*/*")) <= 24 * 2**20
    for name in shipped():
        assert {file.name for file in (SHIPPED / name).iterdir()} == {"README.md", "config.json", "model.safetensors"}
        model = load_model(name, robot=robot().name)
        assert model.config.joints == robot().joint_names
        assert model.about["phase"] == "denoiser" and model.about["step"] == model.about["config"]["steps"]


@pytest.mark.parametrize("name", shipped())
def test_a_sample_of_the_model_is_shorter_to_repair_than_the_line(name: str) -> None:
    """One proposal for each of some hard problems that no training saw, and the straight line, both repaired alike."""
    model, solved = load_model(name), {"model": 0, "line": 0}
    quick = Sampling("ddim", 8) if model.sampling.steps > 8 else None
    for case in load_kernel_problems(DATA / "validation"):
        kernel = Kernel(case.robot, case.scene)
        generator = np.random.default_rng(1)
        with model.one_thread():
            proposed = model.propose(query_from_problem(case), kernel, 1, sampling=quick, generator=generator)
        starts = {
            "model": proposed.control,
            "line": model.spline.line(case.start, case.goal)[None],
        }
        for kind, control in starts.items():

            def is_valid(path: np.ndarray, kernel: Kernel = kernel) -> bool:
                return kernel.proves(path, FINE_RESOLUTION)

            solved[kind] += first_valid(Optimizer(model.spline), kernel, control, is_valid) is not None
    assert solved["model"] > solved["line"], solved


def test_guidance_by_equation_7_makes_proposals_of_apex_paper_valid() -> None:
    """Among large cubes, from the same noise: by its scale of guidance most are, without it hardly any."""
    ready, model = assemble(load_problem("vertical/large/800002"), robot()), load_model("apex-paper")
    query, valid = make_query(ready.checker, ready.start, ready.goals[0]), {}
    for gamma in (0.0, EQUATION_7.gamma):
        sampling = replace(model.sampling, guidance=replace(EQUATION_7, gamma=gamma))
        with model.one_thread():
            generator = np.random.default_rng(2)
            made = model.propose(query, ready.checker.kernel, 3, sampling=sampling, generator=generator)
        paths = [model.spline.path(control) for control in made.control]
        valid[gamma > 0.0] = sum(bool(full_check(ready.checker, path, ready.start, ready.goals)) for path in paths)
    assert valid[False] <= 1 and valid[True] >= 2, valid


@needs("data")
def test_the_data_of_the_tests_are_drawn_from_the_set_in_the_repository() -> None:
    full, few = load(FULL / "paths.zip"), load(DATA / "paths.zip")
    every = {full.problem_name(k) for k in range(full.problems)}
    assert 0 < few.problems < full.problems and all(few.problem_name(k) in every for k in range(few.problems))
    assert len(load_kernel_problems(FULL / "validation")) > len(load_kernel_problems(DATA / "validation"))
    assert (FULL / "robot.npz").read_bytes() == (DATA / "robot.npz").read_bytes()
