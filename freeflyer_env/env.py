"""``FreeFlyer-v0``: the environment. The docstring of the class is its page, hence the length."""

from __future__ import annotations

import copy
import math
import operator
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from freeflyer_env.control import PulseWidthModulator
from freeflyer_env.disturbances import Disturbances, Plant
from freeflyer_env.physics import World
from freeflyer_env.robot import FloatArray, Robot
from freeflyer_env.sampling import sample_problem
from freeflyer_env.scenario import Obstacles, Problem, Scenario
from freeflyer_env.sensors import lidar_angles, top_view
from freeflyer_env.spaces import (
    ACTION_MODES,
    LIDAR_REACH,
    MAX_OBSTACLE_SPEED,
    MODALITIES,
    action_space,
    observation_space,
    obstacle_rows,
    require_choice,
    require_fit,
    require_integer,
    require_number,
)

#: One period of the pulse-width modulation in s (10 Hz), the control step of the thruster modes.
PWM_PERIOD = 0.1

#: Names of the rewards; see :class:`FreeFlyerEnv`.
REWARDS = ("paper", "dense")

#: Weights of the errors in position, heading, speed and rate in the dense reward, in 1/m, 1/rad ...
ERROR_WEIGHTS = (1.0, 0.2, 2.0, 0.2)

#: Impulses this much over the thrusters' reach still pass: plans are exact to a solver's tolerance
#: only, and have to be replayed exactly.
REACH_TOLERANCE = 1e-3

_MAX_OBSTACLES = 4

