from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from ompl import base as ob
from ompl import geometric as og
from planning import within
from support import needs

from apex_ompl import plan, planners
from apex_ompl.errors import ParameterError, UnknownNameError
from apex_ompl.ompl.process import seed_ompl
from apex_ompl.ompl.setup import assemble
from apex_ompl.planners.sampling import OmplParameters, setter_stem
from apex_ompl.scene.problem import Problem


def plain_space() -> ob.SpaceInformation:
    space = ob.RealVectorStateSpace(3)
    bounds = ob.RealVectorBounds(3)
    bounds.setLow(-1)
    bounds.setHigh(1)
    space.setBounds(bounds)
    return ob.SpaceInformation(space)


def bound_planners() -> set[str]:
    """Every geometric planner that the installed OMPL binds."""
    classes = {n for n in dir(og) if isinstance(getattr(og, n), type) and issubclass(getattr(og, n), ob.Planner)}
    return classes


def test_every_planner_of_the_installed_ompl_has_a_name() -> None:
    records = [planners.parameters(name) for name in planners.names()]
    assert {r.planner for r in records if isinstance(r, OmplParameters)} == bound_planners()


@pytest.mark.parametrize("name", [n for n in planners.names() if isinstance(planners.parameters(n), OmplParameters)])
def test_defaults_are_ompls_and_values_arrive(name: str) -> None:
    si = plain_space()
    record = planners.parameters(name)
    plain = getattr(og, record.planner)(si)
    if name == "aorrtc":  # destroying one that was never set up ends the process
        plain.setup()
    changed = {}
    for field in dataclasses.fields(record):
        default = getattr(record, field.name)
        if name not in ("aorrtc", "prm"):  # these two have no defaults to read before they are set up
            assert getattr(plain, "get" + setter_stem(field.name))() == default, field.name
        low, high = field.metadata.get("low", 0), field.metadata.get("high", 2)
        changed[field.name] = (
            (not default) if isinstance(default, bool) else type(default)(low + min(high - low, 2) / 2)
        )
    planner = planners.make(name, si, **changed)
    for field, value in changed.items():
        assert getattr(planner, "get" + setter_stem(field))() == value, field
    assert type(planners.allocator(name, **changed)(si)) is type(plain)


def test_records_are_frozen_and_read_text() -> None:
    record = planners.parameters("rrt", range="0.5", goal_bias="1e-1", intermediate_states="true")
    assert (record.range, record.goal_bias, record.intermediate_states) == (0.5, 0.1, True)
    with pytest.raises(dataclasses.FrozenInstanceError):
        record.range = 1.0  # type: ignore[misc]
    assert planners.parameters("prm", max_nearest_neighbors="7").max_nearest_neighbors == 7
    assert planners.parameters("rrt", range=1).range == 1.0


@pytest.mark.parametrize(
    ("name", "values", "error", "words"),
    [
        ("rrtconect", {}, UnknownNameError, ["planner 'rrtconect'", "did you mean 'rrtconnect'", "kpiece1"]),
        ("rrtconnect", {"rnage": 1.0}, UnknownNameError, ["parameter 'rnage'", "did you mean 'range'"]),
        ("rrtconnect", {"range": "wide"}, ParameterError, ["'range'", "a number in [0, inf]", "'wide'"]),
        ("rrtconnect", {"range": -1.0}, ParameterError, ["'range'", "-1.0"]),
        ("rrtconnect", {"range": 10**400}, ParameterError, ["'range'", "a number in [0, inf]", "1000"]),
        (5, {}, UnknownNameError, ["unknown planner 5; known: aorrtc, "]),
        (["rrt"], {}, UnknownNameError, ["unknown planner ['rrt']; known: aorrtc, "]),
        ("rrtconnect", {"range": float("nan")}, ParameterError, ["'range'", "nan"]),
        ("rrt", {"goal_bias": 1.5}, ParameterError, ["'goal_bias'", "[0, 1]", "1.5"]),
        ("rrt", {"intermediate_states": 1}, ParameterError, ["true or false"]),
        ("prm", {"max_nearest_neighbors": 2.5}, ParameterError, ["a whole number"]),
        ("prm", {"max_nearest_neighbors": True}, ParameterError, ["a whole number"]),
        ("rrtconnect+polish", {"pinned": 7}, ParameterError, ["pinned", "less than half of the 14 points"]),
        ("rrtconnect+polish", {"control_points": 5}, ParameterError, ["control_points", "[6, 200]"]),
        ("rrtconnect+polish", {}, ParameterError, ["state validity checker", "StateValidityChecker"]),
    ],
)
def test_faults_name_the_thing(name: str, values: dict, error: type[Exception], words: list[str]) -> None:
    with pytest.raises(error) as caught:
        planners.make(name, plain_space(), **values)
    for word in words:
        assert word in str(caught.value)


