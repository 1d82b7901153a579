"""Sequential convex programming: the one loop that solves the optimal control problem.

At each iteration the keep-out and actuation constraints are linearised about the last iterate and
the subproblem is solved in a trust region that shrinks geometrically. REL, the relaxation without
keep-out, goes through the same loop. Failures are values, not exceptions.
"""

from __future__ import annotations

import enum
import threading
import time
from collections import OrderedDict
from dataclasses import dataclass, replace

import numpy as np

from freeflyer_env.constraints import FEASIBILITY_TOLERANCE, ConstraintReport
from freeflyer_env.constraints import check as check_constraints
from freeflyer_env.planning.backends import BACKENDS, SolverStatus, make_backend
from freeflyer_env.planning.subproblem import Subproblem
from freeflyer_env.planning.trajectory import Trajectory
from freeflyer_env.scenario import Obstacles, Problem


class SCPStatus(enum.Enum):
    """How SCP ended; :attr:`remedy` says what a user can do about it."""

    SOLVED = "solved"
    ITERATION_LIMIT = "iteration_limit"
    INFEASIBLE_SUBPROBLEM = "infeasible_subproblem"
    NUMERICAL_FAILURE = "numerical_failure"
    INVALID_INPUT = "invalid_input"

    @property
    def remedy(self) -> str:
        """One line: what this status means and what to try."""
        return _REMEDIES[self]


_REMEDIES = {
    SCPStatus.SOLVED: "Converged, and every constraint imposed was verified independently.",
    SCPStatus.ITERATION_LIMIT: (
        "Not converged within the iteration limit; raise SCPConfig.max_iterations or try another "
        "warm start."
    ),
    SCPStatus.INFEASIBLE_SUBPROBLEM: (
        "The problem linearised about this warm start has no solution; try another warm start "
        "(solve_multistart) or a longer final time."
    ),
    SCPStatus.NUMERICAL_FAILURE: (
        "The solver gave up on a subproblem; try another warm start or another backend."
    ),
    SCPStatus.INVALID_INPUT: "The problem as posed cannot be solved; correct the input.",
}


@dataclass(frozen=True)
class SCPConfig:
    """Settings of the SCP loop; the defaults are the paper authors'.

    Attributes:
        backend: Solver of the subproblems, a name in ``freeflyer_env.planning.backends.BACKENDS``.
        max_iterations: Most subproblems that are solved.
        trust_region_start: First half-width of the trust region (m, rad, m/s, rad/s alike).
        trust_region_end: Half-width at the last allowed iteration.
        state_tolerance: Converged if no node's state moved by more than this (2-norm).
        cost_tolerance: Converged if, besides, the cost changed by less than this.
        elastic: Whether an infeasible subproblem is solved again with slack on keep-out instead of
            ending the loop. The answer counts as solved only without slack.
    """

    backend: str = "piqp"
    max_iterations: int = 20
    trust_region_start: float = 10.0
    trust_region_end: float = 0.005
    state_tolerance: float = 0.005
    cost_tolerance: float = 1e-6
    elastic: bool = False

    def __post_init__(self) -> None:
        if self.backend not in BACKENDS:
            make_backend(self.backend)  # raises with the nearest name
        if self.max_iterations < 2:
            raise ValueError(
                f"SCPConfig.max_iterations must be at least 2, got {self.max_iterations}."
            )
        if not 0.0 < self.trust_region_end <= self.trust_region_start < np.inf:
            raise ValueError(
                "SCPConfig needs 0 < trust_region_end <= trust_region_start, got "
                f"{self.trust_region_end} and {self.trust_region_start}."
            )
        for name in ("state_tolerance", "cost_tolerance"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"SCPConfig.{name} must be positive, got {getattr(self, name)}.")

    def trust_region(self, iteration: int) -> float:
        """Half-width at ``iteration`` (from 0): geometric from start to end."""
        share = iteration / (self.max_iterations - 1)
        ratio = self.trust_region_end / self.trust_region_start
        return float(self.trust_region_start * ratio**share)


@dataclass(frozen=True, eq=False)
class SCPResult:
    """What SCP found.

    Attributes:
        status: How it ended.
        trajectory: The last iterate, or None if no subproblem was solved.
        iterations: Number of subproblems solved (the failing one included).
        cost_history: Cost of each iterate.
        solve_time: Wall time in s, all in.
        report: Independent check of ``trajectory``, or None.
        message: One line for people.
    """

    status: SCPStatus
    trajectory: Trajectory | None
    iterations: int
    cost_history: tuple[float, ...]
    solve_time: float
    report: ConstraintReport | None
    message: str

    @property
    def solved(self) -> bool:
        """Whether the trajectory is a verified local optimum."""
        return self.status is SCPStatus.SOLVED

    @property
    def cost(self) -> float:
        """Cost of the solution, infinite unless solved."""
        return self.trajectory.cost if self.solved and self.trajectory else np.inf


def straight_line(problem: Problem) -> Trajectory:
    """The reference of last resort: uniform motion from start to goal, zero controls."""
    share = np.linspace(0.0, 1.0, problem.n_steps)[:, None]
    poses = (1.0 - share) * problem.start[:3] + share * problem.goal[:3]
    return Trajectory.from_poses(problem, poses)


