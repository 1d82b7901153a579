"""The main job end to end (`make demo`): compare warm starts, fly one plan, leave pictures behind.

Plans problems that no model was trained on, on the three held-out scenes, from REL and from ART;
prints the comparison; flies one plan under PID with the thrusters; writes a GIF, a figure of plan
against flight, and a JSON file.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

from art_policy import ART, WarmStartPlanner
from art_policy.cli import DEFAULT_MODEL
from art_policy.cli_io import flight_summary, flight_text
from art_policy.evaluation import (
    evaluate,
    evaluation_problems,
    markdown_table,
    report,
    save_report,
)
from art_policy.figures import fly_and_film, plan_and_flight
from freeflyer_env.planning import solve_rel
from freeflyer_env.rendering import save_gif


def most_telling(model: ART, problems: list[Any]) -> tuple[Any, Any]:
    """The problem, of the first fifteen, on which REL violates most, with ART's plan for it."""
    planner = WarmStartPlanner(model)

    def violations(item: Any) -> int:
        trajectory = solve_rel(item[2]).trajectory
        return 0 if trajectory is None else int(trajectory.violations(item[2]).sum())

    for _, _, problem in sorted(problems[:15], key=violations, reverse=True):
        plan = planner.plan(problem)
        if plan.trajectory is not None:
            return problem, plan
    raise RuntimeError("None of the problems could be planned.")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/demo"))
    parser.add_argument("--problems", type=int, default=60)
    parser.add_argument("--model", default=DEFAULT_MODEL)
    parser.add_argument("--workers", type=int)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    began = time.perf_counter()

    model = ART.from_pretrained(options.model)
    print(f"1. Planning {options.problems} held-out problems from REL and from {options.model} ...")
    problems = evaluation_problems(options.problems, seed=1)
    records = evaluate(options.model, problems, n_candidates=4, workers=options.workers)
    data = report(records, options.model)
    print(f"\n{markdown_table(data['groups']['all'])}\n")

    print("2. Flying one plan under PID with the eight thrusters ...")
    problem, plan = most_telling(model, problems)
    flight, frames = fly_and_film(problem, plan)
    print(f"   {flight_text(flight)}")

    print("3. Writing the pictures ...")
    save_gif(frames, options.out / "flight.gif", fps=10)
    plan_and_flight(problem, plan, flight, options.out / "plan_and_flight.png")
    data["flight"] = flight_summary(flight)
    save_report(data, options.out / "comparison.json")
    for name in ("flight.gif", "plan_and_flight.png", "comparison.json"):
        print(f"   {options.out / name}")
    print(f"Done in {time.perf_counter() - began:.0f} s.")


if __name__ == "__main__":
    main()
