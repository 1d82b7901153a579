"""Batches, the Pareto front, and re-planning in flight."""

import joblib
import numpy as np
import pytest

from freeflyer_env import HELD_OUT_SCENES, Obstacles, Problem, Scenario, sample_problem
from freeflyer_env.planning import (
    RecedingHorizon,
    SCPConfig,
    SCPStatus,
    Trajectory,
    batch,
    pareto_front,
    race_scp,
    solve_many,
    solve_multistart,
    solve_rel,
    solve_scp,
    straight_line,
)
from freeflyer_env.planning.homotopy import homotopy_starts


@pytest.fixture(scope="module")
def problems():
    rng = np.random.default_rng(0)
    return [sample_problem(rng) for _ in range(10)]


@pytest.mark.parametrize("n_jobs", [1, 2])
def test_order_is_kept_and_failures_are_results(problems, n_jobs):
    inside = Problem(
        Scenario(Obstacles.from_rows([[1.0, 1.0, 0.2]])), [1, 1, 0, 0, 0, 0], [3.2, 1, 0, 0, 0, 0]
    )
    results = solve_many([*problems, inside], n_jobs=n_jobs)
    assert [r.cost for r in results] == [solve_scp(p).cost for p in [*problems, inside]]
    assert results[-1].status is SCPStatus.INVALID_INPUT


def test_an_exception_is_the_failure_of_its_problem(problems, monkeypatch):
    def explode(problem, start, config):
        if problem is problems[1]:
            raise ZeroDivisionError("boom")
        return solve_scp(problem, start, config)

    monkeypatch.setattr(batch, "solve_scp", explode)
    results = solve_many(problems[:3], n_jobs=1)
    assert results[1].status is SCPStatus.NUMERICAL_FAILURE
    assert "ZeroDivisionError: boom" in results[1].message
    assert results[2].status is solve_scp(problems[2]).status


def test_warm_starts_and_multistart(problems):
    rel = [solve_rel(problem).trajectory for problem in problems[:4]]
    warm = solve_many(problems[:4], rel, n_jobs=1)
    assert [r.cost for r in warm] == [r.cost for r in solve_many(problems[:4], n_jobs=1)]
    many = solve_many(problems[:3], n_starts=3, n_jobs=2)
    assert [m.best.cost for m in many] == [
        solve_multistart(problem, 3).best.cost for problem in problems[:3]
    ]
    raced = [solve_multistart(problem, 3, effort="best") for problem in problems[:3]]
    for slow, quick in zip(many, raced):
        assert quick.best.cost == pytest.approx(slow.best.cost, rel=0.02)
        assert sum(r.iterations for r in quick.results) <= sum(r.iterations for r in slow.results)
    with pytest.raises(ValueError, match="effort must be one of"):
        solve_multistart(problems[0], 3, effort="most")
    spread = solve_multistart(problems[0], 3, n_jobs=2)
    assert spread.best.cost == many[0].best.cost
    assert solve_many([]) == []
    with pytest.raises(ValueError, match="got 1 for 4"):
        solve_many(problems[:4], rel[:1])
    with pytest.raises(ValueError, match="not both"):
        solve_many(problems[:4], rel, n_starts=2)


def test_ray_through_joblib(problems):
    ray = pytest.importorskip("ray")
    from ray.util.joblib import register_ray

    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
    try:
        register_ray()
        with joblib.parallel_config(backend="ray"):
            results = solve_many(problems[:4], n_jobs=2)
    finally:
        ray.shutdown()
    assert [r.cost for r in results] == [solve_scp(p).cost for p in problems[:4]]


def test_pareto_front():
    problem = sample_problem(np.random.default_rng(3), HELD_OUT_SCENES[0])
    front = pareto_front(problem, [18.0, 25.0, 40.0, 60.0])
    assert {18.0, 25.0, 40.0, 60.0} <= set(front.final_times)
    assert (np.diff(front.costs[front.efficient]) < 0.0).all()
    known = np.isfinite(front.rel_costs)
    assert (front.costs[known] >= front.rel_costs[known] - 1e-6).all()
    for time, result in zip(front.final_times, front.results):
        if result.solved:
            at_time = Problem(problem.scenario, problem.start, problem.goal, time)
            assert result.trajectory.check(at_time).satisfied()
            assert result.cost <= solve_scp(at_time).cost + 1e-9
    # The fastest is bracketed to one step.
    solved = np.isfinite(front.costs)
    first = int(np.argmax(solved))
    assert front.final_times[first] - front.final_times[first - 1] == pytest.approx(0.5)
    assert front.fastest is front.results[first]
    assert front.best(0.0)[0] == 60.0
    assert front.best(1.0)[0] == front.final_times[first]
    assert front.plot().get_xlabel() == "final time in s"
    assert len(pareto_front(problem).final_times) >= 16
    with pytest.raises(ValueError, match="at least one"):
        pareto_front(problem, [])


