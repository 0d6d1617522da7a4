"""An artificial potential field in joint space, followed over a short horizon."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from apex_ompl.baselines.control.short_horizon import Horizon, finish, first_proved
from apex_ompl.kernel import Kernel
from apex_ompl.moving.compute_costs import ComputeBudget
from apex_ompl.moving.context import RunContext
from apex_ompl.moving.dynamic_obstacles import DynamicObstacles, clearance_in_time
from apex_ompl.moving.replanner import ONE_PLAN, Answer, Replanner, Request, register
from apex_ompl.moving.search import Search
from apex_ompl.types import Array

LEAST = 0.25  # clearance below which the potential is linear, as a share of the reach


def repulsive(share: float) -> tuple[float, float]:
    """Return (1 / share - 1)^2 / 2 and its negative derivative by the share; below ``LEAST``, of the tangent there."""
    at = max(share, LEAST)
    steepness = (1.0 / at - 1.0) / at**2
    return 0.5 * (1.0 / at - 1.0) ** 2 + steepness * (at - share), steepness


@dataclass(eq=False)
class PotentialField(Replanner):
    """A reflex: damped descent of an artificial potential (Khatib 1986) over a short horizon.

    Obstacles repel from their predicted places at the time of each step. The horizon, or a part of it, is followed by a
    stop and proved. There is no escape from local minima. Ten sets of parameters were tried in 4 to 8 worlds of each of
    the kinds ``moving`` and ``popup`` of the validation split.

    Attributes:
        steps: Number of steps of the horizon, including the stop at its end.
        step: Time of a step [s].
        damping: Damping of the speed [1/s].
        attraction: Gain of the attraction [1/s^2].
        cone: Distance to the goal beyond which its force is constant [rad].
        repulsion: Gain of the repulsion by dynamic obstacles [rad^2/s^2].
        own_repulsion: Gain of the repulsion by static obstacles and by the robot itself [rad^2/s^2].
        reach: Clearance to dynamic obstacles below which they repel [m].
        own_reach: Clearance to static obstacles and of the robot to itself below which they repel [m].
        counts: Numbers of steps for which a proof is tried.
        near: Distance to a goal, of the farthest joint, below which the straight motion to it is tried first [rad].
    """

    steps: int = 14
    step: float = 0.05
    damping: float = 8.0
    attraction: float = 30.0
    cone: float = 0.8
    repulsion: float = 1.5
    own_repulsion: float = 1.0
    reach: float = 0.15
    own_reach: float = 0.03
    counts: tuple[int, ...] = (14, 8)
    near: float = 0.5

    def replan(self, context: RunContext, request: Request, budget: ComputeBudget) -> Answer:
        """Return the motion down the potential, or a straight one to a near goal."""
        search = Search(context, request, budget)
        if not len(search.goals):
            return Answer(None, "", budget)
        motion, part = finish(search, self.near), "finish"
        if motion is None:
            horizon = Horizon(context.limits, self.step)
            motion, part = first_proved(search, horizon, self.controls(search, horizon), self.counts), "field"
        return Answer(None if motion is None else search.following(motion), part, budget)

    def potential_and_force(
        self, kernel: Kernel, dynamic: DynamicObstacles, goal: Array, q: Array, time: float
    ) -> tuple[float, Array]:
        """Return the potential [rad^2/s^2] at a state, shape (dof,), and its force, shape (dof,) [rad/s^2].

        The robot is attracted by the goal, and repelled by obstacles (Khatib 1986). The attractive part is
        ``attraction * |q - goal|^2 / 2``, and a cone beyond the distance ``cone``. The repulsive parts are
        ``repulsion * (reach / d - 1)^2 / 2`` for clearances d below the reach: to dynamic obstacles, to static
        obstacles, and of the robot to itself. The last two fade with the square of the distance to the goal inside the
        cone, so that a goal close to contact is a minimum (Ge and Cui 2000).

        Args:
            kernel: The robot among static obstacles.
            dynamic: The dynamic obstacles.
            goal: The goal, shape (dof,).
            q: The state.
            time: Time of the dynamic obstacles' stamps [s].
        """
        way = q - goal
        distance = float(np.linalg.norm(way))
        inside = min(distance, self.cone)
        potential = self.attraction * inside * (distance - 0.5 * inside)
        force = -self.attraction * way * (inside / max(distance, 1e-12))
        moving, slope = clearance_in_time(kernel, dynamic, q[None], np.array([time]), self.reach)
        values, slopes = kernel.clearance_gradient(q, self.own_reach)
        fade, fading = (inside / self.cone) ** 2, 2.0 * way / self.cone**2 * (distance < self.cone)
        for clearance, gradient, reach, gain, share, sharing in (
            (moving[0], slope[0, :-1], self.reach, self.repulsion, 1.0, 0.0),
            (values[0, 0], slopes[0, 0], self.own_reach, self.own_repulsion, fade, fading),
            (values[0, 1], slopes[0, 1], self.own_reach, self.own_repulsion, fade, fading),
        ):
            if clearance < reach:
                height, steepness = repulsive(clearance / reach)
                potential += gain * share * height
                force = force + gain * (share * steepness / reach * gradient - sharing * height)
        return potential, force

    def controls(self, search: Search, horizon: Horizon) -> Array:
        """Return the accelerations down the potential, shape (K, dof) [rad/s^2]."""
        context, request = search.context, search.request
        goal, fingers = search.goals[0], context.fingers

        def control(k: int, speed: Array, at: Array) -> Array:
            time = request.join + (k + 1) * self.step
            _, force = self.potential_and_force(context.kernel, request.predicted, goal, at[0], time)
            force[fingers] = 0.0
            search.budget.spend("force")
            return force - self.damping * speed

        points = horizon.steer(search.start, (self.steps, 1), control)
        return horizon.applied(points)[:, 0]


register("potential-field", PotentialField, "a reflex down an artificial potential", ONE_PLAN)
