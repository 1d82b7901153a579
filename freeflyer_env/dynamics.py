"""The impulsive model of the optimal control problem, batched.

State ``x = (r_x, r_y, psi, v_x, v_y, omega)`` and control ``u = (dv_x, dv_y, h)`` in SI units and
the global frame. The impulse acts at the start of the step, then the robot drifts::

    v' = v + u_v,   omega' = omega + (m / J) h,   (r', psi') = (r, psi) + dt (v', omega')

A trajectory of ``N`` controls has ``N + 1`` states; the last impulse is not followed by a drift, so
its state is "after the last impulse", where the goal is prescribed.
"""

from __future__ import annotations

import numpy as np

from freeflyer_env.robot import FloatArray, Robot


def apply_impulse(state: FloatArray, control: FloatArray, robot: Robot) -> FloatArray:
    """State ``(..., 6)`` right after the impulse ``control`` ``(..., 3)``."""
    state = np.array(state, dtype=np.float64)
    state[..., 3:] += np.asarray(control, dtype=np.float64) * robot.control_gain
    return state


def step(state: FloatArray, control: FloatArray, dt: float, robot: Robot) -> FloatArray:
    """One step of the impulsive model: impulse, then a drift of ``dt`` seconds.

    Args:
        state: ``(..., 6)`` states.
        control: ``(..., 3)`` impulses per unit mass, global frame.
        dt: Step in s.
        robot: Gives ``m / J``.

    Returns:
        ``(..., 6)`` next states.
    """
    state = apply_impulse(state, control, robot)
    state[..., :3] += dt * state[..., 3:]
    return state


def rollout(start: FloatArray, controls: FloatArray, dt: float, robot: Robot) -> FloatArray:
    """States of a whole control sequence, in closed form (cumulative sums).

    Args:
        start: ``(..., 6)`` first state.
        controls: ``(..., N, 3)`` impulses per unit mass, global frame.
        dt: Step in s.
        robot: Gives ``m / J``.

    Returns:
        ``(..., N + 1, 6)`` states: before each impulse, and after the last one.
    """
    start = np.asarray(start, dtype=np.float64)
    impulses = np.asarray(controls, dtype=np.float64) * robot.control_gain
    rates = start[..., None, 3:] + np.cumsum(impulses, axis=-2)
    poses = start[..., None, :3] + dt * np.cumsum(rates[..., :-1, :], axis=-2)
    states = np.empty((*rates.shape[:-2], rates.shape[-2] + 1, 6))
    states[..., 0, :] = start
    states[..., 1:, 3:] = rates
    states[..., 1:-1, :3] = poses
    states[..., -1, :3] = states[..., -2, :3]
    return states


def dynamics_residual(
    states: FloatArray, controls: FloatArray, dt: float, robot: Robot
) -> FloatArray:
    """Step-by-step defect of a trajectory, ``(..., N, 6)``; zero where it obeys the model."""
    states = np.asarray(states, dtype=np.float64)
    after = apply_impulse(states[..., :-1, :], controls, robot)
    after[..., :-1, :3] += dt * after[..., :-1, 3:]
    return states[..., 1:, :] - after
