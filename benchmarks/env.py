"""Speed of the environment: ``python -m benchmarks.env [--out FILE]``.

Everything is measured in turns in one run, several rounds, and reported as the median; ratios are
of the same round. All of it runs on one thread, and what counts is its processor time, so that
other work on the machine does little harm. ``bare pymunk`` is the loop that no environment on
pymunk can do without: change the velocity, take the sub-steps, read the state.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import gymnasium as gym
import numpy as np
import pymunk

import freeflyer_env  # noqa: F401  registers FreeFlyer-v0

N_ENVS = 1024


def scalar(name: str, **arguments: object) -> Callable[[int], float]:
    """Steps/s of an environment through ``gym.make`` under random actions, resets included."""
    env = gym.make(name, **arguments)
    env.reset(seed=0)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(500)]

    def measure(steps: int) -> float:
        begun = time.process_time()
        for number in range(steps):
            *_, terminated, truncated, _ = env.step(actions[number % 500])
            if terminated or truncated:
                env.reset()
        return steps / (time.process_time() - begun)

    return measure


def vector(**arguments: object) -> Callable[[int], float]:
    """The same of the vector form with :data:`N_ENVS` environments."""
    envs = gym.make_vec(
        "FreeFlyer-v0", num_envs=N_ENVS, vectorization_mode="vector_entry_point", **arguments
    )
    envs.reset(seed=0)
    envs.action_space.seed(0)
    actions = [envs.action_space.sample() for _ in range(8)]

    def measure(steps: int) -> float:
        steps = max(steps // 20, 100)  # a whole episode at least, so that resets are in it
        begun = time.process_time()
        for number in range(steps):
            envs.step(actions[number % 8])
        return steps * N_ENVS / (time.process_time() - begun)

    return measure


def bare_pymunk(sub_steps: int, h: float, per_sub_step: bool) -> Callable[[int], float]:
    """One disc among four discs and four walls, ``sub_steps`` steps of ``h`` seconds at a time."""
    space = pymunk.Space()
    body = pymunk.Body(16.0, 0.18)
    body.position = (0.3, 1.2)
    space.add(body, pymunk.Circle(body, 0.15))
    for place in ((1.0, 0.7), (1.5, 1.7), (2.5, 0.75), (2.5, 1.75)):
        space.add(pymunk.Circle(space.static_body, 0.2, place))
    corners = [(0.0, 0.0), (3.5, 0.0), (3.5, 2.5), (0.0, 2.5)]
    for first, second in zip(corners, corners[1:] + corners[:1]):
        space.add(pymunk.Segment(space.static_body, first, second, 0.01))

    def read() -> tuple[object, ...]:
        return body.position, body.angle, body.velocity, body.angular_velocity

    def measure(steps: int) -> float:
        begun = time.process_time()
        for number in range(steps):
            change = 1e-4 if number % 2 else -1e-4
            body.velocity = (body.velocity[0] + change, body.velocity[1])
            for _ in range(sub_steps):
                if per_sub_step:
                    body.force = (1e3 * change, 0.0)
                space.step(h)
                if per_sub_step:
                    read()
            read()
        return steps / (time.process_time() - begun)

    return measure


def main() -> None:
    """Prints the table, and writes it as JSON if asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=4000)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    contenders: dict[str, Callable[[int], float]] = {
        "delta_v": scalar("FreeFlyer-v0"),
        "thrusters": scalar("FreeFlyer-v0", action_mode="thrusters"),
        "on_off": scalar("FreeFlyer-v0", action_mode="on_off"),
        "delta_v, lidar": scalar("FreeFlyer-v0", observation=("robot", "lidar")),
        "delta_v, image": scalar("FreeFlyer-v0", observation=("robot", "image")),
        "bare pymunk, 10 sub-steps": bare_pymunk(10, 0.05, per_sub_step=False),
        "bare pymunk, force and state at each": bare_pymunk(10, 0.05, per_sub_step=True),
        f"vector of {N_ENVS}, delta_v": vector(),
        f"vector of {N_ENVS}, thrusters": vector(action_mode="thrusters"),
        f"vector of {N_ENVS}, on_off": vector(action_mode="on_off"),
    }
    try:
        contenders["LunarLander-v3"] = scalar("LunarLander-v3")
    except (gym.error.DependencyNotInstalled, ImportError):
        print('LunarLander-v3 is left out: it needs pip install "gymnasium[box2d]"')
    rounds = [
        {name: measure(options.steps) for name, measure in contenders.items()}
        for _ in range(options.rounds)
    ]
    table = {}
    print("\n| | steps/s | over scalar delta_v |\n|---|---|---|")
    for name in contenders:
        rate = statistics.median(round_[name] for round_ in rounds)
        ratio = statistics.median(round_[name] / round_["delta_v"] for round_ in rounds)
        table[name] = {"steps_per_second": rate, "over_delta_v": ratio}
        print(f"| {name} | {rate:,.0f} | {ratio:.2f} |")
    if options.out:
        options.out.write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    np.seterr(all="raise", under="ignore")
    main()
