"""What the records say: the protocol's figures with their uncertainty, as dictionary and table."""

from __future__ import annotations

import json
import platform
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from art_policy.evaluation.protocol import ProblemRecord
from freeflyer_datasets.summary import wilson_interval

#: Thresholds of the constraint-to-go of REL (paper, Fig. 3).
C_REL_THRESHOLDS = (0, 5, 10, 15, 20)

#: What the paper reports of its models against REL (Table II): by how much infeasible cases,
#: suboptimality and iterations fell.
PAPER = {
    "ART-Rs (held-out scenes)": {"infeasible": 0.82, "suboptimality": 0.0874, "iterations": 0.0779},
    "ART-Rt (final times)": {"infeasible": 0.786, "suboptimality": 0.1356, "iterations": 0.0152},
}

_RESAMPLES = 1000

#: Relative gap between REL + SCP and the bound below which SCP's tolerance is all there is to it.
_LEAST_GAP = 1e-4


def summarise(records: Sequence[ProblemRecord]) -> dict[str, dict[str, Any]]:
    """The protocol's figures per method, over the given problems.

    Costs and iterations are means over the problems that REL's bound and all methods were solved
    for (``n_common``), times are of all problems. ``suboptimality_improvement`` is
    ``(J_REL+SCP - J) / (J_REL+SCP - J_REL)`` of those means, against REL, undefined where there is
    no gap; the infeasible rate has its Wilson 95 % interval, the improvements have that of a paired
    bootstrap over problems (``*_interval``). The last row, ``best known``, is the cheapest solution
    of any method and start.
    """
    names = list(records[0].outcomes) if records else []
    common = [r for r in records if all(o.solved for o in r.outcomes.values()) and r.rel_cost > 0]
    common = [r for r in common if np.isfinite(r.rel_cost)]
    draws = np.random.default_rng(0).integers(0, max(len(common), 1), (_RESAMPLES, len(common)))
    bound = np.array([r.rel_cost for r in common])
    base = _columns(common, "REL")
    summary: dict[str, dict[str, Any]] = {}
    for name in names:
        failures = sum(not r.outcomes[name].solved for r in records)
        times = [r.outcomes[name].time for r in records]
        summary[name] = {
            **_rate(failures, len(records)),
            "n_common": len(common),
            **_improvements(bound, base, _columns(common, name), draws),
            "median_time_ms": 1e3 * float(np.median(times)),
            "mean_time_ms": 1e3 * float(np.mean(times)),
        }
    if records:
        best = np.array([[r.best_known, np.nan] for r in common]).reshape(-1, 2)
        failures = sum(not np.isfinite(r.best_known) for r in records)
        summary["best known"] = {
            **_rate(failures, len(records)),
            "n_common": len(common),
            **_improvements(bound, base, best, draws),
            "median_time_ms": float("nan"),
            "mean_time_ms": float("nan"),
        }
    return summary


def _columns(records: Sequence[ProblemRecord], name: str) -> NDArray[np.float64]:
    """``(n, 2)`` cost and iterations of a method."""
    rows = [(r.outcomes[name].cost, r.outcomes[name].iterations) for r in records]
    return np.array(rows, dtype=np.float64).reshape(-1, 2)


def _rate(failures: int, n: int) -> dict[str, Any]:
    low, high = wilson_interval(failures, n)
    return {
        "n": n,
        "infeasible": failures,
        "infeasible_rate": failures / n,
        "infeasible_low": low,
        "infeasible_high": high,
    }


