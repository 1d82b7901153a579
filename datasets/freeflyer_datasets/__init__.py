"""Datasets of optimal free-flyer trajectories: recipes, generation, storage and loading.

Minari, HDF5 and the solvers are imported when they are used first.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

# Not lazily: a submodule's name would hide the function of the same name.
from freeflyer_datasets.describe import describe
from freeflyer_datasets.generate import GenerationReport, generate
from freeflyer_datasets.recipe import Recipe, list_recipes, load_recipe
from freeflyer_datasets.shards import LABEL_REL, LABEL_SCP

if TYPE_CHECKING:
    from freeflyer_datasets.export import build
    from freeflyer_datasets.loading import PackedDataset, list_samples, load_sample

__all__ = [
    "LABEL_REL",
    "LABEL_SCP",
    "GenerationReport",
    "PackedDataset",
    "Recipe",
    "build",
    "describe",
    "generate",
    "list_recipes",
    "list_samples",
    "load_recipe",
    "load_sample",
]


def __getattr__(name: str) -> Any:
    if name in ("PackedDataset", "list_samples", "load_sample"):
        from freeflyer_datasets import loading

        return getattr(loading, name)
    if name == "build":
        from freeflyer_datasets.export import build

        return build
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
