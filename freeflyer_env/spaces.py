"""The environment's action and observation spaces."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from freeflyer_env.robot import Robot
from freeflyer_env.scenario import Obstacles, Problem, Scenario

ACTION_MODES = ("delta_v", "thrusters", "on_off")

#: Keys of the observation that each modality adds.
MODALITIES = {
    "state": ("state", "goal", "obstacles", "time_to_go"),
    "robot": ("state", "goal", "time_to_go"),
    "image": ("image",),
    "lidar": ("lidar",),
}

#: Largest distance in m that the lidar tells; the table's diagonal is 4.3 m.
LIDAR_REACH = 5.0

#: Fastest obstacle in m/s, per axis, that an observation can tell.
MAX_OBSTACLE_SPEED = 1.0

#: Relative tolerance of the bounds of impulses.
BOUND_TOLERANCE = 1e-4

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
    # A little outwards, so that a plan at the limit is inside in spite of a solver's tolerance.
    high = (limit * (1.0 + BOUND_TOLERANCE)).astype(np.float32)
    return spaces.Box(-high, high, dtype=np.float32)


def observation_space(
    scenario: Scenario,
    max_obstacles: int,
    modalities: tuple[str, ...] = ("state",),
    moving: bool = False,
    image_size: tuple[int, int] = (80, 112),
    lidar_rays: int = 32,
) -> spaces.Dict:
    """Bounds that no episode leaves: full thrust in one direction for the longest final time.

    Args:
        scenario: Gives robot and table.
        max_obstacles: Rows of ``obstacles``.
        modalities: Keys of :data:`MODALITIES`.
        moving: Whether the rows of ``obstacles`` have velocities.
        image_size: ``(H, W)`` of the image in pixels.
        lidar_rays: Number of rays.
    """
    robot, (width, height), t = scenario.robot, scenario.table, MAX_FINAL_TIME
    speed = np.sqrt(8.0) * robot.thrust / robot.mass * t
    rate = 4.0 * robot.lever_arm * robot.thrust / robot.inertia * t
    turn = 3.0 * np.pi + 0.5 * rate * t
    high = np.array([width, height, turn, speed, speed, rate], dtype=np.float32)
    low = np.array([0.0, 0.0, -turn, -speed, -speed, -rate], dtype=np.float32)
    far, top = max(width, height), MAX_OBSTACLE_SPEED
    row_low, row_high = np.zeros(3), np.array([width, height, far])
    if moving:
        # Nothing keeps a moving obstacle on the table; beyond this it is told at the bound.
        row_low = np.array([-width, -height, 0.0, -top, -top])
        row_high = np.array([2 * width, 2 * height, far, top, top])
    rows_low, rows_high = (
        np.tile(row.astype(np.float32), (max_obstacles, 1)) for row in (row_low, row_high)
    )
    boxes: dict[str, spaces.Space[Any]] = {
        "state": spaces.Box(low, high, dtype=np.float32),
        "goal": spaces.Box(low, high, dtype=np.float32),
        "obstacles": spaces.Box(rows_low, rows_high, dtype=np.float32),
        "time_to_go": spaces.Box(0.0, t, (1,), np.float32),
        "image": spaces.Box(0, 255, (*image_size, 3), np.uint8),
        "lidar": spaces.Box(0.0, LIDAR_REACH, (lidar_rays,), np.float32),
    }
    keys = {key: boxes[key] for modality in modalities for key in MODALITIES[modality]}
    return spaces.Dict(keys)


def obstacle_rows(
    obstacles: Obstacles, max_obstacles: int, moving: bool = False, time: float = 0.0
) -> NDArray[np.float32]:
    """The ``obstacles`` observation: rows ``(x, y, radius)``, then zeros.

    Args:
        obstacles: What is on the table.
        max_obstacles: Number of rows.
        moving: Whether the rows go on with ``(v_x, v_y)``.
        time: When, in s.
    """
    rows = np.zeros((max_obstacles, 5 if moving else 3), dtype=np.float32)
    if len(obstacles):
        now = obstacles.after(time) if moving and time else obstacles
        table = now.rows()
        rows[: len(table), : table.shape[1]] = table
    return rows


def rows_at(rows: NDArray[Any], times: NDArray[Any]) -> NDArray[np.float32]:
    """Rows ``(M, 3)`` or ``(M, 5)`` of obstacles in uniform motion, at later times.

    Args:
        rows: ``(x, y, radius)``, with ``(v_x, v_y)`` or without, at time zero.
        times: ``(L,)`` in s.

    Returns:
        ``(L, M, 3 or 5)``.
    """
    table = np.repeat(np.asarray(rows, dtype=np.float64)[None], len(times), axis=0)
    if table.shape[2] == 5:
        table[..., :2] += times[:, None, None] * table[..., 3:]
    return table.astype(np.float32)


def obstacle_mask(rows: NDArray[Any]) -> NDArray[np.bool_]:
    """``(..., M)`` which rows ``(..., M, 3 or 5)`` of an observation are obstacles, not padding."""
    return np.asarray(rows)[..., 2] > 0.0


def require_choice(name: str, value: Any, choices: Iterable[str]) -> None:
    """Raises a ``ValueError`` that names the nearest choice, if a value is not among them."""
    choices = tuple(choices)
    if value not in choices:
        near = difflib.get_close_matches(str(value), choices, n=1)
        hint = f" Did you mean {near[0]!r}?" if near else ""
        raise ValueError(f"{name} must be one of {choices}, got {value!r}.{hint}")


def require_integer(name: str, value: Any, least: int) -> None:
    """Raises a ``ValueError`` unless a value is a whole number of at least ``least``."""
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not whole or value < least:
        raise ValueError(f"{name} must be at least {least}, a whole number, got {value!r}.")


def require_number(name: str, value: Any) -> None:
    """Raises a ``ValueError`` unless a value is a finite number."""
    real = isinstance(value, int | float | np.integer | np.floating)
    if not real or isinstance(value, bool) or not np.isfinite(value):
        raise ValueError(f"{name} must be a finite number, got {value!r}.")


def require_fit(problem: Problem, base: Scenario, space: spaces.Dict) -> None:
    """Checks that an environment made for ``base`` can pose a problem.

    Args:
        problem: What is to be posed.
        base: Gives robot, table and step.
        space: With boxes ``state``, ``goal`` and ``obstacles``, whatever the environment shows.

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
    boxes: dict[str, Any] = dict(space.spaces)
    obstacles, (room, columns) = problem.scenario.obstacles, boxes["obstacles"].shape
    if obstacles.moving and columns == 3:
        raise ValueError(
            "The environment was made for obstacles at rest: make it with moving_obstacles=True."
        )
    if len(obstacles) > room:
        raise ValueError(
            f"The problem has {len(obstacles)} obstacles, the environment room for {room}: make it "
            f"with max_obstacles={len(obstacles)}."
        )
    if problem.final_time > MAX_FINAL_TIME:
        raise ValueError(
            f"The final time must be at most {MAX_FINAL_TIME:g} s, got {problem.final_time:g} s."
        )
    for name, key, value in (
        ("start", "state", problem.start),
        ("goal", "goal", problem.goal),
        ("obstacles", "obstacles", obstacle_rows(obstacles, room, columns == 5)),
    ):
        if not boxes[key].contains(value.astype(np.float32)):
            raise ValueError(
                f"The problem's {name} is outside the observation space: {value.tolist()}."
            )
