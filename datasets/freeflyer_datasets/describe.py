"""What is in a local dataset, from its metadata and the attributes of its episodes alone."""

from __future__ import annotations

import difflib
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from freeflyer_datasets.card import final_times_text, recipe_toml
from freeflyer_datasets.recipe import Recipe, list_recipes
from freeflyer_datasets.shards import LABEL_REL
from freeflyer_datasets.summary import quantiles, share

_SAMPLE = 3000  # episodes that are looked at where the metadata has no statistics
_UNITS = {"rel_cost": "m/s", "best_cost": "m/s"}
_NAMES = {
    "rel_feasible": "REL feasible",
    "rel_cost": "cost of REL",
    "best_cost": "cost of the cheapest optimum",
    "best_over_rel": "its cost over that of REL",
    "c_rel": "C_REL",
    "rel_iterations": "REL iterations",
    "scp_iterations": "SCP iterations",
    "failed": "without any trajectory",
}


def describe(dataset_id: str) -> dict[str, Any]:
    """Counts, feasibility, costs and origin of a local Minari dataset.

    Reads no arrays. The statistics are those that export has put into the metadata; a dataset
    without is described by the problems of 3,000 evenly spaced episodes, whose number
    ``statistics["problems_looked_at"]`` is, and one that this package did not make has none.

    Args:
        dataset_id: Its Minari id, such as ``"freeflyer/scene-random-v0"``; the namespace may be
            left out where that is unambiguous.

    Returns:
        Plain values, ``statistics`` as :meth:`.Statistics.summary` gives them: costs in m/s, shares
        ``[share, lower, upper]`` with the 95 % interval, distributions ``[5 %, 50 %, 95 %, mean]``.

    Raises:
        ValueError: If there is no such dataset here; the message names the nearest and what to do.
        OSError: If its files cannot be read.
        ModuleNotFoundError: Without Minari and h5py.
    """
    from freeflyer_datasets.storage import dataset_folder

    found = find_local(dataset_id)
    if found is None:
        raise ValueError(unknown_text(dataset_id))
    folder = dataset_folder(found)
    metadata = json.loads((folder / "data" / "metadata.json").read_text(encoding="utf-8"))
    files = (path for path in (folder / "data").rglob("*") if path.name != "metadata.json")
    size = sum(path.stat().st_size for path in files if path.is_file())
    episodes = int(metadata["total_episodes"])
    recipe, card = metadata.get("recipe") or {}, folder / "README.md"
    return {
        "dataset": found,
        "description": metadata.get("description", ""),
        "folder": str(folder),
        "card": str(card) if card.is_file() else None,
        "episodes": episodes,
        "steps": int(metadata["total_steps"]),
        "size_mb": size / 1e6,
        "kb_per_episode": size / 1e3 / max(episodes, 1),
        "final_times": final_times_text(recipe.get("final_times", [])),
        "statistics": metadata.get("statistics") or _sampled(folder / "data", episodes),
        "random_score": metadata.get("ref_min_score"),
        "best_score": metadata.get("ref_max_score"),
        "recipe": recipe,
        "versions": metadata.get("versions") or {"minari": metadata["minari_version"]},
        "content_sha256": metadata.get("content_sha256"),
    }


def describe_text(data: dict[str, Any]) -> str:
    """What :func:`describe` gives, as lines to read."""
    rows = [
        ("where", data["folder"]),
        ("size", f"{data['size_mb']:,.1f} MB, {data['kb_per_episode']:.1f} kB an episode"),
        ("episodes", _number(data["episodes"])),
        ("steps", _number(data["steps"])),
    ]
    if data["final_times"]:
        rows.append(("final times", f"{data['final_times']} s"))
    for name, value in data["statistics"].items():
        if name == "steps":
            continue  # said above
        label = {"episodes": "of these"}.get(name) or _NAMES.get(name, name.replace("_", " "))
        rows.append((label, f"{_value_text(value)} {_UNITS.get(name, '')}".rstrip()))
    if not data["statistics"]:
        rows.append(("statistics", "none: freeflyer_datasets did not make this dataset"))
    for name, what in (("random_score", "random actions"), ("best_score", "the cheapest optima")):
        if data[name] is not None:
            rows.append((f"return of {what}", f"{data[name]:.4g}"))
    made = ", ".join(f"{name} {number}" for name, number in data["versions"].items())
    rows += [("exported with", made), ("card", data["card"] or "none")]
    width = max(len(label) for label, _ in rows) + 2
    lines = [f"{data['dataset']}: {data['description']}"]
    lines += [f"  {label + ':':{width}}{text}" for label, text in rows]
    if data["recipe"]:
        lines += ["  recipe:", *(f"    {line}" for line in _recipe_lines(data["recipe"]))]
    return "\n".join(lines)


