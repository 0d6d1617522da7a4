from __future__ import annotations

import argparse
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
import torch

from apex_ompl.errors import ParameterError, UnknownNameError
from apex_ompl.util import validation as v
from apex_ompl.util.arrays import distinct, is_masked_array
from apex_ompl.util.cache import kept

MASKED = np.ma.masked_array([1.0, 2.0], mask=[True, False])


@pytest.mark.parametrize(
    ("check", "message"),
    [
        (lambda: v.check_number(-1.0, "x", 0.0), "x: expected a number, 0 or more, got -1.0"),
        (lambda: v.check_number(2, "x", 0.0, 1.0), "x: expected a number from 0 to 1, got 2"),
        (lambda: v.check_number(float("inf"), "x"), "x: expected a number, got inf"),
        (lambda: v.check_number(10**400, "x", 0.0, 1.0), "x: expected a number from 0 to 1, got 1000"),
        (lambda: v.check_number(10**400, "x"), "x: expected a number, got 1000"),
        (lambda: v.check_positive(10**5000, "x"), "x: expected a positive number, got <int object"),
        (lambda: v.check_flag("yes", "f"), "f: expected True or False, got 'yes'"),
        (lambda: v.check_positive(0.0, "x"), "x: expected a positive number, got 0.0"),
        (
            lambda: v.check_positive("1", "x", "a positive number of seconds"),
            "x: expected a positive number of seconds",
        ),
        (lambda: v.check_integer(True, "n"), "n: expected a whole number, 0 or more, got True"),
        (lambda: v.check_integer(4, "n", 1, 3), "n: expected a whole number from 1 to 3, got 4"),
        (lambda: v.check_seed(2**31), "seed: expected a whole number from 0 to 2147483647, got 2147483648"),
        (lambda: v.finite_array([1.0, np.nan], "q"), "q: expected finite numbers, got nan"),
        (lambda: v.finite_array("abc", "q"), "q: expected finite numbers, got 'abc'"),
        (lambda: v.finite_array("1.5", "q"), "q: expected finite numbers, got '1.5'"),
        (lambda: v.finite_array(["1", 2.0], "q"), "q: expected finite numbers, got ['1', 2.0]"),
        (lambda: v.finite_array([1.0, 1j], "q"), "q: expected finite numbers, got [1.0, 1j]"),
        (lambda: v.finite_array([True, False], "q"), "q: expected finite numbers, got [True, False]"),
        (lambda: v.finite_array([[1.0, 2.0], [1.0]], "q"), "q: expected finite numbers, got [[1.0, 2.0], [1.0]]"),
        (lambda: v.finite_array(np.array([object()]), "q"), "q: expected finite numbers, got array"),
        (lambda: v.number_array(np.array(["1"], object), "q"), "q: expected numbers, got array"),
        (lambda: v.number_array([10**400], "q"), "q: expected numbers, got [1000"),
        (lambda: v.number_array(MASKED, "q"), "q: expected numbers, none of them masked, got masked_array"),
        (lambda: v.number_array([MASKED, MASKED], "q"), "q: expected numbers, none of them masked, got [masked"),
        (
            lambda: v.number_array([0.0, np.ma.masked], "q"),
            "q: expected numbers, none of them masked, got [0.0, masked]",
        ),
        (lambda: v.number_array(torch.ones(2, requires_grad=True), "q"), "q: expected numbers without a gradient, got"),
        (lambda: v.rigid_pose(np.eye(3), "pose"), "pose: expected an array of shape (4, 4), got (3, 3)"),
        (lambda: v.rigid_pose(np.diag([1, 1, 2, 1]), "pose"), "pose: expected a rigid pose, whose 3 x 3 part is a rot"),
        (
            lambda: v.rigid_pose(np.diag([1, 1, -1, 1]), "pose"),
            "pose: expected a rigid pose, whose 3 x 3 part is a rot",
        ),
        (lambda: v.rigid_pose(np.ones((4, 4)), "pose"), "pose: expected a rigid pose, whose last row is 0 0 0 1, got"),
        (lambda: v.check_nonnegative([0.0, -1.0], "d"), "d: expected a number, 0 or more, got"),
        (lambda: v.check_indices([0, 3], 3, "fixed", "joints"), "fixed: expected numbers of joints, 0 to 2, got"),
        (lambda: v.check_array(np.zeros(2), (3,), "q"), "q: expected an array of shape (3,), got (2,)"),
        (lambda: v.check_states(np.zeros((2, 3)), 4), "states: expected an array of shape (N, 4), got (2, 3)"),
        (lambda: v.check_states(np.zeros((0, 4)), 4, "path", least=1), "shape (N, 4), N at least 1, got (0, 4)"),
        (lambda: v.check_path(np.zeros((1, 4))), "finite numbers of shape (N, dof), N at least 2, got (1, 4)"),
        (lambda: v.check_path([[0.0], [np.inf]]), "finite numbers of shape (N, dof), N at least 2, got inf"),
        (lambda: v.check_path([[0.0], [None]]), "path: expected numbers, got [[0.0], [None]]"),
        (lambda: v.finite_array(None, "goal"), "goal: expected finite numbers, got None"),
        (lambda: v.check_times(np.array([0.0, 1.0, 1.0])), "times: expected times that start at 0 and increase"),
        (lambda: v.check_times(np.array([0.0, 1.0]), 3), "times: expected finite numbers of shape (3,)"),
    ],
)
def test_the_error_names_the_value_and_what_was_expected(check: Callable[[], object], message: str) -> None:
    with pytest.raises(ParameterError) as error:
        check()
    assert message in str(error.value)


