"""Planning: speed as ratios within one run, backends, and what the options cost and give.

``python -m benchmarks.planning`` prints Markdown tables; ``--out FOLDER`` leaves them there as JSON
with a figure. Times are medians of wall times on one thread unless said otherwise.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import platform
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.cvxpy_loop import solve_stage_by_stage
from freeflyer_env import HELD_OUT_SCENES, Problem, sample_problem
from freeflyer_env.planning import (
    SCPConfig,
    SCPResult,
    Trajectory,
    solve_many,
    solve_multistart,
    solve_rel,
    solve_scp,
    straight_line,
)
from freeflyer_env.planning.backends import BACKENDS
from freeflyer_env.planning.reference import solve_reference_subproblem
from freeflyer_env.planning.subproblem import Subproblem

PACKAGES = ("numpy", "scipy", "piqp", "clarabel", "qoco", "highspy", "osqp", "cvxpy")

Row = dict[str, Any]
Linearised = list[tuple[Problem, Trajectory]]


def draw(n_problems: int, seed: int = 0, **settings: Any) -> list[Problem]:
    """Random problems, every one with obstacles that the table has room for."""
    rng = np.random.default_rng(seed)
    problems: list[Problem] = []
    while len(problems) < n_problems:
        try:
            problems.append(sample_problem(rng, **settings))
        except ValueError:
            continue
    return problems


def median_ms(work: Callable[..., object], items: Sequence[tuple]) -> float:
    """Median wall time in ms; the first item warms up and is run twice."""
    work(*items[0])
    times = []
    for item in items:
        began = time.perf_counter()
        work(*item)
        times.append(time.perf_counter() - began)
    return 1e3 * float(np.median(times))


def about_rel(problems: list[Problem]) -> Linearised:
    """Each problem with REL's trajectory as reference: what SCP linearises about first."""
    references = [(problem, solve_rel(problem).trajectory) for problem in problems]
    return [(problem, reference) for problem, reference in references if reference is not None]


def subproblem_of(problem: Problem, backend: str = "piqp", **options: Any) -> Subproblem:
    scenario = problem.scenario
    size = (problem.n_steps, len(scenario.obstacles), scenario.dt, scenario.robot)
    return Subproblem(*size, backend, **options)


def speed(n_problems: int) -> list[Row]:
    """One subproblem and a whole REL + SCP solve against CVXPY, restated at every iteration."""
    rows = []
    for final_time in (40.0, 100.0):
        problems = draw(n_problems, final_time=final_time)
        items = about_rel(problems)
        shared = subproblem_of(problems[0])
        ours = median_ms(lambda p, r: shared.solve(p, r, 10.0), items)  # noqa: B023
        stages = median_ms(lambda p, r: solve_stage_by_stage(p, r, 10.0), items[:3])
        vectorised = median_ms(lambda p, r: solve_reference_subproblem(p, r, 10.0), items[:5])
        rows.append(
            {
                "N": problems[0].n_steps,
                "subproblem, ms": ours,
                "REL + SCP, ms": median_ms(solve_scp, [(p,) for p in problems]),
                "CVXPY stage by stage, ms": stages,
                "CVXPY vectorised, ms": vectorised,
                "times faster": stages / ours,
                "times faster than vectorised": vectorised / ours,
            }
        )
    return rows


def sizes(n_problems: int) -> list[Row]:
    """How the subproblem's time grows with the horizon and the number of obstacles."""
    rows = []
    for final_time, n_obstacles in (
        (40, 0),
        (40, 4),
        (40, 8),
        (40, 12),
        (10, 4),
        (80, 4),
        (200, 4),
    ):
        problems = draw(n_problems, final_time=float(final_time), n_obstacles=n_obstacles)
        items = [(problem, straight_line(problem)) for problem in problems]
        shared = subproblem_of(problems[0])
        row: Row = {"N": problems[0].n_steps, "obstacles": n_obstacles}
        row["subproblem, ms"] = median_ms(lambda p, r: shared.solve(p, r, 10.0), items)  # noqa: B023
        rows.append(row)
    return rows


def backends(n_problems: int) -> list[Row]:
    """Time, agreement with HiGHS (simplex) and optimality of every backend on the same programs."""
    items = about_rel(draw(n_problems, seed=1))
    exact = subproblem_of(items[0][0], "highs")
    truth = [exact.solve(problem, reference, 10.0) for problem, reference in items]
    rows = []
    for name in [*BACKENDS, "clarabel, ball", "qoco, ball", "cvxpy:CLARABEL"]:
        few = items[:8] if name in ("osqp", "cvxpy:CLARABEL") else items
        solver, verdicts, errors, residuals = _solver(name, items[0][0]), [], [], []
        times, failed = [], 0
        solver(*few[0])
        for (problem, reference), exact_solution in zip(few, truth):
            began = time.perf_counter()
            status, cost, kkt = solver(problem, reference)
            times.append(time.perf_counter() - began)
            failed += status == "failed"
            verdicts.append((status == "solved") == (exact_solution.trajectory is not None))
            if status == "solved" and exact_solution.trajectory is not None:
                errors.append(abs(cost / exact_solution.trajectory.cost - 1.0))
                residuals.append(kkt)
        rows.append(
            {
                "backend": name,
                "ms": 1e3 * float(np.median(times)),
                "programs": len(few),
                "same verdict": f"{sum(verdicts)} of {len(verdicts)}",
                "gave up": failed,
                "largest cost error": max(errors, default=np.nan),
                "worst KKT residual": max(residuals, default=np.nan),
            }
        )
    return rows


