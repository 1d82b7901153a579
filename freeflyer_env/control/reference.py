"""What a tracker is: the motion to follow, and the interface of those that follow it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np

from freeflyer_env.robot import FloatArray

if TYPE_CHECKING:
    from freeflyer_env.planning.trajectory import Trajectory


class Tracker(Protocol):
    """Follows a plan: measured states in, thruster duties out, once in every control period."""

    def reset(self) -> None:
        """Forgets the flight."""

    def reference(self, trajectory: Trajectory, time: float) -> FloatArray:
        """State ``(6,)`` that the tracker wants to be in at ``time`` in s."""

    def duties(
        self, state: FloatArray, trajectory: Trajectory, time: float, dt: float
    ) -> FloatArray:
        """Thruster duties ``(8,)`` in [0, 1] for the control period that starts at ``time``.

        Args:
            state: ``(6,)`` measured state, SI units, global frame.
            trajectory: The plan to follow.
            time: In s since the plan's start.
            dt: Length of the control period in s.
        """


def reference_at(trajectory: Trajectory, time: float) -> tuple[FloatArray, FloatArray]:
    """Reference of a tracker at ``time``: where the plan is, and how its velocity changes.

    The plan's impulses act at the nodes; thrusters need time. The reference spreads each impulse
    evenly over the step that it begins. That is a motion with piecewise constant acceleration which
    the thrusters can follow, half a step behind the plan: a plan from rest to rest is followed from
    start to goal. A plan that begins in motion is to be made from where the robot will be half a
    step later, as :class:`~freeflyer_env.control.ReplanningTracker` does; one that ends in motion
    passes its goal that much late.

    Args:
        trajectory: The plan.
        time: In s; before 0 the plan's first state is held, beyond the end its last.

    Returns:
        State ``(6,)`` and acceleration ``(3,)`` (m/s^2, m/s^2, rad/s^2).
    """
    states, accelerations = references_at(trajectory, np.array([time]))
    return states[0], accelerations[0]


def references_at(trajectory: Trajectory, times: FloatArray) -> tuple[FloatArray, FloatArray]:
    """:func:`reference_at` at ``times`` ``(K,)``: states ``(K, 6)``, accelerations ``(K, 3)``."""
    dt, n = trajectory.dt, trajectory.n_steps
    times = np.maximum(times, 0.0)
    index = np.floor(times / dt + 1e-9).astype(int)
    is_over = index >= n
    index = np.minimum(index, n - 1)
    tau = (times - index * dt)[:, None]
    nodes = trajectory.states
    before = nodes[index, 3:]
    accelerations = (nodes[index + 1, 3:] - before) / dt
    poses = nodes[index, :3] + before * (tau - 0.5 * dt) + 0.5 * accelerations * tau**2
    states = np.hstack([poses, before + accelerations * tau])
    states[is_over], accelerations[is_over] = nodes[-1], 0.0
    return states, accelerations
