"""Ways of replanning by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from apex_ompl.errors import UnknownNameError
from apex_ompl.loop.mppi import PathIntegral
from apex_ompl.loop.portfolio import Portfolio
from apex_ompl.loop.potential_field import PotentialField
from apex_ompl.loop.proposals import Proposals
from apex_ompl.loop.request import Replanner
from apex_ompl.loop.settings import LoopSettings
from apex_ompl.loop.sources import Lines, Route


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


METHODS = {
    "apex": Method(
        lambda: Portfolio([Route(), Lines(), Proposals(), Lines(bumps=3)]), {}, "all parts, the network among them"
    ),
    "no-network": Method(
        lambda: Portfolio([Route(), Lines(), Lines(bumps=3)]), {}, "all parts but the network's proposals"
    ),
    "blind": Method(
        lambda: Portfolio([Route(), Lines(), Proposals(), Lines(bumps=3)], evades=False),
        {"prediction": "still", "guarded": False, "monitored": False},
        "a plan among obstacles where they were seen at first, followed blindly",
    ),
    "mppi": Method(PathIntegral, {}, "model predictive path integral control"),
    "potential-field": Method(PotentialField, {}, "a reflex down an artificial potential"),
}  # fmt: skip


def names() -> tuple[str, ...]:
    """Names of the ways of replanning."""
    return tuple(METHODS)


def method(name: str) -> Method:
    """Return a way of replanning by its name.

    Raises:
        UnknownNameError: There is none of that name.
    """
    if name not in METHODS:
        raise UnknownNameError("way of replanning", str(name), METHODS)
    return METHODS[name]


def adapted(settings: LoopSettings, one: Method) -> LoopSettings:
    """Return the parameters of the loop with what a way of replanning changes of them."""
    return replace(settings, **one.settings)
