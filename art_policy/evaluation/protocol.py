"""The protocol: test problems, and all methods on one of them.

Every method hands its warm start to the same loop with hard keep-out constraints. A problem counts
as infeasible for a method if that loop did not end with a verified solution.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from art_policy.planner import PlannerConfig, WarmStartPlanner
from freeflyer_env.planning import SCPConfig, SCPResult, solve_rel, solve_scp
from freeflyer_env.planning.homotopy import homotopy_starts
from freeflyer_env.sampling import sample_problem
from freeflyer_env.scenario import HELD_OUT_SCENES, Problem, Scenario

if TYPE_CHECKING:
    from art_policy.deployment import OnnxART
    from art_policy.model import ART

#: Root of the seeds of test problems; datasets use their recipes' seeds and a spawn key of length
#: one.
_TEST_SEED_KEY = 7_777_777

#: Numbers of starts of which multi-start is reported.
_MULTI_START = (2, 4)


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
    """All methods on one problem.

    Attributes:
        scene: Name of the scene.
        index: Number of the problem.
        final_time: In s.
        c_rel: Nodes of REL that violate keep-out; -1 where REL failed.
        rel_cost: Cost of REL, the bound, in m/s.
        best_known: Cheapest solution of any method and start in m/s, infinite if there is none.
        outcomes: By name of the method.
    """

    scene: str
    index: int
    final_time: float
    c_rel: int
    rel_cost: float
    best_known: float
    outcomes: dict[str, Outcome]

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON; :meth:`from_dict` is its inverse."""
        return asdict(self)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> ProblemRecord:
        """The record that :meth:`to_dict` described; null stands for an infinite cost."""

        def number(value: float | None) -> float:
            return float("inf") if value is None else float(value)

        outcomes = {
            name: Outcome(**{**outcome, "cost": number(outcome["cost"])})
            for name, outcome in data["outcomes"].items()
        }
        costs = {name: number(data[name]) for name in ("rel_cost", "best_known")}
        return cls(**{**data, **costs, "outcomes": outcomes})


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
    models: Mapping[str, ART | OnnxART],
    scene: str,
    index: int,
    problem: Problem,
    n_candidates: int,
    n_starts: int,
) -> ProblemRecord:
    """Runs every method on one problem.

    The methods are REL, with hard keep-out and with slack on it; each model, its first candidate
    and the best of several, without REL to fall back on, so that its failures show; and multi-start
    over homotopy classes: the best of two, of four, and of as many as take no longer than the first
    model's best of several.

    Args:
        models: By the name under which they are reported.
        scene: Name of the scene.
        index: Number of the problem.
        problem: What to solve.
        n_candidates: Most candidates of a model that are refined.
        n_starts: Starts of multi-start, REL's included, that the best known solution is taken from.
    """
    rel = solve_rel(problem)
    bound = rel.trajectory
    c_rel = int(bound.violations(problem).sum()) if bound is not None else -1
    began = time.perf_counter()
    refined = solve_scp(problem)
    outcomes = {"REL": _outcome(refined, time.perf_counter() - began)}
    began = time.perf_counter()
    elastic = solve_scp(problem, config=SCPConfig(elastic=True))
    outcomes["REL, elastic"] = _outcome(elastic, time.perf_counter() - began)
    for name, model in models.items():
        most = n_candidates
        if model.config.head == "multi_hypothesis":
            most = min(most, model.config.n_hypotheses)
        for count in sorted({1, most}):
            planner = WarmStartPlanner(model, PlannerConfig(n_candidates=count, rel="never"))
            plan = planner.plan(problem)
            label = name if count == 1 else f"{name}, best of {count}"
            outcomes[label] = _outcome(plan.result, plan.timings["total"])
    budget = max((outcomes[label].time for label in outcomes if "best of" in label), default=0.0)
    starts = _multi_start(problem, refined, outcomes["REL"].time, max(n_starts, *_MULTI_START))
    for count in _MULTI_START:
        outcomes[f"multi-start, best of {count}"] = _best(starts[:count])
    if budget:
        affordable = [start for start in starts if start[1] <= budget] or starts[:1]
        outcomes["multi-start, equal time"] = _best(affordable)
    best = min([outcome.cost for outcome in outcomes.values()] + [r.cost for r, _ in starts])
    return ProblemRecord(scene, index, problem.final_time, c_rel, rel.cost, best, outcomes)


def _multi_start(
    problem: Problem, refined: SCPResult, time_of_rel: float, n_starts: int
) -> list[tuple[SCPResult, float]]:
    """SCP's results from REL and other homotopy classes, with the time it took until there."""
    began = time.perf_counter()
    results = [(refined, time_of_rel)]
    if problem.defects():
        return results
    for start in homotopy_starts(problem, n_starts - 1):
        result = solve_scp(problem, start)
        results.append((result, time_of_rel + time.perf_counter() - began))
    return results


def _best(starts: list[tuple[SCPResult, float]]) -> Outcome:
    best = min((result for result, _ in starts), key=lambda result: result.cost)
    return _outcome(best, starts[-1][1])


def _outcome(result: SCPResult, elapsed: float) -> Outcome:
    cost = float(result.cost) if result.solved else float("inf")
    return Outcome(result.solved, cost, int(result.iterations), float(elapsed))
