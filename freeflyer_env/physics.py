"""The pymunk world: walls, disc obstacles, the robot, contacts.

Chipmunk advances positions with the velocities before it advances velocities with the forces. Half
of a sub-step's velocity change is therefore applied before and half after it (velocity Verlet),
which makes the motion under a constant world force exact at any number of sub-steps. A thruster's
force turns with the body; over a sub-step it is applied at the heading of the sub-step's middle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pymunk

from freeflyer_env.robot import FloatArray
from freeflyer_env.scenario import Scenario

_WALL_THICKNESS = 0.5  # m: thick enough that nothing tunnels through
_ROBOT, _WALL, _FIRST_OBSTACLE = 1, 2, 3


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
        touched = sorted(self.bodies, key=str)
        return {"count": self.count, "impulse": self.impulse, "with": touched}


class World:
    """One robot on one table.

    Args:
        scenario: Table, obstacles and robot; the physical discs collide, not their keep-out radii.
        restitution: Of every contact, 0 (plastic) to 1 (elastic).
        friction: Coulomb coefficient of every contact.
        solid: Whether there are obstacles and walls to touch.
    """

    def __init__(
        self,
        scenario: Scenario,
        restitution: float = 0.5,
        friction: float = 0.0,
        solid: bool = True,
    ) -> None:
        for name, value in (("restitution", restitution), ("friction", friction)):
            if not 0.0 <= value <= 1.0:
                raise ValueError(f"{name} must be in [0, 1], got {value}.")
        self.scenario = scenario
        self._solid = solid
        # Calls that lead here from a moment at which the state was all there is to know.
        self._history: list[tuple[str, tuple[Any, ...]]] = []
        self._steps_apart, self._touched = 0, False
        # Chipmunk multiplies the two shapes' values; the robot's are one.
        self._surface = (restitution, friction)
        self.contacts = ContactLog()
        self._space = pymunk.Space()
        self._space.gravity = (0.0, 0.0)
        # Chipmunk's defaults think in pixels, here distances are in metres: hardly any overlap is
        # tolerated, and the rest of it is gone after one step.
        self._space.collision_slop = 1e-4
        self._space.collision_bias = 0.0
        # The default tree reports pairs in an order that depends on where the robot has been.
        self._space.use_spatial_hash(1.0, 100)
        robot = scenario.robot
        self._body = pymunk.Body(robot.mass, robot.inertia)
        self._shape = pymunk.Circle(self._body, robot.radius)
        self._shape.elasticity, self._shape.friction = 1.0, 1.0
        self._shape.collision_type = _ROBOT
        self._space.add(self._body, self._shape)
        if solid:
            self._add_obstacles()
            self._add_walls()

    def __reduce__(self) -> tuple[Any, ...]:
        # Chipmunk keeps contact impulses and push-out velocities that it neither shows nor takes
        # back, so a copy made during a contact has to go through that contact again.
        settings = (self.scenario, *self._surface, self._solid)
        return _replayed, (settings, self._history, self.contacts)

    @property
    def state(self) -> FloatArray:
        """State ``(6,)`` of the robot, a fresh array."""
        body = self._body
        return np.array([*body.position, body.angle, *body.velocity, body.angular_velocity])

    @state.setter
    def state(self, value: FloatArray) -> None:
        self._place([float(item) for item in value])

    def kick(self, velocity_change: FloatArray) -> None:
        """Changes ``(v_x, v_y, omega)`` at once, as an impulse does."""
        change = tuple(float(item) for item in velocity_change)
        self._history.append(("kick", (change,)))
        self._kick(*change)

    def advance(
        self, duration: float, sub_steps: int, wrenches_body: FloatArray | None = None
    ) -> None:
        """Advances the world.

        Args:
            duration: In s.
            sub_steps: Number of equal physics steps.
            wrenches_body: ``(sub_steps, 3)`` wrench ``(F_x, F_y, M)`` in N, N, N m, body frame,
                of each sub-step; None lets the robot drift.
        """
        wrenches = None if wrenches_body is None else wrenches_body.tolist()
        self._advance(duration / sub_steps, sub_steps, wrenches)

    def take_contacts(self) -> ContactLog:
        """The contacts since the last call."""
        log, self.contacts = self.contacts, ContactLog()
        return log

    def _place(self, x: list[float]) -> None:
        self._history.append(("_place", (x,)))
        self._body.position, self._body.angle = (x[0], x[1]), x[2]
        self._body.velocity, self._body.angular_velocity = (x[3], x[4]), x[5]
        self._space.reindex_shapes_for_body(self._body)

    def _advance(self, h: float, sub_steps: int, wrenches: list[list[float]] | None) -> None:
        self._history.append(("_advance", (h, sub_steps, wrenches)))
        self._steps_apart += sub_steps
        self._touched = False
        if wrenches is None:
            for _ in range(sub_steps):
                self._space.step(h)
        else:
            self._push(h, wrenches)
        if self._touched:
            self._steps_apart = 0
        elif self._steps_apart > self._space.collision_persistence:
            self._history = [("_place", (self.state.tolist(),))]

    def _push(self, h: float, wrenches: list[list[float]]) -> None:
        """Steps of ``h`` seconds, one under each body wrench."""
        body, robot = self._body, self.scenario.robot
        for fx, fy, torque in wrenches:
            alpha = torque / robot.inertia
            middle = body.angle + 0.5 * h * (body.angular_velocity + 0.25 * h * alpha)
            cos, sin, gain = math.cos(middle), math.sin(middle), 0.5 * h / robot.mass
            half = gain * (cos * fx - sin * fy), gain * (sin * fx + cos * fy), 0.5 * h * alpha
            self._kick(*half)
            self._space.step(h)
            self._kick(*half)

    def _kick(self, dx: float, dy: float, turn: float) -> None:
        body = self._body
        vx, vy = body.velocity
        body.velocity = (vx + dx, vy + dy)
        body.angular_velocity += turn

    def _add_obstacles(self) -> None:
        obstacles = self.scenario.obstacles
        for index, (centre, radius) in enumerate(zip(obstacles.centres, obstacles.radii)):
            shape = pymunk.Circle(self._space.static_body, float(radius), tuple(centre))
            self._add_static(shape, _FIRST_OBSTACLE + index)
            self._report(_FIRST_OBSTACLE + index, index)

    def _add_walls(self) -> None:
        width, height = self.scenario.table
        t = _WALL_THICKNESS
        left, right, low, high = -t, width + t, -t, height + t
        corners = [(left, low), (right, low), (right, high), (left, high)]
        for first, second in zip(corners, corners[1:] + corners[:1]):
            segment = pymunk.Segment(self._space.static_body, first, second, t)
            self._add_static(segment, _WALL)
        self._report(_WALL, "wall")

    def _add_static(self, shape: pymunk.Shape, collision_type: int) -> None:
        shape.elasticity, shape.friction = self._surface
        shape.collision_type = collision_type
        self._space.add(shape)

    def _report(self, collision_type: int, name: int | str) -> None:
        """Logs contacts of the robot with shapes of a type under ``name``."""
        self._space.on_collision(
            _ROBOT, collision_type, begin=self._began, post_solve=self._solved, data=name
        )

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
