"""Random scenes and problems (paper, Sec. IV-A), one at a time or many.

One at a time, a generator always gives the same problems: datasets depend on it. Many at a time
have the same distribution.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from freeflyer_env.robot import FloatArray
from freeflyer_env.scenario import Obstacles, Problem, Scenario, unwrap_goal


def sample_obstacles(
    rng: np.random.Generator,
    n_obstacles: int = 4,
    radius_range: tuple[float, float] = (0.1, 0.2),
    table: tuple[float, float] = (3.5, 2.5),
    gap: float = 0.0,
) -> Obstacles:
    """Random discs that do not overlap, centres with x in [0.5, 3.0] m (paper, ART-Rs).

    Args:
        rng: Source of randomness.
        n_obstacles: How many discs.
        radius_range: Smallest and largest radius in m.
        table: Size of the table in m.
        gap: Least distance between two discs' edges in m.

    Raises:
        ValueError: If so many discs do not fit.
    """
    return Obstacles.from_rows(_sample_discs(rng, n_obstacles, radius_range, table, gap))


def _sample_discs(
    rng: np.random.Generator,
    n_obstacles: int,
    radius_range: tuple[float, float],
    table: tuple[float, float],
    gap: float = 0.0,
) -> FloatArray:
    """Rows ``(x, y, radius)`` of :func:`sample_obstacles`."""
    rows: list[tuple[float, float, float]] = []
    for attempt in range(10_000):
        if len(rows) == n_obstacles:
            break
        if gap and attempt % 500 == 499:
            rows = []  # the first ones may have left no room
        radius = rng.uniform(*radius_range)
        x = rng.uniform(0.5, table[0] - 0.5)
        y = rng.uniform(radius, table[1] - radius)
        if all(math.hypot(x - other[0], y - other[1]) > radius + other[2] + gap for other in rows):
            rows.append((x, y, radius))
    if len(rows) < n_obstacles:
        raise ValueError(f"Could not place {n_obstacles} obstacles on the table; ask for fewer.")
    return np.array(rows).reshape(-1, 3)


def sample_problem(
    rng: np.random.Generator,
    scenario: Scenario | None = None,
    final_time: float = 40.0,
    n_obstacles: int = 4,
    obstacle_speed: float = 0.0,
) -> Problem:
    """A random problem: start region left, goal region right, headings uniform, both at rest.

    Start and goal are free of keep-out zones; nothing else is promised, so some problems are hard
    and a few have no solution. Values are exactly representable in float32, so that a problem read
    back from an observation is the same problem.

    Args:
        rng: Source of randomness.
        scenario: The scene; a new one with random obstacles if None (paper, ART-Rs).
        final_time: Final time in s.
        n_obstacles: Number of obstacles of a new scene.
        obstacle_speed: Largest speed in m/s of the obstacles of a new scene; each moves uniformly
            in a random direction.
    """
    if scenario is None:
        rows = _sample_discs(rng, n_obstacles, (0.1, 0.2), Scenario.table)
        if obstacle_speed > 0.0:
            speed, course = rng.uniform(
                [[0.0], [-np.pi]], [[obstacle_speed], [np.pi]], (2, len(rows))
            )
            rows = np.column_stack([rows, speed * np.cos(course), speed * np.sin(course)])
        rows = _float32_exact(rows)
        scenario = Scenario(Obstacles.from_rows(rows))
    radius, (width, _) = scenario.robot.radius, scenario.table
    if radius > 0.25 or width < 1.0:
        raise ValueError(
            "Random problems need room for start and goal: a robot radius of at most 0.25 m and a "
            f"table at least 1 m long, got {radius} m and {width} m; give a problem instead."
        )
    start = _sample_state_at_rest(rng, scenario, (radius, 0.5 - radius), 0.0)
    goal_range = (width - 0.5 + radius, width - radius)
    goal = _sample_state_at_rest(rng, scenario, goal_range, final_time - scenario.dt)
    goal = _float32_exact(unwrap_goal(start, goal))
    return Problem(scenario, start, goal, final_time)


def sample_tables(rng: np.random.Generator, counts: ArrayLike, max_obstacles: int) -> FloatArray:
    """Discs of many random scenes at once, distributed as :func:`sample_obstacles` places them.

    Args:
        rng: Source of randomness.
        counts: ``(k,)`` discs of each scene.
        max_obstacles: Number ``M`` of rows of each.

    Returns:
        ``(k, M, 3)`` rows ``(x, y, radius)`` in m, exact in float32, zero beyond the count.

    Raises:
        ValueError: If so many discs do not fit.
    """
    counts = np.asarray(counts)
    width, height = Scenario.table
    rows = np.zeros((len(counts), max_obstacles, 3))
    placed = np.zeros(len(counts), dtype=np.int64)
    for _ in range(10_000):
        open_ = np.flatnonzero(placed < counts)
        if not len(open_):
            return _float32_exact(rows)
        radius = rng.uniform(0.1, 0.2, len(open_))
        x = rng.uniform(0.5, width - 0.5, len(open_))
        y = rng.uniform(radius, height - radius)
        others = rows[open_]
        gaps = np.hypot(x[:, None] - others[..., 0], y[:, None] - others[..., 1])
        free = ((others[..., 2] == 0.0) | (gaps > radius[:, None] + others[..., 2])).all(axis=1)
        chosen = open_[free]
        rows[chosen, placed[chosen]] = np.column_stack([x, y, radius])[free]
        placed[chosen] += 1
    raise ValueError(f"Could not place {counts.max()} obstacles on the table; ask for fewer.")


def sample_states(
    rng: np.random.Generator, scenario: Scenario, rows: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Starts and goals of many problems at once, distributed as in :func:`sample_problem`.

    Args:
        rng: Source of randomness.
        scenario: Gives robot, table and keep-out factor.
        rows: ``(k, M, 3)`` discs at rest; radius zero is padding.

    Returns:
        Start and goal states ``(k, 6)``.

    Raises:
        ValueError: If the obstacles leave no room.
    """
    radius, (width, _) = scenario.robot.radius, scenario.table
    low, high = (limit[1] for limit in scenario.position_limits)
    keep_out = np.where(
        rows[..., 2] > 0.0, (rows[..., 2] + radius) * scenario.keep_out_factor, -1.0
    )
    states = []
    for x_low, x_high in ((radius, 0.5 - radius), (width - 0.5 + radius, width - radius)):
        state = np.zeros((len(rows), 6))
        open_ = np.arange(len(rows))
        for _ in range(10_000):
            if not len(open_):
                break
            pose = rng.uniform([x_low, low, -np.pi], [x_high, high, np.pi], (len(open_), 3))
            state[open_, :3] = _float32_exact(pose)
            offset = state[open_, None, :2] - rows[open_, :, :2]
            gaps = np.hypot(offset[..., 0], offset[..., 1])
            open_ = open_[(gaps <= keep_out[open_]).any(axis=1)]
        if len(open_):
            raise ValueError(
                f"The obstacles leave no free place with x in {(x_low, x_high)} m; use other "
                "obstacles."
            )
        states.append(state)
    start, goal = states
    turn = goal[:, 2] - start[:, 2]
    goal[:, 2] = start[:, 2] + (turn + np.pi) % (2 * np.pi) - np.pi
    return start, _float32_exact(goal)


def _sample_state_at_rest(
    rng: np.random.Generator, scenario: Scenario, x_range: tuple[float, float], time: float
) -> FloatArray:
    low, high = (limit[1] for limit in scenario.position_limits)
    obstacles = scenario.obstacles
    centres = (obstacles.centres_at(time) if obstacles.moving else obstacles.centres).tolist()
    keep_out = scenario.keep_out_radii.tolist()
    for _ in range(10_000):
        pose = [rng.uniform(*x_range), rng.uniform(low, high), rng.uniform(-np.pi, np.pi)]
        state = _float32_exact(np.array([*pose, 0.0, 0.0, 0.0]))
        x, y = state[:2].tolist()
        if all(math.hypot(x - cx, y - cy) > gap for (cx, cy), gap in zip(centres, keep_out)):
            return state
    raise ValueError(
        f"The obstacles leave no free place with x in {x_range} m; use other obstacles."
    )


def _float32_exact(values: FloatArray) -> FloatArray:
    return values.astype(np.float32).astype(np.float64)
