"""Free final time: the Pareto front of cost against final time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from freeflyer_env.planning.infeasibility import shortest_final_time
from freeflyer_env.planning.result import SCPResult
from freeflyer_env.planning.scp import SCPConfig, solve_rel, solve_scp
from freeflyer_env.planning.trajectory import Trajectory
from freeflyer_env.robot import FloatArray
from freeflyer_env.scenario import Problem

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: More or less the same cost (relative): a longer final time has to save more than this.
_SAME_COST = 1e-6


@dataclass(frozen=True, eq=False)
class ParetoFront:
    """Cost against final time for one start, goal and scene.

    Attributes:
        problem: What was asked; its own final time plays no part.
        final_times: ``(K,)`` final times in s, ascending.
        results: The best SCP result at each.
        rel_costs: ``(K,)`` costs of REL, the lower bound, in m/s; infinite where it failed.
    """

    problem: Problem
    final_times: FloatArray
    results: tuple[SCPResult, ...]
    rel_costs: FloatArray

    @property
    def costs(self) -> FloatArray:
        """``(K,)`` costs in m/s, infinite where nothing was found."""
        return np.array([result.cost for result in self.results])

    @property
    def efficient(self) -> np.ndarray:
        """``(K,)`` whether a solution was found and none that is faster is as cheap."""
        costs = self.costs
        cheapest_before = np.minimum.accumulate(np.concatenate([[np.inf], costs[:-1]]))
        return costs < cheapest_before * (1.0 - _SAME_COST)

    @property
    def fastest(self) -> SCPResult | None:
        """The solution with the shortest final time, or None if there is no solution at all."""
        return next((result for result in self.results if result.solved), None)

    def best(self, price_of_time: float) -> tuple[float, SCPResult]:
        """Final time and result that minimise ``cost + price_of_time * final_time``.

        Args:
            price_of_time: In m/s per s: how much delta-V a second is worth.

        Raises:
            ValueError: If no final time has a solution.
        """
        totals = self.costs + price_of_time * self.final_times
        index = int(np.argmin(totals))
        if not np.isfinite(totals[index]):
            raise ValueError(f"No final time has a solution: {self.results[-1].message}")
        return float(self.final_times[index]), self.results[index]

    def plot(self, axes: Axes | None = None) -> Axes:
        """Draws cost and bound against final time with Matplotlib; returns the axes."""
        if axes is None:
            from matplotlib.figure import Figure

            axes = Figure(figsize=(6.0, 4.0), layout="constrained").subplots()
        found, best = np.isfinite(self.costs), self.efficient
        bounded = np.isfinite(self.rel_costs)
        axes.plot(
            self.final_times[bounded],
            self.rel_costs[bounded],
            ":",
            color="0.5",
            label="REL (bound)",
        )
        axes.plot(self.final_times[found], self.costs[found], "o", mfc="none", color="tab:blue")
        axes.plot(
            self.final_times[best], self.costs[best], "o-", color="tab:blue", label="Pareto front"
        )
        axes.set(xlabel="final time in s", ylabel=r"cost $\sum\|u\|_1$ in m/s")
        axes.grid(alpha=0.3)
        axes.legend(frameon=False)
        return axes


def pareto_front(
    problem: Problem,
    final_times: Sequence[float] | None = None,
    config: SCPConfig | None = None,
) -> ParetoFront:
    """Solves a problem for many final times, each warm-started by its neighbours.

    At each final time SCP starts from REL, from the solution at the next longer one, and from that
    at the next shorter one, both stretched in time; the cheapest result is kept. Then the shortest
    final time that has a solution is bracketed to one step.

    Args:
        problem: Start, goal and scene.
        final_times: In s, multiples of the step. None: sixteen from the shortest that the thrusters
            might allow to twice the problem's own.
        config: Settings of every SCP loop; default: three reroutes.

    Returns:
        The front. Final times without a solution are in it, with the reason in their result.
    """
    dt = problem.scenario.dt
    if final_times is None:
        shortest = shortest_final_time(problem) or problem.final_time
        longest = max(2.0 * problem.final_time, shortest + 16 * dt)
        steps = np.unique(np.rint(np.geomspace(shortest, longest, 16) / dt))
        final_times = [float(dt * count) for count in steps]
    sweep = _Sweep(problem, config or SCPConfig(reroutes=3))
    times = sorted({float(time) for time in final_times})
    if not times:
        raise ValueError("pareto_front needs at least one final time.")
    for ordered in (times[::-1], times):
        for before, time in zip([None, *ordered], ordered):
            sweep.solve(time, before)
    sweep.bracket_fastest()
    order = sorted(sweep.results)
    return ParetoFront(
        problem,
        np.array(order),
        tuple(sweep.results[time] for time in order),
        np.array([sweep.rel[time].cost for time in order]),
    )


class _Sweep:
    """The best result known at each final time."""

    def __init__(self, problem: Problem, config: SCPConfig) -> None:
        self.problem, self.config = problem, config
        self.results: dict[float, SCPResult] = {}
        self.rel: dict[float, SCPResult] = {}

    def solve(self, time: float, neighbour: float | None) -> None:
        """Tries REL (once) and the neighbour's solution as warm starts at this final time."""
        problem = replace(self.problem, final_time=time)
        starts: list[Trajectory | None] = []
        if time not in self.rel:
            self.rel[time] = solve_rel(problem, self.config)
            starts.append(self.rel[time].trajectory)
        if neighbour is not None and self.results[neighbour].solved:
            solution = self.results[neighbour].trajectory
            assert solution is not None
            starts.append(solution.stretched(problem))
        for start in starts:
            result = solve_scp(problem, start, self.config)
            if time not in self.results or result.cost < self.results[time].cost:
                self.results[time] = result
        if self.results[time].solved and not self.rel[time].solved:
            found = self.results[time].trajectory
            self.rel[time] = solve_rel(problem, self.config, found)

    def bracket_fastest(self) -> None:
        """Bisects between the fastest solution and the failure next to it."""
        dt = self.problem.scenario.dt
        while True:
            solved = [time for time in sorted(self.results) if self.results[time].solved]
            failed = [time for time in sorted(self.results) if solved and time < solved[0]]
            if not failed or solved[0] - failed[-1] < 1.5 * dt:
                return
            middle = dt * round(0.5 * (solved[0] + failed[-1]) / dt)
            self.solve(middle, solved[0])
