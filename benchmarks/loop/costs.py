"""Costs of work in the closed loop: the table by which the simulated clock charges it, measured on this machine.

Each kind of work is timed in worlds of the validation split: the median over the worlds of the least of five calls.
That is too little for what replans take, where nothing is in the caches and there is work of no kind besides. So runs
on the simulated clock are timed as well, of each replanner in turn: what their replans took in sum, by what
they were charged, is a factor on the kinds of work that no way before used. With --write the table becomes that of the
package, under the next version number.

With --add, only kinds of work that the package's table does not have are added to it, by what they take compared with a
kind that it has, timed side by side: the others stay, and so do runs that have no work of the new kinds.

Usage: python -m benchmarks.loop.costs [-n 30] [--runs 30] [--write] [--add "proved stop"]
"""

from __future__ import annotations

import json
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from apex_ompl.baselines.control.mppi import PathIntegral, softmax
from apex_ompl.baselines.control.potential_field import PotentialField
from apex_ompl.baselines.control.short_horizon import Horizon
from apex_ompl.baselines.damon.lazy_search import LazySearch
from apex_ompl.baselines.damon.replanner import DamonReplanner
from apex_ompl.baselines.drrt.dynamic_rrt import GoalTree
from apex_ompl.baselines.drrt.replanner import Clearances, DynamicRRTReplanner
from apex_ompl.baselines.gpmp.replanner import WORK, IncrementalGPMP2
from apex_ompl.baselines.imitation.replanner import ImitationReplanner
from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ParameterError, UnknownNameError
from apex_ompl.loop.replan.one_plan import OneProposal, RRTConnectFromRest
from apex_ompl.loop.replan.sources import WORK as SPRINT
from apex_ompl.loop.replan.sources import Proposals, Sprint
from apex_ompl.moving.compute_costs import TABLE, ComputeBudget, cost_table
from apex_ompl.moving.context import Following, RunContext
from apex_ompl.moving.dynamic_obstacles import DynamicObstacles, clearance_in_time, curve_of, prove_motion
from apex_ompl.moving.motion_optimizer import MotionOptimizer
from apex_ompl.moving.replanner import Request
from apex_ompl.moving.retime import retime
from apex_ompl.moving.search import AGE, GUARDED, MOTIONS, SPREAD, Search
from apex_ompl.moving.settings import LoopSettings
from apex_ompl.ompl.process import quiet_ompl
from apex_ompl.ompl.setup import assemble
from apex_ompl.paths.optimizer import Optimizer
from apex_ompl.problems import worlds
from apex_ompl.timing import time_path
from apex_ompl.timing.ruckig_method import between, through
from apex_ompl.timing.timed_spline import Start, TimedSpline
from apex_ompl.types import Array, Flags
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.files import write_atomically
from apex_ompl.util.validation import one_or_more
from benchmarks.lib import record
from benchmarks.lib.record import fastest
from benchmarks.loop.replan_times import replan_times

DEPENDS = ("@planning", "apex_ompl/moving", "apex_ompl/loop", "apex_ompl/baselines", "apex_ompl/timing")
PLANNERS = (
    "apex", "no-network", "retime", "apex-sprint", "rrtconnect", "potential-field", "mppi", "gpmp2", "drrt", "damon",
    "il", "apex-paper", "apex-paper-unguided",
)  # fmt: skip
LEAST_FACTOR = 0.5
LEAST_SHARE = 0.1  # of what replans took that work of new kinds must be charged for, to be scaled


def interval_of_proof(context: RunContext) -> float:
    """Return what an interval of a proof by spheres alone costs, of a motion of the robot without obstacles [s]."""
    checker, rng = CollisionChecker(context.setup.robot), np.random.default_rng(0)
    for _ in range(100):
        ends = context.setup.robot.home + rng.normal(size=(2, len(context.names))) * 0.3
        ends[:, context.fingers] = 0.5
        motion = time_path(
            np.clip(ends, context.limits.lower, context.limits.upper), context.limits, context.names
        ).trajectory
        proof = checker.prove(curve_of(motion), tolerance=0.0)
        if proof and proof.by_spheres == 1.0:
            return fastest(lambda m=motion: checker.prove(curve_of(m), tolerance=0.0)) / proof.intervals
    raise SystemExit("no motion is proved by spheres alone, expected one of 100")


