"""How long a proposal takes, by stage: condition, network, guidance, decoding; and how long a checkpoint takes to load.

One thread, one problem of a hard level; medians of repetitions behind a warm-up.

Usage: python -m benchmarks.model.model_latency [--repeat 30]
"""

from __future__ import annotations

import subprocess
import sys
import time
from typing import Any

import numpy as np

from apex_ompl import load_model, problems
from apex_ompl.apex.models import make_query
from apex_ompl.model.checkpoint import shipped
from apex_ompl.model.guidance import Guidance
from apex_ompl.model.proposals import Sampling
from apex_ompl.ompl.setup import assemble
from apex_ompl.problems.suite_robot import robot
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import one_or_more
from benchmarks.lib import record

DEPENDS = ("apex_ompl/model", "apex_ompl/apex/models.py", "apex_ompl/kernel", "apex_ompl/ompl", "problems")
PROBLEM = "shelf/hard/800003"
COUNTS = (1, 4, 8, 32)
STEPS = (1, 2, 8)
GUIDED = Guidance(gamma=1.0)
LOAD = "import time; b = time.perf_counter(); import apex_ompl; apex_ompl.load_model({name!r}); "
LOAD += "print(time.perf_counter() - b)"


def latency(name: str, repeat: int) -> list[dict[str, Any]]:
    """Return the seconds of each stage for every number of proposals and steps."""
    model, ready = load_model(name), assemble(problems.load(PROBLEM), robot())
    kernel, rows = ready.checker.kernel, []
    took = []
    for _ in range(repeat + 3):
        begin = time.perf_counter()
        query = make_query(ready.checker, ready.start, ready.goals[0], point=model.sees_point)
        took.append(time.perf_counter() - begin)
    query_s = float(np.median(took[3:]))
    for count in COUNTS:
        for steps in STEPS:
            for guidance in (Guidance(gamma=0.0), GUIDED):
                sampling, found = Sampling("ddim", steps, guidance=guidance), []
                for k in range(repeat + 3):
                    generator = np.random.default_rng(k)
                    found.append(model.propose(query, kernel, count, sampling=sampling, generator=generator).seconds)
                stages = {stage: float(np.median([f[stage] for f in found[3:]])) for stage in found[0]}
                row = {"count": count, "steps": steps, "guided": guidance.gamma > 0.0, "query_s": query_s}
                rows.append({**row, "stages": stages, "total_s": sum(stages.values())})
    return rows


def load_seconds(name: str, repeat: int = 5) -> float:
    """Return the median time that loading takes in new processes."""
    command = [sys.executable, "-c", LOAD.format(name=name)]
    return float(np.median([float(subprocess.check_output(command)) for _ in range(repeat)]))


def main() -> None:
    """Measure all that ship, and write the results."""
    parser = record.parser(__doc__)
    parser.add_argument("--repeat", type=one_or_more, default=30)
    args = parser.parse_args()
    lines = [["model", "B", "steps", "guided", "condition ms", "network ms", "guidance ms", "decode ms", "total ms"]]
    lines.append(["---", "---:", "---:", "---", *["---:"] * 5])
    models, notes = {}, []
    for name in shipped():
        rows, load = latency(name, args.repeat), load_seconds(name)
        models[name] = {"load_s": load, "rows": rows}
        query_ms = 1e3 * rows[0]["query_s"]
        notes.append(f"`{name}` loads in {load:.2f} s; its query is made in {query_ms:.2f} ms.")
        for row in rows:
            times = [f"{1e3 * t:.2f}" for t in (*row["stages"].values(), row["total_s"])]
            lines.append([name, row["count"], row["steps"], "yes" if row["guided"] else "no", *times])
    text = "\n".join(record.row(line) for line in lines) + "\n\n" + " ".join(notes)
    record.write("model_latency", {"models": models}, text, problem=PROBLEM, threads=1, n=args.repeat)


if __name__ == "__main__":
    run_script(main)
