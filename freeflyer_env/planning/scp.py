"""Sequential convex programming: the one loop that solves the optimal control problem.

At each iteration the keep-out and actuation constraints are linearised about the last iterate and
the subproblem is solved in a trust region that shrinks geometrically. REL, the relaxation without
keep-out, goes through the same loop. Failures are values, not exceptions.

Two options keep a bad warm start from stopping the loop: slack on keep-out (``elastic``), and other
homotopy classes as warm starts where the given one leads nowhere (``reroutes``).
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from freeflyer_env.constraints import FEASIBILITY_TOLERANCE, ConstraintReport
from freeflyer_env.planning.backends import CVXPY_PREFIX, check_backend
from freeflyer_env.planning.homotopy import homotopy_starts
from freeflyer_env.planning.infeasibility import why_infeasible
from freeflyer_env.planning.program import KKTResiduals, SolverStatus
from freeflyer_env.planning.result import SCPResult, SCPStatus
from freeflyer_env.planning.subproblem import Subproblem
from freeflyer_env.planning.trajectory import Trajectory
from freeflyer_env.scenario import Obstacles, Problem

if TYPE_CHECKING:
    from freeflyer_env.planning.reference import ReferenceSubproblem

#: Price of a metre of slack at a node in multiples of the largest delta-V: first, growth at each
#: use, last. The last one is above the keep-out multipliers seen, so slack is used only at need.
_FIRST_PRICE, _PRICE_GROWTH, _LAST_PRICE = 5.0, 10.0, 50_000.0


@dataclass(frozen=True)
class SCPConfig:
    """Settings of the SCP loop; the defaults are the paper authors'.

    Attributes:
        backend: Solver of the subproblems: a name in
            ``freeflyer_env.planning.backends.BACKENDS``, or ``cvxpy:<SOLVER>``.
        max_iterations: Most subproblems that are solved from one warm start.
        trust_region_start: First half-width of the trust region (m, rad, m/s, rad/s alike).
        trust_region_end: Half-width at the last allowed iteration.
        trust_region_shape: ``"box"`` makes the subproblem a linear program; ``"ball"`` bounds the
            2-norm of each state's change and needs a backend with second-order cones.
        state_tolerance: Converged if no node's state moved by more than this (2-norm).
        cost_tolerance: Converged if, besides, the cost changed by less than this.
        between_nodes: Whether keep-out is imposed on the straight segments between nodes, too.
        elastic: Whether an infeasible subproblem is solved again with slack on keep-out instead of
            ending the loop. The answer counts as solved only without slack.
        reroutes: How many other homotopy classes are tried, shortest path first, where the warm
            start leads to no solution. With ``elastic``, slack is the last resort then.
        time_limit: In s; no subproblem is begun after it, the running one is finished.
    """

    backend: str = "piqp"
    max_iterations: int = 20
    trust_region_start: float = 10.0
    trust_region_end: float = 0.005
    trust_region_shape: Literal["box", "ball"] = "box"
    state_tolerance: float = 0.005
    cost_tolerance: float = 1e-6
    between_nodes: bool = False
    elastic: bool = False
    reroutes: int = 0
    time_limit: float = np.inf

    @classmethod
    def quick(cls, **settings: Any) -> SCPConfig:
        """Settings that stop once the cost has settled to 0.5 mm/s, some 0.2 % of it.

        By then the trajectory has long been feasible; what the iterations after it save is measured
        in ``docs/planning.md``.
        """
        return cls(**{"cost_tolerance": 5e-4, **settings})

    @classmethod
    def robust(cls, **settings: Any) -> SCPConfig:
        """Settings to fly with: elastic, rerouted, and clear of obstacles between the nodes too."""
        return cls(**{"between_nodes": True, "elastic": True, "reroutes": 12, **settings})

    def __post_init__(self) -> None:
        if self.trust_region_shape not in ("box", "ball"):
            raise ValueError(
                "SCPConfig.trust_region_shape must be 'box' or 'ball', got "
                f"{self.trust_region_shape!r}."
            )
        if self.backend != "piqp" or self.trust_region_shape == "ball":
            check_backend(self.backend, cones=self.trust_region_shape == "ball")
        if self.max_iterations < 2:
            raise ValueError(
                f"SCPConfig.max_iterations must be at least 2, got {self.max_iterations}."
            )
        if self.reroutes < 0:
            raise ValueError(f"SCPConfig.reroutes must not be negative, got {self.reroutes}.")
        if not 0.0 < self.trust_region_end <= self.trust_region_start < np.inf:
            raise ValueError(
                "SCPConfig needs 0 < trust_region_end <= trust_region_start, got "
                f"{self.trust_region_end} and {self.trust_region_start}."
            )
        for name in ("state_tolerance", "cost_tolerance", "time_limit"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"SCPConfig.{name} must be positive, got {getattr(self, name)}.")

    def trust_region(self, iteration: int) -> float:
        """Half-width at ``iteration`` (from 0): geometric from start to end."""
        share = iteration / (self.max_iterations - 1)
        ratio = self.trust_region_end / self.trust_region_start
        return float(self.trust_region_start * ratio**share)


def straight_line(problem: Problem) -> Trajectory:
    """The reference of last resort: uniform motion from start to goal, zero controls."""
    share = np.linspace(0.0, 1.0, problem.n_steps)[:, None]
    poses = (1.0 - share) * problem.start[:3] + share * problem.goal[:3]
    return Trajectory.from_poses(problem, poses)


def solve_rel(
    problem: Problem, config: SCPConfig | None = None, warm_start: Trajectory | None = None
) -> SCPResult:
    """Solves REL, the relaxation without keep-out constraints.

    Its cost is the paper's lower bound of the optimal cost and its trajectory the classical warm
    start. Where the thrusters are barely strong enough, the linearisation about the straight line,
    the warm start by default, can be infeasible although REL is not.
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
    config, start = config or SCPConfig(), warm_start or straight_line(problem)
    result = _solve(problem, start, config, keep_out=False)
    if config.reroutes and _unsettled(result, keep_out=False) and result.trajectory:
        again = _solve(problem, result.trajectory, _in_small(config), keep_out=False, began=began)
        result = replace(again, iterations=result.iterations + again.iterations)
    return result


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
        warm_start = rel.trajectory
        if warm_start is None and config.reroutes and not rel.status.hopeless:
            warm_start = _rel_of_longer(problem, config)
        if warm_start is None:
            return rel
    if unfit := _unfit(problem, warm_start):
        return _failure(SCPStatus.INVALID_INPUT, began, detail=unfit)
    attempts: list[SCPResult] = []
    for start, settings in _routes(problem, warm_start, config, attempts):
        attempts.append(_solve(problem, start, settings, keep_out=True, began=began))
        status = attempts[-1].status
        if attempts[-1].solved or status.hopeless or status is SCPStatus.TIME_LIMIT:
            result = attempts[-1]
            break
    else:
        result = min(attempts, key=_violation)
    iterations = sum(attempt.iterations for attempt in attempts)
    elapsed = time.perf_counter() - began
    return replace(result, iterations=iterations, rerouted=len(attempts) - 1, solve_time=elapsed)


