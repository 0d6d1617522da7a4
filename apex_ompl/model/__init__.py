"""Inference of the latent diffusion model (sections III-B and III-C of the paper), by NumPy and the kernel."""

from __future__ import annotations

from typing import TYPE_CHECKING

from apex_ompl.util.lazy import lazy_names

if TYPE_CHECKING:
    from apex_ompl.model.checkpoint import load_model as load_model
    from apex_ompl.model.proposals import Proposals as Proposals
    from apex_ompl.model.proposals import Sampling as Sampling

__all__, __getattr__, __dir__ = lazy_names(__name__, {"checkpoint": "load_model", "proposals": "Proposals Sampling"})
