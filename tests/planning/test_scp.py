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
    assert solve_multistart(problem, 3).best.status is SCPStatus.INFEASIBLE_PROBLEM


@pytest.fixture(scope="module")
def hard():
    """Random problems that SCP from REL does not solve."""
    rng = np.random.default_rng(5)
    problems = [sample_problem(rng) for _ in range(60)]
    return [problem for problem in problems if not solve_scp(problem).solved]


def test_slack_left_is_never_called_solved(hard):
    assert len(hard) >= 8
    statuses = []
    for problem in hard:
        result = solve_scp(problem, config=SCPConfig(elastic=True))
        statuses.append(result.status)
        if result.solved:
            assert result.trajectory.check(problem).satisfied()
        if result.status is SCPStatus.SLACK_LEFT:
            assert result.report.keep_out > 1e-6
            assert result.cost == np.inf
            assert "reroutes" in result.message
    assert SCPStatus.SOLVED in statuses
    assert SCPStatus.SLACK_LEFT in statuses


def test_rerouted_elastic_solves_what_any_of_13_starts_solves(hard):
    config = SCPConfig(elastic=True, reroutes=12)
    for problem in hard:
        known = solve_multistart(problem, 13).best.solved
        result = solve_scp(problem, config=config)
        assert result.solved or not known
        assert result.rerouted > 0
        assert result.iterations > 1


def test_between_the_nodes(solved):
    config = SCPConfig(between_nodes=True)
    dips, kept = [], 0
    for problem, rel, scp in solved:
        if not scp.solved:
            continue
        dips.append(scp.trajectory.between_nodes_depth(problem))
        result = solve_scp(problem, rel.trajectory, config)
        kept += result.solved
        if result.solved:
            assert result.trajectory.between_nodes_depth(problem) <= 1e-6
            assert result.cost <= 1.01 * scp.cost
    assert max(dips) > 1e-4
    assert kept == len(dips)


def test_between_the_nodes_from_a_start_that_grazes_a_disc():
    scenario = Scenario(Obstacles.from_rows([[1.0, 1.0, 0.2], [2.0, 1.5, 0.15]]))
    radius = scenario.keep_out_radii[0]
    start = np.array([1.0 - radius - 1e-7, 1.0, 0.0, 0.0, 0.0, 0.0])
    problem = Problem(scenario, start, np.array([3.2, 1.2, 1.0, 0.0, 0.0, 0.0]))
    result = solve_scp(problem, config=SCPConfig.robust())
    assert result.solved
    assert result.trajectory.between_nodes_depth(problem) <= 1e-6


def test_moving_obstacles():
    # A disc that crosses the straight way when the robot would be there, and one that has gone.
    centres, radii = np.array([[1.75, 0.2], [1.0, 1.25]]), np.array([0.2, 0.2])
    moving = Obstacles(centres, radii, np.array([[0.0, 0.05], [0.0, 0.3]]))
    start, goal = np.array([0.3, 1.25, 0, 0, 0, 0]), np.array([3.2, 1.25, 0, 0, 0, 0])
    problem = Problem(Scenario(moving), start, goal)
    rel = solve_rel(problem)
    assert rel.trajectory.violations(problem).sum() > 3
    for config in (SCPConfig(), SCPConfig.robust()):
        result = solve_scp(problem, config=config)
        assert result.solved
        gaps = np.linalg.norm(
            result.trajectory.states[:, None, :2] - moving.centres_at(problem.node_times), axis=-1
        )
        assert (gaps >= problem.scenario.keep_out_radii - 1e-6).all()
    assert result.trajectory.between_nodes_depth(problem) <= 1e-6
    still = Problem(Scenario(Obstacles(centres, radii)), start, goal)
    assert not result.trajectory.check(still).satisfied()


