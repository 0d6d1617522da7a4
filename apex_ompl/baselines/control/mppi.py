"""Model predictive path integral control in joint space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from apex_ompl.baselines.control.short_horizon import Horizon, finish, first_proved
from apex_ompl.moving.compute_costs import ComputeBudget
from apex_ompl.moving.context import RunContext
from apex_ompl.moving.dynamic_obstacles import clearance_in_time
from apex_ompl.moving.replanner import ONE_PLAN, Answer, Request, register
from apex_ompl.moving.search import Search
from apex_ompl.types import Array

SHARES = np.array([0.0, 0.25, 0.5, 1.0])  # of the largest speed, of rollouts that go straight to a goal; 0 is a stop


@dataclass(eq=False)
class PathIntegral:
    """Model predictive path integral control (Williams et al. 2017) in joint space, as STORM has it (Bhardwaj et al.).

    Rollouts are noise around the controls of the last replan, shifted to the time of joining; besides, there are a stop
    and straight rollouts to the nearest goal at several speeds. The cost of a rollout is the distance of its states
    from the nearest goal, and their violation of the clearance margins: to dynamic obstacles at the time of the state,
    to static obstacles and to the robot itself. The mean, weighted by the softmax of the costs, is followed by a stop
    and proved; where the whole horizon is not proved, a shorter part of it is tried.

    512 rollouts of 20 steps take about 28 ms by the compute-cost table, since static obstacles and the robot itself are
    checked at every fourth state only. Three sets of parameters were tried in 4 to 8 worlds of each of the kinds
    ``moving``, ``popup`` and ``interceptor`` of the validation split.

    Attributes:
        rollouts: Number of rollouts.
        steps: Number of steps of a rollout, including the stop at its end.
        step: Time of a step [s].
        knots: Number of values of the noise of a joint over the horizon, between which it is linear.
        noise: Least and largest standard deviation of the accelerations of a rollout, as shares of the largest.
        temperature: Temperature of the softmax, in units of the cost.
        clearance_margin: Clearance to dynamic obstacles below which a state costs [m].
        own_margin: Clearance to static obstacles and between bodies of the robot below which a state costs [m].
        collision: Cost of contact for a second, in rad of distance for a second.
        effort: Weight of the accelerations squared, as shares of the largest.
        sparse: Number of steps between two states that are checked for static obstacles.
        counts: Numbers of steps for which a proof is tried.
        near: Distance to a goal, of the farthest joint, below which the straight motion to it is tried first [rad].
    """

    rollouts: int = 512
    steps: int = 20
    step: float = 0.05
    knots: int = 5
    noise: tuple[float, float] = (0.01, 0.3)
    temperature: float = 0.05
    clearance_margin: float = 0.08
    own_margin: float = 0.03
    collision: float = 20.0
    effort: float = 0.002
    sparse: int = 4
    counts: tuple[int, ...] = (20, 14, 9)
    near: float = 0.5
    controls: Array | None = None
    started: float = 0.0

    def prepare(self, context: RunContext) -> None:
        """Forget earlier runs."""
        self.controls = None

    def replan(self, context: RunContext, request: Request, budget: ComputeBudget) -> Answer:
        """Return the motion of the mean of the rollouts, or a straight one to a near goal."""
        search = Search(context, request, budget)
        if not len(search.goals):
            return Answer(None, "", budget)
        direct = finish(search, self.near)
        if direct is not None:
            return Answer(search.following(direct), "finish", budget)
        horizon = Horizon(context.limits, self.step)
        points = horizon.roll(search.start, self.tried(search, horizon))
        weights = softmax(self.costs(search, horizon, points), self.temperature)
        budget.spend("state of a rollout", self.rollouts * self.steps)
        self.controls = np.tensordot(weights, horizon.applied(points), axes=(0, 1))
        self.started = request.join
        motion = first_proved(search, horizon, self.controls, self.counts)
        return Answer(None if motion is None else search.following(motion), "mppi", budget)

    def costs(self, search: Search, horizon: Horizon, points: Array) -> Array:
        """Return the costs of rollouts, shape (N,), from their control points, shape (K + 3, N, dof)."""
        states = points[3:]
        count, rollouts, dof = states.shape
        context, goals = search.context, search.goals
        distance = np.linalg.norm(states - goals[0], axis=2)
        total = self.step * distance.sum(axis=0) + distance[-1]
        shares = horizon.applied(points) / horizon.most
        total += self.effort * np.einsum("knd,knd->n", shares, shares)
        times = search.request.join + self.step * np.arange(2, count + 2)
        times[-1] += context.settings.rest_hold / 2.0
        flat = np.ascontiguousarray(states).reshape(-1, dof)
        clear = clearance_in_time(
            context.kernel, search.request.predicted, flat, np.repeat(times, rollouts), self.clearance_margin
        )[0].reshape(count, rollouts)  # fmt: skip
        search.budget.spend("near clearance in time", clear.size)
        total += self.collision * self.step * depth(clear, self.clearance_margin).sum(axis=0)
        some = np.ascontiguousarray(states[self.sparse - 1 :: self.sparse]).reshape(-1, dof)
        own = near_clearance(search, some, self.own_margin, self.near).reshape(-1, rollouts)
        total += self.collision * self.step * self.sparse * depth(own, self.own_margin).sum(axis=0)
        return np.asarray(total)

    def tried(self, search: Search, horizon: Horizon) -> Array:
        """Return controls of rollouts, shape (K, N, dof)."""
        dof, fixed = len(search.start.position), len(SHARES)
        values = search.rng.normal(size=(self.knots, self.rollouts, dof)) * horizon.most
        values *= np.geomspace(*self.noise, self.rollouts)[:, None]
        values[:, 0] = 0.0
        values[:, :, search.context.fingers] = 0.0
        at = np.linspace(0.0, self.knots - 1.0, self.steps)
        low = np.minimum(at.astype(int), self.knots - 2)
        share = (at - low)[:, None, None]
        tried: Array = (1.0 - share) * values[low] + share * values[low + 1]
        tried += self._shifted(search.request.join, dof)[:, None]
        tried[:, -fixed:] = horizon.applied(self._straight(search, horizon))
        return tried

    def _straight(self, search: Search, horizon: Horizon) -> Array:
        """Return rollouts that go straight to the nearest goal, at shares of the largest speed."""
        goal, limits = search.goals[0], search.context.limits

        def control(k: int, speed: Array, at: Array) -> Array:
            way = goal - at
            seconds = np.abs(way / limits.velocity).max(axis=1)
            seconds = np.maximum(seconds, np.sqrt(2.0 * np.abs(way / horizon.most).max(axis=1)))
            wanted = SHARES[:, None] * way / np.maximum(seconds, horizon.step)[:, None]
            return np.asarray((wanted - speed) / horizon.step)

        return horizon.steer(search.start, (self.steps, len(SHARES)), control)

    def _shifted(self, join: float, dof: int) -> Array:
        """Return the controls of the last replan from a time of joining on, shape (K, dof)."""
        if self.controls is None:
            return np.zeros((self.steps, dof))
        at = np.arange(self.steps) + (join - self.started) / self.step
        columns = [np.interp(at, np.arange(self.steps), one, right=0.0) for one in self.controls.T]
        return np.stack(columns, axis=1)


def near_clearance(search: Search, states: Array, clearance_margin: float, near: float) -> Array:
    """Return the clearance of states to static obstacles and of the robot to itself [m], up to a margin, shape (N,).

    Held objects may be closer to each other at the nearest goal: within ``near`` of the goal [rad], the robot's own
    clearance counts in relation to that at the goal.
    """
    goal = search.goals[0]
    found = search.context.kernel.clearance(np.concatenate([goal[None], states]), clearance_margin)
    search.budget.spend("near clearance", len(found))
    share = np.maximum(1.0 - np.abs(states - goal).max(axis=1) / near, 0.0)
    return np.asarray(np.minimum(found[1:, 0], found[1:, 1] + share * (clearance_margin - found[0, 1])))


def softmax(costs: Array, temperature: float) -> Array:
    """Return weights exp(-S / temperature) of costs S, shape (N,), which add up to 1."""
    weights: Array = np.exp((costs.min() - costs) / temperature)
    weights /= weights.sum()
    return weights


def depth(clearance: Array, clearance_margin: float) -> Array:
    """Return the cost max(1 - c / m, 0)^2 of clearances c for a clearance margin m: 0 at m, and 1 in contact."""
    deep: Array = np.maximum(1.0 - np.nan_to_num(clearance, nan=-clearance_margin) / clearance_margin, 0.0) ** 2
    return deep


register("mppi", PathIntegral, "model predictive path integral control", ONE_PLAN)
