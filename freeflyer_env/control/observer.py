"""What noisy measurements say about the state and about forces that no thruster makes."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

import numpy as np

from freeflyer_env.control.riccati import double_integrator, solve_riccati
from freeflyer_env.robot import FloatArray, Robot, body_from_world

# An innovation of so many standard deviations is a push or a contact, not noise.
_JUMP = 8.0


class DisturbanceObserver:
    """Steady-state Kalman filter of pose, velocity and a slowly varying disturbance wrench.

    The disturbance (a tilted table, a weak thruster, a displaced centre of mass) is a wrench in the
    global frame that walks at random. After a jump of the state, by a push or a contact, the filter
    begins again at the measurement; the disturbance is kept.

    Args:
        robot: Nominal mass properties and thrusters.
        delay: Control periods between a command and its effect.
        noise: Standard deviation of measured position (m), heading (rad), velocity (m/s) and rate
            (rad/s).
        walk: Random walk of the disturbance's force (N per square root of a second) and torque
            (N m per square root of a second): the larger, the faster and noisier the estimate.

    Attributes:
        state: ``(6,)`` estimated present state, SI units, global frame.
        disturbance: ``(3,)`` estimated wrench in N, N, N m, global frame.

    Raises:
        ValueError: If an argument is out of range.
    """

    def __init__(
        self,
        robot: Robot,
        delay: int = 0,
        noise: tuple[float, float, float, float] = (
            1e-3,
            math.radians(0.1),
            1e-3,
            math.radians(0.2),
        ),
        walk: tuple[float, float] = (0.005, 0.001),
    ) -> None:
        if not isinstance(delay, int | np.integer) or delay < 0:
            raise ValueError(f"DisturbanceObserver.delay must be an integer >= 0, got {delay!r}.")
        require_positive("DisturbanceObserver.noise", noise, 4)
        require_positive("DisturbanceObserver.walk", walk, 2)
        self.robot, self.delay = robot, int(delay)
        position, heading, velocity, rate = noise
        self._noise = np.array([position, position, heading, velocity, velocity, rate])
        self._walk = np.array([walk[0], walk[0], walk[1]])
        self._mass = np.array([robot.mass, robot.mass, robot.inertia])
        self._gains: dict[float, tuple[FloatArray, FloatArray]] = {}
        self.reset()

    def reset(self) -> None:
        """Forgets everything."""
        self.state, self.disturbance = np.zeros(6), np.zeros(3)
        self._started = False
        # Commands that have been given and have not acted yet, and the one that acts now.
        self._pending = deque([np.zeros(8)] * (self.delay + 1), maxlen=self.delay + 1)

    def update(self, measured: FloatArray, dt: float) -> FloatArray:
        """Takes the measurement at the end of a control period.

        Args:
            measured: ``(6,)`` state.
            dt: Length of the control period in s.

        Returns:
            ``(6,)`` state, predicted to when the next command begins to act.
        """
        if not self._started:
            self.state, self._started = np.array(measured, dtype=np.float64), True
        else:
            gain, deviation = self._gain(dt)
            self.state = self._predict(self.state, self._pending[0], dt)
            innovation = measured - self.state
            if (np.abs(innovation) > _JUMP * deviation).any():
                self.state = np.array(measured, dtype=np.float64)
            else:
                correction = gain @ innovation
                self.state = self.state + correction[:6]
                self.disturbance = self.disturbance + correction[6:]
        ahead = self.state
        for duties in list(self._pending)[1:]:
            ahead = self._predict(ahead, duties, dt)
        return ahead

    def command(self, duties: FloatArray) -> None:
        """Takes note of the duties ``(8,)`` commanded for the period that begins."""
        self._pending.append(np.array(duties, dtype=np.float64))

    def _predict(self, state: FloatArray, duties: FloatArray, dt: float) -> FloatArray:
        """State ``(6,)`` after ``dt`` seconds under the duties and the disturbance."""
        heading = state[2] + 0.5 * dt * state[5]
        wrench = body_from_world(-heading, self.robot.wrench_matrix @ duties) + self.disturbance
        change = dt * wrench / self._mass
        moved = state[:3] + dt * (state[3:] + 0.5 * change)
        return np.concatenate([moved, state[3:] + change])

    def _gain(self, dt: float) -> tuple[FloatArray, FloatArray]:
        """Kalman gain ``(9, 6)`` and deviation ``(6,)`` of the innovations, made once."""
        if dt not in self._gains:
            a, b = double_integrator(self.robot, dt)
            f = np.block([[a, b], [np.zeros((3, 6)), np.eye(3)]])
            h = np.eye(6, 9)
            r = np.diag(self._noise**2)
            q = np.zeros((9, 9))
            # Forces that last a period only, by rounding of pulses, are about as large.
            q[:6, :6] = b @ np.diag(self._walk**2) @ b.T
            q[6:, 6:] = dt * np.diag(self._walk**2)
            p = solve_riccati(f.T, h.T, q, r)
            innovation = h @ p @ h.T + r
            gain = np.asarray(np.linalg.solve(innovation, h @ p).T, dtype=np.float64)
            self._gains[dt] = gain, np.sqrt(np.diag(innovation))
        return self._gains[dt]


def require_positive(name: str, values: Sequence[float], size: int) -> None:
    """Raises a ``ValueError`` unless ``values`` are ``size`` positive finite numbers."""
    array = np.asarray(values, dtype=np.float64)
    if array.shape != (size,) or not (np.isfinite(array).all() and (array > 0.0).all()):
        wanted = f"{size} positive finite numbers" if size > 1 else "a positive finite number"
        raise ValueError(f"{name} must be {wanted}, got {values if size > 1 else values[0]!r}.")
