"""Warm starts through distinct homotopy classes: left or right of each obstacle.

On which side the path passes each obstacle is what SCP cannot change once linearised. The starts
enumerate it, deterministically, instead of adding noise.
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from freeflyer_env.constraints import keep_out_depth
from freeflyer_env.planning.trajectory import Trajectory
from freeflyer_env.robot import FloatArray
from freeflyer_env.scenario import Obstacles, Problem, Scenario

_SAMPLES = 81  # points of a candidate path
_TORN = 4.0  # a gap of so many times the mean distance of a path's points

_MOST_FREE_SIDES = 6  # 64 combinations; further obstacles keep the side on which the line passes


def homotopy_starts(problem: Problem, n_starts: int) -> list[Trajectory]:
    """Warm starts through distinct homotopy classes, shortest path first.

    Candidate paths bend around the obstacles near the straight line in every combination of sides,
    or lead through the points of a coarse grid. They are pushed out of the keep-out discs; the
    shortest of each class is kept. Where a gap is narrower than the robot, pushing out tears the
    path or leaves it in a disc: such paths come last.

    A moving obstacle is taken where uniform motion along the straight line passes it.

    Returns:
        At most ``n_starts`` warm starts with zero controls; deterministic.
    """
    problem = _halted(problem)
    paths = np.concatenate([_bent_paths(problem), _grid_paths(problem)])
    paths = push_out(problem.scenario, paths, rounds=5)
    steps = np.linalg.norm(np.diff(paths, axis=1), axis=2)
    lengths = steps.sum(axis=1)
    depths = np.maximum(keep_out_depth(problem.scenario, paths[:, 1:-1]).max(axis=1), 0.0)
    flawed = (depths > 1e-3) | (steps.max(axis=1) > _TORN * lengths / _SAMPLES)
    sides = _sides(problem, paths)
    chosen: dict[bytes, FloatArray] = {}
    for index in np.lexsort((lengths, flawed)):
        chosen.setdefault(sides[index].tobytes(), paths[index])
        if len(chosen) == n_starts:
            break
    return [warm_start_along(problem, path) for path in chosen.values()][:n_starts]


def warm_start_along(problem: Problem, path: FloatArray) -> Trajectory:
    """A warm start along ``path`` ``(P, 2)``: trapezoidal speed and turn rate, zero controls."""
    lengths = np.linalg.norm(np.diff(path, axis=0), axis=1)
    arc = np.concatenate([[0.0], np.cumsum(lengths)])
    share = _trapezoid(problem.n_steps)
    positions = np.column_stack(
        [np.interp(share * arc[-1], arc, path[:, axis]) for axis in range(2)]
    )
    psi = problem.start[2] + share * (problem.goal[2] - problem.start[2])
    return Trajectory.from_poses(problem, np.column_stack([positions, psi]))


def push_out(
    scenario: Scenario,
    positions: FloatArray,
    margin: float = 0.005,
    rounds: int = 8,
    times: FloatArray | float = 0.0,
) -> FloatArray:
    """Moves positions ``(..., 2)`` radially out of the keep-out discs and onto the table.

    Where discs overlap or touch the wall, ``rounds`` of alternating projections may not suffice.

    Args:
        scenario: Gives table, robot and obstacles.
        positions: Of the robot's centre in m.
        margin: Distance in m from the discs at which they end up.
        rounds: Most rounds.
        times: When, in s, to broadcast with ``(...)``; matters only if obstacles move.
    """
    # Coordinate by coordinate: contiguous rows are twice as fast as pairs.
    x, y = (np.array(positions[..., axis], dtype=np.float64) for axis in range(2))
    low, high = scenario.position_limits
    obstacles = scenario.obstacles
    centres = obstacles.centres_at(times) if obstacles.moving else obstacles.centres
    for _ in range(rounds):
        before = x.copy(), y.copy()
        for index, radius in enumerate(scenario.keep_out_radii):
            c_x, c_y = centres[..., index, 0], centres[..., index, 1]
            away_x, away_y = x - c_x, y - c_y
            distance = np.sqrt(away_x**2 + away_y**2)
            inside = distance < radius + margin
            if inside.any():
                stretch = (radius + margin) / np.maximum(distance, 1e-9)
                np.copyto(x, c_x + away_x * stretch, where=inside)
                np.copyto(y, c_y + away_y * stretch, where=inside)
        np.clip(x, low[0], high[0], out=x)
        np.clip(y, low[1], high[1], out=y)
        moved = max(np.abs(a - b).max(initial=0.0) for a, b in zip(before, (x, y)))
        if moved <= 1e-9:
            break
    return np.stack([x, y], axis=-1)


def _halted(problem: Problem) -> Problem:
    """The problem with its moving obstacles at rest where the straight line passes them."""
    scenario = problem.scenario
    obstacles = scenario.obstacles
    if not obstacles.moving:
        return problem
    start, way = problem.start[:2], problem.goal[:2] - problem.start[:2]
    span = max(float(way @ way), 1e-12)
    every, centres = np.arange(len(obstacles)), obstacles.centres
    for _ in range(4):  # the place depends on the time, and the time on the place
        share = np.clip((centres - start) @ way / span, 0.0, 1.0)
        centres = obstacles.centres_at(share * problem.final_time)[every, every]
    return replace(
        problem, scenario=replace(scenario, obstacles=Obstacles(centres, obstacles.radii))
    )


def _bent_paths(problem: Problem) -> FloatArray:
    """Paths ``(C, P, 2)`` for all combinations of sides of the obstacles near the straight line."""
    scenario = problem.scenario
    start, goal = problem.start[:2], problem.goal[:2]
    span = max(float(np.linalg.norm(goal - start)), 1e-6)
    along = (goal - start) / span
    normal = np.array([-along[1], along[0]])
    offset = scenario.obstacles.centres - start
    progress, signed = offset @ along, offset @ normal
    clearance = scenario.keep_out_radii + 0.02
    near = (progress > 0.0) & (progress < span) & (np.abs(signed) < 2.5 * clearance)
    free = np.flatnonzero(near)[np.argsort(np.abs(signed[near]))][:_MOST_FREE_SIDES]
    free = free[np.argsort(progress[free])]
    knots = np.concatenate([[0.0], progress[free], [span]])
    samples = np.linspace(0.0, span, _SAMPLES)
    laterals = []
    for sides in itertools.product((-1.0, 1.0), repeat=len(free)):
        bend = signed[free] + np.array(sides) * clearance[free]
        # No bend where the straight line passes on that side already.
        passes = (np.sign(-signed[free]) == sides) & (np.abs(signed[free]) > clearance[free])
        bend = np.where(passes, 0.0, bend)
        laterals.append(np.interp(samples, knots, np.concatenate([[0.0], bend, [0.0]])))
    return start + samples[:, None] * along + np.array(laterals)[:, :, None] * normal


def _grid_paths(problem: Problem) -> FloatArray:
    """Paths ``(C, P, 2)`` through one or two points of a coarse grid on the table."""
    low, high = problem.scenario.position_limits
    x = low[0] + (high[0] - low[0]) * np.array([0.27, 0.5, 0.73])
    y = low[1] + (high[1] - low[1]) * np.array([0.05, 0.28, 0.5, 0.72, 0.95])
    one = [[(x[i], y[j])] for i, j in itertools.product(range(3), range(5))]
    two = [[(x[0], y[i]), (x[2], y[j])] for i, j in itertools.permutations(range(5), 2)]
    # Start and goal may lie the other way round; the points are passed in that order.
    order = -1 if problem.goal[0] < problem.start[0] else 1
    paths = []
    for vias in (np.array(one), np.array(two)):
        corners = np.empty((len(vias), vias.shape[1] + 2, 2))
        corners[:, 0], corners[:, -1] = problem.start[:2], problem.goal[:2]
        corners[:, 1:-1] = vias[:, ::order]
        paths.append(_along(corners))
    return np.concatenate(paths)


def _along(corners: FloatArray) -> FloatArray:
    """Equally spaced points ``(C, P, 2)`` along the polygons of ``corners`` ``(C, K, 2)``."""
    legs = np.diff(corners, axis=1)
    lengths = np.sqrt(legs[..., 0] ** 2 + legs[..., 1] ** 2)
    arc = np.zeros(corners.shape[:2])
    np.cumsum(lengths, axis=1, out=arc[:, 1:])
    samples = np.linspace(0.0, arc[:, -1], _SAMPLES, axis=1)
    # On which leg each point is; the last point is the last corner.
    leg = (samples[:, :, None] >= arc[:, None, 1:-1]).sum(axis=2)
    rows = np.arange(len(corners))[:, None]
    slope = legs / np.maximum(np.diff(arc, axis=1), 1e-300)[..., None]
    points = slope[rows, leg] * (samples - arc[rows, leg])[..., None] + corners[rows, leg]
    points[:, -1] = corners[:, -1]
    return points


def _trapezoid(n: int, ramp: float = 0.15) -> FloatArray:
    """Share of the way ``(n,)`` under a trapezoidal speed profile with ramps of share ``ramp``."""
    t = np.linspace(0.0, 1.0, n)
    speed = np.minimum(1.0, np.minimum(t, 1.0 - t) / ramp)
    if n == 2:
        return t
    way = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]))])
    return way / way[-1]


def _sides(problem: Problem, paths: FloatArray) -> NDArray[np.bool_]:
    """``(C, M)`` whether each of the paths ``(C, P, 2)`` passes each obstacle on its right."""
    direction = np.gradient(paths, axis=1)
    sides = np.zeros((len(paths), len(problem.scenario.obstacles)), dtype=bool)
    rows = np.arange(len(paths))
    for index, centre in enumerate(problem.scenario.obstacles.centres):
        offset = centre - paths
        nearest = np.argmin((offset**2).sum(axis=2), axis=1)
        d, o = direction[rows, nearest], offset[rows, nearest]
        sides[:, index] = d[:, 0] * o[:, 1] - d[:, 1] * o[:, 0] < 0.0
    return sides
