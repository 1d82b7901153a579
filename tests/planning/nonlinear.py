"""The optimal control problem itself, without linearisation, stated in CasADi for IPOPT.

Written from the problem alone, in states and split controls; it shares nothing with SCP. The
nonlinear program is not convex: its solutions are local optima, as SCP's are.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from freeflyer_env.planning import Trajectory
from freeflyer_env.robot import FloatArray
from freeflyer_env.scenario import Problem


@dataclass(frozen=True, eq=False)
class NonlinearResult:
    """What IPOPT found.

    Attributes:
        solved: Whether it converged to a local optimum.
        cost: ``sum_k ||u_k||_1`` in m/s, infinite unless solved.
        states: ``(N + 1, 6)`` states of the last iterate (SI, global frame).
        controls: ``(N, 3)`` controls ``(dv_x, dv_y, h)`` of the last iterate.
        message: IPOPT's return status.
    """

    solved: bool
    cost: float
    states: FloatArray
    controls: FloatArray
    message: str


def solve_nonlinear(
    problem: Problem, warm_start: Trajectory, *, barrier: float = 1e-3
) -> NonlinearResult:
    """Solves the nonlinear problem from ``warm_start``, a trajectory with its number of steps.

    With ``u_k = s * (p_k - n_k)``, ``s = dV_max (1, 1, lever arm)``, and ``q`` and ``v`` the pose
    and its rate, the program is::

        minimise    sum_k 1' diag(s) (p_k + n_k)                              (= sum_k ||u_k||_1)
        subject to  v_{k+1} = v_k + (1, 1, m / J) * u_k                       k = 0 ... N - 1
                    q_{k+1} = q_k + dt v_{k+1} for k < N - 1;  q_N = q_{N-1}
                    x_0 = start,  x_N = goal,  p, n >= 0,  table limits on r_k
                    ||r_k - c_km||^2 >= d_m^2                                 k = 1 ... N - 2
                    |Lambda^+ R(psi_k)' u_k| <= dV_max                        k = 0 ... N - 1

    Args:
        problem: What to solve.
        warm_start: The first iterate.
        barrier: IPOPT's first barrier parameter, in units of the largest delta-V. The smaller, the
            fewer local optima near the warm start are passed by.
    """
    n, dt, robot = problem.n_steps, problem.scenario.dt, problem.scenario.robot
    limit, gain = robot.delta_v_max(dt), robot.control_gain
    scale = limit * np.array([1.0, 1.0, robot.lever_arm])

    # One column per node or control.
    states = ca.SX.sym("x", 6, n + 1)
    positive, negative = ca.SX.sym("p", 3, n), ca.SX.sym("n", 3, n)
    poses, rates = states[:3, :], states[3:, :]
    controls = ca.diag(scale) @ (positive - negative)
    cost = ca.dot(ca.repmat(ca.DM(scale / limit), 1, n), positive + negative)

    # In units of what a full impulse does to the rates, and of a drift at that rate.
    rate_defects = ca.diag(1 / (gain * scale)) @ (
        rates[:, 1:] - rates[:, :-1] - ca.diag(gain) @ controls
    )
    drifts = ca.horzcat(dt * rates[:, 1:-1], ca.DM.zeros(3))
    pose_defects = ca.diag(1 / (dt * gain * scale)) @ (poses[:, 1:] - poses[:, :-1] - drifts)

    cos, sin = ca.cos(poses[2, :-1]), ca.sin(poses[2, :-1])
    in_body = ca.vertcat(
        cos * controls[0, :] + sin * controls[1, :],
        -sin * controls[0, :] + cos * controls[1, :],
        controls[2, :],
    )
    constraints = [
        (rate_defects, 0.0, 0.0),
        (pose_defects, 0.0, 0.0),
        (ca.DM(robot.cluster_inverse / limit) @ in_body, -1.0, 1.0),
    ]
    centres, radii = _keep_out(problem)
    for index, radius in enumerate(radii):
        offsets = poses[:2, 1 : n - 1] - centres[1 : n - 1, index].T
        constraints.append((ca.sum1(offsets**2) / radius**2, 1.0, np.inf))

    solver = ca.nlpsol(
        "ocp",
        "ipopt",
        {
            "x": ca.vertcat(*(ca.vec(part) for part in (states, positive, negative))),
            "f": cost,
            "g": ca.vertcat(*(ca.vec(part) for part, _, _ in constraints)),
        },
        _options(barrier),
    )
    guess = warm_start.controls / scale
    parts = warm_start.states, np.maximum(guess, 0.0), np.maximum(-guess, 0.0)
    lower, upper = _state_limits(problem)
    solution = solver(
        x0=np.concatenate([part.ravel() for part in parts]),
        lbx=np.concatenate([lower.ravel(), np.zeros(6 * n)]),
        ubx=np.concatenate([upper.ravel(), np.full(6 * n, np.inf)]),
        lbg=np.concatenate([np.full(part.numel(), low) for part, low, _ in constraints]),
        ubg=np.concatenate([np.full(part.numel(), high) for part, _, high in constraints]),
    )
    found, split = np.split(solution["x"].full().ravel(), [6 * (n + 1)])
    p, m = split.reshape(2, n, 3)
    u = (p - m) * scale
    solved = bool(solver.stats()["success"])
    return NonlinearResult(
        solved=solved,
        cost=float(np.abs(u).sum()) if solved else np.inf,
        states=found.reshape(n + 1, 6),
        controls=u,
        message=solver.stats()["return_status"],
    )


def _options(barrier: float) -> dict[str, Any]:
    return {
        "print_time": False,
        "ipopt": {
            "print_level": 0,
            "sb": "yes",
            "max_iter": 1000,
            "tol": 1e-8,
            "constr_viol_tol": 1e-8,
            "mu_init": barrier,
            # How far the first iterate is pushed inside the bounds.
            "bound_push": 0.1 * barrier,
            "bound_frac": 0.1 * barrier,
        },
    }


def _keep_out(problem: Problem) -> tuple[FloatArray, FloatArray]:
    """Centres ``(N, M, 2)`` of the keep-out discs at the nodes, and their radii ``(M,)``, in m."""
    times = problem.scenario.dt * np.arange(problem.n_steps)
    return problem.scenario.obstacles.centres_at(times), problem.scenario.keep_out_radii


def _state_limits(problem: Problem) -> tuple[FloatArray, FloatArray]:
    """Lower and upper limits ``(N + 1, 6)`` of the states; start and goal are given."""
    lower = np.full((problem.n_steps + 1, 6), -np.inf)
    upper = np.full((problem.n_steps + 1, 6), np.inf)
    # The pose of node N - 1 is the goal's.
    lower[1:-2, :2], upper[1:-2, :2] = problem.scenario.position_limits
    lower[0] = upper[0] = problem.start
    lower[-1] = upper[-1] = problem.goal
    return lower, upper
