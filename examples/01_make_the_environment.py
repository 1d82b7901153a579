"""Make the environment, push the robot with two thrusters, and watch what it does."""

from __future__ import annotations

import gymnasium as gym
import numpy as np


def main() -> None:
    env = gym.make("freeflyer_env:FreeFlyer-v0", action_mode="thrusters", scenario="held-out-1")
    observation, _ = env.reset(seed=0)
    print("start", observation["state"].round(3), "goal", observation["goal"].round(3))
    print("obstacles (x, y, radius)\n", observation["obstacles"])

    # Thrusters 2 and 5 push forwards in the body frame; half duty is pulse-width modulated.
    forwards = np.zeros(8, dtype=np.float32)
    forwards[[2, 5]] = 0.5
    done = False
    while not done:
        observation, _, terminated, truncated, info = env.step(forwards)
        done = terminated or truncated
        if info["contacts"]["count"]:
            left = observation["time_to_go"][0]
            print(f"{left:4.1f} s to go: touched {info['contacts']['with']}")
    print("end", observation["state"].round(3), "success:", info["is_success"])
    print("firing time of each thruster in s:", info["firing_time"].round(2))


if __name__ == "__main__":
    main()
