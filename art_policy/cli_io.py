"""What the commands share: reading options into objects, and printing results."""

from __future__ import annotations

import argparse
import json
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any


def problem_of(options: argparse.Namespace) -> Any:
    """The problem that the options describe; raises ``ValueError`` if it is invalid."""
    import numpy as np

    from freeflyer_env import Problem, Scenario, sample_problem, unwrap_goal

    if options.problem:
        if clash := options.given & {"--scene", "--final-time", "--start", "--goal"}:
            raise ValueError(f"--problem says it all; leave out {', '.join(sorted(clash))}")
        data = json.loads(Path(options.problem).read_text(encoding="utf-8"))
        if not isinstance(data, dict):
            raise ValueError(f"{options.problem} must hold a JSON object with start, goal, ...")
        return Problem.from_dict(data.get("problem", data)).require_valid()
    scenario = None if options.scene == "random" else Scenario.named(options.scene)
    rng = np.random.default_rng(options.seed)
    problem = sample_problem(rng, scenario, options.final_time)
    start, goal = problem.start, problem.goal
    if options.start:
        start = np.array([*options.start, 0.0, 0.0, 0.0])
    if options.goal:
        goal = np.array([*options.goal, 0.0, 0.0, 0.0])
    if options.start or options.goal:
        goal = unwrap_goal(start, goal)
        problem = Problem(problem.scenario, start, goal, problem.final_time)
    return problem.require_valid()


def planner_of(options: argparse.Namespace) -> Any:
    """The planner with the model that the options name; ``"rel"`` is none."""
    from art_policy.model import load_model
    from art_policy.planner import PlannerConfig, WarmStartPlanner

    model = None if options.model == "rel" else load_model(options.model)
    return WarmStartPlanner(model, PlannerConfig(n_candidates=options.candidates))


def configure(make: Callable[..., Any], option: str, text: str | None, **values: Any) -> Any:
    """Makes a configuration from the JSON of an option; any mistake in it is a ``ValueError``."""
    try:
        changes = json.loads(text or "{}")
        return make(**{**values, **changes})
    except (TypeError, AttributeError, json.JSONDecodeError) as error:
        raise ValueError(f"{option} must be a JSON object of settings: {error}") from None


def check_out(path: str | None, suffixes: tuple[str, ...]) -> None:
    """Refuses an output file that cannot be written before the work, not after it."""
    if path is None:
        return
    if suffixes and Path(path).suffix not in suffixes:
        raise ValueError(f"--out must end in {' or '.join(suffixes)}, got {path!r}")
    if suffixes and Path(path).is_dir():
        raise ValueError(f"--out must be a file, {path!r} is a folder")
    folder = Path(path).resolve()
    while not folder.exists():
        folder = folder.parent
    if not os.access(folder, os.W_OK) or (folder.is_file() and folder != Path(path).resolve()):
        raise ValueError(f"--out {path!r} cannot be written")
    if not suffixes and folder.is_file():
        raise ValueError(f"--out must be a folder, {path!r} is a file")
    Path(path).resolve().parent.mkdir(parents=True, exist_ok=True)


def plan_summary(plan: Any) -> dict[str, Any]:
    """Figures of a plan for JSON."""
    return {
        "status": plan.result.status.value,
        "cost": plan.result.cost if plan.result.solved else None,
        "iterations": plan.iterations,
        "source": plan.source,
        "timings_ms": {name: 1e3 * value for name, value in plan.timings.items()},
        "monitor": list(plan.monitor),
    }


def plan_text(plan: Any) -> str:
    """A few lines about a plan, with what the monitor had to say."""
    lines = [f"{plan.result.status.value}: {plan.result.message}"]
    if plan.result.solved:
        lines.append(
            f"cost {plan.result.cost:.4f} m/s, warm start from {plan.source.upper()}, "
            f"{plan.iterations} iterations, {1e3 * plan.timings['total']:.0f} ms"
        )
    return "\n".join([*lines, *(f"monitor: {line}" for line in plan.monitor)])


def flight_summary(flight: Any) -> dict[str, Any]:
    """Figures of a flight for JSON."""
    return {
        "success": flight.success,
        "final_position_error_m": flight.final_error[0],
        "final_heading_error_rad": flight.final_error[1],
        "tracking_error_m": flight.tracking_error,
        "firing_time_s": flight.firing_time,
        "contacts": flight.contacts,
    }


def flight_text(flight: Any) -> str:
    """One line about a flight."""
    return (
        f"flown under PID: {'success' if flight.success else 'goal missed'}, "
        f"{1e3 * flight.final_error[0]:.1f} mm and {math.degrees(flight.final_error[1]):.2f} deg "
        f"from the goal, tracking within {1e3 * flight.tracking_error:.1f} mm, "
        f"{flight.firing_time:.1f} s of firing, {flight.contacts} contacts"
    )


def write_plan(out: str, problem: Any, plan: Any) -> None:
    """Writes a plan as JSON, or a picture of it."""
    trajectory = plan.trajectory
    states = None if trajectory is None else trajectory.states
    if out.endswith(".json"):
        controls = None if trajectory is None else trajectory.controls.tolist()
        data = {"problem": problem.to_dict(), **plan_summary(plan)}
        data |= {"states": None if states is None else states.tolist(), "controls": controls}
        Path(out).write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
        return
    from PIL import Image

    from freeflyer_env.rendering import draw_scene

    picture = draw_scene(
        problem.scenario,
        problem.start[:3],
        goal=problem.goal[:3],
        planned=None if states is None else states[:, :2],
    )
    Image.fromarray(picture).save(out)


def print_result(options: argparse.Namespace, data: dict[str, Any], text: str) -> None:
    """Prints ``data`` as one JSON object with ``--json``, else ``text``."""
    from art_policy.evaluation import finite

    print(json.dumps(finite(data), allow_nan=False) if options.json else text)
