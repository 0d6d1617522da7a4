"""Tasks and worlds with perception in the loop, beside the same ones with what is true.

Each pair is of one seed. **Tasks**: ready-made problems in physics, with a red cube in the way, from starts whose
joints differ by up to 0.02 rad, masses and friction by up to 20 %, and whose objects are off in the hands by standard
deviations of (8, 8, 3) mm and (4, 4, 10) degrees, cut at two of these; grasps are drawn again where a hand touches what
a line brings onto the object in it, at any turn, as a peg that lies too far back in its hand: arms, cube and planner
have no part in that. Either objects and cube are seen by two cameras
of 640 x 480 pixels (drawn by MuJoCo, nine frames a look, noise and missing depths of a stereo camera, poses and depths
off by the spreads of a calibration), with looks from other states where something is not known well enough; or they are
told as they are. Tasks are judged by where the objects are at the end (:mod:`apex_ompl.physics.judges`), and fail where
anything touched the cube. **Worlds**: the loop among obstacles that move, the robot in physics, judged by the referee
with the measured motion. Either two cameras of 320 x 240 pixels see them (drawn by the kernel's renderer, 30 frames a
second, 30 ms late, the same errors), or an ideal sensor does. To tell what the delay does from what the errors do, each
world is run once more with a sensor without errors that is as late and as slow as the cameras. A task or run that was
not planned or not started, for whatever reason, failed.

Differences of the failure ratio are paired, with intervals of Agresti and Min (2005). Settings were chosen on other
seeds (tasks 1 to 20, worlds of the split ``validation``). Plans stop by the wall clock: a busy machine finds fewer.

Runs are stored in benchmarks/runs/perception_end_to_end when they end; the command resumes, in another clone after
``python -m benchmarks.lib.pack unpack perception_end_to_end``.

Usage: python -m benchmarks.perception.end_to_end [-n 600] [--parts tasks worlds] [--report]
"""

from __future__ import annotations

import json
import math
import re
import time
from collections import Counter
from collections.abc import Sequence
from typing import Any

from tqdm import tqdm

from apex_ompl import problems, run
from apex_ompl.drivers.library import mujoco
from apex_ompl.loop import Cameras, Sensor
from apex_ompl.loop.result import Outcome
from apex_ompl.moving.settings import LoopSettings
from apex_ompl.physics.camera import CameraRunner
from apex_ompl.physics.result import TaskRun
from apex_ompl.problems import worlds
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.files import write_atomically
from apex_ompl.util.statistics import share_interval
from benchmarks.lib import record
from benchmarks.lib.pack import RUNS
from benchmarks.physics.worlds import agresti_min

DEPENDS = (
    "@planning", "apex_ompl/moving", "apex_ompl/loop", "apex_ompl/timing", "apex_ompl/drivers", "apex_ompl/physics",
    "apex_ompl/perception", "benchmarks/physics/worlds.py",
)  # fmt: skip
FOLDER = RUNS / "perception_end_to_end"
PARTS = TASKS, WORLDS = "tasks", "worlds"
TOLD, SEEN = WAYS = "told", "seen"
LATE = "late"  # told at the cameras' rate and after their latency, in worlds
PROBLEMS = ("stack_boxes", "handover", "pour", "peg_in_hole", "ball_in_cup")
SEED = 10_001  # of the first task
TIMEOUT, RUN_TIMEOUT = 20.0, 10.0  # of a plan, and of a run in a world [s]
IDEAL = Sensor(rate=100.0, age=0.0, noise=0.0, dropout=0.0)
DELAYED = Sensor(rate=Cameras().rate, age=Cameras().latency, noise=0.0, dropout=0.0)
HEAD = ("what", "pairs", "failed told %", "failed seen %", "only told", "only seen", "difference % (95 %)")