def reachable(dynamic: DynamicObstacles, time: float) -> DynamicObstacles:
    """Return all that obstacles can reach which were seen at a time, where they are expected then [s]."""
    found = dynamic.larger(0.0)
    arrays = found.arrays
    arrays.place[:] += arrays.velocity * (time - arrays.stamp)[:, None]
    arrays.velocity[:], arrays.stamp[:], arrays.growth[:] = 0.0, time, (LoopSettings().error + SPREAD, 0.2)
    return found


def measured(name: str, found: dict[str, list[float]]) -> None:
    """Add what each kind of work costs a unit in a world [s]."""
    world = worlds.load(name)
    setup = assemble(world.problem.still)
    context = RunContext(setup, setup.robot.limits, setup.robot.limits, LoopSettings())
    kernel, limits, goal = context.kernel, context.limits, context.goals[0]
    dynamic = DynamicObstacles(world.present(0.0))
    ends = np.stack([setup.start, goal])
    found["straight motion"].append(fastest(lambda: time_path(ends, limits, context.names)))
    motion = time_path(ends, limits, context.names).trajectory
    still = np.zeros_like(ends)
    found["direct motion"].append(fastest(lambda: between(np.stack([ends, still, still]), limits, context.names)))
    pieces = motion.states(np.array([0.0, 0.5 * motion.duration, motion.duration]))
    piece = fastest(lambda: through(pieces, limits, context.names, 0.0))  # the first one is too long
    found["piece of a motion"].append(piece)
    found["joined motion"].append(fastest(lambda: through(pieces, limits, context.names)) - 2.0 * piece)
    one, half = Following(motion, 0.0), 0.5 * motion.duration
    then = half + context.settings.period
    found["proved stop"].append(fastest(lambda: context.proved_stop(reachable(dynamic, half), one, half, then)))
    moments = np.arange(0.0, motion.duration, GUARDED)
    looked, _ = context.foreseen_stops(dynamic, one, moments, AGE, SPREAD)
    if looked > 0:
        taken = fastest(lambda: context.foreseen_stops(dynamic, one, moments, AGE, SPREAD))
        found["foreseen stop"].append(taken / min(looked + 1, len(moments)))
    found["stop joint by joint"].append(fastest(lambda: context.clear_stop(one, half, along=False)))
    curve = curve_of(motion)
    rate = interval_of_proof(context)
    found["proof interval"].append(rate)
    proof = context.checker.prove(curve, tolerance=0.0)
    taken = fastest(lambda: context.checker.prove(curve, tolerance=0.0))
    if proof.by_spheres < 1.0:
        found["exact proof"].append(max(taken - rate * proof.intervals, 0.0))
    intervals = prove_motion(kernel, dynamic, motion).intervals
    found["interval among dynamic obstacles"].append(
        fastest(lambda: prove_motion(kernel, dynamic, motion)) / max(intervals, 1)
    )
    line = np.linspace(setup.start, goal, 64)
    spline = TimedSpline.along(line, motion.duration, Start.at_rest(setup.start), goal)
    optimizer = MotionOptimizer(kernel, dynamic, limits, MOTIONS)
    optimizer.improve(spline, steps=4)
    count = optimizer.samples
    found["sample of a motion"].append(fastest(lambda: optimizer.improve(spline, steps=4)) / count)
    found["retiming"].append(fastest(lambda: retime(kernel, dynamic, motion, limits)))
    times = np.linspace(0.0, motion.duration, 64)
    found["clearance in time"].append(fastest(lambda: clearance_in_time(kernel, dynamic, line, times, 0.3)) / 64)
    bent = np.stack([setup.start, 0.5 * (setup.start + goal) + 0.05, goal])
    bent = np.clip(
        Optimizer().spline.path(Optimizer().spline.fit(bent, limits.lower, limits.upper).control),
        limits.lower,
        limits.upper,
    )
    found["path in time"].append(fastest(lambda: time_path(bent, limits, context.names)))


