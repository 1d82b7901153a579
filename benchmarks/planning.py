"""Planning speed, as ratios within one run: ``python -m benchmarks.planning``.

One thread. The baseline is the usual practice: a CVXPY problem that is stated anew at every
iteration, here with the constraints already vectorised over time, and solved with Clarabel.
"""

from __future__ import annotations

import argparse
import platform
import time
from collections.abc import Callable

import numpy as np

from freeflyer_env import Problem, sample_problem
from freeflyer_env.planning import solve_rel, solve_scp, straight_line
from freeflyer_env.planning.reference import solve_reference_subproblem
from freeflyer_env.planning.subproblem import Subproblem


def median_ms(work: Callable[[Problem], object], problems: list[Problem]) -> float:
    """Median wall time in ms over the problems; the first one warms up and is run twice."""
    work(problems[0])
    times = []
    for problem in problems:
        began = time.perf_counter()
        work(problem)
        times.append(time.perf_counter() - began)
    return 1e3 * float(np.median(times))


def measure(final_time: float, n_problems: int) -> dict[str, float]:
    """Times in ms for one horizon."""
    rng = np.random.default_rng(0)
    problems = [sample_problem(rng, final_time=final_time) for _ in range(n_problems)]
    scenario = problems[0].scenario
    shared = Subproblem(problems[0].n_steps, 4, scenario.dt, scenario.robot)
    return {
        "subproblem": median_ms(lambda p: shared.solve(p, straight_line(p), 10.0), problems),
        "cvxpy": median_ms(
            lambda p: solve_reference_subproblem(p, straight_line(p), 10.0), problems[:5]
        ),
        "rel_and_scp": median_ms(lambda p: solve_scp(p, solve_rel(p).trajectory), problems),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--problems", type=int, default=50)
    options = parser.parse_args()
    print(f"Python {platform.python_version()}, NumPy {np.__version__}, {platform.machine()}")
    print("| N | subproblem | the same, restated in CVXPY | ratio | REL + SCP |")
    print("|---|---|---|---|---|")
    for final_time in (40.0, 100.0):
        row = measure(final_time, options.problems)
        print(
            f"| {2 * final_time:.0f} | {row['subproblem']:.1f} ms | {row['cvxpy']:.0f} ms "
            f"| {row['cvxpy'] / row['subproblem']:.0f} | {row['rel_and_scp']:.0f} ms |"
        )


if __name__ == "__main__":
    main()
