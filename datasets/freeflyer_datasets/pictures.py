"""Pictures of a dataset for its card: histograms, and a plate of trajectories.

Matplotlib draws them through its objects alone, so that no global state or display is touched; the
same dataset gives the same bytes.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from freeflyer_datasets.shards import LABEL_REL, Shard
from freeflyer_env import dynamics
from freeflyer_env.scenario import Scenario

if TYPE_CHECKING:
    from freeflyer_datasets.card import Statistics

logger = logging.getLogger(__name__)

HISTOGRAMS, PLATE = "histograms.png", "trajectories.png"

_REL, _SCP, _OTHER = "#7f8794", "#1f6fb4", "#8fbfe0"
_OBSTACLE, _KEEP_OUT, _START, _GOAL = "#70798a", "#f6dedb", "#3f4858", "#2c9660"
_ROWS = _COLUMNS = 4
_MANY = 15  # subproblems that share the last bar


def draw_pictures(folder: Path, statistics: Statistics, shard: Shard) -> list[str]:
    """Writes :data:`HISTOGRAMS` and :data:`PLATE` into a folder.

    Args:
        folder: Where to.
        statistics: Of the whole dataset.
        shard: One of its shards, which the plate shows the first problems of.

    Returns:
        The names of the files that were written; none without Matplotlib, which is logged.
    """
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        logger.warning("The card has no pictures: they need Matplotlib (pip install matplotlib).")
        return []
    _histograms(folder / HISTOGRAMS, statistics)
    _plate(folder / PLATE, shard)
    return [HISTOGRAMS, PLATE]


def _histograms(path: Path, s: Statistics) -> None:
    figure = _figure(9.0, 5.6)
    axes = figure.subplots(2, 2).ravel()
    solved = s.solved
    cost = {"REL": s.rel_cost, "cheapest optimum": s.best_cost[solved]}
    both = np.concatenate(list(cost.values()))
    low, high = np.quantile(both, [0.0, 0.999]).tolist() if len(both) else (0.0, 1.0)
    edges = np.linspace(low, high, 61)
    for (name, values), color in zip(cost.items(), (_REL, _SCP)):
        axes[0].hist(values, edges, histtype="stepfilled", alpha=0.55, color=color, label=name)
    axes[0].set(xlabel="cost in m/s", ylabel="problems")
    axes[0].legend(frameon=False)
    most = int(max(s.scp_iterations.max(initial=1), s.rel_iterations.max(initial=1)))
    bins = np.arange(0.5, min(most, _MANY) + 1.5)
    axes[1].hist(np.minimum(s.scp_iterations, _MANY), bins, color=_SCP, rwidth=0.85)
    axes[1].set(xlabel=f"subproblems per optimum ({_MANY}: or more)", ylabel="optima")
    axes[2].hist(s.c_rel, np.arange(-0.5, s.c_rel.max(initial=0) + 1.5), color=_REL)
    axes[2].set(xlabel="$C_{REL}$: nodes of REL inside a keep-out zone", ylabel="problems")
    axes[2].set_yscale("log")
    ratio = s.best_cost[solved] / s.rel_cost[solved]
    top = float(np.quantile(ratio, 0.999)) if len(ratio) else 2.0
    axes[3].hist(ratio, np.linspace(1.0, max(top, 1.05), 61), color=_SCP)
    axes[3].set(xlabel="cheapest optimum / REL, cost", ylabel="problems")
    if len(ratio):
        axes[3].set_yscale("log")
    for axis in axes:
        axis.spines[["top", "right"]].set_visible(False)
        axis.tick_params(labelsize=8)
    _save(figure, path)


def _plate(path: Path, shard: Shard) -> None:
    scenario = Scenario()
    kept = np.unique(shard.problem)[: _ROWS * _COLUMNS]
    figure = _figure(11.0, 8.6)
    for axis, problem in zip(figure.subplots(_ROWS, _COLUMNS).ravel(), kept):
        _panel(axis, shard, int(problem), scenario)
    for axis in figure.axes[len(kept) :]:
        axis.set_axis_off()
    handles, labels = [], []
    for axis in figure.axes:
        for handle, label in zip(*axis.get_legend_handles_labels()):
            if label not in labels:
                handles.append(handle)
                labels.append(label)
    figure.legend(handles, labels, loc="outside lower center", ncol=4, frameon=False, fontsize=9)
    _save(figure, path)


def _panel(axis: Any, shard: Shard, problem: int, scenario: Scenario) -> None:
    """One problem with all its trajectories."""
    from matplotlib.patches import Circle

    for x, y, radius in shard.obstacles[problem]:
        if radius > 0.0:
            keep_out = (radius + scenario.robot.radius) * scenario.keep_out_factor
            axis.add_patch(Circle((x, y), keep_out, color=_KEEP_OUT, zorder=0))
            axis.add_patch(Circle((x, y), radius, color=_OBSTACLE, zorder=1))
    # The cheapest optimum last, on top.
    for index in np.flatnonzero(shard.problem == problem)[::-1]:
        states = dynamics.rollout(
            shard.start[problem],
            shard.controls_of(index).astype(np.float64),
            scenario.dt,
            scenario.robot,
        )
        if shard.label[index] == LABEL_REL:
            style: dict[str, Any] = {"color": _REL, "ls": "--", "lw": 1.1, "label": "REL"}
        elif shard.rank[index] == 0:
            style = {"color": _SCP, "lw": 1.7, "label": "cheapest optimum"}
        else:
            style = {"color": _OTHER, "lw": 1.0, "label": "other optima"}
        axis.plot(states[:, 0], states[:, 1], zorder=3, **style)
    for state, color in ((shard.start[problem], _START), (shard.goal[problem], _GOAL)):
        heading = 0.16 * np.array([np.cos(state[2]), np.sin(state[2])])
        axis.plot(*state[:2], "o", ms=4, color=color, zorder=4)
        axis.plot(*zip(state[:2], state[:2] + heading), color=color, lw=1.4, zorder=4)
    width, height = scenario.table
    axis.set(xlim=(0.0, width), ylim=(0.0, height), aspect="equal", xticks=[], yticks=[])
    axis.set_title(
        f"{shard.final_time[problem]:g} s, $C_{{REL}}$ = {shard.c_rel[problem]}", fontsize=8, pad=3
    )


def _figure(width: float, height: float) -> Any:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _save(figure: Any, path: Path) -> None:
    # Without the entry of the version, which would change with Matplotlib's.
    figure.savefig(path, dpi=100, metadata={"Software": None})
