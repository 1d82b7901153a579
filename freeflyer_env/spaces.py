"""The environment's action and observation spaces."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces

from freeflyer_env.robot import Robot
from freeflyer_env.scenario import Scenario

#: Longest final time in s for which the observation's bounds hold.
MAX_FINAL_TIME = 200.0


def action_space(mode: str, robot: Robot, dt: float) -> spaces.Space[Any]:
    """Actions of a mode; for ``"delta_v"`` all impulses within reach at some heading."""
    if mode == "thrusters":
        return spaces.Box(0.0, 1.0, (8,), np.float32)
    if mode == "on_off":
        return spaces.MultiBinary(8)
    linear = np.sqrt(8.0) * robot.delta_v_max(dt)
    limit = np.array([linear, linear, 4.0 * robot.lever_arm * robot.delta_v_max(dt)])
    # One float32 step outwards, so that a plan at the limit is inside.
    high = np.nextafter(limit.astype(np.float32), np.float32(np.inf))
    return spaces.Box(-high, high, dtype=np.float32)


def observation_space(scenario: Scenario, max_obstacles: int) -> spaces.Dict:
    """Bounds that no episode leaves: full thrust in one direction for the longest final time."""
    robot, (width, height), t = scenario.robot, scenario.table, MAX_FINAL_TIME
    speed = np.sqrt(8.0) * robot.thrust / robot.mass * t
    rate = 4.0 * robot.lever_arm * robot.thrust / robot.inertia * t
    turn = 3.0 * np.pi + 0.5 * rate * t
    high = np.array([width, height, turn, speed, speed, rate], dtype=np.float32)
    low = np.array([0.0, 0.0, -turn, -speed, -speed, -rate], dtype=np.float32)
    rows = np.tile(
        np.array([width, height, max(width, height)], dtype=np.float32), (max_obstacles, 1)
    )
    return spaces.Dict(
        {
            "state": spaces.Box(low, high, dtype=np.float32),
            "goal": spaces.Box(low, high, dtype=np.float32),
            "obstacles": spaces.Box(np.zeros_like(rows), rows, dtype=np.float32),
            "time_to_go": spaces.Box(0.0, t, (1,), np.float32),
        }
    )