def _improvements(
    bound: NDArray[np.float64],
    base: NDArray[np.float64],
    other: NDArray[np.float64],
    draws: NDArray[np.int64],
) -> dict[str, Any]:
    """Improvements over REL, each with its interval; undefined without common problems."""

    def figures(bounds: Any, bases: Any, others: Any) -> dict[str, Any]:
        with np.errstate(divide="ignore", invalid="ignore"):
            gap = bases[..., 0] - bounds
            saved = bases[..., 0] - others[..., 0]
            return {
                "suboptimality_improvement": np.where(
                    gap > _LEAST_GAP * bases[..., 0], saved / gap, np.nan
                ),
                "cost_improvement": saved / bases[..., 0],
                "iterations_improvement": 1.0 - others[..., 1] / bases[..., 1],
            }

    if not len(bound):
        undefined = dict.fromkeys(figures(np.ones(1), np.ones((1, 2)), np.ones((1, 2))), np.nan)
        return {**undefined, "mean_cost": np.nan, "mean_iterations": np.nan}
    result: dict[str, Any] = {
        name: float(value)
        for name, value in figures(bound.mean(), base.mean(axis=0), other.mean(axis=0)).items()
    }
    resampled = figures(*(part[draws].mean(axis=1) for part in (bound, base, other)))
    for name, values in resampled.items():
        if np.isfinite(values).all():
            result[f"{name}_interval"] = np.quantile(values, [0.025, 0.975]).tolist()
    result["mean_cost"], result["mean_iterations"] = other.mean(axis=0).tolist()
    return result


def report(
    records: Sequence[ProblemRecord], model: str | Sequence[str], command: str = ""
) -> dict[str, Any]:
    """What ``freeflyer evaluate`` writes to JSON: figures for all problems and by group.

    Args:
        records: Of all problems.
        model: The models' names.
        command: The command that made it, for whoever reads the report later.
    """
    groups = {"all": list(records)}
    for scene in sorted({r.scene for r in records}):
        groups[f"scene {scene}"] = [r for r in records if r.scene == scene]
    for threshold in C_REL_THRESHOLDS[1:]:
        groups[f"C_REL >= {threshold}"] = [r for r in records if r.c_rel >= threshold]
    solvable = [r for r in records if np.isfinite(r.best_known)]
    if len(solvable) < len(records):
        groups["solvable by some start"] = solvable
    for count in sorted({r.n_obstacles for r in records}):
        groups[f"{count} obstacles"] = [r for r in records if r.n_obstacles == count]
    for final_time in sorted({r.final_time for r in records}):
        groups[f"T_f = {final_time:g} s"] = [r for r in records if r.final_time == final_time]
    cells = sorted({(r.n_obstacles, r.final_time) for r in records})
    for cell in cells:
        name = f"{cell[0]} obstacles, T_f = {cell[1]:g} s"
        groups[name] = [r for r in records if (r.n_obstacles, r.final_time) == cell]
    return {
        "model": model if isinstance(model, str) else list(model),
        "command": command,
        "machine": {"processor": platform.machine(), "python": platform.python_version()},
        "paper": PAPER,
        "groups": {name: summarise(group) for name, group in groups.items() if group},
        "records": [record.to_dict() for record in records],
    }


def markdown_table(summary: dict[str, dict[str, Any]]) -> str:
    """The comparison as a Markdown table, one method a row."""
    lines = [
        "| warm start | infeasible (95 % interval) | suboptimality improvement (95 %) "
        "| cost improvement | iterations | time, median |",
        "|---|---|---|---|---|---|",
    ]
    for name, row in summary.items():
        improvement = "-"
        if np.isfinite(row["suboptimality_improvement"]):
            improvement = f"{row['suboptimality_improvement']:+.1%}"
        if name != "REL" and "suboptimality_improvement_interval" in row:
            low, high = row["suboptimality_improvement_interval"]
            improvement += f" ({low:+.1%} to {high:+.1%})"
        counted = np.isfinite(row["mean_iterations"])
        iterations = f"{row['mean_iterations']:.2f}" if counted else "-"
        time = f"{row['median_time_ms']:.0f} ms" if np.isfinite(row["median_time_ms"]) else "-"
        lines.append(
            f"| {name if name == 'best known' else f'{name} + SCP'} "
            f"| {row['infeasible_rate']:.1%} "
            f"({row['infeasible_low']:.1%} to {row['infeasible_high']:.1%}) "
            f"| {improvement} | {row['cost_improvement']:+.1%} | {iterations} | {time} |"
        )
    return "\n".join(lines)


def save_report(data: dict[str, Any], path: Path) -> None:
    """Writes a report as JSON (infinite costs become null)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(finite(data), indent=1) + "\n", encoding="utf-8")


def finite(value: Any) -> Any:
    """The value with infinite and undefined numbers, which JSON does not know, as None."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [finite(item) for item in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
