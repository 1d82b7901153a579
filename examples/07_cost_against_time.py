"""Free final time: what a faster transfer costs, in one call."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from freeflyer_env import Scenario, sample_problem
from freeflyer_env.planning import pareto_front


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("pareto_front.png"))
    options = parser.parse_args()
    problem = sample_problem(np.random.default_rng(3), Scenario.named("held-out-1"))
    front = pareto_front(problem)
    for final_time, cost, bound in zip(front.final_times, front.costs, front.rel_costs):
        if np.isfinite(cost):
            print(f"{final_time:6.1f} s: {cost:.4f} m/s (without obstacles {bound:.4f})")
        else:
            print(f"{final_time:6.1f} s: no solution")
    final_time, _ = front.best(price_of_time=0.002)
    print(f"if a second is worth 2 mm/s of delta-V, take {final_time:g} s")
    front.plot().figure.savefig(options.out, dpi=110)
    print(f"wrote {options.out}")


if __name__ == "__main__":
    main()
