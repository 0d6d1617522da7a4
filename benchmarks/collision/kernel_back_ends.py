"""The kernel's library beside the same functions compiled on the spot by numba: the same bits, and at what speed.

Answers are compared bit by bit: whether states are free, clearances with their gradients, paths of plans; the latter
with the library also where NumPy, OpenBLAS and the C library are told that the processor has no AVX-512. Times are
paired: both in one process, by turns, of one thread's processor time.

Usage: python -m benchmarks.collision.kernel_back_ends [--states 1000000] [--plans 60] [--rounds 40]
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from apex_ompl.kernel.library import CHOICE
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import one_or_more
from benchmarks.collision.verdicts import NAMES, STATES
from benchmarks.lib import record

DEPENDS = ("@planning", "benchmarks/collision/verdicts.py")
NO_AVX512 = {
    "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL",
    "OPENBLAS_CORETYPE": "Haswell",
    "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX512F,-AVX512VL,-AVX512BW,-AVX512CD,-AVX512DQ",
}
BACK_ENDS = {"library": {}, "numba": {CHOICE: "numba"}, "library, no AVX-512": NO_AVX512}
ANSWERS = """
from apex_ompl import plan
from apex_ompl.kernel import library

out, each, plans, names = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), sys.argv[4:]
assert library.is_used() == (library.os.environ.get(library.CHOICE) is None), library.why_not_used()
found = {}
for seed, name in enumerate(names if each else ()):
    problem, rng = problems.load(name), np.random.default_rng(seed)
    checker = CollisionChecker(robot(), problem.scene, problem.attached)
    states = drawn_states(problem, rng, each)
    found[f"free {name}"] = checker.are_free(states)
    found[f"unproved {name}"] = checker.kernel.unproved(states)[1]
    found[f"clearance {name}"], found[f"gradient {name}"] = checker.kernel.clearance_gradient(states[:500], 0.1)