def test_receding_horizon_follows_a_disturbed_robot():
    problem = sample_problem(np.random.default_rng(3), HELD_OUT_SCENES[0])
    horizon = RecedingHorizon(problem, config=SCPConfig(elastic=True, between_nodes=True))
    rng = np.random.default_rng(0)
    state = problem.start.copy()
    iterations = []
    for step in range(0, 64, 4):
        if step:
            result = horizon.replan(state, 0.5 * step)
            assert result.solved
            iterations.append(result.iterations)
        plan = horizon.plan
        assert plan.n_steps == max(80 - step, 10)
        np.testing.assert_allclose(plan.states[-1], problem.goal, atol=1e-6)
        state = plan.states[4] + rng.normal(0.0, 0.002, 6)
    assert np.median(iterations) <= 3


def test_receding_horizon_keeps_its_plan_where_none_is_found_and_mends_the_state():
    problem = sample_problem(np.random.default_rng(3), HELD_OUT_SCENES[0])
    horizon = RecedingHorizon(problem)
    before = horizon.plan
    flung = problem.start + np.array([0, 0, 0, 0.9, 0.9, 0])
    assert not horizon.replan(flung, 35.0).solved
    assert horizon.plan is before
    centre = problem.scenario.obstacles.centres[0]
    left = horizon.problem_from(np.array([*(centre + 0.3), 4 * np.pi, 0, 0, 0]), 2.0)
    assert left.defects() == []
    assert abs(left.start[2] - before.states[4, 2]) < np.pi
    assert left.final_time == 38.0
    moving = Obstacles(np.array([[1.5, 1.0]]), [0.2], [[0.0, 0.1]])
    later = RecedingHorizon(Problem(Scenario(moving), problem.start, problem.goal)).problem_from(
        problem.start, 2.0
    )
    np.testing.assert_allclose(later.scenario.obstacles.centres, [[1.5, 1.2]])


def test_a_race_finds_the_cheapest_solution_with_fewer_subproblems(problems):
    raced = alone = 0
    for problem in problems[:6]:
        starts = [solve_rel(problem).trajectory, *homotopy_starts(problem, 4)]
        full = [solve_scp(problem, start) for start in starts]
        results = race_scp(problem, starts)
        assert len(results) == len(starts)
        assert min(r.cost for r in results) <= 1.02 * min(r.cost for r in full)
        for result, other in zip(results, full):
            if result.status is not SCPStatus.OUTRUN:
                assert (result.status, result.cost) == (other.status, other.cost)
        raced += sum(r.iterations for r in results)
        alone += sum(r.iterations for r in full)
    assert raced < 0.8 * alone


def test_a_race_tells_what_cannot_run(problems):
    line = straight_line(problems[0])
    short = Trajectory.from_controls(problems[0], np.zeros((3, 3)))
    first, second = race_scp(problems[0], [short, line])
    assert first.status is SCPStatus.INVALID_INPUT
    assert "3 steps" in first.message
    assert second.cost == solve_scp(problems[0], line).cost
    with pytest.raises(ValueError, match="at least one warm start"):
        race_scp(problems[0], [])


def test_moving_obstacles_are_passed_where_the_line_meets_them():
    """One that crosses the line when the robot is there: both sides are starts."""
    crossing = Obstacles(np.array([[1.75, 0.5]]), np.array([0.15]), np.array([[0.0, 0.0375]]))
    problem = Problem(Scenario(crossing), [0.3, 1.25, 0, 0, 0, 0], [3.2, 1.25, 0, 0, 0, 0])
    heights = [start.states[40, 1] for start in homotopy_starts(problem, 2)]
    assert min(heights) < 1.0
    assert max(heights) > 1.5
    heights = [best.trajectory.states[40, 1] for best in solve_multistart(problem, 3).optima]
    assert min(heights) < 1.25 < max(heights)


def test_a_horizon_takes_a_cheaper_way_that_is_proposed():
    problem = sample_problem(np.random.default_rng(4), HELD_OUT_SCENES[0])
    optima = solve_multistart(problem, 6).optima
    worse, best = optima[-1].trajectory, optima[0]
    assert worse.cost > 1.02 * best.cost
    alone = RecedingHorizon(problem, worse).replan(problem.start, 0.0)
    asked = []

    def propose(left):
        asked.append(left)
        return [best.trajectory]

    helped = RecedingHorizon(problem, worse, propose=propose).replan(problem.start, 0.0)
    assert len(asked) == 1
    assert alone.cost == pytest.approx(worse.cost, rel=1e-3)
    assert helped.cost == pytest.approx(best.cost, rel=1e-3)
