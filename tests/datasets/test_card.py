"""The card, its pictures, and what `freeflyer info` tells of a dataset."""

from __future__ import annotations

import json
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from art_policy import cli
from freeflyer_datasets import Recipe
from freeflyer_datasets.card import Statistics, dataset_card, recipe_toml, wilson_interval
from freeflyer_datasets.describe import describe, describe_text, list_local
from freeflyer_datasets.export import export
from freeflyer_datasets.pictures import HISTOGRAMS, PLATE
from freeflyer_datasets.shards import LABEL_REL, iterate_shards


@pytest.fixture
def dataset(shards: Path, data_root: Path, recipe: Recipe) -> Path:
    """The folder of the exported dataset."""
    return data_root / export(shards)


def test_statistics_agree_with_the_shards(shards: Path):
    statistics = Statistics.of_shards(iterate_shards(shards))
    all_shards = list(iterate_shards(shards))
    labels = np.concatenate([shard.label for shard in all_shards])
    assert statistics.n_problems == sum(shard.n_problems for shard in all_shards)
    assert len(statistics.rel_cost) == (labels == LABEL_REL).sum()
    assert len(statistics.scp_iterations) == (labels != LABEL_REL).sum()
    summary = statistics.summary()
    assert summary["episodes"] == {"REL": int((labels == LABEL_REL).sum()),
                                   "SCP": int((labels != LABEL_REL).sum())}  # fmt: skip
    assert summary["rel_feasible"][0] == pytest.approx((statistics.c_rel == 0).mean())
    assert json.loads(json.dumps(summary)) == summary


@pytest.mark.parametrize(
    ("successes", "n", "low", "high"),
    [(0, 10, 0.0, 0.2775), (5, 10, 0.2366, 0.7634), (81, 263, 0.2553, 0.3662), (0, 0, 0, 1)],
)
def test_wilsons_interval(successes, n, low, high):
    """The third row is the example of Newcombe (1998)."""
    assert wilson_interval(successes, n) == pytest.approx((low, high), abs=1e-4)


def test_the_recipe_on_the_card_is_the_recipe(dataset: Path, recipe: Recipe):
    card = (dataset / "README.md").read_text()
    text = card.split("```toml\n")[1].split("```")[0]
    assert Recipe.from_dict(tomllib.loads(text)) == recipe


def test_a_range_of_final_times_stays_a_range(recipe: Recipe):
    from dataclasses import replace

    times = tuple(np.arange(40.0, 100.5, 0.5).tolist())
    long = replace(recipe, final_times=times)
    text = recipe_toml(long, 7)
    assert "range = [40.0, 100.0]" in text
    assert Recipe.from_dict(tomllib.loads(text)) == replace(long, n_problems=7)


def test_the_pictures_are_small_shown_and_always_the_same(dataset: Path, shards: Path):
    card = (dataset / "README.md").read_text()
    before = {}
    for name in (HISTOGRAMS, PLATE):
        before[name] = (dataset / name).read_bytes()
        assert 5_000 < len(before[name]) < 300_000
        assert f"({name})" in card
    export(shards, force=True)
    assert {name: (dataset / name).read_bytes() for name in before} == before


def test_without_matplotlib_there_are_only_no_pictures(shards, data_root, monkeypatch, caplog):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    folder = data_root / export(shards)
    assert "no pictures" in caplog.text
    assert not list(folder.glob("*.png"))
    assert "![" not in (folder / "README.md").read_text()


def test_front_matter_is_what_the_hub_reads(recipe: Recipe, shards: Path):
    statistics = Statistics.of_shards(iterate_shards(shards))
    card = dataset_card(recipe, statistics, "0.1.0", 12_345)
    front = card.split("---\n")[1]
    assert "viewer: false" in front
    assert "size_categories: [n<1K]" in front


def test_info_describes_a_dataset(dataset: Path, recipe: Recipe, capsys):
    assert list_local() == [recipe.id]
    data = describe(recipe.id)
    assert data["episodes"] == sum(data["statistics"]["episodes"].values())
    assert cli.main(["info", recipe.id]) == 0
    printed = capsys.readouterr().out
    assert describe_text(data) in printed
    assert f"episodes: {data['episodes']}" in printed
    assert cli.main(["info", recipe.id, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["steps"] == data["steps"]


def test_a_dataset_without_statistics_is_described_by_its_episodes(dataset: Path, recipe: Recipe):
    path = dataset / "data" / "metadata.json"
    metadata = json.loads(path.read_text())
    whole = metadata.pop("statistics")
    path.write_text(json.dumps(metadata))
    sampled = describe(recipe.id)["statistics"]
    for name in ("rel_cost", "best_cost", "c_rel", "rel_feasible"):
        assert sampled[name] == pytest.approx(whole[name], rel=1e-5)


def test_an_unknown_dataset_is_one_line(dataset: Path, capsys):
    assert cli.main(["info", "freeflyer/tiny-v1"]) == 2
    assert "Did you mean 'freeflyer/tiny-v0'?" in capsys.readouterr().err
    assert cli.main(["info", "freeflyer/scene-random-v0"]) == 2
    assert "freeflyer generate scene-random-v0" in capsys.readouterr().err
