"""Controls of the model as planners, and the suite that is for validation alone in benchmarks."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from models import kernel, query
from support import DATA, ROOT, benchmark_script

from apex_ompl import load_model, plan, planners, problems
from apex_ompl.errors import ParameterError
from apex_ompl.evaluation.rows import Row, jobs

NAMES = ("random weights", "shuffled conditions", "nearest paths")


@pytest.fixture(scope="module")
def controls() -> Iterator[ModuleType]:
    """The module, with few training paths."""
    if not (ROOT / "benchmarks").is_dir():
        pytest.skip("there are no benchmarks")
    found = benchmark_script("lib.control_planners")
    before, found.DATA = found.DATA, DATA
    yield found
    found.DATA = before


@pytest.mark.parametrize("name", NAMES)
def test_controls_plan(controls: ModuleType, name: str) -> None:
    result = plan(problems.load("shelf/easy/800001"), name, timeout=20.0, seed=1, params={"sprint": 0})
    assert result


def test_proposals_are_others_with_the_right_ends(controls: ModuleType) -> None:
    apex, asked = load_model("apex"), [query(1), query(2)]
    made = {name: planners.parameters(name).replaced(apex) for name in NAMES} | {"apex": apex}
    found = {n: m.propose(asked, kernel(), 5, generator=np.random.default_rng(0)).control for n, m in made.items()}
    limits = kernel().robot.arrays
    for name, control in found.items():
        assert control.shape == (10, 14, 16)
        for k, mine in enumerate(asked):
            some = control[5 * k : 5 * k + 5]
            assert np.array_equal(some[:, 0], np.tile(mine.start, (5, 1))), name
            assert np.array_equal(some[:, -1], np.tile(mine.goal, (5, 1))), name
            assert np.ptp(some, axis=0).max() > 1e-2
        assert (control >= limits.lower).all() and (control <= limits.upper).all()
    again = made["nearest paths"].propose(asked, kernel(), 5, generator=np.random.default_rng(0)).control
    assert np.array_equal(again, found["nearest paths"])
    spread = [np.abs(found[a] - found[b]).max() for a in found for b in found if a < b]
    assert min(spread) > 0.05


def test_the_suite_for_validation_is_benchmarked_on_its_split_alone() -> None:
    options: dict = {"runs": 2, "timeout": 1.0, "seed": 0, "simplify": True}
    found = jobs(["unseen/net"], [Row("apex", "apex")], split="validation", **options)
    assert [job.problem for job in found] == ["unseen/net/800000", "unseen/net/800001"]
    for split in ("test", "train"):
        with pytest.raises(ParameterError, match=r"split: expected validation, the only one of unseen"):
            jobs(["unseen"], [Row("apex", "apex")], split=split, **options)


def test_a_checkpoint_stands_beside_the_one_that_ships(controls: ModuleType, tmp_path: Path) -> None:
    unseen = benchmark_script("planners.unseen")
    folder = ROOT / "apex_ompl" / "model" / "checkpoints" / "apex"
    labels = [row.label for row in unseen.rows(unseen.NAMES, folder)]
    assert len(set(labels)) == len(labels) == len(unseen.NAMES) + 1
    assert [row.label for row in unseen.rows(unseen.NAMES, None)] == list(unseen.NAMES)
