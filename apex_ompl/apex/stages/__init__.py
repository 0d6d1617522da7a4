"""Stages of APEX inside ``solve``; each returns the first valid path that it finds, or None.

A stage is a small record of its parameters with one method, ``run(context)``. Their order and their parameters are
chosen by ``apex_ompl.apex.parameters.ApexParameters.stages``.
"""

from apex_ompl.apex.stages.constrained import ConstrainedLines as ConstrainedLines
from apex_ompl.apex.stages.constrained import ConstrainedProposals as ConstrainedProposals
from apex_ompl.apex.stages.constrained import ConstrainedShorten as ConstrainedShorten
from apex_ompl.apex.stages.constrained import ConstrainedTrees as ConstrainedTrees
from apex_ompl.apex.stages.constrained import ConstrainedTurns as ConstrainedTurns
from apex_ompl.apex.stages.known import CheckKnown as CheckKnown
from apex_ompl.apex.stages.known import KnownCandidates as KnownCandidates
from apex_ompl.apex.stages.proposals import Farthest as Farthest
from apex_ompl.apex.stages.proposals import Propose as Propose
from apex_ompl.apex.stages.proposals import Repair as Repair
from apex_ompl.apex.stages.proposals import Resample as Resample
from apex_ompl.apex.stages.proposals import proposal_round as proposal_round
from apex_ompl.apex.stages.shorten import Anytime as Anytime
from apex_ompl.apex.stages.shorten import Shorten as Shorten
from apex_ompl.apex.stages.stage import Solution as Solution
from apex_ompl.apex.stages.stage import Stage as Stage
from apex_ompl.apex.stages.stage import run_stage as run_stage
from apex_ompl.apex.stages.trees import TEMPERATURES as TEMPERATURES
from apex_ompl.apex.stages.trees import Bridging as Bridging
from apex_ompl.apex.stages.trees import GrowTrees as GrowTrees
from apex_ompl.apex.stages.trees import NearestToGoal as NearestToGoal
from apex_ompl.apex.stages.trees import Sprint as Sprint
from apex_ompl.apex.stages.trees import TakeTurns as TakeTurns
