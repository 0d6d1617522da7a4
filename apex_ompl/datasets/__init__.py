"""Data sets of verified paths: records, store, generation by the kernel alone, statistics."""

from __future__ import annotations

from typing import TYPE_CHECKING

from apex_ompl.util.lazy import lazy_names

if TYPE_CHECKING:
    from apex_ompl.datasets.records import Paths
    from apex_ompl.datasets.store import Store, load

__all__ = ["Paths", "Store", "load"]

__getattr__, __dir__ = lazy_names(__name__, {"Paths": "records", "Store": "store", "load": "store"})
