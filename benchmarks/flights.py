"""Plans from learned and from classical warm starts, flown with and without re-planning.

``python -m benchmarks.flights`` plans problems of the paper's settings (held-out scenes in 40 s,
the nominal scene in 40 and 80 s) with a model and with REL, flies every plan in ``FreeFlyer-v0``
with the thrusters and the disturbances of the testbed, and prints a Markdown table for each
setting; ``--out FILE`` writes them as JSON. Every method flies the same problems with the same
disturbances.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from art_policy import PlannerConfig, WarmStartPlanner
from art_policy.evaluation import evaluation_problems
from benchmarks.planning import Row, machine, markdown
from benchmarks.tracking import fly_one, mpc, pid, summary
from freeflyer_env import Problem
from freeflyer_env.control import ReplanningTracker, Tracker
from freeflyer_env.disturbances import Disturbances
from freeflyer_env.planning import SCPConfig

#: Scenes, final time in s, and the cumulative firing time in s of the paper's flight.
SETTINGS = [("held-out", 40.0, 88.3), ("nominal", 40.0, 90.5), ("nominal", 80.0, 58.3)]

DISTURBANCES = "testbed"
DELAY = Disturbances.of(DISTURBANCES).delay
_REPLANNING = "re-planning"
SETTLED = SCPConfig(elastic=True, between_nodes=True)


def planner(model: str | None, candidates: int) -> WarmStartPlanner:
    from art_policy.model import load_model

    loaded = None if model is None else load_model(model)
    return WarmStartPlanner(loaded, PlannerConfig(candidates, "portfolio", SETTLED))


def fly_setting(
    model: str, candidates: int, problems: list[Problem], trackers: Sequence[str], n_jobs: int
) -> tuple[list[Row], list[Row]]:
    """One row of plans and several of flights for each kind of warm start.

    Flown are the problems that both could plan, each with the same disturbances for all.
    """
    from joblib import Parallel, delayed

    sources = {"REL": None, "ART": model}
    found = {
        name: Parallel(n_jobs)(delayed(_plan)(source, candidates, one) for one in problems)
        for name, source in sources.items()
    }
    both = [all(plan["trajectory"] for plan in pair) for pair in zip(*found.values())]
    flown = [number for number, planned in enumerate(both) if planned]
    plans, flights = [], []
    for name, source in sources.items():
        trajectories = [plan["trajectory"] for plan in found[name]]
        plans.append(
            {
                "warm start": name,
                "problems": len(problems),
                "planned": sum(trajectory is not None for trajectory in trajectories),
                "planned by both": len(flown),
                "cost, m/s": float(np.mean([trajectories[number].cost for number in flown])),
                "ms, median": 1e3 * float(np.median([plan["time"] for plan in found[name]])),
            }
        )
        for tracker in trackers:
            done = Parallel(n_jobs)(
                delayed(_fly)(tracker, source, candidates, problems[i], trajectories[i], i)
                for i in flown
            )
            flights.append({"warm start": name, "tracker": tracker, **summary(done)})
    return plans, flights


def _plan(model: str | None, candidates: int, problem: Problem) -> dict[str, Any]:
    made = planner(model, candidates)
    made.plan(problem)  # the first plan of a size assembles the subproblem
    plan = made.plan(problem)
    return {"trajectory": plan.trajectory, "time": plan.timings["total"]}


def _fly(
    tracker: str, model: str | None, candidates: int, problem: Problem, plan: Any, seed: int
) -> dict[str, Any]:
    def replanning(problem: Problem, delay: int) -> Tracker:
        propose = planner(model, candidates).proposals if model else None
        follower = mpc(problem, delay)
        return ReplanningTracker(problem, 2.0, SETTLED, follower, propose=propose)

    make = {"PID": pid, "MPC": mpc, _REPLANNING: replanning}[tracker]
    return fly_one(make, DELAY, DISTURBANCES, problem, plan, seed)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", default="art-general")
    parser.add_argument("--candidates", type=int, default=4)
    parser.add_argument("--flights", type=int, default=100, help="flights of each method")
    choices = ("PID", "MPC", _REPLANNING)
    parser.add_argument("--trackers", nargs="+", choices=choices, default=choices)
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--out", type=Path, help="JSON file for the tables")
    options = parser.parse_args()
    if options.flights < 1:
        parser.error(f"--flights must be at least 1, got {options.flights}")
    print(machine())
    tables: dict[str, Any] = {}
    for scene, final_time, paper in SETTINGS:
        problems = [p for _, _, p in evaluation_problems(options.flights, scene, (final_time,), 3)]
        plans, flights = fly_setting(
            options.model, options.candidates, problems, options.trackers, options.jobs
        )
        name = f"{scene}, {final_time:g} s"
        print(f"\n## {name}\n\n{markdown(plans)}\n\n{markdown(flights)}", flush=True)
        print(f"\nFiring time of the paper's flight: {paper} s")
        tables[name] = {"plans": plans, "flights": flights, "paper_firing_s": paper}
    if options.out:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        data = {"machine": machine(), "model": options.model, "tables": tables}
        options.out.write_text(json.dumps(data, indent=1, default=float) + "\n")
        print(f"\nwrote {options.out}")


if __name__ == "__main__":
    main()
