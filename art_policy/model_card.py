"""The card that a training leaves beside its model: what it is, and how it was made."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

_FIGURES = {
    "val_loss": "loss",
    "val_distance": "nearest hypothesis, distance to the cheapest optimum in m",
    "val_chosen_distance": "best-scored hypothesis, distance to the cheapest optimum in m",
    "val_agreement": "best-scored hypothesis is the nearest one",
    "val_regret": "relative excess cost of the optimum nearest to the best-scored hypothesis",
    "val_control_loss": "mean squared error of the normalised controls",
    "val_state_loss": "mean squared error of the normalised state changes",
    "val_infeasible": "first candidate: plans that failed",
    "val_excess": "first candidate: mean excess over the best known cost (a failure: 0.5)",
    "val_iterations": "first candidate: subproblems",
}


def write_card(
    folder: Path,
    settings: dict[str, Any],
    log: Sequence[dict[str, Any]],
    flops: float,
    peak: float,
) -> Path:
    """Writes ``README.md`` into a model's folder.

    Args:
        folder: Where the model is.
        settings: Of the run: ``model``, ``train`` and ``data``.
        log: All rows of the log.
        flops: Operations of matrix products per example, forward and backward.
        peak: Operations a second that large matrix products reach on all devices of the run.
    """
    model, train, data = settings["model"], settings["train"], settings["data"]
    steps = [row for row in log if "lr" in row]
    lines = [
        f"# {folder.resolve().name}",
        "",
        f"A {model['head'].replace('_', '-')} ART, trained by `freeflyer train`.",
        "",
        "| | |",
        "|---|---|",
        f"| data | {data['dataset']} |",
        f"| examples | {data['examples']:,} |",
    ]
    if steps:
        speed = sum(row["samples_per_s"] for row in steps) / len(steps)
        lines += [
            f"| steps | {steps[-1]['step']:,} of {train['batch_size']} examples |",
            f"| time | {steps[-1]['minutes']:.0f} minutes |",
            f"| throughput | {speed:,.0f} examples/s, {speed * flops / 1e12:.3g} TFLOP/s of "
            f"matrix products, {speed * flops / peak:.0%} of the {peak / 1e12:.3g} that large ones "
            "reach |",
        ]
    if envelope := model.get("envelope"):
        low, high = envelope["final_time"]
        fewest, most = envelope["n_obstacles"]
        lines += [
            f"| final times | {low:g} to {high:g} s |",
            f"| obstacles | {fewest} to {most}, up to {envelope['obstacle_speed']:g} m/s |",
        ]
    examined = [row for row in log if any(key in row for key in _FIGURES)]
    if examined:
        # The model that is kept: the one that planned best, the later one of two alike.
        kept = min(reversed(examined), key=lambda row: row.get("val_excess", 0.0))
        lines += ["", "## On held-out problems", "", "| figure | value |", "|---|---|"]
        lines += [f"| step | {kept['step']:,} |"]
        lines += [f"| {text} | {kept[k]:.4g} |" for k, text in _FIGURES.items() if k in kept]
    lines += ["", "## Settings", "", "```json", json.dumps(settings, indent=1), "```", ""]
    path = folder / "README.md"
    path.write_text("\n".join(lines), encoding="utf-8")
    return path
