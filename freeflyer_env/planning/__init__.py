"""Trajectory optimisation: REL, SCP and multi-start on the paper's optimal control problem."""

from freeflyer_env.planning.multistart import MultistartResult, solve_multistart
from freeflyer_env.planning.scp import (
    SCPConfig,
    SCPResult,
    SCPStatus,
    solve_rel,
    solve_scp,
    straight_line,
)
from freeflyer_env.planning.trajectory import Trajectory, to_go

__all__ = [
    "MultistartResult",
    "SCPConfig",
    "SCPResult",
    "SCPStatus",
    "Trajectory",
    "solve_multistart",
    "solve_rel",
    "solve_scp",
    "straight_line",
    "to_go",
]
