"""Model-predictive control about a plan: one small quadratic program a control period."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from freeflyer_env.control.lqr import STATE_SCALE, WRENCH_SCALE, LQRTracker
from freeflyer_env.control.observer import DisturbanceObserver, require_positive
from freeflyer_env.control.reference import references_at
from freeflyer_env.control.riccati import double_integrator
from freeflyer_env.robot import FloatArray

if TYPE_CHECKING:
    from freeflyer_env.planning.trajectory import Trajectory
    from freeflyer_env.scenario import Scenario

_PLANES = 3  # half-planes in each period: the nearest discs and walls
_SLACK_SCALE = 0.001  # m
_NO_LIMIT = 1e30  # OSQP's infinity


class TrackingMPC(LQRTracker):
    """MPC about a plan: the LQR's cost, the thrusters' limits, keep-out discs and the table.

    Over a horizon of control periods the program chooses the thrusts of the four clusters, each
    within ``[-T, T]``, that minimise the cost of :class:`LQRTracker`, whose cost-to-go ends the
    horizon: while no limit is met, both trackers are the same. The heading is frozen along the
    way on which the LQR would bring it back to the reference. Keep-out discs and walls are
    half-planes tangent where the reference is nearest, the nearest three in each period, softened
    by a slack so that there always is a solution. OSQP solves the program; it is set up once, then
    only numbers change, and each solve starts from the solution of the period before.

    Args:
        scenario: Robot, obstacles (moving ones too: time zero is the plan's start) and table.
        horizon: In s.
        state_scale: As for :class:`LQRTracker`.
        wrench_scale: As for :class:`LQRTracker`.
        slack_price: Cost of one metre inside a keep-out disc or off the table, per period.
        margin: Distance in m by which keep-out discs grow and the table shrinks.
        max_iterations: Of OSQP; without a solution by then the LQR commands the period.
        observer: As for :class:`LQRTracker`.

    Attributes:
        failures: In how many periods of the flight OSQP found no solution.
        iterations: OSQP's iterations in the last period.

    Raises:
        ValueError: If an argument is out of range.
        ModuleNotFoundError: Without OSQP or SciPy.
    """

    def __init__(
        self,
        scenario: Scenario,
        horizon: float = 2.0,
        state_scale: tuple[float, float, float, float] = STATE_SCALE,
        wrench_scale: tuple[float, float] = WRENCH_SCALE,
        slack_price: float = 1e4,
        margin: float = 0.0,
        max_iterations: int = 500,
        observer: DisturbanceObserver | None = None,
    ) -> None:
        try:
            import osqp
            from scipy import sparse
        except ImportError as error:
            raise ModuleNotFoundError(
                'TrackingMPC needs OSQP and SciPy: pip install "freeflyer-gym[planning]".'
            ) from error
        require_positive("TrackingMPC.horizon", [horizon], 1)
        require_positive("TrackingMPC.slack_price", [slack_price], 1)
        if not 0.0 <= margin < np.inf:
            raise ValueError(f"TrackingMPC.margin must be a finite number >= 0, got {margin!r}.")
        if max_iterations < 1:
            raise ValueError(
                f"TrackingMPC.max_iterations must be at least 1, got {max_iterations}."
            )
        self._osqp, self._sparse = osqp, sparse
        self.scenario, self.horizon, self.slack_price = scenario, horizon, slack_price
        self.margin, self.max_iterations = margin, max_iterations
        super().__init__(scenario.robot, state_scale, wrench_scale, observer)

    def reset(self) -> None:
        """Forgets the flight."""
        super().reset()
        self.failures, self.iterations = 0, 0
        # OSQP learns its step size as it goes: a flight must not depend on the ones before.
        self._programs: dict[float, _Program] = {}

    def _feedback(
        self, state: FloatArray, trajectory: Trajectory, time: float, dt: float
    ) -> FloatArray:
        if dt not in self._programs:
            self._programs[dt] = _Program(self, dt)
        clusters, self.iterations = self._programs[dt].solve(state, trajectory, time)
        if clusters is None:
            self.failures += 1
            return super()._feedback(state, trajectory, time, dt)
        return self.robot.allocate(self.robot.thrust * self.robot.cluster_matrix @ clusters)


class _Program:
    """The quadratic program of one length of the control period.

    Variables, period by period: errors ``e_1 .. e_N`` (6 each, in units of the state's scale),
    cluster thrusts ``c_0 .. c_N-1`` (4 each, in units of the thrust), slacks ``s_1 .. s_N``. Rows:
    dynamics, cluster limits, slacks, half-planes.
    """

    def __init__(self, tracker: TrackingMPC, dt: float) -> None:
        self.tracker, self.dt = tracker, dt
        robot, scale = tracker.robot, tracker.state_scale
        self.n = n = max(round(tracker.horizon / dt), 2)
        self.a, self.b = double_integrator(robot, dt)
        # From clusters (in units of the thrust) to the body wrench, and to the cost on it.
        self.wrench = robot.thrust * robot.cluster_matrix
        self.weighted = self.wrench.T / tracker.wrench_scale**2
        gain, self.final = tracker.design(dt)
        # Heading errors that the LQR would leave in the middle of each period.
        closed, power = self.a - self.b @ gain, np.eye(6)
        middle = np.zeros(6)
        middle[[2, 5]] = 1.0, 0.5 * dt
        rows = []
        for _ in range(n):
            rows.append(middle @ power)
            power = closed @ power
        self.heading = np.array(rows)
        self.n_planes = min(_PLANES, 4 + len(tracker.scenario.obstacles))
        low, high = tracker.scenario.position_limits
        self.walls = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
        self.wall_offsets = np.concatenate([low, -high]) + tracker.margin
        self.scaled_a = self.a * scale / scale[:, None]
        self.scaled_b = self.b / scale[:, None]
        self._set_up()

    def _set_up(self) -> None:
        tracker, n, sparse = self.tracker, self.n, self.tracker._sparse
        scale, n_planes = tracker.state_scale, self.n_planes
        e, c, s = 6 * np.arange(n), 6 * n + 4 * np.arange(n), 10 * n + np.arange(n)
        size = 11 * n
        # Cost: the null direction of the clusters is held at zero.
        null = np.array([1.0, 1.0, -1.0, -1.0])
        on_c = self.weighted @ self.wrench + 1e-2 * np.outer(null, null)
        on_e = np.eye(6)
        on_end = self.final * scale * scale[:, None]
        slack = tracker.slack_price * _SLACK_SCALE
        blocks = [on_e] * (n - 1) + [on_end] + [on_c] * n + [np.eye(n) * 0.1 * slack]
        cost = sparse.triu(sparse.block_diag(blocks), format="csc")
        self.q = np.zeros(size)
        self.q[s] = slack
        # Constraints, as triplets; where in their values those are that change is remembered.
        triplets: list[FloatArray] = []

        def put(row: Any, column: Any, value: Any) -> slice:
            triplet = np.broadcast_arrays(row, column, value)
            first = sum(item.shape[1] for item in triplets)
            triplets.append(np.array([part.ravel() for part in triplet], dtype=np.float64))
            return slice(first, first + triplet[0].size)

        all_e, six, four = np.arange(6 * n), np.arange(6), np.arange(4)
        put(all_e, all_e, 1.0)
        put(e[1:, None, None] + six[:, None], e[:-1, None, None] + six, -self.scaled_a)
        rows, columns = e[:, None, None] + six[:, None], c[:, None, None] + four
        self._at_clusters = put(rows, columns, 1.0)
        bounded = 6 * n + np.arange(5 * n)
        put(bounded, bounded, 1.0)
        planes = 11 * n + n_planes * np.arange(n)[:, None] + np.arange(n_planes)
        self._at_planes = put(planes[..., None], e[:, None, None] + np.arange(2), 1.0)
        put(planes, s[:, None], _SLACK_SCALE)
        rows, columns, self.values = np.hstack(triplets)
        n_rows = (11 + n_planes) * n
        count = np.arange(1.0, len(rows) + 1.0)
        matrix = sparse.csc_matrix((count, (rows.astype(int), columns.astype(int))), (n_rows, size))
        self._order = matrix.data.astype(int) - 1
        matrix.data = self.values[self._order]
        self.lower, self.upper = np.zeros(n_rows), np.full(n_rows, _NO_LIMIT)
        self.lower[6 * n : 10 * n], self.upper[6 * n : 10 * n] = -1.0, 1.0
        self.upper[: 6 * n] = 0.0
        self._solver = tracker._osqp.OSQP()
        self._solver.setup(
            cost,
            self.q,
            matrix,
            self.lower,
            self.upper,
            verbose=False,
            warm_starting=True,
            polishing=False,
            max_iter=tracker.max_iterations,
            eps_abs=1e-3,
            eps_rel=1e-3,
            check_termination=5,
            adaptive_rho_interval=50,  # the default may depend on run times
        )

    def solve(
        self, state: FloatArray, trajectory: Trajectory, time: float
    ) -> tuple[FloatArray | None, int]:
        """Cluster thrusts ``(4,)`` of the first period in units of the thrust, and iterations."""
        tracker, n, scale = self.tracker, self.n, self.tracker.state_scale
        times = time + self.dt * np.arange(n + 1.0)
        targets, accelerations = references_at(trajectory, times)
        error = state - targets[0]
        # The reference follows x+ = A x + B w with w of its acceleration, but for its jumps.
        drift = targets[:-1] @ self.a.T - targets[1:] + tracker.observer.disturbance @ self.b.T
        drift[0] += self.a @ error
        headings = targets[:-1, 2] + 0.5 * self.dt * targets[:-1, 5] + self.heading @ error
        cos, sin = np.cos(headings), np.sin(headings)
        turn = np.zeros((n, 3, 3))
        turn[:, 0, 0] = turn[:, 1, 1] = cos
        turn[:, 0, 1], turn[:, 1, 0] = -sin, sin
        turn[:, 2, 2] = 1.0
        self.values[self._at_clusters] = -(self.scaled_b @ turn @ self.wrench).ravel()
        self.lower[: 6 * n] = self.upper[: 6 * n] = (drift / scale).ravel()
        wanted = accelerations[:-1] * tracker._mass - tracker.observer.disturbance
        body = np.einsum("kij,ki->kj", turn, wanted)
        self.q[6 * n : 10 * n] = -(body @ self.weighted.T).ravel()
        normals, gaps = self._half_planes(targets[1:, :2], times[1:])
        self.values[self._at_planes] = (normals * scale[0]).ravel()
        self.lower[11 * n :] = -gaps.ravel()
        self._solver.update(q=self.q, l=self.lower, u=self.upper, Ax=self.values[self._order])
        found = self._solver.solve(raise_error=False)
        if found.info.status_val not in (1, 2):  # solved, solved inaccurately
            self._solver.warm_start(x=np.zeros(len(self.q)), y=np.zeros(len(self.lower)))
            return None, int(found.info.iter)
        return found.x[6 * n : 6 * n + 4], int(found.info.iter)

    def _half_planes(
        self, positions: FloatArray, times: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Normals ``(N, P, 2)`` and the clearance ``(N, P)`` in m that the reference has."""
        scenario, margin = self.tracker.scenario, self.tracker.margin
        from_centres = positions[:, None] - scenario.obstacles.centres_at(times)
        distances = np.maximum(np.linalg.norm(from_centres, axis=-1), 1e-9)
        gaps = np.hstack(
            [
                distances - scenario.keep_out_radii - margin,
                positions @ self.walls.T - self.wall_offsets,
            ]
        )
        walls = np.broadcast_to(self.walls, (len(positions), 4, 2))
        normals = np.concatenate([from_centres / distances[..., None], walls], axis=1)
        nearest = np.argpartition(gaps, self.n_planes - 1, axis=1)[:, : self.n_planes]
        normals = np.take_along_axis(normals, nearest[..., None], axis=1)
        return normals, np.take_along_axis(gaps, nearest, axis=1)
