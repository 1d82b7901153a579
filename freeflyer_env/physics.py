"""The world: free flight in closed form, contacts with discs and walls in pymunk.

As long as nothing can be touched, the motion is that of a rigid body under known forces: drift is
exact, and so is a constant world force, by half a kick before and half after each sub-step
(velocity Verlet). A thruster's force turns with the body; over a sub-step it is applied at the
heading of the sub-step's middle. Where a contact is possible, pymunk takes the steps, with the same
half kicks, because Chipmunk advances positions before velocities.

Moving obstacles are kinematic bodies: at the end of every sub-step they are where
:meth:`Obstacles.centres_at` says, whatever they touch.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pymunk

from freeflyer_env.contact_space import SCENE_CATEGORY, make_space
from freeflyer_env.disturbances import Plant
from freeflyer_env.robot import FloatArray
from freeflyer_env.scenario import Obstacles, Scenario

_MARGIN = 1e-6  # m between hull and surroundings below which pymunk takes over


@dataclass
class ContactLog:
    """Contacts of the robot since the log was last taken.

    Attributes:
        count: Number of contacts that began.
        impulse: Sum of the magnitudes of all contact impulses in N s.
        bodies: What was touched: obstacle indices, and ``"wall"``.
    """

    count: int = 0
    impulse: float = 0.0
    bodies: set[int | str] = field(default_factory=set)

    def to_info(self) -> dict[str, Any]:
        """Plain values for an environment's ``info``."""
        touched = sorted(self.bodies, key=str) if self.bodies else []
        return {"count": self.count, "impulse": self.impulse, "with": touched}


_NO_CONTACTS = ContactLog()