def prepare_scp(problem: Problem, warm_start: Trajectory, config: SCPConfig) -> SCPLoop | SCPResult:
    """The loop of :func:`solve_scp` before its first subproblem, without rerouting.

    Returns:
        The loop, or the failure if problem and warm start do not make sense.
    """
    began = time.perf_counter()
    if unfit := "; ".join(problem.defects()) or _unfit(problem, warm_start):
        return _failure(SCPStatus.INVALID_INPUT, began, detail=unfit)
    return SCPLoop(problem, warm_start, config, began=began)


def _unfit(problem: Problem, warm_start: Trajectory) -> str:
    """Why this warm start cannot be one of this problem; empty if it can."""
    if (warm_start.n_steps, warm_start.dt) != (problem.n_steps, problem.scenario.dt):
        return (
            f"the warm start has {warm_start.n_steps} steps of {warm_start.dt} s, "
            f"the problem {problem.n_steps} of {problem.scenario.dt} s"
        )
    finite = np.isfinite(warm_start.states).all() and np.isfinite(warm_start.controls).all()
    return "" if finite else "the warm start is not finite"


def _routes(
    problem: Problem, warm_start: Trajectory, config: SCPConfig, attempts: list[SCPResult]
) -> Iterator[tuple[Trajectory, SCPConfig]]:
    """Warm starts, and settings for each, in the order in which they are tried.

    Slack costs many iterations and helps rarely, so it comes last, on the best three routes. A loop
    that stayed feasible without settling jumps between vertices of nearly the same cost; it is
    continued in a small trust region.

    Args:
        problem: What to solve.
        warm_start: The first one.
        config: What the user asked for.
        attempts: Results so far; the caller adds each one before it asks for the next route.
    """
    if not config.reroutes:
        yield warm_start, config
        return
    hard = replace(config, elastic=False)
    routes = [warm_start]
    for index in range(1 + config.reroutes):
        if index == 1:
            routes += homotopy_starts(problem, config.reroutes)
        if index >= len(routes):
            break
        yield routes[index], hard
        last = attempts[-1]
        if _unsettled(last, keep_out=True) and last.trajectory:
            yield last.trajectory, _in_small(hard)
    if config.elastic:
        yield from ((route, config) for route in routes[:3])


