"""The verdict on the paper's claims, in five sentences that are made from the results, and the order of rows.

Two failure ratios are in a decided order where their 95 % intervals do not overlap; otherwise the sentence or table
says that it is not decided. Differences have Newcombe's interval (1998, method 10), of the two Wilson intervals.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import hypot
from typing import Any

from paper.figure import ratio
from paper.motions import CUBE
from paper.rows import FAITHFUL, MOVED_NO_NETWORK, NO_NETWORK, ONE, OURS, UNGUIDED
from paper.table import MISSING, Results, Where, dated, shown, table

from apex_ompl.problems.alignment import SIZES

Cell = Mapping[str, Any]
UNDECIDED = "not decided"
LARGEST = "huge"


@dataclass(frozen=True)
class Scene:
    """A kind of scene in which the paper claims that guidance helps.

    Attributes:
        name: What the cubes do, for tables.
        what: The same, for sentences.
        figure: The command that measures it.
        before: Keys of its cells, before the name of the size.
        labels: Rows: guided, unguided, apex with and without its network.
        paper: The paper's failure ratios of the largest, guided and unguided [%].
    """

    name: str
    what: str
    figure: str
    before: Where
    labels: tuple[str, str, str, str]
    paper: tuple[float, float]

    def cell(self, results: Results, size: str, row: int) -> Cell | None:
        """Return the numbers of a row among cubes of a size, where they are measured."""
        *keys, last = self.before
        return known(results.entry((*keys, f"{last}{size}, {self.labels[row]}")))


IN_LOOP = (FAITHFUL, UNGUIDED, OURS, MOVED_NO_NETWORK)
SCENES = (
    Scene("standing", "standing cubes", "size", ("size", "both/"),
          (f"{FAITHFUL}{ONE}", f"{UNGUIDED}{ONE}", OURS, NO_NETWORK), (6.56, 67.19)),
    Scene("brought in", "cubes that are brought in and stand", "imposed", ("imposed", "sizes", ""),
          IN_LOOP, (9.36, 98.45)),
    Scene("passing", "cubes that pass whatever the robot does", "dynamic", ("dynamic", "sizes", ""), IN_LOOP,
          (9.36, 98.45)),
)  # fmt: skip
"""In the order of the sentences. The paper does not say which of the last two its moving obstacles are."""


def order(first: Cell, second: Cell) -> str:
    """Return whether the first failure ratio is ``lower`` or ``higher`` than the second, or ``UNDECIDED``."""
    if first["interval"][1] < second["interval"][0]:
        return "lower"
    return "higher" if first["interval"][0] > second["interval"][1] else UNDECIDED


def known(entry: Cell | None) -> Cell | None:
    """Return the numbers of a row where it was measured."""
    return entry if entry is not None and "interval" in entry else None


def told(first: Cell | None, second: Cell | None) -> str:
    """Return the order of two rows, or nothing where one is not measured."""
    one, other = known(first), known(second)
    return "" if one is None or other is None else order(one, other)


def difference(first: Cell, second: Cell) -> tuple[float, float, float]:
    """Return by how many points the second failure ratio is larger than the first, and Newcombe's 95 % interval."""
    (low, high), (least, most) = first["interval"], second["interval"]
    by = second["R_f"] - first["R_f"]
    under = hypot(second["R_f"] - least, high - first["R_f"])
    over = hypot(most - second["R_f"], first["R_f"] - low)
    return by, by - under, by + over


def sentences(results: Results) -> list[str]:
    """Return the five sentences."""
    return [*(guidance(results, scene) for scene in SCENES), where(results), ours(results)]


def guidance(results: Results, scene: Scene) -> str:
    """Return the sentence on what guidance does among the largest cubes of a kind."""
    title = f"**Largest {scene.what}{', one sample' if scene.labels[0].endswith(ONE) else ''}**"
    guided, unguided = (scene.cell(results, LARGEST, row) for row in (0, 1))
    if guided is None or unguided is None:
        return f"{title}: {unmeasured(scene)}."
    by, low, high = difference(guided, unguided)
    found = order(guided, unguided)
    says = {"lower": "guidance works", "higher": "guidance harms", UNDECIDED: f"{UNDECIDED} whether guidance works"}
    claim = scene.paper[0]
    least, most = guided["interval"]
    beside = "above" if least > claim else "below" if most < claim else "not told apart from"
    cubes = guided.get("causes", {}).get(CUBE)
    first = "" if cubes is None else f" ({share(guided, cubes)} % of all meet a cube first)"
    ratios = f"R_f is {of(guided)} guided{first} and {of(unguided)} unguided"
    return (
        f"{title}: {says[found]}, {ratios}, a difference of {by:.0f} "
        f"points ({low:.0f} to {high:.0f}); the paper has {claim} and {scene.paper[1]} %, and guided R_f is {beside} "
        "the paper's."
    )


