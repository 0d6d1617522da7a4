"""Plans along straight lines of tools: what :meth:`apex_ompl.MotionPlanner.plan_line` does and returns."""

from __future__ import annotations

import math
import os
import pathlib
import time as clock
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from math import nan
from typing import Any

import numpy as np

from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.path_proof import PathProof
from apex_ompl.constraints.line import ToolPath, are_same
from apex_ompl.constraints.line_ends import DeadEnd, LineEnd, collision, dead_end
from apex_ompl.constraints.line_proof import Deviation, motion_deviation, path_deviation
from apex_ompl.constraints.line_tracking import LineTracker, Track
from apex_ompl.constraints.tools import Tools
from apex_ompl.errors import FileFormatError, TimingError, TimingStoppedError
from apex_ompl.ompl.setup import state_fault
from apex_ompl.ompl.validity import full_check
from apex_ompl.paths.path import Path
from apex_ompl.planning.line_query import LineQuery
from apex_ompl.planning.step_records import certificate
from apex_ompl.result import PlanResult, PlanStatus
from apex_ompl.robot.identity import digest
from apex_ompl.timing import Timing, Trajectory, time_path
from apex_ompl.timing.trajectory import ROUNDING, joined
from apex_ompl.types import Array
from apex_ompl.util.clocks import Deadline, timed
from apex_ompl.util.display import one_line
from apex_ompl.util.files import read_archive
from apex_ompl.util.schema import read_json, read_yaml

POSITION, ANGLE = 1e-4, math.radians(0.1)
"""Largest distance from the line [m], and from the shortest turn [rad]."""
NAME = "line"
JOINT_DEVIATION = 0.004  # of a motion from the joint path, that is tried first [rad]
SPEED_SPACING = 2e-3  # of the samples of tool speeds [s]
SPEED_SHARE = 0.999  # of the speed, that a motion is slowed down to
SLOWED_AGAIN = 3
CUTS = 8  # of a path whose proof fails


@dataclass(frozen=True, eq=False)
class LineResult(PlanResult):
    """Outcome of one call of ``plan_line``; true only where the tools reach the last pose, and move there.

    Where they do not, the status is APPROXIMATE_SOLUTION, and ``path`` and ``partial_motion`` lead as far as they go.

    Attributes:
        share: Share of the line that ``path`` covers, 0 to 1.
        end: Why it ends there.
        blocked_by: Joints at their limits, or the two bodies that collide.
        line_distance: Bound of the distance of the tools' origins from the line, along path and motion [m].
        line_angle: Bound of the angle to the orientation that goes with the place on the line [rad].
        partial_motion: The timed motion along ``path`` where that does not reach the end; files do not hold it.
    """

    share: float = 0.0
    end: LineEnd = LineEnd.REACHED
    blocked_by: tuple[str, ...] = ()
    line_distance: float = nan
    line_angle: float = nan
    partial_motion: Trajectory | None = None

    def __repr__(self) -> str:
        """Return the status, the share and what was found, in one line."""
        made = self.trajectory or self.partial_motion
        motion = "" if made is None else f"motion {made.duration:.3f} s"
        share = f"{100.0 * self.share:.4g} % of the line"
        return one_line("LineResult", str(self.status), repr(self.problem.name), share, motion, self.reason)

    def as_dict(self) -> dict[str, Any]:
        """Return the fields as plain data, ready for JSON, those of the line as ``line``."""
        line = {name: getattr(self, name) for name in ("share", "end", "blocked_by", "line_distance", "line_angle")}
        line |= {name: None for name, value in line.items() if isinstance(value, float) and math.isnan(value)}
        return super().as_dict() | {"line": line | {"end": str(self.end), "blocked_by": list(self.blocked_by)}}

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> LineResult:
        """Read a result that was saved as .npz, .json or .yaml.

        Raises:
            ApexError: As :meth:`apex_ompl.PlanResult.load`, or the file holds no line.
        """
        found, file = super().load(path), os.fspath(path)
        assert isinstance(found, LineResult)
        if file.endswith(".npz"):
            data = read_archive(pathlib.Path(file), "result", "result file")[0]
        else:
            data = (read_json if file.endswith(".json") else read_yaml)(pathlib.Path(file), "result file")
        try:
            line = data["line"]
            distance, angle = (nan if line[k] is None else float(line[k]) for k in ("line_distance", "line_angle"))
            share, end, blocked_by = float(line["share"]), LineEnd(line["end"]), tuple(map(str, line["blocked_by"]))
        except (KeyError, TypeError, ValueError) as error:
            raise FileFormatError(file, "line", str(error), "expected the result of a line") from error
        return replace(found, share=share, end=end, blocked_by=blocked_by, line_distance=distance, line_angle=angle)


