"""Proofs that a problem has no solution, for what can be proved in closed form.

Nothing here is needed to solve a problem: it is asked when solving failed, to tell a hopeless
problem from a hard one.
"""

from __future__ import annotations

import itertools

import numpy as np

from freeflyer_env.robot import FloatArray
from freeflyer_env.scenario import Problem

_AXES = ("x", "y", "the heading")
_UNITS = ("m/s", "m/s", "rad/s")


def why_infeasible(problem: Problem, *, keep_out: bool = True) -> str | None:
    """Why the problem provably has no solution: which constraint, and by how much; else None.

    Three families of proofs: the start's (or the goal's) velocity carries the robot off the table;
    the final time is too short for the thrusters, along an axis at any heading; static keep-out
    discs and the table's edge separate the goal from the start. The last one is about continuous
    motion: where keep-out is only imposed at the nodes, a fast robot may hop over a thin place.

    Args:
        problem: The problem.
        keep_out: Whether the obstacles count (False: REL).
    """
    reason = _off_the_table(problem) or _too_short(problem)
    return reason or (_separated(problem) if keep_out else None)


def impulse_limits(problem: Problem) -> FloatArray:
    """``(3,)`` largest change of ``v_x``, ``v_y`` and ``omega`` by one impulse, at any heading."""
    robot, dt = problem.scenario.robot, problem.scenario.dt
    # Lambda^+ bounds |dv_x|, |dv_y| (body) by 2 dV each, and |h| by 4 b dV.
    corner = 2.0 * np.sqrt(2.0)
    reach = np.array([corner, corner, 4.0 * robot.lever_arm])
    return robot.delta_v_max(dt) * reach * robot.control_gain


def needed_impulses(problem: Problem, n_steps: int | None = None) -> FloatArray:
    """``(3,)`` smallest bound on the impulses, per axis, that can meet start and goal at all.

    Each axis is a double integrator; the largest of its impulses is at least ``w't / ||W'w||_1``
    for every direction ``w`` of the space of (position, velocity), where ``t`` is the change to
    make and ``W`` maps impulses to it. The best direction is one of the ``N + 1`` breakpoints.

    Args:
        problem: Gives start, goal and step.
        n_steps: Number of impulses; the problem's own if None.
    """
    n, dt = n_steps or problem.n_steps, problem.scenario.dt
    levers = dt * np.arange(n - 1, -1, -1.0)  # metres at the end per m/s of each impulse
    travel = problem.goal[:3] - problem.start[:3] - problem.start[3:] * levers[0]
    change = problem.goal[3:] - problem.start[3:]
    effort = np.abs(levers[:, None] - levers).sum(axis=1)
    along = np.abs(travel - levers[:, None] * change) / effort[:, None]
    return np.maximum(along.max(axis=0), np.abs(change) / n)


def shortest_final_time(problem: Problem, longest: float = 1000.0) -> float | None:
    """A lower bound in s on the final time, by :func:`needed_impulses`; None beyond ``longest``."""
    dt, limits = problem.scenario.dt, impulse_limits(problem)
    steps = range(2, int(longest / dt) + 1)
    found = (n for n in steps if (needed_impulses(problem, n) <= limits * (1.0 + 1e-9)).all())
    enough = next(found, None)
    return None if enough is None else enough * dt


def _too_short(problem: Problem) -> str | None:
    limits = impulse_limits(problem)
    needed = needed_impulses(problem)
    excess = needed / limits
    worst = int(np.argmax(excess))
    if excess[worst] <= 1.0 + 1e-9:
        return None
    enough = shortest_final_time(problem)
    remedy = f"at least {enough:g} s needed" if enough else "no final time will do"
    return (
        f"the final time of {problem.final_time:g} s is too short (actuation): along "
        f"{_AXES[worst]} an impulse of {needed[worst]:.3g} {_UNITS[worst]} is needed, the "
        f"thrusters give {limits[worst]:.3g} at most; {remedy}"
    )


def _off_the_table(problem: Problem) -> str | None:
    """Full thrust against a start velocity (or, backwards in time, a goal velocity)."""
    dt, limits = problem.scenario.dt, impulse_limits(problem)
    low, high = problem.scenario.position_limits
    k = np.arange(1, problem.n_steps - 1)
    for name, state, sense in (("start", problem.start, 1.0), ("goal", problem.goal, -1.0)):
        for axis in range(2):
            position, velocity = state[axis], sense * state[3 + axis]
            # The first impulse acts before the first drift; seen backwards the last one does, too.
            brake = limits[axis] * dt * k * (k + 1) / 2
            over = (position + velocity * k * dt - brake - high[axis]).max(initial=-np.inf)
            under = (low[axis] - position - velocity * k * dt - brake).max(initial=-np.inf)
            if max(over, under) > 1e-6:
                return (
                    f"the {name}'s velocity of {state[3 + axis]:.3g} m/s along {_AXES[axis]} is "
                    f"too fast so near the edge of the table: the robot is {max(over, under):.3g} "
                    "m beyond it even at full thrust; lower it or move the state inwards"
                )
    return None


def _separated(problem: Problem) -> str | None:
    """Keep-out discs that overlap, and the edge, form a closed curve between start and goal.

    Every pair of overlapping discs is joined by a segment between centres, and every disc that
    reaches over the table's edge by one to the edge. A cycle of such segments separates start and
    goal if and only if the straight line between these crosses it an odd number of times.
    """
    scenario = problem.scenario
    if scenario.obstacles.moving:
        return None
    centres, radii = scenario.obstacles.centres, scenario.keep_out_radii
    low, high = scenario.position_limits
    edge = len(radii)
    links: list[tuple[int, int, FloatArray, FloatArray]] = []
    for i, j in itertools.combinations(range(edge), 2):
        if np.linalg.norm(centres[i] - centres[j]) < radii[i] + radii[j] - 1e-9:
            links.append((i, j, centres[i], centres[j]))
    for i, (centre, radius) in enumerate(zip(centres, radii)):
        for axis in range(2):
            for limit, beyond in ((low, centre - radius < low), (high, centre + radius > high)):
                if beyond[axis]:
                    foot = centre.copy()
                    foot[axis] = limit[axis]
                    links.append((i, edge, centre, foot))
    parity: dict[int, bool] = {}
    for root in range(edge + 1):
        stack = [] if root in parity else [root]
        parity.setdefault(root, False)
        while stack:
            here = stack.pop()
            for i, j, first, second in links:
                if here not in (i, j):
                    continue
                there = j if here == i else i
                odd = parity[here] ^ _cross(problem.start[:2], problem.goal[:2], first, second)
                if there not in parity:
                    parity[there] = odd
                    stack.append(there)
                elif parity[there] != odd:
                    return (
                        "the goal is cut off from the start (keep-out): the keep-out discs, with "
                        "the edge of the table, leave no gap to move through; move an obstacle"
                    )
    return None


def _cross(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> bool:
    """Whether the segments ``a b`` and ``c d`` cross; points ``(2,)``."""

    def side(p: FloatArray, q: FloatArray, r: FloatArray) -> bool:
        return bool((q[0] - p[0]) * (r[1] - p[1]) > (q[1] - p[1]) * (r[0] - p[0]))

    return side(a, b, c) != side(a, b, d) and side(c, d, a) != side(c, d, b)