def controls(name: str, found: dict[str, list[float]]) -> None:
    """Add what each kind of work of the controls over a short horizon, and of dynamic RRT, costs a unit in a world."""
    world = worlds.load(name)
    setup = assemble(world.problem.still)
    context = RunContext(setup, setup.robot.limits, setup.robot.limits, LoopSettings())
    dynamic, standing = DynamicObstacles(world.present(0.0)), Following.resting(setup.start, 0.0, context.names)
    search = Search(context, Request(1, 0.0, 0.05, standing, None, dynamic, dynamic, (), np.inf, 0), ComputeBudget(0.1))
    control, horizon = PathIntegral(), Horizon(context.limits)
    points = horizon.roll(search.start, control.tried(search, horizon))
    states = np.ascontiguousarray(points[3:]).reshape(-1, points.shape[2])
    times = np.repeat(0.05 * np.arange(control.steps), control.rollouts)
    some = np.ascontiguousarray(states[:: control.sparse])
    moving = fastest(lambda: clearance_in_time(context.kernel, dynamic, states, times, control.clearance_margin))
    own = fastest(lambda: context.kernel.clearance(some, control.own_margin))
    found["near clearance in time"].append(moving / len(states))
    found["near clearance"].append(own / len(some))

    def rollouts() -> None:
        rolled = horizon.roll(search.start, control.tried(search, horizon))
        softmax(control.costs(search, horizon, rolled), control.temperature)

    found["state of a rollout"].append(max(fastest(rollouts) - moving - own, 0.0) / len(states))
    one = np.zeros((control.steps, len(setup.start)))
    found["short motion"].append(
        fastest(lambda: horizon.motion(search.start, horizon.roll(search.start, one[:, None])[:, 0], context.names))
    )
    reflex = PotentialField()
    found["force"].append(fastest(lambda: reflex.controls(search, horizon)) / reflex.steps)
    factors = IncrementalGPMP2()
    _, initial = next(factors.initial_motions(search))
    graph = factors.problem(search, initial.duration)
    started = factors.supports(search, initial, initial.duration)
    count = graph.maximum(started, factors.parameters.iterations, 0.0).evaluations * len(graph.times)
    found[WORK].append(fastest(lambda: graph.maximum(started, factors.parameters.iterations, 0.0)) / count)
    step = DynamicRRTReplanner().search.step
    tree = GoalTree(context.goals, step, 200)
    while not tree.full:
        q = search.rng.uniform(context.limits.lower, context.limits.upper)
        tree.extend(tree.nearest(q), q, lambda first, last: np.ones(len(first), bool))
    tree.trim(lambda first, last: np.arange(len(first)) < len(first) - 1)
    once, q = anew(search), search.start.position
    first, last = (ends[:1] for ends in tree.edges)
    Clearances(once).edges(first, last)
    looked, of_own = (once.budget.counts[kind] for kind in ("near clearance in time", "near clearance"))
    before = fastest(lambda: Clearances(anew(search)).edges(first, last))
    each = max(before - looked * moving / len(states) - of_own * own / len(some), 0.0)
    found["extension of a tree"].append(each + fastest(lambda: tree.extend(tree.nearest(q), q, refused)))


def graph(name: str, found: dict[str, list[float]]) -> None:
    """Add what a query of DAMON's graph costs before it searches, and each node that a search reaches."""
    setup = assemble(worlds.load(name).problem.still)
    context, source = RunContext(setup, setup.robot.limits, setup.robot.limits, LoopSettings()), DamonReplanner()
    source.prepare(context)
    damon = source.damon
    states, start = damon.states(setup.start), setup.start[None]
    usable = np.ones(len(states), bool)
    found["query of a graph"].append(fastest(lambda: damon.search(states, usable, start, context.goals)))
    search, reached = LazySearch(replace(damon.graph, states=states), usable, start, context.goals), list[int]()
    search.connect(start=0, nodes=np.arange(100))  # and no goal: all that can be reached is
    taken = fastest(lambda: search.run(refused, lambda: False, reached.append))
    found["node of a graph"].append(taken / max(reached[0], 1))


