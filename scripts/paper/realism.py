"""Paths of models and planners beside solutions of the same problems, for FID and KID."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import cache, partial
from itertools import islice, zip_longest
from pathlib import Path

import numpy as np
import torch
from paper import rows
from tqdm import tqdm

from apex_ompl import problems
from apex_ompl.apex.models import make_query
from apex_ompl.evaluation import Row
from apex_ompl.evaluation.rows import Job
from apex_ompl.evaluation.runs import Run
from apex_ompl.evaluation.runs import planned as planned_run
from apex_ompl.model.checkpoint import load_model
from apex_ompl.model.guidance import GUIDANCES, Guidance
from apex_ompl.model.proposals import TrajectoryModel
from apex_ompl.ompl.setup import PlanningSetup, assemble
from apex_ompl.paths.spline import Spline
from apex_ompl.problems.suite_robot import robot
from apex_ompl.training.autoencoder import Autoencoder
from apex_ompl.training.engine import EngineOptions
from apex_ompl.training.records import SOURCES, Paths
from apex_ompl.training.store import Store
from apex_ompl.training.torch_model import load_torch_model
from apex_ompl.training.units import plan_units, solve_unit
from apex_ompl.types import Array
from apex_ompl.util.cluster import spread

MODELS = ("apex", "apex-paper")
DIGITS = 6  # of the control points that are stored
PROPOSED, PLANNED = "paper.realism:proposed", "paper.realism:planned"


@cache
def load(model: str) -> TrajectoryModel:
    """Return a model that ships, or one that was trained for these figures; once in a process."""
    return load_model(rows.checkpoint(model) or model)


def proposing(model: str, *, guided: bool) -> Row:
    """Return the row of the paths that a model proposes, one a problem, valid or not."""
    label = model if guided else f"{model}, unguided"
    return Row(label, model, {"gamma": _chosen(model).gamma if guided else 0.0}, runner=PROPOSED)


def planning(row: Row) -> Row:
    """Return the row of the paths that a planner finds, as it is benchmarked elsewhere, valid ones only."""
    return replace(row, runner=PLANNED, runs=None)


def proposed(job: Job) -> Run:
    """Return one path of a model for a problem, as control points, and its CPU time [s]."""
    _, control, took = sample(job.planner, job.params["gamma"], job)
    return {"solved": True, "total": took, "control": np.round(control, DIGITS).tolist()}


def sample(model: str, gamma: float, job: Job) -> tuple[PlanningSetup, Array, float]:
    """Return a problem, one path that a model proposes for it, as control points, and the CPU time of that [s]."""
    torch.set_num_threads(1)
    loaded = load(model)
    sampling = replace(loaded.sampling, guidance=replace(_chosen(model), gamma=gamma))
    ready = assemble(problems.load(job.problem), robot())
    query = make_query(ready.checker, ready.start, ready.goals[0])
    begin = time.process_time()  # other work on the machine does not count
    with torch.no_grad():
        generator = np.random.default_rng(job.seed)
        made = loaded.propose(query, ready.checker.kernel, 1, sampling=sampling, generator=generator)
    return ready, made.control[0], time.process_time() - begin


def _chosen(model: str) -> Guidance:
    """Return the guidance of a model's paths."""
    return GUIDANCES["clean" if model == "apex" else "noise"]


def planned(job: Job) -> Run:
    """Return the path that a planner finds for a problem, as control points, and its CPU time [s]."""
    begin = time.process_time()
    _, _, result = planned_run(job)
    took = time.process_time() - begin
    control = None
    if result and result.path is not None:
        control = np.round(Spline().fit(result.path.states).control, DIGITS).tolist()
    return {"solved": control is not None, "reason": result.reason, "total": took, "control": control}


def solutions(folder: Path, count: int, levels: Sequence[str], workers: int) -> list[Paths]:
    """Return solutions of validation problems, at least ``count`` where as many can be had, kept in a folder."""
    units = {unit.name: unit for unit in plan_units(int(1.2 * count), levels, "validation")}
    options, spline = EngineOptions(copies=1, parts=0), Spline()
    settings = {"problems": count, "levels": list(levels), **asdict(spline)}
    store = Store.create(folder, settings, ("problems", "levels"))
    with store.locked():
        there = set(store.units())
        jobs = {name: (unit, options, spline) for name, unit in units.items() if name not in there}
        if jobs:
            made = spread(solve_unit, jobs, workers=workers, address=None)
            for name, (paths, _) in tqdm(made, total=len(jobs), unit="unit"):
                store.write(name, paths)
        return list(store)


def one_each(units: Sequence[Paths], count: int) -> dict[str, Array]:
    """Return the first solution of each of ``count`` problems as control points, by problem, the levels in turn."""
    by_level: dict[str, list[tuple[str, Array]]] = {}
    for unit in units:
        for k in first_of_each(unit):
            name = unit.problem_name(int(unit.arrays["problem"][k]))
            by_level.setdefault(name.rsplit("/", 1)[0], []).append((name, unit.control(slice(k, k + 1))[0]))
    in_turn = (one for some in zip_longest(*by_level.values()) for one in some if one is not None)
    return dict(islice(in_turn, count))


def first_of_each(paths: Paths) -> list[int]:
    """Return the first path of each problem that is not a reversal."""
    found: dict[int, int] = {}
    for k, (problem, source) in enumerate(zip(paths.arrays["problem"], paths.arrays["source"], strict=True)):
        if SOURCES[source] != "reversed":
            found.setdefault(int(problem), k)
    return list(found.values())


def feature_spaces() -> dict[str, Callable[[Sequence[Array]], Array]]:
    """Return functions from paths to their features: in the latent space of apex-paper, and in principal components."""
    spaces = {
        "VAE": load_torch_model("apex-paper").network.autoencoder,
        "PCA": load_torch_model("apex").network.autoencoder,
    }
    return {name: partial(features, space=space) for name, space in spaces.items()}


def features(paths: Sequence[Array], space: Autoencoder) -> Array:
    """Return the features of paths, shape (N, d)."""
    parts = np.array_split(np.stack(paths), max(1, len(paths) // 500))
    with torch.no_grad():
        return np.concatenate([space.encode(torch.tensor(p, dtype=torch.float32)).flatten(1) for p in parts])
