"""The vector form of ``FreeFlyer-v0``: many environments as one NumPy batch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from freeflyer_env.control import PulseWidthModulator
from freeflyer_env.disturbances import Disturbances
from freeflyer_env.env import ERROR_WEIGHTS, REACH_TOLERANCE, FreeFlyerEnv, goal_errors
from freeflyer_env.robot import FloatArray, allocate_clusters
from freeflyer_env.sampling import sample_states, sample_tables
from freeflyer_env.scenario import Obstacles
from freeflyer_env.vector_contacts import IntArray, Worlds

Observations = dict[str, NDArray[np.float32]]
BoolArray = NDArray[np.bool_]

# Random problems drawn at a time, at least: a draw costs about the same for one and for hundreds.
_BATCH = 512

_MODALITIES = {"state", "robot"}


class FreeFlyerVectorEnv(gym.vector.VectorEnv[Any, Any, NDArray[Any]]):
    """``num_envs`` independent copies of :class:`freeflyer_env.env.FreeFlyerEnv`, as one batch.

    Made by ``gym.make_vec("FreeFlyer-v0", num_envs=1024,
    vectorization_mode="vector_entry_point")``.
    Spaces, rewards, endings and physics are those of the single environment, which documents them;
    with the same problems and actions the states agree to rounding, through contacts too. Not
    supported, with a ``ValueError``: moving obstacles, disturbances, images and lidar. For these
    use ``gym.make_vec(..., vectorization_mode="sync")``.

    Observations, and ``info``, have the environments along the first axis and share no memory with
    the environment. ``info`` is that of the single environment in arrays: ``is_success``
    ``(num_envs,)``, ``goal_error`` ``(num_envs, 4)`` (m, rad, m/s, rad/s), ``cost``, ``fuel``,
    ``firing_time`` ``(num_envs, 8)`` in s, and ``contacts`` with ``count`` and ``impulse`` in N s
    ``(num_envs,)`` and ``with`` ``(num_envs, M + 1)``, true for the obstacles that were touched
    and, last, for a wall. Each has its mask ``_name``.

    Random problems have the distribution of :func:`freeflyer_env.sample_problem` but are drawn in
    batches, from one generator: the same seed and number of environments give the same problems,
    others than the single environment's.

    Args:
        num_envs: Number of environments.
        autoreset_mode: What happens to environments whose episode is over. ``NEXT_STEP``: the next
            step resets them, whatever the action, with reward zero. ``SAME_STEP``: they are reset
            at once; ``info["final_obs"]`` (an observation for each, None for others) and
            ``info["final_info"]`` tell how they ended. ``DISABLED``: call ``reset`` with
            ``options={"reset_mask": ...}``.
        **arguments: Of :class:`freeflyer_env.env.FreeFlyerEnv`. ``render_mode`` may be
            ``"rgb_array"``: a picture of each environment.

    Raises:
        ValueError: If an argument is out of range or not supported.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": ["rgb_array"],
        "render_fps": 10,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        **arguments: Any,
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, got {num_envs}.")
        # Checks the arguments, and knows what follows from them.
        self._single = single = FreeFlyerEnv(**arguments)
        _require_support(single)
        self.num_envs, self.render_mode = num_envs, single.render_mode
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self.single_observation_space = single.observation_space
        self.single_action_space = single.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._worlds = Worlds(
            num_envs,
            single.base_scenario,
            single.max_obstacles,
            single.restitution,
            single.friction,
            single.contacts,
        )
        box = single.limits["state"]
        assert isinstance(box, gym.spaces.Box)
        self._low, self._high = (side.astype(np.float64)[:, None] for side in (box.low, box.high))
        self._modulator = PulseWidthModulator(single.sub_steps)
        self._modulator.carried = np.zeros((num_envs, 8))
        self._pool: list[FloatArray] = []
        self._used = 0
        self._starts, self._goals = np.zeros((num_envs, 6)), np.zeros((num_envs, 6))
        self._discs = np.zeros((num_envs, single.max_obstacles, 3))
        self._final_times = np.zeros(num_envs)
        self._steps = np.zeros(num_envs, dtype=np.int64)
        self._last_steps = np.zeros(num_envs, dtype=np.int64)
        self._costs, self._firing_times = np.zeros(num_envs), np.zeros((8, num_envs))
        self._duties = np.zeros((8, num_envs))
        self._potentials = np.zeros(num_envs)
        # Never reset; over.
        self._idle, self._over = np.ones(num_envs, dtype=bool), np.zeros(num_envs, dtype=bool)

    @property
    def states(self) -> FloatArray:
        """States ``(num_envs, 6)`` as in the single environment, float64, a fresh array."""
        return np.ascontiguousarray(self._worlds.state.T)

    def reset(
        self,
        *,
        seed: int | Sequence[int] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Observations, dict[str, Any]]:
        """Starts episodes.

        Args:
            seed: Seeds the random problems of the whole batch; a sequence of ``num_envs`` integers
                will do too, and is one seed as a whole.
            options: ``{"problems": [...]}`` sets the problems, one for each environment that is
                reset: each a ``Problem`` or a mapping, as for the single environment.
                ``{"problem": ...}`` is the same one for all. ``{"reset_mask": ...}``, bool
                ``(num_envs,)``, leaves the other environments as they are.

        Returns:
            Observations and infos of all environments; masks in infos tell which were reset.

        Raises:
            ValueError: If the seed, an option or a problem is invalid.
        """
        options = options or {}
        if unknown := sorted(set(options) - {"problems", "problem", "reset_mask"}):
            raise ValueError(
                f"reset() knows the options 'problems', 'problem' and 'reset_mask', got {unknown}."
            )
        mask = self._checked_mask(options.get("reset_mask"))
        which = np.flatnonzero(mask)
        given = options.get("problems")
        if given is None and options.get("problem") is not None:
            given = [options["problem"]] * which.size
        problems = None if given is None else self._given_problems(given, which.size)
        self._seed(seed)
        self._start(which, *(problems or self._draw(which.size)))
        return self._observations(), self._infos(self._errors(), mask)

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[Observations, FloatArray, BoolArray, BoolArray, dict[str, Any]]:
        """Applies ``(num_envs, ...)`` actions for one control step.

        Returns:
            Observations, rewards (float64), terminated, truncated and infos, of all environments.

        Raises:
            ValueError: If the actions have the wrong shape or are not finite.
            gymnasium.error.ResetNeeded: Before the first reset; without autoreset, if an episode is
                over.
        """
        if self._idle.any():
            raise gym.error.ResetNeeded("Call reset() before step().")
        if self.autoreset_mode == AutoresetMode.DISABLED and self._over.any():
            raise gym.error.ResetNeeded(
                f"The episodes of environments {np.flatnonzero(self._over).tolist()} are over: "
                "call reset(options={'reset_mask': ...}) first."
            )
        actions = np.asarray(actions)
        if actions.shape != self.action_space.shape or not np.isfinite(actions).all():
            raise ValueError(
                f"Actions of mode {self._single.action_mode!r} must be {self.action_space.shape} "
                f"finite numbers, got shape {actions.shape}."
            )
        efforts = self._act(actions.T.astype(np.float64))
        self._costs += efforts
        self._steps += 1
        renewed = self._over.copy()
        if renewed.any():
            which = np.flatnonzero(renewed)
            self._start(which, *self._draw(which.size))
        errors = self._errors()
        infos = self._infos(errors, np.ones(self.num_envs, dtype=bool))
        single, worlds = self._single, self._worlds
        at_end = self._steps >= self._last_steps
        success = (
            infos["is_success"].copy() if single.terminate_early else infos["is_success"] & at_end
        )
        crashed = (worlds.contact_count > 0) & single.terminate_on_contact
        success &= ~crashed
        terminated = (success | crashed) & ~renewed
        truncated = ((at_end | self._off_table()) & ~terminated) & ~renewed
        rewards = single.success_reward * success - efforts
        if single.reward == "dense":
            before, self._potentials = self._potentials, _potential(errors)
            rewards += self._potentials - before
        rewards[renewed] = 0.0
        self._over = terminated | truncated
        observations = self._observations()
        if self.autoreset_mode == AutoresetMode.SAME_STEP and self._over.any():
            observations, infos = self._start_at_once(observations, infos)
        return observations, rewards, terminated, truncated, infos

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """A picture ``(H, W, 3)`` of each environment; meant for a few environments."""
        if self.render_mode is None:
            gym.logger.warn("render() needs render_mode: make_vec(..., render_mode='rgb_array').")
            return None
        if self._idle.any():
            raise gym.error.ResetNeeded("Call reset() before render().")
        from freeflyer_env.rendering import draw_scene

        return tuple(
            draw_scene(
                replace(self._single.base_scenario, obstacles=Obstacles.from_rows(self._discs[i])),
                self._worlds.state[:3, i],
                start=self._starts[i, :3],
                goal=self._goals[i, :3],
                duties=self._duties[:, i],
                time=self._steps[i] * self._single.control_dt,
            )
            for i in range(self.num_envs)
        )

    # -- problems --------------------------------------------------------------------------------

    def _seed(self, seed: int | Sequence[int] | None) -> None:
        if seed is None:
            return
        if isinstance(seed, int | np.integer):
            super().reset(seed=int(seed))
        else:
            if len(seed) != self.num_envs:
                raise ValueError(f"Seeds must be {self.num_envs} integers, got {len(seed)}.")
            self.np_random = np.random.default_rng([int(item) for item in seed])
        self._pool, self._used = [], 0

    def _checked_mask(self, mask: Any) -> BoolArray:
        if mask is None:
            return np.ones(self.num_envs, dtype=bool)
        if not (
            isinstance(mask, np.ndarray)
            and mask.shape == (self.num_envs,)
            and mask.dtype == np.bool_
            and mask.any()
        ):
            raise ValueError(
                f"reset_mask must be an array of {self.num_envs} bools, one of them True at least, "
                f"got {mask!r}."
            )
        return mask.copy()

    def _given_problems(
        self, given: Any, count: int
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Checked starts, goals, obstacle rows and final times."""
        if len(given) != count:
            raise ValueError(
                f"problems must be one for each environment that is reset, {count}, "
                f"got {len(given)}."
            )
        if any(item is None for item in given):
            raise ValueError("problems must be Problems or mappings, got None.")
        problems = [self._single._make_problem(item) for item in given]
        discs = np.zeros((count, self._single.max_obstacles, 3))
        for rows, problem in zip(discs, problems):
            obstacles = problem.scenario.obstacles
            rows[: len(obstacles)] = obstacles.rows()
        return (
            np.array([problem.start for problem in problems]),
            np.array([problem.goal for problem in problems]),
            discs,
            np.array([problem.final_time for problem in problems]),
        )

    def _draw(self, count: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Random starts, goals, obstacle rows and final times."""
        left = len(self._pool[0]) - self._used if self._pool else 0
        if left < count:
            fresh = self._sample(max(count - left, _BATCH))
            kept = [part[self._used :] for part in self._pool] or [part[:0] for part in fresh]
            self._pool = [np.concatenate(parts) for parts in zip(kept, fresh)]
            self._used = 0
        first, self._used = self._used, self._used + count
        starts, goals, discs = (part[first : self._used] for part in self._pool)
        return starts, goals, discs, np.full(count, self._single.final_time)

    def _sample(self, count: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Random starts, goals and obstacle rows."""
        rng, single = self.np_random, self._single
        if single.fixed_scenario is None:
            least, most = single.n_obstacles
            discs = sample_tables(rng, rng.integers(least, most + 1, count), single.max_obstacles)
        else:
            rows = single.fixed_scenario.obstacles.rows()
            discs = np.zeros((count, single.max_obstacles, 3))
            discs[:, : len(rows)] = rows
        return *sample_states(rng, single.base_scenario, discs), discs

    def _start(
        self,
        which: IntArray,
        starts: FloatArray,
        goals: FloatArray,
        discs: FloatArray,
        final_times: FloatArray,
    ) -> None:
        """Starts new episodes in some environments."""
        self._starts[which], self._goals[which], self._discs[which] = starts, goals, discs
        self._final_times[which], self._steps[which] = final_times, 0
        steps = np.ceil(final_times / self._single.control_dt - 1e-6)
        self._last_steps[which] = steps.astype(np.int64)
        self._costs[which], self._firing_times[:, which] = 0.0, 0.0
        self._duties[:, which] = 0.0
        self._modulator.carried[which] = 0.0
        self._worlds.place(which, starts, discs)
        self._idle[which], self._over[which] = False, False
        self._potentials[which] = _potential(self._errors())[which]

    def _start_at_once(
        self, observations: Observations, infos: dict[str, Any]
    ) -> tuple[Observations, dict[str, Any]]:
        """Starts new episodes where they are over, and tells how the old ones ended."""
        over = self._over.copy()
        which = np.flatnonzero(over)
        final = np.full(self.num_envs, None, dtype=object)
        for i in which:
            final[i] = {key: value[i].copy() for key, value in observations.items()}
        final_infos = _masked(infos, over)
        self._start(which, *self._draw(which.size))
        infos = self._infos(self._errors(), np.ones(self.num_envs, dtype=bool))
        infos.update(
            final_obs=final, _final_obs=over, final_info=final_infos, _final_info=over.copy()
        )
        return self._observations(), infos

    # -- motion ----------------------------------------------------------------------------------

    def _act(self, actions: FloatArray) -> FloatArray:
        """Applies actions ``(..., n)``, advances the worlds, returns the efforts in m/s."""
        if self._single.action_mode == "delta_v":
            return self._act_impulses(actions)
        single, robot, n = self._single, self._single.robot, self.num_envs
        if single.action_mode == "thrusters":
            pulses = self._modulator.pulses(actions.T).transpose(2, 1, 0)
            on = np.ascontiguousarray(pulses, dtype=np.float64)
            self._duties = on.sum(axis=1) / single.sub_steps
        else:
            on = (actions > 0.5).astype(np.float64)[:, None]
            self._duties = on[:, 0]
        wrenches = (robot.wrench_matrix @ on.reshape(8, -1)).reshape(3, -1, n)
        self._worlds.advance(single.control_dt, single.sub_steps, wrenches)
        self._firing_times += single.control_dt * self._duties
        return robot.thrust / robot.mass * single.control_dt * self._duties.sum(axis=0)

    def _act_impulses(self, actions: FloatArray) -> FloatArray:
        robot, period, state = self._single.robot, self._single.control_dt, self._worlds.state
        cos, sin = np.cos(state[2]), np.sin(state[2])
        u_x, u_y, turn = actions
        x, y = 0.5 * (cos * u_x + sin * u_y), 0.5 * (cos * u_y - sin * u_x)
        spin = turn * (0.25 / robot.lever_arm)
        signed = np.stack([y + spin, x - spin, spin - y, -x - spin])
        limit = robot.delta_v_max(period)
        excess = (0.5 / limit) * (signed.max(axis=0) - signed.min(axis=0))
        scale = 1.0 / np.where(excess > 1.0 + REACH_TOLERANCE, excess, 1.0)
        impulses = actions * scale
        self._duties = allocate_clusters(signed * (scale / limit))
        self._firing_times += period * self._duties
        state[3:] += impulses * robot.control_gain[:, None]
        self._worlds.advance(period, self._single.sub_steps)
        return np.abs(impulses).sum(axis=0)

    def _off_table(self) -> BoolArray:
        """Where the centre has left the table."""
        (x, y), (width, height) = self._worlds.state[:2], self._worlds.table
        return (x < 0.0) | (x > width) | (y < 0.0) | (y > height)

    # -- what is told ----------------------------------------------------------------------------

    def _errors(self) -> FloatArray:
        """``(4, n)`` errors to the goals in m, rad, m/s and rad/s."""
        return goal_errors(self._worlds.state - self._goals.T)

    def _observations(self) -> Observations:
        left = self._final_times - self._steps * self._single.control_dt
        parts = {
            "state": np.clip(self._worlds.state, self._low, self._high).T,
            "goal": self._goals,
            "obstacles": self._discs,
            "time_to_go": np.maximum(left, 0.0)[:, None],
        }
        return {
            key: parts[key].astype(np.float32, order="C") for key in self._single.observation_space
        }

    def _infos(self, errors: FloatArray, mask: BoolArray) -> dict[str, Any]:
        """Infos of all environments, with copies of ``mask``."""
        tolerance = np.array(self._single.goal_tolerance)[:, None]
        worlds = self._worlds
        contacts = {
            "count": worlds.contact_count.copy(),
            "impulse": worlds.contact_impulse.copy(),
            "with": worlds.touched.copy(),
        }
        infos = {
            "is_success": (errors <= tolerance).all(axis=0),
            "goal_error": np.ascontiguousarray(errors.T),
            "cost": self._costs.copy(),
            "fuel": self._single.robot.thrust * self._firing_times.sum(axis=0),
            "firing_time": np.ascontiguousarray(self._firing_times.T),
        }
        return {
            **_with_masks(infos, mask),
            "contacts": _with_masks(contacts, mask),
            "_contacts": mask.copy(),
        }


def _potential(errors: FloatArray) -> FloatArray:
    """Potential ``(n,)`` of the dense reward, of errors ``(4, n)``."""
    return -(np.array(ERROR_WEIGHTS) @ errors)


def _with_masks(infos: dict[str, Any], mask: BoolArray) -> dict[str, Any]:
    """Infos, each followed by a copy of the mask that says which environments have it."""
    return {
        name: value
        for key, part in infos.items()
        for name, value in ((key, part), (f"_{key}", mask.copy()))
    }


def _masked(infos: dict[str, Any], mask: BoolArray) -> dict[str, Any]:
    """The same infos with all masks replaced by copies of another one."""
    masked: dict[str, Any] = {}
    for key, value in infos.items():
        if isinstance(value, dict):
            masked[key] = _masked(value, mask)
        else:
            masked[key] = mask.copy() if key.startswith("_") else value
    return masked


def _require_support(single: FreeFlyerEnv) -> None:
    """Raises a ``ValueError`` for what there is in the single environment only."""
    wants = {
        "moving obstacles": single.moving_obstacles,
        "disturbances": single.disturbances != Disturbances(),
        "images or lidar": not set(single.modalities) <= _MODALITIES,
        "a window": single.render_mode not in (None, "rgb_array"),
    }
    for name, wanted in wants.items():
        if wanted:
            raise ValueError(
                f"FreeFlyerVectorEnv does not support {name}: use "
                "gym.make_vec(..., vectorization_mode='sync')."
            )
