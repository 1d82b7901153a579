"""Tracking controllers compared: the same plans, flown with and without disturbances.

``python -m benchmarks.tracking`` flies plans of SCP for random problems with the thrusters in
``FreeFlyer-v0`` and prints Markdown tables; ``--out FILE`` writes them as JSON. Every tracker flies
the same problems with the same disturbances. Errors are of the true state; milliseconds are wall
times of ``Tracker.duties``.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from benchmarks.planning import Row, machine, markdown
from freeflyer_env import Problem, sample_problem
from freeflyer_env.constraints import keep_out_depth
from freeflyer_env.control import (
    DisturbanceObserver,
    LQRTracker,
    PIDTracker,
    ReplanningTracker,
    Tracker,
    TrackingMPC,
    fly,
    reference_at,
)
from freeflyer_env.disturbances import Disturbances
from freeflyer_env.planning import SCPConfig, Trajectory, solve_scp

Plans = list[tuple[Problem, Trajectory]]


def observer(problem: Problem, delay: int) -> DisturbanceObserver:
    return DisturbanceObserver(problem.scenario.robot, delay)


def pid(problem: Problem, delay: int) -> Tracker:
    return PIDTracker(problem.scenario.robot)


def lqr(problem: Problem, delay: int) -> Tracker:
    return LQRTracker(problem.scenario.robot, observer=observer(problem, delay))


def mpc(problem: Problem, delay: int) -> Tracker:
    return TrackingMPC(problem.scenario, observer=observer(problem, delay))


def replanning(problem: Problem, delay: int) -> Tracker:
    config = SCPConfig(elastic=True, between_nodes=True)
    return ReplanningTracker(problem, config=config)


def replanning_mpc(problem: Problem, delay: int) -> Tracker:
    config = SCPConfig(elastic=True, between_nodes=True)
    return ReplanningTracker(problem, config=config, follower=mpc(problem, delay))


#: Name, tracker, whether it is told the environment's delay, share of the flights.
TRACKERS: list[tuple[str, Callable[[Problem, int], Tracker], bool, float]] = [
    ("PID, the paper's gains", pid, False, 1.0),
    ("LQR", lqr, False, 1.0),
    ("TrackingMPC", mpc, False, 1.0),
    ("LQR, delay known", lqr, True, 1.0),
    ("TrackingMPC, delay known", mpc, True, 1.0),
    ("re-planning, PID follows", replanning, False, 0.25),
    ("re-planning, TrackingMPC follows, delay known", replanning_mpc, True, 0.25),
]


class Stopwatch:
    """A tracker whose commands are timed."""

    def __init__(self, tracker: Tracker) -> None:
        self.tracker = tracker
        self.times: list[float] = []
        self.reset, self.reference = tracker.reset, tracker.reference

    def duties(self, *arguments: Any) -> Any:
        began = time.perf_counter()
        duties = self.tracker.duties(*arguments)
        self.times.append(time.perf_counter() - began)
        return duties


def make_plans(n_flights: int, seed: int = 0) -> Plans:
    """Random problems that SCP solves, with their plans."""
    rng = np.random.default_rng(seed)
    plans: Plans = []
    while len(plans) < n_flights:
        problem = sample_problem(rng)
        result = solve_scp(problem, config=SCPConfig.robust())
        if result.trajectory is not None:
            plans.append((problem, result.trajectory))
    return plans


def fly_one(
    make: Callable[[Problem, int], Tracker],
    delay: int,
    disturbances: str | None,
    problem: Problem,
    plan: Trajectory,
    seed: int,
) -> dict[str, Any]:
    """What one flight measures, in SI units."""
    env = gym.make(
        "freeflyer_env:FreeFlyer-v0",
        action_mode="thrusters",
        scenario=problem.scenario,
        terminate_early=False,
        disturbances=disturbances,
    )
    env.reset(seed=seed, options={"problem": problem})
    tracker = Stopwatch(make(problem, delay))
    flight = fly(env, plan, tracker)
    positions = flight.states[:, :2]
    wanted = np.array([reference_at(plan, moment)[0] for moment in flight.times])
    off = np.linalg.norm(positions - wanted[:, :2], axis=1)
    return {
        "rms": flight.rms_error,
        "largest": flight.tracking_error,
        "off_plan": float(np.sqrt(np.mean(off**2))),
        "final": flight.final_error[0],
        "final_heading": flight.final_error[1],
        "success": flight.success,
        "contacts": flight.contacts,
        "depth": max(float(keep_out_depth(problem.scenario, positions, flight.times).max()), 0.0),
        "firing": flight.firing_time,
        "fuel": flight.fuel,
        "times": tracker.times,
        "failures": getattr(tracker.tracker, "failures", 0),
    }


def compare(plans: Plans, disturbances: str | None, n_jobs: int) -> list[Row]:
    """One row for each tracker; those that re-plan fly a quarter of the plans."""
    from joblib import Parallel, delayed

    rows, present = [], Disturbances.of(disturbances).delay
    for name, make, is_told, share in TRACKERS:
        delay = present if is_told else 0
        if is_told and not delay and (make, False) in [tracker[1:3] for tracker in TRACKERS]:
            continue  # the same as without being told
        chosen = plans[: max(round(share * len(plans)), 1)]
        flights = Parallel(n_jobs=n_jobs)(
            delayed(fly_one)(make, delay, disturbances, *plan, seed)
            for seed, plan in enumerate(chosen)
        )
        rows.append({"tracker": name, **summary(flights)})
    return rows


def summary(flights: list[dict[str, Any]]) -> Row:
    """Means over the flights, unless the name says otherwise."""

    def mean(key: str) -> float:
        return float(np.mean([flight[key] for flight in flights]))

    times = 1e3 * np.concatenate([flight["times"] for flight in flights])
    return {
        "flights": len(flights),
        "RMS, mm": 1e3 * mean("rms"),
        "RMS off the first plan, mm": 1e3 * mean("off_plan"),
        "largest of all, mm": 1e3 * max(flight["largest"] for flight in flights),
        "final, mm": 1e3 * mean("final"),
        "final, deg": float(np.degrees(mean("final_heading"))),
        "success": f"{mean('success'):.0%}",
        "contacts": sum(flight["contacts"] for flight in flights),
        "deepest in a keep-out disc, mm": 1e3 * max(flight["depth"] for flight in flights),
        "firing, s": mean("firing"),
        "fuel, N s": mean("fuel"),
        "ms, median": float(np.median(times)),
        "ms, 99 %": float(np.percentile(times, 99)),
        "OSQP failures": sum(flight["failures"] for flight in flights),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flights", type=int, default=100, help="flights of each tracker")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--out", type=Path, help="JSON file for the tables")
    options = parser.parse_args()
    if options.flights < 1:
        parser.error(f"--flights must be at least 1, got {options.flights}")
    print(machine())
    plans = make_plans(options.flights)
    tables = {}
    for name, disturbances in (("none", None), ("testbed", "testbed")):
        print(f"\n## disturbances: {name}\n", flush=True)
        tables[name] = compare(plans, disturbances, options.jobs)
        print(f"\n{markdown(tables[name])}", flush=True)
    if options.out:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        data = {"machine": machine(), "tables": tables}
        options.out.write_text(json.dumps(data, indent=1, default=float) + "\n")
        print(f"\nwrote {options.out}")


if __name__ == "__main__":
    main()