for k in range(plans):
    name = names[k % len(names)]
    planner = ("apex", "rrtconnect+polish")[k // len(names) % 2]
    result = plan(name, planner, timeout=60.0, seed=k)
    found[f"path {k} {name} {planner}"] = np.asarray(result.path)
np.savez(out, **found)
"""
TIMES = """
import json, sys, time
import numpy as np
from apex_ompl import load_model, plan, problems
from apex_ompl.kernel import library
from apex_ompl.kernel.compiled import jit
from apex_ompl.ompl.setup import assemble
from apex_ompl.problems.suite_robot import robot
from apex_ompl.paths.optimizer import Optimizer

chosen = library.os.environ.pop(library.CHOICE)
built = library._load()
use_library = False

def call(self, *arguments):
    if use_library:
        return built[self.key](*arguments)
    if not self._ready:
        original(self, *arguments)
    return self.dispatcher(*arguments)

original, jit.CompiledFunction.__call__ = jit.CompiledFunction.__call__, call
jit.CompiledFunction.key = property(lambda self: f"{self.__module__.removeprefix(library.PACKAGE + '.')}.{self.name}")

model, ready = load_model("apex"), assemble(problems.load("shelf/hard/800003"), robot())
kernel, optimizer = ready.checker.kernel, Optimizer(model.spline)
starts = optimizer.starts(ready.start, ready.goals[0], 8, np.random.default_rng(0), 0.5)
near = optimizer.improve(kernel, starts, steps=12)
limits = robot().limits
paths = [np.ascontiguousarray(np.clip(model.spline.path(c), limits.lower, limits.upper)) for c in near.control]
states = np.concatenate(paths)
free = states[kernel.unproved(states)[1] == 0][:1024].copy()
drawn = np.random.default_rng(1).uniform(limits.lower, limits.upper, (1000, len(limits.lower)))
proved = [p for p in paths if kernel.proves(p, 0.02)][:4] or paths[:4]
from apex_ompl.kernel.products import dense_layer
rng = np.random.default_rng(2)
layer = rng.integers(-99, 99, (512, 512)).astype(np.int8), *rng.normal(size=(2, 512)).astype(np.float32)
rows = rng.normal(size=(8, 512)).astype(np.float32)
suites, levels = ("shelf", "posts", "cage", "swap"), ("medium", "hard")
names = [f"{suite}/{level}/80000{k}" for suite in suites for level in levels for k in (0, 1)]
tests = {
    "a state, free [us]": (lambda: kernel.unproved(free), len(free), 1e6),
    "a state, drawn over the limits [us]": (lambda: kernel.unproved(drawn), len(drawn), 1e6),
    "clearance and gradient of a state [us]": (lambda: kernel.clearance_gradient(free[:200], 0.1), 200, 1e6),
    "a path proved [us]": (lambda: [kernel.proves(p, 0.02) for p in proved], len(proved), 1e6),
    "a step of the optimizer [us]": (lambda: optimizer.improve(kernel, starts, steps=12), int(near.steps.sum()), 1e6),
    "a dense layer, 512 by 512, 8 rows [us]": (lambda: dense_layer(*layer, rows), 1, 1e6),
    "a call of one state [us]": (lambda: kernel.unproved(free[:1]), 1, 1e6),
    "a plan, median of 16 problems [ms]": (None, 1, 1e3),
}
clock, rounds, found = time.thread_time, int(sys.argv[1]), {}
for what, (function, count, scale) in tests.items():
    best = {False: [], True: []}
    if function is None:
        for name in names:
            times = {False: [], True: []}
            for _ in range(max(3, rounds // 8)):
                for use_library in best:
                    begin = time.process_time()
                    plan(name, seed=0, timeout=60.0)
                    times[use_library].append(time.process_time() - begin)
            for of, values in times.items():
                best[of].append(min(values))
        found[what] = {"numba": scale * float(np.median(best[False])), "library": scale * float(np.median(best[True]))}
        continue
    for _ in range(rounds):
        for use_library in best:
            begin = clock()
            function()
            best[use_library].append(clock() - begin)
    found[what] = {of: scale * min(best[of == "library"]) / count for of in ("numba", "library")}
print(json.dumps(found))
"""


def main() -> None:
    """Compare, time, and write the results."""
    parser = record.parser(__doc__)
    parser.add_argument("--states", type=one_or_more, default=1_000_000, help="(default: %(default)s)")
    parser.add_argument("--plans", type=one_or_more, default=60, help="(default: %(default)s)")
    parser.add_argument("--rounds", type=one_or_more, default=40, help="(default: %(default)s)")
    args = parser.parse_args()
    each = -(-args.states // len(NAMES))
    with tempfile.TemporaryDirectory() as folder:
        answers = {}
        for k, (name, environment) in enumerate(BACK_ENDS.items()):
            out, tables = Path(folder) / f"{k}.npz", {"XDG_CACHE_HOME": f"{folder}/{k}"}  # of the robot: made by each
            count = 0 if "AVX" in name else each
            run(STATES + ANSWERS, environment | tables, out, count, args.plans, *NAMES)
            with np.load(out) as file:
                answers[name] = dict(file)
    times = json.loads(run(TIMES, {CHOICE: "numba"}, args.rounds))
    reference = answers.pop("library")
    other = {name: sorted(k for k in found if not same(found[k], reference[k])) for name, found in answers.items()}
    figures = {"states": each * len(NAMES), "plans": args.plans, "other_bits": other, "times": times}
    lines = [
        record.row(["beside the library", "states", "plans", "with other bits"]),
        record.row(["---", "---:", "---:", "---:"]),
    ]
    for name, found in answers.items():
        states = each * len(NAMES) if any(k.startswith("free") for k in found) else "-"
        lines.append(record.row([name, states, args.plans, len(other[name])]))
    lines += ["", record.row(["", "numba", "library", "ratio"]), record.row(["---", "---:", "---:", "---:"])]
    for what, row in times.items():
        values = f"{row['numba']:.2f}", f"{row['library']:.2f}", f"{row['library'] / row['numba']:.3f}"
        lines.append(record.row([what, *values]))
    record.write(
        "kernel_back_ends", figures, "\n".join(lines), split="validation", N=len(NAMES), rounds=args.rounds, seed=0
    )


def same(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether arrays have the same bits."""
    return a.shape == b.shape and a.tobytes() == b.tobytes()


def run(code: str, environment: dict[str, str], *arguments: object) -> str:
    """Run a program, and return what it prints."""
    code_of_numba = {"NUMBA_CACHE_DIR": str(Path.home() / ".cache")}
    env = {k: v for k, v in os.environ.items() if k != CHOICE} | {"OMP_NUM_THREADS": "1"} | code_of_numba | environment
    command = [sys.executable, "-c", code, *map(str, arguments)]
    done = subprocess.run(command, env=env, check=False, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"{environment}: {done.stderr}")
    return done.stdout


if __name__ == "__main__":
    run_script(main)
