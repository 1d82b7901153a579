"""The wrappers, as Gymnasium and Stable-Baselines3 see them."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from freeflyer_env import Obstacles, Problem, Scenario
from freeflyer_env.wrappers import FlatObservation, GoalObservation


def make(**arguments):
    return gym.make("FreeFlyer-v0", **arguments)


@pytest.mark.parametrize("observation", ["state", "robot", ("robot", "lidar")])
def test_a_flat_observation_is_of_order_one(observation):
    env = FlatObservation(make(observation=observation, final_time=10.0))
    env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(20):
        vector, *_ = env.step(env.action_space.sample())
        assert env.observation_space.contains(vector)
    assert np.abs(vector).max() < 6.0


def test_a_flat_observation_is_relative_to_the_robot():
    problem = Problem(
        Scenario(Obstacles.from_rows([[1.0, 1.5, 0.2]])),
        [1.0, 1.0, np.pi / 2, 0.05, 0.0, 0.1],
        [1.0, 2.0, np.pi / 2, 0, 0, 0],
    )
    rest, padding = [0.1 / 0.3, 1], [0, 0, 0, 0]
    for mode, expected in (
        ("thrusters", [1, 0, 0, 1, 0, -0.5, *rest, 0.5, 0, 0.2, 1, *padding]),
        ("delta_v", [0, 1, 0, 1, 0.5, 0, *rest, 0, 0.5, 0.2, 1, *padding]),
    ):
        env = FlatObservation(make(action_mode=mode, scenario=problem.scenario, max_obstacles=2))
        vector, _ = env.reset(options={"problem": problem})
        np.testing.assert_allclose(vector, expected, atol=1e-5)


def test_an_image_does_not_go_into_a_vector():
    with pytest.raises(ValueError, match="FlatObservation needs"):
        FlatObservation(make(observation=("state", "image")))


@pytest.mark.parametrize("reward", ["sparse", "dense"])
def test_goal_form(reward):
    env = GoalObservation(make(), reward)
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    achieved, desired = [], []
    for _ in range(30):
        observation, step_reward, *_ = env.step(env.action_space.sample())
        achieved.append(observation["achieved_goal"])
        desired.append(observation["desired_goal"])
        assert step_reward == env.compute_reward(achieved[-1], desired[-1], {})
    batch = env.compute_reward(np.array(achieved), np.array(desired), [{}] * 30)
    assert batch.shape == (30,)
    assert (env.compute_reward(desired[0], desired[0], {})) == 0.0
    with pytest.raises(ValueError, match="'sparse' or 'dense'"):
        GoalObservation(make(), "thin")


def test_gymnasiums_checker():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*different from the unwrapped version")
        for wrapper in (FlatObservation, GoalObservation):
            check_env(wrapper(make(final_time=5.0).unwrapped), skip_render_check=True)


@pytest.mark.parametrize("mode", ["delta_v", "thrusters", "on_off"])
def test_stable_baselines3s_checker(mode):
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    for wrapper in (gym.Wrapper, FlatObservation, GoalObservation):
        with warnings.catch_warnings():
            # Advice, not faults: actions in SI units, and a dictionary with a matrix in it.
            warnings.filterwarnings(
                "ignore", message=".*(symmetric and normalized|unconventional).*"
            )
            warnings.simplefilter("error", category=DeprecationWarning)
            checker.check_env(wrapper(make(action_mode=mode, final_time=5.0)))


def test_hindsight_replay_runs():
    sb3 = pytest.importorskip("stable_baselines3")
    env = gym.wrappers.RescaleAction(GoalObservation(make(final_time=5.0)), -1.0, 1.0)
    model = sb3.SAC(
        "MultiInputPolicy",
        env,
        replay_buffer_class=sb3.HerReplayBuffer,
        learning_starts=20,
        batch_size=16,
        device="cpu",
        policy_kwargs={"net_arch": [16]},
    )
    model.learn(40)
