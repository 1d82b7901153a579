"""Export: from a recipe, or its shards, to a Minari dataset with its card."""

from __future__ import annotations

import copy
import importlib.metadata
import json
import logging
import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from tqdm import tqdm

import freeflyer_env
from freeflyer_datasets.card import dataset_card, package_versions
from freeflyer_datasets.generate import generate
from freeflyer_datasets.pictures import draw_pictures
from freeflyer_datasets.recipe import Recipe, load_recipe
from freeflyer_datasets.shards import Shard, iterate_shards, source_digest
from freeflyer_datasets.storage import (
    EPISODE_ATTRIBUTES,
    EpisodeWriter,
    check_episode,
    dataset_folder,
    shard_episodes,
)
from freeflyer_datasets.summary import Statistics

logger = logging.getLogger(__name__)

_PACKAGE = "freeflyer-gym"
_N_REFERENCE_EPISODES = 100


@dataclass(frozen=True)
class Credits:
    """Who published a dataset, as Minari records it.

    Attributes:
        author: Name.
        author_email: Address, or another way to reach the author; Minari wants a text.
        code_permalink: Where the code of this version is: an address, or what pip installs.
    """

    author: str = "The FreeFlyer developers"
    author_email: str = f"none; contact the maintainers of {_PACKAGE}"
    code_permalink: str = f"{_PACKAGE}=={freeflyer_env.__version__}"


def build(
    recipe: Recipe | str | Path,
    *,
    n_problems: int | None = None,
    shards: str | Path | None = None,
    workers: int | None = None,
    engine: str = "local",
    progress: bool = True,
    force: bool = False,
    credits: Credits | None = None,
) -> str:
    """Makes a dataset from nothing: shards, the Minari dataset, and its card.

    Interrupted, it resumes when called again.

    Args:
        recipe: A recipe, or what :func:`load_recipe` takes.
        n_problems: How many problems; the recipe's own number if None.
        shards: Folder of the shards; a hidden folder in Minari's data root if None.
        workers: Processes; one per processor if None.
        engine: ``"local"`` or ``"ray"``; see :func:`generate`.
        progress: Whether to show progress bars.
        force: Whether to replace a dataset of the same id.
        credits: Who publishes it.

    Returns:
        The dataset id, for ``minari.load_dataset``.

    Raises:
        ValueError: If a dataset of this id is there and ``force`` is not set.
    """
    recipe = recipe if isinstance(recipe, Recipe) else load_recipe(recipe)
    _refuse_existing(recipe.id, force)
    folder = Path(shards) if shards is not None else dataset_folder(f".shards/{recipe.id}")
    report = generate(recipe, folder, n_problems, workers, progress, engine)
    logger.info("%s", report)
    return export(
        folder,
        n_problems=report.n_problems,
        force=force,
        credits=credits,
        progress=progress,
    )


def export(
    shards: str | Path,
    *,
    n_problems: int | None = None,
    force: bool = False,
    credits: Credits | None = None,
    progress: bool = False,
) -> str:
    """Writes the shards of a folder as a Minari dataset, each episode checked, with its card.

    Args:
        shards: Where :func:`freeflyer_datasets.generate` wrote.
        n_problems: How many problems; all that are there if None.
        force: Whether to replace a dataset of the same id.
        credits: Who publishes it.
        progress: Whether to show a progress bar.

    Returns:
        The dataset id.

    Raises:
        ValueError: If a dataset of this id is there and ``force`` is not set.
        EpisodeError: If an episode fails its check; nothing is left behind then.
    """
    folder = Path(shards)
    recipe = Recipe.from_dict(json.loads((folder / "recipe.json").read_text(encoding="utf-8")))
    _refuse_existing(recipe.id, force)
    target = dataset_folder(recipe.id)
    temporary = target.with_name(f".{target.name}.{os.getpid()}.tmp")
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    try:
        _write_dataset(temporary, recipe, folder, n_problems, credits or Credits(), progress)
        _create_namespace(recipe.id)
        shutil.rmtree(target, ignore_errors=True)
        temporary.rename(target)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return recipe.id


