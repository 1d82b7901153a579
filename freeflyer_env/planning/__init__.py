"""Trajectory optimisation: REL, SCP and multi-start on the paper's optimal control problem.

:func:`solve_scp` refines one warm start, :func:`race_scp` the most promising of several;
:func:`solve_multistart` makes several; :func:`solve_many` works on many problems;
:func:`pareto_front` frees the final time; :class:`RecedingHorizon` re-plans in flight.
The planning guide (``docs/planning.md``) says which backend and which settings to use when.
"""

from freeflyer_env.planning.batch import solve_many
from freeflyer_env.planning.final_time import ParetoFront, pareto_front
from freeflyer_env.planning.multistart import MultistartResult, race_scp, solve_multistart
from freeflyer_env.planning.receding_horizon import RecedingHorizon
from freeflyer_env.planning.result import SCPResult, SCPStatus
from freeflyer_env.planning.scp import SCPConfig, solve_rel, solve_scp, straight_line
from freeflyer_env.planning.trajectory import Trajectory, to_go

__all__ = [
    "MultistartResult",
    "ParetoFront",
    "RecedingHorizon",
    "SCPConfig",
    "SCPResult",
    "SCPStatus",
    "Trajectory",
    "pareto_front",
    "race_scp",
    "solve_many",
    "solve_multistart",
    "solve_rel",
    "solve_scp",
    "straight_line",
    "to_go",
]
