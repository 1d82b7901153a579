"""The baseline: the subproblem as it is usually written, a CVXPY problem stated stage by stage.

One constraint object per stage, obstacle and cluster, stated anew at every iteration of SCP.
"""

from __future__ import annotations

import cvxpy as cp
import numpy as np

from freeflyer_env import Problem
from freeflyer_env.planning import Trajectory


def solve_stage_by_stage(
    problem: Problem, reference: Trajectory, trust_region: float, solver: str = "CLARABEL"
) -> tuple[str, float]:
    """States and solves one subproblem; returns CVXPY's status and the cost in m/s."""
    scenario, robot, n = problem.scenario, problem.scenario.robot, problem.n_steps
    dt, limit = scenario.dt, robot.delta_v_max(scenario.dt)
    low, high = scenario.position_limits
    gain = np.diag(robot.control_gain)
    x = [cp.Variable(6) for _ in range(n + 1)]
    u = [cp.Variable(3) for _ in range(n)]
    constraints = [x[0] == problem.start, x[n] == problem.goal, x[n][:3] == x[n - 1][:3]]
    for k in range(n):
        constraints.append(x[k + 1][3:] == x[k][3:] + gain @ u[k])
        if k < n - 1:
            constraints.append(x[k + 1][:3] == x[k][:3] + dt * x[k + 1][3:])
        constraints += [x[k][:2] >= low, x[k][:2] <= high]
        psi, u_ref = reference.states[k, 2], reference.controls[k]
        cos, sin = np.cos(psi), np.sin(psi)
        rotation = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
        slope = np.array([[-sin, cos, 0.0], [-cos, -sin, 0.0], [0.0, 0.0, 0.0]])
        clusters = robot.cluster_inverse @ rotation @ u[k]
        clusters = clusters + (robot.cluster_inverse @ slope @ u_ref) * (x[k][2] - psi)
        constraints += [clusters <= limit, clusters >= -limit]
        if 1 <= k < n - 1:
            constraints.append(cp.norm_inf(x[k] - reference.states[k]) <= trust_region)
            centres = scenario.obstacles.centres_at(k * dt)
            for centre, radius in zip(centres, scenario.keep_out_radii):
                offset = reference.states[k, :2] - centre
                normal = offset / np.linalg.norm(offset)
                constraints.append(normal @ (x[k][:2] - centre) >= radius)
    cost = sum(cp.norm1(control) for control in u)
    statement = cp.Problem(cp.Minimize(cost / limit), constraints)
    statement.solve(solver=solver)
    value = statement.value
    return statement.status, float(value) * limit if value is not None else np.inf
