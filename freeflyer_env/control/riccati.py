"""The discrete algebraic Riccati equation and the double integrator, in NumPy alone."""

from __future__ import annotations

import numpy as np

from freeflyer_env.robot import FloatArray, Robot


def solve_riccati(a: FloatArray, b: FloatArray, q: FloatArray, r: FloatArray) -> FloatArray:
    """The stabilising solution ``X`` of ``X = A' X A - A' X B (R + B' X B)^-1 B' X A + Q``.

    By structure-preserving doubling, which squares the error in each of its few steps.

    Args:
        a: ``(n, n)``.
        b: ``(n, m)``.
        q: ``(n, n)`` symmetric, positive semidefinite.
        r: ``(m, m)`` symmetric, positive definite.

    Raises:
        ValueError: If there is no such solution.
    """
    one = np.eye(len(a))
    g, h = b @ np.linalg.solve(r, b.T), q
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(60):
            # Both (1 + G H)^-1 A and (1 + G H)^-1 G.
            left, middle = np.hsplit(np.linalg.solve(one + g @ h, np.hstack([a, g])), 2)
            change = a.T @ h @ left
            a, g, h = a @ left, g + a @ middle @ a.T, h + change
            if np.abs(change).max() <= 1e-13 * np.abs(h).max():
                return 0.5 * (h + h.T)
    raise ValueError("The Riccati equation has no stabilising solution for these matrices.")


def double_integrator(robot: Robot, dt: float) -> tuple[FloatArray, FloatArray]:
    """The robot in free flight over ``dt`` seconds under a constant wrench in the global frame.

    Returns:
        ``A`` ``(6, 6)`` and ``B`` ``(6, 3)`` of ``x+ = A x + B w``, ``w`` in N, N, N m.
    """
    one = np.eye(3)
    a = np.block([[one, dt * one], [np.zeros((3, 3)), one]])
    per_wrench = np.diag([1.0 / robot.mass, 1.0 / robot.mass, 1.0 / robot.inertia])
    return a, np.vstack([0.5 * dt**2 * per_wrench, dt * per_wrench])
