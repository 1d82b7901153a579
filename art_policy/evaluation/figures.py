"""Figures of an evaluation, drawn from its report (Matplotlib)."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

_PANELS = (
    ("infeasible_rate", "infeasible in %"),
    ("suboptimality_improvement", "suboptimality improvement in %"),
    ("mean_iterations", "iterations"),
)
#: Of the methods in their order; more than these begin again.
_COLORS = ("#7f8794", "#b7bdc8", "#1f6fb4", "#7fb3dd", "#17507f", "#ec7a1c", "#f5b27c", "#a8530d",
           "#2c9660", "#7cc9a2", "#9467bd", "#c7aede", "#8c564b", "#d62728")  # fmt: skip


def figures(report: Mapping[str, Any], folder: Path) -> list[Path]:
    """Writes all figures that a report has the data for.

    These are ``by_c_rel.png`` (paper, Fig. 3), ``by_final_time.png`` (Fig. 4) and
    ``by_obstacles.png`` where there are several, and ``cost_against_time.png``, which settles what
    to use when.

    Args:
        report: As :func:`art_policy.evaluation.report` gives it, or read back from JSON.
        folder: Where to; made if it is not there.

    Returns:
        The files that were written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    groups = report["groups"]
    by_c_rel = [(0.0, groups["all"])]
    by_c_rel += [
        (float(name.removeprefix("C_REL >= ")), group)
        for name, group in groups.items()
        if name.startswith("C_REL >= ")
    ]
    by_time = [
        (float(name.split()[2]), group) for name, group in groups.items() if name[:5] == "T_f ="
    ]
    written = [cost_against_time(groups["all"], folder / "cost_against_time.png")]
    written.append(_by_group(by_c_rel, "$C_{REL}$ at least", folder / "by_c_rel.png"))
    by_count = [
        (float(name.split()[0]), group)
        for name, group in groups.items()
        if name.endswith(" obstacles")
    ]
    if len(by_count) > 1:
        written.append(_by_group(by_count, "number of obstacles", folder / "by_obstacles.png"))
    if len(by_time) > 1:
        written.append(_by_group(by_time, "final time in s", folder / "by_final_time.png"))
    return written


def cost_against_time(group: Mapping[str, Mapping[str, Any]], path: Path) -> Path:
    """Suboptimality improvement against median time of every method, with infeasible rates."""
    figure = _figure(8.6, 3.8)
    axis = figure.subplots()
    for (name, row), color in zip(_methods(group), itertools.cycle(_COLORS)):
        x, y = row["median_time_ms"], 100.0 * row["suboptimality_improvement"]
        ends = row.get("suboptimality_improvement_interval")
        if ends:
            axis.plot([x, x], [100.0 * end for end in ends], color=color, lw=1.2)
        label = f"{name} ({100.0 * row['infeasible_rate']:.1f} % infeasible)"
        axis.plot(x, y, "o", color=color, ms=7, label=label)
    best = group.get("best known")
    if best and best["suboptimality_improvement"] is not None:
        level = 100.0 * best["suboptimality_improvement"]
        axis.axhline(level, color="#2c9660", lw=0.9, ls="--")
        axis.annotate(
            "best known", (0.99, level), (0, 3), xycoords=("axes fraction", "data"),
            textcoords="offset points", ha="right", fontsize=7.5, color="#2c9660",
        )  # fmt: skip
    axis.set(xscale="log", xlabel="median time in ms", ylabel="suboptimality improvement in %")
    axis.margins(x=0.1, y=0.1)
    figure.legend(loc="outside right upper", frameon=False, fontsize=8)
    return _save(figure, path)


def _by_group(
    groups: Sequence[tuple[float, Mapping[str, Mapping[str, Any]]]], label: str, path: Path
) -> Path:
    """Three panels of all methods over a quantity that the problems are grouped by."""
    figure = _figure(10.0, 3.4)
    # Not everything is defined in every group: without obstacles there is no gap to close.
    names = dict.fromkeys(name for _, group in groups for name, _ in _methods(group))
    for axis, (key, title) in zip(figure.subplots(1, len(_PANELS)), _PANELS):
        scale = 1.0 if key == "mean_iterations" else 100.0
        for name, color in zip(names, itertools.cycle(_COLORS)):
            rows = [(x, group[name]) for x, group in groups if group[name][key] is not None]
            xs = [x for x, _ in rows]
            ys = [scale * row[key] for _, row in rows]
            axis.plot(xs, ys, "o-", ms=3.5, lw=1.3, color=color, label=name)
            low, high = (_ends(rows, key, scale, side) for side in range(2))
            if low and high:
                axis.fill_between(xs, low, high, color=color, alpha=0.12, lw=0)
        axis.set(xlabel=label, ylabel=title, xticks=[x for x, _ in groups])
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, fontsize=8)
    return _save(figure, path)


def _ends(
    rows: Sequence[tuple[float, Mapping[str, Any]]], key: str, scale: float, side: int
) -> list[float]:
    """Lower or upper ends of the intervals; none where a row has none."""
    if key == "infeasible_rate":
        return [scale * row[("infeasible_low", "infeasible_high")[side]] for _, row in rows]
    if key == "suboptimality_improvement" and all(f"{key}_interval" in row for _, row in rows):
        return [scale * row[f"{key}_interval"][side] for _, row in rows]
    return []


def _methods(group: Mapping[str, Mapping[str, Any]]) -> list[tuple[str, Mapping[str, Any]]]:
    """The methods that were timed, in order."""
    return [
        (name, row)
        for name, row in group.items()
        if name != "best known"
        and row["median_time_ms"] is not None
        and row["suboptimality_improvement"] is not None
        and np.isfinite(row["suboptimality_improvement"])
    ]


def _figure(width: float, height: float) -> Any:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _save(figure: Any, path: Path) -> Path:
    for axis in figure.axes:
        axis.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=120, metadata={"Software": None})
    return path