def plan_along(checker: CollisionChecker, query: LineQuery, deadline: Deadline, ends: Callable[[], bool]) -> LineResult:
    """Return the result of a plan along a line.

    Args:
        checker: Collision checker.
        query: What :func:`apex_ompl.planning.line_query.line_query` returned.
        deadline: When the plan is to be ready.
        ends: Whether no time is left.

    Raises:
        ParameterError: The radius of blends is larger than half a segment.
    """
    started, times = clock.perf_counter(), dict[str, float]()
    robot, start = checker.robot, query.start
    path = None if are_same(query.poses) else ToolPath.through(query.poses, query.blend)
    result = LineResult(
        status=PlanStatus.EXACT_SOLUTION, reason="", problem=query.problem, robot=robot.name,
        joint_names=robot.joint_names, planner=NAME, seed=0, robot_digest=digest(robot), solved_by=NAME,
    )  # fmt: skip
    fault = state_fault(checker, start)
    if fault:
        kind = LineEnd.JOINT_LIMIT if robot.limit_fault(start) else LineEnd.COLLISION
        return replace(result, status=PlanStatus.INVALID_START, reason=fault, end=kind, solved_by="")
    if path is None:
        rest = time_path(start[None], robot.limits, robot.joint_names).trajectory if query.timing else None
        return replace(result, path=Path(start[None]), trajectory=rest, share=1.0, length=0.0, line_distance=0.0)
    tracker = LineTracker(checker, query.tools, path, lambda: ends() or deadline.for_search <= 0.0)
    with timed(times, "solve"):
        track, end = _followed(tracker, start)
    with timed(times, "verify"):
        track, proof, off, end = _proved(tracker, track, end, deadline)
    if proof is None:
        return replace(result, **_stopped(end, 0.0), times={**times, "total": clock.perf_counter() - started})
    share = 1.0 if end is None else float(track.u[-1]) / path.length
    found = Path(track.states)
    result = replace(
        result, path=found, length=found.length, line_distance=off.position, line_angle=off.angle,
        **certificate(proof), **({"share": 1.0} if end is None else _stopped(end, share)),
    )  # fmt: skip
    if query.timing is not None and len(track.u) > 1:
        with timed(times, "timing"):
            result = _timed(tracker, track, query, result, deadline, ends=ends)
    times["total"] = clock.perf_counter() - started
    return replace(result, times=times, checks=checker.check_counts.states)


def _followed(tracker: LineTracker, start: Array) -> tuple[Track, DeadEnd | None]:
    """Return the track as far as it goes, with all its states, and why it ends, or None at the end of the line."""
    track, end = tracker.follow(start), None
    if len(track.u) < len(tracker.grid):
        if tracker.stop():
            end = _OUT_OF_TIME
        else:
            track = tracker.extended(track, float(tracker.grid[len(track.u)]))
            end = dead_end(tracker, track)
    fine = tracker.refined(track)
    if fine.u[-1] < track.u[-1]:
        end = DeadEnd(LineEnd.SINGULARITY, (), "the arm goes on through another branch only")
    return fine, end


def _proved(
    tracker: LineTracker, track: Track, end: DeadEnd | None, deadline: Deadline
) -> tuple[Track, PathProof | None, Deviation, DeadEnd | None]:
    """Return the longest part of a track that is proved, its proof if any, its deviation, and why it ends."""
    for _ in range(CUTS):
        check = full_check(tracker.checker, track.states, track.states[0], deadline=deadline.at)
        off = path_deviation(tracker.tools, tracker.path, track.u, track.states)
        if check.timed_out or (check and max(off.position / POSITION, off.angle / ANGLE) > 1.0):
            return track, None, off, _OUT_OF_TIME
        if check:
            return track, check.proof, off, end
        end = DeadEnd(LineEnd.COLLISION, (), check.reason)
        if check.proof is not None:
            state, proof = check.proof.state, check.proof
            touching = DeadEnd(LineEnd.COLLISION, proof.pair, proof.reason)
            end = touching if tracker.checker.is_free(state) else collision(tracker, state)
        track = track.upto((check.segment or 0) + 1)
    return track, None, off, end


