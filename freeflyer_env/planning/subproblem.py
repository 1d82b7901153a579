"""The convex subproblem of SCP, assembled once and re-valued at every iteration.

The states are eliminated. With ``q_k = (r_x, r_y, psi)`` at the nodes ``k = 0 .. N - 1`` (``q_0``
and ``q_{N-1}`` are the start's and the goal's) and the split controls ``u_k = s * (p_k - n_k)``,
``p, n >= 0``, the linear program about a reference ``(x_ref, u_ref)`` with trust region ``rho``
is::

    minimise    sum_k 1' diag(s) (p_k + n_k)                                    (= sum_k ||u_k||_1)
    subject to  (q_{k+1} - 2 q_k + q_{k-1}) / dt = g * s * (p_k - n_k)          dynamics
                |M(psi_ref) u_k + M'(psi_ref) u_ref (psi_k - psi_ref)| <= dV_max   actuation
                nu_km' (r_k - c_m) >= d_m,   nu = outward normal at the reference  keep-out
                table limits on r_k;  |q_k - q_ref,k| <= rho                       bounds
                |(q_k - q_{k-1}) / dt - v_ref,k| <= rho                            velocity rows

where ``g = (1, 1, m / J)``, ``M(psi) = Lambda^+ R_GB(psi)'`` gives the clusters' delta-Vs, ``c_m``
and ``d_m`` are the obstacles' centres and keep-out radii, and the velocities before the first and
after the last impulse, the start's and the goal's, take the place of the differences that leave the
horizon. In the elastic form each interior node has a slack ``s_k >= 0`` that is added to its
keep-out rows and priced in the objective, so that a bad reference cannot make the program
infeasible. This is the OCP of the paper's eq. 4 with nine variables a node.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from freeflyer_env.planning.backends import LinearProgram, SolverStatus, make_backend
from freeflyer_env.planning.trajectory import Trajectory
from freeflyer_env.robot import Robot
from freeflyer_env.scenario import Problem

#: Price of a metre of slack in multiples of the largest delta-V; above the keep-out multipliers
#: seen.
_SLACK_PRICE = 5000.0


@dataclass(frozen=True, eq=False)
class SubproblemSolution:
    """A solved (or failed) subproblem.

    Attributes:
        status: What the solver said.
        trajectory: The solution, None unless solved.
    """

    status: SolverStatus
    trajectory: Trajectory | None


class Subproblem:
    """One linear program of fixed size, solved many times with new values.

    Args:
        n_steps: Number ``N`` of controls, at least 2.
        n_obstacles: Number ``M`` of keep-out discs; 0 for REL.
        dt: Step in s.
        robot: Mass properties and thrusters.
        backend: Name of the solver (see :mod:`freeflyer_env.planning.backends`).
        elastic: Whether keep-out may be violated at a price.
        velocity_rows: Whether the trust region on velocities is imposed from the start. It hardly
            ever binds, so by default it is left out, checked afterwards, and imposed where it was
            violated.
    """

    def __init__(
        self,
        n_steps: int,
        n_obstacles: int,
        dt: float,
        robot: Robot,
        backend: str = "piqp",
        *,
        elastic: bool = False,
        velocity_rows: bool = False,
    ) -> None:
        self.n_steps, self.n_obstacles, self.dt, self.robot = n_steps, n_obstacles, dt, robot
        self.backend, self.elastic, self.velocity_rows = backend, elastic, velocity_rows
        self._with_velocity_rows: Subproblem | None = None
        delta_v_max = robot.delta_v_max(dt)
        self._scale = delta_v_max * np.array([1.0, 1.0, robot.lever_arm])
        self._index_variables()
        prices = np.zeros(self._n_variables)
        prices[self._split_columns] = self._scale / delta_v_max
        prices[self._slack_columns] = _SLACK_PRICE
        g = self._inequality_matrix()
        self._program = LinearProgram(
            c=prices,
            a=self._dynamics_matrix(),
            b=np.zeros(3 * n_steps),
            g=g,
            h_lower=np.full(g.shape[0], -np.inf),
            h_upper=np.full(g.shape[0], np.inf),
            x_lower=np.zeros(self._n_variables),
            x_upper=np.full(self._n_variables, np.inf),
        )
        self._backend = make_backend(backend)

    def solve(
        self, problem: Problem, reference: Trajectory, trust_region: float
    ) -> SubproblemSolution:
        """Linearises ``problem`` about ``reference`` and solves.

        Args:
            problem: A problem of this size; its obstacles are ignored if ``n_obstacles`` is 0.
            reference: ``x_ref`` and ``u_ref``.
            trust_region: Half-width ``rho`` of the box about the reference states, in m, rad, m/s
                and rad/s alike.
        """
        self._set_dynamics(problem)
        self._set_actuation(problem, reference)
        self._set_keep_out(problem, reference)
        self._set_bounds(problem, reference, trust_region)
        if self.velocity_rows:
            self._set_velocity_rows(problem, reference, trust_region)
        status, x = self._backend.solve(self._program)
        if status is not SolverStatus.SOLVED:
            return SubproblemSolution(status, None)
        poses = np.empty((self.n_steps, 3))
        poses[1:-1] = x[self._pose_columns]
        trajectory = Trajectory.from_poses(problem, poses, with_controls=True)
        moved = np.abs(trajectory.states[1:-1, 3:] - reference.states[1:-1, 3:]).max()
        if not self.velocity_rows and moved > trust_region:
            return self._strict().solve(problem, reference, trust_region)
        return SubproblemSolution(status, trajectory)

    def _strict(self) -> Subproblem:
        """The same subproblem with its velocity rows, made when first needed."""
        if self._with_velocity_rows is None:
            self._with_velocity_rows = Subproblem(
                self.n_steps,
                self.n_obstacles,
                self.dt,
                self.robot,
                self.backend,
                elastic=self.elastic,
                velocity_rows=True,
            )
        return self._with_velocity_rows

    # -- assembly, once --------------------------------------------------------------------------

    def _index_variables(self) -> None:
        """Columns stage by stage: pose and slack (interior nodes only), then ``p`` and ``n``."""
        n, inner = self.n_steps, self.n_steps - 2
        extra = 3 + self.elastic
        widths = np.full(n, 6 + extra)
        widths[[0, -1]] = 6
        first = np.concatenate([[0], np.cumsum(widths)])
        self._n_variables = int(first[-1])
        self._pose_columns = first[1 : n - 1, None] + np.arange(3)
        self._slack_columns = first[1 : n - 1, None][:, : int(self.elastic)] + 3
        split = first[:-1] + np.where(widths > 6, extra, 0)
        self._split_columns = split[:, None, None] + np.arange(6).reshape(2, 3)
        assert len(self._pose_columns) == inner

    def _dynamics_matrix(self) -> sparse.csc_matrix:
        n = self.n_steps
        rows = np.arange(3 * n).reshape(n, 3)
        # Divided by g * s, so that the split controls have coefficients of one.
        inverse = 1.0 / (self.dt * self.robot.control_gain * self._scale)
        entries = [
            (rows[1:-1], self._pose_columns, -2.0 * inverse),
            (rows[:-2], self._pose_columns, inverse),
            (rows[2:], self._pose_columns, inverse),
            (rows, self._split_columns[:, 0], -np.ones(3)),
            (rows, self._split_columns[:, 1], np.ones(3)),
        ]
        triplets = [
            [np.broadcast_to(part, r.shape).ravel() for part in (r, c, v)] for r, c, v in entries
        ]
        i, j, v = (np.concatenate(parts) for parts in zip(*triplets))
        return sparse.csc_matrix((v, (i, j)), shape=(3 * n, self._n_variables))

    def _inequality_matrix(self) -> sparse.csc_matrix:
        """Pattern of actuation (4 a node), keep-out (M a node) and velocity rows (3 a node)."""
        n, m, inner = self.n_steps, self.n_obstacles, self.n_steps - 2
        act = np.arange(4 * n).reshape(n, 4)
        keep = 4 * n + np.arange(m * inner).reshape(inner, m)
        n_velocities = n - 1 if self.velocity_rows else 0
        vel = 4 * n + m * inner + np.arange(3 * n_velocities).reshape(n_velocities, 3)
        self._act_rows, self._keep_rows, self._vel_rows = act, keep, vel
        split = self._split_columns.reshape(n, 6)
        blocks = {
            "act_split": np.broadcast_arrays(act[:, :, None], split[:, None, :]),
            "act_psi": np.broadcast_arrays(act[1:-1], self._pose_columns[:, 2:]),
            "keep": np.broadcast_arrays(keep[:, :, None], self._pose_columns[:, None, :2]),
            "slack": np.broadcast_arrays(
                keep[:, :, None],
                np.broadcast_to(self._slack_columns[:, None], (inner, m, int(self.elastic))),
            ),
            "vel_next": (vel[:-1], self._pose_columns[: len(vel)]),
            "vel_previous": (vel[1:], self._pose_columns[: len(vel)]),
        }
        i = np.concatenate([rows.ravel() for rows, _ in blocks.values()])
        j = np.concatenate([columns.ravel() for _, columns in blocks.values()])
        order = np.lexsort((i, j))
        position = np.empty_like(order)
        position[order] = np.arange(len(order))
        ends = np.cumsum([rows.size for rows, _ in blocks.values()])[:-1]
        self._slots = dict(zip(blocks, np.split(position, ends)))
        pointers = np.concatenate([[0], np.cumsum(np.bincount(j, minlength=self._n_variables))])
        data = np.zeros(len(i))
        data[self._slots["slack"]] = 1.0
        data[self._slots["vel_next"]] = 1.0 / self.dt
        data[self._slots["vel_previous"]] = -1.0 / self.dt
        shape = (4 * n + m * inner + 3 * n_velocities, self._n_variables)
        return sparse.csc_matrix((data, i[order], pointers), shape=shape)

    # -- values, at every iteration --------------------------------------------------------------

    def _set_dynamics(self, problem: Problem) -> None:
        dt, b = self.dt, np.zeros((self.n_steps, 3))
        b[0] = problem.start[:3] / dt + problem.start[3:]
        b[1] -= problem.start[:3] / dt
        b[-2] -= problem.goal[:3] / dt
        b[-1] = problem.goal[:3] / dt - problem.goal[3:]
        if self.n_steps == 2:
            b[0], b[1] = (
                problem.start[3:] - (problem.goal[:3] - problem.start[:3]) / dt,
                (problem.goal[:3] - problem.start[:3]) / dt - problem.goal[3:],
            )
        self._program.b[:] = (b / (self.robot.control_gain * self._scale)).ravel()

    def _set_actuation(self, problem: Problem, reference: Trajectory) -> None:
        psi, data = reference.states[:-1, 2], self._program.g.data
        cos, sin, n = np.cos(psi), np.sin(psi), self.n_steps
        rotation, slope = np.zeros((n, 3, 3)), np.zeros((n, 3, 3))
        rotation[:, 0, 0] = rotation[:, 1, 1] = cos
        rotation[:, 0, 1], rotation[:, 1, 0], rotation[:, 2, 2] = sin, -sin, 1.0
        slope[:, 0, 0] = slope[:, 1, 1] = -sin
        slope[:, 0, 1], slope[:, 1, 0] = cos, -cos
        unit = self.robot.cluster_inverse / self.robot.delta_v_max(self.dt)
        split = unit @ rotation * self._scale
        data[self._slots["act_split"]] = np.concatenate([split, -split], axis=2).ravel()
        gradient = (unit @ slope @ reference.controls[:, :, None])[:, :, 0]
        data[self._slots["act_psi"]] = gradient[1:-1].ravel()
        shift = gradient * psi[:, None]
        # At the two ends psi is given, and all of the linearisation is on the right-hand side.
        shift[0] -= gradient[0] * problem.start[2]
        shift[-1] -= gradient[-1] * problem.goal[2]
        self._program.h_lower[self._act_rows] = shift - 1.0
        self._program.h_upper[self._act_rows] = shift + 1.0

    def _set_keep_out(self, problem: Problem, reference: Trajectory) -> None:
        if not self.n_obstacles:
            return
        scenario = problem.scenario
        centres = scenario.obstacles.centres
        offset = reference.states[1:-2, None, :2] - centres
        distance = np.linalg.norm(offset, axis=-1, keepdims=True)
        across = np.array([problem.start[1] - problem.goal[1], problem.goal[0] - problem.start[0]])
        across = across / max(float(np.linalg.norm(across)), 1e-12)
        # A reference on the very centre has no outward normal: any side will do, take the left one.
        normal = np.where(distance > 1e-9, offset / np.maximum(distance, 1e-9), across)
        self._program.g.data[self._slots["keep"]] = normal.ravel()
        self._program.h_lower[self._keep_rows] = (normal * centres).sum(
            -1
        ) + scenario.keep_out_radii

    def _set_bounds(self, problem: Problem, reference: Trajectory, trust_region: float) -> None:
        poses = reference.states[1:-2, :3]
        lower, upper = poses - trust_region, poses + trust_region
        low, high = problem.scenario.position_limits
        lower[:, :2], upper[:, :2] = np.maximum(lower[:, :2], low), np.minimum(upper[:, :2], high)
        self._program.x_lower[self._pose_columns] = lower
        self._program.x_upper[self._pose_columns] = upper

    def _set_velocity_rows(
        self, problem: Problem, reference: Trajectory, trust_region: float
    ) -> None:
        centre = reference.states[1:-1, 3:].copy()
        centre[0] += problem.start[:3] / self.dt
        centre[-1] -= problem.goal[:3] / self.dt
        self._program.h_lower[self._vel_rows] = centre - trust_region
        self._program.h_upper[self._vel_rows] = centre + trust_region
