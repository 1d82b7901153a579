"""Batches of problems and trajectories, and the symmetries of the problem."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from functools import partial

import numpy as np
import pytest
import torch
from torch import Tensor

from art_policy.multi_hypothesis import disc_features, problem_features
from art_policy.sequence import (
    MIRROR_CONTROL,
    ProblemBatch,
    SequenceBatch,
    keep_out_depth,
    random_flags,
    reverse_controls,
)
from art_policy.training_data import HypothesisSet, SequenceSet, deviations
from freeflyer_datasets.loading import PackedDataset, load_sample
from freeflyer_datasets.shards import LABEL_REL, LABEL_SCP
from freeflyer_env import constraints
from freeflyer_env.planning import Trajectory, solve_scp, to_go
from freeflyer_env.scenario import Obstacles, Problem, Scenario

LENGTH, WIDTH = Scenario().table
YES = torch.tensor([True])


def mirrored_x(problem: ProblemBatch, controls: Tensor) -> tuple[ProblemBatch, Tensor]:
    return problem.mirrored(YES, LENGTH, axis=0), controls * controls.new_tensor(MIRROR_CONTROL[0])


def mirrored_y(problem: ProblemBatch, controls: Tensor) -> tuple[ProblemBatch, Tensor]:
    return problem.mirrored(YES, WIDTH), controls * controls.new_tensor(MIRROR_CONTROL[1])


def reversed_in_time(problem: ProblemBatch, controls: Tensor) -> tuple[ProblemBatch, Tensor]:
    return problem.reversed(YES, LENGTH), reverse_controls(
        controls, torch.tensor([controls.shape[1]])
    )


def turned(problem: ProblemBatch, controls: Tensor) -> tuple[ProblemBatch, Tensor]:
    quarter = torch.zeros(6, dtype=torch.float64)
    quarter[2] = np.pi / 2
    start, goal = problem.start + quarter, problem.goal + quarter
    return ProblemBatch(start, goal, problem.discs, problem.final_time), controls


def double(batch: ProblemBatch) -> ProblemBatch:
    return ProblemBatch(*(getattr(batch, item.name).double() for item in fields(batch)))


def to_problem(batch: ProblemBatch) -> Problem:
    """The first problem of a batch; the inverse of ``ProblemBatch.from_problems``."""
    scenario = Scenario()
    rows = batch.discs[0][batch.present[0]].numpy().copy()
    rows[:, 2] = rows[:, 2] / scenario.keep_out_factor - scenario.robot.radius
    scene = Scenario(obstacles=Obstacles.from_rows(rows))
    return Problem(scene, batch.start[0].numpy(), batch.goal[0].numpy(), float(batch.final_time[0]))


@pytest.mark.parametrize("symmetry", [mirrored_x, mirrored_y, reversed_in_time, turned])
def test_symmetries_keep_feasibility_and_cost(dataset: PackedDataset, symmetry: Callable) -> None:
    scp = np.flatnonzero(dataset.label == LABEL_SCP)
    for index in scp[:12]:
        problem, trajectory = (
            dataset.problem(dataset.problem_index[index]),
            dataset.trajectory(index),
        )
        before = trajectory.check(problem)
        batch = double(ProblemBatch.from_problems([problem]))
        batch, controls = symmetry(batch, torch.from_numpy(trajectory.controls)[None])
        image = to_problem(batch)
        moved = Trajectory.from_controls(image, controls[0].numpy())
        # The stored problem and controls are float32: what they miss the goal by stays, no more.
        slack = 1e-6 + 1.5 * max(before.goal, before.keep_out, before.table)
        assert moved.check(image).satisfied(tolerance=slack), (index, moved.check(image).worst)
        assert moved.cost == pytest.approx(trajectory.cost, rel=1e-12)
        assert not np.allclose(moved.states, trajectory.states)


def test_quarter_turns_of_the_body_do_not_change_the_features(dataset: PackedDataset) -> None:
    batch = double(ProblemBatch.from_problems([dataset.problem(i) for i in range(6)]))
    image, _ = turned(batch, torch.zeros(6, 4, 3))
    table = (LENGTH, WIDTH)
    torch.testing.assert_close(problem_features(batch, table), problem_features(image, table))
    torch.testing.assert_close(disc_features(batch, table), disc_features(image, table))


def test_augmented_paths_are_those_of_the_augmented_problems(dataset: PackedDataset) -> None:
    training = HypothesisSet(dataset, np.arange(len(dataset)), (LENGTH, WIDTH))
    index, generator = torch.arange(len(training)), torch.Generator().manual_seed(3)
    batch = training.batch(index, generator)
    twin = torch.Generator().manual_seed(3)
    mirror, reverse = random_flags(len(index), twin), random_flags(len(index), twin)
    for row in range(len(index)):
        first = np.flatnonzero((dataset.label == LABEL_SCP) & (dataset.rank == 0))[row]
        controls = torch.from_numpy(dataset.controls_of([first])).double()
        problem = double(
            ProblemBatch.from_problems([dataset.problem(dataset.problem_index[first])])
        )
        if mirror[row]:
            problem, controls = mirrored_y(problem, controls)
        if reverse[row]:
            problem, controls = reversed_in_time(problem, controls)
        expected = Trajectory.from_controls(to_problem(problem), controls[0].numpy()).states
        path = deviations(expected[None, :-1, :3], batch.paths.shape[2])[0]
        np.testing.assert_allclose(batch.paths[row, 0].numpy(), path, atol=1e-5)
        np.testing.assert_allclose(batch.problems.start[row], problem.start[0], atol=1e-6)


def test_tails_are_solved_problems_that_begin_in_flight(dataset: PackedDataset) -> None:
    every = np.arange(len(dataset))
    without = HypothesisSet(dataset, every, (LENGTH, WIDTH))
    training = HypothesisSet(dataset, every, (LENGTH, WIDTH), tails=1.0)
    assert len(training) == 2 * len(without)
    tails = training.batch(torch.arange(len(without), len(training)), None)
    assert (tails.problems.start[:, 3:].norm(dim=1) > 0.0).all()
    assert tails.costs[:, 0].isfinite().all()
    for row in range(0, len(tails), 3):
        problem = to_problem(tails.problems[torch.tensor([row])])
        knots = tails.paths[row].numpy()[0]
        share = np.linspace(0.0, 1.0, problem.n_steps)
        at = np.linspace(0.0, 1.0, len(knots))
        away = np.column_stack([np.interp(share, at, knots[:, axis]) for axis in range(3)])
        line = problem.start[:3] + share[:, None] * (problem.goal[:3] - problem.start[:3])
        result = solve_scp(problem, Trajectory.from_poses(problem, line + away))
        assert result.solved
        assert result.cost == pytest.approx(float(tails.costs[row, 0]), rel=0.02, abs=1e-4)


def test_decoys_leave_the_cheapest_optimum_what_it_is(dataset: PackedDataset) -> None:
    every = np.arange(len(dataset))
    index, most = torch.arange(24), 12
    plain = HypothesisSet(dataset, every, (LENGTH, WIDTH))
    training = HypothesisSet(dataset, every, (LENGTH, WIDTH), max_discs=most)
    batch = training.batch(index, torch.Generator().manual_seed(3))
    before = plain.batch(index, torch.Generator().manual_seed(3))
    n_before = before.problems.present.sum(1)
    assert batch.problems.discs.shape == (len(index), most, 5)
    torch.testing.assert_close(batch.paths[:, 0], before.paths[:, 0])
    torch.testing.assert_close(batch.costs[:, 0], before.costs[:, 0])
    assert (batch.costs >= before.costs).all()  # some others are blocked, that is, infinite
    assert (batch.problems.present.sum(1) > n_before + 2).float().mean() > 0.3
    assert batch.problems.discs[..., 3:].any()
    assert not training.batch(index, None).problems.present[:, n_before.max() :].any()
    fewer = HypothesisSet(dataset, every, (LENGTH, WIDTH), max_discs=3)
    capped = fewer.batch(index, torch.Generator().manual_seed(3)).problems.present.sum(1)
    assert (capped <= n_before.clamp(min=3)).all()
    assert (capped > n_before).any() or (n_before >= 3).all()
    for row in range(0, len(index), 4):
        problem = to_problem(batch.problems[torch.tensor([row])])
        knots = batch.paths[row, 0].numpy()
        share = np.linspace(0.0, 1.0, problem.n_steps)
        at = np.linspace(0.0, 1.0, len(knots))
        away = np.column_stack([np.interp(share, at, knots[:, axis]) for axis in range(3)])
        line = problem.start[:3] + share[:, None] * (problem.goal[:3] - problem.start[:3])
        result = solve_scp(problem, Trajectory.from_poses(problem, line + away))
        assert result.solved
        assert result.cost == pytest.approx(float(batch.costs[row, 0]), rel=0.01)


def test_joined_sets_hold_the_examples_of_each(dataset: PackedDataset) -> None:
    every = np.arange(len(dataset))
    table, generator = (LENGTH, WIDTH), torch.Generator()
    sample = load_sample("general-v0")
    for make in (HypothesisSet, partial(SequenceSet, length=20)):
        one = make(dataset, every, table)
        other = make(sample, np.arange(60), table)
        both = type(one).joined([one, other])
        assert len(both) == len(one) + len(other)
        for each, index in ((one, torch.arange(5)), (other, len(one) + torch.arange(5))):
            mine = both.batch(index, None).problems
            theirs = each.batch(torch.arange(5), None).problems
            torch.testing.assert_close(mine.start, theirs.start)
            torch.testing.assert_close(mine.final_time, theirs.final_time)
            n = theirs.discs.shape[1]
            torch.testing.assert_close(mine.discs[:, :n], theirs.discs)
            assert not mine.discs[:, n:].any()
        assert both.batch(torch.tensor([0, len(one)]), generator) is not None
    joined, alone = both.batch(len(one) + torch.arange(5), None), other.batch(torch.arange(5), None)
    torch.testing.assert_close(joined.controls, alone.controls)


def test_the_constraint_to_go_may_stay_what_it_was(dataset: PackedDataset) -> None:
    every, table = np.arange(len(dataset)), (LENGTH, WIDTH)
    index = torch.arange(len(dataset))
    falling, constant = (
        SequenceSet(dataset, every, table, 200, constant_budget=flag).batch(index, None)
        for flag in (False, True)
    )
    assert (falling.constraints_to_go.diff(dim=1) < 0).any()
    first = falling.constraints_to_go[:, :1]
    assert (constant.constraints_to_go == first).all()


def test_hypothesis_set_holds_the_optima_cheapest_first(dataset: PackedDataset) -> None:
    training = HypothesisSet(dataset, np.arange(len(dataset)), (LENGTH, WIDTH))
    costs = training.batch(torch.arange(len(training)), None).costs
    assert costs[:, 0].isfinite().all()
    padded = costs.nan_to_num(posinf=1e9)
    assert (padded.diff(dim=1) >= 0.0).all()
    assert int(costs.isfinite().sum()) == int((dataset.label == LABEL_SCP).sum())


def test_sequence_batch_agrees_with_trajectory(dataset: PackedDataset) -> None:
    for index in range(0, len(dataset), 5):
        problem, expected = dataset.problem(dataset.problem_index[index]), dataset.trajectory(index)
        controls = torch.from_numpy(expected.controls)[None]
        batch = SequenceBatch.from_controls(
            double(ProblemBatch.from_problems([problem])),
            torch.cat([controls, torch.zeros(1, 7, 3)], dim=1),
            torch.tensor([expected.n_steps]),
            dataset.dt,
            dataset.robot,
        )
        n = expected.n_steps
        assert batch.valid[0].sum() == n
        assert not batch.valid[0, n:].any()
        np.testing.assert_allclose(batch.states[0, :n], expected.states[:-1], atol=1e-6)
        np.testing.assert_allclose(batch.next_states[0, : n - 1], expected.states[1:-1], atol=1e-6)
        returns = to_go(expected.rewards())
        np.testing.assert_allclose(batch.returns_to_go[0, :n], returns, atol=1e-6)
        budget = to_go(expected.violations(problem)) if dataset.label[index] == LABEL_REL else 0.0
        np.testing.assert_allclose(batch.constraints_to_go[0, :n], budget)
        np.testing.assert_allclose(batch.time_to_go[0, 0], problem.final_time)
        assert batch.time_to_go[0, n - 1] == dataset.dt


def test_windows_are_parts_of_the_trajectory(dataset: PackedDataset) -> None:
    whole = SequenceSet(dataset, np.arange(len(dataset)), (LENGTH, WIDTH), 200)
    part = SequenceSet(dataset, np.arange(len(dataset)), (LENGTH, WIDTH), 16)
    index = torch.arange(len(whole))
    full = whole.batch(index, torch.Generator().manual_seed(1))
    window = part.batch(index, torch.Generator().manual_seed(1))
    assert window.valid.all()
    assert full.valid.sum(1).tolist() == np.diff(dataset.offsets).tolist()
    first = ((full.time_to_go[:, 0] - window.time_to_go[:, 0]) / dataset.dt).round().long()
    assert len(first.unique()) > 5
    rows = torch.arange(len(index))
    torch.testing.assert_close(full.states[rows, first], window.states[:, 0])
    torch.testing.assert_close(full.returns_to_go[rows, first + 15], window.returns_to_go[:, 15])


def test_keep_out_depth_agrees_with_the_constraint_check(dataset: PackedDataset) -> None:
    problems = [dataset.problem(i) for i in range(8)]
    assert any(problem.scenario.obstacles.moving for problem in problems)
    rng = np.random.default_rng(0)
    positions, times = rng.uniform((0.0, 0.0), (3.5, 2.5), (8, 50, 2)), rng.uniform(0, 40, (8, 50))
    discs = double(ProblemBatch.from_problems(problems)).discs_at(torch.tensor(times))
    depth = keep_out_depth(discs, torch.tensor(positions))
    for row, problem in zip(range(8), problems):
        expected = constraints.keep_out_depth(problem.scenario, positions[row], times[row])
        np.testing.assert_allclose(depth[row], expected, atol=1e-6)


def test_padding_obstacles_stay_padding(dataset: PackedDataset) -> None:
    batch = ProblemBatch.from_problems([dataset.problem(i) for i in range(12)])
    which = torch.arange(12) % 2 == 0
    image = batch.mirrored(which, WIDTH).reversed(~which, LENGTH)
    assert torch.equal(batch.present, image.present)
    assert not batch.present.all()


def test_relaxed_returns_begin_at_the_cost_of_rel(dataset: PackedDataset) -> None:
    rows = np.arange(len(dataset))
    hindsight = SequenceSet(dataset, rows, (LENGTH, WIDTH), 200)
    relaxed = SequenceSet(dataset, rows, (LENGTH, WIDTH), 200, relaxed_returns=True)
    index = torch.arange(len(hindsight))
    own, asked = (each.batch(index, None) for each in (hindsight, relaxed))
    rel_cost = torch.tensor(dataset.rel_cost[dataset.problem_index[rows]], dtype=torch.float32)
    torch.testing.assert_close(asked.returns_to_go[:, 0], -rel_cost, atol=1e-5, rtol=0.0)
    assert (asked.returns_to_go >= own.returns_to_go - 1e-6).all()
    assert (asked.returns_to_go <= 0.0).all()
    spent = asked.controls[:, 0].abs().sum(1)
    expected = (asked.returns_to_go[:, 0] + spent).clamp(max=0.0)
    torch.testing.assert_close(asked.returns_to_go[:, 1], expected, atol=1e-5, rtol=0.0)


def test_only_the_cheapest_optima_are_used(dataset: PackedDataset) -> None:
    rows = np.arange(len(dataset))
    best = SequenceSet(dataset, rows, (LENGTH, WIDTH), 200, max_optima=1)
    assert len(best) == (np.asarray(dataset.rank) == 0).sum() < len(rows)
