"""MotionBenchMaker's problems of the Panda, UR5, Fetch and Baxter: apex without a model beside rrtconnect+polish.

The problems (Chamzas et al. 2022), URDFs, SRDFs and meshes are those of VAMP's repository, github.com/KavrakiLab/vamp,
whose folder ``resources`` is given, its ``problems.tar.bz2`` unpacked. Robots are set up by ``apex-ompl robot new``
from them, the Fetch with its torso, locked joints as at the start of the first problem, and prepared by
``apex-ompl robot prepare``; Baxter is the one that ships, with both arms and open grippers. Meshes decide. Problems
whose start or goal the meshes refuse are left out and counted. With --vamp VAMP plans them, too, whose robots are
spheres of its own, with its own settings and without dynamic domains, and has a million iterations. Its shortened path
is then proved by the meshes here, or repaired; where that fails, the path as it was found is tried. Times and columns
are those of :mod:`benchmarks.robots.any_robot`; figures are kept in benchmarks/runs/mbm.

Usage: python -m benchmarks.robots.motion_bench_maker RESOURCES [ROBOT...] [-n 100] [--vamp] [--folder FOLDER]
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache
from importlib.metadata import version
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import MissingFileError
from apex_ompl.ompl.setup import assemble
from apex_ompl.paths.path import path_length
from apex_ompl.robot import load_robot
from apex_ompl.robot.moveit import convert
from apex_ompl.robot.new import new_robot, sources_of
from apex_ompl.scene.problem import Problem
from apex_ompl.util.clocks import Deadline
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.files import read_text, write_atomically
from apex_ompl.util.schema import dump_yaml, read_yaml
from apex_ompl.util.validation import check_name
from benchmarks.lib import record, vamp_world
from benchmarks.lib.full_check import proved_or_repaired
from benchmarks.robots import figures
from benchmarks.robots.fleet import open_baxter

DEPENDS = (
    "@planning",
    "benchmarks/robots/figures.py",
    "benchmarks/robots/fleet.py",
    "benchmarks/lib/vamp_world.py",
    "benchmarks/lib/full_check.py",
)
FOLDER = Path(__file__).parents[1] / "runs" / "mbm"
ROBOTS = ("panda", "ur5", "fetch", "baxter")
PACKAGES = {"fetch": "fetch_description"}
SMALLER = {"fetch": "arm"}  # groups of the SRDF whose joints are part of the group that is planned
VAMP: Mapping[str, Mapping[str, Any]] = {"VAMP": {}, "VAMP without dynamic domains": {"dynamic_domain": False}}
MOST_PAIRS = 3  # that a row names
Problems = Mapping[str, Problem | None]
GROUP = r'<group name="{}">.*?</group>'


def requests(robot: str, resources: Path) -> list[Path]:
    """Return the requests of a robot, those of all sets in turn.

    Raises:
        MissingFileError: There are none.
    """
    sets = [sorted(folder.glob("request*.yaml")) for folder in sorted((resources / robot / "problems").glob("*"))]
    if not any(sets):
        raise MissingFileError(str(resources / robot / "problems"), "folder of problems", "no requests in it")
    most = max(map(len, sets))
    return [some[k] for k in range(most) for some in sets if k < len(some)]


def set_up(robot: str, resources: Path, folder: Path) -> Path:
    """Return the robot file of a robot, which is written where it is missing."""
    file, here = folder / robot / f"{robot}.robot.yaml", resources / robot
    if file.exists():
        return file
    file.parent.mkdir(parents=True, exist_ok=True)
    if robot == "baxter":
        return open_baxter(file)
    text, srdf = read_text(here / f"{robot}.srdf", "SRDF"), file.parent / f"{robot}.srdf"
    if robot in SMALLER:
        text = re.sub(GROUP.format(SMALLER[robot]), "", text, count=1, flags=re.DOTALL)
    write_atomically(srdf, text.encode())
    packages = {PACKAGES[robot]: here} if robot in PACKAGES else {}
    new_robot(sources_of([str(here / f"{robot}.urdf")], [str(srdf)]), file, packages)
    data = read_yaml(file, "robot file")
    state = read_yaml(requests(robot, resources)[0], "request")["start_state"]["joint_state"]
    given = dict(zip(state["name"], state["position"], strict=True))
    data["locked"] = {joint: given.get(joint, value) for joint, value in data.get("locked", {}).items()}
    write_atomically(file, dump_yaml(data).encode())
    return file


def problems(robot: Path, resources: Path, most: int) -> Iterator[tuple[str, Problem | None]]:
    """Yield the names of the first problems of a robot with the problems, None where a start or goal is not free."""
    loaded = load_robot(robot)
    name = robot.name.split(".")[0]
    for request in requests(name, resources)[:most]:
        scene = request.with_name(request.name.replace("request", "scene"))
        found = convert(scene, request, loaded).problem.model_copy(update={"robot": str(robot)})
        checker = CollisionChecker(loaded, found.scene, found.attached, found.allowed)
        ends = [found.start_state(loaded.joint_names), *found.goal_states(loaded.joint_names)]
        free = all(checker.is_free(q) and loaded.limit_fault(q) is None for q in ends)
        yield f"{request.parent.name}/{request.stem}", found if free else None


def run_vamp(mine: figures.Figures, robot: str, names: Iterable[str], found: Callable[[], Problems]) -> None:
    """Let VAMP plan for the problems that are missing."""
    done: dict[str, Any] = mine.data.setdefault("vamp", {label: {} for label in VAMP})
    loaded = load_robot(mine.robot)
    mine.note_commit()
    for name, (label, changes) in product(names, VAMP.items()):
        if name in done[label]:
            continue
        problem, times = found()[name], dict[str, float]()
        assert problem is not None
        ready, made = assemble(problem, loaded), vamp_world.environment(problem)
        ends, deadline = (ready.start, ready.goals[0]), Deadline(figures.TIMEOUT)
        paths = vamp_world.planned(robot, ends, loaded.joint_names, made, times, **changes)
        own, proof = sum(times.values()), ready.checker.prove(paths[0]) if paths else None
        path, _ = proved_or_repaired(ready, paths, deadline.at, times) if paths else (None, "")
        done[label][name] = {
            "found": bool(paths), "free": bool(proof), "pair": list(proof.pair) if proof is not None else [],
            "own_s": own, "solved": path is not None, "s": sum(times.values()),
            "length": None if path is None else path_length(path),
        }  # fmt: skip
    mine.write(vamp=done)


def vamp_table(rows: Mapping[str, tuple[figures.Figures, list[str]]]) -> str:
    """Return a table of VAMP's runs."""
    head = [
        "robot", "planner", "N", "found by its spheres", "free by the meshes", "ms p50", "p95", "solved with repair",
        "ms p50", "p95", "length rad", "in the way at first",
    ]  # fmt: skip
    lines = [record.row(head), record.row(["---", "---", *["---:"] * (len(head) - 3), "---"])]
    for robot, (mine, names) in rows.items():
        for label in VAMP:
            runs = [mine.data["vamp"][label][name] for name in names]
            shares = [f"{np.mean([run[key] for run in runs]):.3f}" for key in ("found", "free", "solved")]
            own, whole = (
                [f"{1e3 * t:.1f}" if t is not None else "-" for t in (_reached(runs, *keys, p) for p in (50, 95))]
                for keys in (("found", "own_s"), ("solved", "s"))
            )
            length = record.percentiles([run["length"] for run in runs if run["solved"]], 50)[0]
            pairs = Counter(" and ".join(run["pair"]) for run in runs if run["found"] and not run["free"])
            blamed = ", ".join(f"{pair} {count}" for pair, count in pairs.most_common(MOST_PAIRS))
            cells = [robot, label, len(runs), *shares[:2], *own, shares[2], *whole, f"{length:.2f}", blamed]
            lines.append(record.row(cells))
    return "\n".join(lines)


