"""Joint motion along a path of tool poses, with the redundant joints kept clear of obstacles, limits and singularities.

1. *Track*: from the start on, each pose is reached from the state before by Newton's method with the pseudoinverse.
2. *Relax*: the states q_k move along the null vectors n_k of the tools, q_k + a_k n_k, and back onto the poses. The a_k
   are Gauss-Newton steps on

       1/2 w sum_k |q_k+1 - q_k|^2 / du_k + sum_k du_k c(q_k)

   where c has quadratic penalties on clearances, distances from limits and manipulabilities below margins. Each tool's
   system is tridiagonal.
3. *Choose*, where that is not free: each tool's self-motions are sampled in all poses, from the states of 1 along the
   null vectors in both directions, and dynamic programming finds the states that go farthest, at the least cost.
   Neighbors are near each other, so that branches are not mixed; 2 smooths the result.
4. *Refine*: states are added until the straight lines in between keep the poses.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from apex_ompl.collision import CollisionChecker
from apex_ompl.constraints.line import TURN, ToolPath
from apex_ompl.constraints.tools import Linearization, Tool, Tools, null_directions, pose_errors
from apex_ompl.types import Array, Flags
from apex_ompl.util.arrays import distinct

Stop = Callable[[], bool]

SPACING = 0.01  # of the states that are relaxed [m]
TRACKED = 0.04  # largest step of tracking [m]
SHORTEST = 2.5e-4  # step of tracking below which there is no way on [m]
LARGEST_STEP = 0.3  # of a joint from a state to the next one SPACING away [rad]
CLEARANCE, LIMIT, MANIPULABILITY = 0.03, 0.1, 0.03  # margins [m, rad, -]
WEIGHTS = 4.0, 1.0, 0.3  # of the squared shares that the margins lack
SMOOTHNESS = 0.02  # w
PROBE = 1e-4  # along null vectors, for the slope of the manipulability [rad]
ROUNDS = 3  # of relaxing, choosing and going on
RELAXATIONS = 12
FIRST_DAMPING, LEAST_GAIN = 1e-3, 1e-3
LARGEST_MOVE = 0.3  # along a null vector in one step of relaxation [rad]
SELF_STEP, SELF_STEPS = 0.12, 24  # of sampled self-motions [rad]
JUMP = 0.5  # largest step of a joint between neighbors in dynamic programming [rad]
CHORD = 2e-5  # largest error in the middle between neighbors [m]; TURN of it of angles
REFINEMENTS = 8
BISECTIONS = 7
ROOM = 5e-4  # of the end of a track that does not go on, from contact [m]


class Track(NamedTuple):
    """States along a path of poses.

    Attributes:
        u: Parameters of the poses, from 0, shape (N,) [m].
        states: Shape (N, dof).
    """

    u: Array
    states: Array

    def upto(self, count: int) -> Track:
        """Return the first states."""
        return Track(self.u[:count], self.states[:count])


@dataclass(frozen=True, eq=False)
class _Slopes:
    """Cost of a track's states, with derivatives along the null vectors.

    Attributes:
        cost: Cost of the track.
        nulls: Null vectors of each tool, in the planned joints, each of shape (N, dof).
        slope: Derivatives of c, shape (tools, N).
        bend: Gauss-Newton second derivatives of c, shape (tools, N).
    """

    cost: float
    nulls: list[Array]
    slope: Array
    bend: Array


class LineTracker:
    """Finds joint motions along a path of tool poses, for a robot among obstacles."""

    def __init__(self, checker: CollisionChecker, tools: Sequence[Tool], path: ToolPath, stop: Stop) -> None:
        """Prepare the search.

        Args:
            checker: Collision checker.
            tools: The tools.
            path: Their path.
            stop: Called often; where it returns True, the search ends with what it has.
        """
        self.checker, self.tools, self.path, self.stop = checker, Tools(checker.kernel, tools), path, stop
        limits = checker.robot.limits
        self.lower, self.upper = limits.lower, limits.upper
        self.moving = distinct(np.concatenate([tool.columns for tool in tools]))
        self.grid = path.grid(SPACING)

    def follow(self, start: Array) -> Track:
        """Return the states from a start, shape (dof,), as far as they are free, inside the limits and near each other.

        All are nearer together than the poses ask for; the last one is as far as the search got.
        """
        track = self.tracked(Track(self.grid[:1], start[None]))
        best = track.upto(self.free_count(track))
        if self._complete(best) and not self._cost(best):
            return best
        for _ in range(ROUNDS):
            before = len(best.u)
            for improved in (self.relaxed, self.chosen):
                if self.stop() or len(track.u) < 2:
                    return best
                track = improved(track)
                count = self.free_count(track)
                best = track.upto(count) if count >= len(best.u) else best
                if self._complete(best):
                    return best
            count, track = len(track.u), self.tracked(track)
            if len(track.u) == count or len(best.u) == before:
                break
        return best

    def tracked(self, track: Track) -> Track:
        """Return a track continued by the pseudoinverse as far as it gets; limits and obstacles do not count."""
        u, q = list(track.u), list(track.states)
        at, state, count = u[-1], q[-1], len(u)
        step = TRACKED
        while count < len(self.grid) and step >= SHORTEST and not self.stop():
            ahead = self.grid[count:]
            stop = self.path.ends[np.searchsorted(self.path.ends, at + 1e-12)]
            to = min(at + step, float(stop))
            passed = ahead[ahead <= to + 1e-12]
            wanted = np.append(passed, to)
            found, ok = self._closed(state[None], wanted[-1:])
            far = float(np.abs(found[0] - state).max())
            if not ok[0] or far > LARGEST_STEP * max(1.0, (to - at) / SPACING):
                step *= 0.5
                continue
            if len(passed):
                share = ((passed - at) / (to - at))[:, None]
                between, closed = self._closed(state + share * (found - state), passed)
                if not closed.all():
                    step *= 0.5
                    continue
                u += passed.tolist()
                q += list(between)
                count += len(passed)
            at, state = to, found[0]
            step = min(2.0 * step, TRACKED)
        return Track(np.array(u), np.array(q))

    def relaxed(self, track: Track) -> Track:
        """Return a track with its states moved along the null spaces to less cost."""
        u, q, damping = track.u, track.states, FIRST_DAMPING
        at = self._slopes(track)
        for _ in range(RELAXATIONS):
            if self.stop():
                break
            moved = q.copy()
            for f, null in enumerate(at.nulls):
                moved += self._step(Track(u, q), at, f, damping)[:, None] * null
            moved, ok = self._closed(moved, u)
            moved[0] = q[0]
            if ok[1:].all() and self._cost_of(Track(u, moved)) < at.cost:
                q, before = moved, at.cost
                at, damping = self._slopes(Track(u, q)), damping / 4.0
                if before - at.cost < LEAST_GAIN * before:
                    break
            elif damping > 1e3:
                break
            else:
                damping = max(damping, 1e-4) * 8.0
        return Track(u, q)

    def chosen(self, track: Track) -> Track:
        """Return a track by dynamic programming over self-motions, one tool after the other; it may be shorter.

        The other tools stay on their tracks, and those that are chosen later may still collide in the first round.
        """
        count = len(self.tools.tools)
        for turn in range(count if count == 1 else count + 1):
            f, hard = turn % count, turn >= count - 1
            if self.stop():
                break
            track = self._chosen(track, f, hard)
        smooth = self.relaxed(track) if len(track.u) > 1 else track
        return max((smooth, track), key=self.free_count)

    def refined(self, track: Track) -> Track:
        """Return a track with more states, so that straight lines in between keep the poses; or as far as they do."""
        u, q = track
        for count in range(REFINEMENTS + 1):
            middle_u = 0.5 * (u[:-1] + u[1:])
            middle = 0.5 * (q[:-1] + q[1:])
            error = pose_errors(*self.tools.poses(middle), *self.path.poses(middle_u))
            size = np.maximum(np.abs(error[..., :3]), TURN * np.abs(error[..., 3:])).max(axis=(1, 2))
            split = np.flatnonzero(size > CHORD)
            if not len(split):
                break
            if count == REFINEMENTS:
                return Track(u, q).upto(int(split[0]) + 1)
            found, ok = self._closed(self._guesses(u, q)[split], middle_u[split])
            apart = np.abs(q[split + 1] - q[split]).max(axis=1)
            ok &= np.abs(found - middle[split]).max(axis=1) <= 0.5 * apart + 1e-3
            bad = split[~ok]
            if len(bad):
                end = int(bad[0])
                split, found = split[split < end], found[: int(np.searchsorted(split, end))]
                u, q, middle_u = u[: end + 1], q[: end + 1], middle_u[:end]
            u = np.insert(u, split + 1, middle_u[split])
            q = np.insert(q, split + 1, found, axis=0)
        return Track(u, q)

    def free_count(self, track: Track) -> int:
        """Return how many states from the first on are free, inside the limits, and near the one before."""
        fine = self._inside(track.states)
        fine[1:] &= np.abs(np.diff(track.states, axis=0)).max(axis=1) <= JUMP
        fine[0] = True
        count = len(fine) if fine.all() else int(np.argmin(fine))
        free = self.checker.are_free(track.states[1:count])
        return count if free.all() else 1 + int(np.argmin(free))

    def extended(self, track: Track, to: float) -> Track:
        """Return a track that ends at the last place before a parameter that it reaches, by bisection.

        It ends a little away from bodies, so that a motion may end there.
        """
        u, q = track
        while len(u) > 1 and self.checker.clearance(q[-1]) < ROOM:
            u, q, to = u[:-1], q[:-1], float(u[-1])
        low, high = float(u[-1]), to
        for _ in range(BISECTIONS):
            middle = 0.5 * (low + high)
            found, ok = self._closed(q[-1:], np.array([middle]))
            near = float(np.abs(found - q[-1]).max()) <= JUMP
            if ok[0] and near and self._inside(found)[0] and self.checker.clearance(found[0]) >= ROOM:
                low, u, q = middle, np.append(u, middle), np.append(q, found, axis=0)
            else:
                high = middle
        return Track(u, q)

    def _complete(self, track: Track) -> bool:
        return len(track.u) == len(self.grid)

    def _closed(self, q: Array, u: Array) -> tuple[Array, Flags]:
        return self.tools.close(q, *self.path.poses(u))

    def _inside(self, states: Array) -> Flags:
        return np.asarray(((states >= self.lower) & (states <= self.upper)).all(axis=1), bool)

    def _guesses(self, u: Array, q: Array) -> Array:
        """Return states in the middle between neighbors by cubic interpolation, or linear next to stops."""
        middle = 0.5 * (q[:-1] + q[1:])
        steps, stops = np.diff(u), np.isin(u, self.path.stops)
        even = (np.abs(steps[1:-1] - steps[:-2]) < 1e-9) & (np.abs(steps[1:-1] - steps[2:]) < 1e-9)
        even &= ~(stops[1:-2] | stops[2:-1])
        inner = np.flatnonzero(even) + 1
        middle[inner] += (q[inner] - q[inner - 1] - q[inner + 2] + q[inner + 1]) / 16.0
        return middle

    def _state_costs(self, states: Array, at: Sequence[Linearization]) -> Array:
        clear = self.checker.kernel.clearance(states, CLEARANCE)
        room = np.minimum(states - self.lower, self.upper - states)[:, self.moving]
        lacks = [WEIGHTS[0] * _lack(clear, CLEARANCE) ** 2, WEIGHTS[1] * _lack(room, LIMIT) ** 2]
        lacks += [WEIGHTS[2] * _lack(one.manipulability[:, None], MANIPULABILITY) ** 2 for one in at]
        return np.asarray(0.5 * sum(lack.sum(axis=1) for lack in lacks))

    def _cost(self, track: Track) -> float:
        """Return the cost of the states alone."""
        costs = self._state_costs(track.states, self.tools.linearizations(track.states))
        return float((_spans(track.u) * costs)[1:].sum())

    def _cost_of(self, track: Track) -> float:
        steps = np.diff(track.states, axis=0)
        return self._cost(track) + 0.5 * SMOOTHNESS * float(((steps * steps).sum(axis=1) / np.diff(track.u)).sum())

    def _slopes(self, track: Track) -> _Slopes:
        q = track.states
        at = self.tools.linearizations(q)
        clear, gradient = self.checker.kernel.clearance_gradient(q, CLEARANCE)
        lack = _lack(clear, CLEARANCE)
        nulls, slopes, bends = list[Array](), list[Array](), list[Array]()
        for f, (tool, one) in enumerate(zip(self.tools.tools, at, strict=True)):
            own = null_directions(one)
            null = np.zeros_like(q)
            null[:, tool.columns] = own
            along = (gradient * null[:, None]).sum(axis=2) / CLEARANCE
            slope = -WEIGHTS[0] * (lack * along).sum(axis=1)
            bend = WEIGHTS[0] * (along * along * (lack > 0.0)).sum(axis=1)
            for room, sign in ((q - self.lower, 1.0), (self.upper - q, -1.0)):
                short = _lack(room[:, tool.columns], LIMIT)
                slope -= WEIGHTS[1] * sign * (short * own).sum(axis=1) / LIMIT
                bend += WEIGHTS[1] * (own * own * (short > 0.0)).sum(axis=1) / LIMIT**2
            near = np.flatnonzero(one.manipulability < MANIPULABILITY)
            if len(near):
                probes = np.concatenate([q[near] + PROBE * null[near], q[near] - PROBE * null[near]])
                up, down = self.tools.linearizations(probes)[f].manipulability.reshape(2, -1)
                steep = (up - down) / (2.0 * PROBE * MANIPULABILITY)
                slope[near] -= WEIGHTS[2] * _lack(one.manipulability[near], MANIPULABILITY) * steep
                bend[near] += WEIGHTS[2] * steep * steep
            nulls.append(null)
            slopes.append(slope)
            bends.append(bend)
        return _Slopes(self._cost_of(track), nulls, np.stack(slopes), np.stack(bends))

    def _step(self, track: Track, at: _Slopes, f: int, damping: float) -> Array:
        """Return steps along a tool's null vectors by its tridiagonal system, shape (N,), 0 for the first state."""
        weight, span, null = SMOOTHNESS / np.diff(track.u), _spans(track.u), at.nulls[f]
        pull = weight[:, None] * np.diff(track.states, axis=0)
        right = -span * at.slope[f]
        right[1:] -= (pull * null[1:]).sum(axis=1)
        right[:-1] += (pull * null[:-1]).sum(axis=1)
        size = (null * null).sum(axis=1)
        diagonal = span * (at.bend[f] + damping) + 1e-9
        diagonal[1:] += weight * size[1:]
        diagonal[:-1] += weight * size[:-1]
        beside = -weight * (null[1:] * null[:-1]).sum(axis=1)
        steps = _tridiagonal(diagonal[1:], beside[1:], right[1:])
        found: Array = np.clip(np.append(0.0, steps), -LARGEST_MOVE, LARGEST_MOVE)
        return found

    def _chosen(self, track: Track, f: int, hard: bool) -> Track:
        u = track.u
        options, inside = self._self_motions(track, f)
        flat = options.reshape(-1, options.shape[-1])
        usable = inside.copy()
        rows = np.flatnonzero(inside)
        of_rows = np.full(len(flat), np.inf)
        of_rows[rows] = self._state_costs(flat[rows], self.tools.linearizations(flat[rows]))
        if hard:
            usable.ravel()[rows] = self.checker.are_free(flat[rows])
        costs = of_rows.reshape(inside.shape)
        center = options.shape[1] // 2
        total = np.full(inside.shape, np.inf)
        total[0, center] = 0.0
        came = np.zeros(inside.shape, np.intp)
        last, span = 0, _spans(u)
        for k in range(1, len(u)):
            if self.stop():
                break
            old, new = np.flatnonzero(np.isfinite(total[k - 1])), np.flatnonzero(usable[k])
            if not len(old) or not len(new):
                break
            steps = options[k, new][:, None] - options[k - 1, old][None]
            price = total[k - 1, old] + 0.5 * SMOOTHNESS * (steps * steps).sum(axis=2) / (u[k] - u[k - 1])
            price[np.abs(steps).max(axis=2) > JUMP] = np.inf
            best = price.argmin(axis=1)
            total[k, new] = price[np.arange(len(new)), best] + span[k] * costs[k, new]
            came[k, new] = old[best]
            if not np.isfinite(total[k]).any():
                break
            last = k
        way = [int(total[last].argmin())]
        for k in range(last, 0, -1):
            way.append(int(came[k, way[-1]]))
        return Track(u[: last + 1], options[np.arange(last + 1), way[::-1]])

    def _self_motions(self, track: Track, f: int) -> tuple[Array, Flags]:
        """Return states with the same poses, shape (N, 2 S + 1, dof), and which are inside the limits."""
        u, q = track
        count, columns = len(u), self.tools.tools[f].columns
        rotation, point = self.path.poses(u)
        null = np.zeros_like(q)
        null[:, columns] = null_directions(self.tools.linearizations(q)[f])
        options = np.repeat(q[:, None], 2 * SELF_STEPS + 1, axis=1)
        good = np.zeros(options.shape[:2], bool)
        good[:, SELF_STEPS] = self._inside(q)
        good[0, SELF_STEPS] = True
        both = np.concatenate([np.arange(1, count)] * 2)
        sign = np.repeat([1, -1], count - 1)
        state, way, alive = q[both], sign[:, None] * null[both], np.arange(len(both))
        for step in range(1, SELF_STEPS + 1):
            if not len(alive) or self.stop():
                break
            rows = both[alive]
            found, ok = self.tools.close(state[alive] + SELF_STEP * way[alive], rotation[rows], point[rows], steps=5)
            ok &= np.abs(found - state[alive]).max(axis=1) <= 2.0 * SELF_STEP
            ok &= np.abs(way[alive]).max(axis=1) > 0.0
            inside = self._inside(found)
            keep = ok & (inside | ~good[rows, SELF_STEPS + sign[alive] * (step - 1)])  # not out again once inside
            alive, found, inside = alive[keep], found[keep], inside[keep]
            rows = both[alive]
            options[rows, SELF_STEPS + sign[alive] * step] = found
            good[rows, SELF_STEPS + sign[alive] * step] = inside
            direction = np.zeros_like(found)
            direction[:, columns] = null_directions(self.tools.linearizations(found)[f])
            direction *= np.where((direction * way[alive]).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
            state[alive], way[alive] = found, direction
        return options, good


def _lack(values: Array, margin: float) -> Array:
    """Return which share of a margin values lack, 0 or more."""
    return np.asarray(np.maximum(0.0, 1.0 - values / margin))


def _spans(u: Array) -> Array:
    """Return the length of the path that each parameter stands for, shape (N,)."""
    half = 0.5 * np.diff(u)
    spans: Array = np.append(0.0, half) + np.append(half, 0.0)
    return spans


def _tridiagonal(diagonal: Array, beside: Array, right: Array) -> Array:
    """Return the solution of a symmetric tridiagonal system, shape (N,)."""
    d, b, x = diagonal.tolist(), beside.tolist(), right.tolist()
    for k in range(1, len(d)):
        share = b[k - 1] / d[k - 1]
        d[k] -= share * b[k - 1]
        x[k] -= share * x[k - 1]
    x[-1] /= d[-1]
    for k in range(len(d) - 2, -1, -1):
        x[k] = (x[k] - b[k] * x[k + 1]) / d[k]
    return np.array(x)