# What an episode changes.
_EPISODE = (
    *("problem", "_world", "_modulator", "_pending", "_plan", "_duties", "_flown", "_ended"),
    *("_step_count", "_n_steps", "_cost", "_firing_time", "_goal", "_aim", "_rows", "_measured"),
    *("_potential", "_np_random", "_np_random_seed"),
)


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

    The global frame has its origin in the table's lower left corner, x to the right, y up; headings
    and rates are positive counter-clockwise. The state is that of the hull's centre.

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
    s, realised by pulse-width modulation: one pulse, a whole number of sub-steps long. What
    rounding leaves over is carried to the next step, so that small duties act on average.

    `action_mode="on_off"`: `MultiBinary(8)`, each thruster on or off for the next 0.1 s.

    | Num | Thruster pushes (body frame) | Turns | Num | Thruster pushes | Turns |
    |-----|------------------------------|-------|-----|-----------------|-------|
    | 0   | -y                           | -     | 4   | +y              | -     |
    | 1   | -x                           | +     | 5   | +x              | +     |
    | 2   | +x                           | -     | 6   | -x              | -     |
    | 3   | -y                           | +     | 7   | +y              | +     |

    ## Observation Space

    `Dict`, float32 but for the image, SI units, global frame:

    | Key          | Modalities       | Shape     | What                                         |
    |--------------|------------------|-----------|----------------------------------------------|
    | `state`      | `state`, `robot` | (6,)      | `(r_x, r_y, psi, v_x, v_y, omega)`, measured |
    | `goal`       | `state`, `robot` | (6,)      | the same of the goal                         |
    | `time_to_go` | `state`, `robot` | (1,)      | time left in s                               |
    | `obstacles`  | `state`          | (M, 3)    | `(x, y, radius)` of each disc; zeros: none   |
    | `image`      | `image`          | (H, W, 3) | uint8, the table seen from above             |
    | `lidar`      | `lidar`          | (n,)      | distance in m from the robot's centre to     |
    |              |                  |           | what is there, anticlockwise from ahead      |

    Headings are not wrapped. Where obstacles move, their rows go on with `(v_x, v_y)`.
    `freeflyer_env.spaces.obstacle_mask` tells obstacles from padding.

    ## Rewards

    `reward="paper"` (default). `delta_v`: `-||u||_1` of the realised impulse, the negative of the
    paper's cost. Thruster modes: minus the thrust impulse per unit mass of all eight thrusters in
    m/s, the propellant; this is `||u||_1` for a push along a body axis, differs from it for other
    directions and turns, and counts thrusters that work against each other. On success
    `success_reward` is added.

    `reward="dense"` adds by how much the weighted error to the goal fell, 1 per m, 0.2 per rad, 2
    per m/s and 0.2 per rad/s: over an episode, the error at the start minus that at the end.

    Costs are those of the commands at nominal thrust, whatever disturbs the thrusters.

    ## Starting State

    At rest, uniform over the start region (x from 0.15 m to 0.35 m, any y, any heading); the goal
    is in the opposite region (x from 3.15 m to 3.35 m). `reset(options={"problem": ...})` takes a
    `Problem`, or a mapping with `start`, `goal`, `obstacles` and `final_time`.

    ## Episode End

    Terminated on success: within `goal_tolerance` of the goal in position, heading (whole turns do
    not matter), speed and rate; at the final time only, if `terminate_early=False`. Terminated on
    the first contact, if `terminate_on_contact=True`. Truncated at the final time, or when the
    centre leaves the table, as it can with `contacts=False`, or if something pushes it through a
    wall within one sub-step.

    ## Info

    `is_success`, `goal_error` (position m, heading rad, speed m/s, rate rad/s), `cost` so far,
    `fuel` so far (thrust impulse of all thrusters in N s), `firing_time` of each thruster so far in
    s (for `delta_v` what the impulses would take), `contacts` of the last step (`count`, `impulse`
    in N s, `with`: obstacle indices and `"wall"`). Errors and contacts are true, whatever is
    measured; cost and fuel are at nominal thrust, and a failed thruster does not fire.

    ## Arguments

    * `action_mode`: see above.
    * `observation`: a modality or several: `"state"`, `"robot"` (without the obstacles), `"image"`,
      `"lidar"`; for example `("robot", "lidar")`.
    * `scenario`: `"random"` (new obstacles at every reset), the name of one of the paper's scenes
      (`freeflyer_env.SCENES`), rows `(x, y, radius)` or `(x, y, radius, v_x, v_y)`, or a
      `Scenario`; all but the last can be stored in an environment's spec.
    * `n_obstacles`: of random scenes, a number or the range `(least, most)`; default 4.
    * `obstacle_speed`: largest speed in m/s of the obstacles of random scenes.
    * `final_time`: in s, a multiple of 0.5 s in every action mode.
    * `reward`: `"paper"` or `"dense"`.
    * `success_reward`: added to the reward on success.
    * `terminate_early`: whether success ends the episode before the final time.
    * `terminate_on_contact`: whether a contact ends it, without the reward of a success.
    * `goal_tolerance`: `(position m, heading rad, speed m/s, rate rad/s)`.
    * `sub_steps`: physics steps in a control step. In `delta_v` free flight does not depend on
      them; under thrust that turns with the robot the error is of second order in their length,
      and pulses are whole numbers of them. Contacts are found at their ends (with ten, every 50
      ms in `delta_v` and every 10 ms in the thruster modes); what is thinner than the motion of one
      sub-step can be missed.
    * `max_obstacles`: rows of the `obstacles` observation; default: the scene's, at least 4.
    * `moving_obstacles`: whether rows of `obstacles` have velocities; default: if any can move.
    * `restitution`, `friction`: of all contacts.
    * `contacts`: `False` lets the robot pass through obstacles and walls, as in the optimal control
      problem's model; relaxed trajectories replay exactly then.
    * `disturbances`: `"testbed"`, a mapping or a `freeflyer_env.disturbances.Disturbances`: noise
      of the measurements, a tilted table, thrusters, mass and centre of mass that are not as
      assumed, delay. None by default.
    * `image_size`: `(H, W)` in pixels; `lidar_rays`: number of rays.
    * `render_mode`: `"rgb_array"` or `"human"` (a window). Ten frames a second are real time in the
      thruster modes, and five times as fast in `delta_v`.

    `save()` and `restore()` take an episode back to where it was, bit for bit; `copy.deepcopy` and
    pickle work at any moment. The vector form, `gym.make_vec("FreeFlyer-v0", num_envs=1024,
    vectorization_mode="vector_entry_point")`, is one NumPy batch.

    ## Version History

    * v0: initial version
    """

    metadata = {"render_modes": ["rgb_array", "human"], "render_fps": 10}  # noqa: RUF012

    def __init__(
        self,
        action_mode: str = "delta_v",
        observation: str | Sequence[str] = "state",
        scenario: str | Scenario | list[list[float]] = "random",
        n_obstacles: int | tuple[int, int] | None = None,
        obstacle_speed: float = 0.0,
        final_time: float = 40.0,
        reward: str = "paper",
        success_reward: float = 1.0,
        terminate_early: bool = True,
        terminate_on_contact: bool = False,
        goal_tolerance: tuple[float, float, float, float] = (0.05, 0.1, 0.02, 0.05),
        sub_steps: int = 10,
        max_obstacles: int | None = None,
        moving_obstacles: bool | None = None,
        restitution: float = 0.5,
        friction: float = 0.0,
        contacts: bool = True,
        disturbances: Disturbances | str | Mapping[str, Any] | None = None,
        image_size: tuple[int, int] = (80, 112),
        lidar_rays: int = 32,
        render_mode: str | None = None,
    ) -> None:
        arguments = {name: repr(value) for name, value in locals().items() if name != "self"}
        self._made = {**arguments, "render_mode": ""}  # what snapshots have to agree in
        require_choice("action_mode", action_mode, ACTION_MODES)
        require_choice("reward", reward, REWARDS)
        self.modalities = (
            (observation,) if isinstance(observation, str) else tuple(observation or ())
        )
        for modality in self.modalities or ("none",):
            require_choice("observation", modality, MODALITIES)
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(
                f"render_mode must be None, 'rgb_array' or 'human', got {render_mode!r}."
            )
        for name, count in (("sub_steps", sub_steps), ("lidar_rays", lidar_rays)):
            require_integer(name, count, 1)
        if max_obstacles is not None:
            require_integer("max_obstacles", max_obstacles, 0)
        for name, flag in (
            ("terminate_early", terminate_early),
            ("terminate_on_contact", terminate_on_contact),
            ("contacts", contacts),
        ):
            if not isinstance(flag, bool | np.bool_):
                raise ValueError(f"{name} must be True or False, got {flag!r}.")
        for name, number in (
            ("final_time", final_time),
            ("success_reward", success_reward),
            ("obstacle_speed", obstacle_speed),
        ):
            require_number(name, number)
        size: Any = image_size
        if np.shape(size) != (2,) or not all(isinstance(n, int | np.integer) for n in size):
            raise ValueError(f"image_size must be (height, width) in pixels, got {image_size!r}.")
        if min(image_size) < 8:
            raise ValueError(f"image_size must be at least 8 pixels each, got {image_size}.")
        if np.shape(goal_tolerance) != (4,) or not all(value > 0.0 for value in goal_tolerance):
            raise ValueError(
                f"goal_tolerance must be four positive numbers, got {goal_tolerance!r}."
            )
        if not 0.0 <= obstacle_speed <= MAX_OBSTACLE_SPEED:
            raise ValueError(
                f"obstacle_speed must be in [0, {MAX_OBSTACLE_SPEED:g}] m/s, got {obstacle_speed}."
            )
        self.action_mode, self.render_mode, self.sub_steps = action_mode, render_mode, sub_steps
        self.final_time, self.reward = float(final_time), reward
        self.success_reward, self.goal_tolerance = float(success_reward), tuple(goal_tolerance)
        self.terminate_early, self.terminate_on_contact = terminate_early, terminate_on_contact
        self.restitution, self.friction, self.contacts = restitution, friction, contacts
        self.disturbances = Disturbances.of(disturbances)
        is_counted = n_obstacles is not None
        if n_obstacles is None:
            n_obstacles = (
                _MAX_OBSTACLES if max_obstacles is None else min(max_obstacles, _MAX_OBSTACLES)
            )
        self.obstacle_speed, self.n_obstacles = float(obstacle_speed), _obstacle_range(n_obstacles)
        self.fixed_scenario = _scenario(scenario)
        if self.fixed_scenario is not None and (obstacle_speed or is_counted):
            raise ValueError(
                "n_obstacles and obstacle_speed are for scenario='random' only; leave them out."
            )
        self.base_scenario = base = self.fixed_scenario or Scenario()
        most = len(base.obstacles) if self.fixed_scenario else self.n_obstacles[1]
        self.max_obstacles = max(most, _MAX_OBSTACLES) if max_obstacles is None else max_obstacles
        if self.max_obstacles < most:
            raise ValueError(
                f"max_obstacles must be at least the scene's {most}, got {max_obstacles}."
            )
        if moving_obstacles is None:
            moving_obstacles = bool(
                base.obstacles.moving if self.fixed_scenario else self.obstacle_speed
            )
        self.moving_obstacles = moving_obstacles
        self.control_dt = base.dt if action_mode == "delta_v" else PWM_PERIOD
        self.action_space = action_space(action_mode, base.robot, base.dt)
        self._action_shape: Any = self.action_space.shape
        sizes: dict[str, Any] = {
            "moving": moving_obstacles,
            "image_size": image_size,
            "lidar_rays": lidar_rays,
        }
        self.observation_space: spaces.Dict = observation_space(
            base, self.max_obstacles, self.modalities, **sizes
        )
        self.limits = observation_space(base, self.max_obstacles, **sizes)
        low, high = (getattr(self.limits["state"], name).tolist() for name in ("low", "high"))
        self._state_limits = list(zip(low, high))
        self._keys, self._thrust = tuple(self.observation_space), base.robot.thrust
        self._rays, self._image_size = lidar_angles(lidar_rays), image_size
        self._modulator = self._make_modulator()
        self._plan: FloatArray | None = None
        self._world: World | None = None
        self._window: Any = None
        self._step_count = 0
        # A problem to show before the first reset, and an early error for arguments that are wrong.
        self.problem = self._sample_problem(np.random.default_rng(0))
        require_fit(self.problem, base, self.limits)
        self._make_world(None)

    @property
    def scenario(self) -> Scenario:
        """The present problem's scenario."""
        return self.problem.scenario

    @property
    def robot(self) -> Robot:
        """The robot, as it is assumed to be."""
        return self.problem.scenario.robot

    @property
    def state(self) -> FloatArray:
        """True state ``(6,)``, float64, a fresh array."""
        return self._require_world().state

    @property
    def measured_state(self) -> FloatArray:
        """State ``(6,)`` as last measured, float64, a fresh array; true without noise."""
        self._require_world()
        return np.array(self._measured)

    @property
    def time(self) -> float:
        """Time since the last reset in s."""
        return self._step_count * self.control_dt

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Starts an episode.

        Args:
            seed: Seeds the random problems and disturbances.
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
        self._goal = np.float32(self.problem.goal)
        self._aim = self.problem.goal.tolist()
        self._rows = obstacle_rows(
            self.problem.scenario.obstacles, self.max_obstacles, self.moving_obstacles
        )
        plant = None
        if self.disturbances.any_plant:
            plant = self.disturbances.sample(self.robot, self.np_random)
        self._world = self._make_world(plant)
        self._world.state = self.problem.start
        self._modulator.reset()
        self._pending: deque[Any] = deque(
            np.zeros(self._action_shape) for _ in range(self.disturbances.delay)
        )
        self._plan, self._duties = None, [0.0] * 8
        self._step_count, self._cost, self._firing_time = 0, 0.0, [0.0] * 8
        self._ended = False
        self._n_steps = math.ceil(self.problem.final_time / self.control_dt - 1e-6)
        self._flown = [tuple(self.problem.start[:2].tolist())]
        state = self._world.state_values()
        error = self._goal_error(state)
        self._potential = _potential(error)
        observation, info = self._observation(state), self._info(error)
        if self.render_mode == "human":
            self.render()
        return observation, info

    def step(
        self, action: NDArray[Any]
    ) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Applies an action for one control step."""
        world = self._require_world()
        action = np.asarray(action)
        if action.shape != self._action_shape or not math.isfinite(sum(action.tolist())):
            raise ValueError(
                f"An action of mode {self.action_mode!r} must be {self._action_shape} finite "
                f"numbers, got {action.tolist()}."
            )
        if self._ended:
            gym.logger.warn("step() was called after the episode's end; call reset() first.")
        if self._pending:
            self._pending.append(action.copy())  # the caller may reuse the array
            action = self._pending.popleft()
        effort = self._act(world, action)
        self._cost += effort
        self._step_count += 1
        state = world.state_values()
        self._flown.append((state[0], state[1]))
        error = self._goal_error(state)
        info = self._info(error)
        at_end = self._step_count >= self._n_steps
        success = bool(info["is_success"] and (at_end or self.terminate_early))
        crashed = self.terminate_on_contact and info["contacts"]["count"] > 0
        success = success and not crashed
        terminated = success or crashed
        truncated = not terminated and (at_end or self._off_table(state))
        reward = -effort + (self.success_reward if success and not self._ended else 0.0)
        if self.reward == "dense":
            before, self._potential = self._potential, _potential(error)
            reward += self._potential - before
        self._ended = self._ended or terminated or truncated
        observation = self._observation(state)
        if self.render_mode == "human":
            self.render()
        return observation, reward, terminated, truncated, info

    def render(self) -> NDArray[np.uint8] | None:
        """The scene as ``(H, W, 3)`` uint8, with planned and flown path; or in a window."""
        if self.render_mode is None:
            gym.logger.warn("render() needs render_mode: gym.make(..., render_mode='rgb_array').")
            return None
        from freeflyer_env.rendering import Window, draw_scene

        picture = draw_scene(
            replace(self.scenario, obstacles=self.scenario.obstacles.after(self.time))
            if self.scenario.obstacles.moving
            else self.scenario,
            self.state[:3],
            start=self.problem.start[:3],
            goal=self.problem.goal[:3],
            duties=self._duties,
            planned=self._plan,
            flown=np.array(self._flown),
            time=self.time,
        )
        if self.render_mode == "rgb_array":
            return picture
        if self._window is None:
            self._window = Window("FreeFlyer", self.metadata["render_fps"])
        self._window.show(picture)
        return None

    def close(self) -> None:
        """Closes the window, if there is one."""
        if self._window is not None:
            self._window.close()
            self._window = None

    def save(self) -> dict[str, Any]:
        """A snapshot of the episode, for :meth:`restore`; independent of what follows.

        Within a contact it takes as long as the contact has lasted: pymunk has to go through it
        again.
        """
        self._require_world()
        episode = copy.deepcopy({name: getattr(self, name) for name in _EPISODE})
        return {"made": self._made, **episode}

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Goes back to a snapshot of this environment, or of one that was made alike.

        From there the same actions lead to the same bits, random numbers included. An environment
        of ``gym.make`` has to be reset once before it steps.

        Raises:
            ValueError: If it is no snapshot, or one of an environment made with other arguments.
        """
        if set(snapshot) != {"made", *_EPISODE}:
            raise ValueError("restore() takes what save() gave.")
        if snapshot["made"] != self._made:
            raise ValueError(
                "restore() takes snapshots of an environment that was made with the same arguments."
            )
        for name, value in copy.deepcopy(snapshot).items():
            if name != "made":
                setattr(self, name, value)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_window": None}

    def set_plan(self, states: FloatArray | None) -> None:
        """Shows the positions of the states ``(N, 6)`` as planned path; forgotten at reset."""
        self._plan = None if states is None else np.array(states, dtype=np.float64)[:, :2]

    def push(self, velocity_change: FloatArray) -> None:
        """Changes ``(v_x, v_y, omega)`` by ``(3,)`` m/s, m/s, rad/s at once, as a bump does."""
        change = np.asarray(velocity_change, dtype=np.float64)
        if change.shape != (3,) or not np.isfinite(change).all():
            raise ValueError(f"A push is three finite numbers, got {velocity_change}.")
        self._require_world().kick(tuple(change.tolist()))

    def _act(self, world: World, action: NDArray[Any]) -> float:
        """Applies the action, advances the world, returns the effort in m/s."""
        if self.action_mode == "delta_v":
            return self._act_impulse(world, action.tolist())
        period, robot = self.control_dt, self.robot
        if self.action_mode == "thrusters":
            pulses = self._modulator.pulses(action.astype(np.float64))
        else:
            pulses = np.broadcast_to(action > 0.5, (self.sub_steps, 8))
        forces = pulses * world.plant.thrust_scale
        world.advance(period, self.sub_steps, forces @ robot.wrench_matrix.T)
        self._fire((pulses.sum(axis=0) / self.sub_steps).tolist())
        return robot.thrust / robot.mass * period * sum(self._duties)

    def _act_impulse(self, world: World, action: list[float]) -> float:
        robot, period, psi = self.robot, self.control_dt, world.heading
        ux, uy, turn = action
        cos, sin = math.cos(psi), math.sin(psi)
        body = (cos * ux + sin * uy, cos * uy - sin * ux, turn)
        excess = robot.reach_of_one(*body, period)
        if excess > 1.0 + REACH_TOLERANCE:
            ux, uy, turn = ux / excess, uy / excess, turn / excess
            body = (body[0] / excess, body[1] / excess, turn)
        force = robot.mass / period
        self._fire(robot.allocate_one(body[0] * force, body[1] * force, turn * force))
        if self.disturbances.any_plant:
            forces = np.array(self._duties) * world.plant.thrust_scale
            world.impulse(robot.wrench_matrix @ forces * period)
        else:
            world.kick((ux, uy, turn * robot.mass_over_inertia))
        world.advance(period, self.sub_steps)
        return abs(ux) + abs(uy) + abs(turn)

    def _fire(self, duties: list[float]) -> None:
        """Notes the duties of the last period; a thruster that has failed does not fire."""
        if self.disturbances.failed_thruster is not None:
            duties[self.disturbances.failed_thruster] = 0.0
        self._duties = duties
        dt = self.control_dt
        self._firing_time = [time + duty * dt for time, duty in zip(self._firing_time, duties)]

    def _make_problem(self, given: Any) -> Problem:
        if given is None:
            return self._sample_problem(self.np_random)
        if not isinstance(given, (Problem, Mapping)):
            raise ValueError(
                f"A problem must be a Problem or a mapping, got {type(given).__name__}."
            )
        problem = (
            given if isinstance(given, Problem) else Problem.from_dict(given, self.base_scenario)
        )
        require_fit(problem.require_valid(), self.base_scenario, self.limits)
        return problem

    def _sample_problem(self, rng: np.random.Generator) -> Problem:
        least, most = self.n_obstacles
        count = least
        if self.fixed_scenario is None and most > least:
            count = int(rng.integers(least, most + 1))
        return sample_problem(rng, self.fixed_scenario, self.final_time, count, self.obstacle_speed)

    def _observation(self, state: list[float]) -> dict[str, Any]:
        noise, values = self.disturbances, state
        if noise.any_noise:
            values = noise.measure(np.array(state), self.np_random).tolist()
        self._measured = values
        observation: dict[str, Any] = {}
        for key in self._keys:
            if key == "state":
                for value, (low, high) in zip(values, self._state_limits):
                    if not low <= value <= high:
                        bounds = np.array(self._state_limits).T
                        values = np.clip(values, *bounds).tolist()
                        break
                observation[key] = np.array(values, dtype=np.float32)
            elif key == "goal":
                observation[key] = self._goal.copy()
            elif key == "obstacles":
                observation[key] = self._present_rows().copy()
            elif key == "time_to_go":
                left = self.problem.final_time - self._step_count * self.control_dt
                observation[key] = np.array([left if left > 0.0 else 0.0], dtype=np.float32)
            elif key == "image":
                observation[key] = top_view(
                    state[:3],
                    self.problem.goal[:3],
                    self._present_rows(),
                    self._image_size,
                    self.base_scenario.table,
                    self.robot.radius,
                )
            else:
                ranges = self._require_world().ranges(self._rays, LIDAR_REACH)
                if noise.range_noise > 0.0:
                    ranges += noise.range_noise * self.np_random.standard_normal(len(ranges))
                observation[key] = np.clip(ranges, 0.0, LIDAR_REACH).astype(np.float32)
        return observation

    def _present_rows(self) -> NDArray[np.float32]:
        """Rows of the obstacles as they are now, within the observation's bounds."""
        obstacles = self.problem.scenario.obstacles
        if not obstacles.moving:
            return self._rows
        rows = obstacle_rows(obstacles, self.max_obstacles, True, self.time)
        box: Any = self.limits["obstacles"]
        return np.clip(rows, box.low, box.high)

    def _off_table(self, state: list[float]) -> bool:
        """Whether the centre has left the table: without contacts, or pushed through a wall."""
        x, y, (width, height) = state[0], state[1], self.base_scenario.table
        return not (0.0 <= x <= width and 0.0 <= y <= height)

    def _goal_error(self, state: list[float]) -> tuple[float, float, float, float]:
        """What :func:`goal_errors` gives, in plain floats."""
        x, y, psi, v_x, v_y, omega = map(operator.sub, state, self._aim)
        return (
            math.hypot(x, y),
            abs((psi + math.pi) % (2.0 * math.pi) - math.pi),
            math.hypot(v_x, v_y),
            abs(omega),
        )

    def _info(self, error: tuple[float, float, float, float]) -> dict[str, Any]:
        position, heading, speed, rate = self.goal_tolerance
        return {
            "is_success": error[0] <= position
            and error[1] <= heading
            and error[2] <= speed
            and error[3] <= rate,
            "goal_error": np.array(error),
            "cost": self._cost,
            "fuel": self._thrust * sum(self._firing_time),
            "firing_time": np.array(self._firing_time),
            "contacts": self._require_world().take_contacts().to_info(),
        }

    def _make_modulator(self) -> PulseWidthModulator:
        shortest = self.disturbances.min_on_time * self.sub_steps / PWM_PERIOD
        return PulseWidthModulator(self.sub_steps, math.ceil(shortest - 1e-9))

    def _make_world(self, plant: Plant | None) -> World:
        return World(self.scenario, self.restitution, self.friction, self.contacts, plant)

    def _require_world(self) -> World:
        if self._world is None:
            raise gym.error.ResetNeeded("Call reset() before step() or render().")
        return self._world


