"""Wrappers for what Gymnasium's own do not do: a vector to learn from, and the goal form."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from freeflyer_env.env import ERROR_WEIGHTS, goal_errors
from freeflyer_env.spaces import obstacle_mask

#: Units in which :class:`FlatObservation` measures: m, m/s, rad/s, s.
_LENGTH, _SPEED, _RATE, _TIME = 1.0, 0.1, 0.3, 40.0
_FAR = 10.0


class FlatObservation(gym.ObservationWrapper, RecordConstructorArgs):
    """One float32 vector of order one, relative to the robot, that a network can learn from.

    It holds what there is to go and how fast the robot is, in the frame in which actions push: the
    global one for ``delta_v``, the robot's for thrusters. These are ``(x, y)`` to the goal in m,
    sine and cosine of the turn to it, the velocity relative to the goal's in 0.1 m/s, the rate
    relative to the goal's in 0.3 rad/s, the time left in 40 s, and for each row of ``obstacles``
    where its centre is in m, its radius in m, 1 for an obstacle or 0 for padding, and, if
    obstacles can move, its velocity in 0.1 m/s; then ranges of the lidar in m. Values are cut off
    at 10.

    Args:
        env: ``FreeFlyer-v0`` with the modality ``"state"`` or ``"robot"``, with or without
            ``"lidar"``; no ``"image"``, which does not go into a vector.

    Raises:
        ValueError: If the environment has other modalities.
    """

    def __init__(self, env: gym.Env) -> None:
        RecordConstructorArgs.__init__(self)
        gym.ObservationWrapper.__init__(self, env)
        boxes = _boxes(env)
        if "state" not in boxes or "image" in boxes:
            raise ValueError(
                "FlatObservation needs observation='state' or 'robot', with or without 'lidar', "
                f"got {sorted(boxes)}."
            )
        size = 8
        if "obstacles" in boxes:
            rows, columns = boxes["obstacles"].shape
            size += rows * (columns + 1)
        size += boxes["lidar"].shape[0] if "lidar" in boxes else 0
        self.observation_space = spaces.Box(-_FAR, _FAR, (size,), np.float32)
        base: Any = env.unwrapped
        self._turns = base.action_mode != "delta_v"

    def observation(self, observation: dict[str, NDArray[Any]]) -> NDArray[np.float32]:
        """The vector; see the class."""
        state = observation["state"].astype(np.float64)
        error = observation["goal"] - state
        cos, sin = (np.cos(state[2]), np.sin(state[2])) if self._turns else (1.0, 0.0)
        into_frame = np.array([[cos, sin], [-sin, cos]])
        parts: list[Any] = [
            into_frame @ error[:2] / _LENGTH,
            [np.sin(error[2]), np.cos(error[2])],
            -into_frame @ error[3:5] / _SPEED,
            [-error[5] / _RATE],
            observation["time_to_go"] / _TIME,
        ]
        if "obstacles" in observation:
            rows = observation["obstacles"].astype(np.float64)
            mask = obstacle_mask(rows)[:, None]
            centres = (rows[:, :2] - state[:2]) @ into_frame.T
            velocities = rows[:, 3:] @ into_frame.T if rows.shape[1] == 5 else rows[:, 3:]
            table = np.hstack(
                [centres / _LENGTH, rows[:, 2:3] / _LENGTH, mask, velocities / _SPEED]
            )
            parts.append((table * mask).ravel())
        if "lidar" in observation:
            parts.append(observation["lidar"] / _LENGTH)
        return np.clip(np.concatenate(parts), -_FAR, _FAR).astype(np.float32)


class GoalObservation(gym.ObservationWrapper, RecordConstructorArgs):
    """The goal form of Gymnasium-Robotics, for hindsight experience replay.

    Observations are dictionaries of ``achieved_goal`` and ``desired_goal`` (6,), the state and the
    state to be in, and ``observation``, which holds the state, the time to go and the obstacles.
    The reward is that of :meth:`compute_reward`.

    Args:
        env: ``FreeFlyer-v0`` with the modality ``"state"`` or ``"robot"``.
        reward: ``"sparse"``: 0 within the tolerance of the goal, -1 elsewhere; ``"dense"``: minus
            the weighted error, 1 per m, 0.2 per rad, 2 per m/s and 0.2 per rad/s.

    Raises:
        ValueError: If an argument is out of range.
    """

    def __init__(self, env: gym.Env, reward: str = "sparse") -> None:
        RecordConstructorArgs.__init__(self, reward=reward)
        gym.ObservationWrapper.__init__(self, env)
        boxes = _boxes(env)
        if "state" not in boxes or "image" in boxes or "lidar" in boxes:
            raise ValueError(
                f"GoalObservation needs observation='state' or 'robot' alone, got {sorted(boxes)}."
            )
        if reward not in ("sparse", "dense"):
            raise ValueError(f"reward must be 'sparse' or 'dense', got {reward!r}.")
        self.reward_type = reward
        self._keys = [key for key in ("state", "time_to_go", "obstacles") if key in boxes]
        low, high = (
            np.concatenate([getattr(boxes[key], side).ravel() for key in self._keys])
            for side in ("low", "high")
        )
        self.observation_space = spaces.Dict(
            {
                "observation": spaces.Box(low, high, dtype=np.float32),
                "achieved_goal": boxes["state"],
                "desired_goal": boxes["goal"],
            }
        )

    def observation(self, observation: dict[str, NDArray[Any]]) -> dict[str, NDArray[np.float32]]:
        """The dictionary; see the class."""
        return {
            "observation": np.concatenate([observation[key].ravel() for key in self._keys]),
            "achieved_goal": observation["state"].copy(),
            "desired_goal": observation["goal"].copy(),
        }

    def step(self, action: Any) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Steps; the reward is :meth:`compute_reward`."""
        raw, _, terminated, truncated, info = self.env.step(action)
        observation = self.observation(raw)
        achieved, desired = observation["achieved_goal"], observation["desired_goal"]
        reward = float(self.compute_reward(achieved, desired, info))
        return observation, reward, terminated, truncated, info

    def compute_reward(
        self, achieved_goal: NDArray[Any], desired_goal: NDArray[Any], info: Any
    ) -> NDArray[np.float32]:
        """Rewards ``(...)`` of states ``(..., 6)`` for goals ``(..., 6)``; ``info`` is not used."""
        difference = np.asarray(achieved_goal, np.float64) - np.asarray(desired_goal, np.float64)
        errors = np.moveaxis(goal_errors(np.moveaxis(difference, -1, 0)), 0, -1)
        if self.reward_type == "dense":
            return np.asarray(-errors @ ERROR_WEIGHTS, dtype=np.float32)
        base: Any = self.env.unwrapped
        return np.asarray((errors <= base.goal_tolerance).all(axis=-1), dtype=np.float32) - 1.0


def _boxes(env: gym.Env) -> dict[str, Any]:
    space = env.observation_space
    return dict(space.spaces) if isinstance(space, spaces.Dict) else {}
