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
horizon. This is the OCP of the paper's eq. 4 with nine variables a node. Variants:

* *elastic*: each interior node has a slack ``s_k >= 0`` that is added to its keep-out rows and
  priced in the objective, so that a bad reference cannot make the program infeasible;
* *between nodes*: ``d_m`` grows at each node to ``hypot(d_m, L / 2)``, ``L`` the reference's longer
  step at that node in the obstacle's frame: the straight way between nodes stays outside then;
* *ball*: the trust region is ``||x_k - x_ref,k||_2 <= rho`` at each node, a second-order cone.

The planning guide (``docs/planning.md``) derives all of it.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse

from freeflyer_env.planning.backends import make_backend
from freeflyer_env.planning.program import (
    Balls,
    ConvexProgram,
    KKTResiduals,
    Solution,
    SolverStatus,
    SubproblemSolution,
    kkt_residuals,
)
from freeflyer_env.planning.trajectory import Trajectory
from freeflyer_env.robot import FloatArray, Robot
from freeflyer_env.scenario import Problem


class Subproblem:
    """One convex program of fixed size and form, solved many times with new values.

    Args:
        n_steps: Number ``N`` of controls, at least 2.
        n_obstacles: Number ``M`` of keep-out discs; 0 for REL.
        dt: Step in s.
        robot: Mass properties and thrusters.
        backend: Name of the solver (see :mod:`freeflyer_env.planning.backends`).
        elastic: Whether keep-out may be violated at a price.
        between_nodes: Whether the way between the nodes is kept out of the discs, too.
        ball: Whether the trust region is a ball, which needs a backend with cones, or a box.
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
        between_nodes: bool = False,
        ball: bool = False,
        velocity_rows: bool = False,
    ) -> None:
        self.n_steps, self.n_obstacles, self.dt, self.robot = n_steps, n_obstacles, dt, robot
        self.backend, self.elastic, self.between_nodes = backend, elastic, between_nodes
        self.ball, self.velocity_rows = ball, velocity_rows
        self._with_velocity_rows: Subproblem | None = None
        self._problem: Problem | None = None  # of which the dynamics are set
        delta_v_max = robot.delta_v_max(dt)
        self._scale = delta_v_max * np.array([1.0, 1.0, robot.lever_arm])
        self._unit = robot.cluster_inverse / delta_v_max
        self._index_variables()
        prices = np.zeros(self._n_variables)
        prices[self._split_columns] = self._scale / delta_v_max
        g = self._inequality_matrix()
        self._program = ConvexProgram(
            c=prices,
            a=self._dynamics_matrix(),
            b=np.zeros(3 * n_steps),
            g=g,
            h_lower=np.full(g.shape[0], -np.inf),
            h_upper=np.full(g.shape[0], np.inf),
            x_lower=np.zeros(self._n_variables),
            x_upper=np.full(self._n_variables, np.inf),
            balls=self._balls() if ball else None,
        )
        self._solution = Solution.unsolved(SolverStatus.FAILED)
        self._backend = make_backend(backend)

    def solve(
        self,
        problem: Problem,
        reference: Trajectory,
        trust_region: float,
        slack_price: float = 5000.0,
    ) -> SubproblemSolution:
        """Linearises ``problem`` about ``reference`` and solves.

        Args:
            problem: A problem of this size; its obstacles are ignored if ``n_obstacles`` is 0.
            reference: ``x_ref`` and ``u_ref``.
            trust_region: Half-width ``rho`` of the box (radius of the ball) about the reference
                states, in m, rad, m/s and rad/s alike.
            slack_price: Price of a metre of slack at one node, in multiples of the largest delta-V;
                for the elastic form.
        """
        if problem is not self._problem:
            self._set_dynamics(problem)
            self._problem = problem
        self._set_actuation(problem, reference)
        self._set_keep_out(problem, reference)
        self._set_bounds(problem, reference, trust_region)
        if self.velocity_rows:
            self._set_velocity_rows(problem, reference, trust_region)
        if self.elastic:
            self._program.c[self._slack_columns] = slack_price
        self._solution = solution = self._backend.solve(self._program)
        if solution.status is not SolverStatus.SOLVED:
            return SubproblemSolution(solution.status, None)
        poses = np.empty((self.n_steps, 3))
        poses[1:-1] = solution.x[self._pose_columns]
        trajectory = Trajectory.from_poses(problem, poses, with_controls=True)
        moved = np.abs(trajectory.states[1:-1, 3:] - reference.states[1:-1, 3:]).max()
        if not (self.velocity_rows or self.ball) and moved > trust_region:
            strict = self._strict()
            found = strict.solve(problem, reference, trust_region, slack_price)
            self._solution = strict._solution
            return found
        slack = float(solution.x[self._slack_columns].sum())
        return SubproblemSolution(solution.status, trajectory, slack)

    def kkt_residuals(self) -> KKTResiduals:
        """How exactly the program solved last satisfies its optimality conditions.

        Units: largest delta-V for objective, dynamics and actuation rows; SI units elsewhere.
        """
        program = self._program
        if self._with_velocity_rows and self._solution is self._with_velocity_rows._solution:
            program = self._with_velocity_rows._program
        return kkt_residuals(program, self._solution)

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
                between_nodes=self.between_nodes,
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

    def _balls(self) -> Balls:
        """For nodes 1 ... N - 1 the pose (no entry for the last one, which is given) and rate."""
        n = self.n_steps
        rows = np.arange(6 * (n - 1)).reshape(n - 1, 6)
        i = np.concatenate([rows[:-1, :3].ravel(), rows[:-1, 3:].ravel(), rows[1:, 3:].ravel()])
        j = np.tile(self._pose_columns.ravel(), 3)
        v = np.repeat([1.0, 1.0 / self.dt, -1.0 / self.dt], self._pose_columns.size)
        k = sparse.csc_matrix((v, (i, j)), shape=(6 * (n - 1), self._n_variables))
        return Balls(k, np.zeros((n - 1, 6)))

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
        cos, sin = np.cos(psi)[:, None], np.sin(psi)[:, None]
        x, y, turn = self._unit.T
        split = np.empty((self.n_steps, 4, 6))  # M(psi), and its negative
        split[:, :, 0] = (cos * x - sin * y) * self._scale[0]
        split[:, :, 1] = (sin * x + cos * y) * self._scale[1]
        split[:, :, 2] = turn * self._scale[2]
        np.negative(split[:, :, :3], out=split[:, :, 3:])
        data[self._slots["act_split"]] = split.ravel()
        slope = np.zeros((self.n_steps, 4, 3))  # M'(psi)
        slope[:, :, 0], slope[:, :, 1] = -sin * x - cos * y, cos * x - sin * y
        gradient = (slope @ reference.controls[:, :, None])[:, :, 0]
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
        centres = scenario.obstacles.centres_at(problem.node_times[:-1])
        relative = reference.states[:-1, None, :2] - centres
        x, y = relative[1:-1, :, :1], relative[1:-1, :, 1:]
        distance = np.sqrt(x * x + y * y)
        normal = relative[1:-1] / np.maximum(distance, 1e-9)
        if distance.min(initial=1.0) <= 1e-9:
            # A reference on the very centre has no outward normal: any side will do, take the left.
            way = problem.goal[:2] - problem.start[:2]
            left = np.array([-way[1], way[0]]) / max(float(np.linalg.norm(way)), 1e-12)
            normal = np.where(distance > 1e-9, normal, left)
        radii = scenario.keep_out_radii
        if self.between_nodes:
            radii = _widened(radii, relative)
        self._program.g.data[self._slots["keep"]] = normal.ravel()
        level = normal[..., 0] * centres[1:-1, :, 0] + normal[..., 1] * centres[1:-1, :, 1]
        self._program.h_lower[self._keep_rows] = level + radii

    def _set_bounds(self, problem: Problem, reference: Trajectory, trust_region: float) -> None:
        poses = reference.states[1:-2, :3]
        lower, upper = poses - trust_region, poses + trust_region
        if self._program.balls is not None:
            lower, upper = np.full_like(poses, -np.inf), np.full_like(poses, np.inf)
            self._set_balls(problem, reference, trust_region)
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

    def _set_balls(self, problem: Problem, reference: Trajectory, trust_region: float) -> None:
        balls = self._program.balls
        assert balls is not None
        balls.radius = trust_region
        balls.centres[:-1, :3] = reference.states[1:-2, :3]
        balls.centres[:, 3:] = reference.states[1:-1, 3:]
        balls.centres[0, 3:] += problem.start[:3] / self.dt
        balls.centres[-1, 3:] -= problem.goal[:3] / self.dt


def _widened(radii: FloatArray, relative: FloatArray) -> FloatArray:
    """Radii ``(N - 2, M)`` at the interior nodes that keep the segments between nodes out of discs.

    A segment of length ``L`` whose ends are ``hypot(d, L / 2)`` from the centre is ``d`` from it.
    Where the start or the goal, which are given, are nearer, its neighbour has to be so far away
    that the given end is the segment's nearest point.

    Args:
        radii: ``(M,)`` keep-out radii in m.
        relative: ``(N, M, 2)`` nodes of the reference in the obstacles' frames.
    """
    steps = np.linalg.norm(np.diff(relative, axis=0), axis=-1)
    wide = np.hypot(radii, 0.5 * np.maximum(steps[:-1], steps[1:]))
    for end in (0, -1) if len(wide) else ():
        gap = np.linalg.norm(relative[end], axis=-1)
        near = gap < np.hypot(radii, 0.5 * steps[end])
        away = np.hypot(np.maximum(gap, radii), steps[end])
        wide[end] = np.where(near, np.maximum(wide[end], away), wide[end])
    return wide
