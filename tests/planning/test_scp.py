"""SCP: verified solutions, honest failures, multi-start."""

import numpy as np
import pytest

from freeflyer_env import HELD_OUT_SCENES, Obstacles, Problem, Scenario, sample_problem
from freeflyer_env.constraints import keep_out_depth
from freeflyer_env.planning import (
    SCPConfig,
    SCPStatus,
    Trajectory,
    solve_multistart,
    solve_rel,
    solve_scp,
    straight_line,
)
from freeflyer_env.planning.homotopy import homotopy_starts, push_out


@pytest.fixture(scope="module")
def solved():
    """Twenty problems on the held-out scenes with REL and SCP results."""
    rng = np.random.default_rng(21)
    problems = [sample_problem(rng, HELD_OUT_SCENES[i % 3]) for i in range(20)]
    return [(p, rel := solve_rel(p), solve_scp(p, rel.trajectory)) for p in problems]


def test_solved_means_verified(solved):
    assert sum(scp.solved for _, _, scp in solved) >= 12
    for problem, rel, scp in solved:
        assert rel.solved
        if scp.solved:
            report = scp.trajectory.check(problem)
            assert report.satisfied(1e-6)
            assert scp.cost == pytest.approx(np.abs(scp.trajectory.controls).sum())
            assert scp.cost >= rel.cost - 1e-6
            assert 2 <= scp.iterations == len(scp.cost_history) <= 20
        else:
            assert scp.cost == np.inf


def test_restart_from_the_solution_takes_two_iterations(solved):
    for problem, _, scp in solved:
        if scp.solved:
            again = solve_scp(problem, scp.trajectory)
            assert again.iterations <= 3
            assert again.cost == pytest.approx(scp.cost, rel=1e-4)


def test_without_warm_start_rel_is_used(solved):
    problem, _, scp = solved[0]
    assert solve_scp(problem).cost_history == scp.cost_history


def test_multistart_is_never_worse_and_its_optima_are_distinct(solved):
    for problem, _, scp in solved[:8]:
        many = solve_multistart(problem, 5)
        assert many.best.cost <= scp.cost + 1e-9
        costs = [optimum.cost for optimum in many.optima]
        assert costs == sorted(costs)
        assert all(optimum.trajectory.check(problem).satisfied() for optimum in many.optima)
        assert solve_multistart(problem, 1).best.cost == scp.cost


def test_homotopy_starts_are_clear_of_obstacles(solved):
    for problem, _, _ in solved[:8]:
        for start in homotopy_starts(problem, 6):
            assert keep_out_depth(problem.scenario, start.states[2:-2, :2]).max() < 0.02
            np.testing.assert_array_equal(start.states[0], problem.start)


def test_push_out_leaves_what_is_free():
    scenario = HELD_OUT_SCENES[0]
    free = np.array([[0.2, 0.3], [3.3, 2.3]])
    np.testing.assert_array_equal(push_out(scenario, free), free)
    inside = scenario.obstacles.centres + 0.01
    assert keep_out_depth(scenario, push_out(scenario, inside)).max() <= 0.0


def test_too_short_a_final_time_is_an_infeasible_subproblem():
    problem = sample_problem(np.random.default_rng(1), final_time=5.0)
    result = solve_scp(problem)
    assert result.status is SCPStatus.INFEASIBLE_SUBPROBLEM
    assert result.trajectory is None
    assert "longer final time" in result.message


def test_invalid_input_is_a_status_with_a_reason():
    scenario = Scenario(Obstacles.from_rows([[1.0, 1.0, 0.2]]))
    inside = np.array([1.0, 1.1, 0, 0, 0, 0])
    problem = Problem(scenario, inside, np.array([3.2, 1.0, 0, 0, 0, 0]))
    result = solve_scp(problem)
    assert result.status is SCPStatus.INVALID_INPUT
    assert "keep-out zone of obstacle 0" in result.message
    valid = sample_problem(np.random.default_rng(2))
    other = straight_line(sample_problem(np.random.default_rng(2), final_time=50.0))
    assert "100 steps" in solve_scp(valid, other).message
    line = straight_line(valid)
    broken = Trajectory(np.where(line.states > 2, np.nan, line.states), line.controls, line.dt)
    assert "not finite" in solve_scp(valid, broken).message


def test_an_off_table_start_is_invalid_for_every_solver():
    outside = [0.05, 1.0, 0, 0, 0, 0]
    problem = Problem(HELD_OUT_SCENES[0], outside, [3.2, 1.0, 0, 0, 0, 0])
    for result in (solve_rel(problem), solve_scp(problem), solve_multistart(problem, 3).best):
        assert result.status is SCPStatus.INVALID_INPUT
        assert "off the table" in result.message


def test_a_two_step_problem_has_starts():
    problem = sample_problem(np.random.default_rng(0), final_time=1.0)
    assert solve_multistart(problem, 3).best.status is SCPStatus.INFEASIBLE_SUBPROBLEM


def test_elastic_solves_at_least_as_many():
    rng = np.random.default_rng(5)
    problems = [sample_problem(rng) for _ in range(25)]
    hard = [solve_scp(problem).solved for problem in problems]
    soft = [solve_scp(problem, config=SCPConfig(elastic=True)) for problem in problems]
    assert sum(result.solved for result in soft) >= sum(hard)
    for problem, result in zip(problems, soft):
        if result.solved:
            assert result.trajectory.check(problem).satisfied()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"backend": "piqq"}, "Did you mean 'piqp'"),
        ({"max_iterations": 1}, "at least 2"),
        ({"trust_region_end": 20.0}, "trust_region_end <= trust_region_start"),
        ({"state_tolerance": 0.0}, "state_tolerance must be positive"),
    ],
)
def test_bad_settings(settings, message):
    with pytest.raises(ValueError, match=message):
        SCPConfig(**settings)
