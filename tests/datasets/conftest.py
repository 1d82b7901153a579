"""A tiny recipe and its shards, made once for all tests of this folder."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

from freeflyer_datasets import Recipe, generate

SHARD_SIZE = 4

# The package's attribute of this name is the function.
GENERATE_MODULE = importlib.import_module("freeflyer_datasets.generate")


@pytest.fixture(scope="session")
def recipe() -> Recipe:
    """Random scenes with a varying number of obstacles, two final times, two starts; some
    obstacles move."""
    return Recipe(
        id="freeflyer/tiny-v0",
        description="A tiny dataset.",
        n_problems=10,
        seed=12,
        n_obstacles=(2, 4),
        obstacle_speeds=(0.0, 0.02),
        final_times=(30.0, 40.0),
        n_starts=2,
    )


@pytest.fixture(autouse=True)
def small_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shards of four problems."""
    monkeypatch.setattr(GENERATE_MODULE, "SHARD_SIZE", SHARD_SIZE)


@pytest.fixture(scope="session")
def shards(recipe: Recipe, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with three shards; tests must not change it."""
    folder = tmp_path_factory.mktemp("shards")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(GENERATE_MODULE, "SHARD_SIZE", SHARD_SIZE)
        generate(recipe, folder, workers=1, progress=False)
    return folder


@pytest.fixture(autouse=True)
def data_root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty data root for Minari."""
    root = tmp_path / "minari"
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(root))
    return root