def _scenario(given: str | Scenario | list[list[float]]) -> Scenario | None:
    """The scenario that an environment's argument names; None for random ones."""
    if isinstance(given, Scenario):
        return given
    if not isinstance(given, str | Sequence | np.ndarray):
        raise ValueError(
            "scenario must be 'random', a scene's name, rows (x, y, radius) or a Scenario, "
            f"got {given!r}."
        )
    if not isinstance(given, str):
        return replace(Scenario(), obstacles=Obstacles.from_rows(given))
    return None if given == "random" else Scenario.named(given)


def _obstacle_range(given: int | tuple[int, int]) -> tuple[int, int]:
    """The range ``(least, most)`` that the argument ``n_obstacles`` means."""
    pair = (given, given) if isinstance(given, int | np.integer) else given
    is_pair = isinstance(pair, Sequence) and len(pair) == 2
    whole = is_pair and all(isinstance(count, int | np.integer) for count in pair)
    least, most = pair if whole else (0, -1)
    if not 0 <= least <= most:
        raise ValueError(
            f"n_obstacles must be a number >= 0 or a range (least, most), got {given!r}."
        )
    return int(least), int(most)


def goal_errors(differences: FloatArray) -> FloatArray:
    """Errors in position (m), heading (rad), speed (m/s) and rate (rad/s) of many states at once.

    Args:
        differences: ``(6, ...)`` states less their goals.

    Returns:
        ``(4, ...)``; whole turns do not count.
    """
    x, y, psi, v_x, v_y, rate = differences
    turn = np.abs((psi + np.pi) % (2.0 * np.pi) - np.pi)
    return np.stack([np.sqrt(x * x + y * y), turn, np.sqrt(v_x * v_x + v_y * v_y), np.abs(rate)])


def _potential(error: tuple[float, float, float, float]) -> float:
    return -sum(map(operator.mul, ERROR_WEIGHTS, error))
