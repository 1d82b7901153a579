"""The fast subproblem against the CVXPY statement, which it shares nothing with."""

import numpy as np
import pytest

from freeflyer_env import HELD_OUT_SCENES, Problem, Scenario, sample_problem
from freeflyer_env.planning import Trajectory, solve_multistart, straight_line
from freeflyer_env.planning.program import SolverStatus
from freeflyer_env.planning.reference import solve_reference_subproblem
from freeflyer_env.planning.subproblem import Subproblem


def subproblem_for(problem, n_obstacles, **options):
    scenario = problem.scenario
    return Subproblem(problem.n_steps, n_obstacles, scenario.dt, scenario.robot, **options)


def compare(problem, reference, trust_region, n_obstacles):
    """Asserts that both forms agree; returns whether the subproblem was feasible."""
    solution = subproblem_for(problem, n_obstacles).solve(problem, reference, trust_region)
    status, objective, _ = solve_reference_subproblem(
        problem, reference, trust_region, keep_out=n_obstacles > 0, solver="HIGHS"
    )
    if solution.trajectory is None:
        assert solution.status is SolverStatus.INFEASIBLE
        assert "infeasible" in status
        return False
    assert status == "optimal"
    assert solution.trajectory.cost == pytest.approx(objective, rel=1e-6)
    return True


def test_agrees_with_the_cvxpy_statement_on_50_random_problems():
    rng = np.random.default_rng(11)
    feasible = 0
    for index in range(50):
        # Short horizons keep CVXPY quick and the actuation limits tight; three of four are hard.
        final_time = (20.0, 25.0, 30.0, 40.0)[index % 4]
        scenario = HELD_OUT_SCENES[index % 3] if index % 2 else None
        problem = sample_problem(rng, scenario, final_time)
        line = straight_line(problem)
        n_obstacles = 0 if index % 5 == 0 else len(problem.scenario.obstacles)
        feasible += compare(problem, line, 10.0, n_obstacles)
    assert 15 <= feasible < 50, "the sample should contain feasible and infeasible subproblems"


@pytest.mark.parametrize("trust_region", [0.02, 0.2])
def test_agrees_where_the_trust_region_and_the_actuation_slope_matter(trust_region):
    rng = np.random.default_rng(3)
    for _ in range(4):
        problem = sample_problem(rng, HELD_OUT_SCENES[0])
        reference = solve_multistart(problem, 4).best.trajectory
        assert compare(problem, reference, trust_region, 4)


def test_velocity_rows_are_imposed_where_they_bind():
    problem = sample_problem(np.random.default_rng(4))
    reference = solve_multistart(problem, 3).best.trajectory
    # A reference with other velocities than its positions imply: the box on velocities binds.
    states = reference.states.copy()
    states[1:-1, 5] += 0.02
    shifted = Trajectory(states, reference.controls, reference.dt)
    solution = subproblem_for(problem, 4).solve(problem, shifted, 0.05)
    strict = subproblem_for(problem, 4, velocity_rows=True).solve(problem, shifted, 0.05)
    assert strict.trajectory is not None
    assert solution.trajectory is not None
    assert solution.trajectory.cost == pytest.approx(strict.trajectory.cost, rel=1e-6)
    moved = np.abs(solution.trajectory.states[1:-1] - shifted.states[1:-1]).max()
    assert moved <= 0.05 + 1e-6
    assert compare(problem, shifted, 0.05, 4)


def test_a_reference_that_misses_the_ends():
    problem = sample_problem(np.random.default_rng(4), HELD_OUT_SCENES[0])
    reference = solve_multistart(problem, 4).best.trajectory
    states = reference.states.copy()
    states[:, 2] += 0.3
    assert compare(problem, Trajectory(states, reference.controls, reference.dt), 10.0, 4)


def test_a_goal_with_velocity_and_two_steps():
    empty = Scenario(
        obstacles=sample_problem(np.random.default_rng(0), n_obstacles=0).scenario.obstacles
    )
    start = np.array([1.0, 1.0, 0.3, 0.02, 0.0, 0.0])
    moving = np.array([1.4, 1.1, 0.5, 0.03, -0.01, 0.01])
    problem = Problem(empty, start, moving, 20.0)
    assert compare(problem, straight_line(problem), 10.0, 0)
    hop = np.array([1.01, 1.0, 0.3, 0.02, 0.0, 0.0])
    assert compare(
        Problem(empty, start, hop, 1.0), straight_line(Problem(empty, start, hop, 1.0)), 10.0, 0
    )


def test_elastic_subproblem_is_feasible_where_the_hard_one_is_not():
    rng = np.random.default_rng(5)
    for _ in range(30):
        problem = sample_problem(rng)
        line = straight_line(problem)
        hard = subproblem_for(problem, 4).solve(problem, line, 10.0)
        soft = subproblem_for(problem, 4, elastic=True).solve(problem, line, 10.0)
        assert soft.trajectory is not None
        if hard.trajectory is not None:
            assert soft.trajectory.cost == pytest.approx(hard.trajectory.cost, rel=1e-5)


def test_values_are_overwritten_completely():
    rng = np.random.default_rng(6)
    shared = None
    for _ in range(5):
        problem = sample_problem(rng)
        shared = shared or subproblem_for(problem, 4)
        line = straight_line(problem)
        again = shared.solve(problem, line, 10.0)
        fresh = subproblem_for(problem, 4).solve(problem, line, 10.0)
        assert again.status is fresh.status
        if fresh.trajectory is not None:
            assert again.trajectory.cost == pytest.approx(fresh.trajectory.cost, rel=1e-7)