def environment_spec(recipe: Recipe, *, evaluation: bool = False) -> EnvSpec:
    """The environment in which the episodes of a recipe's dataset replay.

    Args:
        recipe: Of the dataset.
        evaluation: Whether it is the one to judge a policy in: success is rewarded and ends the
            episode.
    """
    one_scene = recipe.scenes[0] if len(set(recipe.scenes)) == 1 else "random"
    spec = copy.deepcopy(gym.spec("FreeFlyer-v0"))
    kwargs: dict[str, Any] = {
        "action_mode": "delta_v",
        "scenario": "random" if recipe.scenes == "random" else one_scene,
        "final_time": max(recipe.final_times),
        "max_obstacles": recipe.max_obstacles,
    }
    if recipe.moving:
        kwargs["moving_obstacles"] = True
    if not evaluation:
        # Relaxed trajectories pass through obstacles, and others slide along the table's edge.
        kwargs |= {"success_reward": 0.0, "terminate_early": False, "contacts": False}
    spec.kwargs = kwargs
    return spec


def _write_dataset(
    folder: Path,
    recipe: Recipe,
    shards: Path,
    n_problems: int | None,
    credits: Credits,
    progress: bool,
) -> None:
    from minari.dataset.minari_storage import MinariStorage

    spec = environment_spec(recipe)
    storage = MinariStorage.new(folder / "data", env_spec=spec, data_format="hdf5")
    spaces = storage.observation_space, storage.action_space
    bar = tqdm(total=n_problems, unit="problem", disable=not progress, desc="export")
    with EpisodeWriter(folder / "data" / "main_data.hdf5") as writer, bar:

        def written(shard: Shard) -> Shard:
            for episode in shard_episodes(shard):
                check_episode(episode, *spaces)
                writer.write(episode)
            bar.update(shard.n_problems)
            return shard

        statistics = Statistics.of_shards(map(written, iterate_shards(shards, n_problems)))
        counts = {"total_episodes": writer.n_episodes, "total_steps": writer.n_steps}
    storage.update_metadata(
        {
            **counts,
            "dataset_size": storage.get_size(),
            "content_sha256": source_digest(shards, n_problems),
            **_metadata(recipe, statistics, credits),
        }
    )
    pictures = draw_pictures(folder, statistics, next(iterate_shards(shards, n_problems)))
    n_bytes = (folder / "data" / "main_data.hdf5").stat().st_size
    card = dataset_card(recipe, statistics, package_versions(), n_bytes, pictures)
    (folder / "README.md").write_text(card, encoding="utf-8")


def _metadata(recipe: Recipe, statistics: Statistics, credits: Credits) -> dict[str, Any]:
    evaluation = environment_spec(recipe, evaluation=True)
    best = np.where(statistics.solved, 1.0 - statistics.best_cost, -statistics.rel_cost)
    return {
        "dataset_id": recipe.id,
        "minari_version": importlib.metadata.version("minari"),
        "author": {credits.author},
        "author_email": {credits.author_email},
        "code_permalink": credits.code_permalink,
        "algorithm_name": f"SCP from {recipe.n_starts} starts; REL, its relaxation",
        "description": recipe.description,
        "requirements": [f"{_PACKAGE}>={freeflyer_env.__version__}"],
        "eval_env_spec": evaluation.to_json(),
        "ref_min_score": _random_score(evaluation),
        "ref_max_score": float(np.mean(best)),
        "num_episodes_average_score": _N_REFERENCE_EPISODES,
        "recipe": {**recipe.to_dict(), "n_problems": statistics.n_problems},
        "statistics": statistics.summary(),
        "versions": package_versions(),
        "episode_attributes": EPISODE_ATTRIBUTES,
    }


def _random_score(spec: EnvSpec) -> float:
    """Mean return of uniformly random actions in the evaluation environment."""
    env = gym.make(spec)
    env.action_space.seed(0)
    returns = []
    for number in range(_N_REFERENCE_EPISODES):
        env.reset(seed=number)
        total, over = 0.0, False
        while not over:
            _, reward, terminated, truncated, _ = env.step(env.action_space.sample())
            total, over = total + float(reward), terminated or truncated
        returns.append(total)
    env.close()
    return float(np.mean(returns))


def _refuse_existing(dataset_id: str, force: bool) -> None:
    folder = dataset_folder(dataset_id)
    if folder.exists() and not force:
        raise ValueError(
            f"A dataset {dataset_id!r} is already in {str(folder)!r}. Give the recipe another id "
            f"(a new version), or set force=True to replace it."
        )


def _create_namespace(dataset_id: str) -> None:
    from minari.namespace import create_namespace, list_local_namespaces

    namespace = dataset_id.rpartition("/")[0]
    if namespace and namespace not in list_local_namespaces():
        create_namespace(namespace, description="Spacecraft robot trajectories (freeflyer-gym)")
