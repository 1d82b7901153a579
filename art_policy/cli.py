"""The ``freeflyer`` command line.

Bad input ends with one line on standard error and exit code 2, planning that finds no solution with
exit code 1; ``--json`` prints one JSON object for machines on standard output.
"""

from __future__ import annotations

import argparse
import logging
import os
import re
import shlex
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from art_policy.cli_io import (
    check_out,
    flight_summary,
    flight_text,
    plan_summary,
    plan_text,
    planner_of,
    print_result,
    problem_of,
    write_plan,
)
from art_policy.cli_models import correct_model, evaluate_models, export_model, train_model
from freeflyer_datasets.generate import ENGINES, GenerationError

DEFAULT_MODEL = "art-general"


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of the ``freeflyer`` script; returns the exit code."""
    parser = _parser()
    words = list(arguments if arguments is not None else sys.argv[1:])
    options = parser.parse_args(words)
    options.given, options.line = set(words), shlex.join(["freeflyer", *words])
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    try:
        return options.run(options) or 0
    except KeyboardInterrupt:
        print("interrupted; what takes long resumes with the same command", file=sys.stderr)
        return 130
    except (ValueError, OSError, ModuleNotFoundError, GenerationError) as error:
        message = " ".join(str(error).split())
        print(f"freeflyer {options.command}: error: {message}", file=sys.stderr)
        return 2


# -- commands ------------------------------------------------------------------------------------


def _plan(options: argparse.Namespace) -> int:
    check_out(options.out, (".json", ".png"))
    problem = problem_of(options)
    plan = planner_of(options).plan(problem)
    summary = {"problem": problem.to_dict(), **plan_summary(plan)}
    if options.out:
        write_plan(options.out, problem, plan)
        summary["out"] = str(options.out)
    print_result(options, summary, plan_text(plan))
    return 0 if plan.result.solved else 1


def _fly(options: argparse.Namespace) -> None:
    from art_policy.figures import fly_and_film

    check_out(options.out, (".gif",))
    problem = problem_of(options)
    plan = planner_of(options).plan(problem)
    if plan.trajectory is None:
        raise ValueError(f"there is no plan to fly: {plan.result.message}")
    flight, frames = fly_and_film(problem, plan, film=bool(options.out))
    summary = {**plan_summary(plan), "flight": flight_summary(flight)}
    if options.out:
        from freeflyer_env.rendering import save_gif

        save_gif(frames, options.out, fps=10)
        summary["out"] = str(options.out)
    print_result(options, summary, f"{plan_text(plan)}\n{flight_text(flight)}")


def _generate(options: argparse.Namespace) -> None:
    from freeflyer_datasets import build, load_recipe

    recipe = load_recipe(options.recipe)
    if options.out:
        os.environ["MINARI_DATASETS_PATH"] = str(Path(options.out).resolve())
    dataset = build(
        recipe,
        n_problems=options.problems,
        workers=options.workers,
        engine=options.engine,
        progress=not options.json,
        force=options.force,
    )
    where = f" in {options.out}" if options.out else ""
    text = f"made {dataset}{where}; load it with minari.load_dataset({dataset!r})"
    if options.out:
        text += f" and MINARI_DATASETS_PATH={options.out}"
    print_result(options, {"dataset": dataset, "out": options.out}, text)


def _render(options: argparse.Namespace) -> None:
    import minari

    from freeflyer_env import Problem
    from freeflyer_env.rendering import draw_scene, save_gif

    check_out(options.out, (".gif", ".png"))
    dataset = minari.load_dataset(options.dataset)
    if not 0 <= options.episode < dataset.total_episodes:
        raise ValueError(
            f"--episode must be in [0, {dataset.total_episodes - 1}], got {options.episode}"
        )
    observations: Any = dataset[options.episode].observations
    problem = Problem.from_dict({key: value[0] for key, value in observations.items()})
    states = observations["state"]

    def frame(index: int) -> Any:
        return draw_scene(
            problem.scenario,
            states[index, :3],
            goal=problem.goal[:3],
            planned=states[:, :2],
            flown=states[: index + 1, :2],
            time=index * problem.scenario.dt,
        )

    if str(options.out).endswith(".png"):
        from PIL import Image

        Image.fromarray(frame(len(states) - 1)).save(options.out)
    else:
        save_gif([frame(i) for i in range(len(states))], options.out, fps=10)
    print_result(options, {"out": options.out}, f"wrote {options.out}")


def _upload(options: argparse.Namespace) -> None:
    from freeflyer_datasets.sharing import upload

    url = upload(options.dataset, remote=options.remote, progress=not options.json)
    print_result(options, {"dataset": options.dataset, "url": url}, f"published at {url}")


def _download(options: argparse.Namespace) -> None:
    from freeflyer_datasets.sharing import download

    folder = download(
        options.dataset, remote=options.remote, force=options.force, progress=not options.json
    )
    text = f"fetched into {folder}; load it with minari.load_dataset({options.dataset!r})"
    print_result(options, {"dataset": options.dataset, "folder": str(folder)}, text)


def _info(options: argparse.Namespace) -> None:
    from freeflyer_datasets import list_recipes
    from freeflyer_datasets.describe import describe, describe_text, find_local, list_local

    name = options.name
    if name is None:
        import freeflyer_env
        from art_policy.model import shipped_models

        data: dict[str, Any] = {
            "version": freeflyer_env.__version__,
            "models": shipped_models(),
            "datasets": list_local(),
            "recipes": list_recipes(),
            "scenes": list(freeflyer_env.SCENES),
        }
        lines = (f"{key}: {', '.join(value) or 'none'}" for key, value in list(data.items())[1:])
        print_result(options, data, "\n".join([f"version: {data['version']}", *lines]))
    elif find_local(name):
        data = describe(name)
        print_result(options, data, describe_text(data))
    else:
        data = _model_info(name)
        print_result(options, data, "\n".join(f"{key}: {value}" for key, value in data.items()))


def _model_info(name: str) -> dict[str, Any]:
    from art_policy.model import ART, shipped_models
    from freeflyer_datasets.describe import unknown_text

    shipped = shipped_models()
    # A folder is a model, and what cannot be a dataset's id may be one on the hub.
    on_hub = name.count("/") == 1 and not re.search(r"-v\d+$", name)
    if name not in shipped and not Path(name).is_dir():
        message = unknown_text(name, shipped)
        if not on_hub or "Did you mean" in message:
            raise ValueError(message)
    model = ART.from_pretrained(name)
    return {"model": name, "parameters": model.num_parameters, "config": model.config.to_dict()}


# -- options -------------------------------------------------------------------------------------


def _at_least_one(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1, got {value}")
    return value


def _parser() -> argparse.ArgumentParser:
    count = _at_least_one
    parser = argparse.ArgumentParser(
        prog="freeflyer", description="Learned warm starts for a free-flying spacecraft robot."
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def command(name: str, run: Callable[[argparse.Namespace], int | None], text: str) -> Any:
        sub = commands.add_parser(name, help=text, description=text)
        sub.set_defaults(run=run)
        sub.add_argument("--seed", type=int, default=0, help="seed of everything random")
        sub.add_argument("--json", action="store_true", help="print one JSON object")
        return sub

    for name, run, text in (
        ("plan", _plan, "Plan one problem: ART proposes, SCP refines."),
        ("fly", _fly, "Plan one problem and fly the plan under PID with the thrusters."),
    ):
        sub = command(name, run, text)
        sub.add_argument("--scene", default="random", help="'random' or a scene's name")
        sub.add_argument("--final-time", type=float, default=40.0, help="in s")
        sub.add_argument(
            "--start", type=float, nargs=3, metavar=("X", "Y", "PSI"), help="m, m, rad"
        )
        sub.add_argument("--goal", type=float, nargs=3, metavar=("X", "Y", "PSI"), help="m, m, rad")
        sub.add_argument("--problem", help="JSON file with start, goal, obstacles, final_time")
        sub.add_argument("--model", default=DEFAULT_MODEL, help="model, or 'rel' for none")
        sub.add_argument("--candidates", type=count, default=1, help="proposals that are refined")
        sub.add_argument("--out", help="plan: .json or .png; fly: .gif")

    sub = command("generate", _generate, "Make a Minari dataset from a recipe; resumes.")
    sub.add_argument("recipe", help="a recipe's name or TOML file")
    sub.add_argument("--problems", type=count, help="how many problems (default: the recipe's)")
    sub.add_argument("--workers", type=count, help="processes (default: one per processor)")
    sub.add_argument("--engine", choices=ENGINES, default="local", help="ray: a Ray cluster")
    sub.add_argument("--out", help="Minari data root (default: Minari's own)")
    sub.add_argument("--force", action="store_true", help="replace a dataset of the same id")

    sub = command("train", train_model, "Train a model on datasets; resumes.")
    text = "Minari id, or a folder of shards or of a packed dataset"
    sub.add_argument("datasets", nargs="+", metavar="DATASET", help=text)
    heads = ("multi_hypothesis", "autoregressive", "autoregressive_small")
    sub.add_argument("--head", choices=heads, default=heads[0])
    sub.add_argument("--minutes", type=float, help="length of the training")
    sub.add_argument("--steps", type=count, help="length of the training in optimiser steps")
    sub.add_argument("--out", required=True, help="folder of the model")
    sub.add_argument("--model-config", help="JSON with fields of ARTConfig")
    sub.add_argument("--train-config", help="JSON with fields of TrainConfig")

    sub = command("correct", correct_model, "Optimal continuations of what a model did (DAgger).")
    sub.add_argument("model", help="an autoregressive model's name, folder, Hugging Face id")
    sub.add_argument("dataset", help="what it was trained on, as for train")
    sub.add_argument("--problems", type=count, default=10_000, help="how many it is let run on")
    sub.add_argument("--workers", type=count, help="processes (default: one per processor)")
    sub.add_argument("--out", required=True, help="folder of the new dataset, for train")

    sub = command("evaluate", evaluate_models, "Compare warm starts on problems never trained on.")
    sub.add_argument(
        "models", nargs="+", metavar="MODEL", help="a shipped model's name, folder, Hugging Face id"
    )
    sub.add_argument("--problems", type=count, default=300)
    text = "'held-out', 'random', 'clutter' or a scene's name"
    sub.add_argument("--scenes", default="held-out", help=text)
    sub.add_argument("--obstacles", type=int, nargs="+", help="numbers of obstacles of new scenes")
    sub.add_argument("--obstacle-speed", type=float, default=0.0, help="largest, in m/s")
    sub.add_argument("--final-time", type=float, nargs="+", default=[40.0], help="in s")
    sub.add_argument("--candidates", type=count, default=4, help="most candidates refined")
    sub.add_argument("--starts", type=count, default=13, help="starts for the best known solution")
    text = "stop every SCP once its cost has settled to 0.5 mm/s (the paper: 1e-6 m/s)"
    sub.add_argument("--quick", action="store_true", help=text)
    sub.add_argument("--workers", type=count)
    sub.add_argument("--out", help="JSON file for the report; with it the evaluation resumes")
    sub.add_argument("--figures", help="folder for figures")

    sub = command("export", export_model, "Write a model as ONNX, quicker for one problem.")
    sub.add_argument("model", help="a shipped model's name, folder, Hugging Face id")
    sub.add_argument("--int8", action="store_true", help="weights as 8-bit integers")
    sub.add_argument("--out", required=True, help=".onnx file")

    sub = command("render", _render, "Draw an episode of a dataset.")
    sub.add_argument("dataset", help="Minari id")
    sub.add_argument("--episode", type=int, default=0)
    sub.add_argument("--out", required=True, help=".gif or .png")

    for name, share, text in (
        ("upload", _upload, "Publish a local dataset on the Hugging Face hub; resumes."),
        ("download", _download, "Fetch a dataset from the Hugging Face hub; resumes."),
    ):
        sub = command(name, share, text)
        sub.add_argument("dataset", help="Minari id")
        sub.add_argument("--remote", help="hf://OWNER (default: Minari's own setting)")
        if name == "download":
            sub.add_argument("--force", action="store_true", help="replace a local dataset")

    sub = command("info", _info, "What is installed, or what a model or a dataset is.")
    sub.add_argument("name", nargs="?", help="a model, or a local dataset's Minari id")
    return parser


if __name__ == "__main__":
    sys.exit(main())