def where(results: Results) -> str:
    """Return the sentence on the sizes at which guidance helps."""
    parts = []
    for scene in SCENES:
        by_order: dict[str, list[str]] = {}
        for size, edge in SIZES.items():
            found = told(scene.cell(results, size, 0), scene.cell(results, size, 1)) or MISSING
            by_order.setdefault(found, []).append(f"{100 * edge:.0f}")
        says = {"lower": "it helps at", "higher": "it harms at", UNDECIDED: f"{UNDECIDED} at", MISSING: f"{MISSING} at"}
        sizes = ", ".join(f"{says[key]} {', '.join(some)} cm" for key, some in by_order.items())
        parts.append(f"among {scene.what}, {sizes}")
    return f"**Where guidance helps**: {'; '.join(parts)}."


def ours(results: Results) -> str:
    """Return the sentence on this planner, with and without its network, beside the guided samples."""
    parts = []
    for scene in SCENES:
        guided, own, bare = (scene.cell(results, LARGEST, row) for row in (0, 2, 3))
        if guided is None or own is None:
            parts.append(f"among {scene.what} {unmeasured(scene)}")
            continue
        beside = {"lower": "less than", "higher": "more than", UNDECIDED: f"{UNDECIDED} whether less than"}
        text = (
            f"among the largest {scene.what}, it fails in {of(own)}, {beside[order(own, guided)]} guided `{FAITHFUL}`"
        )
        if bare is not None:
            says = {"lower": "the network helps", "higher": "the network harms",
                    UNDECIDED: f"{UNDECIDED} whether the network helps"}  # fmt: skip
            text += f", and without its network in {of(bare)}: {says[order(own, bare)]}"
        parts.append(text)
    return f"**This planner, `{OURS}`**: {'; '.join(parts)}."


def of(cell: Cell) -> str:
    """Return a failure ratio with its interval and N."""
    low, high = cell["interval"]
    return f"{cell['R_f']:.1f} % ({low:.1f} to {high:.1f}, N {cell['N']})"


def share(cell: Cell, count: int) -> str:
    """Return the share of a row's runs that ``count`` of them are, with its interval."""
    part = ratio([False] * count + [True] * (cell["N"] - count))
    low, high = part["interval"]
    return f"{part['R_f']:.1f} ({low:.1f} to {high:.1f})"


def causes(results: Results) -> str:
    """Return the table of what samples and runs of the paper's system among the largest cubes fail by."""
    rows = []
    for scene in SCENES:
        for row, how in enumerate(("guided", "unguided")):
            cell = scene.cell(results, LARGEST, row)
            if cell is None or "causes" not in cell:
                continue
            shares = [f"{name} {share(cell, count)}" for name, count in cell["causes"].items()]
            rows.append([scene.name, how, shown(cell, "R_f"), f"{cell['N']}{dated(cell)}", "; ".join(shares) or "-"])
    return table(["largest cubes", "`apex-paper`", "R_f %", "N", "of these by cause (% of N)"], rows)


def unmeasured(scene: Scene) -> str:
    """Return that a scene is not measured, and what measures it."""
    return f"{MISSING} (`python scripts/reproduce.py {scene.figure}`)"


def by_size(results: Results) -> str:
    """Return the table of what guidance does over the size of cubes, and of apex with and without its network."""
    head = ["cubes", "edge cm", "guided R_f %", "N", "unguided R_f %", "N", "difference (95 %)", "order",
            "`apex` R_f %", "N", "without its network", "N"]  # fmt: skip
    rows: list[Sequence[str]] = []
    for scene in SCENES:
        for size, edge in SIZES.items():
            found = [scene.cell(results, size, row) for row in range(4)]
            numbers = [
                text for cell in found for text in (shown(cell, "R_f"), f"{cell['N']}{dated(cell)}" if cell else "")
            ]
            points, says = MISSING, told(found[0], found[1])
            if found[0] is not None and found[1] is not None:
                by, low, high = difference(found[0], found[1])
                points = f"{by:.1f} ({low:.1f} to {high:.1f})"
            says = {"lower": "guided is lower", "higher": "guided is higher"}.get(says, says)
            rows.append([scene.name, f"{100 * edge:.0f}", *numbers[:4], points, says, *numbers[4:]])
    return table(head, rows)