def _solver(name: str, problem: Problem) -> Callable[[Problem, Trajectory], tuple]:
    if name.startswith("cvxpy:"):

        def solve_statement(problem: Problem, reference: Trajectory) -> tuple:
            status, cost, _ = solve_reference_subproblem(problem, reference, 10.0)
            return {"optimal": "solved"}.get(status, "infeasible"), cost, np.nan

        return solve_statement
    backend, _, form = name.partition(", ")
    subproblem = subproblem_of(problem, backend, ball=form == "ball")

    def solve(problem: Problem, reference: Trajectory) -> tuple:
        found = subproblem.solve(problem, reference, 10.0)
        if found.trajectory is None:
            return found.status.value, np.inf, np.nan
        return "solved", found.trajectory.cost, subproblem.kkt_residuals().worst

    return solve


def robustness(n_problems: int) -> list[Row]:
    """What keeps SCP from getting stuck; missed: not solved, although one of 13 starts is."""
    problems = draw(n_problems, seed=2)
    settings = {
        "hard, from REL": SCPConfig(),
        "elastic": SCPConfig(elastic=True),
        "12 reroutes": SCPConfig(reroutes=12),
        "elastic, 12 reroutes": SCPConfig(elastic=True, reroutes=12),
        "robust (between nodes too)": SCPConfig.robust(),
    }
    known = np.array([solve_multistart(problem, 13).best.solved for problem in problems])
    rows = []
    for name, config in settings.items():
        results = [solve_scp(problem, config=config) for problem in problems]
        missed = known & ~np.array([result.solved for result in results])
        times = 1e3 * np.array([result.solve_time for result in results])
        statuses = Counter(result.status.value for result in results if not result.solved)
        rows.append(
            {
                "settings": name,
                "solved": f"{sum(result.solved for result in results)} of {n_problems}",
                "missed": f"{missed.sum()} of {known.sum()}",
                "otherwise": ", ".join(f"{count} {status}" for status, count in statuses.items()),
                "iterations": float(np.mean([result.iterations for result in results])),
                "ms, median": float(np.median(times)),
                "ms, mean": float(times.mean()),
                "ms, most": float(times.max()),
            }
        )
    return rows


def between_nodes(n_problems: int) -> list[Row]:
    """The price of keeping clear of obstacles between the nodes too."""
    rows = []
    problems = [problem for problem in draw(n_problems, seed=3) if solve_scp(problem).solved]
    plain = [solve_scp(problem) for problem in problems]
    for name, config in (("nodes", SCPConfig()), ("between nodes", SCPConfig(between_nodes=True))):
        results = [solve_scp(problem, config=config) for problem in problems]
        kept = [i for i, result in enumerate(results) if result.solved]
        depths = np.array([_depth(results[i], problems[i]) for i in kept])
        ratio = [results[i].cost / plain[i].cost - 1.0 for i in kept]
        rows.append(
            {
                "keep-out": name,
                "solved": f"{len(kept)} of {len(problems)}",
                "dip between nodes": f"{(depths > 1e-6).mean():.0%}",
                "deepest, mm": 1e3 * float(depths.max()),
                "cost": f"{np.mean(ratio):+.3%}",
                "iterations": float(np.mean([result.iterations for result in results])),
                "ms, median": 1e3 * float(np.median([result.solve_time for result in results])),
            }
        )
    return rows


def _depth(result: SCPResult, problem: Problem) -> float:
    assert result.trajectory is not None
    return result.trajectory.between_nodes_depth(problem)


def multistart(n_problems: int) -> list[Row]:
    """Cost and time of several starts, on the held-out scenes, where all of them succeed."""
    rng = np.random.default_rng(4)
    problems = [sample_problem(rng, HELD_OUT_SCENES[i % 3]) for i in range(n_problems)]
    problems = [problem for problem in problems if solve_scp(problem).solved]
    bound = np.mean([solve_rel(problem).cost for problem in problems])
    rows: list[Row] = []
    first = 0.0
    for n_starts in (1, 2, 3, 4, 8, 13):
        began = time.perf_counter()
        results = [solve_multistart(problem, n_starts) for problem in problems]
        elapsed = time.perf_counter() - began
        cost = float(np.mean([result.best.cost for result in results]))
        first = first or cost
        rows.append(
            {
                "starts": n_starts,
                "mean cost, m/s": cost,
                "suboptimality improvement": f"{(first - cost) / (first - bound):+.1%}",
                "distinct optima": float(np.mean([len(result.optima) for result in results])),
                "ms, mean": 1e3 * elapsed / len(problems),
            }
        )
    return rows


