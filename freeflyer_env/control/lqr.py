"""Linear-quadratic control about a plan."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from freeflyer_env.control.observer import DisturbanceObserver, require_positive
from freeflyer_env.control.reference import reference_at
from freeflyer_env.control.riccati import double_integrator, solve_riccati
from freeflyer_env.robot import FloatArray, Robot, body_from_world

if TYPE_CHECKING:
    from freeflyer_env.planning.trajectory import Trajectory

#: Errors of position (m), heading (rad), velocity (m/s) and rate (rad/s) that weigh as much as ...
STATE_SCALE = (0.01, 0.03, 0.03, 0.1)
#: ... a force (N) and a torque (N m) beyond the feedforward.
WRENCH_SCALE = (0.1, 0.02)


class LQRTracker:
    """Discrete-time LQR about a plan: double integrators with the robot's mass and inertia.

    The plan's acceleration is fed forward. An observer filters the measurements and estimates the
    disturbance, which is cancelled; this takes the place of an integral of the error.

    Args:
        robot: Nominal mass properties and thrusters.
        state_scale: Errors of position (m), heading (rad), velocity (m/s) and rate (rad/s) that
            cost 1 each in every control period.
        wrench_scale: Force (N) and torque (N m) beyond the feedforward that cost 1 each.
        observer: Default: a :class:`DisturbanceObserver` without delay. With a delay, commands are
            meant for the state and the reference of the time at which they will act.

    Raises:
        ValueError: If an argument is out of range.
    """

    def __init__(
        self,
        robot: Robot,
        state_scale: tuple[float, float, float, float] = STATE_SCALE,
        wrench_scale: tuple[float, float] = WRENCH_SCALE,
        observer: DisturbanceObserver | None = None,
    ) -> None:
        require_positive("LQRTracker.state_scale", state_scale, 4)
        require_positive("LQRTracker.wrench_scale", wrench_scale, 2)
        position, heading, velocity, rate = state_scale
        self.state_scale = np.array([position, position, heading, velocity, velocity, rate])
        self.wrench_scale = np.array([wrench_scale[0], wrench_scale[0], wrench_scale[1]])
        self.robot, self.observer = robot, observer or DisturbanceObserver(robot)
        self._mass = np.array([robot.mass, robot.mass, robot.inertia])
        self._designs: dict[float, tuple[FloatArray, FloatArray]] = {}
        self.reset()

    def reset(self) -> None:
        """Forgets the flight."""
        self.observer.reset()

    def reference(self, trajectory: Trajectory, time: float) -> FloatArray:
        """State ``(6,)`` that the tracker wants to be in at ``time`` in s."""
        return reference_at(trajectory, time)[0]

    def duties(
        self, state: FloatArray, trajectory: Trajectory, time: float, dt: float
    ) -> FloatArray:
        """Thruster duties ``(8,)``; see :meth:`Tracker.duties`."""
        expected = self.observer.update(state, dt)
        acts_at = time + self.observer.delay * dt
        return self._command(self._feedback(expected, trajectory, acts_at, dt))

    def design(self, dt: float) -> tuple[FloatArray, FloatArray]:
        """Gain and cost-to-go of the LQR for control periods of ``dt`` seconds, made once.

        Returns:
            ``K`` ``(3, 6)`` with the wrench ``-K e``, where ``e`` is the state less the reference
            (SI units, global frame), and ``P`` ``(6, 6)`` with the cost-to-go ``e' P e``.
        """
        if dt not in self._designs:
            a, b = double_integrator(self.robot, dt)
            q, r = np.diag(self.state_scale**-2.0), np.diag(self.wrench_scale**-2.0)
            p = solve_riccati(a, b, q, r)
            gain = np.asarray(np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a), dtype=np.float64)
            self._designs[dt] = gain, p
        return self._designs[dt]

    def _feedback(
        self, state: FloatArray, trajectory: Trajectory, time: float, dt: float
    ) -> FloatArray:
        """Duties ``(8,)`` for the period that begins in ``state`` at ``time``."""
        target, acceleration = reference_at(trajectory, time)
        wrench = acceleration * self._mass - self.observer.disturbance
        wrench -= self.design(dt)[0] @ (state - target)
        # The heading in the middle of the period, where the pulses are.
        return self.robot.allocate(body_from_world(state[2] + 0.5 * dt * state[5], wrench))

    def _command(self, duties: FloatArray) -> FloatArray:
        self.observer.command(duties)
        return duties
