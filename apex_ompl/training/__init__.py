"""Networks in torch, their training, and data sets of verified paths with their generation."""

from __future__ import annotations

from typing import TYPE_CHECKING

from apex_ompl.util.lazy import lazy_names

if TYPE_CHECKING:
    from apex_ompl.training.records import Paths as Paths
    from apex_ompl.training.store import Store as Store
    from apex_ompl.training.store import load as load
    from apex_ompl.training.torch_model import load_torch_model as load_torch_model

__all__, __getattr__, __dir__ = lazy_names(
    __name__, {"records": "Paths", "store": "Store load", "torch_model": "load_torch_model"}
)
