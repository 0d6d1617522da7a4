"""OMPL's sampling-based planners: every geometric planner that its Python bindings have.

The defaults are OMPL's own; a range of 0 lets OMPL choose one from the size of the space (a fifth of its extent), and
is ``RANGE`` under constraints along the path.
``apex_ompl.planners.TUNED`` has parameters that suit the suites of problems.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import ClassVar

from ompl import base as ob
from ompl import geometric as og

from apex_ompl.ompl.constrained_space import RANGE, refuse_constraints
from apex_ompl.ompl.parameters import Parameters, bounded, register

UNIT = "rad"
# OMPL spells these setters differently.
_SETTERS = {"delay_cc": "DelayCC", "cache_cc": "CacheCC", "extended_fmt": "ExtendedFMT"}


def setter_stem(parameter: str) -> str:
    """Return what follows ``set`` and ``get`` in OMPL's names for a parameter."""
    return _SETTERS.get(parameter) or "".join(word.capitalize() for word in parameter.split("_"))


@dataclass(frozen=True)
class OmplParameters(Parameters):
    """Parameters of a planner of OMPL's own, set through its setters."""

    planner: ClassVar[str]
    constrained: ClassVar[bool] = True

    def build(self, si: ob.SpaceInformation) -> ob.Planner:
        """Return OMPL's planner with these parameters.

        Raises:
            ParameterError: There are constraints along the path, under which the planner does not plan.
        """
        if not self.constrained:
            refuse_constraints(si, self.name)
        planner = getattr(og, self.planner)(si)
        for field in fields(self):
            getattr(planner, "set" + setter_stem(field.name))(getattr(self, field.name))
        if getattr(self, "range", None) == 0.0 and isinstance(si.getStateSpace(), ob.ConstrainedStateSpace):
            planner.setRange(RANGE)
        return planner


@register("rrtconnect")
@dataclass(frozen=True)
class RRTConnect(OmplParameters):
    """Two trees that grow towards each other (Kuffner and LaValle, 2000)."""

    planner: ClassVar[str] = "RRTConnect"
    range: float = bounded(0.0, 0.0, unit=UNIT)
    intermediate_states: bool = False


@register("rrt")
@dataclass(frozen=True)
class RRT(OmplParameters):
    """One tree from the start (LaValle, 1998)."""

    planner: ClassVar[str] = "RRT"
    range: float = bounded(0.0, 0.0, unit=UNIT)
    goal_bias: float = bounded(0.05, 0.0, 1.0)
    intermediate_states: bool = False


@dataclass(frozen=True)
class _StarParameters(OmplParameters):
    """What RRT* and its informed kin share."""

    optimizing: ClassVar[bool] = True
    repeatable: ClassVar[bool] = False
    range: float = bounded(0.0, 0.0, unit=UNIT)
    goal_bias: float = bounded(0.05, 0.0, 1.0)
    rewire_factor: float = bounded(1.1, 1.0)
    k_nearest: bool = True
    delay_cc: bool = True


@register("rrtstar")
@dataclass(frozen=True)
class RRTstar(_StarParameters):
    """RRT that rewires towards the shortest path (Karaman and Frazzoli, 2011)."""

    planner: ClassVar[str] = "RRTstar"


@register("informedrrtstar")
@dataclass(frozen=True)
class InformedRRTstar(_StarParameters):
    """RRT* that samples where a shorter path can be (Gammell et al., 2014)."""

    planner: ClassVar[str] = "InformedRRTstar"


@register("sorrtstar")
@dataclass(frozen=True)
class SORRTstar(_StarParameters):
    """Informed RRT* with batches of samples sorted by heuristic (Gammell et al., 2014)."""

    planner: ClassVar[str] = "SORRTstar"
    batch_size: int = bounded(100, 1)


