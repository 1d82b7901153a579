"""The subproblem stated in CVXPY, as in the paper: the oracle of the tests.

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
    dt, limit = scenario.dt, robot.delta_v_max(scenario.dt)
    x, u = cp.Variable((n + 1, 6)), cp.Variable((n, 3))
    x_ref, u_ref = reference.states, reference.controls
    low, high = scenario.position_limits

    constraints = [x[0] == problem.start, x[n] == problem.goal]
    # Dynamics: the impulse, then the drift; the last impulse is not followed by one.
    constraints.append(x[1:, 3:] == x[:-1, 3:] + u @ np.diag(robot.control_gain))
    constraints.append(x[1:-1, :3] == x[:-2, :3] + dt * x[1:-1, 3:])
    constraints.append(x[n, :3] == x[n - 1, :3])
    for axis in range(2):
        constraints += [x[:-1, axis] >= low[axis], x[:-1, axis] <= high[axis]]
    constraints.append(cp.abs(x[1:-1] - x_ref[1:-1]) <= trust_region)
    psi_ref = x_ref[:-1, 2]
    unit = np.array([robot.cluster_inverse @ _body_from_world(psi) for psi in psi_ref])
    slope = np.array([robot.cluster_inverse @ _body_from_world_slope(psi) for psi in psi_ref])
    gradient = np.einsum("kij,kj->ki", slope, u_ref)
    for cluster in range(4):
        delta_v = cp.multiply(gradient[:, cluster], x[:-1, 2] - psi_ref)
        for axis in range(3):
            delta_v += cp.multiply(unit[:, cluster, axis], u[:, axis])
        constraints.append(cp.abs(delta_v) <= limit)
    if keep_out:
        for centre, radius in zip(scenario.obstacles.centres, scenario.keep_out_radii):
            offset = x_ref[1:-2, :2] - centre
            normal = offset / np.linalg.norm(offset, axis=1, keepdims=True)
            ahead = cp.multiply(normal[:, 0], x[1:-2, 0] - centre[0])
            across = cp.multiply(normal[:, 1], x[1:-2, 1] - centre[1])
            constraints.append(ahead + across >= radius)
    statement = cp.Problem(cp.Minimize(cp.sum(cp.abs(u)) / limit), constraints)
    statement.solve(solver=solver)
    if statement.status != cp.OPTIMAL or x.value is None or u.value is None:
        return statement.status, np.inf, None
    return statement.status, float(statement.value) * limit, Trajectory(x.value, u.value, dt)


def _body_from_world(psi: float) -> np.ndarray:
    cos, sin = np.cos(psi), np.sin(psi)
    return np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])


def _body_from_world_slope(psi: float) -> np.ndarray:
    cos, sin = np.cos(psi), np.sin(psi)
    return np.array([[-sin, cos, 0.0], [-cos, -sin, 0.0], [0.0, 0.0, 0.0]])
