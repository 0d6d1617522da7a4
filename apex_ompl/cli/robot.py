"""The command ``apex-ompl robot``: new, check and prepare."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from apex_ompl.cli.options import name_value_pairs
from apex_ompl.cli.progress import progress_bars
from apex_ompl.collision.cover.pairs import PairSearch
from apex_ompl.collision.cover.preparation import Preparation
from apex_ompl.collision.cover.preparation import prepare as prepare_robot
from apex_ompl.collision.cover.survey import Survey, survey
from apex_ompl.errors import ParameterError
from apex_ompl.robot import Robot, load_robot
from apex_ompl.robot.new import PLACE, new_robot, sources_of
from apex_ompl.util.display import Summary, counted
from apex_ompl.util.validation import check_integer

NAMED = 5  # pairs and links that a line names
ENOUGH = 0.85  # share of free states that covers should prove


def new(parsed: argparse.Namespace) -> int:
    """Write a robot file, and print what was guessed."""
    places = [_place(text) for text in parsed.at]
    made = new_robot(sources_of(parsed.urdf, parsed.srdf, places), parsed.out, _packages(parsed.package))
    for note in made.notes:
        print(f"apex-ompl: note: {note}", file=sys.stderr)
    print(*made.files, sep="\n")
    return 0


def _place(text: str) -> list[float]:
    try:
        return [float(word) for word in text.split(",")]
    except ValueError as error:
        raise ParameterError("--at", text, PLACE) from error


def _packages(pairs: Sequence[str]) -> dict[str, Path]:
    """Return package name -> absolute folder."""
    found = {}
    for name, folder in name_value_pairs("--package", pairs).items():
        path = Path(folder).expanduser().resolve()
        if not path.is_dir():
            raise ParameterError("--package", f"{name}={folder}", "NAME=FOLDER with a folder that exists")
        found[name] = path
    return found


def check(parsed: argparse.Namespace) -> int:
    """Print what a robot can do and what its covers prove; the exit code is 2 where it cannot be planned for."""
    check_integer(parsed.samples, "--samples", 1)
    robot = load_robot(parsed.robot)
    found = survey(robot, parsed.samples)
    faults = list(_faults(found))
    if parsed.json:
        pairs = {" - ".join(links): share for links, share in found.spoilers.items()}
        proved = None if math.isnan(found.proved) else found.proved
        numbers = found._asdict() | {"spoilers": pairs, "proved": proved}
        print(json.dumps({"name": robot.name, "dof": robot.dof, **numbers, "faults": faults}))
    else:
        print(_summary(robot, found))
    for fault in faults:
        print(f"apex-ompl: fault: {robot.name}: {fault}", file=sys.stderr)
    return 2 if faults else 0


def _faults(found: Survey) -> Iterator[str]:
    """Yield the reasons for which a robot cannot be planned for, a sentence each."""
    if found.home:
        yield f"home: expected a state that is free, {found.home}"
    if found.free == 0.0:
        pair = f"; {' and '.join(found.always[0])} touch at all of them" if found.always else ""
        yield f"expected free states, found none among {found.samples} random ones{pair}"


def _summary(robot: Robot, found: Survey) -> Summary:
    """Return what is printed of a robot."""
    groups = ", ".join(f"{name} {len(group)}" for name, group in robot.groups.items())
    rows = [
        ("joints", f"{robot.dof} planned" + f": {groups}" * bool(groups)),
        ("solids", f"{len(robot.geometry.geometryObjects)}, {len(robot.geometry.collisionPairs)} pairs are checked"),
        ("free", f"{found.free:.1%} of {counted(found.samples, 'random state')}"),
    ]
    covers = "of its file" if robot.covers else "made at run time, see robot prepare"
    if not math.isnan(found.proved):
        low = "" if found.proved >= ENOUGH else f"; planning is slow below {ENOUGH:.0%}"
        rows.append(("proved", f"{found.proved:.1%} of the free states by sphere covers {covers}{low}"))
    spoilers = [f"{' and '.join(links)} {share:.0%}" for links, share in list(found.spoilers.items())[:NAMED]]
    rows += [("unproved", text) for text in spoilers]
    rows.append(("home", "free" if not found.home else found.home))
    if found.always:
        rows.append(("always", f"touch at all of {found.pair_samples} states: {_pairs(found.always)}"))
    if found.never:
        rows.append(("never", f"{counted(len(found.never), 'pair')} touch at none of {found.pair_samples} states"))
    if found.grazing:
        rows.append(
            ("grazing", f"touch as bearings do and are not checked: {_pairs(found.grazing)}; see robot prepare")
        )
    if found.open_meshes:
        rows.append(("open", f"meshes of {_some(found.open_meshes)} are not closed"))
    if found.unlimited:
        rows.append(("limits", f"{_some(found.unlimited)} have a range that is no limit"))
    return Summary(robot.name, rows)


def _pairs(pairs: Sequence[tuple[str, str]]) -> str:
    return _some([" and ".join(links) for links in pairs])


def _some(names: Sequence[str]) -> str:
    more = len(names) - NAMED
    return ", ".join(names[:NAMED]) + f", {more} more" * (more > 0)


def prepare(parsed: argparse.Namespace) -> int:
    """Compute pairs and covers of a robot."""
    settings = Preparation(
        budget=parsed.budget, jobs=parsed.jobs, effort=parsed.effort,
        pairs=PairSearch(parsed.samples, parsed.margin, parsed.seed, tuple(parsed.soft), parsed.graze),
    )  # fmt: skip
    with progress_bars() as report:
        done = prepare_robot(parsed.robot, settings, report)
    covers = ", ".join(f"{number} with effort {effort}" for effort, number in done.covers.items()) or "none"
    rows = [
        ("pairs", f"{done.pairs} disabled"),
        ("covers", f"of {counted(sum(done.covers.values()), 'shape')}: {covers}"),
    ]
    if done.grazing:
        shallow = f"touch by less than {1e3 * parsed.graze:g} mm, as bearings do, and are not checked"
        rows.append(("grazing", f"{_pairs(done.grazing)} {shallow}; --graze 0 checks them"))
    if done.missing:
        rows.append(("missing", f"{counted(done.missing, 'cover')}, made at run time until then"))
    if not done.thorough:
        rows.append(("next", "the time was not enough for all of it; the same command goes on"))
    print(Summary(str(parsed.robot), [*rows, *(("file", str(file)) for file in done.files)]))
    return 0
