"""Look-ups in tables of clearances: cells and boxes of cells, by brute force."""

from __future__ import annotations

import numpy as np
import pytest
from random_robots import random_robot

from apex_ompl.kernel.arrays import pack
from apex_ompl.kernel.clearance_table import UNIT, ClearanceTable, table_arrays
from apex_ompl.kernel.compiled.arrays import robot_view
from apex_ompl.kernel.compiled.check.clearance_table import ACROSS, clearance_of_box, clearance_of_cell
from apex_ompl.kernel.compiled.jit import uncached

DOF, SIZES = 4, {1: 64, 2: 32, 3: 16}


@uncached
def look_up(ri, rf, k, states, half, cells, boxes):  # type: ignore[no-untyped-def] # noqa: PLR0917
    """Put bounds of pair ``k`` at states, and over boxes around them, into place."""
    t = robot_view(ri, rf)
    for n in range(len(states)):
        cells[n] = clearance_of_cell(t, k, states[n])
        boxes[n] = clearance_of_box(t, k, states[n], half[n])


def random_table(rng: np.random.Generator, axes: int) -> ClearanceTable:
    joints = tuple(f"q{k}" for k in rng.permutation(DOF)[:axes])
    lower, upper = rng.uniform(-2.0, -1.0, axes), rng.uniform(0.5, 2.0, axes)
    cells = rng.integers(0, 256, (SIZES[axes],) * axes).astype(np.uint8)
    cells[rng.random(cells.shape) < 0.002] = 0
    return ClearanceTable(joints, lower, upper, np.maximum(cells, rng.integers(0, 60)).astype(np.uint8))


def bounds(
    tables: list[ClearanceTable | None], k: int, states: np.ndarray, half: np.ndarray, continuous: tuple[int, ...] = ()
) -> np.ndarray:
    """Bounds of the kernel for pair ``k`` at states and over boxes, shape (N, 2), in units of the tables."""
    names = [f"q{n}" for n in range(DOF)]
    arrays = random_robot(0, dof=DOF)[0].arrays._replace(**table_arrays(tables, names))
    arrays.continuous[list(continuous)] = 1
    cells, boxes = np.empty(len(states)), np.empty(len(states))
    look_up(*pack(arrays), k, states, half, cells, boxes)
    return np.rint(np.stack([cells, boxes], axis=1) / UNIT).astype(int)


@pytest.mark.parametrize("axes", [1, 2, 3])
def test_a_box_gets_no_more_than_the_least_of_its_cells(axes: int) -> None:
    rng = np.random.default_rng(axes)
    tables = [None, random_table(rng, 2), random_table(rng, axes), None, random_table(rng, 1)]
    table, n = tables[2], SIZES[axes]
    assert table is not None
    joints = [int(name[1:]) for name in table.joints]
    width = (table.upper - table.lower) / n
    half = rng.uniform(0.0, 1.0, (500, DOF)) * rng.choice([0.0, 0.05, 0.3, 1.0], (500, 1))
    states = rng.uniform(-2.0, 2.0, (500, DOF))
    found = bounds(tables, 2, states, half)
    inside = exact = 0
    for q, h, (cell, box) in zip(states[:, joints], half[:, joints], found, strict=True):
        at = np.floor((q - table.lower) / width).astype(int)
        assert cell == (table.cells[tuple(at)] if (at >= 0).all() and (at < n).all() else 0)
        low, high = (np.floor((x - table.lower) / width).astype(int) for x in (q - h, q + h))
        if (low < 0).any() or (high >= n).any():
            assert box == 0
            continue
        least = table.cells[tuple(slice(a, b + 1) for a, b in zip(low, high, strict=True))].min()
        assert box <= least
        inside += 1
        if (high - low < ACROSS).all():
            assert box == least
            exact += 1
    assert inside > 100
    assert exact > 50


@pytest.mark.parametrize("axes", [1, 2, 3])
def test_cells_of_continuous_joints_repeat_after_a_turn(axes: int) -> None:
    rng = np.random.default_rng(axes)
    table, n, turn = random_table(rng, axes), SIZES[axes], 2.0 * np.pi
    joints = [int(name[1:]) for name in table.joints]
    table.lower[0], table.upper[0] = -np.pi, np.pi
    width = (table.upper - table.lower) / n
    states = rng.uniform(-2.0, 2.0, (400, DOF))
    states[:, joints[0]] = rng.uniform(-300.0, 300.0, 400)
    half = rng.uniform(0.0, 0.3, (400, DOF)) * rng.choice([0.0, 0.2, 1.0], (400, 1))
    half[::7, joints[0]] = rng.uniform(3.0, 30.0, len(half[::7]))
    half[3, joints[0]], states[5, joints[0]] = np.inf, np.nan
    found = bounds([table], 0, states, half, (joints[0],))
    assert found[3, 1] == 0
    assert not found[5].any()
    inside = exact = 0
    for k in (k for k in range(400) if k not in (3, 5)):
        q, h, (cell, box) = states[k, joints], half[k, joints], found[k]
        low, at, high = (np.floor((x - table.lower) / width).astype(int) for x in (q - h, q, q + h))
        if (at[1:] < 0).any() or (at[1:] >= n).any():
            assert cell == 0
            continue
        assert cell == table.cells[tuple(np.append(at[0] % n, at[1:]))]
        if (low[1:] < 0).any() or (high[1:] >= n).any():
            assert box == 0
            continue
        rows = np.arange(low[0], high[0] + 1) % n
        least = table.cells[np.ix_(rows, *(np.arange(a, b + 1) for a, b in zip(low[1:], high[1:], strict=True)))].min()
        assert box <= least
        inside += 1
        if (high - low < ACROSS).all():
            assert box == least
            exact += 1
    assert inside > 100
    assert exact > 30
    again = states.copy()
    again[:, joints[0]] += turn * rng.integers(-9, 10, 400)
    at = (states[:, joints[0]] + np.pi) / width[0] % 1.0
    clear = (at > 1e-6) & (at < 1.0 - 1e-6)  # of borders of cells, in spite of rounding
    assert np.array_equal(bounds([table], 0, again, np.zeros_like(half), (joints[0],))[clear, 0], found[clear, 0])


def test_what_is_no_number_is_not_proved() -> None:
    table = random_table(np.random.default_rng(0), 2)
    states = np.zeros((2, DOF))
    states[0, int(table.joints[1][1:])], states[1, int(table.joints[0][1:])] = np.nan, np.inf
    assert not bounds([table], 0, states, np.zeros((2, DOF))).any()


def test_larger_cells_hold_the_least_of_those_that_they_consist_of() -> None:
    table = random_table(np.random.default_rng(5), 2)
    levels = table.levels()
    assert [len(level) for level in levels] == [32, 16, 8, 4, 2, 1]
    for fine, coarse in zip(levels[:-1], levels[1:], strict=True):
        np.testing.assert_array_equal(coarse, fine.reshape(len(coarse), 2, len(coarse), 2).min(axis=(1, 3)))
    assert levels[-1].item() == table.cells.min()
    assert table.proved == (table.cells > 0).mean()
