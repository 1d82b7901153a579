"""The protocol: test problems, and all methods on one of them.

Every method hands its warm start to the same loop with hard keep-out constraints. A problem counts
as infeasible for a method if that loop did not end with a verified solution.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from art_policy.planner import PlannerConfig, WarmStartPlanner
from freeflyer_env.planning import (
    SCPConfig,
    SCPResult,
    solve_multistart,
    solve_rel,
    solve_scp,
)
from freeflyer_env.robot import Robot
from freeflyer_env.sampling import sample_obstacles, sample_problem
from freeflyer_env.scenario import HELD_OUT_SCENES, Problem, Scenario

if TYPE_CHECKING:
    from art_policy.deployment import OnnxART
    from art_policy.model import ART

#: Root of the seeds of test problems; datasets use their recipes' seeds and a spawn key of length
#: one.
_TEST_SEED_KEY = 7_777_777

#: Numbers of starts of which multi-start is reported, besides the one that takes as long as a
#: model's candidates.
_MULTI_START = (2, 4)

#: Numbers of obstacles in clutter, and the least gap between two in robot diameters.
_CLUTTER, _LEAST_GAP = (8, 9, 10, 11, 12), 1.2


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
        n_obstacles: Number of obstacles.
        c_rel: Nodes of REL that violate keep-out; -1 where REL failed.
        rel_cost: Cost of REL, the bound, in m/s.
        best_known: Cheapest solution of any method and start in m/s, infinite if there is none.
        outcomes: By name of the method.
    """

    scene: str
    index: int
    final_time: float
    n_obstacles: int
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
    n_obstacles: Sequence[int] | None = None,
    obstacle_speed: float = 0.0,
) -> list[tuple[str, int, Problem]]:
    """Test problems that no dataset contains: ``(scene, index, problem)``, ``n_problems`` in all.

    Args:
        n_problems: How many, spread evenly over scenes, final times and numbers of obstacles.
        scenes: ``"held-out"`` (the paper's three), ``"random"`` (a new scene each), ``"clutter"``
            (random, every gap at least 1.2 times as wide as the robot), or a scene's name.
        final_times: Final times in s.
        seed: Another seed gives other problems.
        n_obstacles: Numbers of obstacles of the new scenes; default: 4, in clutter 8 to 12.
        obstacle_speed: Largest speed of the obstacles of random scenes in m/s.

    Raises:
        ValueError: If an argument is out of range or does not fit ``scenes``.
    """
    if n_problems < 1:
        raise ValueError(f"The number of problems must be at least 1, got {n_problems}.")
    is_new = scenes in ("random", "clutter")
    if ((n_obstacles or obstacle_speed) and not is_new) or (obstacle_speed and scenes != "random"):
        raise ValueError(
            "The number of obstacles can be chosen for scenes 'random' and 'clutter', their speed "
            f"for 'random', not for {scenes!r}."
        )
    scenarios: list[tuple[str, Scenario | None]]
    if scenes == "held-out":
        scenarios = [(f"held-out-{i}", scene) for i, scene in enumerate(HELD_OUT_SCENES, 1)]
    elif is_new:
        scenarios = [(scenes, None)]
    else:
        scenarios = [(scenes, Scenario.named(scenes))]
    counts = n_obstacles or (_CLUTTER if scenes == "clutter" else (4,))
    problems = []
    for index in range(n_problems):
        rng = np.random.default_rng([_TEST_SEED_KEY, seed, index])
        name, scenario = scenarios[index % len(scenarios)]
        turn = index // len(scenarios)
        final_time = final_times[turn % len(final_times)]
        count = counts[turn // len(final_times) % len(counts)]
        if scenes == "clutter":
            gap = _LEAST_GAP * 2.0 * Robot().radius
            scenario = Scenario(sample_obstacles(rng, count, gap=gap))
        problem = sample_problem(rng, scenario, final_time, count, obstacle_speed)
        problems.append((name, index, problem))
    return problems


def evaluate_problem(
    models: Mapping[str, ART | OnnxART],
    scene: str,
    index: int,
    problem: Problem,
    n_candidates: int,
    n_starts: int,
    config: SCPConfig | None = None,
) -> ProblemRecord:
    """Runs every method on one problem.

    The methods are REL, with hard keep-out and with slack on it; each model, its first candidate,
    the best of several, without REL to fall back on, so that its failures show, and the best of
    several and REL; and multi-start over homotopy classes, in a race as the candidates are: the
    best of two, of four, and of as many as take no longer than the first model's best of several.

    Args:
        models: By the name under which they are reported.
        scene: Name of the scene.
        index: Number of the problem.
        problem: What to solve.
        n_candidates: Most candidates of a model that are refined.
        n_starts: Starts of multi-start, REL's included, that the best known solution is taken from.
        config: Settings of the SCP that all methods share; the paper's if None.
    """
    config = config or SCPConfig()
    rel = solve_rel(problem, config)
    bound = rel.trajectory
    c_rel = int(bound.violations(problem).sum()) if bound is not None else -1
    outcomes = {
        "REL": _timed(lambda: solve_scp(problem, config=config)),
        "REL, elastic": _timed(lambda: solve_scp(problem, config=replace(config, elastic=True))),
    }
    for name, model in models.items():
        most = n_candidates
        if model.config.head == "multi_hypothesis":
            most = min(most, model.config.n_hypotheses)
        settings = {
            name: PlannerConfig(1, "never", config),
            f"{name}, best of {most}": PlannerConfig(most, "never", config),
            f"{name}, best of {most} and REL": PlannerConfig(most, "portfolio", config),
        }
        if most == 1:
            del settings[f"{name}, best of 1"]
        for label, setting in settings.items():
            plan = WarmStartPlanner(model, setting).plan(problem)
            outcomes[label] = _outcome(plan.result, plan.timings["total"])
    several = [outcome.time for label, outcome in outcomes.items() if "best of" in label]
    budget = several[0] if several else 0.0
    counts = sorted({*_MULTI_START, min(8, n_starts), n_starts})
    raced = {
        count: _timed(lambda: _multi_start(problem, count, config))  # noqa: B023
        for count in counts
    }
    for count in _MULTI_START:
        outcomes[f"multi-start, best of {count}"] = raced[count]
    if budget:
        affordable = [raced[count] for count in counts if raced[count].time <= budget]
        outcomes["multi-start, equal time"] = (affordable or [outcomes["REL"]])[-1]
    best = min(outcome.cost for outcome in [*outcomes.values(), *raced.values()])
    size = len(problem.scenario.obstacles)
    return ProblemRecord(scene, index, problem.final_time, size, c_rel, rel.cost, best, outcomes)


def _multi_start(problem: Problem, n_starts: int, config: SCPConfig) -> SCPResult:
    """The best that a race from REL and other homotopy classes leads to."""
    results = solve_multistart(problem, n_starts, config, effort="best").results
    return min(results, key=lambda result: result.cost)


def _timed(solve: Callable[[], SCPResult]) -> Outcome:
    began = time.perf_counter()
    result = solve()
    return _outcome(result, time.perf_counter() - began)


def _outcome(result: SCPResult, elapsed: float) -> Outcome:
    cost = float(result.cost) if result.solved else float("inf")
    return Outcome(result.solved, cost, int(result.iterations), float(elapsed))
