"""Tracking a plan with on/off thrusters."""

import gymnasium as gym
import numpy as np
import pytest

from freeflyer_env import HELD_OUT_SCENES, Robot, sample_problem
from freeflyer_env.control import (
    MPCTracker,
    PIDTracker,
    PulseWidthModulator,
    fly,
    reference_at,
)
from freeflyer_env.planning import solve_multistart


@pytest.fixture(scope="module")
def planned():
    problem = sample_problem(np.random.default_rng(4), HELD_OUT_SCENES[0])
    return problem, solve_multistart(problem, 4).best.trajectory


@pytest.fixture
def env():
    return gym.make("freeflyer_env:FreeFlyer-v0", action_mode="thrusters", terminate_early=False)


def test_pulses_are_whole_sub_steps_and_right_on_average():
    modulator = PulseWidthModulator(10)
    duties = np.array([0.0, 0.03, 0.1, 0.25, 0.333, 0.5, 0.97, 1.0])
    periods = np.array([modulator.pulses(duties) for _ in range(300)])
    assert periods.shape == (300, 10, 8)
    np.testing.assert_allclose(periods.mean(axis=(0, 1)), duties, atol=1e-3)
    assert not periods[..., 0].any()
    assert periods[..., 7].all()


def test_each_period_has_one_pulse():
    pulses = PulseWidthModulator(10).pulses(np.full(8, 0.4))
    assert (np.abs(np.diff(pulses.astype(int), axis=0)).sum(axis=0) <= 2).all()
    assert (pulses.sum(axis=0) == 4).all()


def test_the_reference_is_continuous_and_ends_in_the_goal(planned):
    problem, trajectory = planned
    times = np.arange(0.0, 40.0, 0.05)
    states = np.array([reference_at(trajectory, t)[0] for t in times])
    np.testing.assert_allclose(states[0], problem.start, atol=1e-12)
    assert np.abs(np.diff(states[:, :2], axis=0)).max() < 0.02
    np.testing.assert_allclose(reference_at(trajectory, 40.0 - 1e-6)[0], problem.goal, atol=1e-6)
    np.testing.assert_allclose(reference_at(trajectory, 99.0)[0], problem.goal, atol=1e-9)
    # A true motion: positions are the integral of velocities, velocities of accelerations.
    middle = np.array([reference_at(trajectory, t + 0.025)[0] for t in times[:-1]])
    np.testing.assert_allclose(np.diff(states[:, :3], axis=0), 0.05 * middle[:, 3:], atol=1e-9)


def test_it_stays_close_to_the_impulsive_plan(planned):
    _, trajectory = planned
    for index in range(trajectory.n_steps):
        reference, _ = reference_at(trajectory, index * trajectory.dt)
        lag = 0.5 * trajectory.dt * np.linalg.norm(trajectory.states[index, 3:5])
        gap = np.linalg.norm(reference[:2] - trajectory.states[index, :2])
        assert gap <= lag + 1e-9


def test_pid_with_the_papers_gains_flies_the_plan(env, planned):
    problem, trajectory = planned
    env.reset(options={"problem": problem})
    calls = []
    flight = fly(env, trajectory, on_step=lambda: calls.append(1))
    assert flight.success
    assert len(calls) == len(flight.duties) == 400
    assert flight.tracking_error < 0.005
    assert flight.final_error[0] < 0.005
    assert flight.contacts == 0
    assert flight.firing_time > 5.0
    assert flight.states.shape == (401, 6)


def test_it_recovers_from_an_offset(env, planned):
    problem, trajectory = planned
    env.reset(options={"problem": problem})
    base = env.unwrapped
    state = base.state
    state[1] += 0.03
    base._world.state = state
    flight = fly(env, trajectory, PIDTracker(base.robot))
    assert flight.final_error[0] < 0.02


def test_bad_use(planned):
    problem, trajectory = planned
    env = gym.make("freeflyer_env:FreeFlyer-v0")
    env.reset(options={"problem": problem})
    with pytest.raises(ValueError, match="needs action_mode='thrusters'"):
        fly(env, trajectory)
    with pytest.raises(ValueError, match="three numbers >= 0"):
        PIDTracker(Robot(), kp=(1.0, -1.0, 0.0))


def test_mpc_plans_anew_after_a_push(planned, env):
    problem, plan = planned
    env = gym.make(
        "freeflyer_env:FreeFlyer-v0",
        action_mode="thrusters",
        scenario=problem.scenario,
        terminate_early=False,
    )
    worst = {}
    for tracker in (PIDTracker(problem.scenario.robot), MPCTracker(problem)):
        env.reset(options={"problem": problem})

        def push():
            if abs(env.unwrapped.time - 12.0) < 1e-6:
                env.unwrapped.push([-0.04, 0.05, 0.4])

        flight = fly(env, plan, tracker, on_step=push)
        assert flight.success
        assert flight.final_error[0] < 1e-3
        worst[type(tracker)] = flight.tracking_error
    assert worst[MPCTracker] < 0.05 < worst[PIDTracker]
    assert len(tracker.results) == 70
    assert all(result.solved for result in tracker.results)
    assert np.median([result.iterations for result in tracker.results]) <= 3
    tracker.reset()
    assert tracker.results == []


def test_mpc_and_push_refuse_nonsense(planned, env):
    with pytest.raises(ValueError, match="period must be positive"):
        MPCTracker(planned[0], period=0.0)
    env.reset(seed=0)
    with pytest.raises(ValueError, match="three finite numbers"):
        env.unwrapped.push([1.0, np.nan, 0.0])
