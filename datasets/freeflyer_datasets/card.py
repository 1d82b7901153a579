"""The dataset card: a page of Markdown that is written beside a dataset."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib import metadata
from typing import Any

import numpy as np
from numpy.typing import NDArray

from freeflyer_datasets.recipe import Recipe
from freeflyer_datasets.shards import LABEL_REL, LABEL_SCP, Shard

#: Smallest ``C_REL`` of each class of difficulty (paper, Fig. 3).
C_REL_CLASSES = (0, 5, 10, 15, 20)

_CAPTIONS = {
    "histograms.png": "Costs, iterations, C_REL",
    "trajectories.png": "Sixteen problems with their trajectories",
}


@dataclass(frozen=True, eq=False)
class Statistics:
    """What the card tells of a dataset.

    Attributes:
        n_problems: Problems, failed ones included.
        n_failed: Problems without a trajectory.
        n_steps: Steps of all trajectories.
        c_rel: ``(P,)`` nodes of REL inside a keep-out zone, of the problems with trajectories.
        rel_cost: ``(P,)`` cost of REL in m/s.
        best_cost: ``(P,)`` cost of the cheapest optimum in m/s; NaN where none was found.
        n_optima: ``(P,)`` number of optima kept.
        rel_iterations: ``(P,)`` subproblems solved for REL.
        scp_iterations: ``(number of optima,)`` subproblems solved for each optimum.
        violation: Largest violation of a constraint of any trajectory.
    """

    n_problems: int
    n_failed: int
    n_steps: int
    c_rel: NDArray[np.int32]
    rel_cost: NDArray[np.float64]
    best_cost: NDArray[np.float64]
    n_optima: NDArray[np.int64]
    rel_iterations: NDArray[np.int32]
    scp_iterations: NDArray[np.int32]
    violation: float

    @property
    def n_trajectories(self) -> int:
        """Number of episodes."""
        return len(self.rel_cost) + len(self.scp_iterations)

    def summary(self) -> dict[str, Any]:
        """Plain numbers, for a dataset's metadata; shares with their 95 % interval."""
        solved = self.solved
        return {
            "problems": self.n_problems,
            "failed": self.n_failed,
            "episodes": {"REL": len(self.rel_cost), "SCP": len(self.scp_iterations)},
            "steps": self.n_steps,
            "rel_feasible": share(self.c_rel == 0),
            "with_optimum": share(solved),
            "rel_cost": quantiles(self.rel_cost),
            "best_cost": quantiles(self.best_cost[solved]),
            "best_over_rel": quantiles(self.best_cost[solved] / self.rel_cost[solved]),
            "c_rel": quantiles(self.c_rel),
            "rel_iterations": quantiles(self.rel_iterations),
            "scp_iterations": quantiles(self.scp_iterations),
            "largest_violation": self.violation,
        }

    @property
    def solved(self) -> NDArray[np.bool_]:
        """``(P,)`` whether an optimum was found."""
        return np.isfinite(self.best_cost)

    @classmethod
    def of_shards(cls, shards: Iterable[Shard]) -> Statistics:
        """Statistics of the shards of one dataset."""
        parts = [_shard_columns(shard) for shard in shards]
        columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        return cls(
            n_problems=int(columns.pop("n_problems").sum()),
            n_failed=int(columns.pop("n_failed").sum()),
            n_steps=int(columns.pop("n_steps").sum()),
            violation=float(columns.pop("violation").max()),
            **columns,
        )


def _shard_columns(shard: Shard) -> dict[str, np.ndarray]:
    is_rel, is_best = shard.label == LABEL_REL, (shard.label == LABEL_SCP) & (shard.rank == 0)
    kept = shard.problem[is_rel]
    best = np.full(shard.n_problems, np.nan)
    best[shard.problem[is_best]] = shard.cost[is_best]
    optima = np.bincount(shard.problem[~is_rel], minlength=shard.n_problems)
    return {
        "n_problems": np.array([shard.n_problems]),
        "n_failed": np.array([shard.n_problems - len(kept)]),
        "n_steps": np.array([len(shard.controls)]),
        "c_rel": shard.c_rel[kept],
        "rel_cost": shard.rel_cost[kept],
        "best_cost": best[kept],
        "n_optima": optima[kept],
        "rel_iterations": shard.iterations[is_rel],
        "scp_iterations": shard.iterations[~is_rel],
        "violation": np.array([shard.violation.max(initial=0.0)]),
    }


