"""Disturbances: what a real testbed adds to the ideal environment, off by default."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from freeflyer_env.robot import FloatArray, Robot

_GRAVITY = 9.81  # m/s^2


@dataclass(frozen=True)
class Disturbances:
    """How much of each disturbance there is; all zero, as by default, is the ideal environment.

    What varies is drawn anew at every reset from the environment's generator (noise at every step).
    Planners and controllers go on using the nominal robot.

    Attributes:
        position_noise: Standard deviation in m of each measured coordinate (motion capture: 1 mm).
        heading_noise: Standard deviation in rad of the measured heading (motion capture: 0.1 deg).
        velocity_noise: Standard deviation in m/s of each estimated velocity component.
        rate_noise: Standard deviation in rad/s of the estimated turn rate.
        range_noise: Standard deviation in m of each range that the lidar tells.
        table_tilt: Angle in rad by which the table is out of level, in a random direction: a
            constant acceleration of ``9.81 m/s^2`` times it.
        com_offset: Distance in m of the centre of mass from the hull's centre, in a random
            direction of the body frame.
        thrust_error: Relative standard deviation of each thruster's force, and half of it once
            more for all eight together (supply pressure).
        failed_thruster: Index of a thruster that never fires; None if all work.
        mass_error: Relative standard deviation of the mass.
        inertia_error: Relative standard deviation of the moment of inertia.
        delay: Control periods between a command and its effect.
        min_on_time: Pulses shorter than this many seconds are not fired, and their time is carried
            to the next period (solenoid valves: about 10 ms). Thruster mode only.
    """

    position_noise: float = 0.0
    heading_noise: float = 0.0
    velocity_noise: float = 0.0
    rate_noise: float = 0.0
    range_noise: float = 0.0
    table_tilt: float = 0.0
    com_offset: float = 0.0
    thrust_error: float = 0.0
    failed_thruster: int | None = None
    mass_error: float = 0.0
    inertia_error: float = 0.0
    delay: int = 0
    min_on_time: float = 0.0

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if item.name == "failed_thruster":
                whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
                if value is not None and not (whole and 0 <= value < 8):
                    raise ValueError(
                        f"Disturbances.failed_thruster must be None or 0 to 7, got {value!r}."
                    )
            elif item.name == "delay":
                whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
                if not whole or value < 0:
                    raise ValueError(f"Disturbances.delay must be an integer >= 0, got {value!r}.")
            elif not (
                isinstance(value, float | int | np.floating | np.integer)
                and math.isfinite(value)
                and value >= 0.0
            ):
                raise ValueError(
                    f"Disturbances.{item.name} must be a finite number >= 0, got {value!r}."
                )
        for name in ("thrust_error", "mass_error", "inertia_error"):
            if getattr(self, name) > 0.2:
                raise ValueError(
                    f"Disturbances.{name} is relative and at most 0.2, got {getattr(self, name)}."
                )
        for name, most in (("table_tilt", 0.1), ("com_offset", 0.1), ("min_on_time", 0.1)):
            if getattr(self, name) > most:
                raise ValueError(
                    f"Disturbances.{name} must be at most {most}, got {getattr(self, name)}."
                )

    @classmethod
    def testbed(cls) -> Disturbances:
        """What one meets on an air table with motion capture.

        Motion capture of 1 mm and 0.1 deg; velocities from a filter; a table levelled to 0.1 mrad;
        5 mm of centre of mass; thrusters alike to 5 %, mass to 1 % and inertia to 5 %; one period
        of delay; valves that need 10 ms.
        """
        return cls(
            position_noise=1e-3,
            heading_noise=math.radians(0.1),
            velocity_noise=1e-3,
            rate_noise=math.radians(0.2),
            range_noise=5e-3,
            table_tilt=1e-4,
            com_offset=5e-3,
            thrust_error=0.05,
            mass_error=0.01,
            inertia_error=0.05,
            delay=1,
            min_on_time=0.01,
        )

    @classmethod
    def of(cls, given: Disturbances | str | Mapping[str, Any] | None) -> Disturbances:
        """From what an environment's argument may be: None, ``"testbed"``, fields, or this.

        Raises:
            ValueError: If a name is unknown or a value out of range.
        """
        if given is None:
            return cls()
        if isinstance(given, Disturbances):
            return given
        if not isinstance(given, str | Mapping):
            raise ValueError(
                f"disturbances must be 'testbed', their fields or Disturbances, got {given!r}."
            )
        if isinstance(given, str):
            if given != "testbed":
                raise ValueError(f"disturbances must be 'testbed' or their fields, got {given!r}.")
            return cls.testbed()
        names = [item.name for item in fields(cls)]
        for name in given:
            if name not in names:
                near = difflib.get_close_matches(str(name), names, n=1)
                hint = f" Did you mean {near[0]!r}?" if near else ""
                raise ValueError(f"Disturbances have no field {name!r}.{hint}")
        return cls(**given)

    @cached_property
    def any_plant(self) -> bool:
        """Whether the robot or the table differ from the nominal ones."""
        return self.failed_thruster is not None or any(
            getattr(self, name) > 0.0
            for name in ("table_tilt", "com_offset", "thrust_error", "mass_error", "inertia_error")
        )

    @cached_property
    def any_noise(self) -> bool:
        """Whether measurements differ from the true state."""
        return any(value > 0.0 for value in self._deviations)

    @property
    def _deviations(self) -> tuple[float, ...]:
        position, velocity = self.position_noise, self.velocity_noise
        return position, position, self.heading_noise, velocity, velocity, self.rate_noise

    def measure(self, state: FloatArray, rng: np.random.Generator) -> FloatArray:
        """A measurement ``(6,)`` of the true state ``(6,)``."""
        return state + rng.standard_normal(6) * self._deviations

    def sample(self, robot: Robot, rng: np.random.Generator) -> Plant:
        """Draws the true robot and table of one episode."""
        draws = np.clip(rng.standard_normal(11), -3.0, 3.0)
        tilt, offset = rng.uniform(0.0, 2.0 * math.pi, 2)
        scale = (1.0 + self.thrust_error * draws[:8]) * (1.0 + 0.5 * self.thrust_error * draws[8])
        if self.failed_thruster is not None:
            scale[self.failed_thruster] = 0.0
        gravity = _GRAVITY * self.table_tilt
        return Plant(
            robot=replace(
                robot,
                mass=robot.mass * (1.0 + self.mass_error * draws[9]),
                inertia=robot.inertia * (1.0 + self.inertia_error * draws[10]),
            ),
            thrust_scale=scale,
            acceleration=(gravity * math.cos(tilt), gravity * math.sin(tilt)),
            com=(self.com_offset * math.cos(offset), self.com_offset * math.sin(offset)),
        )


@dataclass(frozen=True, eq=False)
class Plant:
    """The true robot and table of one episode.

    Attributes:
        robot: With its true mass and inertia.
        thrust_scale: ``(8,)`` true over nominal force of each thruster.
        acceleration: ``(a_x, a_y)`` in m/s^2 that the table's tilt gives, global frame.
        com: ``(x, y)`` of the centre of mass in m, body frame about the hull's centre.
    """

    robot: Robot
    thrust_scale: FloatArray
    acceleration: tuple[float, float] = (0.0, 0.0)
    com: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def nominal(cls, robot: Robot) -> Plant:
        """The plant without disturbances."""
        return cls(robot, np.ones(8))
