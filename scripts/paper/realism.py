"""Paths of the models beside solutions of the same problems, for FID and KID in ``reproduce.py fid``."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import cache, partial
from itertools import islice, zip_longest
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from apex_ompl import problems
from apex_ompl.apex.query import make_query
from apex_ompl.datasets.engine import EngineOptions
from apex_ompl.datasets.records import SOURCES, Paths
from apex_ompl.datasets.store import Store
from apex_ompl.diffusion.autoencoder import Autoencoder
from apex_ompl.diffusion.checkpoint import load_model, load_torch_model
from apex_ompl.diffusion.guidance import Guidance
from apex_ompl.diffusion.proposals import Sampling
from apex_ompl.generation.solving import solve_unit
from apex_ompl.generation.units import plan_units
from apex_ompl.ompl_adapter.process import quiet_ompl
from apex_ompl.ompl_adapter.setup import assemble
from apex_ompl.problems.suite_robot import robot
from apex_ompl.trajopt.spline import Spline
from apex_ompl.types import Array
from apex_ompl.util.cluster import spread

MODELS = ("apex", "apex-paper")
STEPS = 8  # of DDIM, for apex-paper, whose own 256 would take hours
BATCH = 50  # problems of a job

load = cache(load_model)  # once in a process


def variants() -> dict[str, tuple[str, Sampling]]:
    """Return the variants by label: a model and its sampling, guided and unguided."""
    own = {"apex": load("apex").sampling, "apex-paper": Sampling("ddim", STEPS)}
    return {
        f"{name}{'' if guided else ', unguided'}": (name, replace(own[name], guidance=Guidance(gamma=float(guided))))
        for name in MODELS
        for guided in (True, False)
    }


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


def made_for(
    units: Sequence[Paths], count: int, workers: int
) -> tuple[list[Array], dict[str, list[Array]], dict[str, float]]:
    """Return the first solution of each of ``count`` problems, and the paths of each variant for the same problems.

    Returns:
        The solutions, those of all levels in turn; by variant, paths in the same order, as control points; and the CPU
        time of each variant [s].
    """
    by_level: dict[str, list[tuple[str, Array]]] = {}
    for unit in units:
        for k in first_of_each(unit):
            name = unit.problem_name(int(unit.arrays["problem"][k]))
            by_level.setdefault(name.rsplit("/", 1)[0], []).append((name, unit.control(slice(k, k + 1))[0]))
    in_turn = (one for some in zip_longest(*by_level.values()) for one in some if one is not None)
    picked = list(islice(in_turn, count))
    jobs = {str(k): (picked[k : k + BATCH], k) for k in range(0, len(picked), BATCH)}
    found = dict(tqdm(spread(propose, jobs, workers=workers, address=None), total=len(jobs), unit="part"))
    paths: dict[str, list[Array]] = {label: [] for label in variants()}
    seconds = dict.fromkeys(paths, 0.0)
    for part in (found[name] for name in jobs):
        for label, (made, took) in part.items():
            paths[label] += made
            seconds[label] += took
    return [control for _, control in picked], paths, seconds


def propose(part: Sequence[tuple[str, Array]], seed: int) -> dict[str, tuple[list[Array], float]]:
    """Return the paths of each variant for some problems, from their ends, and the CPU time that they took [s]."""
    generator = np.random.default_rng(seed)
    torch.set_num_threads(1)
    sampled = variants()
    made: dict[str, list[Array]] = {label: [] for label in sampled}
    seconds = dict.fromkeys(made, 0.0)
    with quiet_ompl(), torch.no_grad():
        for problem, control in part:
            checker = assemble(problems.load(problem), robot()).checker
            query = make_query(checker, control[0], control[-1])
            for label, (name, sampling) in sampled.items():
                begin = time.process_time()  # other work on the machine does not count
                found = load(name).propose(query, checker.kernel, 1, sampling=sampling, generator=generator)
                seconds[label] += time.process_time() - begin
                made[label].append(found.control[0])
    return {label: (made[label], seconds[label]) for label in made}


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
