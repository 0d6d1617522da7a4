"""APEX with other proposals, as planners: importing this module registers them.

``random weights``: a network like the model's, not trained. ``shuffled conditions``: the model, which sees a training
problem drawn at random and not the one at hand. ``nearest paths``: training paths of the most similar conditions, moved
to the ends at hand. Random perturbations in the place of proposals are apex's own, by its parameter ``model`` of
"none".
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from ompl import base as ob

from apex_ompl.apex.model_search import AUTO, DEFAULT
from apex_ompl.apex.parameters import ApexParameters
from apex_ompl.apex.planner import APEX
from apex_ompl.errors import ParameterError
from apex_ompl.kernel import Kernel, RobotTables
from apex_ompl.kernel.scene_builder import scene_tables
from apex_ompl.model.array_model import ArrayModel
from apex_ompl.model.proposals import Proposals, TrajectoryModel
from apex_ompl.model.query import ObstacleSet, Query
from apex_ompl.ompl.parameters import register
from apex_ompl.training.data import Mirror, shard_paths
from apex_ompl.training.records import Paths, held_extents
from apex_ompl.training.torch_model import load_torch_model
from benchmarks.lib.controls import Neighbors, Shuffled, drawn

DATA = Path(__file__).resolve().parents[2] / "data" / "dual_panda_softhand"
NEAR = 4  # times as many nearest paths as are wanted are there to draw from


class ControlParameters(ApexParameters):
    """APEX whose model is replaced."""

    def replaced(self, model: ArrayModel) -> TrajectoryModel:
        """Return what makes proposals in the place of a model."""
        raise NotImplementedError

    def build(self, si: ob.SpaceInformation) -> ob.Planner:
        """Return the planner.

        Raises:
            ParameterError: The model is none that NumPy evaluates.
        """
        planner = APEX(si, self)
        if not isinstance(planner.model, ArrayModel):
            raise ParameterError("parameter 'model'", self.model, "a model that NumPy evaluates, as of kind mlp")
        planner.model = self.replaced(planner.model)
        return planner


@register("random weights")
@dataclass(frozen=True)
class RandomWeightsParameters(ControlParameters):
    """APEX with a model of random weights."""

    def replaced(self, model: ArrayModel) -> TrajectoryModel:
        """Return a model like the given one."""
        return _drawn(DEFAULT if self.model == AUTO else self.model)


@cache
def _drawn(name: str) -> ArrayModel:
    return drawn(load_torch_model(name).network)


class TrainingConditions(Shuffled):
    """Proposals for a training problem drawn anew in each round, put on the ends of the one at hand."""

    def propose(self, query: Any, kernel: Any, count: int, **options: Any) -> Proposals:
        """Return proposals for another problem."""
        self._draw(options.get("generator"))
        return super().propose(query, kernel, count, **options)

    def renoise(self, query: Query, kernel: Any, control: Any, step: int, **options: Any) -> Proposals:
        """Return paths near given ones, denoised for another problem."""
        self._draw(options.get("generator"))
        return super().renoise(query, kernel, control, step, **options)

    def _draw(self, generator: np.random.Generator | None) -> None:
        paths, _ = training_paths()
        self.other = training_query(paths, int((generator or np.random.default_rng(0)).integers(len(paths))))


@register("shuffled conditions")
@dataclass(frozen=True)
class ShuffledParameters(ControlParameters):
    """APEX with a model that sees other problems."""

    def replaced(self, model: ArrayModel) -> TrajectoryModel:
        """Return the model with conditions of training problems."""
        return TrainingConditions(model.config, model.weights, {})


class NearestPaths(ArrayModel):
    """The nearest training paths instead of proposals, drawn from some times as many."""

    def propose(self, query: Any, kernel: Kernel, count: int, **options: Any) -> Proposals:
        """Return training paths, moved to the ends of queries."""
        queries = [query] if isinstance(query, Query) else list(query)
        rng, near = options.get("generator") or np.random.default_rng(0), neighbors()
        found = [
            near.refitted(q, kernel, NEAR * count)[np.sort(rng.permutation(NEAR * count)[:count])] for q in queries
        ]
        return Proposals(np.concatenate(found), np.empty(0), {})

    def renoise(self, query: Query, kernel: Kernel, control: Any, step: int, **options: Any) -> Proposals:
        """Return other training paths: a path is not resampled."""
        return self.propose(query, kernel, len(control), **options)


@register("nearest paths")
@dataclass(frozen=True)
class NearestParameters(ControlParameters):
    """APEX with the nearest paths of the data set that ships."""

    def replaced(self, model: ArrayModel) -> TrajectoryModel:
        """Return the nearest training paths."""
        return NearestPaths(model.config, model.weights, {})


@cache
def training_paths() -> tuple[Paths, RobotTables]:
    """Return the paths that ship, and their robot."""
    return shard_paths([str(DATA / "paths.zip")], 0, 1, 0)[0], RobotTables.load(DATA / "robot.npz")


@cache
def neighbors() -> Neighbors:
    """Return the paths that ship to look for neighbors in, with their mirror images."""
    from apex_ompl.model.checkpoint import SHIPPED, read_config

    paths, tables = training_paths()
    mirror = Mirror(**read_config(SHIPPED / "apex").trained["config"]["mirror"])
    return Neighbors([paths, mirror.paths(paths, Kernel(tables, scene_tables([])))], tables)


def training_query(paths: Paths, k: int) -> Query:
    """Return the query that a path of a data set solves."""
    a, problem = paths.arrays, int(paths.arrays["problem"][k])
    first = int(a["things"][:problem].sum())
    span = slice(first, first + int(a["things"][problem]))
    columns = (a[name][span] for name in ("shape", "position", "orientation", "size"))
    obstacles = ObstacleSet.from_rows(list(zip(*columns, strict=True)))
    held = held_extents(paths.names["held"][a["held"][problem]])
    return Query(paths.start[k], paths.goal[k], np.asarray(a["point"][k], float), obstacles, held=held)
