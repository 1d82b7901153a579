"""Pictures of a dataset for its card: histograms, and a plate of trajectories.

Matplotlib draws them through its objects alone, so that no window, back end or figure of the caller
is touched, in its default style whatever the user's settings are; the same dataset gives the same
bytes (with the same versions of Matplotlib and Pillow).
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from freeflyer_datasets.shards import LABEL_REL, Shard
from freeflyer_env import dynamics
from freeflyer_env.scenario import Scenario

if TYPE_CHECKING:
    from freeflyer_datasets.summary import Statistics

logger = logging.getLogger(__name__)

HISTOGRAMS, PLATE = "histograms.png", "trajectories.png"

_REL, _BEST, _OTHER = "#3d434c", "#1f6fb4", "#82b8de"
_REL_BARS = "#6b7380"
_OBSTACLE, _KEEP_OUT, _START, _GOAL = "#8a93a1", "#f4ded9", "#22272e", "#1b8a54"
_STYLE = {
    "font.size": 8.0,
    "axes.linewidth": 0.6,
    "axes.labelsize": 8.0,
    "axes.titlesize": 8.0,
    "xtick.labelsize": 7.0,
    "ytick.labelsize": 7.0,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "legend.fontsize": 8.0,
    "legend.frameon": False,
    "mathtext.default": "regular",
}
_WIDTH = 7.2  # inches, the text of a page
_DPI = 200
_N_COLOURS = 64
_ROWS = _COLUMNS = 4
_BINS = 60
_MANY = 15  # subproblems that share the last bar
_SHOWN = 0.999  # share of the costs that the axis spans
_HEADING = 0.17  # m, length of the tick that shows a heading


def draw_pictures(folder: Path, statistics: Statistics, shard: Shard) -> list[str]:
    """Writes :data:`HISTOGRAMS` and :data:`PLATE` into a folder, each less than 300 kB.

    Args:
        folder: Where to; it must exist.
        statistics: Of the whole dataset.
        shard: One of its shards, which the plate shows the first 16 problems of.

    Returns:
        The names of the files that were written; none without Matplotlib, which is logged once.

    Raises:
        OSError: If a file cannot be written.
    """
    try:
        import matplotlib.style
    except ImportError:
        logger.warning("The card has no pictures: they need Matplotlib (pip install matplotlib).")
        return []
    with matplotlib.style.context(["default", _STYLE]):
        _histograms(folder / HISTOGRAMS, statistics)
        _plate(folder / PLATE, shard)
    return [HISTOGRAMS, PLATE]


def _histograms(path: Path, s: Statistics) -> None:
    figure = _figure(_WIDTH, 4.6)
    axes = figure.subplots(2, 2).ravel()
    solved = s.solved
    _costs(axes[0], {"REL": s.rel_cost, "cheapest optimum": s.best_cost[solved]})
    _iterations(axes[1], s.scp_iterations)
    c_rel = s.c_rel
    edges = np.arange(-0.5, c_rel.max(initial=0) + 1.5)
    axes[2].hist(c_rel, edges, histtype="stepfilled", color=_REL_BARS)
    axes[2].set(xlabel="$C_{REL}$, nodes of REL inside a keep-out zone", ylabel="problems")
    ratio = s.best_cost[solved] / s.rel_cost[solved]
    # Where REL is feasible the ratio is one up to rounding, below it as often as above.
    low, high = min(1.0, ratio.min(initial=1.0)), max(1.05, ratio.max(initial=1.0))
    axes[3].hist(ratio, np.linspace(low, high, _BINS + 1), histtype="stepfilled", color=_BEST)
    axes[3].set(xlabel="cost of the cheapest optimum / cost of REL", ylabel="problems")
    for axis, count in ((axes[2], len(c_rel)), (axes[3], len(ratio))):
        if count:
            axis.set_yscale("log")
            axis.set_ylim(bottom=0.7)
    for letter, axis in zip("abcd", axes):
        axis.set_title(f"({letter})", loc="left", fontweight="bold")
        axis.spines[["top", "right"]].set_visible(False)
    for axis in axes[:2]:
        axis.yaxis.set_major_formatter("{x:,.0f}")
    _save(figure, path)


def _costs(axis: Any, costs: dict[str, NDArray[np.float64]]) -> None:
    both = np.concatenate(list(costs.values()))
    low, high = np.quantile(both, [0.0, _SHOWN]).tolist() if len(both) else (0.0, 1.0)
    edges = np.linspace(low, max(high, low + 1e-3), _BINS + 1)
    for (name, values), color in zip(costs.items(), (_REL_BARS, _BEST)):
        axis.hist(values, edges, histtype="stepfilled", alpha=0.35, color=color, label=name)
        axis.hist(values, edges, histtype="step", lw=0.9, color=color)
    axis.set(xlabel="cost in m/s", ylabel="problems")
    axis.legend()
    if beyond := int((both > edges[-1]).sum()):
        axis.text(1.0, 0.06, f"{beyond:,} beyond", transform=axis.transAxes, ha="right", size=7)


def _iterations(axis: Any, iterations: NDArray[np.int32]) -> None:
    edges = np.arange(0.5, _MANY + 1.5)
    axis.hist(np.minimum(iterations, _MANY), edges, color=_BEST, rwidth=0.86)
    ticks = [1, 3, 5, 7, 9, 11, 13, _MANY]
    axis.set_xticks(ticks, [*map(str, ticks[:-1]), rf"$\geq${_MANY}"])
    axis.set(xlabel="SCP iterations (subproblems solved) per optimum", ylabel="optima")


def _plate(path: Path, shard: Shard) -> None:
    scenario = Scenario()
    width, height = scenario.table
    kept = np.unique(shard.problem)[: _ROWS * _COLUMNS]
    figure = _figure(_WIDTH, 6.1, layout=None)
    grid = {"left": 0.05, "right": 0.995, "bottom": 0.065, "top": 0.93, "wspace": 0.06}
    axes = figure.subplots(
        _ROWS, _COLUMNS, sharex=True, sharey=True, gridspec_kw={**grid, "hspace": 0.22}
    )
    for axis, problem in zip(axes.ravel(), kept):
        _panel(axis, shard, int(problem), scenario)
    for axis in axes.ravel()[len(kept) :]:
        axis.set_axis_off()
    axes[0, 0].set(xlim=(0.0, width), ylim=(0.0, height))
    axes[0, 0].set(xticks=np.arange(0.0, width), yticks=np.arange(0.0, height))
    figure.supxlabel("$r_x$ in m", x=0.52, y=0.008, fontsize=8.0)
    figure.supylabel("$r_y$ in m", x=0.003, fontsize=8.0)
    figure.legend(*_legend(), loc="upper center", ncol=7, columnspacing=1.2)
    _save(figure, path)


def _panel(axis: Any, shard: Shard, problem: int, scenario: Scenario) -> None:
    """One problem with all its trajectories."""
    from matplotlib.patches import Circle

    for x, y, radius, *velocity in shard.obstacles[problem]:
        if radius > 0.0:
            if any(velocity):
                way = 0.5 * shard.final_time[problem] * np.array(velocity)
                axis.annotate(
                    "", (x + way[0], y + way[1]), (x, y), arrowprops={"arrowstyle": "->", "lw": 0.6}
                )
            keep_out = (radius + scenario.robot.radius) * scenario.keep_out_factor
            axis.add_patch(Circle((x, y), keep_out, color=_KEEP_OUT, lw=0.0, zorder=0))
            axis.add_patch(Circle((x, y), radius, color=_OBSTACLE, lw=0.0, zorder=1))
    for index in np.flatnonzero(shard.problem == problem):
        states = dynamics.rollout(
            shard.start[problem],
            shard.controls_of(int(index)).astype(np.float64),
            scenario.dt,
            scenario.robot,
        )
        if shard.label[index] == LABEL_REL:
            style: dict[str, Any] = {"color": _REL, "ls": (0, (3, 2)), "lw": 0.9, "zorder": 5}
        elif shard.rank[index] == 0:
            style = {"color": _BEST, "lw": 1.8, "zorder": 4}
        else:
            style = {"color": _OTHER, "lw": 0.9, "zorder": 3}
        axis.plot(states[:, 0], states[:, 1], **style)
    for state, color, marker in (
        (shard.start[problem], _START, "o"),
        (shard.goal[problem], _GOAL, "s"),
    ):
        x, y, heading = state[:3]
        ends = [x, x + _HEADING * np.cos(heading)], [y, y + _HEADING * np.sin(heading)]
        # Whole at the table's edge too, where starts and goals lie.
        axis.plot(*ends, color=color, lw=1.1, zorder=6, clip_on=False)
        axis.plot(x, y, marker, ms=3.6, mec="white", mew=0.4, color=color, zorder=7, clip_on=False)
    axis.set_aspect("equal")
    axis.tick_params(length=2.0, pad=2.0)
    axis.set_title(
        f"{shard.final_time[problem]:g} s, $C_{{REL}}$ = {shard.c_rel[problem]}", size=7.0, pad=2.5
    )


def _legend() -> tuple[list[Any], list[str]]:
    from matplotlib.lines import Line2D

    def disc(color: str, size: float) -> Any:
        return Line2D([], [], marker="o", ls="", ms=size, mew=0.0, color=color)

    marks = {
        "REL": Line2D([], [], color=_REL, ls=(0, (3, 2)), lw=0.9),
        "cheapest optimum": Line2D([], [], color=_BEST, lw=1.8),
        "other optima": Line2D([], [], color=_OTHER, lw=0.9),
        "start": Line2D([], [], marker="o", ls="", ms=3.6, mew=0.0, color=_START),
        "goal": Line2D([], [], marker="s", ls="", ms=3.6, mew=0.0, color=_GOAL),
        "obstacle": disc(_OBSTACLE, 6.0),
        "keep-out zone": disc(_KEEP_OUT, 8.0),
    }
    return list(marks.values()), list(marks)


def _figure(width: float, height: float, layout: Any = "constrained") -> Any:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=_DPI, layout=layout)
    FigureCanvasAgg(figure)
    return figure


def _save(figure: Any, path: Path) -> None:
    """Writes a PNG with a palette, a third of the size, and without metadata."""
    from PIL import Image

    figure.canvas.draw()
    picture = Image.fromarray(np.asarray(figure.canvas.buffer_rgba())).convert("RGB")
    picture = picture.quantize(_N_COLOURS, dither=Image.Dither.NONE)
    picture.save(path, format="PNG", optimize=True, dpi=(_DPI, _DPI))
