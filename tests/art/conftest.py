"""A small packed dataset of solved problems, made once for all tests of this folder."""

from __future__ import annotations

import pytest
import torch

from freeflyer_datasets import Recipe, generate
from freeflyer_datasets.loading import PackedDataset


@pytest.fixture(scope="session", autouse=True)
def one_thread() -> None:
    """Sums in one order, whatever the machine."""
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> PackedDataset:
    """Random scenes with two to four obstacles, some moving, and two final times."""
    folder = tmp_path_factory.mktemp("shards")
    recipe = Recipe(
        id="freeflyer/tiny-v0",
        description="A tiny dataset.",
        n_problems=24,
        seed=7,
        n_obstacles=(2, 4),
        obstacle_speeds=(0.0, 0.02),
        final_times=(30.0, 40.0),
        n_starts=3,
    )
    generate(recipe, folder, workers=1, progress=False)
    return PackedDataset.from_shards(folder)
