"""Cosines and sines of joint values, several at once."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from apex_ompl.kernel.compiled.jit import uncached
from apex_ompl.kernel.compiled.packet.sincos import MOST, TOGETHER, set_sines


@uncached
def call(angles, count, cosines, sines):  # type: ignore[no-untyped-def]
    """Call it."""
    set_sines(angles, count, cosines, sines)


def found(angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return cosines and sines of some angles."""
    room = -(-len(angles) // TOGETHER) * TOGETHER
    buffers = np.full((3, room), np.inf)
    buffers[0, : len(angles)] = angles
    call(buffers[0], len(angles), buffers[1], buffers[2])
    return buffers[1, : len(angles)], buffers[2, : len(angles)]


@given(st.lists(st.floats(-1.1 * MOST, 1.1 * MOST), min_size=1, max_size=3 * TOGETHER))
def test_sines_are_those_of_the_library_in_extended_precision(angles: list[float]) -> None:
    cosines, sines = found(np.array(angles))
    exact = np.array(angles, np.longdouble)
    for mine, true in ((cosines, np.cos(exact)), (sines, np.sin(exact))):
        assert (np.abs(mine - true) <= np.maximum(2.5 * np.spacing(np.abs(true.astype(float))), 1e-20)).all()
        assert (np.abs(mine) <= 1.0).all()


@pytest.mark.parametrize("quarter", range(-9, 10))
def test_sines_at_whole_quarters(quarter: int) -> None:
    at = quarter * np.pi / 2
    near = np.array([np.nextafter(at, -np.inf), at, np.nextafter(at, np.inf)])
    cosines, sines = found(near)
    np.testing.assert_allclose(cosines, np.cos(near), rtol=0.0, atol=2e-16)
    np.testing.assert_allclose(sines, np.sin(near), rtol=0.0, atol=2e-16)


def test_what_is_no_angle_gives_no_number() -> None:
    for no_angle in (np.nan, np.inf, -np.inf):
        cosines, sines = found(np.array([no_angle, 0.5]))
        assert np.isnan(cosines[0]) and np.isnan(sines[0])
        np.testing.assert_allclose((cosines[1], sines[1]), (np.cos(0.5), np.sin(0.5)), rtol=1e-15)