@register("aorrtc")
@dataclass(frozen=True)
class AORRTC(OmplParameters):
    """RRTConnect made almost-surely asymptotically optimal (Wilson et al., 2025)."""

    planner: ClassVar[str] = "AORRTC"
    constrained: ClassVar[bool] = False
    optimizing: ClassVar[bool] = True
    repeatable: ClassVar[bool] = False
    range: float = bounded(0.0, 0.0, unit=UNIT)

    def build(self, si: ob.SpaceInformation) -> ob.Planner:
        """Return the planner, set up: in OMPL 2.0.1, destroying one that never was ends the process."""
        planner = super().build(si)
        planner.setup()
        return planner


@register("bitstar")
@dataclass(frozen=True)
class BITstar(OmplParameters):
    """Batch informed trees (Gammell et al., 2015)."""

    planner: ClassVar[str] = "BITstar"
    optimizing: ClassVar[bool] = True
    repeatable: ClassVar[bool] = False
    samples_per_batch: int = bounded(100, 1)
    rewire_factor: float = bounded(1.1, 1.0)
    use_k_nearest: bool = True
    pruning: bool = True
    just_in_time_sampling: bool = False
    stop_on_soln_improvement: bool = False


@dataclass(frozen=True)
class _MarchingParameters(OmplParameters):
    """What FMT* and BFMT* share."""

    num_samples: int = bounded(1000, 1)
    radius_multiplier: float = bounded(1.1, 0.01)
    nearest_k: bool = True
    cache_cc: bool = True
    heuristics: bool = False
    extended_fmt: bool = True


@register("fmt")
@dataclass(frozen=True)
class FMT(_MarchingParameters):
    """Fast marching tree over a fixed number of samples (Janson et al., 2015)."""

    planner: ClassVar[str] = "FMT"


@register("bfmt")
@dataclass(frozen=True)
class BFMT(_MarchingParameters):
    """Fast marching trees from both ends (Starek et al., 2015)."""

    planner: ClassVar[str] = "BFMT"
    radius_multiplier: float = bounded(1.0, 0.01)
    heuristics: bool = True


@register("prm")
@dataclass(frozen=True)
class PRM(OmplParameters):
    """Probabilistic roadmap, grown in one thread and searched in another (Kavraki et al., 1996)."""

    planner: ClassVar[str] = "PRM"
    threaded: ClassVar[bool] = True
    repeatable: ClassVar[bool] = False
    max_nearest_neighbors: int = bounded(10, 1)


@register("prmstar")
@dataclass(frozen=True)
class PRMstar(OmplParameters):
    """PRM with the neighborhood that makes it asymptotically optimal (Karaman and Frazzoli, 2011)."""

    planner: ClassVar[str] = "PRMstar"
    threaded: ClassVar[bool] = True
    optimizing: ClassVar[bool] = True
    repeatable: ClassVar[bool] = False


@register("kpiece1")
@dataclass(frozen=True)
class KPIECE1(OmplParameters):
    """One tree that explores by cells of a projection (Sucan and Kavraki, 2009)."""

    planner: ClassVar[str] = "KPIECE1"
    range: float = bounded(0.0, 0.0, unit=UNIT)
    goal_bias: float = bounded(0.05, 0.0, 1.0)
    border_fraction: float = bounded(0.9, 0.0, 1.0)


@register("bkpiece1")
@dataclass(frozen=True)
class BKPIECE1(OmplParameters):
    """KPIECE from both ends."""

    planner: ClassVar[str] = "BKPIECE1"
    range: float = bounded(0.0, 0.0, unit=UNIT)
    border_fraction: float = bounded(0.9, 0.0, 1.0)


@register("lbkpiece1")
@dataclass(frozen=True)
class LBKPIECE1(OmplParameters):
    """KPIECE from both ends that checks motions lazily."""

    planner: ClassVar[str] = "LBKPIECE1"
    range: float = bounded(0.0, 0.0, unit=UNIT)
    border_fraction: float = bounded(0.9, 0.0, 1.0)
