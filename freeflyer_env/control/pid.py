"""PID control about a plan."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from freeflyer_env.control.reference import reference_at
from freeflyer_env.robot import FloatArray, Robot, body_from_world

if TYPE_CHECKING:
    from freeflyer_env.planning.trajectory import Trajectory


class PIDTracker:
    """PID control of position and heading about a plan, with the plan's impulses fed forward.

    Args:
        robot: Mass properties and thrusters.
        kp: Gains on ``(r_x, r_y, psi)`` in N/m, N/m, N m/rad (paper, Sec. IV-D).
        ki: Gains on the integral of the error.
        kd: Gains on ``(v_x, v_y, omega)`` in N s/m, N s/m, N m s/rad.
        feedforward: Whether the plan's acceleration is fed forward. Without it the paper's gains
            leave the robot up to 10 cm behind, with it 0.3 mm.
    """

    def __init__(
        self,
        robot: Robot,
        kp: Sequence[float] = (2.0, 2.0, 0.2),
        ki: Sequence[float] = (0.0, 0.0, 0.0),
        kd: Sequence[float] = (10.0, 10.0, 0.4),
        feedforward: bool = True,
    ) -> None:
        self.robot, self.feedforward = robot, feedforward
        gains = [np.asarray(gain, dtype=np.float64) for gain in (kp, ki, kd)]
        for name, gain in zip(("kp", "ki", "kd"), gains):
            if gain.shape != (3,) or not (np.isfinite(gain).all() and (gain >= 0.0).all()):
                raise ValueError(
                    f"PIDTracker.{name} must be three numbers >= 0, got {gain.tolist()}."
                )
        self._kp, self._ki, self._kd = gains
        self.reset()

    def reset(self) -> None:
        """Forgets the integral of the error."""
        self._integral = np.zeros(3)

    def reference(self, trajectory: Trajectory, time: float) -> FloatArray:
        """State ``(6,)`` that the tracker wants to be in at ``time`` in s."""
        return reference_at(trajectory, time)[0]

    def duties(
        self, state: FloatArray, trajectory: Trajectory, time: float, dt: float
    ) -> FloatArray:
        """Thruster duties ``(8,)``; see :meth:`Tracker.duties`."""
        reference, acceleration = reference_at(trajectory, time)
        error = reference - state
        self._integral += error[:3] * dt
        wrench = self._kp * error[:3] + self._ki * self._integral + self._kd * error[3:]
        if self.feedforward:
            wrench += acceleration * [self.robot.mass, self.robot.mass, self.robot.inertia]
        # The heading in the middle of the period, where the pulses are.
        return self.robot.allocate(body_from_world(state[2] + 0.5 * dt * state[5], wrench))