def wilson_interval(n_successes: int, n: int, z: float = 1.96) -> tuple[float, float]:
    """Wilson's interval of a proportion; 95 % for ``z = 1.96``, (0, 1) without observations."""
    if n == 0:
        return 0.0, 1.0
    p, extra = n_successes / n, z * z / n
    middle = (p + extra / 2) / (1 + extra)
    half = z / (1 + extra) * float(np.sqrt(p * (1 - p) / n + extra / (4 * n)))
    return max(middle - half, 0.0), min(middle + half, 1.0)


def share(mask: NDArray[np.bool_]) -> list[float]:
    """``[share, lower, upper]`` of what is true, with the 95 % interval."""
    low, high = wilson_interval(int(mask.sum()), len(mask))
    return [float(mask.mean()) if len(mask) else float("nan"), low, high]


def quantiles(values: NDArray[Any]) -> list[float]:
    """``[5 %, 50 %, 95 %, mean]``; empty without values."""
    if not len(values):
        return []
    return [*np.quantile(values, [0.05, 0.5, 0.95]).tolist(), float(np.mean(values))]


def dataset_card(
    recipe: Recipe,
    statistics: Statistics,
    version: str,
    n_bytes: int,
    pictures: Sequence[str] = (),
) -> str:
    """The card as Markdown, with the front matter of the Hugging Face hub.

    Args:
        recipe: How the dataset was made.
        statistics: What is in it.
        version: Version of ``freeflyer-gym`` that made it.
        n_bytes: Size of the data.
        pictures: Files beside the card to show.
    """
    s, name = statistics, recipe.id.rsplit("/", 1)[-1]
    shown = "\n\n".join(f"![{_CAPTIONS.get(file, file)}]({file})" for file in pictures)
    return f"""---
license: mit
viewer: false
tags: [minari, offline-rl, trajectory-optimization, spacecraft]
size_categories: [{_size_category(s.n_trajectories)}]
---

# {recipe.id}

{recipe.description}
Trajectories of a planar spacecraft robot with eight thrusters: for each problem the relaxed
solution, which ignores the obstacles (REL), and the local optima that sequential convex programming
(SCP) finds.

```python
import minari

dataset = minari.load_dataset("{recipe.id}")
env = dataset.recover_environment()
```

{shown}

## Contents

{_contents(recipe, s, n_bytes)}

## Feasibility

Shares with their 95 % interval (Wilson).

{_feasibility(s)}

## Difficulty

`C_REL` counts the nodes of the relaxed trajectory that lie inside a keep-out zone.

{_difficulty(s)}

## Episodes

Observations are dictionaries of `state` (6), `goal` (6), `obstacles` ({recipe.max_obstacles}, 3)
and `time_to_go` (1), all float32 in SI units and the table frame; actions are impulses per unit
mass `(dv_x, dv_y, h)`; the reward is minus the 1-norm of the action. The last observation is the
state after the last impulse. The states are those that the stored actions produce, to 1e-6.
Split by the attribute `problem_index`, never by episode.

## How it was made

With freeflyer-gym {version} from this recipe, which makes it again
(`freeflyer generate {name}.toml`):

```toml
{recipe_toml(recipe, s.n_problems)}
```

SCP was started from {_starts(recipe)}.
Kept is {_kept(recipe)} of each problem.
Every trajectory was checked against the constraints by code that the solver does not share; the
largest violation, with float32 actions, is {s.violation:.1e}.
Exported with {_versions()}.

## Licence and citation

MIT. Please cite the software, and the paper whose method and protocol this follows:

```bibtex
@software{{freeflyer_gym,
  title   = {{FreeFlyer / ART: learned warm starts for spacecraft trajectory optimisation}},
  author  = {{{{The FreeFlyer developers}}}},
  version = {{{version}}},
}}

@misc{{celestini_art,
  title  = {{Generalizable Spacecraft Trajectory Generation via Multimodal Learning with
            Transformers}},
  author = {{Celestini, Davide and Afsharrad, Amirhossein and Gammelli, Daniele and
            Guffanti, Tommaso and Zardini, Gioele and Lall, Sanjay and Capello, Elisa and
            D'Amico, Simone and Pavone, Marco}},
}}
```
"""


