"""Planners by name: OMPL's own and this package's, each with a frozen record of its parameters."""

if not __name__.startswith("apex_ompl."):  # the folder also lies at the top of the source tree
    raise ImportError("import apex_ompl.planners, not planners")

from apex_ompl.planners.registry import Parameters, allocator, make, names, parameters

__all__ = ["Parameters", "allocator", "make", "names", "parameters"]