OURS = [
    pytest.param(name, marks=needs(f"benchmarks/baselines/{name}")) if name in ("il", "il-paper") else name
    for name in planners.names() if "bad_planners" not in type(planners.parameters(name)).__module__
]  # fmt: skip


@pytest.mark.parametrize("name", OURS)
def test_every_planner_solves_the_robots_problem(name: str, problem: Problem) -> None:
    """Selected the OMPL way, through an allocator, each finds an exact path or says why it did not."""
    ready = assemble(problem)
    simple_setup = ready.simple_setup
    simple_setup.setPlannerAllocator(planners.allocator(name))
    optimizing = planners.parameters(name).optimizing
    sure = name in ("rrtconnect", "rrtconnect+polish", "aorrtc", "prm", "bkpiece1", "lbkpiece1", "bitstar")
    status = simple_setup.solve(within(1.5 if optimizing and sure else 8.0 if sure else 0.75))
    assert ready.validity_checker.fault is None and ready.motion_validator.fault is None
    if sure:
        assert status.getStatus() == ob.PlannerStatus.EXACT_SOLUTION
    if status.getStatus() == ob.PlannerStatus.EXACT_SOLUTION:
        assert simple_setup.getSolutionPath().check()


@pytest.mark.parametrize("name", ["shelf/medium/800005", "swap/medium/800002"])
def test_polish_shortens_what_rrtconnect_finds(name: str) -> None:
    """The same trees, a shorter path that passes the full check, and smooth: it turns by little at each state."""
    plain = plan(name, "rrtconnect", timeout=30.0, seed=3, objective="length")
    polished = plan(name, "rrtconnect+polish", timeout=30.0, seed=3, objective="length")
    again = plan(name, "rrtconnect+polish", timeout=30.0, seed=3, objective="length")
    assert plain and polished and polished.solved_by == "rrtconnect+polish"
    assert polished.length < plain.length and polished.clearance > plain.clearance
    assert np.array_equal(polished.path, again.path)
    assert "simplify" not in polished.times
    steps = np.diff(polished.path, axis=0)
    turns = np.linalg.norm(np.diff(steps, axis=0), axis=1) / np.linalg.norm(steps, axis=1).mean()
    assert len(polished.path) == 256 and turns.max() < 0.5
    shape = {"control_points": 20, "pinned": 3}
    few = plan(name, "rrtconnect+polish", timeout=30.0, seed=3, params=shape, objective="length")
    assert few and np.abs(np.diff(few.path, axis=0)[[0, -1]]).max() < 0.01 * np.abs(np.diff(few.path, axis=0)).max()


def test_polish_stops_with_its_condition(problem: Problem) -> None:
    """When time is up behind the search, what was found by then is the solution."""
    ready = assemble(problem)
    planner = planners.make("rrtconnect+polish", ready.simple_setup.getSpaceInformation())
    ready.simple_setup.setPlanner(planner)
    seed_ompl(0)
    found = ready.simple_setup.getProblemDefinition().hasExactSolution
    status = ready.simple_setup.solve(ob.PlannerTerminationCondition(found))
    assert status.getStatus() == ob.PlannerStatus.EXACT_SOLUTION
    raw = ready.simple_setup.getSolutionPath().length()  # the path itself is freed by ``clear``
    ready.simple_setup.clear()
    assert ready.simple_setup.solve(ob.timedPlannerTerminationCondition(20.0)).getStatus() == status.getStatus()
    assert ready.simple_setup.getSolutionPath().length() < raw
    ready.simple_setup.clear()
    assert ready.simple_setup.solve(ob.plannerAlwaysTerminatingCondition()).getStatus() != status.getStatus()
