"""The vector form of ``FreeFlyer-v0``: many environments as one NumPy batch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from freeflyer_env.control import PulseWidthModulator
from freeflyer_env.env import ERROR_WEIGHTS, REACH_TOLERANCE, FreeFlyerEnv
from freeflyer_env.robot import FloatArray, body_from_world
from freeflyer_env.scenario import Obstacles, Problem, Scenario, sample_states, sample_tables
from freeflyer_env.spaces import require_fit
from freeflyer_env.vector_contacts import Contacts

BoolArray = NDArray[np.bool_]

_MARGIN = 1e-6  # m between hull and surroundings below which contacts are looked for


class FreeFlyerVectorEnv(VectorEnv[dict[str, Any], NDArray[Any], NDArray[Any]]):
    """``num_envs`` times :class:`FreeFlyerEnv` at once, an order of magnitude faster a step.

    Made by ``gym.make_vec("FreeFlyer-v0", num_envs=1024,
    vectorization_mode="vector_entry_point")``. Actions, observations, rewards and endings are those
    of the scalar environment, with the batch as first axis. Free flight is the same to 1e-9. The
    contacts follow Chipmunk's rules without Chipmunk: single ones are the same up to rounding;
    where two happen at once, in a corner, they are solved in a fixed order.

    Infos hold ``is_success`` and ``cost`` ``(n,)``, ``goal_error`` ``(n, 4)``, ``fuel`` ``(n,)``,
    ``firing_time`` ``(n, 8)`` and ``contacts`` with ``count`` and ``impulse`` ``(n,)`` and ``with``
    ``(n, M + 1)``, which is true for the obstacles that were touched and, last, for the wall.

    Args:
        num_envs: Number of environments.
        autoreset_mode: What happens when an episode ends: the next step starts a new one
            (``NEXT_STEP``), the same step does, with ``final_obs`` and ``final_info`` in the infos
            (``SAME_STEP``), or the caller resets with ``options={"reset_mask": mask}``
            (``DISABLED``).
        **arguments: Those of :class:`FreeFlyerEnv`, but for disturbances, moving obstacles, images
            and lidar, for which ``vectorization_mode="sync"`` is the way.

    Raises:
        ValueError: If an argument is out of range or is not for the vector form.
    """

    metadata = {  # noqa: RUF012
        "render_modes": ["rgb_array"],
        "render_fps": 10,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        *,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        **arguments: Any,
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, got {num_envs}.")
        # Checks the arguments, and says what they mean.
        self._one = one = FreeFlyerEnv(**arguments)
        for name, given in (
            ("disturbances", one.disturbances.any_at_all),
            ("moving obstacles", one.moving_obstacles),
            (f"observation={one.modalities}", not {"state", "robot"} >= set(one.modalities)),
            ("render_mode='human'", one.render_mode == "human"),
        ):
            if given:
                raise ValueError(
                    f"The vector form has no {name}: use gym.make_vec('FreeFlyer-v0', ..., "
                    "vectorization_mode='sync')."
                )
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self.num_envs, self.render_mode = num_envs, one.render_mode
        self.single_action_space = one.action_space
        self.single_observation_space = one.observation_space
        self.action_space = batch_space(one.action_space, num_envs)
        self.observation_space = batch_space(one.observation_space, num_envs)
        self._robot, self._dt = one.robot, one.control_dt
        self._base = one.base_scenario
        self._modulator = PulseWidthModulator(one.sub_steps)
        m = one.max_obstacles
        self._contacts = Contacts(
            num_envs, m, self._robot, self._base.table, one.restitution, one.friction
        )
        self._state = np.zeros((num_envs, 6))
        self._goal = np.zeros((num_envs, 6))
        self._rows = np.zeros((num_envs, m, 3))
        self._final_time = np.zeros(num_envs)
        self._steps = np.zeros(num_envs, dtype=np.int64)
        self._n_steps = np.zeros(num_envs, dtype=np.int64)
        self._cost, self._firing_time = np.zeros(num_envs), np.zeros((num_envs, 8))
        self._potential = np.zeros(num_envs)
        self._done = np.zeros(num_envs, dtype=bool)
        self._duties = np.zeros((num_envs, 8))
        self._is_reset = False
        limits: Any = one.limits["state"]
        self._low, self._high = limits.low, limits.high

    @property
    def states(self) -> FloatArray:
        """True states ``(num_envs, 6)``, float64, a fresh array."""
        return self._state.copy()

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Starts new episodes.

        Args:
            seed: One for the batch, or several, which together seed it.
            options: ``{"problems": [...]}``: one ``Problem`` or mapping for each environment that
                is reset; ``{"reset_mask": (num_envs,) bool}``: which are; all if left out.

        Raises:
            ValueError: If a problem or an option is invalid.
        """
        if seed is not None and not isinstance(seed, int | np.integer):
            self._np_random = np.random.default_rng([int(item or 0) for item in seed])
        else:
            super().reset(seed=seed)
        options = options or {}
        if unknown := sorted(set(options) - {"problems", "reset_mask"}):
            raise ValueError(
                f"reset() knows only the options 'problems' and 'reset_mask', got {unknown}."
            )
        mask = np.ones(self.num_envs, dtype=bool)
        if "reset_mask" in options:
            mask = np.asarray(options["reset_mask"])
            if mask.shape != (self.num_envs,) or mask.dtype != bool:
                raise ValueError(
                    f"reset_mask must be ({self.num_envs},) bool, got {mask.shape} {mask.dtype}."
                )
            if not (self._is_reset or mask.all()):
                raise gym.error.ResetNeeded("Reset all environments once before some of them.")
        self._is_reset = True
        self._start(np.flatnonzero(mask), options.get("problems"))
        return self._observation(), self._info(self._errors())

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[dict[str, Any], FloatArray, BoolArray, BoolArray, dict[str, Any]]:
        """Applies actions ``(num_envs, ...)`` for one control step."""
        if not self._is_reset:
            raise gym.error.ResetNeeded("Call reset() before step().")
        actions = np.asarray(actions)
        if actions.shape != self.action_space.shape or not np.isfinite(actions).all():
            raise ValueError(
                f"Actions of mode {self._one.action_mode!r} must be {self.action_space.shape} "
                f"finite numbers, got shape {actions.shape}."
            )
        over = self._done
        if over.any():
            if self.autoreset_mode is AutoresetMode.DISABLED:
                raise gym.error.ResetNeeded(
                    "Some episodes are over: reset them with options={'reset_mask': mask}."
                )
            # Those start anew in this step; whatever the batch does to them is undone.
            actions = np.where(over[:, None], 0, actions)
        one = self._one
        effort = self._act(actions.astype(np.float64))
        self._cost += effort
        self._steps += 1
        error = self._errors()
        if over.any():
            self._start(np.flatnonzero(over), None)
            error = self._errors()
        info = self._info(error)
        at_end = self._steps >= self._n_steps
        success = info["is_success"] & (at_end | one.terminate_early)
        crashed = (self._contacts.count > 0) & one.terminate_on_contact
        terminated = (success | crashed) & ~over
        truncated = (at_end | self._off_table()) & ~terminated & ~over
        reward = one.success_reward * (success & ~over) - np.where(over, 0.0, effort)
        if one.reward == "dense":
            potential = -error @ ERROR_WEIGHTS
            reward += np.where(over, 0.0, potential - self._potential)
            self._potential = potential
        self._done = terminated | truncated
        observation = self._observation()
        if self.autoreset_mode is AutoresetMode.SAME_STEP and self._done.any():
            observation, info = self._restart(observation, info)
        return observation, reward, terminated, truncated, info

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """One picture ``(H, W, 3)`` uint8 of each environment."""
        if self.render_mode is None:
            gym.logger.warn("render() needs render_mode='rgb_array'.")
            return None
        from freeflyer_env.rendering import draw_scene

        return tuple(
            draw_scene(
                self._scenario(index),
                self._state[index, :3],
                goal=self._goal[index, :3],
                duties=self._duties[index],
                time=float(self._steps[index] * self._dt),
            )
            for index in range(self.num_envs)
        )

    # -- episodes --------------------------------------------------------------------------------

    def _start(self, indices: NDArray[np.intp], problems: Any) -> None:
        """Starts episodes of the environments ``(k,)`` given."""
        if problems is None:
            self._sample(indices)
        else:
            self._pose(indices, problems)
        self._n_steps[indices] = np.ceil(self._final_time[indices] / self._dt - 1e-6)
        self._steps[indices], self._cost[indices] = 0, 0.0
        self._firing_time[indices], self._duties[indices] = 0.0, 0.0
        self._done[indices] = False
        if np.ndim(self._modulator.carried) == 2:
            self._modulator.carried[indices] = 0.0
        self._contacts.start(indices, self._rows[indices])
        difference = self._state[indices] - self._goal[indices]
        self._potential[indices] = -_errors(difference) @ ERROR_WEIGHTS

    def _sample(self, indices: NDArray[np.intp]) -> None:
        rng, one, k = self.np_random, self._one, len(indices)
        if one.fixed_scenario is not None:
            table = one.fixed_scenario.obstacles.rows()
            rows = np.zeros((k, one.max_obstacles, 3))
            rows[:, : len(table)] = table
        else:
            counts = rng.integers(one.n_obstacles[0], one.n_obstacles[1] + 1, k)
            rows = sample_tables(rng, counts, one.max_obstacles)
        self._rows[indices] = rows
        start, goal = sample_states(rng, self._base, rows)
        self._state[indices], self._goal[indices] = start, goal
        self._final_time[indices] = one.final_time

    def _pose(self, indices: NDArray[np.intp], problems: Any) -> None:
        if len(problems) != len(indices):
            raise ValueError(f"{len(indices)} problems are needed, got {len(problems)}.")
        checked = []
        for given in problems:
            if not isinstance(given, (Problem, Mapping)):
                raise ValueError(
                    f"A problem must be a Problem or a mapping, got {type(given).__name__}."
                )
            problem = given if isinstance(given, Problem) else Problem.from_dict(given, self._base)
            require_fit(problem.require_valid(), self._base, self._one.limits)
            checked.append(problem)
        for index, problem in zip(indices, checked):
            obstacles = problem.scenario.obstacles
            self._state[index], self._goal[index] = problem.start, problem.goal
            self._rows[index] = 0.0
            self._rows[index, : len(obstacles)] = obstacles.rows()
            self._final_time[index] = problem.final_time

    def _restart(
        self, observation: dict[str, Any], info: dict[str, Any]
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Starts anew what is over, and keeps its last observation and info."""
        done = np.flatnonzero(self._done)
        final = np.full(self.num_envs, None, dtype=object)
        for index in done:
            final[index] = {key: value[index].copy() for key, value in observation.items()}
        mask = self._done.copy()
        self._start(done, None)
        fresh = self._info(self._errors())
        fresh |= {"final_obs": final, "_final_obs": mask}
        fresh |= {"final_info": _masked(info, mask), "_final_info": mask.copy()}
        return self._observation(), fresh

    # -- motion ----------------------------------------------------------------------------------

    def _act(self, actions: FloatArray) -> FloatArray:
        """Applies actions, advances the batch, returns the effort ``(n,)`` in m/s."""
        robot, one, dt = self._robot, self._one, self._dt
        self._contacts.clear_log()
        if one.action_mode == "delta_v":
            body = body_from_world(self._state[:, 2], actions)
            excess = robot.reach(body, dt)
            scale = np.where(excess > 1.0 + REACH_TOLERANCE, excess, 1.0)[:, None]
            actions, body = actions / scale, body / scale
            self._duties = robot.allocate(body * (robot.mass / dt))
            self._firing_time += self._duties * dt
            self._state[:, 3:] += actions * robot.control_gain
            self._drift()
            return np.abs(actions).sum(axis=1)
        if one.action_mode == "thrusters":
            pulses = self._modulator.pulses(actions)
        else:
            on = (actions > 0.5)[:, None, :]
            pulses = np.broadcast_to(on, (self.num_envs, one.sub_steps, 8))
        self._thrust(pulses.astype(np.float64) @ robot.wrench_matrix.T)
        self._duties = pulses.sum(axis=1) / one.sub_steps
        self._firing_time += self._duties * dt
        return robot.thrust / robot.mass * dt * self._duties.sum(axis=1)

    def _drift(self) -> None:
        """Drift for a control step: in one go where nothing can be touched."""
        state, h = self._state, self._dt / self._one.sub_steps
        way = self._dt * np.hypot(state[:, 3], state[:, 4])
        near = self._near(way)
        before = state[near]
        state[:, :3] += self._dt * state[:, 3:]
        if len(near):
            for _ in range(self._one.sub_steps):
                before[:, :3] += h * before[:, 3:]
                self._contacts.resolve(near, before)
            state[near] = before

    def _thrust(self, wrenches: FloatArray) -> None:
        """Motion under body wrenches ``(n, sub_steps, 3)``, one a sub-step."""
        state, robot, h = self._state, self._robot, self._dt / self._one.sub_steps
        push = np.abs(wrenches[..., :2]).sum(axis=-1).max(axis=1) / robot.mass
        near = self._near(self._dt * (np.hypot(state[:, 3], state[:, 4]) + push * self._dt))
        psi, rate = state[:, 2], state[:, 5]
        for number in range(self._one.sub_steps):
            fx, fy, torque = wrenches[:, number].T
            alpha = torque / robot.inertia
            middle = psi + 0.5 * h * (rate + 0.25 * h * alpha)
            cos, sin, gain = np.cos(middle), np.sin(middle), 0.5 * h / robot.mass
            half = np.column_stack(
                [gain * (cos * fx - sin * fy), gain * (sin * fx + cos * fy), 0.5 * h * alpha]
            )
            state[:, 3:] += half
            state[:, :3] += h * state[:, 3:]
            if len(near):
                part = state[near]
                self._contacts.resolve(near, part)
                state[near] = part
            state[:, 3:] += half

    def _near(self, way: FloatArray) -> NDArray[np.intp]:
        """Environments that may touch something on a way of so many m."""
        if not self._one.contacts:
            return np.empty(0, dtype=np.intp)
        return self._contacts.within(self._state, way + _MARGIN)

    # -- what is told ----------------------------------------------------------------------------

    def _observation(self) -> dict[str, Any]:
        left = np.maximum(self._final_time - self._steps * self._dt, 0.0)
        values = {
            "state": np.clip(self._state.astype(np.float32), self._low, self._high),
            "goal": self._goal.astype(np.float32),
            "obstacles": self._rows.astype(np.float32),
            "time_to_go": left[:, None].astype(np.float32),
        }
        return {key: values[key] for key in self._one.observation_space}

    def _info(self, error: FloatArray) -> dict[str, Any]:
        firing_time, contacts = self._firing_time.copy(), self._contacts
        told = {
            "is_success": (error <= self._one.goal_tolerance).all(axis=1),
            "goal_error": error,
            "cost": self._cost.copy(),
            "fuel": self._robot.thrust * firing_time.sum(axis=1),
            "firing_time": firing_time,
        }
        touched = {
            "count": contacts.count.copy(),
            "impulse": contacts.impulse.copy(),
            "with": contacts.touched.copy(),
        }
        everyone = np.ones(self.num_envs, dtype=bool)
        return _masked({**told, "contacts": _masked(touched, everyone)}, everyone)

    def _errors(self) -> FloatArray:
        return _errors(self._state - self._goal)

    def _off_table(self) -> BoolArray:
        if self._one.contacts:
            return np.zeros(self.num_envs, dtype=bool)
        position = self._state[:, :2]
        return ((position < 0.0) | (position > self._base.table)).any(axis=1)

    def _scenario(self, index: int) -> Scenario:
        return Scenario(
            Obstacles.from_rows(self._rows[index]),
            self._robot,
            self._base.table,
            self._base.dt,
            self._base.keep_out_factor,
        )


def _errors(difference: FloatArray) -> FloatArray:
    """Errors ``(n, 4)`` in position, heading, speed and rate of state differences ``(n, 6)``."""
    x, y, psi, v_x, v_y, omega = difference.T
    turn = np.abs((psi + np.pi) % (2.0 * np.pi) - np.pi)
    return np.column_stack([np.hypot(x, y), turn, np.hypot(v_x, v_y), np.abs(omega)])


def _masked(values: dict[str, Any], mask: BoolArray) -> dict[str, Any]:
    """With Gymnasium's ``_key`` masks, which say whose values are meant."""
    plain = {key: value for key, value in values.items() if not key.startswith("_")}
    return {**plain, **{f"_{key}": mask.copy() for key in plain}}
