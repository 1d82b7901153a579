"""The paper's evaluation: warm starts compared on the same problems, with the same SCP.

Every method hands its warm start to the same loop. A problem counts as infeasible for a method if
any subproblem could not be solved; costs are compared on the problems that every method solved.
"""

from __future__ import annotations

import functools
import json
import platform
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from art_policy.planner import PlannerConfig, WarmStartPlanner
from freeflyer_env.planning import SCPResult, solve_multistart, solve_rel, solve_scp
from freeflyer_env.scenario import HELD_OUT_SCENES, Problem, Scenario, sample_problem

if TYPE_CHECKING:
    from art_policy.model import ART

#: Thresholds of the constraint-to-go of REL (paper, Fig. 3).
C_REL_THRESHOLDS = (0, 5, 10, 15, 20)

#: Root of the seeds of test problems; datasets use their recipes' seeds and a spawn key of length
#: one.
_TEST_SEED_KEY = 7_777_777


@dataclass(frozen=True)
class Outcome:
    """One method on one problem.

    Attributes:
        solved: Whether SCP ended with a verified solution.
        cost: Cost of the solution in m/s, infinite unless solved.
        iterations: Subproblems solved by the SCP that gave the answer (one-based).
        time: Everything that a user waits for, in s.
    """

    solved: bool
    cost: float
    iterations: int
    time: float


@dataclass(frozen=True)
class ProblemRecord:
    """All methods on one problem; ``c_rel`` counts REL's violating nodes."""

    scene: str
    index: int
    final_time: float
    c_rel: int
    rel_cost: float
    outcomes: dict[str, Outcome]