class World:
    """One robot on one table.

    Args:
        scenario: Table, obstacles and robot; the physical discs collide, not their keep-out radii.
        restitution: Of every contact, 0 (plastic) to 1 (elastic).
        friction: Coulomb coefficient of every contact.
        solid: Whether the robot touches obstacles and walls; otherwise it passes through.
        plant: The true robot, thrusters and tilt of the table; default: the nominal ones.
    """

    def __init__(
        self,
        scenario: Scenario,
        restitution: float = 0.5,
        friction: float = 0.0,
        solid: bool = True,
        plant: Plant | None = None,
    ) -> None:
        for name, value in (("restitution", restitution), ("friction", friction)):
            if not 0.0 <= value <= 1.0:
                raise ValueError(f"{name} must be in [0, 1], got {value}.")
        self.scenario = scenario
        self.plant = plant or Plant.nominal(scenario.robot)
        self.contacts = ContactLog()
        self._settings = (scenario, restitution, friction, solid, self.plant)
        self._solid, self._balanced = solid, not any(self.plant.com)
        self._time = 0.0
        # Pose and velocities of the centre of mass: the truth while nothing can be touched.
        self._free = [0.0] * 6
        # So far (m) the hull may move before it could touch something; at least.
        self._room = 0.0
        self._obstacle_speed = _top_speed(scenario.obstacles)
        # While pymunk has the truth: the calls since it took over, of which the first places all.
        self._engaged = False
        self._history: list[tuple[str, tuple[Any, ...]]] = []
        self._steps_apart, self._touched = 0, False
        self._surface = (restitution, friction)
        self._space: pymunk.Space | None = None
        self._movers: list[pymunk.Body] = []

    def __reduce__(self) -> tuple[Any, ...]:
        # Chipmunk keeps contact impulses and push-out velocities that it neither shows nor takes
        # back, so a copy made during a contact has to go through that contact again.
        history = self._history if self._engaged else [("_fly", self._flight())]
        return _replayed, (self._settings, history, self.contacts)

    @property
    def state(self) -> FloatArray:
        """State ``(6,)`` of the hull's centre, a fresh array."""
        return np.array(self.state_values())

    @state.setter
    def state(self, value: FloatArray) -> None:
        x, y, psi, vx, vy, rate = (float(item) for item in value)
        if not self._balanced:
            lx, ly = self._lever(psi)
            x, y, vx, vy = x + lx, y + ly, vx - rate * ly, vy + rate * lx
        self._fly([x, y, psi, vx, vy, rate], self._time, 0.0)

    def state_values(self) -> list[float]:
        """:attr:`state` as six plain floats."""
        if self._balanced:
            return list(self._centre_of_mass())
        x, y, psi, vx, vy, rate = self._centre_of_mass()
        lx, ly = self._lever(psi)
        return [x - lx, y - ly, psi, vx + rate * ly, vy - rate * lx, rate]

    @property
    def heading(self) -> float:
        """Heading in rad."""
        return self._centre_of_mass()[2]

    def kick(self, velocity_change: tuple[float, float, float]) -> None:
        """Changes ``(v_x, v_y, omega)`` of the hull's centre at once, as an impulse does."""
        vx, vy, turn = velocity_change
        if not self._balanced:
            lx, ly = self._lever(self.heading)
            vx, vy = vx - turn * ly, vy + turn * lx
        self._kick(vx, vy, turn)

    def impulse(self, impulse_body: FloatArray) -> None:
        """Gives the impulse ``(J_x, J_y, L)`` in N s, N s, N m s at the hull's centre, body frame.

        The robot's true mass, inertia and centre of mass decide what comes of it.
        """
        jx, jy, angular = (float(item) for item in impulse_body)
        robot, (x, y), angle = self.plant.robot, self.plant.com, self.heading
        cos, sin = math.cos(angle) / robot.mass, math.sin(angle) / robot.mass
        turn = (angular - (x * jy - y * jx)) / robot.inertia
        self._kick(cos * jx - sin * jy, sin * jx + cos * jy, turn)

    def advance(
        self, duration: float, sub_steps: int, wrenches_body: FloatArray | None = None
    ) -> None:
        """Advances the world.

        Args:
            duration: In s.
            sub_steps: Number of equal physics steps.
            wrenches_body: ``(sub_steps, 3)`` wrench ``(F_x, F_y, M)`` in N, N, N m about the hull's
                centre, body frame, of each sub-step; None lets the robot drift.
        """
        h = duration / sub_steps
        wrenches = None if wrenches_body is None else wrenches_body.tolist()
        if wrenches is None and any(self.plant.acceleration):
            wrenches = [[0.0, 0.0, 0.0]] * sub_steps
        if not (self._engaged or self._has_room(duration, wrenches)):
            self._engage()
        if self._engaged:
            self._advance(h, sub_steps, wrenches)
        elif wrenches is None:
            self._drift(duration)
        else:
            self._glide(h, wrenches)

    def ranges(self, angles: FloatArray, reach: float) -> FloatArray:
        """Distances ``(n,)`` in m from the hull's centre to what lies in the directions.

        Args:
            angles: ``(n,)`` in rad from the robot's heading.
            reach: Largest distance in m, given where nothing is nearer.
        """
        space = self._require_space()
        if not self._engaged:
            self._place_movers()
        x, y, psi = self.state_values()[:3]
        seen = pymunk.ShapeFilter(mask=SCENE_CATEGORY)
        distances = np.full(len(angles), float(reach))
        for index, angle in enumerate((np.asarray(angles) + psi).tolist()):
            end = (x + reach * math.cos(angle), y + reach * math.sin(angle))
            hit = space.segment_query_first((x, y), end, 0.0, seen)
            if hit is not None:
                distances[index] = hit.alpha * reach
        return distances

    def take_contacts(self) -> ContactLog:
        """The contacts since the last call."""
        log = self.contacts
        if log.bodies:
            self.contacts = ContactLog()
            return log
        return _NO_CONTACTS

    # -- free flight -----------------------------------------------------------------------------

    def _flight(self) -> tuple[list[float], float, float]:
        return list(self._free), self._time, self._room

    def _fly(self, centre_of_mass: list[float], time: float, room: float) -> None:
        """Sets everything there is to know in free flight."""
        self._engaged = False
        self._free, self._time, self._room = list(centre_of_mass), time, room

    def _has_room(self, duration: float, wrenches: list[list[float]] | None) -> bool:
        """Whether nothing can be touched for so long, drifting or under body wrenches."""
        if not self._solid:
            return True
        _, _, _, vx, vy, rate = self._free
        speed, rate = math.hypot(vx, vy), abs(rate)
        arm = 0.0 if self._balanced else math.hypot(*self.plant.com)
        if wrenches is not None:
            (ax, ay), robot = self.plant.acceleration, self.plant.robot
            push = max([abs(fx) + abs(fy) for fx, fy, _ in wrenches])
            speed += duration * (push / robot.mass + abs(ax) + abs(ay))
            if arm:
                torque = max([abs(torque) for _, _, torque in wrenches])
                rate += duration * (torque + arm * push) / robot.inertia
        way = duration * (speed + arm * rate + self._obstacle_speed) + _MARGIN
        if way > self._room:
            self._room = self._clearance()
        if way > self._room:
            return wrenches is None and self._is_clear(duration)
        self._room -= way
        return True

    def _is_clear(self, duration: float) -> bool:
        """Whether the straight way of so many seconds leads past everything, at rest."""
        if self._obstacle_speed or not self._balanced:
            return False
        (width, height), obstacles = self.scenario.table, self.scenario.obstacles
        x, y, _, vx, vy, _ = self._free
        wx, wy, hull = vx * duration, vy * duration, self.plant.robot.radius + _MARGIN
        if not (hull < x + wx < width - hull and hull < y + wy < height - hull):
            return False
        square = wx * wx + wy * wy
        if square == 0.0:
            return False
        for (cx, cy), radius in zip(obstacles.centres.tolist(), obstacles.radii.tolist()):
            dx, dy = cx - x, cy - y
            share = min(max((dx * wx + dy * wy) / square, 0.0), 1.0)
            if math.hypot(dx - share * wx, dy - share * wy) < radius + hull:
                return False
        apart, self._room = self._room > _MARGIN, 0.0
        return apart

    def _clearance(self) -> float:
        """Distance in m from the hull to the nearest obstacle or wall."""
        scenario, (width, height) = self.scenario, self.scenario.table
        obstacles = scenario.obstacles
        x, y = self.state_values()[:2]
        nearest = min(x, y, width - x, height - y)
        centres = obstacles.centres_at(self._time) if self._obstacle_speed else obstacles.centres
        for (cx, cy), radius in zip(centres.tolist(), obstacles.radii.tolist()):
            nearest = min(nearest, math.hypot(x - cx, y - cy) - radius)
        return nearest - self.plant.robot.radius

    def _drift(self, duration: float) -> None:
        x, y, psi, vx, vy, rate = self._free
        self._free = [x + vx * duration, y + vy * duration, psi + rate * duration, vx, vy, rate]
        self._time += duration

    def _glide(self, h: float, wrenches: list[list[float]]) -> None:
        """Sub-steps of ``h`` seconds, one under each body wrench, with nothing near."""
        x, y, psi, vx, vy, rate = self._free
        for wrench in wrenches:
            dx, dy, turn = self._half_kick(h, wrench, psi, rate)
            vx, vy, rate = vx + dx, vy + dy, rate + turn
            x, y, psi = x + h * vx, y + h * vy, psi + h * rate
            vx, vy, rate = vx + dx, vy + dy, rate + turn
        self._free = [x, y, psi, vx, vy, rate]
        self._time += h * len(wrenches)

    def _kick(self, dx: float, dy: float, turn: float) -> None:
        """Changes the velocity of the centre of mass, and the rate."""
        if self._engaged:
            self._history.append(("_kick", (dx, dy, turn)))
            self._kick_body(dx, dy, turn)
            return
        free = self._free
        free[3] += dx
        free[4] += dy
        free[5] += turn

    def _half_kick(
        self, h: float, wrench: list[float], psi: float, rate: float
    ) -> tuple[float, float, float]:
        """Half of the velocity change of a step of ``h`` seconds under a body wrench."""
        (fx, fy, torque), (ax, ay) = wrench, self.plant.acceleration
        robot, (x, y) = self.plant.robot, self.plant.com
        alpha = (torque - (x * fy - y * fx)) / robot.inertia
        middle = psi + 0.5 * h * (rate + 0.25 * h * alpha)
        cos, sin, half = math.cos(middle), math.sin(middle), 0.5 * h
        gain = half / robot.mass
        return (
            gain * (cos * fx - sin * fy) + half * ax,
            gain * (sin * fx + cos * fy) + half * ay,
            half * alpha,
        )

    def _lever(self, psi: float) -> tuple[float, float]:
        """From the hull's centre to the centre of mass, global frame, in m."""
        (x, y), cos, sin = self.plant.com, math.cos(psi), math.sin(psi)
        return cos * x - sin * y, sin * x + cos * y

    # -- contact ---------------------------------------------------------------------------------

    def _engage(self, *flight: Any) -> None:
        """Hands over to pymunk, which keeps the truth until contacts are over and forgotten."""
        if flight:
            self._fly(*flight)
        self._require_space()
        self._history = [("_engage", self._flight())]
        x, y, psi, vx, vy, rate = self._free
        body = self._body
        body.angle = psi
        lx, ly = self._lever(psi)
        body.position = (x - lx, y - ly)
        body.velocity, body.angular_velocity = (vx, vy), rate
        assert self._space is not None
        self._space.reindex_shapes_for_body(body)
        self._place_movers()
        self._engaged, self._steps_apart = True, 0

    def _advance(self, h: float, sub_steps: int, wrenches: list[list[float]] | None) -> None:
        """Steps of ``h`` seconds in pymunk."""
        self._history.append(("_advance", (h, sub_steps, wrenches)))
        self._touched = False
        assert self._space is not None
        if wrenches is not None:
            for wrench in wrenches:
                half = self._half_kick(h, wrench, self._body.angle, self._body.angular_velocity)
                self._kick_body(*half)
                self._step(h)
                self._kick_body(*half)
        elif self._movers:
            for _ in range(sub_steps):
                self._step(h)
        else:
            for _ in range(sub_steps):
                self._space.step(h)
            self._time += sub_steps * h
        self._steps_apart = 0 if self._touched else self._steps_apart + sub_steps
        if self._steps_apart > self._space.collision_persistence:
            self._fly(self._centre_of_mass(), self._time, 0.0)

    def _step(self, h: float) -> None:
        """One step of Chipmunk, moving obstacles taken along."""
        assert self._space is not None
        if self._movers:
            centres = self.scenario.obstacles.centres_at([self._time, self._time + h]).tolist()
            for mover, now, then in zip(self._movers, *centres):
                mover.position = tuple(now)
                mover.velocity = ((then[0] - now[0]) / h, (then[1] - now[1]) / h)
        self._space.step(h)
        self._time += h

    def _kick_body(self, dx: float, dy: float, turn: float) -> None:
        body = self._body
        vx, vy = body.velocity
        body.velocity = (vx + dx, vy + dy)
        body.angular_velocity += turn

    def _centre_of_mass(self) -> list[float]:
        if not self._engaged:
            return self._free
        body = self._body
        (x, y), angle = body.position, body.angle
        lx, ly = self._lever(angle)
        return [x + lx, y + ly, angle, *body.velocity, body.angular_velocity]

    def _place_movers(self) -> None:
        assert self._space is not None
        for mover, centre in zip(
            self._movers, self.scenario.obstacles.centres_at(self._time).tolist()
        ):
            mover.position = tuple(centre)
            self._space.reindex_shapes_for_body(mover)

    def _require_space(self) -> pymunk.Space:
        """The pymunk space, made when it is first needed."""
        if self._space is None:
            self._space, self._body, self._movers = make_space(
                self.scenario, self.plant, self._surface, self._began, self._solved
            )
        return self._space

    def _began(self, _arbiter: pymunk.Arbiter, _space: pymunk.Space, name: int | str) -> None:
        self._touched = True
        self.contacts.count += 1
        self.contacts.bodies.add(name)

    def _solved(self, arbiter: pymunk.Arbiter, _space: pymunk.Space, name: int | str) -> None:
        self._touched = True
        self.contacts.impulse += float(arbiter.total_impulse.length)
        self.contacts.bodies.add(name)


def _replayed(
    settings: tuple[Any, ...], history: list[tuple[str, tuple[Any, ...]]], contacts: ContactLog
) -> World:
    """A new world in which the calls of ``history`` were made again."""
    world = World(*settings)
    for name, arguments in history:
        getattr(world, name)(*arguments)
    world.contacts = contacts
    return world


def _top_speed(obstacles: Obstacles) -> float:
    """Largest speed in m/s that any obstacle ever has."""
    if obstacles.waypoints is not None:
        legs = np.diff(obstacles.waypoints, axis=1)
        speeds = np.linalg.norm(legs[..., 1:], axis=-1) / legs[..., 0]
    else:
        assert obstacles.velocities is not None
        speeds = np.linalg.norm(obstacles.velocities, axis=-1)
    return float(speeds.max(initial=0.0))