def _rel_of_longer(problem: Problem, config: SCPConfig) -> Trajectory | None:
    """REL of a longer final time in this problem's time, where REL itself is hard to linearise."""
    for factor in (1.2, 1.6):
        final_time = problem.scenario.dt * round(factor * problem.n_steps)
        rel = solve_rel(replace(problem, final_time=final_time), config)
        if rel.trajectory is not None:
            return rel.trajectory.stretched(problem)
    return None


def _unsettled(result: SCPResult, *, keep_out: bool) -> bool:
    """Whether a loop ended without convergence, but on a trajectory that satisfies everything."""
    if result.status is not SCPStatus.ITERATION_LIMIT or result.report is None:
        return False
    return (result.report if keep_out else replace(result.report, keep_out=0.0)).satisfied()


def _in_small(config: SCPConfig) -> SCPConfig:
    """The settings with a small trust region, in which an unsettled loop is continued."""
    end = config.trust_region_end
    start = min(10.0 * end, config.trust_region_start)
    return replace(config, trust_region_start=start, trust_region_end=0.1 * end)


def _violation(result: SCPResult) -> float:
    """Orders failures: by how much the trajectory violates a constraint."""
    return result.report.worst[1] if result.report else np.inf


def _solve(
    problem: Problem,
    reference: Trajectory,
    config: SCPConfig,
    *,
    keep_out: bool,
    began: float | None = None,
) -> SCPResult:
    loop = SCPLoop(problem, reference, config, keep_out=keep_out, began=began)
    while not loop.done:
        loop.step()
    return loop.result()


