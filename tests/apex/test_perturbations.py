"""APEX for robots without a shipped model: random perturbations of straight lines instead of proposals."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from planning import HARD, cached_problem
from support import ROOT

from apex_ompl import load_robot, plan, run
from apex_ompl.apex.models import PerturbationModel, make_query, trajectory_model
from apex_ompl.api import load_problem
from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import FileFormatError
from apex_ompl.model.proposals import Sampling, TrajectoryModel
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import Obstacle

BAXTER = ROOT / "examples" / "baxter_table.yaml"


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 999), count=st.integers(1, 5), temperature=st.floats(0.1, 3.0))
def test_perturbed_lines_join_the_ends_within_the_limits(
    baxter: Robot, seed: int, count: int, temperature: float
) -> None:
    model, checker, rng = PerturbationModel(), CollisionChecker(baxter), np.random.default_rng(seed)
    limits = baxter.limits
    ends = rng.uniform(limits.lower, limits.upper, (2, 2, baxter.dof))
    queries = [make_query(checker, start, goal, point=False) for start, goal in ends]
    sampling = Sampling(steps=1, temperature=temperature)
    made = [
        model.propose(queries, checker.kernel, count, sampling=sampling, generator=np.random.default_rng(seed)).control
        for _ in range(2)
    ]
    assert np.array_equal(*made) and made[0].shape == (2 * count, model.spline.points, baxter.dof)
    assert (made[0] >= limits.lower).all() and (made[0] <= limits.upper).all()
    for k, (start, goal) in enumerate(ends):
        paths = model.spline.path(made[0][k * count : (k + 1) * count])
        assert np.array_equal(paths[:, 0], np.tile(start, (count, 1)))
        assert np.array_equal(paths[:, -1], np.tile(goal, (count, 1)))
    other = model.renoise(queries[0], checker.kernel, made[0][:1], 0, generator=np.random.default_rng(seed + 1)).control
    assert other.shape == made[0][:1].shape and not np.array_equal(other, made[0][:1])


def test_perturbations_are_larger_at_higher_temperature(baxter: Robot) -> None:
    model, checker = PerturbationModel(), CollisionChecker(baxter)
    query = make_query(checker, baxter.home, baxter.home, point=False)
    off = [
        np.abs(
            model.propose(query, checker.kernel, 50, sampling=Sampling(steps=1, temperature=t)).control - baxter.home
        )
        for t in (0.25, 0.5)
    ]
    assert 1.8 < off[1].mean() / off[0].mean() < 2.2, "limits are hardly met"


def test_what_proposes_for_a_robot() -> None:
    pandas, baxter = load_robot("dual_panda_softhand"), load_robot("baxter")
    assert isinstance(trajectory_model("auto", baxter), PerturbationModel)
    assert isinstance(trajectory_model("none", pandas), PerturbationModel)
    assert isinstance(trajectory_model("auto", pandas), TrajectoryModel)
    with pytest.raises(FileFormatError, match="expected 'baxter'"):
        trajectory_model("apex", baxter)


def test_apex_plans_without_a_model() -> None:
    with_none = plan(cached_problem(HARD), "apex", timeout=20.0, params={"model": "none"})
    assert with_none and not with_none.notes and with_none.solved_by
    auto = plan(BAXTER, timeout=20.0)
    assert auto and auto.planner == "apex" and "baxter" in auto.notes[0]


def test_the_closed_loop_runs_with_a_robot_whose_hands_do_not_close() -> None:
    problem = load_problem(BAXTER)
    box = Obstacle(name="dynamic_obstacle", box=(0.1, 0.1, 0.1), position=(0.75, -1.4, 0.35), velocity=(0.0, 0.25, 0.0))
    result = run(problem.model_copy(update={"scene": (*problem.scene, box)}))
    assert result.outcome == "reached", result.reason
    assert not any("Error" in event.data.get("why", "") for event in result.events)
