"""Helpers that several commands share."""

from __future__ import annotations

from collections.abc import Sequence

from apex_ompl.errors import ParameterError

LIMITS = ("velocity", "acceleration", "jerk")
"""Limits with the options ``--NAME-scale`` and ``--max-NAME``."""


def name_value_pairs(option: str, pairs: Sequence[str]) -> dict[str, str]:
    """Return the values of a repeated option NAME=VALUE by name.

    Raises:
        ParameterError: A name, a value or the equals sign is missing.
    """
    found = {}
    for pair in pairs:
        name, equals, value = pair.partition("=")
        if not equals or not name or not value:
            raise ParameterError(option, pair, "NAME=VALUE")
        found[name.strip()] = value.strip()
    return found


def numbers_by_name(option: str, pairs: Sequence[str]) -> dict[str, float]:
    """Return the numbers of a repeated option NAME=NUMBER by name.

    Raises:
        ParameterError: A name, a number or the equals sign is missing.
    """
    found = {}
    for name, value in name_value_pairs(option, pairs).items():
        try:
            found[name] = float(value)
        except ValueError as error:
            raise ParameterError(option, f"{name}={value}", "NAME=NUMBER") from error
    return found
