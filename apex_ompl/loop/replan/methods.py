"""Replanners by name: our own are registered here, those of the baselines in their own modules."""

from __future__ import annotations

from functools import partial
from importlib import import_module

from apex_ompl.errors import ParameterError
from apex_ompl.loop.replan.one_plan import OneProposal, RRTConnectFromRest, StopAndWait
from apex_ompl.loop.replan.portfolio import Portfolio
from apex_ompl.loop.replan.sources import Faster, Lines, Proposals, Renoised, Route, Sprint
from apex_ompl.moving.replanner import FROM_REST, ONE_PLAN, REGISTRY, UNGUARDED, Method, Replanner, register
from apex_ompl.moving.search import Source
from apex_ompl.util.validation import check_name

PAPER = {**UNGUARDED, "verified": False, "from_rest": True, "by_distance": True}
BASELINES = (
    "gpmp.replanner", "control.mppi", "control.potential_field", "drrt.replanner", "damon.replanner",
    "imitation.replanner",
)  # fmt: skip
"""Modules of :mod:`apex_ompl.baselines` that register replanners."""


def names() -> tuple[str, ...]:
    """Names of the replanners."""
    _load_baselines()
    return tuple(REGISTRY)


def named(name: str) -> Method:
    """Return a replanner by its name.

    Raises:
        UnknownNameError: There is none of that name.
    """
    if name not in REGISTRY:
        _load_baselines()
    return REGISTRY[check_name(name, "replanner", REGISTRY)]


def method_of(method: str | Replanner) -> Method:
    """Return a replanner of that name, or a given one as a method of its class's name.

    Raises:
        UnknownNameError: There is none of that name.
        ParameterError: It is neither a name nor a replanner.
    """
    if isinstance(method, str):
        return named(method)
    if not all(callable(getattr(method, name, None)) for name in ("prepare", "replan")):
        raise ParameterError("method", method, "the name of a replanner, or an object with prepare and replan")
    return Method(type(method).__name__, lambda: method)


def replanner_of(method: str | Replanner) -> Replanner:
    """Return a new replanner of that name, or the given one.

    Raises:
        UnknownNameError: There is none of that name.
        ParameterError: It is neither a name nor a replanner.
    """
    return method_of(method).make()


def _load_baselines() -> None:
    for module in BASELINES:
        import_module(f"apex_ompl.baselines.{module}")


def _portfolio(*others: Source) -> Portfolio:
    """Return all sources, with others before the network's proposals."""
    return Portfolio([Faster(), Route(), Lines(), *others, Proposals(), Lines(perturbed=3)])


def _no_network(*, waits: bool = True) -> Portfolio:
    return Portfolio([Faster(), Route(), Lines(), Lines(perturbed=3)], waits=waits)


register("apex", _portfolio, "all parts, the network among them")
register(
    "apex-unguarded", _portfolio, "all parts, without a fail-safe stop: the cost of the guarantee", {"guarded": False}
)
register(
    "apex-foreseeing", _portfolio, "the same with the true motions of obstacles: the gain of a better sensor",
    {"guarded": False, "prediction": "truth"},
)  # fmt: skip
register("no-network", _no_network, "all parts but the network's proposals")
register(
    "apex-renoise", lambda: _portfolio(Renoised()), "all parts, and the remaining motion noised and denoised again"
)
register("apex-sprint", lambda: _portfolio(Sprint()), "all parts, and a sprint of trees where the robot is at rest")
register(
    "apex-paper", partial(OneProposal, guided=True),
    "the paper's loop: stop near an obstacle, one guided proposal from rest, followed unproved", PAPER,
)  # fmt: skip
register("apex-paper-unguided", partial(OneProposal, guided=False), "the same without guidance", PAPER)
register(
    "retime", lambda: StopAndWait(_no_network(waits=False), retimes=True),
    "one plan; only the speed along its path is replanned", ONE_PLAN,
)  # fmt: skip
register(
    "stop-and-wait", lambda: StopAndWait(_no_network(waits=False)),
    "one plan; stops where it is blocked, continues when the rest is clear", FROM_REST,
)  # fmt: skip
register(
    "rrtconnect", RRTConnectFromRest,
    "stops where the way is blocked; RRTConnect from rest, among obstacles where they are seen", FROM_REST,
)  # fmt: skip
register(
    "blind",
    lambda: Portfolio([Route(), Lines(), Proposals(), Lines(perturbed=3)], evades=False, waits=False),
    "a plan among obstacles where they were seen at first, followed to the end", {**UNGUARDED, "monitored": False},
)  # fmt: skip
