"""The environment's action and observation spaces."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from freeflyer_env.robot import Robot
from freeflyer_env.scenario import Problem, Scenario

ACTION_MODES = ("delta_v", "thrusters", "on_off")

#: Longest final time in s for which the observation's bounds hold.
MAX_FINAL_TIME = 200.0


def action_space(mode: str, robot: Robot, dt: float) -> spaces.Space[Any]:
    """Actions of a mode; for ``"delta_v"`` all impulses within reach at some heading."""
    if mode == "thrusters":
        return spaces.Box(0.0, 1.0, (8,), np.float32)
    if mode == "on_off":
        return spaces.MultiBinary(8)
    # Two thrusters push along each body axis; at 45 degrees to them both pairs add up.
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


def obstacle_rows(problem: Problem, max_obstacles: int) -> NDArray[np.float32]:
    """The ``obstacles`` observation ``(max_obstacles, 3)``: rows ``(x, y, radius)``, then zeros."""
    rows = np.zeros((max_obstacles, 3), dtype=np.float32)
    rows[: len(problem.scenario.obstacles)] = problem.scenario.obstacles.rows()
    return rows


def require_fit(problem: Problem, base: Scenario, space: spaces.Dict) -> None:
    """Checks that an environment made for ``base`` can pose a problem.

    Raises:
        ValueError: If robot, table or step differ, or the problem is outside the observation space.
    """
    for name in ("robot", "table", "dt"):
        theirs, ours = getattr(problem.scenario, name), getattr(base, name)
        if theirs != ours:
            raise ValueError(
                f"The problem's {name} is {theirs}, the environment's {ours}: make it with "
                "scenario=problem.scenario."
            )
    if problem.scenario.obstacles.moving:
        raise ValueError("The environment's obstacles are at rest; plan moving ones without it.")
    boxes: dict[str, Any] = dict(space.spaces)
    n_obstacles, room = len(problem.scenario.obstacles), boxes["obstacles"].shape[0]
    if n_obstacles > room:
        raise ValueError(
            f"The problem has {n_obstacles} obstacles, the environment room for {room}: make it "
            f"with max_obstacles={n_obstacles}."
        )
    if problem.final_time > MAX_FINAL_TIME:
        raise ValueError(
            f"The final time must be at most {MAX_FINAL_TIME:g} s, got {problem.final_time:g} s."
        )
    for name, key, value in (
        ("start", "state", problem.start),
        ("goal", "goal", problem.goal),
        ("obstacles", "obstacles", obstacle_rows(problem, room)),
    ):
        if not boxes[key].contains(value.astype(np.float32)):
            raise ValueError(
                f"The problem's {name} is outside the observation space: {value.tolist()}."
            )
