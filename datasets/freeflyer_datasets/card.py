"""The dataset card: a page of Markdown that is written beside a dataset."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from importlib import metadata

import numpy as np

import freeflyer_env
from freeflyer_datasets.pictures import HISTOGRAMS, PLATE
from freeflyer_datasets.recipe import Recipe
from freeflyer_datasets.summary import Statistics, share

#: Smallest ``C_REL`` of each class of difficulty (paper, Fig. 3).
C_REL_CLASSES = (0, 5, 10, 15, 20)

_MANY_TIMES = 6  # final times, beyond which the range is said

# Of each picture: what stands for it where it cannot be seen, and its caption.
_CAPTIONS = {
    HISTOGRAMS: (
        "Histograms of costs, iterations, C_REL and cost ratios",
        """Histograms of (a) the costs of REL and of the cheapest optimum, (b) SCP iterations,
(c) `C_REL`, (d) the ratio of the two costs.""",
    ),
    PLATE: (
        "Scenes with the relaxed trajectory and all optima",
        """The first problems, not selected: a circle marks the start, a square the goal, a tick the
heading. REL ignores the keep-out zones, which the robot's centre must not enter.""",
    ),
}
# They decide the bytes of a dataset, besides this package and Python.
_PACKAGES = ("numpy", "piqp", "gymnasium", "minari")


def dataset_card(
    recipe: Recipe,
    statistics: Statistics,
    versions: Mapping[str, str],
    n_bytes: int,
    pictures: Sequence[str] = (),
) -> str:
    """The card as Markdown, with the front matter of the Hugging Face hub.

    Args:
        recipe: How the dataset was made; the card shows the number of problems that were made.
        statistics: What is in it.
        versions: Those of the packages that exported it, as :func:`package_versions` gives them.
        n_bytes: Size of the data.
        pictures: Files beside the card to show, as :func:`.draw_pictures` names them.
    """
    s, name = statistics, recipe.id.rsplit("/", 1)[-1]
    shown = ""
    for file in pictures:
        instead, caption = _CAPTIONS[file]
        shown += f"\n![{instead}]({file})\n\n{caption}\n"
    exported = ", ".join(f"{package} {number}" for package, number in versions.items())
    rows = f"({recipe.max_obstacles}, {5 if recipe.moving else 3})"
    return f"""---
license: mit
viewer: false
task_categories: [reinforcement-learning, robotics]
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

Shares with their 95 % interval (Wilson). SCP trajectories are feasible, every one of them: others
are not kept.

{_feasibility(recipe, s)}

## Difficulty

`C_REL` counts the nodes of the relaxed trajectory that lie inside a keep-out zone.

{_difficulty(s)}

## Episodes

Observations are dictionaries of `state` (6), `goal` (6), `obstacles` {rows} and `time_to_go` (1),
all float32 in SI units and the table frame; actions are impulses per unit mass `(dv_x, dv_y, h)`;
the reward is minus the 1-norm of the action. The last observation is the state after the last
impulse. The states are those that the stored actions produce, to 1e-6.
Split by the attribute `problem_index`, never by episode.

## How it was made

From this recipe, which makes it again (`freeflyer generate {name}.toml`):

```toml
{recipe_toml(recipe, s.n_problems)}
```

SCP was started from {_starts(recipe)}.
Kept is {_kept(recipe)} of each problem.
Every trajectory was checked against the constraints by code that the solver does not share; the
largest violation, with float32 actions, is {s.violation:.1e}.
Exported with {exported}.

## Licence and citation

MIT. Please cite the software, and the paper whose method and protocol this follows:

```bibtex
@software{{freeflyer_gym,
  title   = {{{{FreeFlyer / ART}}: learned warm starts for spacecraft trajectory optimisation}},
  author  = {{{{The FreeFlyer developers}}}},
  version = {{{versions["freeflyer-gym"]}}},
}}

@misc{{celestini_art,
  title  = {{{{Generalizable Spacecraft Trajectory Generation via Multimodal Learning with
            Transformers}}}},
  author = {{Celestini, Davide and Afsharrad, Amirhossein and Gammelli, Daniele and
            Guffanti, Tommaso and Zardini, Gioele and Lall, Sanjay and Capello, Elisa and
            D'Amico, Simone and Pavone, Marco}},
}}
```
"""


