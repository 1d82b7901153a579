"""Training examples as tensors, built once, so that an epoch is nothing but tensor work."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from art_policy.envelope import Envelope
from art_policy.multi_hypothesis import HypothesisBatch
from art_policy.sequence import (
    DISC_SPEED,
    MIRROR_CONTROL,
    ProblemBatch,
    SequenceBatch,
    random_flags,
    reverse_controls,
)
from freeflyer_env.robot import FloatArray
from freeflyer_env.scenario import Scenario

if TYPE_CHECKING:
    from freeflyer_datasets.loading import PackedDataset

_LABEL_SCP = 1
_CHUNK = 4096  # trajectories that are rolled out at once
_OPENING = 16  # steps


class HypothesisSet:
    """Problems with their distinct optima as paths, for the multi-hypothesis head.

    Args:
        dataset: Source; problems without a solved trajectory are left out.
        trajectories: Indices of the trajectories to use.
        table: Size of the table in m, for augmentation.
        tails: Share of the problems of which one that begins in flight is added: what is left of
            one of the optima from a random node on, which is an optimum of what is left.
        max_discs: If given, augmentation adds discs to scenes that have fewer
            (:meth:`.HypothesisBatch.with_decoys`).
        n_samples: Number ``S`` of equally spaced times at which a path is compared.
        max_optima: Most optima ``R`` of one problem that are used, cheapest first.
    """

    def __init__(
        self,
        dataset: PackedDataset,
        trajectories: np.ndarray,
        table: tuple[float, float],
        tails: float = 0.0,
        max_discs: int | None = None,
        n_samples: int = 128,
        max_optima: int = 4,
    ) -> None:
        label, rank = np.asarray(dataset.label), np.asarray(dataset.rank)
        chosen = trajectories[
            (label[trajectories] == _LABEL_SCP) & (rank[trajectories] < max_optima)
        ]
        problems, slot = np.unique(np.asarray(dataset.problem_index)[chosen], return_inverse=True)
        n_optima = int(rank[chosen].max(initial=0)) + 1
        paths = np.zeros((len(problems), n_optima, n_samples, 3), dtype=np.float32)
        costs = np.full((len(problems), n_optima), np.inf, dtype=np.float32)
        for part, states in rollouts(dataset, chosen):
            paths[slot[part], rank[chosen[part]]] = deviations(states[:, :-1, :3], n_samples)
        costs[slot, rank[chosen]] = dataset.cost[chosen]
        # Without its cheapest optimum (beyond the chosen ranks, say) a problem teaches nothing.
        usable = np.isfinite(costs[:, 0])
        batch = HypothesisBatch(
            problem_batch(dataset, problems[usable]),
            torch.from_numpy(paths[usable]),
            torch.from_numpy(costs[usable]),
        )
        if tails:
            batch = _joined([batch, _tails(dataset, chosen, tails, n_optima, n_samples)])
        self._examples, self._table, self._dt = batch, table, dataset.dt
        self._max_discs = max_discs
        if max_discs is not None:
            self._examples = _padded(batch, max_discs, n_optima)

    @classmethod
    def joined(cls, sets: Sequence[HypothesisSet]) -> HypothesisSet:
        """The examples of several sets that were made with the same settings."""
        if len(sets) == 1:
            return sets[0]
        whole = copy.copy(sets[0])
        whole._examples = _joined([each._examples for each in sets])
        return whole

    @property
    def envelope(self) -> Envelope | None:
        """Ranges of the problems, with the discs that augmentation adds; None without problems."""
        problems = self._examples.problems
        if not len(problems):
            return None
        envelope = Envelope.of(problems)
        if self._max_discs is None:
            return envelope
        fewest, most = envelope.n_obstacles
        counts = (fewest, max(most, self._max_discs))
        return replace(
            envelope, n_obstacles=counts, obstacle_speed=max(envelope.obstacle_speed, DISC_SPEED)
        )

    def __len__(self) -> int:
        return len(self._examples)

    def to(self, device: torch.device | str) -> HypothesisSet:
        """The same on another device, where batches are made then."""
        moved = copy.copy(self)
        moved._examples = self._examples.to(device)
        return moved

    def batch(self, index: Tensor, generator: torch.Generator | None) -> HypothesisBatch:
        """The examples ``index``, each under a random symmetry if a ``generator`` is given."""
        every = self._examples
        index = index.to(every.costs.device)
        examples = HypothesisBatch(every.problems[index], every.paths[index], every.costs[index])
        if generator is None:
            return examples
        examples = examples.augmented(self._table, self._dt, generator)
        if self._max_discs is None:
            return examples
        return examples.with_decoys(self._table, self._dt, self._max_discs, generator)


#: Fewest steps that are left of a trajectory in a problem that begins in flight.
_SHORTEST_TAIL = 10


def _tails(
    dataset: PackedDataset, trajectories: np.ndarray, share: float, n_optima: int, n_samples: int
) -> HypothesisBatch:
    """What is left of one optimum of a share of the problems from a random node on; seeded."""
    rng = np.random.default_rng(0)
    order = rng.permutation(trajectories)
    _, first = np.unique(np.asarray(dataset.problem_index)[order], return_index=True)
    chosen = order[first][rng.random(len(first)) < share]
    n_steps = np.diff(dataset.offsets)[chosen]
    begin = rng.integers(1, np.maximum(n_steps - _SHORTEST_TAIL, 2))
    paths = np.zeros((len(chosen), n_optima, n_samples, 3), dtype=np.float32)
    costs = np.full((len(chosen), n_optima), np.inf, dtype=np.float32)
    start = np.zeros((len(chosen), 6), dtype=np.float32)
    for part, states in rollouts(dataset, chosen):
        for row, whole in zip(part, states):
            left = whole[begin[row] : -1, :3]
            paths[row, 0] = deviations(left[None], n_samples)[0]
            start[row] = whole[begin[row]]
            controls = dataset.controls_of([chosen[row]])[0]
            costs[row, 0] = np.abs(controls[begin[row] :]).sum()
    whole_problems = problem_batch(dataset, np.asarray(dataset.problem_index)[chosen])
    passed = torch.from_numpy((dataset.dt * begin).astype(np.float32))
    discs = whole_problems.discs.clone()
    discs[..., :3] = whole_problems.discs_at(passed[:, None])[:, 0]
    goal, final_time = whole_problems.goal, whole_problems.final_time - passed
    problems = ProblemBatch(torch.from_numpy(start), goal, discs, final_time)
    # Where nothing is left to pay for, no optimum is better than another.
    usable = torch.from_numpy(costs[:, 0] > 0.0)
    return HypothesisBatch(
        problems[usable], torch.from_numpy(paths)[usable], torch.from_numpy(costs)[usable]
    )


def _padded(batch: HypothesisBatch, n_discs: int, n_optima: int) -> HypothesisBatch:
    """The same with room for at least so many discs and optima."""
    problems = batch.problems
    more = max(n_discs - problems.discs.shape[1], 0)
    discs = F.pad(problems.discs, (0, 0, 0, more))
    more = max(n_optima - batch.costs.shape[1], 0)
    paths = F.pad(batch.paths, (0, 0, 0, 0, 0, more))
    costs = F.pad(batch.costs, (0, more), value=torch.inf)
    return HypothesisBatch(replace(problems, discs=discs), paths, costs)


def _joined(batches: Sequence[HypothesisBatch]) -> HypothesisBatch:
    n_discs = max(batch.problems.discs.shape[1] for batch in batches)
    n_optima = max(batch.costs.shape[1] for batch in batches)
    batches = [_padded(batch, n_discs, n_optima) for batch in batches]
    return HypothesisBatch(
        ProblemBatch.joined([batch.problems for batch in batches]),
        torch.cat([batch.paths for batch in batches]),
        torch.cat([batch.costs for batch in batches]),
    )


class SequenceSet:
    """Trajectories, relaxed and optimal, in windows for the autoregressive head.

    Args:
        dataset: Source.
        trajectories: Indices of the trajectories to use.
        table: Size of the table in m, for augmentation.
        length: Number of steps of a window, the model's context length.
        constant_budget: Whether the constraint-to-go stays what it is for the whole trajectory.
        max_optima: Most optima of one problem that are used, cheapest first.
        relaxed_returns: Whether the reward-to-go of optimal trajectories begins at minus REL's cost
            rather than their own.
        openings: Share of the batches that hold only the first steps of their trajectories.
    """

    def __init__(
        self,
        dataset: PackedDataset,
        trajectories: np.ndarray,
        table: tuple[float, float],
        length: int,
        constant_budget: bool = False,
        max_optima: int = 4,
        relaxed_returns: bool = False,
        openings: float = 0.0,
    ) -> None:
        kept = np.asarray(dataset.rank)[trajectories] < max_optima
        trajectories = trajectories[kept]
        problems, slot = np.unique(dataset.problem_index[trajectories], return_inverse=True)
        self._problems = problem_batch(dataset, problems)
        self._slot = torch.from_numpy(slot)
        self._first = torch.from_numpy(dataset.offsets[trajectories])
        self._n_steps = torch.from_numpy(np.diff(dataset.offsets)[trajectories])
        above = dataset.cost[trajectories] - dataset.rel_cost[problems][slot]
        self._above_rel = torch.from_numpy(np.maximum(above, 0.0).astype(np.float32))
        self._above_rel *= relaxed_returns
        with warnings.catch_warnings():
            # The file is mapped read-only, and nothing here writes.
            warnings.filterwarnings("ignore", message="The given NumPy array is not writable")
            self._controls = torch.from_numpy(np.asarray(dataset.controls))
        self._dt, self._robot = dataset.dt, dataset.robot
        self._table, self._length, self._constant_budget = table, length, constant_budget
        self._openings = openings

    @classmethod
    def joined(cls, sets: Sequence[SequenceSet]) -> SequenceSet:
        """The trajectories of several sets that were made with the same settings."""
        if len(sets) == 1:
            return sets[0]
        whole = copy.copy(sets[0])
        whole._problems = ProblemBatch.joined([each._problems for each in sets])
        problems = np.cumsum([0, *(len(each._problems) for each in sets)]).tolist()
        steps = np.cumsum([0, *(len(each._controls) for each in sets)]).tolist()
        whole._slot = torch.cat([each._slot + n for each, n in zip(sets, problems)])
        whole._first = torch.cat([each._first + n for each, n in zip(sets, steps)])
        whole._n_steps = torch.cat([each._n_steps for each in sets])
        whole._above_rel = torch.cat([each._above_rel for each in sets])
        whole._controls = torch.cat([each._controls for each in sets])
        return whole

    def to(self, device: torch.device | str) -> SequenceSet:
        """The same on another device, where batches are made then."""
        moved = copy.copy(self)
        moved._problems = self._problems.to(device)
        moved._slot, moved._first = self._slot.to(device), self._first.to(device)
        moved._above_rel = self._above_rel.to(device)
        moved._controls = self._controls.to(device)
        return moved

    @property
    def envelope(self) -> Envelope | None:
        """Ranges of the problems; None without problems."""
        return Envelope.of(self._problems) if len(self._problems) else None

    def __len__(self) -> int:
        return len(self._slot)

    def batch(self, index: Tensor, generator: torch.Generator | None) -> SequenceBatch:
        """The trajectories ``index``; random symmetries and windows if a ``generator`` is given."""
        device, most = self._slot.device, int(self._n_steps[index].max())
        n_steps, index = self._n_steps[index].to(device), index.to(device)
        problems = self._problems[self._slot[index]]
        step = torch.arange(most, device=device)
        inside = step < n_steps[:, None]
        rows = torch.where(inside, self._first[index, None] + step, 0)
        controls = self._controls[rows] * inside[..., None]
        if generator:
            mirror, reverse = (random_flags(len(index), generator).to(device) for _ in range(2))
            problems = problems.mirrored(mirror, self._table[1])
            problems = problems.reversed(reverse, self._table[0], self._dt)
            flip = controls.new_tensor(MIRROR_CONTROL[1])
            controls = torch.where(mirror[:, None, None], controls * flip, controls)
            flipped = reverse_controls(controls, n_steps)
            controls = torch.where(reverse[:, None, None], flipped, controls)
        whole = SequenceBatch.from_controls(problems, controls, n_steps, self._dt, self._robot)
        # What generation asks for, less what has been spent: never more than nothing.
        returns = (whole.returns_to_go + self._above_rel[index, None]).clamp(max=0.0)
        whole = replace(whole, returns_to_go=returns)
        if self._constant_budget:
            budget = whole.constraints_to_go[:, :1].expand_as(whole.constraints_to_go)
            whole = replace(whole, constraints_to_go=budget)
        if generator and float(torch.rand(1, generator=generator)) < self._openings:
            return whole.window(torch.zeros_like(n_steps), min(_OPENING, self._length, most))
        last = (n_steps - self._length).clamp(min=0)
        share = torch.rand(len(index), generator=generator) if generator else torch.zeros(1)
        first = (share.to(device) * (last + 1)).long()
        return whole.window(first, min(self._length, most))


def problem_batch(dataset: PackedDataset, problems: np.ndarray) -> ProblemBatch:
    """The problems of these indices, with keep-out radii in place of radii."""
    scenario = Scenario()
    table = np.asarray(dataset.obstacles[problems], dtype=np.float64)
    rows = np.zeros((*table.shape[:2], 5))
    rows[..., : table.shape[2]] = table
    radius = (rows[..., 2] + scenario.robot.radius) * scenario.keep_out_factor
    rows[..., 2] = np.where(rows[..., 2] > 0.0, radius, 0.0)
    columns = (dataset.start[problems], dataset.goal[problems], rows, dataset.final_time[problems])
    return ProblemBatch(*(torch.from_numpy(np.asarray(c, dtype=np.float32)) for c in columns))


def rollouts(
    dataset: PackedDataset, trajectories: np.ndarray
) -> Iterator[tuple[np.ndarray, FloatArray]]:
    """States of trajectories in chunks of equal length.

    Yields:
        Positions within ``trajectories`` ``(C,)``, and their states ``(C, N + 1, 6)``.
    """
    n_steps = np.diff(dataset.offsets)[trajectories]
    for length in np.unique(n_steps):
        same = np.flatnonzero(n_steps == length)
        for first in range(0, len(same), _CHUNK):
            part = same[first : first + _CHUNK]
            yield part, dataset.states(trajectories[part])


def deviations(poses: FloatArray, n_samples: int) -> FloatArray:
    """Deviation of node poses ``(B, N, 3)`` from the straight line, resampled: ``(B, S, 3)``."""
    share = np.linspace(0.0, 1.0, poses.shape[1])[:, None]
    away = poses - (1.0 - share) * poses[:, :1] - share * poses[:, -1:]
    position = np.linspace(0.0, poses.shape[1] - 1.0, n_samples)
    left = np.minimum(position.astype(int), poses.shape[1] - 2)
    weight = (position - left)[:, None]
    return (1.0 - weight) * away[:, left] + weight * away[:, left + 1]
