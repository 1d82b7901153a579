"""The planner, its monitor and the wrapper."""

import dataclasses
import json

import gymnasium as gym
import numpy as np
import pytest

from art_policy import ART, PlannerConfig, PlannerWrapper, WarmStartPlanner
from art_policy.envelope import Envelope
from art_policy.layers import ARTConfig
from art_policy.planner import distrust
from freeflyer_env import HELD_OUT_SCENES, Obstacles, Problem, Scenario, sample_problem
from freeflyer_env.planning import (
    RecedingHorizon,
    SCPStatus,
    Trajectory,
    solve_rel,
    solve_scp,
    straight_line,
)


@pytest.fixture(scope="module")
def model(untrained_model):
    return ART.from_pretrained(untrained_model)


@pytest.fixture(scope="module")
def problems():
    rng = np.random.default_rng(17)
    return [sample_problem(rng, HELD_OUT_SCENES[i % 3]) for i in range(8)]


def test_without_a_model_it_is_rel_and_scp(problems):
    plan = WarmStartPlanner(None).plan(problems[0])
    assert plan.source == "rel"
    assert plan.result.cost == solve_scp(problems[0]).cost
    assert plan.timings["propose"] == 0.0
    assert plan.timings["total"] >= plan.timings["rel"] + plan.timings["scp"]


def test_falls_back_to_rel_and_says_so(model, problems):
    for problem in problems:
        alone = WarmStartPlanner(model, PlannerConfig(rel="never")).plan(problem)
        plan = WarmStartPlanner(model).plan(problem)
        rel = solve_scp(problem)
        assert plan.result.solved
        if not alone.result.solved:
            assert plan.source == ("rel" if rel.solved else "reroute")
            assert any("candidate 0" in line for line in plan.monitor)
        if plan.result.solved:
            assert plan.trajectory.check(problem).satisfied()


def test_a_portfolio_is_never_worse_than_rel(model, problems):
    planner = WarmStartPlanner(model, PlannerConfig(n_candidates=2, rel="portfolio"))
    for problem in problems:
        plan = planner.plan(problem)
        assert plan.result.cost <= solve_scp(problem).cost
        assert plan.iterations >= plan.result.iterations


def test_outside_of_its_training_a_model_is_not_left_alone(model, problems):
    problem = problems[0]
    config = dataclasses.replace(model.config, envelope=Envelope((40.0, 40.0), (4, 4), 0.0, 0.0))
    envelope = config.envelope
    assert ARTConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config
    assert envelope.outside(problem) is None
    moving = Obstacles([[1.0, 1.0]] * 4, [0.1] * 4, velocities=[[0.01, 0.0]] * 4)
    flying = problem.start + np.array([0.0, 0.0, 0.0, 0.02, 0.0, 0.0])
    others = {
        "final time, 60 s, is not in the 40 to 40 s": {"final_time": 60.0},
        "number of obstacles, 0, ": {"scenario": Scenario(Obstacles.from_rows([]))},
        "speed of the obstacles, 0.01 m/s, ": {"scenario": Scenario(moving)},
        "speed at start or goal, 0.02 m/s, ": {"start": flying},
    }
    for text, changes in others.items():
        assert text in envelope.outside(dataclasses.replace(problem, **changes))
    known = ART(config).eval()
    known.load_state_dict(model.state_dict())
    other = dataclasses.replace(problem, final_time=60.0)
    plan = WarmStartPlanner(known).plan(other)
    assert any(line.startswith("REL refined too: the final time") for line in plan.monitor)
    assert plan.result.cost <= solve_scp(other).cost
    alone = WarmStartPlanner(known, PlannerConfig(rel="never")).plan(other)
    assert not any("REL" in line for line in alone.monitor)


def test_proposals_are_warm_starts_for_re_planning(model, problems):
    planner = WarmStartPlanner(model, PlannerConfig(n_candidates=3))
    flown = planner.plan(problems[0]).trajectory
    horizon = RecedingHorizon(problems[0], flown, propose=planner.proposals)
    result = horizon.replan(flown.states[20], 10.0)
    assert result.solved
    assert result.cost <= 1.001 * np.abs(flown.controls[20:]).sum()
    assert WarmStartPlanner(None).proposals(problems[0]) == []


def test_an_invalid_problem_is_a_failed_plan(model):
    scenario = Scenario(Obstacles.from_rows([[0.3, 1.0, 0.1]]))
    problem = Problem(scenario, [0.3, 1.0, 0, 0, 0, 0], [3.2, 1.0, 0, 0, 0, 0])
    plan = WarmStartPlanner(model).plan(problem)
    assert plan.result.status is SCPStatus.INVALID_INPUT
    assert plan.trajectory is None
    assert "keep-out zone" in plan.result.message


def test_the_monitor_distrusts(problems):
    problem = problems[0]
    good = solve_rel(problem).trajectory
    shifted = dataclasses.replace(good, states=good.states + 0.01)
    broken = Trajectory(np.full_like(good.states, np.nan), good.controls, good.dt)
    centre = problem.scenario.obstacles.centres[0]
    poses = np.column_stack([np.tile(centre, (80, 1)), np.zeros(80)])
    through = Trajectory.from_poses(problem, poses)
    other = straight_line(dataclasses.replace(problem, final_time=50.0))
    assert distrust(problem, straight_line(problem).from_poses(problem, good.states[:-1, :3])) in (
        None,
        distrust(problem, good),
    )
    assert "away from the start" in distrust(problem, shifted)
    assert "not finite" in distrust(problem, broken)
    assert "keep-out disc" in distrust(problem, through)
    assert "100 steps" in distrust(problem, other)


def test_the_wrapper_plans_at_reset(model):
    env = PlannerWrapper(
        gym.make("freeflyer_env:FreeFlyer-v0", scenario="held-out-1", terminate_early=False),
        WarmStartPlanner(model, PlannerConfig(rel="portfolio")),
    )
    for seed in range(6):
        _, info = env.reset(seed=seed)
        assert env.plan is info["plan"]
        if info["plan"].trajectory is None:
            continue
        for control in info["plan"].trajectory.controls:
            *_, terminated, truncated, info = env.step(control.astype(np.float32))
        assert terminated
        assert not truncated
        assert info["is_success"]
        return
    pytest.fail("no plan was found for six problems")


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"n_candidates": 0}, "n_candidates must be at least 1"), ({"rel": "maybe"}, "rel must be")],
)
def test_bad_settings(settings, message):
    with pytest.raises(ValueError, match=message):
        PlannerConfig(**settings)
