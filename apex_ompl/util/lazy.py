"""Public names of a package that are imported when they are first used (PEP 562)."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

from apex_ompl.util.forking import unforked


def lazy_names(
    package: str, names: Mapping[str, str], others: tuple[str, ...] = ()
) -> tuple[list[str], Callable[[str], Any], Callable[[], list[str]]]:
    """Return ``__all__``, ``__getattr__`` and ``__dir__`` of a package whose import costs nothing.

    For type checkers, the package imports each name as itself under ``TYPE_CHECKING``.

    Args:
        package: Name of the package.
        names: Module below the package -> public names that it has, with spaces between them.
        others: Names that ``dir`` lists besides ``__all__``.
    """
    homes = {name: module for module, its_names in names.items() for name in its_names.split()}

    def __getattr__(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        with unforked():
            found = getattr(import_module(f"{package}.{homes[name]}"), name)
        return vars(sys.modules[package]).setdefault(name, found)

    def __dir__() -> list[str]:
        return sorted([*homes, *others])

    return sorted(homes), __getattr__, __dir__
