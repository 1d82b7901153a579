"""What is in a local dataset, without reading its episodes."""

from __future__ import annotations

import difflib
import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from freeflyer_datasets.card import quantiles, share
from freeflyer_datasets.recipe import list_recipes
from freeflyer_datasets.shards import LABEL_REL
from freeflyer_datasets.storage import dataset_folder

_SAMPLE = 2000  # episodes that are looked at where the metadata has no statistics
_UNITS = {"rel_cost": "m/s", "best_cost": "m/s"}


def describe(dataset_id: str) -> dict[str, Any]:
    """Counts, feasibility, costs and origin of a local Minari dataset of this package.

    Datasets that were exported without statistics are described by 2,000 evenly spaced episodes.

    Args:
        dataset_id: Its Minari id, such as ``"freeflyer/scene-random-v0"``.

    Returns:
        Plain values; shares are ``[share, lower, upper]`` with the 95 % interval, distributions
        ``[5 %, 50 %, 95 %, mean]``.

    Raises:
        ValueError: If there is no such dataset here; the message names the nearest and what to do.
    """
    folder = dataset_folder(dataset_id)
    path = folder / "data" / "metadata.json"
    if not path.is_file():
        known = list_local()
        near = difflib.get_close_matches(dataset_id, known, n=1)
        hint = f" Did you mean {near[0]!r}?" if near else f" Local: {', '.join(known) or 'none'}."
        name = dataset_id.rsplit("/", 1)[-1]
        remedy = f" Make it with: freeflyer generate {name}" if name in list_recipes() else ""
        raise ValueError(f"There is no dataset {dataset_id!r} in Minari's data root.{hint}{remedy}")
    metadata = json.loads(path.read_text(encoding="utf-8"))
    data = folder / "data" / "main_data.hdf5"
    size, episodes = data.stat().st_size, int(metadata["total_episodes"])
    recipe = metadata.get("recipe") or {}
    return {
        "dataset": dataset_id,
        "description": metadata.get("description", ""),
        "folder": str(folder),
        "episodes": episodes,
        "steps": int(metadata["total_steps"]),
        "size_mb": size / 1e6,
        "kb_per_episode": size / 1e3 / max(episodes, 1),
        "scenes": recipe.get("scenes"),
        "final_times": _range(recipe.get("final_times", [])),
        "statistics": metadata.get("statistics") or _sampled(data, episodes),
        "random_score": metadata.get("ref_min_score"),
        "best_score": metadata.get("ref_max_score"),
        "content_sha256": metadata.get("content_sha256"),
        "card": str(folder / "README.md"),
    }


def describe_text(data: dict[str, Any]) -> str:
    """What :func:`describe` gives, as lines to read."""
    lines = [f"{data['dataset']}: {data['description']}".rstrip()]
    for name in ("folder", "episodes", "steps", "scenes", "final_times"):
        lines.append(f"  {name}: {_number(data[name])}")
    lines.append(f"  size: {data['size_mb']:,.1f} MB, {data['kb_per_episode']:.1f} kB an episode")
    for name, value in data["statistics"].items():
        if name == "steps":
            continue  # said above
        label = {"episodes": "of these"}.get(name, name.replace("_", " "))
        unit = _UNITS.get(name, "")
        if isinstance(value, list) and len(value) == 3:
            part, low, high = (100 * item for item in value)
            text = f"{part:.2f} % (95 % interval {low:.2f} to {high:.2f} %)"
        elif isinstance(value, list) and len(value) == 4:
            text = "median {1:.4g} (5 % {0:.4g}, 95 % {2:.4g}), mean {3:.4g}".format(*value)
        elif isinstance(value, dict):
            text = ", ".join(f"{key} {_number(count)}" for key, count in value.items())
        else:
            text = _number(value)
        lines.append(f"  {label}: {text} {unit}".rstrip())
    scores = data["random_score"], data["best_score"]
    lines.append("  return of random actions {:.4g}, of the cheapest optima {:.4g}".format(*scores))
    lines.append(f"  card: {data['card']}")
    return "\n".join(lines)


def list_local() -> list[str]:
    """Ids of the datasets in Minari's data root."""
    root = dataset_folder(".").resolve()
    found = root.glob("**/data/metadata.json") if root.is_dir() else []
    ids = [path.parents[1].relative_to(root) for path in found]
    return sorted(str(name) for name in ids if not str(name).startswith("."))


def _sampled(path: Path, n_episodes: int) -> dict[str, Any]:
    """Statistics of evenly spaced episodes, from their attributes."""
    names = ("label", "rank", "success", "cost", "iterations", "rel_cost", "c_rel")
    rows = []
    with h5py.File(path, "r") as file:
        for number in np.unique(np.linspace(0, n_episodes - 1, _SAMPLE).astype(int)):
            attributes = file[f"episode_{number}"].attrs
            rows.append([float(attributes[name]) for name in names])
    label, rank, success, cost, iterations, rel_cost, c_rel = np.array(rows).reshape(-1, 7).T
    is_rel, is_best = label == LABEL_REL, (label != LABEL_REL) & (rank == 0)
    return {
        "episodes looked at": len(rows),
        "rel_feasible": share(success[is_rel] > 0),
        "rel_cost": quantiles(cost[is_rel]),
        "best_cost": quantiles(cost[is_best]),
        "best_over_rel": quantiles(cost[is_best] / rel_cost[is_best]),
        "c_rel": quantiles(c_rel[is_rel]),
        "rel_iterations": quantiles(iterations[is_rel]),
        "scp_iterations": quantiles(iterations[~is_rel]),
    }


def _range(times: list[float]) -> str:
    if len(times) > 6:
        return f"{min(times):g} to {max(times):g} s ({len(times)} values)"
    return ", ".join(f"{time:g}" for time in times) + " s"


def _number(value: Any) -> str:
    return f"{value:,}" if isinstance(value, int) else str(value)
