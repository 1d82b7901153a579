"""Figures for papers and documentation, with Matplotlib."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from art_policy.rollout import propose
from freeflyer_env.planning import solve_rel, solve_scp
from freeflyer_env.scenario import Obstacles, Problem, Scenario

if TYPE_CHECKING:
    from art_policy.deployment import OnnxART
    from art_policy.model import ART
    from art_policy.planner import Plan
    from freeflyer_env.control import Flight


def plan_and_flight(problem: Problem, plan: Plan, flight: Flight, path: str | Path) -> None:
    """Planned against flown path, and velocities (paper, Figs. 5 and 6).

    Args:
        problem: What was planned.
        plan: A solved plan.
        flight: The flight under a tracking controller.
        path: Picture file to write.
    """
    from matplotlib.figure import Figure

    trajectory = plan.result.trajectory
    if trajectory is None:
        raise ValueError("plan_and_flight needs a solved plan.")
    figure = Figure(figsize=(11.0, 4.6), layout="constrained")
    table, velocity = figure.subplots(1, 2, width_ratios=(1.25, 1.0))
    _draw_table(table, problem)
    rel = solve_rel(problem).trajectory
    if rel is not None:
        table.plot(*rel.states[:, :2].T, color="0.6", lw=1.2, ls=":", label="REL")
    table.plot(
        *plan.warm_start.states[:, :2].T,
        color="tab:orange",
        lw=1.4,
        label=f"{plan.source.upper()} proposes",
    )
    table.plot(*trajectory.states[:, :2].T, "--", color="tab:blue", lw=2.2, label="SCP plans")
    table.plot(*flight.states[:, :2].T, color="black", lw=1.2, label="PID flies")
    table.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=4, frameon=False)
    for axis, (name, color) in enumerate((("x", "tab:blue"), ("y", "tab:red"))):
        planned = 100.0 * trajectory.states[:, 3 + axis]
        velocity.step(
            trajectory.times,
            planned,
            where="pre",
            color=color,
            ls="--",
            label=f"$v_{name}$ planned",
        )
        flown = 100.0 * flight.states[:, 3 + axis]
        velocity.plot(flight.times, flown, color=color, lw=1.0, label=f"$v_{name}$ flown")
    velocity.set(xlabel="time in s", ylabel="velocity in cm/s")
    velocity.grid(alpha=0.3)
    velocity.legend(frameon=False)
    figure.savefig(path, dpi=110, bbox_inches="tight")


def one_obstacle_moves(
    models: Mapping[str, ART | OnnxART], path: str | Path, n_panels: int = 5
) -> Path:
    """What models propose as one obstacle is put elsewhere (paper, Fig. 2).

    The obstacle crosses the way from start to goal; each panel shows REL, every model's first
    candidate (dashed), and what SCP makes of it.

    Args:
        models: By the name under which they are shown.
        path: Picture file to write.
        n_panels: Number of places of the obstacle.
    """
    from matplotlib.figure import Figure

    colors = ("#1f6fb4", "#ec7a1c", "#2c9660", "#9467bd")
    scene = Scenario.named("held-out-1")
    start, goal = np.zeros(6), np.zeros(6)
    start[:2], goal[:2] = (0.25, 1.25), (3.25, 1.25)
    figure = Figure(figsize=(3.0 * n_panels, 2.9), layout="constrained")
    for axis, y in zip(figure.subplots(1, n_panels), np.linspace(0.75, 1.75, n_panels)):
        rows = scene.obstacles.rows()
        rows[np.argmin(np.abs(rows[:, 0] - 1.75)), :2] = 1.75, y
        scenario = replace(scene, obstacles=Obstacles.from_rows(rows))
        problem = Problem(scenario, start, goal, 40.0)
        _draw_table(axis, problem)
        rel = solve_rel(problem).trajectory
        if rel is not None:
            axis.plot(*rel.states[:, :2].T, color="0.6", lw=1.0, ls=":", label="REL")
        for (name, model), color in zip(models.items(), itertools.cycle(colors)):
            warm_start = propose(model, problem, rel=rel)[0].trajectory
            axis.plot(*warm_start.states[:, :2].T, "--", color=color, lw=1.0, label=name)
            refined = solve_scp(problem, warm_start)
            if refined.solved and refined.trajectory is not None:
                label = f"SCP from {name}"
                axis.plot(*refined.trajectory.states[:, :2].T, color=color, lw=1.8, label=label)
        axis.set(xlabel="", ylabel="")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=6, frameon=False, fontsize=8)
    figure.savefig(path, dpi=110, metadata={"Software": None})
    return Path(path)


def fly_and_film(
    problem: Problem, plan: Plan, film: bool = True, every: int = 4
) -> tuple[Flight, list[NDArray[np.uint8]]]:
    """Flies a solved plan under PID with the thrusters in ``FreeFlyer-v0``.

    Args:
        problem: What was planned.
        plan: A solved plan.
        film: Whether to draw frames.
        every: Control periods of 0.1 s between frames.

    Returns:
        The flight, and its frames ``(H, W, 3)``.
    """
    import gymnasium as gym

    from freeflyer_env.control import fly

    if plan.trajectory is None:
        raise ValueError("There is no plan to fly.")
    env = gym.make(
        "freeflyer_env:FreeFlyer-v0",
        action_mode="thrusters",
        scenario=problem.scenario,
        terminate_early=False,
        render_mode="rgb_array" if film else None,
    )
    env.reset(options={"problem": problem})
    base: Any = env.unwrapped
    base.set_plan(plan.trajectory.states)
    frames: list[Any] = [env.render()] if film else []

    def draw() -> None:
        if film and round(base.time / base.control_dt) % every == 0:
            frames.append(env.render())

    return fly(env, plan.trajectory, on_step=draw), frames


def _draw_table(axes: Any, problem: Problem) -> None:
    from matplotlib.patches import Circle

    scenario = problem.scenario
    discs = zip(scenario.obstacles.centres, scenario.obstacles.radii, scenario.keep_out_radii)
    for centre, radius, keep_out in discs:
        axes.add_patch(Circle(tuple(centre), radius, color="0.35"))
        axes.add_patch(Circle(tuple(centre), keep_out, fill=False, ec="tab:red", ls="--", lw=0.8))
    for pose, color in ((problem.start, "black"), (problem.goal, "tab:green")):
        axes.add_patch(Circle(tuple(pose[:2]), scenario.robot.radius, fill=False, ec=color, lw=1.6))
        nose = pose[:2] + scenario.robot.radius * np.array([np.cos(pose[2]), np.sin(pose[2])])
        axes.plot(*zip(pose[:2], nose), color=color, lw=1.6)
    axes.set(xlim=(0, scenario.table[0]), ylim=(0, scenario.table[1]), aspect="equal")
    axes.set(xlabel="x in m", ylabel="y in m")