def batch(n_problems: int) -> list[Row]:
    """Throughput of ``solve_many`` against the number of processes (warmed up)."""
    problems = draw(n_problems, seed=5)
    rows: list[Row] = []
    for n_jobs in sorted({1, 2, os.cpu_count() or 1}):
        solve_many(problems[: 2 * n_jobs], n_jobs=n_jobs)
        began = time.perf_counter()
        solve_many(problems, n_jobs=n_jobs)
        rate = len(problems) / (time.perf_counter() - began)
        first = rows[0]["problems/s"] if rows else rate
        rows.append({"processes": n_jobs, "problems/s": rate, "times one": rate / first})
    return rows


SECTIONS: dict[str, tuple[Callable[[int], list[Row]], float]] = {
    "speed": (speed, 1.0),
    "sizes": (sizes, 0.5),
    "backends": (backends, 1.0),
    "robustness": (robustness, 4.0),
    "between_nodes": (between_nodes, 2.0),
    "multistart": (multistart, 1.0),
    "batch": (batch, 4.0),
}


def markdown(rows: list[Row]) -> str:
    """A Markdown table."""

    def cell(value: Any) -> str:
        if not isinstance(value, float):
            return str(value)
        return f"{value:.1e}" if 0.0 < abs(value) < 1e-3 else f"{value:.3g}"

    lines = [f"| {' | '.join(rows[0])} |", f"|{'---|' * len(rows[0])}"]
    lines += [f"| {' | '.join(cell(value) for value in row.values())} |" for row in rows]
    return "\n".join(lines)


def figure(tables: dict[str, list[Row]], path: Path) -> None:
    """Three panels: backends, growth with the horizon, robustness."""
    from matplotlib.figure import Figure

    canvas = Figure(figsize=(12.0, 3.6), layout="constrained")
    left, middle, right = canvas.subplots(1, 3)
    rows = sorted(tables["backends"], key=lambda row: -row["ms"])
    rows = [{"backend": "CVXPY, stage by stage", "ms": _stages(tables)}, *rows]
    left.barh([row["backend"] for row in rows], [row["ms"] for row in rows], color="tab:blue")
    left.set(xscale="log", xlabel="ms a subproblem (N = 80)")
    for n_obstacles, style in ((4, "o-"), (None, "s")):
        chosen = [row for row in tables["sizes"] if n_obstacles in (None, row["obstacles"])]
        chosen = [row for row in chosen if n_obstacles or row["N"] == 80]
        chosen.sort(key=lambda row: row["N"])
        name = "4 obstacles" if n_obstacles else "0, 8, 12 obstacles"
        values = [row["subproblem, ms"] for row in chosen]
        middle.plot([row["N"] for row in chosen], values, style, mfc="none", label=name)
    middle.set(xlabel="number of steps N", ylabel="ms a subproblem")
    middle.legend(frameon=False)
    names = [row["settings"] for row in tables["robustness"]]
    shares = [100.0 * _unsolved(row["solved"]) for row in tables["robustness"]]
    right.barh(names[::-1], shares[::-1], color="tab:orange")
    right.set(xlabel="random problems not solved, %")
    canvas.savefig(path, dpi=110)


def _stages(tables: dict[str, list[Row]]) -> float:
    return float(tables["speed"][0]["CVXPY stage by stage, ms"])


def _unsolved(text: str) -> float:
    solved, _, total = text.split()
    return 1.0 - int(solved) / int(total)


def machine() -> str:
    """Processor and versions."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        names = [line for line in cpuinfo.read_text().splitlines() if "model name" in line]
        model = names[0].split(":")[1].strip() if names else model
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in PACKAGES)
    return f"{model}, {os.cpu_count()} cores; Python {platform.python_version()}, {versions}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--problems", type=int, default=50, help="size of each sample, roughly")
    parser.add_argument("--only", nargs="+", choices=SECTIONS, help="some sections, not all")
    parser.add_argument("--out", type=Path, help="folder for planning.json and planning.png")
    options = parser.parse_args()
    print(machine())
    tables = {}
    for name in options.only or SECTIONS:
        run, factor = SECTIONS[name]
        tables[name] = run(max(int(factor * options.problems), 4))
        print(f"\n## {name}: {run.__doc__}\n\n{markdown(tables[name])}", flush=True)
    if options.out:
        options.out.mkdir(parents=True, exist_ok=True)
        data = {"machine": machine(), "tables": tables}
        (options.out / "planning.json").write_text(json.dumps(data, indent=1, default=float) + "\n")
        if not options.only:
            figure(tables, options.out / "planning.png")
        print(f"\nwrote {options.out}")


if __name__ == "__main__":
    main()