def recipe_toml(recipe: Recipe, n_problems: int) -> str:
    """The recipe as TOML, with the number of problems that were made."""
    fields = {**recipe.to_dict(), "n_problems": n_problems}
    times = list(recipe.final_times)
    if len(times) > 6 and np.allclose(np.diff(times), 0.5):
        fields["final_times"] = {"range": [times[0], times[-1]]}
    # Strings, numbers and lists of them look the same in TOML and in JSON.
    lines = [
        f"{key} = {json.dumps(value)}"
        if not isinstance(value, dict)
        else f"{key} = {{ range = {json.dumps(value['range'])} }}"
        for key, value in fields.items()
    ]
    return "\n".join(lines)


def _contents(recipe: Recipe, s: Statistics, n_bytes: int) -> str:
    times = recipe.final_times
    if len(times) > 6:
        final_times = f"{min(times):g} to {max(times):g} ({len(times)} values)"
    else:
        final_times = ", ".join(f"{time:g}" for time in times)
    solved = s.solved
    rows = [
        ("problems", f"{s.n_problems:,}"),
        ("without any trajectory", f"{s.n_failed:,}"),
        ("episodes", f"{s.n_trajectories:,} (REL {len(s.rel_cost):,}, SCP {s.n_optima.sum():,})"),
        ("steps", f"{s.n_steps:,}"),
        ("scenes", "random" if recipe.scenes == "random" else ", ".join(recipe.scenes)),
        ("final times in s", final_times),
        ("size in MB", f"{n_bytes / 1e6:,.1f}"),
        ("size of an episode in kB", f"{n_bytes / max(s.n_trajectories, 1) / 1e3:.1f}"),
        ("optima per problem", f"{_mean(s.n_optima)}"),
        ("cost of REL in m/s", _quantiles(s.rel_cost)),
        ("cost of the cheapest optimum in m/s", _quantiles(s.best_cost[solved])),
        ("its cost over that of REL", _quantiles(s.best_cost[solved] / s.rel_cost[solved])),
        ("subproblems per REL solution", _mean(s.rel_iterations)),
        ("subproblems per SCP optimum", _mean(s.scp_iterations)),
        ("C_REL", _quantiles(s.c_rel)),
    ]
    return _table(("", "value"), rows)


def _difficulty(s: Statistics) -> str:
    rows = []
    for least in C_REL_CLASSES:
        mask = s.c_rel >= least
        solved = mask & s.solved
        ratio = s.best_cost[solved] / s.rel_cost[solved]
        rows.append((f">= {least}", _percent(mask), _percent(s.solved[mask]), _mean(ratio)))
    return _table(("C_REL", "problems", "with an optimum", "best cost / REL cost"), rows)


def _feasibility(s: Statistics) -> str:
    rows = []
    for what, mask in (
        ("REL trajectories that keep out of the obstacles", s.c_rel == 0),
        ("problems with an SCP optimum", s.solved),
        ("problems with several", s.n_optima > 1),
    ):
        part, low, high = share(mask)
        interval = f"{100 * low:.2f} to {100 * high:.2f} %"
        rows.append(
            (what, f"{int(mask.sum()):,} of {len(mask):,}", f"{100 * part:.2f} %", interval)
        )
    return _table(("", "count", "share", "interval"), rows)


def _versions() -> str:
    import platform

    parts = [f"Python {'.'.join(platform.python_version_tuple()[:2])}"]
    for package in ("numpy", "piqp", "gymnasium", "minari"):
        try:
            parts.append(f"{package} {metadata.version(package)}")
        except metadata.PackageNotFoundError:
            continue
    return ", ".join(parts)


def _size_category(n_episodes: int) -> str:
    for power, name in ((3, "n<1K"), (4, "1K<n<10K"), (5, "10K<n<100K"), (6, "100K<n<1M")):
        if n_episodes < 10**power:
            return name
    return "1M<n<10M"


def _starts(recipe: Recipe) -> str:
    if recipe.n_starts == 1:
        return "the relaxed solution"
    return (
        f"the relaxed solution and up to {recipe.n_starts - 1} paths that pass the obstacles on "
        "other sides"
    )


def _kept(recipe: Recipe) -> str:
    return "the cheapest optimum" if recipe.optima == "best" else "every distinct optimum"


def _table(head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _percent(mask: np.ndarray) -> str:
    return f"{100 * mask.mean():.1f} %" if len(mask) else "-"


def _mean(values: np.ndarray) -> str:
    return f"{values.mean():.3g}" if len(values) else "-"


def _quantiles(values: np.ndarray) -> str:
    if not len(values):
        return "-"
    low, middle, high = np.quantile(values, [0.05, 0.5, 0.95])
    return f"median {middle:.3g} (5 % {low:.3g}, 95 % {high:.3g})"
