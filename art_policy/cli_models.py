"""The commands about models: train, evaluate, export."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from art_policy.cli_io import check_out, configure, print_result

if TYPE_CHECKING:
    from freeflyer_datasets import PackedDataset


def train_model(options: argparse.Namespace) -> None:
    """Trains a model on datasets."""
    from art_policy.layers import ARTConfig
    from art_policy.train import TrainConfig, train

    presets: dict[str, Callable[..., ARTConfig]] = {
        "multi_hypothesis": ARTConfig,
        "autoregressive": ARTConfig.paper,
        "autoregressive_small": ARTConfig.small,
    }
    model_config = configure(presets[options.head], "--model-config", options.model_config)
    length = {"max_minutes": options.minutes, "max_steps": options.steps, "seed": options.seed}
    config = configure(TrainConfig, "--train-config", options.train_config, **length)
    check_out(options.out, ())
    datasets = [open_dataset(name) for name in options.datasets]
    model = train(datasets, model_config, config, options.out)
    text = f"{model.num_parameters:,} parameters in {options.out}; now: freeflyer evaluate"
    print_result(
        options,
        {
            "out": options.out,
            "parameters": model.num_parameters,
            "problems": sum(dataset.n_problems for dataset in datasets),
        },
        f"{text} {options.out}",
    )


def correct_model(options: argparse.Namespace) -> None:
    """Collects optimal continuations of what a model did."""
    import torch

    from art_policy.corrections import collect_corrections
    from art_policy.model import ART

    device = "cuda" if torch.cuda.is_available() else "cpu"
    data = collect_corrections(
        ART.from_pretrained(options.model, device),
        open_dataset(options.dataset),
        options.problems,
        options.out,
        options.workers,
        options.seed,
        progress=not options.json,
    )
    text = f"{data.n_problems} problems in flight; now: freeflyer train {options.dataset}"
    print_result(
        options, {"out": options.out, "problems": data.n_problems}, f"{text} {options.out}"
    )


def open_dataset(name: str) -> PackedDataset:
    """The packed form of a dataset by its Minari id, or of a folder of shards or packed arrays."""
    from freeflyer_datasets import PackedDataset

    folder = Path(name)
    if not folder.is_dir():
        return PackedDataset.from_minari(name)
    is_packed = (folder / "meta.json").is_file()
    return PackedDataset.open(folder) if is_packed else PackedDataset.from_shards(folder)


def evaluate_models(options: argparse.Namespace) -> None:
    """Compares warm starts on problems never trained on."""
    from art_policy.evaluation import (
        evaluate,
        evaluation_problems,
        markdown_table,
        report,
        save_report,
    )
    from art_policy.evaluation.figures import figures
    from art_policy.figures import one_obstacle_moves
    from art_policy.model import load_model
    from freeflyer_env.planning import SCPConfig

    for model in options.models:
        load_model(model)  # a wrong name is an error before the work begins
    check_out(options.out, (".json",))
    partial = Path(f"{options.out}.partial") if options.out else None
    records = evaluate(
        options.models,
        evaluation_problems(
            options.problems,
            options.scenes,
            options.final_time,
            options.seed,
            options.obstacles,
            options.obstacle_speed,
        ),
        options.candidates,
        options.starts,
        SCPConfig.quick() if options.quick else SCPConfig(),
        options.workers,
        progress=not options.json,
        partial=partial,
    )
    data = report(records, options.models, options.line)
    if partial:
        save_report(data, Path(options.out))
        partial.unlink()
    drawn = []
    if options.figures:
        folder = Path(options.figures)
        models = {Path(name).name: load_model(name) for name in options.models}
        drawn = [str(path) for path in figures(data, folder)]
        drawn.append(str(one_obstacle_moves(models, folder / "one_obstacle_moves.png")))
    groups = data["groups"]
    summary = {"models": options.models, "groups": groups, "out": options.out, "figures": drawn}
    text = "\n\n".join(
        f"{name} ({group_size(group)} problems)\n\n{markdown_table(group)}"
        for name, group in groups.items()
        if ", T_f = " not in name  # the cells are for the file
    )
    print_result(options, summary, text)


def group_size(group: dict[str, dict[str, Any]]) -> int:
    """Number of problems of a group in a report."""
    return int(next(iter(group.values()))["n"])


def export_model(options: argparse.Namespace) -> None:
    """Writes a model as ONNX."""
    from art_policy.deployment import export_onnx
    from art_policy.model import ART

    check_out(options.out, (".onnx",))
    path = export_onnx(ART.from_pretrained(options.model), options.out, options.int8)
    size = path.stat().st_size / 1e6
    text = f"wrote {path} ({size:.1f} MB); now: freeflyer evaluate {options.model} {path}"
    print_result(options, {"out": str(path), "mb": size}, text)