def list_local() -> list[str]:
    """Ids of the datasets in Minari's data root; none without Minari and h5py."""
    try:
        from freeflyer_datasets.storage import dataset_folder

        root = dataset_folder("")
    except ModuleNotFoundError:
        return []
    found = []
    for name, folders, _ in os.walk(root):
        folder = Path(name)
        if folder != root and (folder / "data" / "metadata.json").is_file():
            found.append(folder.relative_to(root).as_posix())
            folders.clear()
        # Hidden ones hold shards, and datasets that are unfinished.
        folders[:] = [folder for folder in folders if not folder.startswith(".")]
    return sorted(found)


def find_local(name: str) -> str | None:
    """Id of the local dataset of that id, or of that name in the only namespace that has it."""
    local = list_local()
    if name in local:
        return name
    ids = [dataset for dataset in local if dataset.rpartition("/")[2] == name]
    return ids[0] if len(ids) == 1 else None


def unknown_text(name: str, models: Sequence[str] = ()) -> str:
    """A sentence that there is no dataset of that name here, the nearest names, what to do.

    Args:
        name: What was asked for.
        models: Names that are known besides those of local datasets and recipes.
    """
    local, recipes = list_local(), list_recipes()
    short = name.rpartition("/")[2]
    if short in recipes and name in (short, f"freeflyer/{short}"):
        return f"There is no dataset {name!r} here yet. Make it with: freeflyer generate {short}"
    known = {full.rpartition("/")[2]: full for full in (*recipes, *local, *models)}
    near = [known[match] for match in difflib.get_close_matches(short, known, n=3)]
    what = f"No dataset here is called {name!r}."
    if models:
        what = f"No model is called {name!r}, and no dataset here."
    hint = f" Did you mean {' or '.join(map(repr, near))}?" if near else ""
    lists = [("models", models), ("local datasets", local), ("recipes", recipes)]
    every = "; ".join(f"{kind}: {', '.join(names)}" for kind, names in lists if names)
    return f"{what}{hint} Known {every}."


def _sampled(folder: Path, n_episodes: int) -> dict[str, Any]:
    """Statistics of the problems whose REL is among evenly spaced episodes."""
    import h5py

    columns = ("problem_index", "success", "cost", "iterations", "c_rel")
    rels: list[dict[str, float]] = []
    bests: list[dict[str, float]] = []
    ratio = []
    numbers = np.linspace(0, n_episodes - 1, min(_SAMPLE, n_episodes)).astype(int).tolist()
    try:
        with h5py.File(folder / "main_data.hdf5", "r") as file:

            def read(number: int) -> dict[str, float]:
                attributes = file[f"episode_{number}"].attrs
                return {name: float(attributes[name]) for name in columns}

            for number in numbers:
                # Through its REL alone, or problems with many optima would count more.
                if file[f"episode_{number}"].attrs["label"] != LABEL_REL:
                    continue
                rels.append(read(number))
                if number + 1 == n_episodes:
                    continue
                following = read(number + 1)  # the cheapest optimum, where there is one
                if following["problem_index"] == rels[-1]["problem_index"]:
                    bests.append(following)
                    ratio.append(following["cost"] / rels[-1]["cost"])
    except (FileNotFoundError, KeyError):
        return {}

    def column(episodes: list[dict[str, float]], name: str) -> NDArray[np.float64]:
        return np.array([episode[name] for episode in episodes])

    return {
        "problems_looked_at": len(rels),
        "rel_feasible": share(column(rels, "success").sum(), len(rels)),
        "with_optimum": share(len(bests), len(rels)),
        "rel_cost": quantiles(column(rels, "cost")),
        "best_cost": quantiles(column(bests, "cost")),
        "best_over_rel": quantiles(np.array(ratio)),
        "c_rel": quantiles(column(rels, "c_rel")),
        "rel_iterations": quantiles(column(rels, "iterations")),
        "iterations_of_the_cheapest": quantiles(column(bests, "iterations")),
    }


def _value_text(value: Any) -> str:
    if isinstance(value, list) and len(value) == 3:
        part, low, high = (100 * item for item in value)
        return f"{part:.2f} % (95 % interval {low:.2f} to {high:.2f} %)"
    if isinstance(value, list) and len(value) == 4:
        return "median {1:.4g} (5 % {0:.4g}, 95 % {2:.4g}), mean {3:.4g}".format(*value)
    if isinstance(value, dict):
        return ", ".join(f"{key} {_number(count)}" for key, count in value.items())
    return _number(value) if value != [] else "none"


def _recipe_lines(recipe: dict[str, Any]) -> list[str]:
    try:
        return recipe_toml(Recipe.from_dict(recipe), recipe["n_problems"]).splitlines()
    except ValueError:  # of another version of this package
        return [f"{key} = {json.dumps(value)}" for key, value in recipe.items()]


def _number(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.2g}"
    return f"{value:,}" if isinstance(value, int) else str(value)
