"""Public names of a package that are imported when they are first used (PEP 562)."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

from apex_ompl.util.forking import unforked


def lazy_names(
    package: str, homes: Mapping[str, str], others: tuple[str, ...] = ()
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return ``__getattr__`` and ``__dir__`` of a package whose import costs nothing.

    The package lists the names in ``__all__``, and imports them for type checkers under ``TYPE_CHECKING``.

    Args:
        package: Name of the package.
        homes: Public name -> module below the package that has it.
        others: Names that ``dir`` lists besides ``__all__``.
    """

    def __getattr__(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        with unforked():
            found = getattr(import_module(f"{package}.{homes[name]}"), name)
        return vars(sys.modules[package]).setdefault(name, found)

    def __dir__() -> list[str]:
        return sorted([*vars(sys.modules[package])["__all__"], *others])

    return __getattr__, __dir__
