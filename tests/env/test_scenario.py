"""Scenes, problems, the impulsive model, the constraint check."""

from dataclasses import replace

import numpy as np
import pytest

from freeflyer_env import (
    HELD_OUT_SCENES,
    SCENES,
    TRAINING_SCENES,
    Obstacles,
    Problem,
    Robot,
    Scenario,
    dynamics,
    sample_obstacles,
    sample_problem,
    unwrap_goal,
)
from freeflyer_env.constraints import between_nodes_depth, check, keep_out_depth, violations

START, GOAL = [0.3, 1.0, 0, 0, 0, 0], [3.2, 1.2, 0, 0, 0, 0]
EMPTY = Scenario(Obstacles.from_rows([]))


def test_the_papers_scenes():
    assert len(TRAINING_SCENES) == 15
    assert len(HELD_OUT_SCENES) == 3
    assert len(SCENES) == 19
    np.testing.assert_allclose(SCENES["nominal"].rows()[0], [1.0, 0.7, 0.2])
    np.testing.assert_allclose(Scenario().keep_out_radii, 0.35 * 1.1)


def test_sampled_problems_are_valid_reproducible_and_float32_exact():
    for seed in range(30):
        problem = sample_problem(np.random.default_rng(seed), n_obstacles=seed % 7)
        again = sample_problem(np.random.default_rng(seed), n_obstacles=seed % 7)
        assert problem.defects() == []
        assert problem.to_dict() == again.to_dict()
        assert abs(problem.goal[2] - problem.start[2]) <= np.pi + 1e-6
        for values in (problem.start, problem.goal, problem.scenario.obstacles.rows()):
            np.testing.assert_array_equal(values, values.astype(np.float32))
        rows = problem.scenario.obstacles.rows()
        for i, a in enumerate(rows):
            for b in rows[:i]:
                assert np.hypot(*(a[:2] - b[:2])) > a[2] + b[2] - 1e-6


def test_problem_dictionaries():
    problem = sample_problem(np.random.default_rng(1))
    assert Problem.from_dict(problem.to_dict()).to_dict() == problem.to_dict()
    with pytest.raises(ValueError, match="needs \\['final_time'\\]"):
        Problem.from_dict({"start": START, "goal": GOAL, "obstacles": []})


