"""The latent diffusion model (sections III-B and III-C of the paper): networks, noise, sampling, guidance, training.

It imports torch, NumPy and the kernel; neither OMPL nor Pinocchio.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from apex_ompl.util.lazy import lazy_names

if TYPE_CHECKING:
    from apex_ompl.diffusion.checkpoint import load_model, load_torch_model
    from apex_ompl.diffusion.proposals import Proposals, Sampling

__all__ = ["Proposals", "Sampling", "load_model", "load_torch_model"]

__getattr__, __dir__ = lazy_names(
    __name__,
    {"Proposals": "proposals", "Sampling": "proposals", "load_model": "checkpoint", "load_torch_model": "checkpoint"},
)
