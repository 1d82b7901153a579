"""The subproblem stated in CVXPY, stage by stage as in the paper: the oracle of the tests.

It is written from the OCP alone, in states and controls, and shares nothing with
:mod:`freeflyer_env.planning.subproblem` but the problem.
"""

from __future__ import annotations

import cvxpy as cp
import numpy as np

from freeflyer_env.planning.trajectory import Trajectory
from freeflyer_env.scenario import Problem


def solve_reference_subproblem(
    problem: Problem,
    reference: Trajectory,
    trust_region: float,
    *,
    keep_out: bool = True,
    solver: str = "CLARABEL",
) -> tuple[str, float, Trajectory | None]:
    """Solves the paper's eq. 4, linearised about ``reference``, with a box trust region.

    Args:
        problem: The problem.
        reference: ``x_ref`` and ``u_ref``.
        trust_region: Half-width of the box about the reference states.
        keep_out: Whether the keep-out half-planes are imposed (False: REL).
        solver: Any CVXPY solver for linear programs.

    Returns:
        CVXPY's status, the objective (infinite unless solved), and the trajectory or None.
    """
    scenario, robot, n = problem.scenario, problem.scenario.robot, problem.n_steps
    x, u = cp.Variable((n + 1, 6)), cp.Variable((n, 3))
    gain = np.zeros((3, 6))
    gain[:, 3:] = np.diag(robot.control_gain)
    drift = np.eye(6)
    drift[3:, :3] = scenario.dt * np.eye(3)
    low, high = scenario.position_limits
    limit = robot.delta_v_max(scenario.dt)
    constraints = [x[0] == problem.start, x[n] == problem.goal]
    for i in range(n):
        after = x[i] + u[i] @ gain
        constraints.append(x[i + 1] == (after @ drift if i < n - 1 else after))
        constraints += [x[i, :2] >= low, x[i, :2] <= high]
        psi, u_ref = reference.states[i, 2], reference.controls[i]
        clusters = robot.cluster_inverse @ _body_from_world(psi)
        slope = robot.cluster_inverse @ _body_from_world_slope(psi) @ u_ref
        constraints.append(cp.abs(clusters @ u[i] + slope * (x[i, 2] - psi)) <= limit)
        if i > 0:
            constraints.append(cp.abs(x[i] - reference.states[i]) <= trust_region)
        if keep_out and 0 < i < n - 1:
            for centre, radius in zip(scenario.obstacles.centres, scenario.keep_out_radii):
                offset = reference.states[i, :2] - centre
                normal = offset / np.linalg.norm(offset)
                constraints.append(normal @ (x[i, :2] - centre) >= radius)
    statement = cp.Problem(cp.Minimize(cp.sum(cp.abs(u)) / limit), constraints)
    statement.solve(solver=solver)
    if statement.status != cp.OPTIMAL:
        return statement.status, np.inf, None
    return statement.status, statement.value * limit, Trajectory(x.value, u.value, scenario.dt)


def _body_from_world(psi: float) -> np.ndarray:
    cos, sin = np.cos(psi), np.sin(psi)
    return np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])


def _body_from_world_slope(psi: float) -> np.ndarray:
    cos, sin = np.cos(psi), np.sin(psi)
    return np.array([[-sin, cos, 0.0], [-cos, -sin, 0.0], [0.0, 0.0, 0.0]])
