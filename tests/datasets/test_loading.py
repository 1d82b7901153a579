"""Packed datasets: contents, split, cache."""

from __future__ import annotations

import json
import pickle
import shutil
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from freeflyer_datasets import (
    LABEL_SCP,
    PackedDataset,
    Recipe,
    list_recipes,
    list_samples,
    load_recipe,
    load_sample,
)
from freeflyer_datasets.generate import solve_problems
from freeflyer_datasets.shards import iterate_shards, list_shards


@pytest.fixture
def packed(shards: Path, tmp_path: Path) -> PackedDataset:
    return PackedDataset.from_shards(shards, cache=tmp_path / "packed")


def test_contents_are_those_of_the_shards(packed: PackedDataset, shards: Path, recipe: Recipe):
    assert packed.n_problems == recipe.n_problems
    assert packed.dataset_id == recipe.id
    assert packed.obstacles.shape == (recipe.n_problems, recipe.max_obstacles, 5)  # some move
    assert packed.controls.dtype == np.float32
    row = 0
    for shard in iterate_shards(shards):
        for index in range(shard.n_trajectories):
            assert packed.problem_index[row] == shard.first + shard.problem[index]
            np.testing.assert_array_equal(packed.controls_of([row])[0], shard.controls_of(index))
            row += 1
    assert len(packed) == row


def test_trajectories_solve_their_problems(packed: PackedDataset):
    for index in np.flatnonzero(packed.label == LABEL_SCP):
        trajectory = packed.trajectory(index)
        problem = packed.problem(packed.problem_index[index])
        assert trajectory.check(problem).satisfied(1e-6)
        assert trajectory.cost == pytest.approx(packed.cost[index], rel=1e-6)


def test_states_in_batches(packed: PackedDataset):
    rows = np.flatnonzero(packed.n_steps == packed.n_steps[0])
    states = packed.states(rows)
    assert states.shape == (len(rows), packed.n_steps[0] + 1, 6)
    for row, expected in zip(rows, states):
        np.testing.assert_array_equal(packed.trajectory(row).states, expected)
    with pytest.raises(ValueError, match=r"equal lengths, got \[60 80\]"):
        packed.states(np.arange(len(packed)))


def test_split_is_by_problem_and_deterministic(packed: PackedDataset):
    training, validation = packed.split(0.3)
    assert sorted([*training, *validation]) == list(range(len(packed)))
    sides = [set(packed.problem_index[side]) for side in (training, validation)]
    assert not sides[0] & sides[1]
    assert sides[1]
    again = packed.split(0.3)
    np.testing.assert_array_equal(again[1], validation)
    assert set(packed.split(1e-9)[1]) <= set(validation)
    with pytest.raises(ValueError, match="validation_fraction"):
        packed.split(1.0)


def test_a_problem_stays_on_its_side_when_the_dataset_grows(shards: Path, tmp_path: Path):
    sides = []
    for n_problems in (6, 10):
        packed = PackedDataset.from_shards(shards, n_problems, tmp_path / str(n_problems))
        sides.append(set(packed.problem_index[packed.split(0.3)[1]]))
        assert packed.n_problems == n_problems
    assert {problem for problem in sides[1] if problem < 6} == sides[0]


def test_pickles_as_its_path(packed: PackedDataset):
    data = pickle.dumps(packed)
    assert len(data) < 1000
    np.testing.assert_array_equal(pickle.loads(data).controls, packed.controls)


def test_cache_is_kept_while_valid_and_made_again_when_not(shards: Path, tmp_path: Path):
    folder = tmp_path / "shards"
    shutil.copytree(shards, folder)
    path = PackedDataset.from_shards(folder).path
    assert path == folder / "packed"

    def stamp() -> int:
        return (path / "meta.json").stat().st_mtime_ns

    made = stamp()
    assert len(PackedDataset.from_shards(folder)) > 0
    assert stamp() == made
    list_shards(folder)[-1].unlink()  # the source changes
    assert PackedDataset.from_shards(folder).n_problems == 8
    made = stamp()
    (path / "cost.npy").write_bytes(b"")  # a file is truncated
    assert PackedDataset.from_shards(folder).cost.size > 0
    assert stamp() != made
    meta = json.loads((path / "meta.json").read_text())
    (path / "meta.json").write_text(json.dumps({**meta, "version": 0}))
    assert PackedDataset.from_shards(folder).n_problems == 8
    assert json.loads((path / "meta.json").read_text()) == meta


