"""What SCP returns: a status with a remedy, a trajectory, and the evidence."""

from __future__ import annotations

import enum
from dataclasses import dataclass

import numpy as np

from freeflyer_env.constraints import ConstraintReport
from freeflyer_env.planning.program import KKTResiduals
from freeflyer_env.planning.trajectory import Trajectory


class SCPStatus(enum.Enum):
    """How SCP ended; :attr:`remedy` says what a user can do about it."""

    SOLVED = "solved"
    ITERATION_LIMIT = "iteration_limit"
    INFEASIBLE_SUBPROBLEM = "infeasible_subproblem"
    INFEASIBLE_PROBLEM = "infeasible_problem"
    SLACK_LEFT = "slack_left"
    TIME_LIMIT = "time_limit"
    OUTRUN = "outrun"
    NUMERICAL_FAILURE = "numerical_failure"
    INVALID_INPUT = "invalid_input"

    @property
    def hopeless(self) -> bool:
        """Whether no other warm start can help."""
        return self in (SCPStatus.INFEASIBLE_PROBLEM, SCPStatus.INVALID_INPUT)

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
        "The problem linearised about this warm start has no solution; try SCPConfig.robust(), "
        "another warm start (solve_multistart) or a longer final time."
    ),
    SCPStatus.INFEASIBLE_PROBLEM: "The problem provably has no solution; change the problem.",
    SCPStatus.SLACK_LEFT: (
        "Settled on a trajectory that is still inside a keep-out disc; allow more "
        "SCPConfig.reroutes, or a longer final time."
    ),
    SCPStatus.TIME_LIMIT: (
        "Stopped at SCPConfig.time_limit; raise it, or use the trajectory if it is feasible."
    ),
    SCPStatus.OUTRUN: "Given up: another warm start had led to a cheaper solution, or to the same.",
    SCPStatus.NUMERICAL_FAILURE: (
        "The solver gave up on a subproblem; try another warm start or another backend."
    ),
    SCPStatus.INVALID_INPUT: "The problem as posed cannot be solved; correct the input.",
}


@dataclass(frozen=True, eq=False)
class SCPResult:
    """What SCP found.

    Attributes:
        status: How it ended.
        trajectory: The last iterate, or None if no subproblem was solved.
        iterations: Number of subproblems solved (failing ones and those of reroutes included).
        cost_history: Cost of each iterate of the last route.
        solve_time: Wall time in s, all in.
        report: Independent check of ``trajectory``, or None.
        message: One line for people: what the status means and what to do about it.
        kkt: Residuals of the optimality conditions of the last subproblem if solved, else None
            (also for ``cvxpy:`` backends).
        rerouted: Number of further attempts, from other homotopy classes or with slack.
    """

    status: SCPStatus
    trajectory: Trajectory | None
    iterations: int
    cost_history: tuple[float, ...]
    solve_time: float
    report: ConstraintReport | None
    message: str
    kkt: KKTResiduals | None = None
    rerouted: int = 0

    @property
    def solved(self) -> bool:
        """Whether the trajectory is a verified local optimum."""
        return self.status is SCPStatus.SOLVED

    @property
    def feasible(self) -> bool:
        """Whether the trajectory satisfies every constraint of the problem, optimal or not."""
        return self.report is not None and self.report.satisfied()

    @property
    def cost(self) -> float:
        """Cost of the solution, infinite unless solved."""
        return self.trajectory.cost if self.solved and self.trajectory else np.inf
