"""The Minari dataset: round trip, replay in the environment, checks before writing, card."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from freeflyer_datasets import LABEL_REL, PackedDataset, Recipe, build
from freeflyer_datasets.export import Credits, environment_spec, export
from freeflyer_datasets.packing import ARRAYS
from freeflyer_datasets.shards import iterate_shards
from freeflyer_datasets.storage import (
    EPISODE_ATTRIBUTES,
    Episode,
    EpisodeError,
    check_episode,
    shard_episodes,
)
from freeflyer_env import Problem

minari = pytest.importorskip("minari")


@pytest.fixture(scope="module")
def exported(shards: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data root that holds the tiny dataset; tests must not change it."""
    root = tmp_path_factory.mktemp("root")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(root))
        assert export(shards) == "freeflyer/tiny-v0"
    return root


@pytest.fixture
def dataset(exported: Path, monkeypatch: pytest.MonkeyPatch) -> minari.MinariDataset:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(exported))
    return minari.load_dataset("freeflyer/tiny-v0")


def test_round_trip(dataset, shards: Path):
    expected = [episode for shard in iterate_shards(shards) for episode in shard_episodes(shard)]
    assert dataset.total_episodes == len(expected)
    assert dataset.total_steps == sum(len(episode.actions) for episode in expected)
    metadata = list(dataset.storage.get_episode_metadata(range(len(expected))))
    for episode, attributes, want in zip(dataset, metadata, expected):
        assert episode.observations.keys() == want.observations.keys()
        for key, value in want.observations.items():
            np.testing.assert_array_equal(episode.observations[key], value)
            assert episode.observations[key].dtype == np.float32
        for name in ("actions", "rewards", "terminations", "truncations"):
            np.testing.assert_array_equal(getattr(episode, name), getattr(want, name))
            assert getattr(episode, name).dtype == getattr(want, name).dtype
        assert attributes == {
            "id": episode.id,
            "total_steps": len(want.actions),
            **want.attributes,
        }
        assert set(EPISODE_ATTRIBUTES) == set(want.attributes)
        assert "infos" in repr(episode)


def test_episodes_replay_in_the_recovered_environment(dataset):
    env = dataset.recover_environment()
    assert env.spec.id == "FreeFlyer-v0"
    assert env.observation_space == dataset.observation_space
    assert env.action_space == dataset.action_space
    for episode in dataset:
        first = {key: value[0] for key, value in episode.observations.items()}
        observation, _ = env.reset(options={"problem": Problem.from_dict(first)})
        for step, action in enumerate(episode.actions):
            compare(episode.observations, observation, step)
            observation, reward, terminated, truncated, _ = env.step(action)
            assert reward == pytest.approx(episode.rewards[step], abs=1e-7)
            assert terminated == episode.terminations[step]
            assert truncated == episode.truncations[step]
        compare(episode.observations, observation, len(episode.actions))
    env.close()


def compare(observations: dict, observation: dict, step: int) -> None:
    for key, value in observation.items():
        np.testing.assert_allclose(value, observations[key][step], rtol=0, atol=1e-6, err_msg=key)


def test_both_environments_can_be_made(dataset):
    for evaluation in (False, True):
        env = dataset.recover_environment(eval_env=evaluation)
        env.reset(seed=0)
        env.close()


def test_metadata_is_complete(dataset, recipe: Recipe):
    metadata = dataset.storage.metadata
    for key in ("author", "author_email", "code_permalink", "algorithm_name", "description"):
        assert metadata[key]
    assert metadata["requirements"] == ["freeflyer-gym>=0.1.0"]
    assert metadata["ref_min_score"] < metadata["ref_max_score"] < 1.0
    assert metadata["minari_version"] == minari.__version__
    assert metadata["dataset_size"] > 0
    assert Recipe.from_dict(metadata["recipe"]) == recipe
    assert "freeflyer/tiny-v0" in minari.list_local_datasets()
    scores = minari.get_normalized_score(dataset, np.array([metadata["ref_max_score"]]))
    assert scores == pytest.approx(1.0)


def test_packed_from_minari_equals_packed_from_shards(dataset, shards: Path, tmp_path: Path):
    ours = PackedDataset.from_minari(dataset.id, cache=tmp_path / "a")
    theirs = PackedDataset.from_shards(shards, cache=tmp_path / "b")
    for name in ARRAYS:
        first, second = getattr(ours, name), getattr(theirs, name)
        assert first.dtype == second.dtype, name
        np.testing.assert_array_equal(first, second, err_msg=name)
    again = PackedDataset.from_minari(dataset.id, cache=tmp_path / "a")
    assert again.dataset_id == "freeflyer/tiny-v0"


