"""Contacts of a batch of robots, by the rules of Chipmunk's solver.

After each sub-step every overlap gives an impulse that reverses the approach with the restitution
and works against sliding with the friction, and a displacement of the next sub-step that takes the
overlap away (Chipmunk: ``collision_bias = 0``). A disc has one lever at each contact, its radius,
so that a single contact is solved in closed form; several at once need Chipmunk's iterations.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from freeflyer_env.physics import COLLISION_SLOP
from freeflyer_env.robot import FloatArray, Robot

_ITERATIONS = 10  # Chipmunk's


class Contacts:
    """Contacts of ``n`` robots, each with up to ``m`` discs and the walls of its table.

    Args:
        n: Number of robots.
        m: Most discs of one.
        robot: The robot.
        table: Size of the table in m.
        restitution: Of every contact.
        friction: Of every contact.

    Attributes:
        count: ``(n,)`` contacts that began since the log was cleared.
        impulse: ``(n,)`` sum of their impulses in N s.
        touched: ``(n, m + 1)`` which discs, and last whether a wall, were touched.
    """

    def __init__(
        self,
        n: int,
        m: int,
        robot: Robot,
        table: tuple[float, float],
        restitution: float,
        friction: float,
    ) -> None:
        self._robot, self._table = robot, np.asarray(table)
        self._restitution, self._friction = restitution, friction
        self._centres, self._radii = np.zeros((n, m, 2)), np.zeros((n, m))
        # Which discs, and which of the walls at x = 0, y = 0, x = w, y = h, overlap now.
        self._overlaps = np.zeros((n, m + 4), dtype=bool)
        self._push = np.zeros((n, 2))
        self.count, self.impulse = np.zeros(n, dtype=np.int64), np.zeros(n)
        self.touched = np.zeros((n, m + 1), dtype=bool)

    def start(self, indices: NDArray[np.intp], rows: FloatArray) -> None:
        """New tables, with rows ``(k, m, 3)`` of discs, for the robots ``(k,)``."""
        self._centres[indices], self._radii[indices] = rows[..., :2], rows[..., 2]
        self._overlaps[indices], self._push[indices] = False, 0.0
        self.count[indices], self.impulse[indices], self.touched[indices] = 0, 0.0, False

    def clear_log(self) -> None:
        """Forgets what was counted."""
        self.count[:], self.impulse[:], self.touched[:] = 0, 0.0, False

    def within(self, states: FloatArray, way: FloatArray) -> NDArray[np.intp]:
        """Robots that have something nearer than ``way`` ``(n,)`` in m, or touch something."""
        gaps, _ = self._gaps(states[:, :2], slice(None))
        busy = (gaps.min(axis=1) < way) | self._overlaps.any(axis=1) | self._push.any(axis=1)
        return np.flatnonzero(busy)

    def resolve(self, indices: NDArray[np.intp], states: FloatArray) -> None:
        """Ends a sub-step of the robots ``(k,)``: changes their states ``(k, 6)`` in place."""
        states[:, :2] += self._push[indices]
        self._push[indices] = 0.0
        gaps, normals = self._gaps(states[:, :2], indices)
        overlaps = gaps < 0.0
        began = overlaps & ~self._overlaps[indices]
        self._overlaps[indices] = overlaps
        if not overlaps.any():
            return
        self.count[indices] += began.sum(axis=1)
        m = overlaps.shape[1] - 4
        self.touched[indices, :m] |= overlaps[:, :m]
        self.touched[indices, m] |= overlaps[:, m:].any(axis=1)
        number = overlaps.sum(axis=1)
        single = np.flatnonzero(number == 1)
        which = overlaps[single].argmax(axis=1)
        self._resolve_single(indices, states, single, gaps[single, which], normals[single, which])
        for local in np.flatnonzero(number > 1):
            chosen = np.flatnonzero(overlaps[local])
            self._resolve_several(
                indices[local], states[local], gaps[local, chosen], normals[local, chosen]
            )

    def _gaps(
        self, positions: FloatArray, indices: NDArray[np.intp] | slice
    ) -> tuple[FloatArray, FloatArray]:
        """Gaps ``(k, m + 4)`` in m and unit normals ``(k, m + 4, 2)`` towards the robot."""
        radius, m = self._robot.radius, self._radii.shape[1]
        offset = positions[:, None, :] - self._centres[indices]
        distance = np.hypot(offset[..., 0], offset[..., 1])
        radii = self._radii[indices]
        gaps = np.empty((len(positions), m + 4))
        gaps[:, :m] = np.where(radii > 0.0, distance - radii - radius, np.inf)
        gaps[:, m : m + 2] = positions - radius
        gaps[:, m + 2 :] = self._table - positions - radius
        normals = np.empty((len(positions), m + 4, 2))
        normals[:, :m] = offset / np.maximum(distance, 1e-12)[..., None]
        normals[:, m:] = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))
        return gaps, normals

    def _resolve_single(
        self,
        indices: NDArray[np.intp],
        states: FloatArray,
        local: NDArray[np.intp],
        gap: FloatArray,
        normal: FloatArray,
    ) -> None:
        robot, part = self._robot, states[local]
        tangent = np.column_stack([-normal[:, 1], normal[:, 0]])
        approach = (part[:, 3:5] * normal).sum(axis=1)
        jn = np.maximum(-(1.0 + self._restitution) * approach * robot.mass, 0.0)
        slide = (part[:, 3:5] * tangent).sum(axis=1) - part[:, 5] * robot.radius
        jt = -slide / (1.0 / robot.mass + robot.radius**2 / robot.inertia)
        jt = np.clip(jt, -self._friction * jn, self._friction * jn)
        part[:, 3:5] += (jn[:, None] * normal + jt[:, None] * tangent) / robot.mass
        part[:, 5] -= jt * robot.radius / robot.inertia
        states[local] = part
        self.impulse[indices[local]] += np.hypot(jn, jt)
        depth = np.maximum(-gap - COLLISION_SLOP, 0.0)
        self._push[indices[local]] = depth[:, None] * normal

    def _resolve_several(
        self, index: np.intp, state: FloatArray, gaps: FloatArray, normals: FloatArray
    ) -> None:
        """Chipmunk's sequential impulses for one robot ``(6,)`` with several contacts."""
        robot, k = self._robot, len(gaps)
        tangents = np.column_stack([-normals[:, 1], normals[:, 0]])
        bounce = self._restitution * (normals @ state[3:5])
        depth = np.maximum(-gaps - COLLISION_SLOP, 0.0)
        jn, jt, jb, push = np.zeros(k), np.zeros(k), np.zeros(k), np.zeros(2)
        sliding_mass = 1.0 / (1.0 / robot.mass + robot.radius**2 / robot.inertia)
        for _ in range(_ITERATIONS):
            for c in range(k):
                n, t = normals[c], tangents[c]
                more = max(jb[c] + depth[c] - push @ n, 0.0)
                push += (more - jb[c]) * n
                jb[c] = more
                more = max(jn[c] - (bounce[c] + state[3:5] @ n) * robot.mass, 0.0)
                normal_part, jn[c] = more - jn[c], more
                slide = state[3:5] @ t - state[5] * robot.radius
                state[3:5] += normal_part / robot.mass * n
                most = self._friction * jn[c]
                more = min(max(jt[c] - slide * sliding_mass, -most), most)
                tangential, jt[c] = more - jt[c], more
                state[3:5] += tangential / robot.mass * t
                state[5] -= tangential * robot.radius / robot.inertia
        self.impulse[index] += np.hypot(jn, jt).sum()
        self._push[index] = push
