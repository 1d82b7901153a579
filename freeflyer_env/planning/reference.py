"""The subproblem stated in CVXPY, as in the paper: the oracle of the tests.

It is written from the OCP alone, in states and controls, and shares nothing with
:mod:`freeflyer_env.planning.subproblem` but the problem. Any solver of CVXPY's will do; as the
backend ``cvxpy:<SOLVER>`` of SCP it is some fifty times slower than the others.
"""

from __future__ import annotations

import warnings

import cvxpy as cp
import numpy as np
from numpy.typing import NDArray

from freeflyer_env.planning.program import SolverStatus, SubproblemSolution
from freeflyer_env.planning.trajectory import Trajectory
from freeflyer_env.robot import FloatArray
from freeflyer_env.scenario import Problem


def solve_reference_subproblem(
    problem: Problem,
    reference: Trajectory,
    trust_region: float,
    *,
    keep_out: bool = True,
    slack_price: float | None = None,
    between_nodes: bool = False,
    ball: bool = False,
    solver: str = "CLARABEL",
) -> tuple[str, float, Trajectory | None]:
    """Solves the paper's eq. 4, linearised about ``reference``, in a trust region.

    Args:
        problem: The problem.
        reference: ``x_ref`` and ``u_ref``.
        trust_region: Half-width of the box, or radius of the ball, about the reference states.
        keep_out: Whether the keep-out half-planes are imposed (False: REL).
        slack_price: Price of a metre of slack on keep-out at a node, in multiples of the largest
            delta-V; None: no slack.
        between_nodes: Whether the radii are widened so that segments between nodes stay outside.
        ball: Whether the trust region is a ball.
        solver: Any CVXPY solver for linear (with ``ball``: second-order cone) programs.

    Returns:
        CVXPY's status; the objective in m/s, slack's price included (infinite unless solved); the
        trajectory or None.
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
    # The pose of the last node is the goal's, wherever the reference ends: it has no say.
    centre = x_ref[1:-1].copy()
    centre[-1, :3] = problem.goal[:3]
    if ball:
        constraints.append(cp.norm(x[1:-1] - centre, axis=1) <= trust_region)
    else:
        constraints.append(cp.abs(x[1:-1] - centre) <= trust_region)
    psi_ref = x_ref[:-1, 2]
    unit = np.array([robot.cluster_inverse @ _body_from_world(psi) for psi in psi_ref])
    slope = np.array([robot.cluster_inverse @ _body_from_world_slope(psi) for psi in psi_ref])
    gradient = np.einsum("kij,kj->ki", slope, u_ref)
    for cluster in range(4):
        delta_v = cp.multiply(gradient[:, cluster], x[:-1, 2] - psi_ref)
        for axis in range(3):
            delta_v += cp.multiply(unit[:, cluster, axis], u[:, axis])
        constraints.append(cp.abs(delta_v) <= limit)
    slack = np.zeros(n) if slack_price is None else cp.Variable(n, nonneg=True)
    if keep_out:
        at, normals, offsets = _half_planes(problem, reference, between_nodes)
        if len(at):
            ahead = cp.sum(cp.multiply(normals, x[at, :2]), axis=1)
            constraints.append(ahead + slack[at] >= offsets)
    price = 0.0 if slack_price is None else slack_price
    objective = cp.sum(cp.abs(u)) / limit + price * cp.sum(slack)
    statement = cp.Problem(cp.Minimize(objective), constraints)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of inaccurate solutions: the status says so too
            statement.solve(solver=solver)
    except cp.SolverError:
        return cp.SOLVER_ERROR, np.inf, None
    if statement.status != cp.OPTIMAL or x.value is None or u.value is None:
        return statement.status, np.inf, None
    return statement.status, float(statement.value) * limit, Trajectory(x.value, u.value, dt)


class ReferenceSubproblem:
    """The statement with the interface of :class:`~freeflyer_env.planning.subproblem.Subproblem`.

    Args:
        solver: Name of a solver of CVXPY's.
        keep_out: As in :func:`solve_reference_subproblem`, like the others.
        elastic: Whether there is slack.
        between_nodes: Whether radii are widened.
        ball: Whether the trust region is a ball.
    """

    def __init__(
        self, solver: str, *, keep_out: bool, elastic: bool, between_nodes: bool, ball: bool
    ) -> None:
        self.solver, self.keep_out, self.elastic = solver, keep_out, elastic
        self.between_nodes, self.ball = between_nodes, ball

    def solve(
        self,
        problem: Problem,
        reference: Trajectory,
        trust_region: float,
        slack_price: float = 5000.0,
    ) -> SubproblemSolution:
        """Solves the subproblem about ``reference``; arguments as in ``Subproblem.solve``."""
        status, objective, trajectory = solve_reference_subproblem(
            problem,
            reference,
            trust_region,
            keep_out=self.keep_out,
            slack_price=slack_price if self.elastic else None,
            between_nodes=self.between_nodes,
            ball=self.ball,
            solver=self.solver,
        )
        if trajectory is None:
            infeasible = status in (cp.INFEASIBLE, cp.INFEASIBLE_INACCURATE)
            failed = SolverStatus.INFEASIBLE if infeasible else SolverStatus.FAILED
            return SubproblemSolution(failed, None)
        # The solver's own states obey the dynamics to its tolerance only; the poses' do exactly.
        exact = Trajectory.from_poses(problem, trajectory.states[:-1, :3], with_controls=True)
        paid = objective - trajectory.cost
        limit = problem.scenario.robot.delta_v_max(problem.scenario.dt)
        slack = max(paid, 0.0) / (slack_price * limit) if self.elastic else 0.0
        return SubproblemSolution(SolverStatus.SOLVED, exact, slack)

    def kkt_residuals(self) -> None:
        """CVXPY's own statement has none to offer."""
        return None


def _half_planes(
    problem: Problem, reference: Trajectory, between_nodes: bool
) -> tuple[NDArray[np.int64], FloatArray, FloatArray]:
    """Nodes ``(P,)``, normals ``(P, 2)`` and offsets ``(P,)`` of planes ``normal' r >= offset``."""
    n, dt, scenario = problem.n_steps, problem.scenario.dt, problem.scenario
    planes: list[tuple[int, FloatArray, float]] = []
    for index, keep_out in enumerate(scenario.keep_out_radii):
        centres = [scenario.obstacles.centres_at(dt * node)[index] for node in range(n)]
        offsets = [reference.states[node, :2] - centres[node] for node in range(n)]
        gaps = [float(np.linalg.norm(offset)) for offset in offsets]
        for node in range(1, n - 1):
            radius = keep_out
            for other in (node - 1, node + 1) if between_nodes else ():
                step = np.linalg.norm(offsets[other] - offsets[node])
                radius = max(radius, np.hypot(keep_out, step / 2))
                if other in (0, n - 1) and gaps[other] < np.hypot(keep_out, step / 2):
                    radius = max(radius, np.hypot(max(gaps[other], keep_out), step))
            normal = offsets[node] / gaps[node]
            planes.append((node, normal, float(normal @ centres[node] + radius)))
    nodes, normals, levels = zip(*planes) if planes else ((), np.empty((0, 2)), ())
    return np.array(nodes, dtype=int), np.array(normals), np.array(levels)


def _body_from_world(psi: float) -> np.ndarray:
    cos, sin = np.cos(psi), np.sin(psi)
    return np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])


def _body_from_world_slope(psi: float) -> np.ndarray:
    cos, sin = np.cos(psi), np.sin(psi)
    return np.array([[-sin, cos, 0.0], [-cos, -sin, 0.0], [0.0, 0.0, 0.0]])
