"""The constraints of the optimal control problem, checked on a trajectory.

This is the one check that the planner, the datasets and the evaluation share. It
works from the states and controls alone and shares no code with the solver.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from freeflyer_env.dynamics import dynamics_residual
from freeflyer_env.robot import FloatArray
from freeflyer_env.scenario import Problem, Scenario

#: Largest violation, in the constraint's own unit, of a trajectory that counts as feasible.
FEASIBILITY_TOLERANCE = 1e-6


@dataclass(frozen=True)
class ConstraintReport:
    """Largest violation of each family of constraints (paper, eq. 4b to 4g); zero where it holds.

    Attributes:
        dynamics: Defect of the impulsive model, in m, rad, m/s or rad/s.
        start: Distance of the first state from the start, largest component.
        goal: Distance of the last state from the goal, largest component.
        table: Depth of the centre beyond the table's limits in m.
        keep_out: Depth of the centre inside a keep-out disc in m, at the nodes.
        actuation: Excess of a cluster's delta-V over its limit in m/s.
    """

    dynamics: float
    start: float
    goal: float
    table: float
    keep_out: float
    actuation: float

    @property
    def worst(self) -> tuple[str, float]:
        """The family that is violated most, and by how much."""
        pairs = [(item.name, float(getattr(self, item.name))) for item in fields(self)]
        return max(pairs, key=lambda pair: pair[1] if np.isfinite(pair[1]) else np.inf)

    def satisfied(self, tolerance: float = FEASIBILITY_TOLERANCE) -> bool:
        """Whether every family holds to ``tolerance`` (False where a value is not finite)."""
        return bool(self.worst[1] <= tolerance)


def keep_out_depth(
    scenario: Scenario, positions: FloatArray, times: FloatArray | float = 0.0
) -> FloatArray:
    """How deep positions ``(..., 2)`` are inside the nearest keep-out disc, ``(...)`` in m.

    Negative outside: minus the clearance. Without obstacles minus infinity.

    Args:
        scenario: Gives the obstacles.
        positions: Of the robot's centre in m.
        times: When, in s, to broadcast with ``(...)``; matters only if obstacles move.
    """
    positions = np.asarray(positions, dtype=np.float64)
    if not len(scenario.obstacles):
        return np.full(positions.shape[:-1], -np.inf)
    away = positions[..., None, :] - scenario.obstacles.centres_at(times)
    gaps = np.sqrt(away[..., 0] ** 2 + away[..., 1] ** 2)
    return np.max(scenario.keep_out_radii - gaps, axis=-1)


def nodes_inside(
    problem: Problem, states: FloatArray, tolerance: float = FEASIBILITY_TOLERANCE
) -> int:
    """How many of the ``N`` nodes of states ``(N + 1, 6)`` are inside a keep-out disc.

    Of the relaxed trajectory it is the paper's ``C_REL(t_1)``.

    Args:
        problem: Gives the obstacles and the times of the nodes.
        states: ``(N + 1, 6)``.
        tolerance: Depth in m from which a node counts.
    """
    depth = keep_out_depth(problem.scenario, states[:-1, :2], problem.node_times[:-1])
    return int((depth > tolerance).sum())


def between_nodes_depth(problem: Problem, states: FloatArray) -> FloatArray:
    """How deep each segment between nodes is inside a keep-out disc, ``(N - 1,)`` in m; exact.

    Between two nodes robot and obstacles move uniformly, so in an obstacle's frame the robot is on
    a straight segment, and the nearest point of that is known in closed form. Negative outside.

    Args:
        problem: Gives the obstacles and the times of the nodes.
        states: ``(N + 1, 6)``.
    """
    scenario, times = problem.scenario, problem.node_times[:-1]
    if not len(scenario.obstacles):
        return np.full(len(times) - 1, -np.inf)
    relative = np.asarray(states)[:-1, None, :2] - scenario.obstacles.centres_at(times)
    first, along = relative[:-1], np.diff(relative, axis=0)
    length = np.maximum((along**2).sum(-1), 1e-300)
    share = np.clip(-(first * along).sum(-1) / length, 0.0, 1.0)
    gaps = np.linalg.norm(first + share[..., None] * along, axis=-1)
    return np.max(scenario.keep_out_radii - gaps, axis=-1)


def actuation_excess(scenario: Scenario, psi: FloatArray, controls: FloatArray) -> FloatArray:
    """Excess of the largest cluster delta-V over its limit, ``(...)`` in m/s; negative within."""
    clusters = scenario.robot.cluster_delta_v(psi, controls)
    return np.abs(clusters).max(axis=-1) - scenario.robot.delta_v_max(scenario.dt)


def check(problem: Problem, states: FloatArray, controls: FloatArray) -> ConstraintReport:
    """Checks states ``(N + 1, 6)`` and controls ``(N, 3)`` against every constraint.

    Raises:
        ValueError: If the trajectory has another number of steps than the problem.
    """
    scenario = problem.scenario
    if len(controls) != problem.n_steps or len(states) != problem.n_steps + 1:
        raise ValueError(
            f"The problem has {problem.n_steps} steps, the trajectory {len(controls)} controls and "
            f"{len(states)} states."
        )
    residual = dynamics_residual(states, controls, scenario.dt, scenario.robot)
    return ConstraintReport(
        dynamics=float(np.abs(residual).max()),
        start=float(np.abs(states[0] - problem.start).max()),
        goal=float(np.abs(states[-1] - problem.goal).max()),
        table=float(np.maximum(_off_table(scenario, states), 0.0).max()),
        keep_out=float(
            np.maximum(keep_out_depth(scenario, states[:, :2], problem.node_times), 0.0).max()
        ),
        actuation=float(
            np.maximum(actuation_excess(scenario, states[:-1, 2], controls), 0.0).max()
        ),
    )


def violations(
    scenario: Scenario,
    states: FloatArray,
    controls: FloatArray,
    tolerance: float = FEASIBILITY_TOLERANCE,
) -> FloatArray:
    """The indicator ``C(t_i)`` of the paper's eq. 6 at the ``N`` nodes, ``(N,)`` of 0 or 1.

    A node violates if its state is off the table or inside a keep-out disc, or its control exceeds
    the actuation limit, by more than ``tolerance``, or is not a number.
    """
    nodes = np.asarray(states)[:-1]
    times = scenario.dt * np.arange(len(nodes), dtype=np.float64)
    excess = np.maximum(_off_table(scenario, nodes), keep_out_depth(scenario, nodes[:, :2], times))
    excess = np.maximum(excess, actuation_excess(scenario, nodes[:, 2], controls))
    return (~(excess <= tolerance)).astype(np.float64)


def _off_table(scenario: Scenario, states: FloatArray) -> FloatArray:
    low, high = scenario.position_limits
    positions = np.asarray(states)[..., :2]
    return np.maximum(low - positions, positions - high).max(axis=-1)