def test_an_episode_is_small(dataset):
    size = os.path.getsize(dataset.storage.data_path / "main_data.hdf5")
    assert size / dataset.total_episodes < 10_000


def test_the_card_says_what_is_in_it(exported: Path, recipe: Recipe):
    card = (exported / "freeflyer/tiny-v0/README.md").read_text()
    for text in (
        "# freeflyer/tiny-v0",
        "| problems | 10 |",
        "30, 40",
        "random",
        "Celestini",
        "MIT",
    ):
        assert text in card
    assert max(len(line) for line in card.splitlines()) < 120


def test_an_existing_dataset_is_kept_unless_forced(recipe: Recipe, shards: Path, data_root: Path):
    first = dataclasses.replace(recipe, n_problems=2)
    assert build(first, workers=1, progress=False) == recipe.id
    before = minari.load_dataset(recipe.id).total_episodes
    with pytest.raises(ValueError, match=r"already in .* force=True"):
        build(recipe, workers=1, progress=False)
    with pytest.raises(ValueError, match="already in"):
        export(shards)
    assert minari.load_dataset(recipe.id).total_episodes == before
    packed = PackedDataset.from_minari(recipe.id)
    assert packed.path == data_root / recipe.id / "packed"
    export(shards, force=True, credits=Credits(author="A. Person"))
    dataset = minari.load_dataset(recipe.id)
    assert dataset.total_episodes > before
    assert dataset.storage.metadata["author"] == {"A. Person"}
    assert len(PackedDataset.from_minari(recipe.id)) == dataset.total_episodes
    assert sorted(minari.list_local_datasets()) == [recipe.id]


def test_without_a_dataset_the_message_says_what_to_do():
    with pytest.raises(FileNotFoundError, match="MINARI_DATASETS_PATH"):
        PackedDataset.from_minari("freeflyer/absent-v0")


@pytest.fixture(scope="module")
def episode(shards: Path) -> Episode:
    return next(shard_episodes(next(iterate_shards(shards))))


def observations_with(episode: Episode, **changes: np.ndarray) -> dict[str, dict]:
    return {"observations": {**episode.observations, **changes}}


BAD_EPISODES = [
    (lambda e: observations_with(e, state=e.observations["state"][:-1]), "state has shape"),
    (lambda e: observations_with(e, goal=e.observations["goal"].astype(float)), "goal is float64"),
    (lambda e: observations_with(e, state=e.observations["state"] * np.nan), "state is not finite"),
    (lambda e: observations_with(e, time_to_go=e.observations["time_to_go"] - 50), "leaves its"),
    (lambda e: observations_with(e, goal=e.observations["goal"] + 1e-3), "from the goal"),
    (lambda e: observations_with(e, spin=e.observations["goal"]), "observation keys differ"),
    (lambda e: {"actions": e.actions * np.float32(1.01)}, "from the rollout of the actions"),
    (lambda e: {"actions": e.actions + np.float32(9.0)}, "actions leaves its space"),
    (lambda e: {"rewards": e.rewards * 1.01}, "return differs from minus the cost"),
    (lambda e: {"rewards": e.rewards[1:]}, "rewards has shape"),
    (lambda e: {"truncations": ~e.truncations}, "must end at its last step only"),
    (lambda e: {"attributes": {**e.attributes, "c_rel": 60}}, "nodes violate keep-out, not 60"),
]


@pytest.mark.parametrize(("change", "match"), BAD_EPISODES)
def test_bad_episodes_are_refused(episode: Episode, recipe: Recipe, change, match):
    env = gym.make(environment_spec(recipe))
    spaces = env.observation_space, env.action_space
    check_episode(episode, *spaces)
    bad = dataclasses.replace(episode, **change(episode))
    with pytest.raises(EpisodeError, match=f"Problem 0, label {LABEL_REL}.*{match}"):
        check_episode(bad, *spaces)


def test_a_bad_episode_leaves_nothing_behind(shards: Path, data_root: Path, monkeypatch):
    def refuse(*_):
        raise EpisodeError("as a test")

    monkeypatch.setattr("freeflyer_datasets.export.check_episode", refuse)
    with pytest.raises(EpisodeError, match="as a test"):
        export(shards)
    assert not [path for path in data_root.rglob("*") if path.is_file()]
