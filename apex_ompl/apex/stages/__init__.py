"""Stages of APEX inside ``solve``; each returns the first valid path that it finds, or None.

A stage is a small record of its parameters with one method, ``run(context)``. Their order and their parameters are
chosen by ``apex_ompl.apex.parameters.ApexParameters.stages``.
"""

from apex_ompl.apex.stages.known import CheckKnown, KnownCandidates
from apex_ompl.apex.stages.proposals import Farthest, Propose, Repair, Resample, proposal_round
from apex_ompl.apex.stages.shorten import Anytime, Shorten
from apex_ompl.apex.stages.stage import Solution, Stage, run_stage
from apex_ompl.apex.stages.trees import TEMPERATURES, Bridging, GrowTrees, NearestToGoal, Sprint, TakeTurns

__all__ = [
    "TEMPERATURES",
    "Anytime",
    "Bridging",
    "CheckKnown",
    "Farthest",
    "GrowTrees",
    "KnownCandidates",
    "NearestToGoal",
    "Propose",
    "Repair",
    "Resample",
    "Shorten",
    "Solution",
    "Sprint",
    "Stage",
    "TakeTurns",
    "proposal_round",
    "run_stage",
]