def recipe_toml(recipe: Recipe, n_problems: int) -> str:
    """The recipe as TOML, with the number of problems that were made.

    :meth:`Recipe.from_dict` of the parsed text is the recipe with that number.
    """
    lines = []
    for key, value in {**recipe.to_dict(), "n_problems": n_problems}.items():
        # Numbers, strings and lists of them look the same in TOML, but for one character.
        text = json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
        if key == "final_times" and len(value) > _MANY_TIMES:
            ends = [value[0], value[-1]]
            short = Recipe.from_dict({**recipe.to_dict(), "final_times": {"range": ends}})
            if short == recipe:
                text = f"{{ range = {json.dumps(ends)} }}"
        lines.append(f"{key} = {text}")
    return "\n".join(lines)


def final_times_text(times: Sequence[float]) -> str:
    """Final times in s: all of them, or the range of many."""
    if len(times) > _MANY_TIMES:
        return f"{min(times):g} to {max(times):g} ({len(times)} values)"
    return ", ".join(f"{time:g}" for time in times)


def package_versions() -> dict[str, str]:
    """Versions of this package, of Python (minor), and of those packages that are installed."""
    found = {
        "freeflyer-gym": freeflyer_env.__version__,
        "Python": "{}.{}".format(*sys.version_info),
    }
    for package in _PACKAGES:
        with suppress(metadata.PackageNotFoundError):
            found[package] = metadata.version(package)
    return found


def _contents(recipe: Recipe, s: Statistics, n_bytes: int) -> str:
    solved = s.solved
    rows = [
        ("problems", f"{s.n_problems:,}"),
        ("without any trajectory", f"{s.n_failed:,}"),
        ("episodes", f"{s.n_trajectories:,} (REL {len(s.rel_cost):,}, SCP {s.n_optima.sum():,})"),
        ("steps", f"{s.n_steps:,}"),
        ("scenes", "random" if recipe.scenes == "random" else ", ".join(recipe.scenes)),
        ("final times in s", final_times_text(recipe.final_times)),
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


def _feasibility(recipe: Recipe, s: Statistics) -> str:
    # With more starts the shards do not tell which of them led to the optimum, when several did.
    alone = ", SCP started from REL alone" if recipe.n_starts == 1 else ""
    counts = [
        ("REL trajectories that happen to be feasible", (s.c_rel == 0).sum(), len(s.c_rel)),
        ("problems with a REL trajectory", len(s.rel_cost), s.n_problems),
        (f"problems with an optimum{alone}", s.solved.sum(), s.n_problems),
    ]
    if recipe.n_starts > 1 and recipe.optima == "all":
        counts.append(("problems with several optima", (s.n_optima > 1).sum(), s.n_problems))
    rows = []
    for what, count, n in counts:
        part, low, high = (100 * value for value in share(count, n) or [np.nan] * 3)
        rows.append((what, f"{count:,} of {n:,}", f"{part:.2f} %", f"{low:.2f} to {high:.2f} %"))
    return _table(("", "count", "share", "interval"), rows)


def _size_category(n_episodes: int) -> str:
    names = ("n<1K", "1K<n<10K", "10K<n<100K", "100K<n<1M", "1M<n<10M", "10M<n<100M")
    for power, name in enumerate(names, start=3):
        if n_episodes < 10**power:
            return name
    return "100M<n<1B"


def _starts(recipe: Recipe) -> str:
    if recipe.n_starts == 1:
        return "the relaxed solution"
    return (
        f"the relaxed solution and up to {recipe.n_starts - 1} paths that pass the obstacles on "
        "other sides"
    )


def _kept(recipe: Recipe) -> str:
    return {
        "all": "every distinct optimum",
        "best": "the cheapest optimum",
        "first": "the optimum of the first start that is solved",
    }[recipe.optima]


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
