"""The verdict of the paper's page: intervals, orders, and sentences that follow the results."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest
from support import ROOT

sys.path += [str(ROOT / "scripts"), str(ROOT)]

from paper import figure, motions, page, table, verdict  # noqa: E402

from apex_ompl.collision.path_proof import PathProof  # noqa: E402
from apex_ompl.ompl.validity import FullCheck  # noqa: E402
from apex_ompl.problems.alignment import SIZES  # noqa: E402


def cell(failed: int, of: int) -> dict[str, Any]:
    """Return the numbers of a row with so many failures."""
    return figure.ratio([False] * failed + [True] * (of - failed))


@pytest.mark.parametrize(
    "first, second, low, high",
    [  # table II, method 10, of Newcombe (1998), Statistics in Medicine 17, 873-890
        ((56, 70), (48, 80), 5.24, 33.39),
        ((9, 10), (3, 10), 17.05, 80.90),
        ((6, 7), (2, 7), 5.82, 80.62),
        ((5, 56), (0, 29), -3.81, 19.26),
        ((0, 10), (0, 20), -16.11, 27.75),
        ((10, 10), (0, 10), 60.75, 100.0),
    ],
)
def test_differences_have_the_intervals_that_newcombe_printed(
    first: tuple[int, int], second: tuple[int, int], low: float, high: float
) -> None:
    by, least, most = verdict.difference(cell(*second), cell(*first))
    assert by == pytest.approx(100 * (first[0] / first[1] - second[0] / second[1]))
    assert (least, most) == pytest.approx((low, high), abs=0.006)


COUNTS = st.integers(1, 300).flatmap(lambda of: st.tuples(st.integers(0, of), st.just(of)))


@given(first=COUNTS, second=COUNTS)
def test_an_order_is_decided_where_intervals_do_not_meet(first: tuple[int, int], second: tuple[int, int]) -> None:
    a, b = cell(*first), cell(*second)
    found = verdict.order(a, b)
    assert verdict.order(b, a) == {"lower": "higher", "higher": "lower"}.get(found, found)
    meet = max(a["interval"][0], b["interval"][0]) <= min(a["interval"][1], b["interval"][1])
    assert (found == verdict.UNDECIDED) == meet
    if found == "lower":
        assert first[0] * second[1] < second[0] * first[1] and verdict.difference(a, b)[1] > 0.0


class Made(table.Results):
    """Results that were never written."""

    def __init__(self, cells: dict[tuple[str, ...], dict[str, Any]]) -> None:
        """Take entries by their keys."""
        self.folder, self.found = Path(), {}
        for keys, value in cells.items():
            inner = self.found
            for key in keys[:-1]:
                inner = inner.setdefault(key, {})
            inner[keys[-1]] = value


def standing(guided: dict[str, Any], unguided: dict[str, Any], size: str = "huge") -> dict[tuple[str, ...], Any]:
    """Return cells of standing cubes of a size."""
    return {
        ("size", f"both/{size}, apex-paper, one sample"): guided,
        ("size", f"both/{size}, apex-paper, unguided, one sample"): unguided,
    }


@pytest.mark.parametrize(
    "guided, unguided, says, beside",
    [
        ((30, 300), (200, 300), "guidance works, R_f is 10.0 %", "above"),
        ((200, 300), (30, 300), "guidance harms, R_f is 66.7 %", "above"),
        ((20, 300), (200, 300), "guidance works, R_f is 6.7 %", "not told apart from"),
        ((3, 300), (200, 300), "guidance works, R_f is 1.0 %", "below"),
        ((2, 4), (3, 4), "not decided whether guidance works, R_f is 50.0 %", "above"),
    ],
)
def test_a_sentence_says_what_the_intervals_decide(
    guided: tuple[int, int], unguided: tuple[int, int], says: str, beside: str
) -> None:
    told = verdict.sentences(Made(standing(cell(*guided), cell(*unguided))))
    assert len(told) == 5 and says in told[0] and f"guided R_f is {beside} the paper's" in told[0]
    assert "6.56 and 67.19 %" in told[0] and f"N {guided[1]}" in told[0]
    for sentence, command in zip(told[1:3], ("imposed", "dynamic"), strict=True):
        assert f"not measured yet (`python scripts/reproduce.py {command}`)" in sentence


def test_the_sentence_of_sizes_and_that_of_apex_follow_their_cells() -> None:
    cells = standing(cell(5, 100), cell(80, 100), "small") | standing(cell(50, 100), cell(60, 100), "huge")
    cells |= {("size", "both/huge, apex"): cell(0, 200), ("size", "both/huge, apex, no network"): cell(40, 200)}
    told = verdict.sentences(Made(cells))
    assert "among standing cubes, it helps at 6 cm, not measured yet at 10, 15, 20 cm, not decided at 30 cm;" in told[3]
    assert "less than guided `apex-paper`, and without its network in 20.0 %" in told[4]
    assert "the network helps" in told[4] and "whether the network helps" not in told[4]
    lines = verdict.by_size(Made(cells)).splitlines()
    assert len(lines) == 2 + len(verdict.SCENES) * len(SIZES)
    assert "| standing | 6 | 5.0 (" in lines[2] and "| guided is lower |" in lines[2] and "not decided" in lines[6]
    assert lines[7].count(table.MISSING) == 5


def test_what_samples_fail_by_has_shares_of_all_runs() -> None:
    guided = cell(40, 300) | {"causes": {"itself": 23, "cube": 17}}
    told = Made(standing(guided, cell(290, 300) | {"causes": {"cube": 290}}))
    first, second = verdict.causes(told).splitlines()[2:]
    low, high = (100 * end for end in binomtest(17, 300).proportion_ci(method="wilson"))
    assert f"cube 5.7 ({low:.1f} to {high:.1f})" in first and first.startswith("| standing | guided | 13.3 (")
    assert "| unguided |" in second and "itself" not in second
    assert f"5.7 ({low:.1f} to {high:.1f}) % of all meet a cube first)" in verdict.sentences(told)[0]
    assert verdict.causes(Made(standing(cell(1, 9), cell(1, 9)))).count("\n") == 1, "they did not tell their causes"


@pytest.mark.parametrize(
    "ok, pair, said",
    [(True, ("cube_0", "palm"), ""), (False, None, "limits"), (False, ("palm", "cube_0"), "cube"),
     (False, ("cube_1", "palm"), "itself")],
)  # fmt: skip
def test_a_sample_fails_by_what_it_meets_first(ok: bool, pair: tuple[str, str] | None, said: str) -> None:
    proof = None if pair is None else PathProof(ok, "", 0.0, np.zeros(1), 0.0, 0.0, pair, 0.0, 1)
    assert motions.cause(FullCheck(ok, "", 0, proof), ["cube_0"]) == said


def test_what_was_never_trained_is_said() -> None:
    key = ("size", "both/huge, apex-paper-sizes, one sample")
    text = page.entries(Made({key: {"why": "not trained"}}))
    (line,) = [line for line in text.splitlines() if "told sizes, guided" in line]
    assert "| not trained |" in line


def test_cells_with_more_runs_stay_until_the_new_ones_are_more() -> None:
    about = {"date": "2026-11-26", "run_commits": "abc"}
    old = {"about": about, "notes": [], "cost": {"runs": 1}, "many": cell(1, 16), "few": cell(1, 4),
           "sizes": {"gone": cell(0, 6) | {"earlier": "2026-11-20, commits x"}}, "text": "old"}  # fmt: skip
    new = {"cost": {"runs": 2}, "many": cell(0, 8), "few": cell(0, 8), "sizes": {}, "untrained": {"why": "not trained"}}
    found = figure.with_older(new, old)
    assert found.keys() == {"cost", "many", "few", "sizes", "untrained"} and found["cost"] == {"runs": 2}
    assert found["few"] == cell(0, 8) and found["untrained"] == new["untrained"]
    assert found["many"] == cell(1, 16) | {"earlier": "2026-11-26, commits abc"}
    assert found["sizes"]["gone"]["earlier"] == "2026-11-20, commits x", "it keeps its date"
    assert page.count(found["many"], found["few"]) == "16 (2026-11-26), 8"
