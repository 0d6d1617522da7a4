"""Where the time of apex goes on hard problems, and variants of its stages that were tried.

Every run is one of apex without trees (``fallback=false``, ``bridge=false``) on a validation problem of a hard level,
with a limit of 5 s; a run without a path has infinite times. The first table holds the stages of the planner as it is,
shortening included; the second holds variants of it, without shortening, the first row being apex as it is. The third
shows the cost of the first sprint, RRTConnect's iterations before proposals, where it does not help, and how often it
is enough in open scenes; later sprints are left out there.
Each run is stored in benchmarks/runs/apex_profile when it ends; the command resumes where it was stopped.

Usage: python -m benchmarks.planners.apex_profile [-n 30]
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any
from unittest import mock

from ompl import base as ob

from apex_ompl.apex import parameters as apex_parameters
from apex_ompl.apex.parameters import ApexParameters
from apex_ompl.evaluation import Row, Workers, bench, runs
from apex_ompl.evaluation.rows import Job
from apex_ompl.evaluation.runs import NO_PROBLEM, Run
from apex_ompl.evaluation.summary import Statistics
from apex_ompl.paths.optimizer import Optimizer, OptimizerSettings
from apex_ompl.result import FIRST, INSIDE
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import one_or_more
from benchmarks.lib import record

DEPENDS = ("@benchmark",)
FOLDER = record.RESULTS.parent / "runs" / "apex_profile"
TIMEOUT, SEED = 5.0, 1  # [s]
TREELESS = {"fallback": False, "bridge": False}
HARD = tuple(f"{suite}/hard" for suite in ("shelf", "bins", "cage", "posts", "wall", "swap", "clutter"))
OPEN = ("vertical/free", "vertical/small", "horizontal/small", "bins/easy", "wall/easy")
SPRINTS = (0, 200, 800, 2000, 5000)  # iterations of compiled trees
RUNNER = "benchmarks.planners.apex_profile:run_variant"
VARIANTS: dict[str, tuple[dict[str, Any], int | None]] = {
    "as it is": ({}, None),
    "1, 7, 24 proposals": ({"first": 1, "second": 7}, None),
    "2, 6, 24 proposals": ({"first": 2, "second": 6}, None),
    "8, 24, 24 proposals": ({"first": 8, "second": 24}, None),
    "128 samples in repair": ({}, 128),
    "48 samples": ({}, 48),
    "1, 7, 24 proposals, 128 samples: as it was": ({"first": 1, "second": 7}, 128),
    "1 denoising step": ({"denoising_steps": 1}, None),
    "3 denoising steps": ({"denoising_steps": 3}, None),
    "DPM-Solver++, 2 steps": ({"sampler": "dpm_solver", "denoising_steps": 2}, None),
    "guided": ({"guidance": True}, None),
    "no resampling": ({"resample": 0}, None),
    "2 resamplings a round": ({"resample": 2}, None),
    "no straight line": ({"line": False}, None),
}
STAGES = Row("stages", "apex", {"seed": SEED, **TREELESS}, levels=HARD)


def run_variant(job: Job) -> Run:
    """Return the columns of a run with other samples of the optimizer in repair, or without later sprints."""
    params = dict(job.params)
    samples, later_sprints = params.pop("samples", None), params.pop("later_sprints", True)
    build = ApexParameters.build

    def build_variant(self: ApexParameters, si: ob.SpaceInformation) -> ob.Planner:
        planner = build(self, si)
        if samples is not None:
            planner.optimizer = Optimizer(planner.model.spline, OptimizerSettings(samples=samples))
        return planner

    factors = apex_parameters.SPRINT_FACTORS if later_sprints else (1, 0, 0)
    again = apex_parameters.AGAIN if later_sprints else 0
    with (
        mock.patch.object(ApexParameters, "build", build_variant),
        mock.patch.object(apex_parameters, "SPRINT_FACTORS", factors),
        mock.patch.object(apex_parameters, "AGAIN", again),
    ):
        return runs.columns(*runs.planned(replace(job, params=params, runner="")))


def variant_rows() -> list[Row]:
    """Return a row of each variant."""
    common = {"seed": SEED, "polish": False, **TREELESS}
    return [
        Row(name, "apex", {**common, **params, "samples": samples}, levels=HARD, runner=RUNNER)
        for name, (params, samples) in VARIANTS.items()
    ]


def sprint_rows() -> list[Row]:
    """Return a row of each length of the first sprint."""
    common = {"seed": SEED, "polish": False, "later_sprints": False}
    return [Row(f"sprint {k}", "apex", {**common, "sprint": k}, runner=RUNNER) for k in SPRINTS]


def statistics(made: Sequence[Run], label: str, levels: Sequence[str]) -> Statistics:
    """Return the statistics of a row on some levels."""
    return Statistics("", label, [run for run in made if run["label"] == label and run["experiment"] in levels])


def first_times(found: Statistics) -> list[float | None]:
    """Return percentiles of the time to a first path [s]."""
    return [record.reached(found.times("first"), p) for p in (50, 80, 95)]


def ms(values: Sequence[float | None]) -> list[str]:
    """Return times as text [ms]."""
    return ["-" if value is None else f"{1e3 * value:.1f}" for value in values]


def stages(made: Sequence[Run]) -> tuple[dict[str, Any], list[str]]:
    """Return the time of each stage of the planner as it is [s], and a table."""
    times = [run["times"] for run in statistics(made, STAGES.label, HARD).solved]
    lines = [record.row(["stage", "share of the time", "mean ms", "p95 ms"]), record.row(["---", *["---:"] * 3])]
    total, found = sum(one["solve"] for one in times), {}
    names = {name for one in times for name in one if name.startswith(INSIDE) and name != FIRST}
    spent = {name.removeprefix(INSIDE): [one.get(name, 0.0) for one in times] for name in names}
    for stage, values in sorted(spent.items(), key=lambda pair: -sum(pair[1])):
        share, mean, high = sum(values) / total, sum(values) / len(times), record.reached(values, 95) or 0.0
        found[stage] = {"share": share, "mean_s": mean, "p95_s": high}
        lines.append(record.row([stage, f"{share:.2f}", f"{1e3 * mean:.1f}", f"{1e3 * high:.1f}"]))
    if times:
        rest = 1.0 - sum(f["share"] for f in found.values())
        lines.append(record.row(["all else", f"{rest:.2f}", f"{1e3 * rest * total / len(times):.1f}", ""]))
    return found, lines


def variants(made: Sequence[Run]) -> tuple[dict[str, Any], list[str]]:
    """Return the statistics of variants, and a table."""
    lines = [record.row(["variant", "solved", "first path ms p50", "p80", "p95", "by proposals as they are"])]
    lines.append(record.row(["---", *["---:"] * 5]))
    found = {}
    for name in VARIANTS:
        f = statistics(made, name, HARD)
        solved, by = len(f.solved) / len(f.runs), Counter(f.by)
        found[name] = {"solved": solved, "first_s": first_times(f), "by": dict(by)}
        lines.append(record.row([name, f"{solved:.3f}", *ms(first_times(f)), f"{by['apex'] / len(f.runs):.2f}"]))
    return found, lines


def sprints(made: Sequence[Run]) -> tuple[dict[str, Any], list[str]]:
    """Return the statistics of sprints of several lengths, and a table."""
    head = ["iterations", "open: enough for", "open: first path ms p50", "p80", "p95"]
    head += ["hard: enough for", "hard: sprint ms p50", "hard: first path ms p50", "p80", "p95"]
    lines = [record.row(head), record.row(["---:"] * len(head))]
    found = {}
    for sprint in SPRINTS:
        cells: list[str] = [str(sprint)]
        for name, levels in (("open", OPEN), ("hard", HARD)):
            f = statistics(made, f"sprint {sprint}", levels)
            spent = record.reached([run["times"].get(f"{INSIDE}sprint", 0.0) for run in f.runs], 50)
            enough = f.by["sprint"] / len(f.runs)
            found[f"{sprint}, {name}"] = {"enough": enough, "first_s": first_times(f), "sprint_s": spent}
            cells += [f"{enough:.2f}", *(ms([spent]) if name == "hard" else []), *ms(first_times(f))]
        lines.append(record.row(cells))
    return found, lines


def main() -> None:
    """Run what is missing, and write the results."""
    parser = record.parser(__doc__)
    parser.add_argument(
        "-n", type=one_or_more, default=30, help="validation problems of a level (default: %(default)s)"
    )
    args = parser.parse_args()
    results = bench(
        [*HARD, *OPEN], [STAGES, *variant_rows(), *sprint_rows()], FOLDER, runs=args.n, timeout=TIMEOUT,
        split="validation", workers=Workers(), provenance=record.session(),
    )  # fmt: skip
    made = [run for run in results.runs if run["seed"] < args.n and run["status"] != NO_PROBLEM]
    (by_stage, first), (by_variant, second), (by_sprint, third) = stages(made), variants(made), sprints(made)
    data = {"stages": by_stage, "variants": by_variant, "sprints": by_sprint}
    counts = f"{args.n * len(HARD)} hard, {args.n * len(OPEN)} open"
    record.write(
        "apex_profile", data, "\n".join([*first, "", *second, "", *third]), split="validation", N=counts, seed=SEED,
        **record.made_with(replace(results, runs=made)),
    )  # fmt: skip


if __name__ == "__main__":
    run_script(main)
