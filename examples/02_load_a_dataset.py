"""Make a tiny dataset, load it with Minari, and read it packed, as training does.

The published datasets load in the same way, for example ``freeflyer/scene-random-v0``.
"""

from __future__ import annotations

import os
import tempfile

import minari
import numpy as np

from freeflyer_datasets import LABEL_SCP, PackedDataset, Recipe, build


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        os.environ["MINARI_DATASETS_PATH"] = folder
        recipe = Recipe(
            id="freeflyer/example-v0",
            description="Eight random problems.",
            n_problems=8,
            seed=0,
        )
        dataset = minari.load_dataset(build(recipe, workers=1))
        print(f"{dataset.id}: {dataset.total_episodes} episodes, {dataset.total_steps} steps")
        episode = dataset[0]
        for name, value in episode.observations.items():
            print(f"  observations[{name!r}]: {value.shape}")
        print(f"  actions: {episode.actions.shape}, return {episode.rewards.sum():.3f} m/s")

        packed = PackedDataset.from_minari(dataset.id)
        training, validation = packed.split(validation_fraction=0.25)
        print(f"{len(training)} trajectories to train on, {len(validation)} to validate")
        best = np.flatnonzero((packed.label == LABEL_SCP) & (packed.rank == 0))
        ratio = packed.cost[best] / packed.rel_cost[packed.problem_index[best]]
        print(f"states {packed.states(best).shape}; cost over that of REL: {ratio.mean():.2f}")


if __name__ == "__main__":
    main()