def test_start_and_goal_with_velocity():
    rng = np.random.default_rng(12)
    solved = 0
    for _ in range(8):
        at_rest = sample_problem(rng, final_time=50.0)
        start, goal = at_rest.start.copy(), at_rest.goal.copy()
        start[3:], goal[3:] = rng.uniform(-0.04, 0.04, 3), rng.uniform(-0.04, 0.04, 3)
        problem = Problem(at_rest.scenario, start, goal, 50.0)
        result = solve_scp(problem, config=SCPConfig.robust())
        solved += result.solved
        if result.solved:
            np.testing.assert_allclose(result.trajectory.states[0], start, atol=1e-9)
            np.testing.assert_allclose(result.trajectory.states[-1], goal, atol=1e-6)
    assert solved >= 7


@pytest.mark.parametrize(
    ("n_obstacles", "final_time"), [(0, 200.0), (1, 30.0), (8, 60.0), (12, 100.0)]
)
def test_any_number_of_obstacles_and_any_final_time(n_obstacles, final_time):
    rng = np.random.default_rng(n_obstacles)
    problem = sample_problem(rng, final_time=final_time, n_obstacles=n_obstacles)
    result = solve_scp(problem, config=SCPConfig.robust())
    assert result.solved
    assert result.trajectory.check(problem).satisfied()


def test_vertices_of_nearly_the_same_cost_are_left_behind():
    problem = sample_problem(np.random.default_rng(12), final_time=23.5, n_obstacles=0)
    plain = solve_scp(problem)
    assert plain.status is SCPStatus.ITERATION_LIMIT
    assert plain.feasible
    assert plain.cost == np.inf
    settled = solve_scp(problem, config=SCPConfig.robust())
    assert settled.solved
    assert settled.cost == pytest.approx(plain.cost_history[-1], rel=1e-3)


def test_rel_that_is_hard_to_linearise_is_reached_from_a_longer_time():
    problem = sample_problem(np.random.default_rng(43), final_time=21.0, n_obstacles=0)
    assert solve_rel(problem).status is SCPStatus.INFEASIBLE_SUBPROBLEM
    found = solve_scp(problem, config=SCPConfig.robust())
    assert found.solved
    assert solve_rel(problem, warm_start=found.trajectory).trajectory is not None


def test_a_time_limit_is_kept():
    problem = sample_problem(np.random.default_rng(2), final_time=100.0)
    result = solve_scp(problem, config=SCPConfig(time_limit=1e-6))
    assert result.status is SCPStatus.TIME_LIMIT
    assert result.trajectory is None
    assert "time_limit" in result.message


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"backend": "piqq"}, "Did you mean 'piqp'"),
        ({"max_iterations": 1}, "at least 2"),
        ({"trust_region_end": 20.0}, "trust_region_end <= trust_region_start"),
        ({"state_tolerance": 0.0}, "state_tolerance must be positive"),
        ({"reroutes": -1}, "reroutes must not be negative"),
        ({"time_limit": 0.0}, "time_limit must be positive"),
    ],
)
def test_bad_settings(settings, message):
    with pytest.raises(ValueError, match=message):
        SCPConfig(**settings)


@pytest.mark.parametrize("last", [None, 10, 2])
def test_landing_is_the_least_change_that_reaches_the_goal(last):
    rng = np.random.default_rng(4)
    problem = sample_problem(rng)
    wild = Trajectory.from_controls(problem, 1e-3 * rng.normal(size=(problem.n_steps, 3)))
    landed = wild.landed(problem, last)
    np.testing.assert_allclose(landed.states[-1], problem.goal, atol=1e-12)
    change = landed.controls - wild.controls
    assert (change[: problem.n_steps - (last or problem.n_steps)] == 0.0).all()
    # Least in the 2-norm: a change that keeps the end is orthogonal to it.
    steps = np.arange(problem.n_steps)[-(last or problem.n_steps) :]
    effect = np.array([np.ones(len(steps)), problem.n_steps - 1 - steps], dtype=float)
    detour = rng.normal(size=len(steps))
    detour -= effect.T @ np.linalg.solve(effect @ effect.T, effect @ detour)
    np.testing.assert_allclose(detour @ change[steps], 0.0, atol=1e-9)
    np.testing.assert_allclose(landed.landed(problem).controls, landed.controls, atol=1e-9)
