"""Proposals: whole trajectories of the right problem, cheap to get, good to refine."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from art_policy.generation import generate
from art_policy.layers import ARTConfig
from art_policy.model import ART
from art_policy.rollout import decode_poses, propose, propose_batch
from freeflyer_env import Obstacles, Problem, Scenario, dynamics, sample_problem
from freeflyer_env.constraints import actuation_excess, keep_out_depth
from freeflyer_env.planning import Trajectory, solve_rel, solve_scp, straight_line

MULTI = ARTConfig(width=32, n_layers=1, n_heads=2, n_hypotheses=4)
SEQUENCE = replace(MULTI, head="autoregressive", context_length=8)
MODES = replace(SEQUENCE, n_modes=4)


@pytest.fixture(scope="module")
def problems() -> list[Problem]:
    """Problems of different lengths and numbers of obstacles."""
    rng = np.random.default_rng(5)
    return [
        sample_problem(rng, final_time=final_time, n_obstacles=number)
        for final_time, number in ((30.0, 4), (40.0, 2), (35.5, 0))
    ]


def model(config: ARTConfig) -> ART:
    torch.manual_seed(1)
    art = ART(config).eval()
    with torch.no_grad():
        for parameter in art.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    return art


def test_multi_hypothesis_proposals(problems: list[Problem]) -> None:
    art = model(MULTI)
    for problem in problems:
        proposals = propose(art, problem, n_candidates=10)
        assert len(proposals) == 4
        scores = [proposal.score for proposal in proposals]
        assert scores == sorted(scores, reverse=True)
        assert np.exp(scores).sum() == pytest.approx(1.0, abs=1e-5)
        for proposal in proposals:
            states = proposal.trajectory.states
            assert states.shape == (problem.n_steps + 1, 6)
            np.testing.assert_allclose(states[0], problem.start)
            np.testing.assert_allclose(states[-1], problem.goal)
            assert (keep_out_depth(problem.scenario, states[:, :2]) < 1e-9).all()
            low, high = problem.scenario.position_limits
            assert (states[:, :2] >= low - 1e-6).all()
            assert (states[:, :2] <= high + 1e-6).all()


def test_a_batch_gives_what_single_calls_give(problems: list[Problem]) -> None:
    art = model(MULTI)
    batch = propose_batch(art, problems, n_candidates=2)
    assert propose_batch(art, []) == []
    for problem, together in zip(problems, batch):
        for one, other in zip(propose(art, problem, n_candidates=2), together):
            assert one.score == pytest.approx(other.score, abs=1e-5)
            np.testing.assert_allclose(one.trajectory.states, other.trajectory.states, atol=1e-5)


@pytest.mark.parametrize("config", [MULTI, SEQUENCE], ids=["hypotheses", "sequence"])
def test_a_goal_to_the_left_is_planned_in_a_mirror(
    config: ARTConfig, problems: list[Problem]
) -> None:
    problem, sign = problems[0], np.array([-1.0, 1.0, -1.0, -1.0, 1.0, -1.0])
    scenario = problem.scenario
    shift = np.array([scenario.table[0], 0, 0, 0, 0, 0])
    rows = scenario.obstacles.rows()
    rows[:, 0] = scenario.table[0] - rows[:, 0]
    scene = Scenario(obstacles=Obstacles.from_rows(rows))
    image = Problem(
        scene, shift + sign * problem.start, shift + sign * problem.goal, problem.final_time
    )
    art = model(config)
    rel, mirrored = (solve_rel(each).trajectory for each in (problem, image))
    expected = shift + sign * propose(art, problem, rel=rel)[0].trajectory.states
    found = propose(art, image, rel=mirrored)[0].trajectory.states
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_decoded_poses_follow_the_knots_where_nothing_is_in_the_way() -> None:
    empty = Scenario(obstacles=Obstacles.from_rows([]))
    start, goal = np.array([0.2, 1.0, 0.0, 0, 0, 0]), np.array([3.2, 1.0, 1.0, 0, 0, 0])
    problem = Problem(empty, start, goal, 11.0)  # 22 nodes: 20 interior knots fall on nodes
    knots = np.random.default_rng(0).normal(size=(2, 20, 3)) * 0.1
    poses = decode_poses(problem, knots, "uniform")
    share = np.linspace(0.0, 1.0, 22)[1:-1, None]
    line = (1.0 - share) * start[:3] + share * goal[:3]
    np.testing.assert_allclose(poses[:, 1:-1], line + knots, atol=1e-6)


def test_proposals_can_be_refined(problems: list[Problem]) -> None:
    proposal = propose(model(MULTI), problems[1])[0]
    assert solve_scp(problems[1], proposal.trajectory).solved


@pytest.mark.parametrize("tokens_per_step", [2, 4])
def test_generation_with_and_without_cache(problems: list[Problem], tokens_per_step: int) -> None:
    net = model(replace(SEQUENCE, tokens_per_step=tokens_per_step)).net
    returns = np.array([-0.3, -0.2, -0.4])
    cached = generate(net, problems, returns)
    plain = generate(net, problems, returns, use_cache=False)
    for problem, a, b in zip(problems, cached, plain):
        assert a.shape == (problem.n_steps, 3)
        np.testing.assert_allclose(a, b, atol=1e-7)


def test_sequence_proposals_obey_the_dynamics_and_end_at_the_goal(problems: list[Problem]) -> None:
    rels = [solve_rel(problem).trajectory for problem in problems]
    groups = propose_batch(model(SEQUENCE), problems, n_candidates=3, rels=rels)
    for problem, group in zip(problems, groups):
        assert len(group) == 3
        assert group[0].score >= group[1].score >= group[2].score
        for proposal in group:
            states, controls = proposal.trajectory.states, proposal.trajectory.controls
            robot, dt = problem.scenario.robot, problem.scenario.dt
            residual = dynamics.dynamics_residual(states, controls, dt, robot)
            assert np.abs(residual).max() < 1e-12
            np.testing.assert_allclose(states[-1], problem.goal, atol=1e-9)


def test_generated_controls_are_within_the_actuation_limit(problems: list[Problem]) -> None:
    controls = generate(model(SEQUENCE).net, problems, np.full(len(problems), -0.3))
    for problem, each in zip(problems, controls):
        states = Trajectory.from_controls(problem, each).states
        assert actuation_excess(problem.scenario, states[:-1, 2], each).max() < 1e-9


def test_of_the_samples_those_that_pass_the_obstacles_come_first(problems: list[Problem]) -> None:
    rels = [solve_rel(problem).trajectory for problem in problems]
    many = propose_batch(model(MODES), problems, n_candidates=8, rels=rels)
    one = propose_batch(model(MODES), problems, rels=rels)
    for problem, group, (first,) in zip(problems, many, one):
        depths = [
            keep_out_depth(problem.scenario, p.trajectory.states[:-1, :2], problem.node_times[:-1])
            for p in group
        ]
        inside = [int((depth > 1e-3).sum()) for depth in depths]
        assert inside == sorted(inside)
        assert first.score == group[0].score


def test_the_reward_to_go_changes_what_is_generated(problems: list[Problem]) -> None:
    net = model(SEQUENCE).net
    low, high = generate(net, [problems[0]] * 2, np.array([-0.2, -0.6]))
    assert np.abs(low - high).max() > 1e-6


def test_samples_of_a_model_with_modes(problems: list[Problem]) -> None:
    net = model(MODES).net
    returns = np.full(3, -0.3)
    same = generate(net, [problems[0]] * 3, returns, draws=[0, 1, 2])
    assert np.abs(same[0] - same[1]).max() > 1e-6
    assert np.abs(same[1] - same[2]).max() > 1e-6
    alone = generate(net, [problems[0]], returns[:1], draws=[2])
    np.testing.assert_allclose(alone[0], same[2], atol=1e-7)
    together = generate(net, problems, returns, draws=[2, 1, 0])
    np.testing.assert_allclose(together[0], same[2], atol=1e-7)
    np.testing.assert_allclose(generate(net, problems[:1], returns[:1])[0], same[0], atol=1e-7)


def test_a_prompt_is_what_a_sequence_begins_with(problems: list[Problem]) -> None:
    net = model(SEQUENCE).net
    returns = np.full(3, -0.3)
    prompt = generate(net, problems, 1.5 * returns)
    same = generate(net, problems, returns, prompts=[np.zeros((0, 3))] * 3)
    led = generate(net, problems, returns, prompts=[each[:6] for each in prompt])
    for free, plain, given, other in zip(
        generate(net, problems, returns), same, prompt, led, strict=True
    ):
        np.testing.assert_allclose(plain, free, atol=1e-9)
        np.testing.assert_allclose(other[:6], given[:6], atol=1e-9)
        assert np.abs(other[6:] - given[6:]).max() > 1e-7


def test_guides_are_followed_by_a_sequence_model(problems: list[Problem]) -> None:
    rels = [solve_rel(problem).trajectory for problem in problems]
    guides = [[straight_line(problem), rel] for problem, rel in zip(problems, rels)]
    groups = propose_batch(model(SEQUENCE), problems, n_candidates=2, rels=rels, guides=guides)
    for problem, rel, group in zip(problems, rels, groups):
        assert len(group) == 2
        nearest = min(np.abs(p.trajectory.states[8, :2] - rel.states[8, :2]).max() for p in group)
        assert nearest < 0.1
        for proposal in group:
            np.testing.assert_allclose(proposal.trajectory.states[-1], problem.goal, atol=1e-9)
    with pytest.raises(ValueError, match="this one proposes whole paths"):
        propose(model(MULTI), problems[0], guides=guides[0])


def test_bad_requests(problems: list[Problem]) -> None:
    with pytest.raises(ValueError, match="n_candidates must be at least 1, got 0"):
        propose(model(MULTI), problems[0], n_candidates=0)
    with pytest.raises(ValueError, match="needs REL's trajectory"):
        propose(model(SEQUENCE), problems[0])
