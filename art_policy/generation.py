"""Model-based autoregressive generation (paper, Sec. III-C): known dynamics give the states."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from art_policy.autoregressive import Autoregressive
from art_policy.layers import ARTConfig, KeyValueCache
from art_policy.sequence import MIRROR_CONTROL, MIRROR_STATE, ProblemBatch
from freeflyer_env import dynamics
from freeflyer_env.robot import FloatArray
from freeflyer_env.scenario import Problem, Scenario


class Steps(Protocol):
    """A model that is asked for one control after the other, for a batch of problems."""

    def predict(
        self, state: FloatArray, returns: FloatArray, budget: FloatArray, time_to_go: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """What to do at the present step.

        Args:
            state: ``(B, 6)``.
            returns: ``(B,)`` reward-to-go in m/s.
            budget: ``(B,)`` constraint-to-go.
            time_to_go: ``(B,)`` in s.

        Returns:
            Controls ``(B, n_modes, 3)`` and their logits ``(B, n_modes)``.
        """

    def apply(self, control: FloatArray) -> None:
        """Says which control ``(B, 3)`` was applied; the next step follows."""


class SteppedModel(Protocol):
    """What :func:`generate` needs of a model."""

    config: ARTConfig

    def steps(self, problems: ProblemBatch, use_cache: bool = True) -> Steps:
        """The model at the first step of these problems."""


class TorchSteps:
    """The steps of a network in PyTorch, with keys and values of the past or without."""

    def __init__(self, net: Autoregressive, problems: ProblemBatch, use_cache: bool) -> None:
        self._net, self._device = net, net.control_scale.device
        self._problems = problems.to(self._device)
        self._picture = net.look(self._problems)
        self._cache = KeyValueCache() if use_cache else None
        empty = torch.empty(len(problems), 0, net.config.width, device=self._device)
        self._tokens, self._time = empty, empty

    @torch.inference_mode()
    def predict(
        self, state: FloatArray, returns: FloatArray, budget: FloatArray, time_to_go: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        net = self._net
        x, reward, constraint, self._time = (
            self._column(values) for values in (state, returns, budget, time_to_go)
        )
        new = net.embed_descriptors(
            self._problems, x, reward, constraint, self._time, self._picture
        )
        self._tokens = torch.cat([self._tokens, new.flatten(1, 2)], dim=1)
        modes, logits = net.decode_controls(net.transform(self._tokens, self._cache)[:, -1])
        return (modes * net.control_scale).double().cpu().numpy(), logits.cpu().numpy()

    @torch.inference_mode()
    def apply(self, control: FloatArray) -> None:
        last = self._net.embed_controls(self._problems, self._column(control), self._time)
        last = last.flatten(1, 2)
        self._tokens = last if self._cache is not None else torch.cat([self._tokens, last], dim=1)

    def _column(self, values: FloatArray) -> Tensor:
        """``(B, ...)`` numbers as a float32 sequence of one step, ``(B, 1, ...)``."""
        return torch.as_tensor(values[:, None], dtype=torch.float32, device=self._device)


def generate(
    net: SteppedModel,
    problems: Sequence[Problem],
    returns_to_go: FloatArray,
    *,
    draws: Sequence[int] | None = None,
    prompts: Sequence[FloatArray] | None = None,
    use_cache: bool = True,
) -> list[FloatArray]:
    """Trajectories of an autoregressive model, as their controls.

    Args:
        net: The network, or an exported model.
        problems: ``B`` problems; their final times may differ.
        returns_to_go: ``(B,)`` rewards-to-go at the start, minus the cost asked for, in m/s.
        draws: ``(B,)`` numbers of samples from the model's modes, the same in every call; 0, and by
            default, the most probable controls.
        prompts: ``B`` arrays ``(n, 3)`` of controls that are applied first, whatever the model
            thinks; it goes on from there.
        use_cache: Whether to keep keys and values of the past, or to run the whole sequence again
            at every step (slow; the same result).

    Returns:
        Controls ``(N, 3)`` of each problem, within the actuation limit.
    """
    dt, robot = problems[0].scenario.dt, problems[0].scenario.robot
    if any((p.scenario.dt, p.scenario.robot) != (dt, robot) for p in problems):
        raise ValueError("Problems that are generated together must share the robot and the step.")
    # In training the goal is to the right; other problems are looked at in a mirror.
    to_left = np.array([problem.goal[0] < problem.start[0] for problem in problems])
    width = net.config.table[0]
    seen = ProblemBatch.from_problems(problems).mirrored(torch.from_numpy(to_left), width, axis=0)
    state = np.array([problem.start for problem in problems])
    state[to_left] = state[to_left] * MIRROR_STATE[0] + (width, 0.0, 0.0, 0.0, 0.0, 0.0)
    time_to_go = np.array([problem.final_time for problem in problems])
    returns = np.array(returns_to_go, dtype=np.float64)
    # No violation is asked for. Nor is a budget overdrawn after one: no example ever showed that.
    budget = np.zeros(len(problems))
    longest, rows = max(problem.n_steps for problem in problems), np.arange(len(problems))
    noise = _mode_noise(draws or [0] * len(problems), longest, net.config.n_modes)
    given = np.full((len(problems), longest, 3), np.nan)
    for row, prompt in enumerate(prompts or ()):
        given[row, : len(prompt)] = prompt[:longest]
    given[to_left] *= MIRROR_CONTROL[0]
    steps, controls = net.steps(seen, use_cache), []
    for step in range(longest):
        modes, logits = steps.predict(state, returns, budget, time_to_go)
        control = modes[rows, (logits + noise[:, step]).argmax(axis=1)]
        control = np.where(np.isnan(given[:, step]), control, given[:, step])
        control = _within_limits(problems[0].scenario, state, control)
        steps.apply(control)
        returns = np.minimum(returns + np.abs(control).sum(axis=1), 0.0)
        state = dynamics.step(state, control, dt, robot)
        time_to_go = time_to_go - dt
        controls.append(control)
    table = np.stack(controls, axis=1)  # (B, longest N, 3)
    table[to_left] *= MIRROR_CONTROL[0]
    return [row[: problem.n_steps] for row, problem in zip(table, problems)]


def _mode_noise(draws: Sequence[int], n_steps: int, n_modes: int) -> FloatArray:
    """``(B, n_steps, n_modes)`` added to logits, their largest is a sample; none for draw 0."""
    noise = {
        draw: np.random.default_rng(draw).gumbel(size=(n_steps, n_modes)) if draw else 0.0
        for draw in set(draws)
    }
    rows = [np.broadcast_to(noise[draw], (n_steps, n_modes)) for draw in draws]
    return np.array(rows)


def _within_limits(scenario: Scenario, state: FloatArray, control: FloatArray) -> FloatArray:
    """Controls ``(B, 3)`` scaled down to the actuation limit at the states ``(B, 6)``."""
    clusters = scenario.robot.cluster_delta_v(state[:, 2], control)
    share = np.abs(clusters).max(axis=1) / scenario.robot.delta_v_max(scenario.dt)
    return control / np.maximum(share, 1.0)[:, None]
