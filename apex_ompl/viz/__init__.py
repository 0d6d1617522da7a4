"""Rendered scenes, films and plots."""

from __future__ import annotations

from typing import TYPE_CHECKING

from apex_ompl.util.lazy import lazy_names

if TYPE_CHECKING:
    from apex_ompl.viz.viewer.run import ShownRun as ShownRun

__all__, __getattr__, __dir__ = lazy_names(__name__, {"viewer.run": "ShownRun"})