def refused(first: Array, last: Array) -> Flags:
    """Return that no motion is clear."""
    return np.zeros(len(first), bool)


def trees() -> dict[str, float]:
    """Return what a motion of OMPL's trees costs, and a state of compiled ones, with all that is done else [s]."""
    spent, motions, sprinted, states = 0.0, 0, 0.0, 0
    for name in worlds.ids("moving", "validation", 30):
        world = worlds.load(name)
        setup, present = assemble(world.problem.still), tuple(world.present(0.0))
        context, source = (
            RunContext(setup, setup.robot.limits, setup.robot.limits, LoopSettings()),
            RRTConnectFromRest(),
        )
        source.prepare(context)
        dynamic, standing = DynamicObstacles(present), Following.resting(setup.start, 0.0, context.names)
        search = Search(
            context, Request(2, 0.0, 0.05, standing, None, dynamic, dynamic, present, np.inf, 0), ComputeBudget(0.1)
        )
        with quiet_ompl():
            begin = time.perf_counter()
            source.path(search, proved=False)
            spent += time.perf_counter() - begin
        motions += search.budget.counts["motion of a tree"]
        sprint = Sprint()
        sprint.prepare(context)
        first = anew(search)
        list(sprint.initial_motions(first))
        sprinted += fastest(lambda one=sprint, of=search: list(one.initial_motions(anew(of))))
        states += first.budget.counts[SPRINT]
    return {"motion of a tree": spent / motions, SPRINT: sprinted / states}


def anew(search: Search) -> Search:
    """Return the same replan, begun anew."""
    return Search(search.context, search.request, ComputeBudget(search.budget.limit))


def network() -> dict[str, float]:
    """Return the costs of a call of the network, of each proposal, and of each chunk of the imitation policy [s]."""
    from apex_ompl.apex.models import make_query

    setup = assemble(worlds.load("vertical/moving-large-0.2/800000").problem.still)
    context, source = RunContext(setup, setup.robot.limits, setup.robot.limits, LoopSettings()), Proposals()
    source.prepare(context)
    model, checker = source.model_and_checker
    query = make_query(checker, setup.start, context.goals[0], point=model.sees_point)
    policy = ImitationReplanner()
    policy.prepare(context)
    begin, end = setup.start, context.goals[0]
    chunk = fastest(lambda: policy.states(begin, end)) / (policy.steps / 8)
    taken = {}
    with model.one_thread():
        for count in (1, 8):
            taken[count] = fastest(lambda n=count: model.propose(query, checker.kernel, n))
    each = max((taken[8] - taken[1]) / 7.0, 0.0)
    paths = {}
    for guided, kind in ((False, "path of the paper"), (True, "guided path of the paper")):
        paper = OneProposal(guided)
        paper.prepare(context)
        paths[kind] = fastest(lambda one=paper: one.propose(setup.start, context.goals[0], np.random.default_rng(0)))
    return {"proposals": taken[1] - each, "proposal": each, **paths, "chunk of a policy": chunk}


def in_replans(alone: Mapping[str, float], names: Sequence[str]) -> tuple[dict[str, float], dict[str, dict[str, Any]]]:
    """Return what kinds of work cost in replans [s], of what they cost alone, and factors by replanner."""
    costs, known, about = dict(alone), set[str](), {}
    package = json.loads(TABLE.read_text())["seconds"]
    for planner in PLANNERS:
        timed = replan_times(planner, names)
        new, old = ([kind for kind in timed.counts if (kind in known) == there] for there in (False, True))
        spending, rest = timed.spending(costs, new), timed.seconds - timed.spending(costs, old)
        factor = max(rest / spending, LEAST_FACTOR) if spending > LEAST_SHARE * timed.seconds else 1.0
        costs |= {kind: factor * costs[kind] for kind in new}
        known |= set(new)
        about[planner] = {"factor": factor, "replans": timed.replans, "seconds": timed.seconds}
        about[planner]["by_package"] = timed.seconds / timed.spending(package)
    return costs, about


