"""Ways of replanning by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from apex_ompl.baselines.control.mppi import PathIntegral
from apex_ompl.baselines.control.potential_field import PotentialField
from apex_ompl.baselines.damon.replanner import ManifoldGraph
from apex_ompl.baselines.drrt.replanner import KeptTree
from apex_ompl.baselines.gpmp.replanner import IncrementalGPMP, IncrementalGPMP2
from apex_ompl.baselines.imitation.replanner import Imitation
from apex_ompl.loop.replan.paper import OneProposal
from apex_ompl.loop.replan.portfolio import Portfolio
from apex_ompl.loop.replan.proposals import Proposals, Renoised
from apex_ompl.loop.replan.resuming import Resume
from apex_ompl.loop.replan.snapshot import Snapshot
from apex_ompl.loop.replan.sprint import Sprint
from apex_ompl.moving.request import Replanner
from apex_ompl.moving.settings import LoopSettings
from apex_ompl.moving.sources import Faster, Lines, Route
from apex_ompl.util.validation import check_name


@dataclass(frozen=True)
class Method:
    """A way of replanning.

    Attributes:
        make: Makes its replanner, new for each run.
        settings: What it changes of the parameters of the loop.
        about: One line about it.
    """

    make: Callable[[], Replanner]
    settings: dict[str, Any]
    about: str


ONE_PLAN = {"hastens": False}
FROM_REST = {"from_rest": True, **ONE_PLAN}
BLIND = {"prediction": "still", "guarded": False, **ONE_PLAN}
PAPER = {**BLIND, "verified": False, "from_rest": True, "by_distance": True}


def _no_network(*, waits: bool = True) -> Portfolio:
    return Portfolio([Faster(), Route(), Lines(), Lines(bumps=3)], waits=waits)


def _all_parts() -> Portfolio:
    return Portfolio([Faster(), Route(), Lines(), Proposals(), Lines(bumps=3)])


METHODS = {
    "apex": Method(_all_parts, {}, "all parts, the network among them"),
    "apex-unguarded": Method(
        _all_parts, {"guarded": False}, "all parts, without a proved stop in hand: what the guarantee costs"
    ),
    "apex-foreseeing": Method(
        _all_parts, {"guarded": False, "prediction": "truth"},
        "the same, told where obstacles are and how they move: what better eyes could gain",
    ),
    "no-network": Method(_no_network, {}, "all parts but the network's proposals"),
    "apex-renoise": Method(
        lambda: Portfolio([Faster(), Route(), Lines(), Renoised(), Proposals(), Lines(bumps=3)]), {},
        "all parts, and what is left of the motion noised and denoised again",
    ),
    "apex-sprint": Method(
        lambda: Portfolio([Faster(), Route(), Lines(), Sprint(), Proposals(), Lines(bumps=3)]), {},
        "all parts, and a sprint of trees where the robot stands",
    ),
    "apex-paper": Method(
        lambda: OneProposal(guided=True), PAPER,
        "the paper's loop: stop near an obstacle, one guided proposal from rest, followed unproved",
    ),
    "apex-paper-unguided": Method(lambda: OneProposal(guided=False), PAPER, "the same without guidance"),
    "retime": Method(
        lambda: Resume(_no_network(waits=False), retimes=True), ONE_PLAN,
        "one plan, along which the speed alone is chosen anew",
    ),
    "stop-and-wait": Method(
        lambda: Resume(_no_network(waits=False)), FROM_REST,
        "one plan; stops where it is blocked, goes on when it is clear",
    ),
    "rrtconnect": Method(
        Snapshot, FROM_REST, "stops where the way is blocked; RRTConnect from rest, among obstacles where they are seen"
    ),
    "blind": Method(
        lambda: Portfolio([Route(), Lines(), Proposals(), Lines(bumps=3)], evades=False, waits=False),
        {**BLIND, "monitored": False},
        "a plan among obstacles where they were seen at first, followed blindly",
    ),
    "gpmp2": Method(IncrementalGPMP2, ONE_PLAN, "GPMP2 from the moving robot, warm from the last motion (as iGPMP2)"),
    "gpmp": Method(IncrementalGPMP, ONE_PLAN, "GPMP from the moving robot: steps along the functional gradient"),
    "mppi": Method(PathIntegral, ONE_PLAN, "model predictive path integral control"),
    "potential-field": Method(PotentialField, ONE_PLAN, "a reflex down an artificial potential"),
    "drrt": Method(
        KeptTree, FROM_REST, "dynamic RRT: stops where the way is blocked; a tree from the goal, kept and repaired"
    ),
    "damon": Method(
        ManifoldGraph, FROM_REST, "DAMON: stops where the way is blocked; A* over a graph on a learned manifold"
    ),
    "il": Method(
        Imitation, {**BLIND, "verified": False}, "an imitation policy as a reflex, followed unproved"
    ),
    "il-paper": Method(
        lambda: Imitation("il-paper"), {**BLIND, "verified": False}, "the same, which sees one obstacle point"
    ),
}  # fmt: skip


def names() -> tuple[str, ...]:
    """Names of the ways of replanning."""
    return tuple(METHODS)


def method(name: str) -> Method:
    """Return a way of replanning by its name.

    Raises:
        UnknownNameError: There is none of that name.
    """
    return METHODS[check_name(name, "way of replanning", METHODS)]


def adapted(settings: LoopSettings, one: Method) -> LoopSettings:
    """Return the parameters of the loop with what a way of replanning changes of them."""
    return replace(settings, **one.settings)


def replanner_of(name: str) -> Replanner:
    """Return a new replanner of a way of replanning by its name.

    Raises:
        UnknownNameError: There is none of that name.
    """
    return method(name).make()