def _timed(
    tracker: LineTracker, track: Track, query: LineQuery, result: LineResult, deadline: Deadline, *,
    ends: Callable[[], bool],
) -> LineResult:  # fmt: skip
    """Return a result with its motion, or why there is none."""
    assert query.timing is not None
    robot, checker, tools, path = tracker.checker.robot, tracker.checker, tracker.tools, tracker.path
    limits, names = robot.limits, robot.joint_names
    how = _with_speed(query, query.timing)
    scaled, held = how.limits(limits, names), tuple(checker.held.values())
    more = how.motion_limits(robot, held, query.problem.payload)
    parts, offs, clear = list[Trajectory](), [Deviation(result.line_distance, result.line_angle)], [math.inf]
    joint_deviation, method = 0.0, ""
    for low, high in _sections(path, track):
        u, states = track.u[low : high + 1], track.states[low : high + 1]

        def fault(motion: Trajectory, u: Array = u, states: Array = states) -> str:
            over = [f"{name} {share:.4f}" for name, share in motion.use(scaled).items() if share > 1.0 + ROUNDING]
            if over:
                return f"the share of a limit that it uses is over 1: {', '.join(over)}"
            off = motion_deviation(tools, path, u, states, motion.knots)
            if off.position > POSITION or off.angle > ANGLE:
                return f"it is up to {1e3 * off.position:.3f} mm and {math.degrees(off.angle):.3f} degrees off the line"
            check = full_check(checker, motion, states[0], states[-1:], deadline=deadline.at)
            if check and check.proof is not None:
                offs.append(off)
                clear.append(check.proof.clearance)
            return check.reason

        share = (u[-1] - u[0]) / track.u[-1]
        section = replace(how, minimum_duration=float(share * how.minimum_duration))
        try:
            made = time_path(states, limits, names, section, fault, stop=ends, motion_limits=more)
            motion = _slowed(made.trajectory, tools, query.speed, fault)
        except TimingStoppedError:
            return replace(result, status=PlanStatus.TIMEOUT, reason="a path was found but not timed in time")
        except TimingError as error:
            fault_of_all = f"the path cannot be timed, {error}"
            if not result:  # which says already why the line ends early
                return replace(result, reason=f"{result.reason}; {fault_of_all}")
            return replace(result, status=PlanStatus.TIMING_FAILED, reason=fault_of_all)
        parts.append(motion)
        joint_deviation, method = max(joint_deviation, made.deviation), made.method
    motion = joined(parts)
    result = replace(
        result, limit_use=motion.use(limits) | ({} if more is None else more.use(motion)), deviation=joint_deviation,
        timing_method=method, motion_clearance=min(clear), line_distance=max(off.position for off in offs),
        line_angle=max(off.angle for off in offs),
    )  # fmt: skip
    return replace(result, trajectory=motion) if result else replace(result, partial_motion=motion)


def _with_speed(query: LineQuery, timing: Timing) -> Timing:
    """Return a timing near the joint path, with the speed of the tools among its limits."""
    timing = replace(timing, deviation=min(timing.deviation, JOINT_DEVIATION))
    if query.speed is None:
        return timing
    given, mine = timing.max_tool_speed, dict.fromkeys(query.names, query.speed)
    if given is None or isinstance(given, Mapping):
        given = dict(given or {})
        return replace(timing, max_tool_speed=given | {k: min(v, given.get(k, v)) for k, v in mine.items()})
    return replace(timing, max_tool_speed=min(given, query.speed))


def _slowed(motion: Trajectory, tools: Tools, speed: float | None, fault: Callable[[Trajectory], str]) -> Trajectory:
    """Return a motion slowed down until no tool is faster than a speed [m/s].

    Raises:
        TimingError: The slower motion is faulty.
    """
    for _ in range(SLOWED_AGAIN if speed is not None else 0):
        assert speed is not None
        sample = motion.sample(min(SPEED_SPACING, max(motion.duration, 1e-6) / 100.0))
        fastest = float(tools.speeds(sample.position, sample.velocity).max())
        if fastest <= speed:
            break
        motion = motion.slower(fastest / (SPEED_SHARE * speed)).merged()
        reason = fault(motion)
        if reason:
            raise TimingError(reason)
    return motion


def _sections(path: ToolPath, track: Track) -> list[tuple[int, int]]:
    """Return first and last state of each part of a track from stop to stop."""
    places = [int(np.abs(track.u - stop).argmin()) for stop in path.stops if stop < track.u[-1]]
    return [(a, b) for a, b in zip(places, [*places[1:], len(track.u) - 1], strict=True) if b > a]


def _stopped(end: DeadEnd | None, share: float) -> dict[str, Any]:
    """Return what a result says of a line that ends early."""
    assert end is not None
    late = end.end is LineEnd.TIMEOUT
    return {
        "status": PlanStatus.TIMEOUT if late else PlanStatus.APPROXIMATE_SOLUTION,
        "reason": f"the line ends after {100.0 * share:.4g} % of it: {end.reason}",
        "end": end.end, "blocked_by": end.names, "share": share,
    }  # fmt: skip


_OUT_OF_TIME = DeadEnd(LineEnd.TIMEOUT, (), "the time is over")
