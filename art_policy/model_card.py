"""The card that a training leaves beside its model: what it is, and how it was made."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from art_policy.throughput import peak_flops

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
    folder: Path, settings: dict[str, Any], log: Sequence[dict[str, Any]], flops: float
) -> Path:
    """Writes ``README.md`` into a model's folder.

    Args:
        folder: Where the model is.
        settings: Of the run: ``model``, ``train`` and ``data``.
        log: All rows of the log.
        flops: Operations of matrix products per example, forward and backward.
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
            f"| throughput | {speed:,.0f} examples/s, {_utilisation(speed * flops)} |",
        ]
    if envelope := model.get("envelope"):
        low, high = envelope["final_time"]
        fewest, most = envelope["n_obstacles"]
        lines += [
            f"| final times | {low:g} to {high:g} s |",
            f"| obstacles | {fewest} to {most}, up to {envelope['obstacle_speed']:g} m/s |",
        ]
    for last in [row for row in log if any(key in row for key in _FIGURES)][-1:]:
        lines += ["", "## On held-out problems", "", "| figure | value |", "|---|---|"]
        lines += [f"| {text} | {last[k]:.4g} |" for k, text in _FIGURES.items() if k in last]
    lines += ["", "## Settings", "", "```json", json.dumps(settings, indent=1), "```", ""]
    path = folder / "README.md"
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def _utilisation(work: float) -> str:
    """Operations a second, as a share of what a matrix product reaches on this machine."""
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    half = device.type == "cuda" or torch.cpu._is_avx512_bf16_supported()
    peak = peak_flops(device, torch.bfloat16 if half else torch.float32)
    kind = "bfloat16" if half else "float32"
    return (
        f"{work / 1e12:.3g} TFLOP/s of matrix products, {work / peak:.0%} of the {peak / 1e12:.3g} "
        f"that a large one reaches here in {kind}"
    )
