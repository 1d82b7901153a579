"""The free-flyer robot: mass properties, thruster geometry and allocation.

The body frame has its origin at the centre of mass, ``e_x`` forward and ``e_y`` to the left::

              (2) e_y (1)
             <--   ^   -->            body wrench, with d_i in [0, 1] the duty of thruster i:
            ^  |   |   |  ^             F_x = T ((d2 + d5) - (d1 + d6))
        (3) |--o-------o--| (0)         F_y = T ((d4 + d7) - (d0 + d3))
               |       | ---> e_x       M   = b T ((d1 + d3 + d5 + d7) - (d0 + d2 + d4 + d6))
        (4) |--o-------o--| (7)
            v  |       |  v
             <--       -->            (arrows show the exhaust; the push is opposite)
              (5)     (6)

The eight thrusters form four opposed pairs, the *clusters* ``(7-0, 2-1, 4-3, 5-6)``: a cluster's
signed delta-V is positive when its first thruster fires.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

#: For each cluster the thruster that pushes it forwards and the one that pushes it backwards.
CLUSTER_THRUSTERS = ((7, 0), (2, 1), (4, 3), (5, 6))

# Cluster thrusts that cancel out: what can be added without changing the wrench.
_FREE_CLUSTERS = np.array([1.0, 1.0, -1.0, -1.0])


@dataclass(frozen=True)
class Robot:
    """A planar spacecraft robot with eight on/off thrusters (paper, Sec. IV-A).

    Attributes:
        mass: Mass in kg.
        inertia: Moment of inertia about the vertical axis in kg m^2.
        radius: Radius of the (disc-shaped) hull in m.
        thrust: Thrust of each thruster in N.
        lever_arm: Distance of each thruster's line of action from the centre of mass in m.
    """

    mass: float = 16.0
    inertia: float = 0.18
    radius: float = 0.15
    thrust: float = 0.2
    lever_arm: float = 0.11461

    def __post_init__(self) -> None:
        for name in ("mass", "inertia", "radius", "thrust", "lever_arm"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise ValueError(f"Robot.{name} must be a positive finite number, got {value!r}.")
        if self.lever_arm > self.radius:
            raise ValueError(
                f"Robot.lever_arm must be at most the radius ({self.radius} m), "
                f"got {self.lever_arm}."
            )

    @property
    def mass_over_inertia(self) -> float:
        """``m / J`` in 1/m^2: turns the angular impulse per unit mass ``h`` into a rate change."""
        return self.mass / self.inertia

    @cached_property
    def control_gain(self) -> FloatArray:
        """``(3,)`` gain from a control to the change of ``(v_x, v_y, omega)``."""
        return np.array([1.0, 1.0, self.mass_over_inertia])

    def delta_v_max(self, dt: float) -> float:
        """Largest delta-V of one thruster in a step of ``dt`` seconds, in m/s: ``T dt / m``."""
        return self.thrust * dt / self.mass

    @cached_property
    def thruster_positions(self) -> FloatArray:
        """Thruster positions on the hull's rim in the body frame, ``(8, 2)`` in m."""
        b = self.lever_arm
        a = float(np.sqrt(self.radius**2 - b**2))
        return np.array([(b, a), (a, b), (-a, b), (-b, a), (-b, -a), (-a, -b), (a, -b), (b, -a)])

    @cached_property
    def thruster_directions(self) -> FloatArray:
        """Unit direction in which each thruster pushes the robot, body frame, ``(8, 2)``."""
        return np.array(
            [(0, -1), (-1, 0), (1, 0), (0, -1), (0, 1), (1, 0), (-1, 0), (0, 1)], dtype=np.float64
        )

    @cached_property
    def wrench_matrix(self) -> FloatArray:
        """Maps duties ``(8,)`` to the body wrench ``(F_x, F_y, M)`` in N, N, N m: ``(3, 8)``."""
        r, d = self.thruster_positions, self.thruster_directions
        torque = r[:, 0] * d[:, 1] - r[:, 1] * d[:, 0]
        return self.thrust * np.column_stack([d, torque]).T

    @cached_property
    def cluster_matrix(self) -> FloatArray:
        """``Lambda``: cluster delta-Vs to the body control ``(dv_x, dv_y, h)``, ``(3, 4)``."""
        b = self.lever_arm
        return np.array([[0, 1, 0, 1], [1, 0, 1, 0], [b, -b, -b, b]], dtype=np.float64)

    @cached_property
    def cluster_inverse(self) -> FloatArray:
        """Pseudo-inverse of :attr:`cluster_matrix`, ``(4, 3)``, of the actuation limit."""
        q = 0.25 / self.lever_arm
        return np.array([[0, 0.5, q], [0.5, 0, -q], [0, 0.5, -q], [0.5, 0, q]])

    def cluster_delta_v(self, psi: FloatArray | float, control: FloatArray) -> FloatArray:
        """Cluster delta-Vs that the pseudo-inverse assigns to a global control (paper, eq. 4g).

        Args:
            psi: Heading in rad, any batch shape ``(...)``.
            control: ``(..., 3)`` controls ``(dv_x, dv_y, h)`` in m/s, m/s, m^2/s, global frame.

        Returns:
            ``(..., 4)`` signed delta-Vs in m/s.
        """
        return body_from_world(psi, control) @ self.cluster_inverse.T

    def allocate(self, wrench_body: FloatArray) -> FloatArray:
        """Thruster duties that realise a body wrench as nearly as the thrusters can.

        Every realisable wrench is met exactly, with the least propellant; one beyond reach is
        scaled down, its direction kept.

        Args:
            wrench_body: ``(..., 3)`` force and torque ``(F_x, F_y, M)`` in N, N, N m, body frame.

        Returns:
            ``(..., 8)`` duties in [0, 1].
        """
        wrench_body = np.asarray(wrench_body, dtype=np.float64)
        if wrench_body.ndim == 1:
            return np.array(self.allocate_one(*wrench_body.tolist()))
        signed = np.moveaxis(self._signed_clusters(wrench_body), -1, 0) / self.thrust
        return np.ascontiguousarray(np.moveaxis(allocate_clusters(signed), 0, -1))

    def allocate_one(self, force_x: float, force_y: float, torque: float) -> list[float]:
        """What :meth:`allocate` does, for one wrench in plain floats: ten times as fast."""
        x, y = 0.5 * force_x / self.thrust, 0.5 * force_y / self.thrust
        turn = 0.25 * torque / (self.lever_arm * self.thrust)
        signed = (y + turn, x - turn, turn - y, -x - turn)
        first, second, third, fourth = sorted(signed)
        shift = max(min(0.0, third), second)
        low, high = fourth - 1.0, first + 1.0
        shift = 0.5 * (low + high) if low > high else max(min(shift, high), low)
        a, b, c, d = (signed[0] - shift, signed[1] - shift, shift - signed[2], shift - signed[3])
        scale = 1.0 / max(abs(a), abs(b), abs(c), abs(d), 1.0)
        duties = [0.0] * 8
        for value, (forward, backward) in zip((a, b, c, d), CLUSTER_THRUSTERS):
            if value > 0.0:
                duties[forward] = value * scale
            else:
                duties[backward] = -value * scale
        return duties

    def reach(self, control_body: FloatArray, dt: float) -> FloatArray:
        """How much of their reach the thrusters need for an impulse, ``(...)``; 1 is all of it.

        Args:
            control_body: ``(..., 3)`` impulses per unit mass ``(dv_x, dv_y, h)``, body frame.
            dt: Time in s in which to deliver them.
        """
        signed = self._signed_clusters(control_body)
        return 0.5 * (signed.max(axis=-1) - signed.min(axis=-1)) / self.delta_v_max(dt)

    def reach_of_one(self, dv_x: float, dv_y: float, h: float, dt: float) -> float:
        """What :meth:`reach` gives, for one control in plain floats."""
        x, y, turn = 0.5 * dv_x, 0.5 * dv_y, 0.25 * h / self.lever_arm
        signed = (y + turn, x - turn, turn - y, -x - turn)
        return 0.5 * (max(signed) - min(signed)) / self.delta_v_max(dt)

    def _signed_clusters(self, target: FloatArray) -> FloatArray:
        """Pseudo-inverse cluster thrusts ``(..., 4)``, with signs that make the freedom a shift."""
        return np.asarray(target, dtype=np.float64) @ self.cluster_inverse.T * _FREE_CLUSTERS


