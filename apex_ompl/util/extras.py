"""Packages of the optional extras."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from types import SimpleNamespace
from typing import Any

from apex_ompl.errors import MissingFileError
from apex_ompl.util.forking import unforked


def import_extra(module: str, purpose: str, extra: str) -> Any:
    """Return a module that needs an extra of the package.

    Args:
        module: Its name.
        purpose: What it is for, for the message.
        extra: Name of the extra.

    Raises:
        MissingFileError: A package is not installed.
    """
    try:
        with unforked():
            return import_module(module)
    except ImportError as error:
        name = error.name or "a package"
        raise MissingFileError(name, f"package for {purpose}", f"install the extra: apex-ompl[{extra}]") from error


def names_of(places: Mapping[str, tuple[str, ...]], package: str, purpose: str, extra: str) -> Any:
    """Return names of an optional package as one namespace.

    Args:
        places: The names by the modules that have them.
        package: Name of the package.
        purpose: What it is for.
        extra: The extra that installs it.

    Raises:
        MissingFileError: It is not installed.
    """
    try:
        with unforked():
            found = {name: getattr(import_module(module), name) for module, names in places.items() for name in names}
    except ImportError as error:
        raise MissingFileError(package, f"package for {purpose}", f"install the extra: apex-ompl[{extra}]") from error
    return SimpleNamespace(**found)
