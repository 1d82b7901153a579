"""Reinforcement learning: PPO or SAC of Stable-Baselines3 learns to dock in free space.

    pip install "freeflyer-gym[rl]"
    python examples/08_learn_to_dock.py --algorithm sac --steps 60000 --out out/dock

It prints every now and then how often the deterministic policy succeeds, and leaves the policy and
the learning curve as CSV.
"""

import argparse
import csv
from pathlib import Path

import gymnasium as gym
import numpy as np
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env

import freeflyer_env  # noqa: F401  registers FreeFlyer-v0
from freeflyer_env.wrappers import FlatObservation

SETTINGS = {
    "ppo": (PPO, 8, {"n_steps": 512, "batch_size": 512, "gamma": 0.99, "gae_lambda": 0.95,
                     "ent_coef": 0.0, "learning_rate": 5e-4, "n_epochs": 10,
                     "policy_kwargs": {"log_std_init": -0.5}}),
    "sac": (SAC, 1, {"batch_size": 256, "gamma": 0.98, "learning_rate": 5e-4, "train_freq": 4,
                     "gradient_steps": 2, "learning_starts": 2000, "buffer_size": 200_000,
                     "policy_kwargs": {"net_arch": [128, 128]}}),
}  # fmt: skip


def make(**arguments):
    """Free space, impulses scaled to [-1, 1], the dense reward."""
    env = gym.make(
        "FreeFlyer-v0",
        scenario=[],
        reward="dense",
        success_reward=1.0,
        max_obstacles=0,
        **arguments,
    )
    return gym.wrappers.RescaleAction(FlatObservation(env), -1.0, 1.0)


class Curve(BaseCallback):
    """Evaluates the deterministic policy on the same problems every so many steps."""

    def __init__(self, every, episodes=50):
        super().__init__()
        self.every, self.episodes, self.rows, self.env = every, episodes, [], make()

    def _on_step(self):
        if self.num_timesteps >= self.every * (len(self.rows) + 1):
            self.rows.append((self.num_timesteps, *evaluate(self.model, self.env, self.episodes)))
            steps, success, reward, cost = self.rows[-1]
            print(f"{steps:8d} steps: success {100 * success:3.0f} %, return {reward:6.3f}, "
                  f"cost {cost:.3f} m/s", flush=True)  # fmt: skip
        return True


def evaluate(model, env, episodes):
    """Share of successes, mean return, mean cost of the successful episodes."""
    successes, returns, costs = [], [], []
    for seed in range(episodes):
        observation, _ = env.reset(seed=10_000 + seed)
        total, over = 0.0, False
        while not over:
            action, _ = model.predict(observation, deterministic=True)
            observation, reward, terminated, truncated, info = env.step(action)
            total, over = total + reward, terminated or truncated
        successes.append(info["is_success"])
        returns.append(total)
        if info["is_success"]:
            costs.append(info["cost"])
    return np.mean(successes), np.mean(returns), np.mean(costs) if costs else np.nan


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--algorithm", choices=SETTINGS, default="ppo")
    parser.add_argument("--steps", type=int, default=500_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/dock"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    algorithm, n_envs, settings = SETTINGS[options.algorithm]
    envs = make_vec_env(make, n_envs=n_envs, seed=options.seed)
    model = algorithm("MlpPolicy", envs, seed=options.seed, device="cpu", **settings)
    curve = Curve(every=max(options.steps // 20, 1))
    model.learn(options.steps, callback=curve)
    model.save(options.out / options.algorithm)
    with open(options.out / f"{options.algorithm}.csv", "w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([("steps", "success", "return", "cost"), *curve.rows])
    print(f"policy and learning curve in {options.out}")


if __name__ == "__main__":
    main()