class SCPLoop:
    """The loop itself, one subproblem at a time; :func:`solve_scp` is what users call.

    Args:
        problem: What to solve; checked by the caller, as is the reference.
        reference: The warm start.
        config: Settings; rerouting is the caller's.
        keep_out: Whether the keep-out constraints are imposed.
        began: Time at which the caller's work began, on the clock of ``time.perf_counter``.

    Attributes:
        iterations: Subproblems solved so far.
    """

    def __init__(
        self,
        problem: Problem,
        reference: Trajectory,
        config: SCPConfig,
        *,
        keep_out: bool = True,
        began: float | None = None,
    ) -> None:
        self._problem, self._config, self._keep_out = problem, config, keep_out
        self._reference = reference
        self._began = time.perf_counter() if began is None else began
        self._price = self._slack = 0.0
        self._costs: list[float] = []
        self._trajectory: Trajectory | None = None
        self._kkt: KKTResiduals | None = None
        self._report: ConstraintReport | None = None  # of the trajectory, once it has settled
        self._status: SCPStatus | None = None
        self.iterations = 0

    @property
    def done(self) -> bool:
        """Whether the loop has ended."""
        return self._status is not None

    @property
    def solved(self) -> bool:
        """Whether it has ended at a verified local optimum."""
        return self._status is SCPStatus.SOLVED

    @property
    def cost(self) -> float:
        """Cost of the last iterate in m/s, infinite before the first."""
        return self._costs[-1] if self._costs else np.inf

    @property
    def trajectory(self) -> Trajectory | None:
        """The last iterate, None before the first."""
        return self._trajectory

    def give_up(self) -> None:
        """Ends the loop: another warm start has led to a cheaper solution, or to the same."""
        self._status = SCPStatus.OUTRUN

    def step(self) -> None:
        """Solves one subproblem."""
        config, soften = self._config, self._config.elastic and self._keep_out
        if time.perf_counter() - self._began > config.time_limit:
            self._status = SCPStatus.TIME_LIMIT
            return
        trust_region = config.trust_region(self.iterations)
        self.iterations += 1
        solver = _subproblem(self._problem, self._keep_out, config)
        solution = solver.solve(self._problem, self._reference, trust_region)
        softened = solution.trajectory is None and soften
        if softened:
            solver = _subproblem(self._problem, self._keep_out, config, elastic=True)
            grown = min(self._price * _PRICE_GROWTH, _LAST_PRICE)
            self._price = grown if self._price else _FIRST_PRICE
            solution = solver.solve(self._problem, self._reference, trust_region, self._price)
        if solution.trajectory is None:
            infeasible = solution.status is SolverStatus.INFEASIBLE
            self._status = (
                SCPStatus.INFEASIBLE_SUBPROBLEM if infeasible else SCPStatus.NUMERICAL_FAILURE
            )
            return
        trajectory, self._slack = solution.trajectory, solution.slack
        self._trajectory = trajectory
        self._costs.append(trajectory.cost)
        moved = np.linalg.norm(trajectory.states - self._reference.states, axis=1).max()
        self._reference = trajectory
        settled = (
            self.iterations > 1
            and moved <= config.state_tolerance
            and abs(self._costs[-1] - self._costs[-2]) < config.cost_tolerance
        )
        self._report = trajectory.check(self._problem) if settled else None
        if self._report and self._satisfied(trajectory, self._report):
            self._status, self._kkt = SCPStatus.SOLVED, solver.kkt_residuals()
        elif self.iterations == config.max_iterations or (
            # Settled with slack left: more iterations would only pay for it again.
            settled and softened and self._price == _LAST_PRICE
        ):
            left = self._slack > FEASIBILITY_TOLERANCE
            self._status = SCPStatus.SLACK_LEFT if left else SCPStatus.ITERATION_LIMIT

    def _satisfied(self, trajectory: Trajectory, report: ConstraintReport) -> bool:
        """Whether a trajectory satisfies all that this loop imposes."""
        if not self._keep_out:
            return replace(report, keep_out=0.0).satisfied()
        between_nodes = self._config.between_nodes
        if between_nodes and trajectory.between_nodes_depth(self._problem) > FEASIBILITY_TOLERANCE:
            return False
        return report.satisfied()

    def result(self) -> SCPResult:
        """How the loop ended."""
        status = self._status or SCPStatus.ITERATION_LIMIT
        message = status.remedy
        if status not in (SCPStatus.SOLVED, SCPStatus.OUTRUN):
            reason = why_infeasible(self._problem, keep_out=self._keep_out)
            if reason:
                status = SCPStatus.INFEASIBLE_PROBLEM
                message = f"{status.remedy[:-1]}: {reason}."
        trajectory = self._trajectory
        report = self._report
        if report is None and trajectory is not None:
            report = trajectory.check(self._problem)
        elapsed = time.perf_counter() - self._began
        return SCPResult(
            status,
            trajectory,
            self.iterations,
            tuple(self._costs),
            elapsed,
            report,
            message,
            self._kkt,
        )


def _failure(status: SCPStatus, began: float, detail: str) -> SCPResult:
    message = f"{status.remedy[:-1]}: {detail}."
    return SCPResult(status, None, 0, (), time.perf_counter() - began, None, message)


_MOST_SUBPROBLEMS = 16
_local = threading.local()


def _subproblem(
    problem: Problem, keep_out: bool, config: SCPConfig, *, elastic: bool = False
) -> Subproblem | ReferenceSubproblem:
    """The assembled subproblem of this size; each thread keeps the ones it used last."""
    scenario, backend = problem.scenario, config.backend
    ball, segments = config.trust_region_shape == "ball", config.between_nodes and keep_out
    if backend.startswith(CVXPY_PREFIX):
        from freeflyer_env.planning.reference import ReferenceSubproblem

        return ReferenceSubproblem(
            backend.removeprefix(CVXPY_PREFIX).upper(),
            keep_out=keep_out,
            elastic=elastic,
            between_nodes=segments,
            ball=ball,
        )
    n_obstacles = len(scenario.obstacles) if keep_out else 0
    size = (problem.n_steps, n_obstacles, scenario.dt, scenario.robot, backend)
    key = (*size, elastic, segments, ball)
    cache: OrderedDict[tuple, Subproblem] = _local.__dict__.setdefault("cache", OrderedDict())
    if key not in cache:
        cache[key] = Subproblem(*size, elastic=elastic, between_nodes=segments, ball=ball)
    cache.move_to_end(key)
    while len(cache) > _MOST_SUBPROBLEMS:
        cache.popitem(last=False)
    return cache[key]