def test_open_refuses_what_is_damaged(packed: PackedDataset, tmp_path: Path):
    PackedDataset.open(packed.path, verify=True)
    path = packed.path / "controls.npy"
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"controls.npy.*checksum"):
        PackedDataset.open(packed.path, verify=True)
    with pytest.raises(ValueError, match="not a packed dataset"):
        PackedDataset.open(tmp_path)


@pytest.mark.parametrize("name", list_samples())
def test_samples_are_the_first_problems_of_their_recipes(name):
    sample, recipe = load_sample(name), load_recipe(name)
    assert sample.dataset_id == recipe.id
    assert sample.n_problems == 200
    for index in (0, 57, 199):
        assert sample.problem(index).to_dict() == recipe.problem(index).to_dict()
    shard = solve_problems(recipe, 0, 1)
    first = np.flatnonzero(sample.problem_index == 0)
    np.testing.assert_allclose(sample.cost[first], shard.cost, rtol=1e-5)
    for row in np.flatnonzero(sample.label == LABEL_SCP)[:40:8]:
        problem = sample.problem(int(sample.problem_index[row]))
        assert sample.trajectory(row).check(problem).satisfied(2e-6)


def test_every_recipe_has_a_sample_and_a_wrong_name_is_one_line():
    assert list_samples() == list_recipes()
    assert len(load_sample("freeflyer/time-4-v0")) == len(load_sample("time-4-v0"))
    with pytest.raises(ValueError, match="Did you mean 'time-4-v0'"):
        load_sample("time4-v0")


def test_windows_are_parts_of_the_trajectories():
    sample = load_sample("time-4-v0")
    rows, first = np.array([0, 7, 300, 831]), np.array([0, 15, 60, 70])
    states, controls, inside = sample.windows(rows, first, 40)
    assert states.shape == (4, 40, 6)
    for number, (row, begin) in enumerate(zip(rows, first)):
        trajectory = sample.trajectory(row)
        n = min(40, trajectory.n_steps - begin)
        assert inside[number].sum() == n
        np.testing.assert_allclose(
            states[number, :n], trajectory.states[begin : begin + n], atol=1e-12
        )
        np.testing.assert_array_equal(
            controls[number, :n], sample.controls_of([row])[0][begin : begin + n]
        )
        assert not controls[number, n:].any()
    with pytest.raises(ValueError, match="begin within"):
        sample.windows([0], [400], 5)


def test_transitions_are_the_flattened_episodes():
    sample = load_sample("scene-random-v0")
    flat = sample.transitions([3, 4, 9])
    env = gym.make("freeflyer_env:FreeFlyer-v0")
    problem = sample.problem(int(sample.problem_index[3]))
    observation, _ = env.reset(options={"problem": problem})
    expected = gym.spaces.flatten(env.observation_space, observation)
    np.testing.assert_allclose(flat["observations"][0], expected, rtol=1e-6)
    assert {name: len(value) for name, value in flat.items()} == dict.fromkeys(flat, 240)
    assert np.flatnonzero(flat["terminals"]).tolist() == [79, 159, 239]
    assert flat["rewards"][:80].sum() == pytest.approx(-sample.cost[3], rel=1e-5)


def test_d3rlpy_clones_the_behaviour():
    d3rlpy = pytest.importorskip("d3rlpy")
    sample = load_sample("scene-random-v0")
    dataset = d3rlpy.dataset.MDPDataset(**sample.transitions(range(40)))
    algorithm = d3rlpy.algos.BCConfig(batch_size=64).create(device=False)
    history = algorithm.fit(
        dataset, n_steps=50, n_steps_per_epoch=50, show_progress=False, save_interval=100,
        logger_adapter=d3rlpy.logging.NoopAdapterFactory(),
    )  # fmt: skip
    assert len(history) == 1
    assert algorithm.predict(sample.transitions([0])["observations"]).shape == (80, 3)