def body_from_world(psi: FloatArray | float, vector: FloatArray) -> FloatArray:
    """Turns ``(..., 3)`` planar vectors with a moment from the global into the body frame."""
    vector = np.asarray(vector, dtype=np.float64)
    cos, sin = np.cos(psi), np.sin(psi)
    x, y = vector[..., 0], vector[..., 1]
    return np.stack([cos * x + sin * y, -sin * x + cos * y, vector[..., 2]], axis=-1)


def allocate_clusters(signed: FloatArray) -> FloatArray:
    """Duties for cluster thrusts whose signs make the freedom of the allocation a shift.

    Args:
        signed: ``(4, ...)`` pseudo-inverse cluster thrusts in units of one thruster's, the signs of
            the last two changed.

    Returns:
        ``(8, ...)`` duties in [0, 1], the least propellant; see :meth:`Robot.allocate`.
    """
    a, b, c, d = signed
    (low_1, high_1), (low_2, high_2) = (
        (np.minimum(p, q), np.maximum(p, q)) for p, q in ((a, b), (c, d))
    )
    first, fourth = np.minimum(low_1, low_2), np.maximum(high_1, high_2)
    inner = np.maximum(low_1, low_2), np.minimum(high_1, high_2)
    second, third = np.minimum(*inner), np.maximum(*inner)
    # The sum of magnitudes is smallest between the two middle values, and every magnitude is
    # within 1 from `low` to `high`; where nothing is, the middle needs the least scaling.
    shift = np.maximum(np.minimum(0.0, third), second)
    low, high = fourth - 1.0, first + 1.0
    shift = np.where(low > high, 0.5 * (low + high), np.maximum(np.minimum(shift, high), low))
    clusters = signed - shift
    clusters[2:] *= -1.0
    clusters /= np.maximum(np.abs(clusters).max(axis=0), 1.0)
    duties = np.empty((8, *signed.shape[1:]))
    for value, (forward, backward) in zip(clusters, CLUSTER_THRUSTERS):
        np.maximum(value, 0.0, out=duties[forward])
        np.maximum(-value, 0.0, out=duties[backward])
    return duties