def pairs_of(part: str, count: int) -> list[str]:
    """Return the names of the first pairs of a part, of all problems or kinds of worlds alike."""
    if part == TASKS:
        return [f"{PROBLEMS[k % len(PROBLEMS)]}/{SEED + k // len(PROBLEMS)}" for k in range(count)]
    kinds = worlds.kinds()
    each = [worlds.ids(kind, "test", -(-count // len(kinds))) for kind in kinds]
    return [name for some in zip(*each, strict=True) for name in some][:count]


def label_of(part: str, name: str) -> str:
    """Return the problem or the kind of world of a pair."""
    first = name.partition("/")[0]
    return first if part == TASKS or first in worlds.kinds() else worlds.MOVING_KIND


def executed(name: str, runners: dict[str, CameraRunner]) -> dict[str, Any]:
    """Return both runs of a task."""
    problem, seed = name.split("/")
    if problem not in runners:
        runners[problem] = CameraRunner(problems.load(problem), cubes=1, timeout=TIMEOUT)
    found = {}
    for way in WAYS:
        started = time.process_time()
        one, _ = runners[problem].run(int(seed), told=way == TOLD)
        found[way] = _stored(one) | {"cpu": round(time.process_time() - started, 2)}
    return found


def _stored(one: TaskRun) -> dict[str, Any]:
    failed = [check.name for check in one.checks if not check.passed]
    looks = sum(title.startswith("look") for title, _, _ in one.steps)
    return {
        "failed": not one, "outcome": one.outcome, "reason": one.reason, "checks": failed, "looks": looks,
        "metrics": {key: value for key, value in one.metrics.items() if math.isfinite(value)},
    }  # fmt: skip


def went(name: str) -> dict[str, Any]:
    """Return the runs in a world."""
    sensors = {TOLD: IDEAL, LATE: DELAYED, SEEN: Cameras(rendered=True, seed=worlds_seed(name))}
    found = {}
    for way, sensor in sensors.items():
        started, environment = time.process_time(), worlds.load(name)
        one = run(environment, driver="mujoco", sensor=sensor, settings=LoopSettings(timeout=RUN_TIMEOUT))
        kept = ("time_to_goal", "clearance", "broken_steps", "stops", "doubted_places")
        found[way] = {
            "failed": one.outcome != Outcome.REACHED, "outcome": str(one.outcome), "reason": one.reason,
            "metrics": {key: one.metrics[key] for key in kept if math.isfinite(one.metrics.get(key, math.nan))},
            "cpu": round(time.process_time() - started, 2),
        }  # fmt: skip
    return found


def worlds_seed(name: str) -> int:
    """Return the seed of the errors of cameras in a world."""
    return int(name.rpartition("/")[2])


def stored(part: str, names: Sequence[str], *, report: bool) -> dict[str, dict[str, Any]]:
    """Make the pairs that are missing, unless a report is all that is wanted, and return those that are there."""
    folder, runners, found = FOLDER / part, dict[str, CameraRunner](), {}
    folder.mkdir(parents=True, exist_ok=True)
    for name in tqdm(names, desc=part, mininterval=30.0, disable=report):
        file = folder / f"{name.replace('/', '_')}.json"
        if not file.exists() and not report:
            made = executed(name, runners) if part == TASKS else went(name)
            write_atomically(file, (json.dumps(made | {"commit": record.session()["commit"]}) + "\n").encode())
        if file.exists():
            found[name] = json.loads(file.read_text())
    return found


def row(label: str, pairs: Sequence[dict[str, Any]], told: str = TOLD) -> list[Any]:
    """Return the row of some pairs."""
    count = len(pairs)
    cells = []
    for way in (told, SEEN):
        bad = sum(one[way]["failed"] for one in pairs)
        low, high = share_interval(bad, count)
        cells.append(f"{100 * bad / count:.1f} ({100 * low:.1f} to {100 * high:.1f})")
    fewer = sum(one[told]["failed"] and not one[SEEN]["failed"] for one in pairs)
    more = sum(one[SEEN]["failed"] and not one[told]["failed"] for one in pairs)
    middle, half = agresti_min(fewer, more, count)
    shown = f"{100 * (more - fewer) / count:+.1f} ({100 * (middle - half):+.1f} to {100 * (middle + half):+.1f})"
    return [label, count, *cells, fewer, more, shown]


def cause(one: dict[str, Any]) -> str:
    """Return why a run failed, without names and numbers."""
    if one.get("checks"):
        return f"{one['outcome']}: not: {one['checks'][0]}"
    words = re.sub(r"'[^']*':? ?|at [0-9.]+ s: .*|[-+]?[0-9][0-9.]*(?: ?%| ?(?:mm|m|degrees|s)\b)?", "", one["reason"])
    return f"{one['outcome']}: {' '.join(words.split(';')[0].split())}".rstrip(": ")


def tables(found: dict[str, dict[str, dict[str, Any]]]) -> tuple[list[list[Any]], list[list[Any]], str]:
    """Return the rows of differences, those of causes, and both as text."""
    rows, causes = [], []
    for part, pairs in found.items():
        if not pairs:
            continue
        labels = dict.fromkeys(label_of(part, name) for name in pairs)
        rows += [row(label, [one for name, one in pairs.items() if label_of(part, name) == label]) for label in labels]
        rows.append(row(f"all {part}", list(pairs.values())))
        late = [one for one in pairs.values() if LATE in one]
        rows += [row(f"all {part}, told as late as the cameras", late, LATE)] if late else []
        for way in (*WAYS, LATE):
            failed = [(name, one[way]) for name, one in pairs.items() if way in one and one[way]["failed"]]
            counted = Counter((label_of(part, name), cause(one)) for name, one in failed)
            causes += [[way, *key, number] for key, number in counted.most_common()]
    every = [one for pairs in found.values() for one in pairs.values()]
    rows += [row("all", every)] if every else []
    text = "\n\n".join(
        "\n".join(record.row(list(line)) for line in (head, ["---"] * len(head), *lines))
        for head, lines in ((HEAD, rows), (("", "of", "cause", "failures"), causes))
    )
    return rows, causes, text


def main() -> None:
    """Make the runs, and write the results."""
    parser = record.parser(__doc__ or "", n=600, of="pairs of each part")
    parser.add_argument("--parts", nargs="+", default=list(PARTS), choices=PARTS)
    parser.add_argument("--report", action="store_true", help="run nothing; write the results of the stored runs")
    given = parser.parse_args()
    found = {part: stored(part, pairs_of(part, given.n), report=given.report) for part in given.parts}
    rows, causes, text = tables(found)
    data = {"columns": HEAD, "rows": rows, "causes": causes}
    count = {part: len(pairs) for part, pairs in found.items()}
    commits = "; ".join(sorted({one["commit"] for pairs in found.values() for one in pairs.values()}))
    record.write(
        "perception_end_to_end", data, text, n=given.n, pairs=count, mujoco=mujoco().__version__, run_commits=commits
    )


if __name__ == "__main__":
    run_script(main)
