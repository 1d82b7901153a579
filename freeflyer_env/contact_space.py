"""The pymunk space in which contacts happen: robot, discs, walls, and Chipmunk's settings."""

from __future__ import annotations

from collections.abc import Callable

import pymunk

from freeflyer_env.disturbances import Plant
from freeflyer_env.scenario import Scenario

#: Half of a wall's thickness in m: nothing below 10 m/s tunnels through within 50 ms.
WALL_RADIUS = 0.5

#: Overlap in m that is not pushed out.
COLLISION_SLOP = 1e-4

#: Of shapes that are not the robot.
SCENE_CATEGORY = 0b01

_ROBOT_CATEGORY = 0b10
_ROBOT, _WALL, _FIRST_OBSTACLE = 1, 2, 3

#: Called with an arbiter, the space, and the index of an obstacle or ``"wall"``.
Callback = Callable[[pymunk.Arbiter, pymunk.Space, int | str], None]


def make_space(
    scenario: Scenario,
    plant: Plant,
    surface: tuple[float, float],
    began: Callback,
    solved: Callback,
) -> tuple[pymunk.Space, pymunk.Body, list[pymunk.Body]]:
    """Puts a robot on its table; where it and moving obstacles are is for the caller to say.

    Args:
        scenario: Table and obstacles.
        plant: The true robot.
        surface: Restitution and friction of every contact.
        began: Called when the robot begins to touch something.
        solved: Called after each step in which it touches something.

    Returns:
        The space, the robot's body, and a kinematic body for each obstacle if any of them moves.
    """
    space = pymunk.Space()
    space.gravity = (0.0, 0.0)
    # Chipmunk's defaults think in pixels, here distances are in metres: hardly any overlap is
    # tolerated, and the rest of it is gone after one step.
    space.collision_slop = COLLISION_SLOP
    space.collision_bias = 0.0
    # The default tree reports pairs in an order that depends on where the robot has been.
    space.use_spatial_hash(1.0, 100)
    body = pymunk.Body(plant.robot.mass, plant.robot.inertia)
    body.center_of_gravity = plant.com
    hull = pymunk.Circle(body, plant.robot.radius)
    # Chipmunk multiplies the two shapes' values; the robot's are one.
    hull.elasticity, hull.friction = 1.0, 1.0
    hull.collision_type = _ROBOT
    hull.filter = pymunk.ShapeFilter(categories=_ROBOT_CATEGORY)
    space.add(body, hull)

    def add(shape: pymunk.Shape, collision_type: int) -> None:
        shape.elasticity, shape.friction = surface
        shape.filter = pymunk.ShapeFilter(categories=SCENE_CATEGORY)
        shape.collision_type = collision_type
        space.add(shape)

    def report(collision_type: int, name: int | str) -> None:
        space.on_collision(_ROBOT, collision_type, begin=began, post_solve=solved, data=name)

    obstacles, movers = scenario.obstacles, []
    for index, (centre, radius) in enumerate(zip(obstacles.centres, obstacles.radii)):
        carrier, place = space.static_body, tuple(centre.tolist())
        if obstacles.moving:
            carrier, place = pymunk.Body(body_type=pymunk.Body.KINEMATIC), (0.0, 0.0)
            space.add(carrier)
            movers.append(carrier)
        add(pymunk.Circle(carrier, float(radius), place), _FIRST_OBSTACLE + index)
        report(_FIRST_OBSTACLE + index, index)
    (width, height), t = scenario.table, WALL_RADIUS
    corners = [(-t, -t), (width + t, -t), (width + t, height + t), (-t, height + t)]
    for first, second in zip(corners, corners[1:] + corners[:1]):
        add(pymunk.Segment(space.static_body, first, second, t), _WALL)
    report(_WALL, "wall")
    return space, body, movers
