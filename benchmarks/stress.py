"""Ten thousand random problems and a table of nasty ones: no exception, nothing falsely solved.

``python -m benchmarks.stress`` plans each with ``SCPConfig.robust()`` over all processors, checks
every solution again with the independent check, and exits with 1 if one of them fails it.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Iterator

import numpy as np

from freeflyer_env import Obstacles, Problem, Scenario, sample_problem
from freeflyer_env.constraints import FEASIBILITY_TOLERANCE
from freeflyer_env.planning import SCPConfig, SCPResult, solve_many

START, GOAL = np.array([0.3, 1.25, 0, 0, 0, 0.0]), np.array([3.2, 1.25, 1.0, 0, 0, 0.0])


def random_problems(n_problems: int, seed: int) -> list[Problem]:
    """Random scenes of 0 to 8 obstacles, final times of 20 to 100 s."""
    problems: list[Problem] = []
    rng = np.random.default_rng(seed)
    while len(problems) < n_problems:
        final_time = 0.5 * float(rng.integers(40, 201))
        try:
            problem = sample_problem(
                rng, final_time=final_time, n_obstacles=int(rng.integers(0, 9))
            )
        except ValueError:
            continue  # so many discs did not fit
        problems.append(problem)
    return problems


def problem_of(
    *rows: tuple[float, ...],
    start: np.ndarray = START,
    goal: np.ndarray = GOAL,
    final_time: float = 40.0,
) -> Problem:
    width = len(rows[0]) if rows else 3
    obstacles = Obstacles.from_rows(np.array(rows, dtype=float).reshape(-1, width))
    return Problem(Scenario(obstacles), start, goal, final_time)


def nasty_problems() -> Iterator[tuple[str, Problem]]:
    """Degenerate and borderline problems by name."""
    radius = (0.2 + 0.15) * 1.1  # keep-out radius of a disc of 0.2 m
    at = {"x": np.eye(6)[0], "y": np.eye(6)[1], "psi": np.eye(6)[2]}
    v_x, v_y = np.eye(6)[3], np.eye(6)[4]
    yield "no obstacles", problem_of()
    yield "touching obstacles", problem_of((1.7, 1.05, 0.2), (1.7, 1.45, 0.2))
    yield "overlapping obstacles", problem_of((1.7, 1.15, 0.2), (1.8, 1.35, 0.2))
    yield "the same obstacle twice", problem_of((1.7, 1.25, 0.2), (1.7, 1.25, 0.2))
    yield "an obstacle centred on the way", problem_of((1.75, 1.25, 0.2))
    yield (
        "three in line on the way",
        problem_of((1, 1.25, 0.15), (1.7, 1.25, 0.15), (2.4, 1.25, 0.15)),
    )
    for name, extra in (
        ("1 mm narrower than", -5e-4),
        ("as wide as", 0.0),
        ("1 mm wider than", 5e-4),
    ):
        gap = radius + extra
        rows = [(1.75, 1.25 - gap, 0.2), (1.75, 1.25 + gap, 0.2)]
        rows += [(1.75, 1.25 - gap - 0.7, 0.2), (1.75, 1.25 + gap + 0.7, 0.2)]
        yield f"a corridor {name} the robot", problem_of(*rows)
    yield "start grazes a disc", problem_of((0.3 + radius, 1.25, 0.2))
    yield "goal grazes a disc", problem_of((3.2 - radius, 1.25, 0.2))
    yield "start and goal graze", problem_of((0.3 + radius, 1.25, 0.2), (3.2 - radius, 1.25, 0.2))
    yield "start and goal coincide", problem_of((1.7, 1.25, 0.2), goal=START)
    yield "a turn on the spot", problem_of((1.7, 1.25, 0.2), goal=START + np.pi * at["psi"])
    yield "three whole turns", problem_of((1.7, 1.25, 0.2), goal=GOAL + 6 * np.pi * at["psi"])
    yield "goal on the edge", problem_of((1.7, 1.25, 0.2), goal=GOAL + 0.15 * at["x"])
    corner = np.array([0.15, 0.15, 0, 0, 0, 0])
    far = np.array([3.35, 2.35, 3.0, 0, 0, 0])
    yield "corner to corner", problem_of((1.7, 1.25, 0.2), start=corner, goal=far)
    yield (
        "along the wall past a disc",
        problem_of((1.7, 0.3, 0.2), start=corner, goal=np.array([3.35, 0.15, 0, 0, 0, 0])),
    )
    yield "two steps", problem_of(start=START, goal=START, final_time=1.0)
    yield "three steps past an obstacle", problem_of((1.7, 1.25, 0.2), goal=START, final_time=1.5)
    yield "10 s, near", problem_of((1.7, 1.25, 0.2), goal=START + 0.3 * at["y"], final_time=10.0)
    yield "10 s, far", problem_of((1.7, 1.25, 0.2), final_time=10.0)
    yield "hardly enough time", problem_of(final_time=19.0)
    yield "200 s", problem_of((1.7, 1.25, 0.2), final_time=200.0)
    yield "flung at an obstacle", problem_of((1.2, 1.25, 0.2), start=START + 0.12 * v_x)
    yield "flung off the table", problem_of((1.7, 1.25, 0.2), start=START - 0.3 * v_x)
    yield "arrives at speed", problem_of((1.7, 1.25, 0.2), goal=GOAL - 0.05 * v_x + 0.05 * v_y)
    yield "an obstacle off the table", problem_of((1.7, 2.7, 0.2), (9.0, 9.0, 0.2))
    yield "a tiny and a huge obstacle", problem_of((1.0, 1.25, 0.001), (2.0, 0.4, 0.8))
    ring = [
        (3.2 + 0.66 * np.cos(a), 1.25 + 0.66 * np.sin(a), 0.15) for a in np.arange(0, 6.2, 0.78)
    ]
    yield "goal in a closed ring", problem_of(*ring)
    yield "a wall across the table", problem_of(*((1.75, y, 0.2) for y in (0.3, 0.95, 1.6, 2.25)))
    yield (
        "twelve obstacles",
        problem_of(*((x, y, 0.1) for x in (0.9, 1.6, 2.3) for y in (0.2, 0.9, 1.6, 2.3))),
    )
    yield "start inside a keep-out disc", problem_of((0.4, 1.25, 0.2))
    yield "goal off the table", problem_of(goal=GOAL + 0.5 * at["x"])
    yield "an obstacle crosses the way", problem_of((1.7, 0.2, 0.2, 0.0, 0.05))
    yield (
        "an obstacle runs the robot down",
        problem_of((3.2, 1.25, 0.2, -0.2, 0.0), final_time=60.0),
    )
    yield "an obstacle arrives with it", problem_of((3.2, 0.2, 0.2, 0.0, 0.02))


def faults(problem: Problem, result: SCPResult) -> list[str]:
    """What is wrong with a result: a solution that is none, a failure without a reason."""
    lines = []
    if not result.message:
        lines.append("no message")
    if result.solved:
        assert result.trajectory is not None
        family, worst = result.trajectory.check(problem).worst
        if not worst <= FEASIBILITY_TOLERANCE:
            lines.append(f"solved, but {family} is violated by {worst:.1e}")
        depth = result.trajectory.between_nodes_depth(problem)
        if not depth <= FEASIBILITY_TOLERANCE:
            lines.append(f"solved, but {depth:.1e} m inside keep-out between nodes")
        if result.kkt is None or not result.kkt.worst < 1e-4:
            lines.append(f"solved, but optimality is {result.kkt}")
    return lines


def summary(problems: list[Problem], results: list[SCPResult]) -> str:
    """Statuses by number of obstacles, and times, as Markdown."""
    statuses = [status for status, _ in Counter(r.status.value for r in results).most_common()]
    lines = [
        f"| obstacles | problems | {' | '.join(statuses)} |",
        f"|{'---|' * (2 + len(statuses))}",
    ]
    counts = [len(problem.scenario.obstacles) for problem in problems]
    for count in sorted(set(counts)):
        group = [r for r, c in zip(results, counts) if c == count]
        tally = Counter(result.status.value for result in group)
        cells = " | ".join(str(tally[status]) for status in statuses)
        lines.append(f"| {count} | {len(group)} | {cells} |")
    times = 1e3 * np.array([result.solve_time for result in results])
    residuals = [result.kkt.worst for result in results if result.kkt]
    rerouted = sum(result.rerouted > 0 for result in results)
    lines.append(
        f"\nTime a problem: median {np.median(times):.0f} ms, mean {times.mean():.0f} ms, most "
        f"{times.max():.0f} ms. {rerouted} needed another route than REL's. Worst KKT residual "
        f"{max(residuals, default=np.nan):.1e}."
    )
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--problems", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=-1)
    options = parser.parse_args()
    config = SCPConfig.robust()
    names, nasty = zip(*nasty_problems())
    wrong = 0
    print("| nasty problem | status | cost, m/s | iterations | ms |\n|---|---|---|---|---|")
    for name, problem, result in zip(names, nasty, solve_many(nasty, config=config, n_jobs=1)):
        found = faults(problem, result)
        wrong += len(found)
        cost = f"{result.cost:.4f}" if result.solved else result.message.partition(": ")[2]
        print(
            f"| {name} | {result.status.value} | {cost} | {result.iterations} | "
            f"{1e3 * result.solve_time:.0f} |"
        )
        for line in found:
            print(f"FAULT: {name}: {line}")
    problems = random_problems(options.problems, options.seed)
    began = time.perf_counter()
    results = solve_many(problems, config=config, n_jobs=options.jobs, progress=sys.stderr.isatty())
    elapsed = time.perf_counter() - began
    for index, (problem, result) in enumerate(zip(problems, results)):
        for line in faults(problem, result):
            wrong += 1
            print(f"FAULT: random problem {index}: {line}")
        if result.status.value == "numerical_failure":
            print(f"random problem {index}: {result.message}")
    print(f"\n{summary(problems, results)}\n\n{len(results)} problems in {elapsed:.0f} s")
    print(f"{wrong} faults")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
