"""Proofs that a problem has no solution: right where they claim something, silent elsewhere."""

import numpy as np
import pytest
from scipy.optimize import linprog

from freeflyer_env import Obstacles, Problem, Robot, Scenario, sample_problem
from freeflyer_env.planning import SCPConfig, SCPStatus, solve_rel, solve_scp
from freeflyer_env.planning.infeasibility import (
    impulse_limits,
    needed_impulses,
    shortest_final_time,
    why_infeasible,
)

START, GOAL = np.array([0.3, 1.2, 0, 0, 0, 0.0]), np.array([3.2, 1.2, 0, 0, 0, 0.0])


def scene(*rows):
    return Scenario(Obstacles.from_rows(np.array(rows, dtype=float).reshape(-1, 3)))


@pytest.mark.parametrize("seed", range(6))
def test_needed_impulses_are_those_of_a_linear_program(seed):
    rng = np.random.default_rng(seed)
    start, goal = START.copy(), GOAL.copy()
    start[3:], goal[3:] = rng.uniform(-0.1, 0.1, 3), rng.uniform(-0.1, 0.1, 3)
    goal[2] = rng.uniform(-3, 3)
    problem = Problem(scene(), start, goal, (2.0, 11.0, 20.0)[seed % 3])
    n, dt = problem.n_steps, 0.5
    levers = dt * np.arange(n - 1, -1, -1)
    for axis, needed in enumerate(needed_impulses(problem)):
        change = goal[3 + axis] - start[3 + axis]
        travel = goal[axis] - start[axis] - start[3 + axis] * levers[0]
        ones = np.ones((n, 1))
        program = linprog(
            np.r_[np.zeros(n), 1.0],
            A_ub=np.block([[np.eye(n), -ones], [-np.eye(n), -ones]]),
            b_ub=np.zeros(2 * n),
            A_eq=np.array([np.r_[levers, 0.0], np.r_[np.ones(n), 0.0]]),
            b_eq=[travel, change],
            bounds=[(None, None)] * n + [(0, None)],
        )
        assert needed == pytest.approx(program.fun, rel=1e-7)


def test_impulse_limits_bound_what_the_thrusters_give():
    problem, robot = Problem(scene(), START, GOAL), Robot()
    rng = np.random.default_rng(0)
    control = rng.normal(size=(4000, 3)) * [1.0, 1.0, robot.lever_arm]
    psi = rng.uniform(-np.pi, np.pi, 4000)
    excess = np.abs(robot.cluster_delta_v(psi, control)).max(axis=1) / robot.delta_v_max(0.5)
    reach = np.abs(control / excess[:, None] * robot.control_gain).max(axis=0)
    limits = impulse_limits(problem)
    assert (reach <= limits * (1 + 1e-9)).all()
    assert (reach >= 0.85 * limits).all()


def test_too_short_a_final_time():
    problem = Problem(scene(), START, GOAL, 15.0)
    for result in (
        solve_rel(problem),
        solve_scp(problem),
        solve_scp(problem, config=SCPConfig.robust()),
    ):
        assert result.status is SCPStatus.INFEASIBLE_PROBLEM
        assert "final time of 15 s is too short (actuation): along x" in result.message
        assert "at least 18.5 s needed" in result.message
    assert shortest_final_time(problem) == 18.5
    spin = Problem(scene(), START, GOAL + np.array([0, 0, 60.0, 0, 0, 0]), 20.0)
    assert "along the heading" in why_infeasible(spin)


def test_a_start_that_cannot_brake():
    start = START.copy()
    start[3] = -0.5
    result = solve_scp(Problem(scene(), start, GOAL, 40.0))
    assert result.status is SCPStatus.INFEASIBLE_PROBLEM
    assert "start's velocity of -0.5 m/s along x" in result.message
    goal = GOAL.copy()
    goal[3] = -0.4
    assert "goal's velocity" in why_infeasible(Problem(scene(), START, goal, 40.0))


def test_braking_in_the_last_step_counts():
    # The last impulse stops the drift towards the goal, as the first one stops the start's.
    goal = np.array([3.35, 1.2, 0, -0.01, 0, 0])
    start = np.array([0.15, 1.2, 0, -0.01, 0, 0])
    for problem in (Problem(scene(), START, goal), Problem(scene(), start, GOAL)):
        assert solve_scp(problem).solved
        assert why_infeasible(problem) is None


def test_a_goal_that_is_cut_off():
    wall = [[1.75, y, 0.2] for y in (0.3, 0.95, 1.6, 2.25)]
    problem = Problem(scene(*wall), START, GOAL)
    result = solve_scp(problem, config=SCPConfig.robust())
    assert result.status is SCPStatus.INFEASIBLE_PROBLEM
    assert "cut off from the start (keep-out)" in result.message
    ring = [
        [3.2 + 0.62 * np.cos(a), 1.2 + 0.62 * np.sin(a), 0.15] for a in np.linspace(1.6, 4.7, 5)
    ]
    ring += [[3.2, 1.82, 0.15], [3.2, 0.58, 0.15]]
    assert "cut off" in why_infeasible(Problem(scene(*ring), START, GOAL))
    assert why_infeasible(Problem(scene(*ring), START, GOAL), keep_out=False) is None


def test_a_gap_is_not_called_a_wall():
    gap = [[1.75, y, 0.2] for y in (0.2, 0.85, 1.65, 2.3)]
    problem = Problem(scene(*gap), START, GOAL)
    assert why_infeasible(problem) is None
    assert solve_scp(problem, config=SCPConfig.robust()).solved


def test_nothing_is_claimed_of_problems_that_were_solved():
    rng = np.random.default_rng(2)
    claims = 0
    for _ in range(60):
        problem = sample_problem(rng, final_time=float(rng.choice([20.0, 22.0, 25.0, 40.0])))
        if solve_scp(problem, config=SCPConfig(reroutes=3)).solved:
            assert why_infeasible(problem) is None
        else:
            claims += why_infeasible(problem) is not None
    assert claims > 0
