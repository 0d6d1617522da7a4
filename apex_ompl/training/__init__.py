"""Networks in torch, their training, and data sets of verified paths with their generation."""

from __future__ import annotations

from typing import TYPE_CHECKING

from apex_ompl.util.lazy import lazy_names

if TYPE_CHECKING:
    from apex_ompl.training.records import Paths
    from apex_ompl.training.store import Store, load
    from apex_ompl.training.torch_model import load_torch_model

__all__ = ["Paths", "Store", "load", "load_torch_model"]

__getattr__, __dir__ = lazy_names(
    __name__, {"Paths": "records", "Store": "store", "load": "store", "load_torch_model": "torch_model"}
)
