"""The grammars by level: those of ``broad``, and those of ``unseen`` that no data of training are drawn from."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np

from apex_ompl.problems.broad import containers, curved, frameworks, furniture, panels, scattered, simple, unseen
from apex_ompl.problems.broad.composition import Composition

Grammar = Callable[[np.random.Generator], Composition]
SUITE, UNSEEN = "broad", "unseen"


def _by_name(*grammars: Grammar) -> Mapping[str, Grammar]:
    return MappingProxyType({grammar.__name__: grammar for grammar in grammars})


GRAMMARS: Mapping[str, Mapping[str, Grammar]] = MappingProxyType({
    SUITE: _by_name(
        furniture.rack, furniture.drawers, furniture.cabinet, furniture.tables, furniture.stairs, furniture.bench,
        furniture.chairs, containers.crates, containers.pigeonholes, containers.barrels, containers.cage,
        containers.bottles, containers.nested, containers.packed, panels.windows, panels.slits, panels.maze,
        panels.louvres, panels.doorways, panels.lids, panels.curtains, panels.shards, curved.arches, curved.hoops,
        curved.domes, curved.gutters, curved.hooks, curved.bowls, scattered.clutter, scattered.pebbles,
        scattered.boulders, scattered.posts, scattered.mikado, scattered.blobs, scattered.program,
    ),
    UNSEEN: _by_name(
        unseen.pipework, unseen.tunnel, unseen.tree, unseen.spiral, unseen.net, unseen.machine, unseen.skeleton,
        frameworks.blades, frameworks.wheels, frameworks.truss, frameworks.honeycomb, frameworks.bristles,
    ),
})  # fmt: skip
"""Suite -> its levels -> grammar."""

LEVELS = {SUITE: (*simple.LEVELS, *GRAMMARS[SUITE]), UNSEEN: tuple(GRAMMARS[UNSEEN])}
