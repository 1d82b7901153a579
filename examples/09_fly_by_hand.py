"""Fly the robot by hand: W A S D push along its axes, Q and E turn it, R starts anew, Escape ends.

    python examples/09_fly_by_hand.py --scene nominal

It needs a display and ``pip install "freeflyer-gym[render]"``.
"""

import argparse
import os

import gymnasium as gym
import numpy as np

import freeflyer_env  # noqa: F401  registers FreeFlyer-v0

#: Thrusters that each key fires: two that push the same way, or a pair that turns.
THRUSTERS = {"w": (2, 5), "s": (1, 6), "a": (4, 7), "d": (0, 3), "q": (1, 5), "e": (2, 6)}


def action_of(keys):
    """Which of the eight thrusters are on for the keys that are held."""
    action = np.zeros(8, dtype=np.int8)
    for key in keys:
        action[list(THRUSTERS[key])] = 1
    return action


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", default="random", help="'random' or a scene's name")
    parser.add_argument("--final-time", type=float, default=100.0, help="in s")
    parser.add_argument("--steps", type=int, help="stop after so many steps of 0.1 s")
    options = parser.parse_args()
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    import pygame

    env = gym.make(
        "FreeFlyer-v0",
        action_mode="on_off",
        scenario=options.scene,
        final_time=options.final_time,
        render_mode="human",
    )
    env.reset()
    steps = 0
    while options.steps is None or steps < options.steps:
        held = pygame.key.get_pressed()
        if held[pygame.K_ESCAPE] or pygame.event.get(pygame.QUIT):
            break
        action = action_of(key for key in THRUSTERS if held[pygame.key.key_code(key)])
        *_, terminated, truncated, info = env.step(action)
        steps += 1
        if terminated or truncated or held[pygame.K_r]:
            print(f"{'success' if info['is_success'] else 'no success'}: "
                  f"{1e3 * info['goal_error'][0]:.0f} mm from the goal, "
                  f"{info['fuel']:.2f} N s of propellant")  # fmt: skip
            env.reset()
    print(f"{steps * 0.1:.1f} s flown")
    env.close()


if __name__ == "__main__":
    main()