def solve_rel(problem: Problem, config: SCPConfig | None = None) -> SCPResult:
    """Solves REL, the relaxation without keep-out constraints, from the straight line.

    Its cost is the paper's lower bound of the optimal cost and its trajectory the classical warm
    start.
    """
    began = time.perf_counter()
    free = Problem(
        replace(problem.scenario, obstacles=Obstacles.from_rows([])),
        problem.start,
        problem.goal,
        problem.final_time,
    )
    if defects := free.defects():
        return _failure(SCPStatus.INVALID_INPUT, began, detail="; ".join(defects))
    return _solve(problem, straight_line(problem), config or SCPConfig(), keep_out=False)


def solve_scp(
    problem: Problem, warm_start: Trajectory | None = None, config: SCPConfig | None = None
) -> SCPResult:
    """Refines a warm start to a feasible local optimum.

    Args:
        problem: What to solve.
        warm_start: First reference, with ``problem.n_steps`` controls. None: REL is solved first
            and used (its time counts, its iterations do not).
        config: Settings of the loop.

    Returns:
        The result; never an exception for an expected failure.
    """
    config = config or SCPConfig()
    began = time.perf_counter()
    if defects := problem.defects():
        return _failure(SCPStatus.INVALID_INPUT, began, detail="; ".join(defects))
    if warm_start is None:
        rel = solve_rel(problem, config)
        if rel.trajectory is None:
            return rel
        warm_start = rel.trajectory
    if (warm_start.n_steps, warm_start.dt) != (problem.n_steps, problem.scenario.dt):
        detail = (
            f"the warm start has {warm_start.n_steps} steps of {warm_start.dt} s, "
            f"the problem {problem.n_steps} of {problem.scenario.dt} s"
        )
        return _failure(SCPStatus.INVALID_INPUT, began, detail=detail)
    if not (np.isfinite(warm_start.states).all() and np.isfinite(warm_start.controls).all()):
        return _failure(SCPStatus.INVALID_INPUT, began, detail="the warm start is not finite")
    return _solve(problem, warm_start, config, keep_out=True, began=began)


def _solve(
    problem: Problem,
    reference: Trajectory,
    config: SCPConfig,
    *,
    keep_out: bool,
    began: float | None = None,
) -> SCPResult:
    began = time.perf_counter() if began is None else began
    subproblem = _subproblem(problem, keep_out, config.backend)
    soften = config.elastic and keep_out
    costs: list[float] = []
    trajectory: Trajectory | None = None
    for iteration in range(config.max_iterations):
        trust_region = config.trust_region(iteration)
        solution = subproblem.solve(problem, reference, trust_region)
        softened = solution.trajectory is None and soften
        if softened:
            elastic = _subproblem(problem, keep_out, config.backend, elastic=True)
            solution = elastic.solve(problem, reference, trust_region)
        if solution.trajectory is None:
            status = (
                SCPStatus.INFEASIBLE_SUBPROBLEM
                if solution.status is SolverStatus.INFEASIBLE
                else SCPStatus.NUMERICAL_FAILURE
            )
            return _finish(problem, status, trajectory, costs, iteration + 1, began)
        trajectory = solution.trajectory
        costs.append(trajectory.cost)
        moved = np.linalg.norm(trajectory.states - reference.states, axis=1).max()
        reference = trajectory
        if iteration == 0 or moved > config.state_tolerance:
            continue
        if abs(costs[-1] - costs[-2]) >= config.cost_tolerance:
            continue
        if _verified(problem, trajectory, keep_out):
            return _finish(problem, SCPStatus.SOLVED, trajectory, costs, iteration + 1, began)
        if softened:
            # Settled with slack left: more iterations would only pay for it again.
            status = SCPStatus.INFEASIBLE_SUBPROBLEM
            return _finish(problem, status, trajectory, costs, iteration + 1, began)
    return _finish(
        problem, SCPStatus.ITERATION_LIMIT, trajectory, costs, config.max_iterations, began
    )


def _verified(problem: Problem, trajectory: Trajectory, keep_out: bool) -> bool:
    report = check_constraints(problem, trajectory.states, trajectory.controls)
    if not keep_out:
        report = replace(report, keep_out=0.0)
    return report.satisfied(FEASIBILITY_TOLERANCE)


def _finish(
    problem: Problem,
    status: SCPStatus,
    trajectory: Trajectory | None,
    costs: list[float],
    iterations: int,
    began: float,
) -> SCPResult:
    report = trajectory.check(problem) if trajectory else None
    elapsed = time.perf_counter() - began
    return SCPResult(status, trajectory, iterations, tuple(costs), elapsed, report, status.remedy)


def _failure(status: SCPStatus, began: float, detail: str) -> SCPResult:
    message = f"{status.remedy[:-1]}: {detail}."
    return SCPResult(status, None, 0, (), time.perf_counter() - began, None, message)


_MOST_SUBPROBLEMS = 16
_local = threading.local()


def _subproblem(
    problem: Problem, keep_out: bool, backend: str, *, elastic: bool = False
) -> Subproblem:
    """The assembled subproblem of this size; each thread keeps the ones it used last."""
    scenario = problem.scenario
    n_obstacles = len(scenario.obstacles) if keep_out else 0
    key = (problem.n_steps, n_obstacles, scenario.dt, scenario.robot, backend, elastic)
    cache: OrderedDict[tuple, Subproblem] = _local.__dict__.setdefault("cache", OrderedDict())
    if key not in cache:
        cache[key] = Subproblem(
            problem.n_steps, n_obstacles, scenario.dt, scenario.robot, backend, elastic=elastic
        )
    cache.move_to_end(key)
    while len(cache) > _MOST_SUBPROBLEMS:
        cache.popitem(last=False)
    return cache[key]
