"""A million samples at 1 kHz of motions that are handed over 20 to 50 ms ahead: no step over a limit.

Random motions of two arms and hands, straight in the joint space and timed to their limits, are sent by a driver's
rules; two in five are replaced in the middle by a stop and another motion, one in five is stopped. What each controller
gets, knots at whole nanoseconds, is followed by code that knows nothing of the package: polynomials of fifth degree,
from the stamp of a message to that of the next. Its positions each millisecond are differenced.

Handovers and the stops in them are at any time, or, as docs/drivers.md advises, at a knot of the motion where one is
less than a millisecond away. Between such a near knot and the exact state at the start there is no room for a knot of
its own, so that an acceleration lasts longer than it should.

With a step h, the first difference over h is the mean velocity of a step, the second over h^2 a mean of the
acceleration over two steps with the weights of a hat function, the third over h^3 a mean of the jerk over three with
those of a quadratic B-spline. So none exceeds the largest value of the motion, whose acceleration is continuous, also
where the jerk jumps at a knot. Where a handover or the rounding of times leaves a gap d in the position, the third
shows 3 d / h^3 at most: 3 rad/s^3 for a nanoradian. Motions keep limits to 1e-3 where knots are merged, else to 1e-9.

Usage: python -m benchmarks.physics.streaming [--samples 1000000]
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from apex_ompl.drivers.commands import Commands
from apex_ompl.drivers.controllers import Controllers
from apex_ompl.problems.suite_robot import robot
from apex_ompl.timing import Trajectory, joined, time_path
from apex_ompl.timing.trajectory import LEAST_SPACING
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import one_or_more
from benchmarks.lib import record
from benchmarks.timing.exported_motions import NANOSECONDS, Points, quintics

DEPENDS = ("@checking", "apex_ompl/timing", "apex_ompl/drivers", "benchmarks/timing/exported_motions.py")
SEED = 72
STEP = NANOSECONDS // 1000
AHEAD = 0.02, 0.05  # of handovers [s]
SPREAD = 0.7  # of the goals around home [rad]
SHARES = {"handover": 0.4, "stop": 0.2}  # of motions
ROOM = 1e-3  # by which motions with other knots may exceed a limit
CONTROLLERS = {"left_arm": slice(0, 7), "right_arm": slice(7, 14), "hands": slice(14, 16)}
WHERE = {"at knots that are near": True, "at any time": False}
Array = NDArray[np.float64]


class Message(NamedTuple):
    """What the controllers get: when it starts [ns], and the points of each."""

    start: int
    parts: list[Points]


class Client:
    """Sends motions, and keeps the messages; hands over at knots where they are near, or at any time."""

    def __init__(self, at_knots: bool) -> None:
        """Start at home."""
        self.at_knots = at_knots
        self.robot, self.rng = robot(), np.random.default_rng(SEED)
        names = self.robot.joint_names
        self.controllers = Controllers(names, {name: names[part] for name, part in CONTROLLERS.items()}, None)
        self.commands = Commands(names, self.robot.limits, self.robot.home)
        self.messages: list[Message] = []
        self.ahead: list[float] = []
        self.counts = {"motions": 0, "handovers": 0, "stops": 0}
        self.use = {"velocity": 0.0, "acceleration": 0.0, "jerk": 0.0}  # of the limits, by the motions themselves

    def line(self, start: Array) -> Trajectory:
        """Return a motion to a random state."""
        limits, dof = self.robot.limits, self.robot.dof
        goal = self.robot.home + self.rng.normal(0.0, SPREAD, dof)
        goal[CONTROLLERS["hands"]] = self.rng.random(2)
        goal = np.clip(goal, limits.lower + 0.01, limits.upper - 0.01)
        return time_path(np.stack([start, goal]), limits, self.robot.joint_names).trajectory

    def send(self, motion: Trajectory, at: float, now: float) -> None:
        """Send a motion that starts at a time [s]."""
        self.commands.send(motion, at, now)
        self._tell(motion, at)
        self.commands.forget(now)

    def stop(self, at: float) -> None:
        """Stop."""
        self._tell(self.commands.stop(at), at)

    def turn(self, now: float) -> float:
        """Send a motion, and what replaces it; return the time at which the robot is at rest again [s]."""
        at = self._soon(now)
        motion = self.line(self.commands.states(np.array([at]))[0, 0])
        self.send(motion, at, now)
        self.counts["motions"] += 1
        kind = self.rng.random()
        later = at + self.rng.uniform(0.05, 0.9) * motion.duration
        if kind < SHARES["handover"]:
            since = self._chosen(motion, self._soon(later) - at)
            if since < motion.duration - 0.05:
                rest = motion.after(since)
                rest = rest.stop_at(self._chosen(rest, self.rng.uniform(0.0, 0.05)), self.robot.limits)
                self.send(joined([rest, self.line(rest.positions[-1])]), at + since, later)
                self.counts["handovers"] += 1
        elif kind < SHARES["handover"] + SHARES["stop"]:
            self.stop(self._soon(later))
            self.counts["stops"] += 1
        return self.commands.end

    def _chosen(self, motion: Trajectory, time: float) -> float:
        """Return a time of a motion, or the knot less than a millisecond from it, in whole nanoseconds [s]."""
        knot = float(motion.times[np.abs(motion.times - time).argmin()])
        chosen = knot if self.at_knots and abs(knot - time) < LEAST_SPACING else time
        return round(chosen * NANOSECONDS) / NANOSECONDS

    def _soon(self, now: float) -> float:
        ahead = self.rng.uniform(*AHEAD)
        self.ahead.append(ahead)
        return round((now + ahead) * NANOSECONDS) / NANOSECONDS

    def _tell(self, motion: Trajectory, at: float) -> None:
        parts = [
            Points(np.array([one[0] for one in part.points], np.int64),
                   np.moveaxis(np.array([one[1:] for one in part.points]), 1, 0), tuple(part.joints))
            for part in self.controllers.parts(motion)
        ]  # fmt: skip
        use = motion.use(self.robot.limits)
        self.use = {name: max(most, use[name]) for name, most in self.use.items()}
        self.messages.append(Message(round(at * NANOSECONDS), parts))


def followed(points: Points, since: NDArray[np.int64]) -> Array:
    """Return the positions of a controller at times since the start of a message, shape (N,) [ns]."""
    if len(points.nanoseconds) == 1:
        return np.tile(points.states[0, 0], (len(since), 1))
    c, h = quintics(points)
    k = np.clip(np.searchsorted(points.nanoseconds, since, side="right") - 1, 0, len(h) - 1)
    share = np.minimum((since - points.nanoseconds[k]) / np.diff(points.nanoseconds)[k], 1.0)[:, None]
    found = np.zeros((len(since), c.shape[2]))
    for power in range(5, -1, -1):
        found = found * share + c[power, k]
    return found


def sampled(messages: list[Message], count: int) -> Array:
    """Return the positions at each millisecond from the first message on, shape (count, dof)."""
    times = messages[0].start + STEP * np.arange(count, dtype=np.int64)
    found = np.empty((count, sum(len(part.joints) for part in messages[0].parts)))
    begins = [int(np.searchsorted(times, message.start)) for message in messages] + [count]
    for message, begin, end in zip(messages, begins[:-1], begins[1:], strict=True):
        parts = [followed(part, times[begin:end] - message.start) for part in message.parts]
        found[begin:end] = np.hstack(parts)
    return found


def largest(q: Array) -> dict[str, Any]:
    """Return the largest share of each limit by differences, and how many steps exceed it."""
    limits, h = robot().limits, STEP / NANOSECONDS
    found: dict[str, Any] = {}
    differences = q
    for order, (name, limit) in enumerate(
        {"velocity": limits.velocity, "acceleration": limits.acceleration, "jerk": limits.jerk}.items(), 1
    ):
        differences = np.diff(differences, axis=0)
        shares = (np.abs(differences) / h**order / limit).max(axis=1)
        found[name] = {
            "largest": float(shares.max()),
            "p99": float(np.percentile(shares, 99)),
            "over": int((shares > 1.0).sum()),
            "over by 0.1 %": int((shares > 1.0 + ROOM).sum()),
        }
    return found


def streamed(count: int, at_knots: bool) -> tuple[Client, dict[str, Any]]:
    """Return a client, and what differences of its samples show."""
    client, now = Client(at_knots), 0.0
    with tqdm(total=count / 1000, unit="s") as bar:
        while now < count / 1000 + 0.1:
            before, now = now, client.turn(now)
            bar.update(now - before)
    return client, largest(sampled(client.messages, count))


def main() -> None:
    """Measure, and write the results."""
    parser = record.parser(__doc__ or "")
    parser.add_argument("--samples", type=one_or_more, default=10**6, help="at 1 kHz (default: %(default)s)")
    count = parser.parse_args().samples
    head = [
        "handovers", "by differences", "largest share of the limit", "that of the motions", "p99", "steps over",
        "by more than 0.1 %",
    ]  # fmt: skip
    lines, texts, data = [record.row(head), record.row(["---"] * len(head))], list[str](), dict[str, Any]()
    for where, at_knots in WHERE.items():
        client, found = streamed(count, at_knots)
        for name, row in found.items():
            shares = f"{row['largest']:.6f}", f"{client.use[name]:.6f}", f"{row['p99']:.4f}"
            lines.append(record.row([where, name, *shares, row["over"], row["over by 0.1 %"]]))
        ahead = 1e3 * np.array(client.ahead)
        counts = ", ".join(f"{number} {name}" for name, number in client.counts.items())
        texts.append(f"{where}: {counts}; {len(client.messages)} messages to each of {len(CONTROLLERS)} controllers, "
                     f"{ahead.min():.0f} to {ahead.max():.0f} ms ahead.")  # fmt: skip
        data[where] = {
            "differences": found,
            "use of the motions": client.use,
            "counts": client.counts,
            "messages": len(client.messages),
        }
    text = "\n".join([*lines, "", f"{count} samples of {client.robot.dof} joints a row.", *texts])
    record.write("physics_streaming", data, text, samples=count, seed=SEED)


if __name__ == "__main__":
    run_script(main)