def evaluation_problems(
    n_problems: int,
    scenes: str = "held-out",
    final_times: Sequence[float] = (40.0,),
    seed: int = 0,
) -> list[tuple[str, int, Problem]]:
    """Test problems that no dataset contains: ``(scene, index, problem)``, ``n_problems`` in all.

    Args:
        n_problems: How many, spread evenly over scenes and final times.
        scenes: ``"held-out"`` (the paper's three), ``"random"`` (a new scene each), or a scene's
            name.
        final_times: Final times in s.
        seed: Another seed gives other problems.
    """
    if n_problems < 1:
        raise ValueError(f"The number of problems must be at least 1, got {n_problems}.")
    scenarios: list[tuple[str, Scenario | None]]
    if scenes == "held-out":
        scenarios = [(f"held-out-{i}", scene) for i, scene in enumerate(HELD_OUT_SCENES, 1)]
    elif scenes == "random":
        scenarios = [("random", None)]
    else:
        scenarios = [(scenes, Scenario.named(scenes))]
    problems = []
    for index in range(n_problems):
        rng = np.random.default_rng([_TEST_SEED_KEY, seed, index])
        name, scenario = scenarios[index % len(scenarios)]
        final_time = final_times[(index // len(scenarios)) % len(final_times)]
        problems.append((name, index, sample_problem(rng, scenario, final_time)))
    return problems


def evaluate_problem(
    model: Any, scene: str, index: int, problem: Problem, n_candidates: int
) -> ProblemRecord:
    """Runs every method on one problem: REL, the model alone, and multi-start as a baseline."""
    rel = solve_rel(problem)
    bound = rel.trajectory
    c_rel = int(bound.violations(problem).sum()) if bound is not None else -1
    began = time.perf_counter()
    refined = solve_scp(problem)
    outcomes = {"REL": _outcome(refined, time.perf_counter() - began)}
    if model.config.head == "multi_hypothesis":
        n_candidates = min(n_candidates, model.config.n_hypotheses)
    for count in sorted({1, n_candidates}):
        # Without REL to fall back on, so that the model's failures show.
        planner = WarmStartPlanner(model, PlannerConfig(n_candidates=count, rel="never"))
        plan = planner.plan(problem)
        name = "ART" if count == 1 else f"ART, best of {count}"
        outcomes[name] = _outcome(plan.result, plan.timings["total"])
    for count in sorted({2, max(2, n_candidates)}):
        began = time.perf_counter()
        many = solve_multistart(problem, count)
        elapsed = time.perf_counter() - began
        outcomes[f"multi-start, best of {count}"] = _outcome(many.best, elapsed)
    return ProblemRecord(scene, index, problem.final_time, c_rel, rel.cost, outcomes)


def _outcome(result: SCPResult, elapsed: float) -> Outcome:
    return Outcome(result.solved, float(result.cost), int(result.iterations), float(elapsed))


def evaluate(
    model: str | Path,
    problems: Sequence[tuple[str, int, Problem]],
    n_candidates: int = 4,
    workers: int | None = None,
    progress: bool = True,
) -> list[ProblemRecord]:
    """Runs every method on every problem, in parallel over processes with one thread each.

    Args:
        model: What :meth:`ART.from_pretrained` takes.
        problems: As :func:`evaluation_problems` gives them.
        n_candidates: Largest number of candidates, at most as many as the model has hypotheses;
            and of starts of the multi-start baseline, fewer where there are fewer classes.
        workers: Processes; one per processor if None.
        progress: Whether to show a progress bar.
    """
    import joblib
    from tqdm import tqdm

    if n_candidates < 1:
        raise ValueError(f"The number of candidates must be at least 1, got {n_candidates}.")
    weights = Path(model) / "model.safetensors"
    version = weights.stat().st_mtime_ns if weights.is_file() else 0
    chunks = [list(problems[i : i + 10]) for i in range(0, len(problems), 10)]
    records: list[ProblemRecord] = []
    with (
        joblib.parallel_config(backend="loky", inner_max_num_threads=1),
        tqdm(total=len(problems), unit="problem", disable=not progress) as bar,
    ):
        jobs = (
            joblib.delayed(_evaluate_chunk)(str(model), version, chunk, n_candidates)
            for chunk in chunks
        )
        for chunk_records in joblib.Parallel(n_jobs=workers or -1, return_as="generator")(jobs):
            records += chunk_records
            bar.update(len(chunk_records))
    return records


def _evaluate_chunk(
    model: str, version: int, chunk: list[tuple[str, int, Problem]], n_candidates: int
) -> list[ProblemRecord]:
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        loaded = _load(model, version)
        records = []
        for scene, index, problem in chunk:
            _warm_up(model, version, problem.n_steps, len(problem.scenario.obstacles))
            records.append(evaluate_problem(loaded, scene, index, problem, n_candidates))
        return records
    finally:
        torch.set_num_threads(threads)


@functools.lru_cache(maxsize=1)
def _load(model: str, version: int) -> ART:
    """The model, once per process and version of its weights."""
    from art_policy.model import ART

    return ART.from_pretrained(model)


@functools.lru_cache(maxsize=64)
def _warm_up(model: str, version: int, n_steps: int, n_obstacles: int) -> None:
    """Solves a problem of this size untimed: the first one assembles, the others overwrite."""
    rng = np.random.default_rng(0)
    final_time = n_steps * Scenario().dt
    problem = sample_problem(rng, None, final_time, n_obstacles)
    evaluate_problem(_load(model, version), "warm-up", 0, problem, 2)


def summarise(records: Sequence[ProblemRecord]) -> dict[str, dict[str, float]]:
    """The protocol's figures per method, over the given problems.

    Costs and iterations are means over the problems that REL's bound and all methods were solved
    for (``n_common``), times are of all problems;
    ``suboptimality_improvement`` is ``(J_REL+SCP - J) / (J_REL+SCP - J_REL)`` of those means,
    against REL; the infeasible rate has its Wilson 95 % interval.
    """
    names = list(records[0].outcomes) if records else []
    common = [r for r in records if all(o.solved for o in r.outcomes.values()) and r.rel_cost > 0]
    common = [r for r in common if np.isfinite(r.rel_cost)]
    bound = _mean(r.rel_cost for r in common)
    base_cost = _mean(r.outcomes["REL"].cost for r in common)
    base_iterations = _mean(r.outcomes["REL"].iterations for r in common)
    summary = {}
    for name in names:
        failures = sum(not r.outcomes[name].solved for r in records)
        low, high = wilson_interval(failures, len(records))
        cost = _mean(r.outcomes[name].cost for r in common)
        iterations = _mean(r.outcomes[name].iterations for r in common)
        times = [r.outcomes[name].time for r in records]
        gap = base_cost - bound
        summary[name] = {
            "n": len(records),
            "n_common": len(common),
            "infeasible": failures,
            "infeasible_rate": failures / len(records),
            "infeasible_low": low,
            "infeasible_high": high,
            "suboptimality_improvement": (base_cost - cost) / gap if gap > 0 else float("nan"),
            "cost_improvement": 1.0 - cost / base_cost,
            "mean_cost": cost,
            "mean_iterations": iterations,
            "iterations_improvement": 1.0 - iterations / base_iterations,
            "median_time_ms": 1e3 * float(np.median(times)),
            "mean_time_ms": 1e3 * float(np.mean(times)),
        }
    return summary


def report(records: Sequence[ProblemRecord], model: str) -> dict[str, Any]:
    """What ``freeflyer evaluate`` writes to JSON: figures for all problems and by group."""
    groups = {"all": list(records)}
    for scene in sorted({r.scene for r in records}):
        groups[f"scene {scene}"] = [r for r in records if r.scene == scene]
    for threshold in C_REL_THRESHOLDS[1:]:
        groups[f"C_REL >= {threshold}"] = [r for r in records if r.c_rel >= threshold]
    for final_time in sorted({r.final_time for r in records}):
        groups[f"T_f = {final_time:g} s"] = [r for r in records if r.final_time == final_time]
    return {
        "model": model,
        "machine": {"processor": platform.machine(), "python": platform.python_version()},
        "groups": {name: summarise(group) for name, group in groups.items() if group},
        "records": [asdict(record) for record in records],
    }


def markdown_table(summary: dict[str, dict[str, float]]) -> str:
    """The comparison as a Markdown table, one method a row."""
    lines = [
        "| warm start | infeasible (95 % interval) | suboptimality improvement "
        "| cost improvement | iterations | time, median |",
        "|---|---|---|---|---|---|",
    ]
    for name, row in summary.items():
        lines.append(
            f"| {name} + SCP | {row['infeasible_rate']:.1%} "
            f"({row['infeasible_low']:.1%} to {row['infeasible_high']:.1%}) "
            f"| {row['suboptimality_improvement']:+.1%} | {row['cost_improvement']:+.1%} "
            f"| {row['mean_iterations']:.2f} | {row['median_time_ms']:.0f} ms |"
        )
    return "\n".join(lines)


def save_report(data: dict[str, Any], path: Path) -> None:
    """Writes a report as JSON (infinite costs become null)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(finite(data), indent=1) + "\n", encoding="utf-8")


def wilson_interval(count: int, n: int, z: float = 1.96) -> tuple[float, float]:
    """Wilson score interval of a proportion, 95 % by default."""
    if n == 0:
        return 0.0, 1.0
    share = count / n
    centre = (share + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * np.sqrt(share * (1 - share) / n + z**2 / (4 * n**2))
    return max(0.0, float(centre - half)), min(1.0, float(centre + half))


def _mean(values: Iterable[float]) -> float:
    collected = list(values)
    return float(np.mean(collected)) if collected else float("nan")


def finite(value: Any) -> Any:
    """The value with infinite and undefined numbers, which JSON does not know, as None."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [finite(item) for item in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