@pytest.mark.parametrize("name", ["mouse", 5, None, ["cat"], {}, np.array(["cat", "dog"])])
def test_names_are_texts_and_known(name: Any) -> None:
    assert v.check_name("cat", "animal", {"cat": 1, "dog": 2}) == "cat"
    with pytest.raises(UnknownNameError, match="unknown animal .*; known: cat, dog"):
        v.check_name(name, "animal", ("cat", "dog"))


def test_good_values_pass() -> None:
    assert v.check_flag(np.True_, "f") is True
    v.check_options({"a": 1}, ("a", "b"))
    v.check_number(np.float32(0.5), "x", 0.0, 1.0)
    v.check_positive(np.int64(3), "x")
    assert type(v.check_integer(np.int64(3), "n", 3, 3)) is int
    v.check_nonnegative([0.0, np.inf], "d")
    v.check_indices(np.array([0, 2]), 3, "fixed", "joints")
    v.check_array(np.zeros((5, 14, 16)), ("B", 14, 16), "control points", finite=True)
    v.check_times(np.array([0.0, 0.1]), 2)
    assert v.check_path([[0, 1], [2, 3]]).dtype == float
    given = np.array([1.0, np.nan])
    assert v.number_array(given, "q") is given and v.finite_array(given[:1], "q") is not given
    for numbers in ((1, 2.0), [np.float32(1), Fraction(2)], np.arange(1, 3), torch.tensor([1, 2])):
        assert v.number_array(numbers, "q").tolist() == [1.0, 2.0]
    assert v.number_array(np.ma.masked_array([1.0, 2.0]), "q").tolist() == [1.0, 2.0], "nothing is masked"
    turn = np.eye(4, dtype=np.float32)
    turn[:2, :2] = [[np.cos(1), -np.sin(1)], [np.sin(1), np.cos(1)]]
    assert v.rigid_pose(turn, "pose").dtype == float


@pytest.mark.parametrize("text", ["-1", "1.5", "2147483648", "x", ""])
def test_integers_on_a_command_line(text: str) -> None:
    for read in (v.whole_number, v.one_or_more):
        with pytest.raises(argparse.ArgumentTypeError, match="expected a whole number"):
            read(text)
    assert v.whole_number("0") == 0 and v.one_or_more("7") == 7


def test_results_are_kept_up_to_a_number_and_the_oldest_are_dropped() -> None:
    made: list[str] = []
    results: dict[str, str] = {}
    for key in "abacadaeb":
        assert kept(results, key, lambda key=key: made.append(key) or key.upper(), 3) == key.upper()
        assert len(results) <= 3
    assert "".join(made) == "abcdaeb" and list(results) == ["a", "e", "b"]


@pytest.mark.parametrize("values", [[], [3], [2, 1, 2, 2, -1], [0.5, 0.25, 0.5], np.arange(6).reshape(2, 3) % 3])
def test_distinct_numbers_are_those_of_numpy(values: Any) -> None:
    found, wanted = distinct(values), np.unique(values)
    assert found.dtype == wanted.dtype and found.tolist() == wanted.tolist()


def test_masked_arrays_are_told_from_others() -> None:
    assert is_masked_array(MASKED) and not is_masked_array(MASKED.data) and not is_masked_array([1.0])
