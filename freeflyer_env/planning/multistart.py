"""Several starts, each passing the obstacles on other sides: the teacher, and the honest baseline.

Whether the path passes left or right of each obstacle (its homotopy class, seen from start to goal)
is what SCP cannot change once linearised, so the starts enumerate it instead of adding noise.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from freeflyer_env.constraints import keep_out_depth
from freeflyer_env.planning.scp import SCPConfig, SCPResult, solve_rel, solve_scp
from freeflyer_env.planning.trajectory import Trajectory
from freeflyer_env.robot import FloatArray
from freeflyer_env.scenario import Problem, Scenario

#: Two optima are the same if their costs and positions agree to these (m/s, m).
_SAME_COST, _SAME_POSITION = 1e-4, 0.02

_MOST_FREE_SIDES = 6  # 64 combinations; further obstacles keep the side on which the line passes


@dataclass(frozen=True, eq=False)
class MultistartResult:
    """What the starts of one problem led to.

    Attributes:
        rel: The REL solution, start 0 of the list.
        results: One SCP result per start.
        optima: Distinct solved optima, cheapest first.
    """

    rel: SCPResult
    results: tuple[SCPResult, ...]
    optima: tuple[SCPResult, ...]

    @property
    def best(self) -> SCPResult:
        """The cheapest optimum; the REL-started result where nothing was solved."""
        return self.optima[0] if self.optima else self.results[0]


def solve_multistart(
    problem: Problem, n_starts: int = 6, config: SCPConfig | None = None
) -> MultistartResult:
    """SCP from REL and from up to ``n_starts - 1`` paths in distinct homotopy classes.

    Args:
        problem: What to solve.
        n_starts: Number of starts, at least 1; 1 is SCP from REL. Fewer are used where the
            obstacles allow fewer classes.
        config: Settings of every SCP loop.

    Returns:
        All results; deterministic, no random numbers are used.
    """
    if n_starts < 1:
        raise ValueError(f"n_starts must be at least 1, got {n_starts}.")
    rel = solve_rel(problem, config)
    if rel.trajectory is None:
        return MultistartResult(rel, (rel,), ())
    starts = [rel.trajectory]
    if n_starts > 1:
        starts += homotopy_starts(problem, n_starts - 1)
    results = tuple(solve_scp(problem, start, config) for start in starts)
    return MultistartResult(rel, results, distinct_optima(results))


def distinct_optima(results: tuple[SCPResult, ...]) -> tuple[SCPResult, ...]:
    """The solved results without repetitions, cheapest first."""
    found: list[SCPResult] = []
    for result in sorted((r for r in results if r.solved), key=lambda r: r.cost):
        if not any(_same(result, other) for other in found):
            found.append(result)
    return tuple(found)


def homotopy_starts(problem: Problem, n_starts: int) -> list[Trajectory]:
    """Warm starts through distinct homotopy classes, shortest path first.

    Each combination of sides gives a path that bends around the obstacles near the straight line;
    it is pushed out of the keep-out discs, and kept if it is the shortest of its class and stays on
    the table and out of the discs.

    Returns:
        At most ``n_starts`` warm starts with zero controls.
    """
    by_class: dict[tuple[bool, ...], tuple[float, FloatArray]] = {}
    for path in _candidate_paths(problem):
        path = push_out(problem.scenario, path)
        # A gap narrower than the robot cannot be passed: projecting leaves the path in a disc.
        if keep_out_depth(problem.scenario, path[1:-1]).max(initial=-np.inf) > 1e-3:
            continue
        length = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
        sides = _sides(problem, path)
        if sides not in by_class or length < by_class[sides][0]:
            by_class[sides] = (length, path)
    ranked = sorted(by_class.values(), key=lambda pair: pair[0])[:n_starts]
    return [warm_start_along(problem, path) for _, path in ranked]


def warm_start_along(problem: Problem, path: FloatArray) -> Trajectory:
    """A warm start along ``path`` ``(P, 2)``: trapezoidal speed, uniform turn, zero controls."""
    lengths = np.linalg.norm(np.diff(path, axis=0), axis=1)
    arc = np.concatenate([[0.0], np.cumsum(lengths)])
    share = _trapezoid(problem.n_steps)
    positions = np.column_stack(
        [np.interp(share * arc[-1], arc, path[:, axis]) for axis in range(2)]
    )
    psi = problem.start[2] + share * (problem.goal[2] - problem.start[2])
    return Trajectory.from_poses(problem, np.column_stack([positions, psi]))


def push_out(
    scenario: Scenario, positions: FloatArray, margin: float = 0.005, rounds: int = 8
) -> FloatArray:
    """Moves positions ``(..., 2)`` radially out of the keep-out discs and onto the table.

    Where discs overlap or touch the wall, ``rounds`` of alternating projections may not suffice.
    """
    positions = np.array(positions, dtype=np.float64)
    low, high = scenario.position_limits
    for _ in range(rounds):
        for centre, radius in zip(scenario.obstacles.centres, scenario.keep_out_radii):
            offset = positions - centre
            distance = np.linalg.norm(offset, axis=-1, keepdims=True)
            pushed = centre + offset * ((radius + margin) / np.maximum(distance, 1e-9))
            positions = np.where(distance < radius + margin, pushed, positions)
        positions = np.clip(positions, low, high)
    return positions


def _candidate_paths(problem: Problem) -> list[FloatArray]:
    """Piecewise linear paths ``(P, 2)`` for all combinations of sides of the obstacles that matter."""
    scenario = problem.scenario
    start, goal = problem.start[:2], problem.goal[:2]
    span = float(np.linalg.norm(goal - start))
    if span < 1e-6:
        return []
    along = (goal - start) / span
    normal = np.array([-along[1], along[0]])
    offset = scenario.obstacles.centres - start
    progress, signed = offset @ along, offset @ normal
    clearance = scenario.keep_out_radii + 0.02
    between = (progress > 0.0) & (progress < span)
    near = between & (np.abs(signed) < 2.5 * clearance)
    free = np.flatnonzero(near)[np.argsort(np.abs(signed[near]))][:_MOST_FREE_SIDES]
    free = free[np.argsort(progress[free])]
    samples = np.linspace(0.0, span, 161)
    paths = []
    for sides in itertools.product((-1.0, 1.0), repeat=len(free)):
        # Bounds of the lateral offset at each obstacle, zero where the line passes on that side.
        bend = signed[free] + np.array(sides) * clearance[free]
        natural = np.sign(-signed[free]) == np.array(sides)
        wide = np.abs(signed[free]) > clearance[free]
        bend = np.where(natural & wide, 0.0, bend)
        knots = np.concatenate([[0.0], progress[free], [span]])
        lateral = np.interp(samples, knots, np.concatenate([[0.0], bend, [0.0]]))
        paths.append(start + samples[:, None] * along + lateral[:, None] * normal)
    return paths


def _trapezoid(n: int, ramp: float = 0.15) -> FloatArray:
    """Share of the way ``(n,)`` under a trapezoidal speed profile; ``ramp`` is each ramp's share."""
    t = np.linspace(0.0, 1.0, n)
    speed = np.minimum(1.0, np.minimum(t, 1.0 - t) / ramp)
    way = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]))])
    return way / way[-1]


def _sides(problem: Problem, path: FloatArray) -> tuple[bool, ...]:
    """Whether the path passes each obstacle with the obstacle to its right."""
    direction = np.gradient(path, axis=0)
    sides = []
    for centre in problem.scenario.obstacles.centres:
        offset = centre - path
        nearest = int(np.argmin((offset**2).sum(axis=1)))
        d, o = direction[nearest], offset[nearest]
        sides.append(bool(d[0] * o[1] - d[1] * o[0] < 0.0))
    return tuple(sides)


def _same(first: SCPResult, second: SCPResult) -> bool:
    assert first.trajectory is not None and second.trajectory is not None
    if abs(first.cost - second.cost) > _SAME_COST:
        return False
    gap = first.trajectory.states[:, :2] - second.trajectory.states[:, :2]
    return bool(np.abs(gap).max() < _SAME_POSITION)
