"""Corrections: problems in flight where a model went, with their optima."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from art_policy.corrections import _in_flight, collect_corrections
from art_policy.layers import ARTConfig
from art_policy.model import ART
from freeflyer_datasets import PackedDataset, load_sample
from freeflyer_datasets.shards import LABEL_REL, LABEL_SCP
from freeflyer_env import Obstacles, Problem, Scenario


@pytest.fixture(scope="module")
def model() -> ART:
    torch.manual_seed(0)
    return ART(ARTConfig.small(width=32, n_layers=1, n_heads=2)).eval()


def test_corrections_are_a_dataset_of_feasible_optima(model: ART, tmp_path: Path) -> None:
    data = load_sample("scene-random-v0")
    found = collect_corrections(model, data, 30, tmp_path / "new", workers=1, progress=False)
    assert found.n_problems >= 3
    assert found.label[:].tolist() == [LABEL_REL, LABEL_SCP] * found.n_problems
    assert found.dataset_id == data.dataset_id
    final_times = data.final_time[:].max() - found.final_time[:]
    assert (final_times > 0.0).all()
    assert len(np.unique(final_times)) > 1
    for row in range(1, len(found), 2):
        problem = found.problem(int(found.problem_index[row]))
        trajectory = found.trajectory(row)
        assert trajectory.check(problem).satisfied(1e-5)  # controls are kept in float32
        assert trajectory.cost == pytest.approx(float(found.cost[row]), rel=1e-5)
        assert trajectory.cost >= found.rel_cost[found.problem_index[row]] - 1e-5


def test_problems_of_validation_are_not_touched(model: ART, tmp_path: Path) -> None:
    data = load_sample("scene-random-v0")
    held_out = np.unique(data.problem_index[data.split()[1]])
    found = collect_corrections(model, data, 200, tmp_path / "new", workers=2, progress=False)
    goals = {tuple(goal) for goal in data.goal[held_out]}
    assert not goals & {tuple(goal) for goal in found.goal[:]}


def test_what_is_left_begins_where_its_obstacles_are() -> None:
    obstacles = Obstacles([[1.5, 1.0]], [0.15], [[0.02, 0.0]])
    problem = Problem(Scenario(obstacles=obstacles), np.zeros(6) + 0.3, np.zeros(6) + 1.0)
    rest = _in_flight(problem, np.zeros(6) + 0.5, 20)
    assert rest.final_time == 30.0
    np.testing.assert_allclose(rest.scenario.obstacles.centres, [[1.7, 1.0]])
    np.testing.assert_allclose(rest.start, np.zeros(6) + 0.5)


def test_errors_say_what_to_do(model: ART, tmp_path: Path) -> None:
    data: PackedDataset = load_sample("scene-random-v0")
    with pytest.raises(ValueError, match="exists; choose another"):
        collect_corrections(model, data, 3, tmp_path)
    with pytest.raises(ValueError, match=r"TrainConfig\.tails"):
        collect_corrections(ART(ARTConfig()), data, 3, tmp_path / "new")