def _reached(runs: Sequence[Mapping[str, Any]], done: str, seconds: str, p: float) -> float | None:
    """Return a percentile of times, those of runs that are not done last; None where it is one of them."""
    return record.reached([run[seconds] if run[done] else np.inf for run in runs], p)


def main() -> None:
    """Set up, prepare, plan and write."""
    parser = record.parser(__doc__, n=100, of="problems of a robot")
    parser.add_argument("resources", type=Path, help="folder resources of VAMP's repository")
    parser.add_argument("robots", nargs="*", help=f"by default all of {', '.join(ROBOTS)}")
    parser.add_argument("--vamp", action="store_true", help="let VAMP plan, too")
    figures.add_options(parser, FOLDER)
    args = parser.parse_args()
    rows, refused = {}, {}
    for robot in [check_name(name, "robot", ROBOTS) for name in args.robots or ROBOTS]:
        file = set_up(robot, args.resources.resolve(), args.folder.resolve())
        mine = figures.Figures(file)
        mine.prepare(args.budget, args.jobs)
        found = cache(lambda file=file: dict(problems(file, args.resources, args.n)))
        known = mine.data.get("refused", {})
        if known.get("n", 0) < args.n:
            mine.write(refused={"n": args.n, "names": [name for name, one in found().items() if one is None]})
        gone = set(mine.data["refused"]["names"])
        names = [f"{path.parent.name}/{path.stem}" for path in requests(robot, args.resources)[: args.n]]
        names, refused[robot] = [name for name in names if name not in gone], len(gone & {*names})
        mine.run(names, lambda name, found=found: found()[name])
        if args.vamp:
            run_vamp(mine, robot, names, found)
        rows[robot] = mine, names
    left = ", ".join(f"{robot} {count}" for robot, count in refused.items())
    settings = {
        "n": args.n,
        "budget": args.budget,
        "refused": left,
        "run_commits": figures.run_commits(rows),
        **figures.SETTINGS,
    }
    data, table = figures.table(rows)
    if all("vamp" in mine.data for mine, _ in rows.values()):
        table = f"{table}\n\n{vamp_table(rows)}"
        settings["vamp"] = version("vamp-planner")
    record.write("motion_bench_maker_robots", data, table, **settings)


if __name__ == "__main__":
    run_script(main)
