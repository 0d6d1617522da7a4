"""Matrix products and solutions in a fixed order, against NumPy's."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import ROOT

from apex_ompl.kernel.products import cholesky, product, solve

SHAPES = [
    ((3, 4), (4, 5)),
    ((1, 1), (1, 1)),
    ((0, 3), (3, 3)),
    ((3, 0), (0, 2)),
    ((2, 6, 3, 4), (4, 5)),
    ((4, 3), (7, 3, 2)),
    ((5, 2, 3), (5, 3, 2)),
    ((5, 2, 3), (1, 3, 2)),
    ((0, 2, 3), (0, 3, 1)),
    ((2, 1, 2, 3), (4, 3, 2)),
]


@pytest.mark.parametrize("first, second", SHAPES)
def test_products_are_those_of_numpy(first: tuple[int, ...], second: tuple[int, ...]) -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=first), rng.normal(size=second)
    found = product(a, b)
    assert found.shape == (a @ b).shape and np.allclose(found, a @ b, rtol=1e-14, atol=1e-14)
    turned = product(a.swapaxes(-1, -2).copy().swapaxes(-1, -2), np.asfortranarray(b))
    assert np.array_equal(found, turned)


@pytest.mark.parametrize("shapes", [((3, 4), (3, 5)), ((2, 3, 4), (2, 3, 5)), ((2, 3, 4), (3, 4, 5))])
def test_shapes_that_do_not_fit_are_refused(shapes: tuple[tuple[int, ...], ...]) -> None:
    with pytest.raises(ValueError):
        product(*map(np.zeros, shapes))


def test_products_of_single_precision_are_taken_in_double() -> None:
    a = np.random.default_rng(0).normal(size=(3, 64)).astype(np.float32)
    assert np.allclose(product(a, a.T), a.astype(float) @ a.T.astype(float), rtol=1e-14)


@given(st.integers(1, 20), st.integers(0, 4), st.integers(0, 2**32 - 1))
def test_solutions_are_those_of_lapack(n: int, columns: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    half = rng.normal(size=(n, n + 3))
    matrix, right = half @ half.T + 0.1 * np.eye(n), rng.normal(size=(n, columns))
    factor = cholesky(matrix)
    assert np.allclose(factor, np.linalg.cholesky(matrix), rtol=1e-9, atol=1e-12)
    assert np.allclose(solve(factor, right), np.linalg.solve(matrix, right), rtol=1e-6, atol=1e-9)


PLAN = """
import hashlib, sys
import numpy as np
from apex_ompl import plan
for name in ("shelf/hard/800000", "cage/medium/800000", "ball_in_cup"):
    print(hashlib.sha256(np.asarray(plan(name, seed=1, timeout=60.0).path).tobytes()).hexdigest())
"""


def test_a_seed_gives_the_same_path_on_all_processors(tmp_path: Path) -> None:
    """OpenBLAS and NumPy choose their code by the processor, and can be told to take it for an older one.

    Tables of the robot are made on each.
    """
    older = {"OPENBLAS_CORETYPE": "Nehalem", "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL"}
    found = []
    for name, environment in {"this": {}, "older": older}.items():
        env = os.environ | {"PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(tmp_path / name)} | environment
        command = [sys.executable, "-c", PLAN]
        done = subprocess.run(command, check=False, env=env, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
        found.append(done.stdout)
    assert found[0] == found[1] and len(found[0].split()) == 3