def test_unwrap_goal():
    goal = unwrap_goal(np.array([0, 0, 3.0, 0, 0, 0]), np.array([0, 0, -3.0, 0, 0, 0]))
    assert goal[2] == pytest.approx(2 * np.pi - 3.0)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Problem(EMPTY, START, GOAL, 0.7), "multiple of dt = 0.5 s"),
        (lambda: Problem(EMPTY, START, GOAL, float("nan")), "multiple of dt"),
        (lambda: Problem(EMPTY, START, GOAL, 0.5), "at least 1.0 s"),
        (lambda: Problem(EMPTY, START[:3], GOAL), "state of 6 numbers"),
        (lambda: Problem(EMPTY, [np.nan, *START[1:]], GOAL), "start must be finite; r_x"),
        (lambda: Obstacles.from_rows([[1, 1, -0.1]]), "radii must be positive"),
        (lambda: Obstacles([[1, 1], [2, 2]], [0.1]), "one radius per centre"),
        (lambda: Obstacles.from_rows([[np.nan, 1, 0.1]]), "finite"),
        (lambda: Scenario(table=(0.2, 2.0)), "wider than the robot"),
        (lambda: Scenario(dt=0.0), "dt must be positive"),
        (lambda: Scenario(keep_out_factor=0.9), "at least 1"),
        (lambda: Scenario.named("nominel"), "Did you mean 'nominal'"),
        (lambda: sample_obstacles(np.random.default_rng(0), 500), "ask for fewer"),
        (
            lambda: Problem(EMPTY, START, [9, *GOAL[1:]]).require_valid(),
            "the goal .* is off the table",
        ),
    ],
)
def test_bad_input(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_rollout_is_the_step_repeated_without_the_last_drift():
    rng, robot = np.random.default_rng(0), Robot()
    start, controls = rng.normal(size=(4, 6)), 0.01 * rng.normal(size=(4, 7, 3))
    states = dynamics.rollout(start, controls, 0.5, robot)
    state = start
    for k in range(6):
        state = dynamics.step(state, controls[:, k], 0.5, robot)
        np.testing.assert_allclose(states[:, k + 1], state, atol=1e-12)
    last = dynamics.apply_impulse(state, controls[:, 6], robot)
    np.testing.assert_allclose(states[:, 7], last, atol=1e-12)
    assert np.abs(dynamics.dynamics_residual(states, controls, 0.5, robot)).max() < 1e-12


def test_each_family_of_constraints_is_checked():
    scenario = Scenario(Obstacles.from_rows([[2.0, 1.0, 0.2]]))
    problem = Problem(scenario, [0.5, 1.0, 0, 0, 0, 0], [0.5, 1.0, 0, 0, 0, 0], 5.0)
    controls = np.zeros((10, 3))
    states = dynamics.rollout(problem.start, controls, 0.5, scenario.robot)
    assert check(problem, states, controls).satisfied(0.0)

    def broken(index, column, value):
        changed = states.copy()
        changed[index, column] = value
        return check(problem, changed, controls)

    assert broken(0, 0, 0.6).start == pytest.approx(0.1)
    assert broken(-1, 1, 1.2).goal == pytest.approx(0.2)
    assert broken(4, 3, 0.3).dynamics == pytest.approx(0.3)
    assert broken(4, 1, 2.45).table == pytest.approx(0.1)
    assert broken(4, 0, 1.9).keep_out == pytest.approx(0.385 - 0.1)
    assert broken(4, 0, np.nan).satisfied() is False
    assert violations(scenario, np.full((11, 6), np.nan), controls).sum() == 10
    with pytest.raises(ValueError, match="has 10 steps, the trajectory 4 controls"):
        check(problem, states[:5], controls[:4])
    strong = controls.copy()
    strong[3, 0] = 0.02
    assert check(problem, states, strong).actuation == pytest.approx(0.01 - 0.00625)
    assert violations(scenario, states, strong).tolist() == [0, 0, 0, 1, 0, 0, 0, 0, 0, 0]
    inside = states.copy()
    inside[5, 0] = 2.0
    assert violations(scenario, inside, controls).sum() == 1


def test_keep_out_depth():
    scenario = Scenario(Obstacles.from_rows([[1.0, 1.0, 0.15], [2.0, 1.0, 0.15]]))
    depth = keep_out_depth(scenario, np.array([[1.0, 1.0], [1.5, 1.0]]))
    np.testing.assert_allclose(depth, [0.33, -0.17])
    assert keep_out_depth(EMPTY, np.zeros((3, 2))).tolist() == [-np.inf] * 3


def test_robot_and_table_can_be_changed():
    big = replace(Scenario(), robot=Robot(radius=0.3))
    low, high = big.position_limits
    np.testing.assert_allclose(low, 0.3)
    np.testing.assert_allclose(high, [3.2, 2.2])


def test_moving_obstacles():
    obstacles = Obstacles(np.array([[1.0, 1.0], [2.0, 1.5]]), [0.2, 0.1], [[0.1, 0.0], [0.0, -0.2]])
    assert obstacles.moving
    np.testing.assert_allclose(obstacles.centres_at(2.0), [[1.2, 1.0], [2.0, 1.1]])
    assert obstacles.centres_at(np.zeros((3, 5))).shape == (3, 5, 2, 2)
    np.testing.assert_allclose(obstacles.after(2.0).centres_at(1.0), obstacles.centres_at(3.0))
    again = Obstacles.from_rows(obstacles.rows())
    np.testing.assert_array_equal(again.velocities, obstacles.velocities)
    assert Obstacles(obstacles.centres, obstacles.radii).rows().shape == (2, 3)
    with pytest.raises(ValueError, match="got 4 numbers"):
        Obstacles.from_rows([[1.0, 1.0, 0.2, 0.0]])
    # A goal that is free now and covered on arrival is a defect of the problem.
    covered = Obstacles(np.array([[3.2, 0.35]]), [0.2], [[0.0, 0.02]])
    problem = Problem(Scenario(covered), [0.3, 1.2, 0, 0, 0, 0], [3.2, 1.2, 0, 0, 0, 0], 40.0)
    assert "the goal is inside" in problem.defects()[0]
    assert Problem.from_dict(problem.to_dict()).scenario.obstacles.moving


def test_between_nodes_depth_is_that_of_dense_samples():
    rng = np.random.default_rng(0)
    for moving in (False, True):
        velocities = rng.uniform(-0.1, 0.1, (4, 2)) * moving
        base = sample_problem(rng)
        obstacles = Obstacles(base.scenario.obstacles.centres, np.full(4, 0.2), velocities)
        problem = Problem(replace(base.scenario, obstacles=obstacles), base.start, base.goal)
        states = np.zeros((81, 6))
        states[:, :2] = rng.uniform(0.5, 2.5, (81, 2))
        exact = between_nodes_depth(problem, states)
        share = np.linspace(0.0, 1.0, 4001)[:, None]
        for k in range(0, 79, 13):
            way = states[k, :2] + share * (states[k + 1, :2] - states[k, :2])
            depth = keep_out_depth(problem.scenario, way, 0.5 * (k + share[:, 0])).max()
            assert exact[k] == pytest.approx(depth, abs=1e-6)
            assert exact[k] >= depth - 1e-12