def write(table: Mapping[str, float]) -> None:
    """Write the table of the package, under the next version number."""
    version = json.loads(TABLE.read_text())["version"]
    content = {"version": version + 1, "seconds": {kind: float(f"{v:.3g}") for kind, v in table.items()}}
    write_atomically(TABLE, (json.dumps(content, indent=1) + "\n").encode())


def add(kind: str, names: Sequence[str], found: dict[str, list[float]]) -> None:
    """Add the kinds that the table of the package lacks, by what they take compared with a kind that it has."""
    table = cost_table()["seconds"]
    if kind not in table:
        raise UnknownNameError("kind of work", kind, sorted(table))
    for name in names:
        measured(name, found)
    alone = {one: float(np.median(values)) for one, values in found.items()}
    if kind not in alone:
        raise UnknownNameError("kind of work", kind, sorted(table.keys() & alone.keys()))
    scale = table[kind] / alone[kind]
    new = {one: scale * value for one, value in alone.items() if one not in table}
    if not new:
        raise ParameterError("--add", kind, "a table of costs that lacks some kind of work: there is nothing to add")
    write({**table, **new})
    rows = [["kind of work", "us a unit alone", "us in the table"], ["---", "---:", "---:"]]
    shown = (kind, *new)
    rows += [[one, f"{1e6 * alone[one]:.3g}", f"{1e6 * {**table, **new}[one]:.3g}"] for one in shown]
    text = f"Added to the table by what they take compared with '{kind}', timed side by side.\n\n"
    figures = {"alone": {one: alone[one] for one in shown}, "seconds": new, "scale": scale}
    record.write("costs_added", figures, text + "\n".join(map(record.row, rows)), seed=0, n=len(names))


def main() -> None:
    """Measure, and write the results."""
    parser = record.parser(__doc__, n=30, of="worlds")
    parser.add_argument("--runs", type=one_or_more, default=30, help="of each way (default: %(default)s)")
    parser.add_argument("--write", action="store_true", help="write the table of the package, too")
    parser.add_argument("--add", metavar="KIND", help="add new kinds to the table by what they take compared with this")
    args = parser.parse_args()
    found: dict[str, list[float]] = defaultdict(list)
    if args.add is not None and args.write:
        parser.error("--add writes the table by itself, expected no --write")
    if args.add is not None:
        add(args.add, worlds.ids("moving", "validation", args.n), found)
        return
    for name in worlds.ids("moving", "validation", args.n):
        measured(name, found)
        controls(name, found)
        graph(name, found)
    alone = {kind: float(np.median(values)) for kind, values in found.items()} | network() | trees()
    table, about = in_replans(alone, worlds.ids("moving", "validation", args.runs))
    rows = [["kind of work", "us a unit alone", "in replans"], ["---", "---:", "---:"]]
    rows += [[kind, f"{1e6 * alone[kind]:.3g}", f"{1e6 * v:.3g}"] for kind, v in table.items()]
    text = "\n".join(map(record.row, rows))
    head = ["replans of", "N", "s", "factor on kinds of their own", "took by charged by the package's table"]
    rows = [head, ["---", "---:", "---:", "---:", "---:"]]
    for name, one in about.items():
        rows.append([name, one["replans"], f"{one['seconds']:.2f}", f"{one['factor']:.2f}", f"{one['by_package']:.2f}"])
    text += "\n\n" + "\n".join(map(record.row, rows))
    if args.write:
        write(table)
    record.write("costs", {"alone": alone, "seconds": table, "replans": about}, text, seed=0, n=args.n)


if __name__ == "__main__":
    run_script(main)
