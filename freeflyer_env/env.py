"""``FreeFlyer-v0``: the environment."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from freeflyer_env.control import PulseWidthModulator
from freeflyer_env.physics import World
from freeflyer_env.robot import FloatArray, Robot, body_from_world
from freeflyer_env.scenario import Obstacles, Problem, Scenario, sample_problem
from freeflyer_env.spaces import (
    ACTION_MODES,
    action_space,
    observation_space,
    obstacle_rows,
    require_fit,
)

#: One period of the pulse-width modulation in s (10 Hz), the control step of the thruster modes.
PWM_PERIOD = 0.1

# Impulses this much over the thrusters' reach still pass: plans are exact to a solver's tolerance
# only, and have to be replayed exactly.
_REACH_TOLERANCE = 1e-3

_MAX_OBSTACLES = 4


class FreeFlyerEnv(gym.Env[dict[str, Any], Any]):
    """
    ## Description

    A spacecraft robot floats on an air table without friction. Eight on/off thrusters push and turn
    it; disc obstacles and the table's edges are in the way. It starts at rest on the left and has
    to be at rest in the goal pose on the right when the final time is over, with as little
    propellant as it can.

    It is the free-flyer testbed of Celestini et al., "Generalizable Spacecraft Trajectory
    Generation via Multimodal Learning with Transformers": mass 16 kg, inertia 0.18 kg m^2, radius
    0.15 m, thrust 0.2 N, table 3.5 m x 2.5 m. Contacts are real (pymunk); drift is exact. The
    thrusters are drawn in :mod:`freeflyer_env.robot`.

    ## Action Space

    `action_mode="delta_v"` (default): `Box(3)`, float32, the impulses of the optimal control
    problem, one every 0.5 s, global frame. Beyond the thrusters' reach they are scaled down (what
    is in reach depends on the heading; the bounds hold for the best one).

    | Num | Action                                   | Min       | Max      | Unit  |
    |-----|------------------------------------------|-----------|----------|-------|
    | 0   | impulse per unit mass along x            | -0.01768  | 0.01768  | m/s   |
    | 1   | impulse per unit mass along y            | -0.01768  | 0.01768  | m/s   |
    | 2   | angular impulse per unit mass, `J/m dw`  | -0.002866 | 0.002866 | m^2/s |

    `action_mode="thrusters"`: `Box(0, 1, (8,))`, float32, duty of each thruster over the next 0.1
    s, realised by pulse-width modulation: one pulse, a whole number of sub-steps (10 ms) long. What
    rounding leaves over is carried to the next step, so that small duties act on average.

    `action_mode="on_off"`: `MultiBinary(8)`, each thruster on or off for the next 0.1 s.

    ## Observation Space

    `Dict`, all float32, SI units, global frame:

    | Key          | Shape  | What                                                               |
    |--------------|--------|--------------------------------------------------------------------|
    | `state`      | (6,)   | `(r_x, r_y, psi, v_x, v_y, omega)`; the heading is not wrapped     |
    | `goal`       | (6,)   | the same of the goal                                               |
    | `obstacles`  | (M, 3) | `(x, y, radius)` of each disc; rows of zeros where there are fewer |
    | `time_to_go` | (1,)   | time left in s                                                     |

    ## Rewards

    `delta_v`: `-||u||_1` of the realised impulse, the negative of the paper's cost. Thruster modes:
    minus the thrust impulse per unit mass of all eight thrusters in m/s, the propellant; this is
    `||u||_1` for a push along a body axis, differs from it for other directions and turns, and
    counts thrusters that work against each other. On success `success_reward` is added.

    ## Starting State

    At rest, uniform over the start region (x from 0.15 m to 0.35 m, any y, any heading); the goal
    is in the opposite region (x from 3.15 m to 3.35 m). `reset(options={"problem": ...})` takes a
    `Problem`, or a mapping with `start`, `goal`, `obstacles` and `final_time`.

    ## Episode End

    Terminated on success: within `goal_tolerance` of the goal in position, heading (whole turns do
    not matter), speed and rate; at the final time only, if `terminate_early=False`. Truncated at
    the final time, or when the centre leaves the table, which only `contacts=False` makes possible.

    ## Info

    `is_success`, `goal_error` (position m, heading rad, speed m/s, rate rad/s), `cost` so far,
    `firing_time` of each thruster so far in s (for `delta_v` what the impulses would take),
    `contacts` of the last step (`count`, `impulse` in N s, `with`: obstacle indices and `"wall"`).

    ## Arguments

    * `action_mode`: see above.
    * `scenario`: `"random"` (new obstacles at every reset), the name of one of the paper's scenes
      (`freeflyer_env.SCENES`), rows `(x, y, radius)`, or a `Scenario`; all but the last can be
      stored in an environment's spec.
    * `final_time`: in s.
    * `success_reward`: added to the reward on success.
    * `terminate_early`: whether success ends the episode before the final time.
    * `goal_tolerance`: `(position m, heading rad, speed m/s, rate rad/s)`.
    * `sub_steps`: physics steps in a control step. In `delta_v` free flight does not depend on
      them; under thrust that turns with the robot the error is of second order in their length,
      and pulses are whole numbers of them. Contacts are found at their ends, after an overlap of
      up to one sub-step's motion (50 ms in `delta_v`).
    * `max_obstacles`: rows of the `obstacles` observation; default: the scene's, at least 4.
    * `restitution`, `friction`: of all contacts.
    * `contacts`: `False` lets the robot pass through obstacles and walls, as in the optimal control
      problem's model; relaxed trajectories replay exactly then.
    * `render_mode`: `"rgb_array"`. Ten frames a second are real time in the thruster modes, and
      five times as fast in `delta_v`.

    ## Version History

    * v0: initial version
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(
        self,
        action_mode: str = "delta_v",
        scenario: str | Scenario | list[list[float]] = "random",
        final_time: float = 40.0,
        success_reward: float = 1.0,
        terminate_early: bool = True,
        goal_tolerance: tuple[float, float, float, float] = (0.05, 0.1, 0.02, 0.05),
        sub_steps: int = 10,
        max_obstacles: int | None = None,
        restitution: float = 0.5,
        friction: float = 0.0,
        contacts: bool = True,
        render_mode: str | None = None,
    ) -> None:
        _require_choice("action_mode", action_mode, ACTION_MODES)
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}.")
        if sub_steps < 1:
            raise ValueError(f"sub_steps must be at least 1, got {sub_steps}.")
        if len(goal_tolerance) != 4 or not all(value > 0.0 for value in goal_tolerance):
            raise ValueError(f"goal_tolerance must be four positive numbers, got {goal_tolerance}.")
        self.action_mode, self.render_mode, self.sub_steps = action_mode, render_mode, sub_steps
        self.final_time, self.success_reward = float(final_time), float(success_reward)
        self.terminate_early, self.goal_tolerance = terminate_early, tuple(goal_tolerance)
        self.restitution, self.friction, self.contacts = restitution, friction, contacts
        self._fixed_scenario = _scenario(scenario)
        self._base = base = self._fixed_scenario or Scenario()
        n_obstacles = len(base.obstacles) if self._fixed_scenario else _MAX_OBSTACLES
        self.max_obstacles = max(n_obstacles, _MAX_OBSTACLES)
        if max_obstacles is not None:
            if max_obstacles < n_obstacles and self._fixed_scenario:
                raise ValueError(
                    f"max_obstacles must be at least the scene's {n_obstacles}, "
                    f"got {max_obstacles}."
                )
            self.max_obstacles = max_obstacles
        self.control_dt = base.dt if action_mode == "delta_v" else PWM_PERIOD
        self.action_space = action_space(action_mode, base.robot, base.dt)
        self.observation_space: spaces.Dict = observation_space(base, self.max_obstacles)
        self._modulator = PulseWidthModulator(sub_steps)
        self._plan: FloatArray | None = None
        self._world: World | None = None
        self._step_count = 0
        # A problem to show before the first reset, and an early error for arguments that are wrong.
        self.problem = self._sample_problem(np.random.default_rng(0))
        require_fit(self.problem, base, self.observation_space)
        self._make_world()

    @property
    def scenario(self) -> Scenario:
        """The present problem's scenario."""
        return self.problem.scenario

    @property
    def robot(self) -> Robot:
        """The robot."""
        return self.problem.scenario.robot

    @property
    def state(self) -> FloatArray:
        """True state ``(6,)``, float64, a fresh array."""
        return self._require_world().state

    @property
    def time(self) -> float:
        """Time since the last reset in s."""
        return self._step_count * self.control_dt

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Starts an episode.

        Args:
            seed: Seeds the random problems.
            options: ``{"problem": ...}`` sets the problem: a ``Problem``, or a mapping as
                ``Problem.to_dict`` gives it (an observation from the start of an episode will do).

        Raises:
            ValueError: If the problem is invalid; the message says why in one line.
        """
        super().reset(seed=seed)
        options = options or {}
        if unknown := sorted(set(options) - {"problem"}):
            raise ValueError(f"reset() knows only the option 'problem', got {unknown}.")
        self.problem = self._make_problem(options.get("problem"))
        self._constants = {
            "goal": np.float32(self.problem.goal),
            "obstacles": obstacle_rows(self.problem, self.max_obstacles),
        }
        self._world = self._make_world()
        self._world.state = self.problem.start
        self._modulator.reset()
        self._plan, self._duties = None, np.zeros(8)
        self._step_count, self._cost, self._firing_time = 0, 0.0, np.zeros(8)
        self._ended = False
        self._n_steps = math.ceil(self.problem.final_time / self.control_dt - 1e-6)
        self._flown = [self.problem.start[:2]]
        state = self._world.state
        return self._observation(state), self._info(state)

    def step(
        self, action: NDArray[Any]
    ) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Applies an action for one control step."""
        world = self._require_world()
        action = np.asarray(action)
        if action.shape != self.action_space.shape or not np.isfinite(action).all():
            raise ValueError(
                f"An action of mode {self.action_mode!r} must be {self.action_space.shape} finite "
                f"numbers, got {action.tolist()}."
            )
        if self._ended:
            gym.logger.warn("step() was called after the episode's end; call reset() first.")
        effort = self._act(world, action.astype(np.float64))
        self._cost += effort
        self._step_count += 1
        state = world.state
        self._flown.append(state[:2])
        info = self._info(state)
        at_end = self._step_count >= self._n_steps
        terminated = bool(info["is_success"] and (at_end or self.terminate_early))
        truncated = not terminated and (at_end or self._off_table(state))
        reward = -effort + (self.success_reward if terminated and not self._ended else 0.0)
        self._ended = self._ended or terminated or truncated
        return self._observation(state), reward, terminated, truncated, info

    def render(self) -> NDArray[np.uint8] | None:
        """The scene as ``(H, W, 3)`` uint8, with planned and flown path."""
        if self.render_mode is None:
            gym.logger.warn("render() needs render_mode: gym.make(..., render_mode='rgb_array').")
            return None
        from freeflyer_env.rendering import draw_scene

        return draw_scene(
            self.scenario,
            self.state[:3],
            start=self.problem.start[:3],
            goal=self.problem.goal[:3],
            duties=self._duties,
            planned=self._plan,
            flown=np.array(self._flown),
            time=self.time,
        )

    def set_plan(self, states: FloatArray | None) -> None:
        """Shows the positions of the states ``(N, 6)`` as planned path; forgotten at reset."""
        self._plan = None if states is None else np.array(states, dtype=np.float64)[:, :2]

    def push(self, velocity_change: FloatArray) -> None:
        """Changes ``(v_x, v_y, omega)`` by ``(3,)`` m/s, m/s, rad/s at once, as a bump does."""
        change = np.asarray(velocity_change, dtype=np.float64)
        if change.shape != (3,) or not np.isfinite(change).all():
            raise ValueError(f"A push is three finite numbers, got {velocity_change}.")
        self._require_world().kick(change)

    def _act(self, world: World, action: FloatArray) -> float:
        """Applies the action, advances the world, returns the effort in m/s."""
        robot, period = self.robot, self.control_dt
        if self.action_mode == "delta_v":
            body = body_from_world(world.state[2], action)
            excess = float(robot.reach(body, period))
            if excess > 1.0 + _REACH_TOLERANCE:
                action, body = action / excess, body / excess
            self._duties = robot.allocate(body * robot.mass / period)
            self._firing_time += self._duties * period
            world.kick(action * robot.control_gain)
            world.advance(period, self.sub_steps)
            return float(np.abs(action).sum())
        if self.action_mode == "thrusters":
            pulses = self._modulator.pulses(action)
        else:
            pulses = np.broadcast_to(action > 0.5, (self.sub_steps, 8))
        wrenches = pulses @ robot.wrench_matrix.T
        world.advance(period, self.sub_steps, wrenches)
        self._duties = pulses.mean(axis=0)
        self._firing_time += self._duties * period
        return float(robot.thrust / robot.mass * self._duties.sum() * period)

    def _make_problem(self, given: Any) -> Problem:
        if given is None:
            return self._sample_problem(self.np_random)
        if not isinstance(given, (Problem, Mapping)):
            raise ValueError(
                f"A problem must be a Problem or a mapping, got {type(given).__name__}."
            )
        problem = given if isinstance(given, Problem) else Problem.from_dict(given, self._base)
        require_fit(problem.require_valid(), self._base, self.observation_space)
        return problem

    def _sample_problem(self, rng: np.random.Generator) -> Problem:
        n_obstacles = min(self.max_obstacles, _MAX_OBSTACLES)
        return sample_problem(rng, self._fixed_scenario, self.final_time, n_obstacles=n_obstacles)

    def _observation(self, state: FloatArray) -> dict[str, Any]:
        box: Any = self.observation_space["state"]
        time_to_go = max(self.problem.final_time - self.time, 0.0)
        return {
            "state": np.minimum(np.maximum(np.float32(state), box.low), box.high),
            **{key: value.copy() for key, value in self._constants.items()},
            "time_to_go": np.array([time_to_go], dtype=np.float32),
        }

    def _off_table(self, state: FloatArray) -> bool:
        """Whether the centre has left the table, as it can where there are no contacts."""
        (x, y), (width, height) = state[:2].tolist(), self._base.table
        return not self.contacts and not (0.0 <= x <= width and 0.0 <= y <= height)

    def _info(self, state: FloatArray) -> dict[str, Any]:
        x, y, psi, v_x, v_y, omega = (state - self.problem.goal).tolist()
        error = (
            math.hypot(x, y),
            abs((psi + math.pi) % (2.0 * math.pi) - math.pi),
            math.hypot(v_x, v_y),
            abs(omega),
        )
        return {
            "is_success": all(e <= t for e, t in zip(error, self.goal_tolerance)),
            "goal_error": error,
            "cost": self._cost,
            "firing_time": self._firing_time.copy(),
            "contacts": self._require_world().take_contacts().to_info(),
        }

    def _make_world(self) -> World:
        return World(self.scenario, self.restitution, self.friction, solid=self.contacts)

    def _require_world(self) -> World:
        if self._world is None:
            raise gym.error.ResetNeeded("Call reset() before step() or render().")
        return self._world


def _scenario(given: str | Scenario | list[list[float]]) -> Scenario | None:
    if isinstance(given, Scenario):
        return given
    if not isinstance(given, str):
        return replace(Scenario(), obstacles=Obstacles.from_rows(given))
    return None if given == "random" else Scenario.named(given)


def _require_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        near = difflib.get_close_matches(str(value), choices, n=1)
        hint = f" Did you mean {near[0]!r}?" if near else ""
        raise ValueError(f"{name} must be one of {choices}, got {value!r}.{hint}")
