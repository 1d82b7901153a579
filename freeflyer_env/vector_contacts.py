"""Many worlds at once: free flight in closed form, contacts by sequential impulses, all in NumPy.

The batched counterpart of :mod:`freeflyer_env.physics` for the nominal robot and obstacles at rest.
Free flight is the same closed form. Contacts follow the method of Chipmunk, which that module uses:
overlaps are found at the ends of sub-steps, answered there by impulses along the line of centres
and friction across it, and pushed apart in the next sub-step. Accumulated impulses are kept as long
as Chipmunk keeps them, so that lasting contacts come out alike too.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from freeflyer_env.contact_space import COLLISION_SLOP, WALL_RADIUS
from freeflyer_env.robot import FloatArray
from freeflyer_env.scenario import Scenario

IntArray = NDArray[np.int64]

_ITERATIONS, _PERSISTENCE = 10, 3  # Chipmunk's; the latter in sub-steps
_MARGIN = 1e-6  # m
_FAR = 1e6  # m: where discs are that are not there
_FORGOTTEN = 1000  # sub-steps


class Worlds:
    """One robot on each of ``n`` tables.

    Args:
        n: Number of worlds.
        scenario: Gives robot and table; the obstacles are placed with :meth:`place`.
        max_obstacles: Most discs on a table.
        restitution: Of every contact, 0 (plastic) to 1 (elastic).
        friction: Coulomb coefficient of every contact.
        solid: Whether robots touch obstacles and walls; otherwise they pass through.

    Attributes:
        state: ``(6, n)`` states, SI units, table frame.
        contact_count: ``(n,)`` contacts that began in the last :meth:`advance`.
        contact_impulse: ``(n,)`` sum of the magnitudes of its contact impulses in N s.
        touched: ``(n, max_obstacles + 1)`` which discs, and last whether a wall, were touched.
    """

    def __init__(
        self,
        n: int,
        scenario: Scenario,
        max_obstacles: int,
        restitution: float,
        friction: float,
        solid: bool,
    ) -> None:
        self.robot, self.table, self.solid = scenario.robot, scenario.table, solid
        self.restitution, self.friction = restitution, friction
        self.state = np.zeros((6, n))
        self.contact_count = np.zeros(n, dtype=np.int64)
        self.contact_impulse = np.zeros(n)
        self.touched = np.zeros((n, max_obstacles + 1), dtype=bool)
        # The surfaces: centres in m, and the distance from there at which the robot touches. In the
        # order in which Chipmunk meets them: walls on the left, above, on the right and below, with
        # one coordinate that matters, then discs, the last one first.
        thick, (width, height) = WALL_RADIUS, self.table
        self.centres = np.full((2, n, 4 + max_obstacles), _FAR)
        self.centres[0, :, 0:4:2] = -thick, width + thick
        self.centres[1, :, 1:4:2] = height + thick, -thick
        self.reach = np.full((n, 4 + max_obstacles), thick + self.robot.radius)
        # So far (m) each hull may move before it could touch something; at least.
        self._room = np.full(n, -1.0)
        # Of each surface the accumulated impulses (normal, tangential) and the sub-steps since it
        # was touched; of each robot the displacement of the next sub-step that ends an overlap;
        # where any contact is remembered.
        self.impulses = np.zeros((2, n, 4 + max_obstacles))
        self.age = np.full((n, 4 + max_obstacles), _FORGOTTEN, dtype=np.int64)
        self.push = np.zeros((2, n))
        self.engaged = np.zeros(n, dtype=bool)

    def place(self, worlds: IntArray, states: FloatArray, discs: FloatArray) -> None:
        """Starts anew.

        Args:
            worlds: ``(k,)`` indices.
            states: ``(k, 6)`` states.
            discs: ``(k, max_obstacles, 3)`` rows ``(x, y, radius)`` in m; radius zero: none.
        """
        self.state[:, worlds] = states.T
        x, y, radius = discs[:, ::-1].transpose(2, 0, 1)
        there = radius > 0.0
        self.centres[:, worlds, 4:] = np.where(there, [x, y], _FAR)
        self.reach[worlds, 4:] = np.where(there, radius + self.robot.radius, 0.0)
        self._room[worlds], self.engaged[worlds] = -1.0, False
        self.age[worlds], self.push[:, worlds] = _FORGOTTEN, 0.0
        self.contact_count[worlds], self.contact_impulse[worlds] = 0, 0.0
        self.touched[worlds] = False

    def advance(
        self, duration: float, sub_steps: int, wrenches_body: FloatArray | None = None
    ) -> None:
        """Advances all worlds.

        Args:
            duration: In s.
            sub_steps: Number of equal physics steps.
            wrenches_body: ``(3, sub_steps or 1, n)`` wrench ``(F_x, F_y, M)`` in N, N, N m, body
                frame, of each sub-step or all of them; None lets the robots drift.
        """
        self.contact_count = np.zeros_like(self.contact_count)
        self.contact_impulse = np.zeros_like(self.contact_impulse)
        self.touched = np.zeros_like(self.touched)
        h = duration / sub_steps
        near = self._near(duration, wrenches_body is not None)
        wrenches = None
        if wrenches_body is None:
            touching = self._ahead(near, duration)
            final = self.state.copy()
            final[:3] += duration * self.state[3:]
        else:
            final, path = self._powered(h, sub_steps, wrenches_body, near)
            touching = near[self.engaged[near] | self._overlap(path, near)]
            shape = (3, sub_steps, self.state.shape[1])
            wrenches = np.broadcast_to(wrenches_body, shape)[:, :, touching]
        if touching.size:
            final[:, touching] = self._collide(touching, h, sub_steps, wrenches)
        self.state = final

    # -- free flight -----------------------------------------------------------------------------

    def _near(self, duration: float, powered: bool) -> IntArray:
        """Worlds in which something could be touched within so many seconds."""
        if not self.solid:
            return np.zeros(0, dtype=np.int64)
        speed = np.sqrt(self.state[3] ** 2 + self.state[4] ** 2)
        if powered:
            speed += np.sqrt(8.0) * self.robot.delta_v_max(duration)
        way = duration * speed + _MARGIN
        unsure = np.flatnonzero(way > self._room)
        towards = offsets(self.centres[:, unsure], self.state[:2, unsure])
        apart = np.sqrt(towards[0] ** 2 + towards[1] ** 2)
        self._room[unsure] = (apart - self.reach[unsure]).min(axis=1)
        self._room -= way
        return unsure[(self._room[unsure] < 0.0) | self.engaged[unsure]]

    def _ahead(self, worlds: IntArray, duration: float) -> IntArray:
        """Those of some worlds in which the straight way of so many seconds meets something."""
        way = duration * self.state[3:5, worlds]
        dx, dy = offsets(self.centres[:, worlds], self.state[:2, worlds])
        # A wall is met along its normal alone.
        wx, wy = (part[:, None] * (offset != 0.0) for part, offset in zip(way, (dx, dy)))
        share = (dx * wx + dy * wy) / np.maximum(wx * wx + wy * wy, 1e-300)
        share = np.minimum(np.maximum(share, 0.0), 1.0)
        square = (dx - share * wx) ** 2 + (dy - share * wy) ** 2
        meets = (square < (self.reach[worlds] + _MARGIN) ** 2).any(axis=1)
        return worlds[meets | self.engaged[worlds]]

    def _powered(
        self, h: float, sub_steps: int, wrenches_body: FloatArray, near: IntArray
    ) -> tuple[FloatArray, FloatArray]:
        """Flight under thrust: final states, and positions ``(2, sub_steps, k)`` of some worlds."""
        to_middle, to_end, to_path = _sums(sub_steps)
        x, y, psi, vx, vy, rate = self.state
        force_x, force_y, torque = wrenches_body
        alpha = torque / self.robot.inertia
        if len(alpha) == 1:
            to_middle = to_middle.sum(axis=1, keepdims=True)
        middle = psi + (h * (np.arange(sub_steps) + 0.5))[:, None] * rate
        middle += (h * h) * to_middle @ alpha
        cos, sin = np.cos(middle), np.sin(middle)
        gain, final = 0.5 * h / self.robot.mass, np.empty_like(self.state)
        path = np.empty((2, sub_steps, near.size))
        kicks = (cos * force_x - sin * force_y, sin * force_x + cos * force_y)
        for axis, (start, speed, kick) in enumerate(zip((x, y), (vx, vy), kicks)):
            kick *= gain
            final[axis] = start + h * (sub_steps * speed + to_path[-1] @ kick)
            final[3 + axis] = speed + 2.0 * kick.sum(axis=0)
            steps = np.arange(1, sub_steps + 1)[:, None]
            path[axis] = start[near] + h * (steps * speed[near] + to_path @ kick[:, near])
        alpha = np.broadcast_to(alpha, middle.shape)
        final[2] = psi + h * sub_steps * rate + (h * h) * (to_end @ alpha)
        final[5] = rate + h * alpha.sum(axis=0)
        return final, path

    def _overlap(self, path: FloatArray, worlds: IntArray) -> NDArray[np.bool_]:
        """``(k,)`` whether a path ``(2, sub_steps, k)`` meets anything at the end of a sub-step."""
        dx, dy = offsets(self.centres[:, None, worlds], path)
        return (dx * dx + dy * dy < self.reach[worlds] ** 2).any(axis=(0, 2))

    # -- contact ---------------------------------------------------------------------------------

    def _collide(
        self, worlds: IntArray, h: float, sub_steps: int, wrenches: FloatArray | None
    ) -> FloatArray:
        """Final states ``(6, k)`` of worlds ``(k,)`` in which there is contact."""
        self._room[worlds] = -1.0
        pose, velocity = self.state[:3, worlds], self.state[3:, worlds]
        contact = _Contacts(self, worlds)
        for index in range(sub_steps):
            kick = None
            if wrenches is not None:
                kick = self._half_kick(h, pose[2], velocity[2], wrenches[:, index])
                velocity += kick
            pose += h * velocity
            contact.step(pose, velocity)
            if kick is not None:
                velocity += kick
        contact.keep(sub_steps)
        return np.concatenate([pose, velocity])

    def _half_kick(
        self, h: float, psi: FloatArray, rate: FloatArray, wrench: FloatArray
    ) -> FloatArray:
        """Half of the velocity change ``(3, k)`` of a sub-step under wrenches ``(3, k)``."""
        half, alpha = 0.5 * h, wrench[2] / self.robot.inertia
        middle = psi + half * (rate + 0.5 * half * alpha)
        cos, sin, gain = np.cos(middle), np.sin(middle), half / self.robot.mass
        return np.stack(
            [
                gain * (cos * wrench[0] - sin * wrench[1]),
                gain * (sin * wrench[0] + cos * wrench[1]),
                half * alpha,
            ]
        )


class _Contacts:
    """The contacts of some worlds ``(k,)`` during one advance."""

    def __init__(self, every: Worlds, worlds: IntArray) -> None:
        self._every, self._worlds = every, worlds
        self._centres, self._reach = every.centres[:, worlds], every.reach[worlds]
        self._touching = self._reach**2
        self._impulses, self._age = every.impulses[:, worlds], every.age[worlds]
        self._push = every.push[:, worlds]
        self._count, self._impulse = np.zeros(worlds.size, dtype=np.int64), np.zeros(worlds.size)
        self._pushing = True

    def keep(self, sub_steps: int) -> None:
        """Hands the worlds what they have to know after so many sub-steps."""
        every, worlds = self._every, self._worlds
        every.impulses[:, worlds], every.age[worlds] = self._impulses, self._age
        every.push[:, worlds] = self._push
        every.engaged[worlds] = (self._age < _PERSISTENCE).any(axis=1)
        every.contact_count[worlds] = self._count
        every.contact_impulse[worlds] = self._impulse
        touched = self._age < sub_steps
        every.touched[worlds, :-1] = touched[:, :3:-1]
        every.touched[worlds, -1] = touched[:, :4].any(axis=1)

    def step(self, pose: FloatArray, velocity: FloatArray) -> None:
        """Ends a sub-step: answers the overlaps of ``pose`` ``(3, k)`` in ``velocity`` ``(3, k)``.

        Overlaps that the last sub-step found are taken away first.
        """
        if self._pushing:
            pose[:2] += self._push
            self._push[:] = 0.0
            self._pushing = False
        self._age += 1
        towards = offsets(self._centres, pose[:2])
        squares = towards[0] * towards[0] + towards[1] * towards[1]
        robots, surfaces = np.nonzero(squares < self._touching)
        if not robots.size:
            return
        self._pushing = True
        apart = np.sqrt(squares[robots, surfaces])
        depths = apart - self._reach[robots, surfaces]
        normals = towards[:, robots, surfaces]
        if apart.all():
            normals /= apart
        else:
            # From right on a centre the robot is pushed to the left, as in Chipmunk.
            normals = np.where(apart > 0.0, normals / np.maximum(apart, 1e-300), [[1.0], [0.0]])
        again = robots[1:] == robots[:-1]
        if not again.any():
            self._solve_single(velocity, robots, surfaces, normals, depths)
            return
        several = np.zeros(robots.size, dtype=bool)
        several[1:] |= again
        several[:-1] |= again
        alone = ~several
        self._solve_single(
            velocity, robots[alone], surfaces[alone], normals[:, alone], depths[alone]
        )
        where = np.flatnonzero(several)
        for part in np.split(where, np.flatnonzero(np.diff(robots[where])) + 1):
            self._solve_several(
                velocity, int(robots[part[0]]), surfaces[part], normals[:, part], depths[part]
            )

    def _solve_single(
        self,
        velocity: FloatArray,
        robots: IntArray,
        surfaces: IntArray,
        normals: FloatArray,
        depths: FloatArray,
    ) -> None:
        """What :meth:`_solve_several` does where each robot has one contact, in closed form.

        Args:
            velocity: ``(3, k)``, changed.
            robots: ``(q,)`` distinct indices into k.
            surfaces: ``(q,)`` which surfaces are touched.
            normals: ``(2, q)`` unit vectors from robot to surface.
            depths: ``(q,)`` distance between hull and surface in m, negative.
        """
        robot, friction = self._every.robot, self._every.friction
        self._push[:, robots] = normals * np.minimum(0.0, depths + COLLISION_SLOP)
        age = self._age[robots, surfaces]
        began = age > 1
        # The sums of a contact that goes on cancel out; of a new one that comes soon after an old
        # one they do not.
        left = self._impulses[:, robots, surfaces] * (began & (age <= _PERSISTENCE))
        (nx, ny), (vx, vy, rate) = normals, velocity[:, robots]
        approach = (1.0 + self._every.restitution) * robot.mass * (vx * nx + vy * ny)
        sums = np.zeros_like(left)
        sums[0] = np.maximum(left[0] + approach, 0.0)
        change = (sums - left) / robot.mass
        if friction > 0.0:
            lever = robot.radius / robot.inertia
            slip = vy * nx - vx * ny + robot.radius * rate
            wanted = left[1] + slip / (1.0 / robot.mass + robot.radius * lever)
            limit = friction * sums[0]
            sums[1] = np.minimum(np.maximum(wanted, -limit), limit)
            across = sums[1] - left[1]
            velocity[2, robots] -= lever * across
            velocity[0, robots] += ny * (across / robot.mass)
            velocity[1, robots] -= nx * (across / robot.mass)
        velocity[:2, robots] -= normals * change[0]
        self._impulses[:, robots, surfaces] = sums
        self._age[robots, surfaces] = 0
        self._count[robots] += began
        self._impulse[robots] += np.hypot(sums[0], sums[1])

    def _solve_several(
        self,
        velocity: FloatArray,
        robot: int,
        surfaces: IntArray,
        normals: FloatArray,
        depths: FloatArray,
    ) -> None:
        """Sequential impulses for one robot with several contacts, in plain floats.

        Args:
            velocity: ``(3, k)``, changed.
            robot: Index into k.
            surfaces: ``(c,)`` which surfaces are touched.
            normals: ``(2, c)`` unit vectors from robot to surface.
            depths: ``(c,)`` distance between hull and surface in m, negative.
        """
        body, friction = self._every.robot, self._every.friction
        mass, lever = body.mass, body.radius / body.inertia
        tangent_mass = 1.0 / (1.0 / mass + body.radius * lever)
        vx, vy, rate = velocity[:, robot].tolist()
        ages = self._age[robot, surfaces]
        # A contact that goes on starts from its last impulses; a new one finds what is left of an
        # old one in the sums only.
        sums = np.where(ages <= _PERSISTENCE, self._impulses[:, robot, surfaces], 0.0).T.tolist()
        directions = normals.T.tolist()
        bounces = [self._every.restitution * (vx * a + vy * b) for a, b in directions]
        wanted = [max(-depth - COLLISION_SLOP, 0.0) for depth in depths.tolist()]
        for (a, b), (jn, jt), age in zip(directions, sums, ages.tolist()):
            if age == 1:
                vx, vy = vx - (a * jn - b * jt) / mass, vy - (b * jn + a * jt) / mass
                rate -= lever * jt
        px, py, pushes = 0.0, 0.0, [0.0] * len(wanted)
        for _ in range(_ITERATIONS):
            before = px, py, vx, vy, rate
            for i, (a, b) in enumerate(directions):
                new = max(pushes[i] + wanted[i] + px * a + py * b, 0.0)
                px, py = px - a * (new - pushes[i]), py - b * (new - pushes[i])
                pushes[i], (jn, jt) = new, sums[i]
                new = max(jn + mass * (vx * a + vy * b + bounces[i]), 0.0)
                slip = vy * a - vx * b + body.radius * rate
                across = min(max(jt + tangent_mass * slip, -friction * new), friction * new)
                sums[i] = [new, across]
                along, across = (new - jn) / mass, across - jt
                rate -= lever * across
                vx, vy = vx + b * across / mass - a * along, vy - a * across / mass - b * along
            if before == (px, py, vx, vy, rate):
                break
        velocity[:, robot], self._push[:, robot] = (vx, vy, rate), (px, py)
        self._impulses[:, robot, surfaces] = np.array(sums).T
        self._age[robot, surfaces] = 0
        self._count[robot] += (ages > 1).sum()
        self._impulse[robot] += sum(math.hypot(*pair) for pair in sums)


@lru_cache
def _sums(sub_steps: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The recursions of flight under thrust as sums over sub-steps.

    Returns:
        What the accelerations of all sub-steps add to the heading in the middle of each
        ``(sub_steps, sub_steps)`` and at the end ``(sub_steps,)``, in units of ``h^2``; what the
        half kicks add to the position after each ``(sub_steps, sub_steps)``, in units of ``h``.
    """
    one, done = np.eye(sub_steps), np.tri(sub_steps)
    before = done - one
    turns = before + 0.5 * one
    return (
        before @ turns + 0.5 * before + 0.125 * one,
        turns.sum(axis=0),
        done @ (before + done),
    )


def offsets(centres: FloatArray, positions: FloatArray) -> FloatArray:
    """Vectors from positions to the nearest points of the surfaces' cores.

    Args:
        centres: ``(2, ..., 4 + M)`` of the surfaces; walls come first.
        positions: ``(2, ...)``.

    Returns:
        ``(2, ..., 4 + M)`` in m.
    """
    towards = centres - positions[..., None]
    towards[1, ..., 0:4:2] = 0.0
    towards[0, ..., 1:4:2] = 0.0
    return towards
