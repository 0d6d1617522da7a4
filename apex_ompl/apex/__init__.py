"""APEX: the stages of ``solve``, their context and report."""

from __future__ import annotations

from typing import TYPE_CHECKING

from apex_ompl.util.lazy import lazy_names

if TYPE_CHECKING:
    from apex_ompl.apex.query import make_query

__all__ = ["make_query"]

__getattr__, __dir__ = lazy_names(__name__, {"make_query": "query"})
