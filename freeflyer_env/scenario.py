"""Scenes and problems: what the robot is asked to do, and where.

A :class:`Scenario` is the table with its disc obstacles and the robot on it; a :class:`Problem`
adds a start, a goal and a final time. The paper's scenes are in :data:`SCENES`, by name;
random ones are drawn in :mod:`freeflyer_env.sampling`.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from freeflyer_env.robot import FloatArray, Robot
from freeflyer_env.scenes import HELD_OUT, NOMINAL, TRAINING

#: Names of the six state components, in order.
STATE_NAMES = ("r_x", "r_y", "psi", "v_x", "v_y", "omega")

_ON_BOUNDARY = 2e-7  # m: float32 rounding of a start on the boundary is not a violation


@dataclass(frozen=True, eq=False)
class Obstacles:
    """Disc obstacles on the table: at rest, in uniform motion, or along waypoints.

    Attributes:
        centres: ``(M, 2)`` centres at time zero in m, table frame.
        radii: ``(M,)`` radii in m.
        velocities: ``(M, 2)`` velocities at time zero in m/s; zero if left out. Nothing stops a
            moving obstacle, not even the edge of the table.
        waypoints: ``(M, K, 3)`` rows ``(time in s, x, y in m)`` of each obstacle, times ascending;
            it moves straight and uniformly from one to the next, and rests before the first and
            after the last. None for uniform motion. See :meth:`along`.
    """

    centres: FloatArray
    radii: FloatArray
    velocities: FloatArray | None = None
    waypoints: FloatArray | None = None

    def __post_init__(self) -> None:
        centres = np.array(self.centres, dtype=np.float64).reshape(-1, 2)
        radii = np.array(self.radii, dtype=np.float64).reshape(-1)
        still = self.velocities is None
        velocities = np.array(0.0 * centres if still else self.velocities, dtype=np.float64)
        velocities = velocities.reshape(-1, 2)
        if not len(centres) == len(radii) == len(velocities):
            raise ValueError(
                f"Obstacles need one radius per centre, and one velocity, got {len(centres)} "
                f"centres, {len(radii)} radii and {len(velocities)} velocities."
            )
        if not all(np.isfinite(part).all() for part in (centres, radii, velocities)):
            raise ValueError(
                "Obstacles must be finite numbers; check centres, radii and velocities for NaN."
            )
        if (radii <= 0.0).any():
            raise ValueError(f"Obstacles.radii must be positive, got {radii.tolist()}.")
        for name, part in (("centres", centres), ("radii", radii), ("velocities", velocities)):
            part.setflags(write=False)
            object.__setattr__(self, name, part)
        if self.waypoints is not None:
            waypoints = np.array(self.waypoints, dtype=np.float64)
            if waypoints.ndim != 3 or len(waypoints) != len(radii) or waypoints.shape[2] != 3:
                raise ValueError(
                    f"Obstacles.waypoints must have shape ({len(radii)}, K, 3), rows (time, x, y), "
                    f"got {waypoints.shape}."
                )
            if not np.isfinite(waypoints).all() or (np.diff(waypoints[:, :, 0]) <= 0.0).any():
                raise ValueError("Obstacles.waypoints must be finite, with ascending times.")
            waypoints.setflags(write=False)
            object.__setattr__(self, "waypoints", waypoints)

    def __len__(self) -> int:
        return len(self.radii)

    @cached_property
    def moving(self) -> bool:
        """Whether any obstacle ever moves."""
        if self.waypoints is not None:
            return bool(np.any(np.diff(self.waypoints[:, :, 1:], axis=1)))
        return bool(np.any(self.velocities))

    def centres_at(self, times: ArrayLike) -> FloatArray:
        """``(..., M, 2)`` centres in m at ``times`` ``(...)`` in s."""
        assert self.velocities is not None
        times = np.asarray(times, dtype=np.float64)
        if self.waypoints is None:
            return self.centres + times[..., None, None] * self.velocities
        centres = np.empty((*times.shape, len(self), 2))
        for index, track in enumerate(self.waypoints):
            for axis in range(2):
                centres[..., index, axis] = np.interp(times, track[:, 0], track[:, 1 + axis])
        return centres

    def after(self, time: float) -> Obstacles:
        """The obstacles ``time`` seconds later."""
        if self.waypoints is None:
            return Obstacles(self.centres_at(time), self.radii, self.velocities)
        return Obstacles.along(self.waypoints - [time, 0.0, 0.0], self.radii)

    @classmethod
    def along(cls, waypoints: ArrayLike, radii: ArrayLike) -> Obstacles:
        """Obstacles that move along waypoints.

        Args:
            waypoints: ``(M, K, 3)`` rows ``(time, x, y)`` in s, m, m.
            radii: ``(M,)`` radii in m.
        """
        table, radii = np.asarray(waypoints, dtype=np.float64), np.asarray(radii, dtype=np.float64)
        still = cls(np.zeros((radii.size, 2)), radii, waypoints=table)
        now, soon = still.centres_at(0.0), still.centres_at(1e-6)
        return cls(now, radii, np.round((soon - now) / 1e-6, 9), table)

    @classmethod
    def from_rows(cls, rows: ArrayLike) -> Obstacles:
        """Obstacles from rows ``(x, y, radius)`` or ``(x, y, radius, v_x, v_y)``.

        Rows of radius zero are padding.
        """
        table = np.asarray(rows, dtype=np.float64)
        table = table.reshape(-1, table.shape[-1] if table.size else 3)
        if table.shape[1] not in (3, 5):
            raise ValueError(
                "A row of obstacles is (x, y, radius) or (x, y, radius, v_x, v_y), "
                f"got {table.shape[1]} numbers."
            )
        table = table[table[:, 2] != 0.0]
        return cls(table[:, :2], table[:, 2], table[:, 3:] if table.shape[1] == 5 else None)

    def rows(self) -> FloatArray:
        """``(M, 3)`` rows ``(x, y, radius)``; ``(M, 5)`` with velocities if anything moves."""
        assert self.velocities is not None
        table = np.column_stack([self.centres, self.radii])
        return np.hstack([table, self.velocities]) if self.moving else table


def _default_obstacles() -> Obstacles:
    return SCENES["nominal"]


@dataclass(frozen=True, eq=False)
class Scenario:
    """The table, its obstacles and the robot.

    Attributes:
        obstacles: The discs on the table.
        robot: The robot.
        table: Size of the table ``(x, y)`` in m; its lower left corner is the origin.
        dt: Step of the optimal control problem in s.
        keep_out_factor: The keep-out radius is ``(R_obstacle + R_robot) * keep_out_factor``.
    """

    obstacles: Obstacles = field(default_factory=_default_obstacles)
    robot: Robot = field(default_factory=Robot)
    table: tuple[float, float] = (3.5, 2.5)
    dt: float = 0.5
    keep_out_factor: float = 1.1

    def __post_init__(self) -> None:
        object.__setattr__(self, "table", tuple(float(side) for side in self.table))
        if not all(np.isfinite(side) and side > 2 * self.robot.radius for side in self.table):
            raise ValueError(
                f"Scenario.table must be wider than the robot (2 x {self.robot.radius} m) "
                f"in both directions, got {self.table}."
            )
        if not (np.isfinite(self.dt) and self.dt > 0.0):
            raise ValueError(f"Scenario.dt must be positive, got {self.dt}.")
        if not (np.isfinite(self.keep_out_factor) and self.keep_out_factor >= 1.0):
            raise ValueError(
                f"Scenario.keep_out_factor must be at least 1, got {self.keep_out_factor}."
            )

    @cached_property
    def keep_out_radii(self) -> FloatArray:
        """``(M,)`` radii in m that the robot's centre stays out of."""
        return _read_only((self.obstacles.radii + self.robot.radius) * self.keep_out_factor)

    @cached_property
    def position_limits(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper limit ``(2,)`` of the robot's centre in m."""
        margin = self.robot.radius
        return _read_only(np.full(2, margin)), _read_only(np.asarray(self.table) - margin)

    @classmethod
    def named(cls, name: str) -> Scenario:
        """The scenario of one of the paper's scenes.

        Raises:
            ValueError: If there is no such scene; the message names the nearest one.
        """
        if name not in SCENES:
            near = difflib.get_close_matches(name, SCENES, n=1)
            hint = f" Did you mean {near[0]!r}?" if near else ""
            raise ValueError(f"No scene is called {name!r}.{hint} Known: {', '.join(SCENES)}.")
        return cls(obstacles=SCENES[name])


def _read_only(array: FloatArray) -> FloatArray:
    array.setflags(write=False)
    return array


@dataclass(frozen=True, eq=False)
class Problem:
    """One trajectory optimisation problem: from ``start`` to ``goal`` in ``final_time`` seconds.

    Attributes:
        scenario: Table, obstacles and robot.
        start: ``(6,)`` state at time zero, SI units, global frame.
        goal: ``(6,)`` state after the last impulse. Headings are not periodic: the shortest turn is
            asked for by a goal heading within pi of the start's (see :func:`unwrap_goal`).
        final_time: Final time in s, a whole number (at least two) of steps ``dt``.

    Raises:
        ValueError: On a wrong shape, a value that is not finite, or a final time that does not fit.
            What only makes a well-formed problem unsolvable is told by :meth:`defects`.
    """

    scenario: Scenario
    start: FloatArray
    goal: FloatArray
    final_time: float = 40.0

    def __post_init__(self) -> None:
        for name in ("start", "goal"):
            value = np.array(getattr(self, name), dtype=np.float64)
            if value.shape != (6,):
                raise ValueError(
                    f"Problem.{name} must be a state of 6 numbers {STATE_NAMES}, "
                    f"got shape {value.shape}."
                )
            if not np.isfinite(value).all():
                bad = STATE_NAMES[int(np.argmin(np.isfinite(value)))]
                raise ValueError(f"Problem.{name} must be finite; {bad} is {value.tolist()}.")
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        dt = self.scenario.dt
        steps = self.final_time / dt
        if not np.isfinite(steps) or steps < 2 or abs(steps - round(steps)) > 1e-6:
            raise ValueError(
                f"Problem.final_time must be a multiple of dt = {dt} s, at least {2 * dt} s; "
                f"got {self.final_time} s."
            )

    @property
    def n_steps(self) -> int:
        """Number ``N`` of controls."""
        return round(self.final_time / self.scenario.dt)

    @cached_property
    def node_times(self) -> FloatArray:
        """``(N + 1,)`` times of the states in s; the last impulse takes no time."""
        step = np.minimum(np.arange(self.n_steps + 1), self.n_steps - 1)
        return _read_only(self.scenario.dt * step)

    def defects(self) -> list[str]:
        """Why no trajectory can solve this problem, one line per reason; empty if none is seen."""
        return list(self._defects)

    @cached_property
    def _defects(self) -> tuple[str, ...]:
        lines = []
        low, high = self.scenario.position_limits
        times = self.node_times[[0, -1]]
        for name, state, time in zip(("start", "goal"), (self.start, self.goal), times):
            position = state[:2]
            if (position < low - _ON_BOUNDARY).any() or (position > high + _ON_BOUNDARY).any():
                lines.append(
                    f"the {name} ({position[0]:.3f}, {position[1]:.3f}) m is off the table: the "
                    f"centre must stay in x [{low[0]:g}, {high[0]:g}], "
                    f"y [{low[1]:g}, {high[1]:g}] m"
                )
            centres = self.scenario.obstacles.centres_at(time)
            gaps = np.linalg.norm(position - centres, axis=1)
            for index, (gap, radius) in enumerate(zip(gaps, self.scenario.keep_out_radii)):
                if gap < radius - _ON_BOUNDARY:
                    lines.append(
                        f"the {name} is inside the keep-out zone of obstacle {index}: {gap:.3f} m "
                        f"from its centre, at least {radius:.3f} m needed; move one of them"
                    )
        return tuple(lines)

    def require_valid(self) -> Problem:
        """Returns itself, or raises a ``ValueError`` with the :meth:`defects` in one line."""
        if defects := self.defects():
            raise ValueError(f"Invalid problem: {'; '.join(defects)}.")
        return self

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and lists, for JSON; robot, table and step are not among them."""
        obstacles = self.scenario.obstacles
        data = {
            "start": self.start.tolist(),
            "goal": self.goal.tolist(),
            "obstacles": obstacles.rows().tolist(),
            "final_time": float(self.final_time),
        }
        if obstacles.waypoints is not None:
            data["waypoints"] = obstacles.waypoints.tolist()
        return data

    @classmethod
    def from_dict(cls, data: Mapping[str, Any], scenario: Scenario | None = None) -> Problem:
        """Problem from a mapping with ``start``, ``goal``, ``obstacles`` and ``final_time``.

        With ``waypoints`` too, the obstacles move along them (see :class:`Obstacles`).

        Args:
            data: As :meth:`to_dict` gives it; an environment's first observation (with
                ``state`` and ``time_to_go``) will do too.
            scenario: Supplies robot, table and step; its obstacles are replaced.
        """
        data = dict(data)
        known = {"start", "goal", "obstacles", "final_time", "waypoints", "state", "time_to_go"}
        known |= {"image", "lidar"}  # of an observation
        if unknown := sorted(set(data) - known):
            raise ValueError(f"A problem has no {unknown}; it has {sorted(known)}.")
        if "state" in data and "time_to_go" in data:
            data["start"] = data.pop("state")
            data["final_time"] = float(np.asarray(data.pop("time_to_go")).item())
        missing = {"start", "goal", "obstacles", "final_time"} - set(data)
        if missing:
            raise ValueError(f"A problem needs {sorted(missing)} too; got {sorted(data)}.")
        try:
            obstacles = Obstacles.from_rows(data["obstacles"])
            if "waypoints" in data:
                obstacles = Obstacles.along(data["waypoints"], obstacles.radii)
            scenario = replace(scenario or Scenario(), obstacles=obstacles)
            return cls(scenario, data["start"], data["goal"], float(data["final_time"]))
        except TypeError as error:
            raise ValueError(f"A problem holds numbers and lists of numbers: {error}.") from None


def unwrap_goal(start: FloatArray, goal: FloatArray) -> FloatArray:
    """The goal with its heading moved by whole turns to within pi of the start's."""
    goal = np.array(goal, dtype=np.float64)
    turn = goal[2] - start[2]
    goal[2] = start[2] + (turn + np.pi) % (2 * np.pi) - np.pi
    return goal


#: The paper's scenes by name: the nominal one, the 15 of ART-15s, the three held out for tests.
SCENES: dict[str, Obstacles] = {
    "nominal": Obstacles.from_rows(NOMINAL),
    **{f"training-{i}": Obstacles.from_rows(rows) for i, rows in enumerate(TRAINING, 1)},
    **{f"held-out-{i}": Obstacles.from_rows(rows) for i, rows in enumerate(HELD_OUT, 1)},
}

#: Scenarios of the 15 training scenes of ART-15s, and of the three test scenes.
TRAINING_SCENES = tuple(Scenario.named(f"training-{i}") for i in range(1, len(TRAINING) + 1))
HELD_OUT_SCENES = tuple(Scenario.named(f"held-out-{i}") for i in range(1, len(HELD_OUT) + 1))
