"""Several starts that pass the obstacles on other sides: the teacher, and the honest baseline."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from freeflyer_env.planning.homotopy import homotopy_starts
from freeflyer_env.planning.result import SCPResult
from freeflyer_env.planning.scp import (
    SCPConfig,
    SCPLoop,
    prepare_scp,
    solve_rel,
    solve_scp,
    straight_line,
)
from freeflyer_env.planning.trajectory import Trajectory
from freeflyer_env.scenario import Problem

#: What :func:`solve_multistart` does with its starts.
EFFORTS = ("all", "best", "first")

#: Two optima are the same if their costs and positions agree to these (m/s, m).
_SAME_COST, _SAME_POSITION = 1e-4, 0.02

#: A warm start has fallen behind if its cost is so many times the best solution's after the first
#: subproblem, and after a later one. Of 452 proposals of a model, 95 % lost less than that from
#: there to their solution after the first, 98 % after the second.
_BEHIND = (1.1, 1.02)


@dataclass(frozen=True, eq=False)
class MultistartResult:
    """What the starts of one problem led to.

    Attributes:
        rel: The REL solution, start 0 of the list.
        results: One SCP result per start that was tried.
        optima: Distinct solved optima, cheapest first.
    """

    rel: SCPResult
    results: tuple[SCPResult, ...]
    optima: tuple[SCPResult, ...]

    @property
    def best(self) -> SCPResult:
        """The cheapest optimum; the REL-started result where nothing was solved."""
        return self.optima[0] if self.optima else self.results[0]


def solve_multistart(
    problem: Problem,
    n_starts: int = 6,
    config: SCPConfig | None = None,
    n_jobs: int = 1,
    effort: str = "all",
) -> MultistartResult:
    """SCP from REL and from up to ``n_starts - 1`` paths in distinct homotopy classes.

    Args:
        problem: What to solve.
        n_starts: Number of starts, at least 1; 1 is SCP from REL (where that failed, from the
            straight line). Fewer are used where the obstacles allow fewer classes.
        config: Settings of every SCP loop; ``reroutes`` plays no part, the starts are the routes.
        n_jobs: Processes over which the starts are spread; worth it where one problem has to be
            solved fast. For many problems use :func:`solve_many`.
        effort: ``"all"`` refines every start. ``"best"`` gives up those that fall behind
            (:func:`race_scp`). ``"first"`` stops at the first one that is solved: SCP from REL, and
            other starts only where that fails. The last two take one process, whatever ``n_jobs``.

    Returns:
        All results; deterministic, no random numbers are used.
    """
    if n_starts < 1:
        raise ValueError(f"n_starts must be at least 1, got {n_starts}.")
    if effort not in EFFORTS:
        raise ValueError(f"effort must be one of {EFFORTS}, got {effort!r}.")
    rel = solve_rel(problem, config)
    if rel.status.hopeless or problem.defects():
        return MultistartResult(rel, (solve_scp(problem, straight_line(problem), config),), ())
    config = replace(config or SCPConfig(), reroutes=0)
    starts = [rel.trajectory or straight_line(problem)]
    if effort == "first":
        tried = [solve_scp(problem, starts[0], config)]
        if not tried[0].solved and n_starts > 1:
            for start in homotopy_starts(problem, n_starts - 1):
                tried.append(solve_scp(problem, start, config))
                if tried[-1].solved:
                    break
        return MultistartResult(rel, tuple(tried), distinct_optima(tuple(tried)))
    if n_starts > 1:
        starts += homotopy_starts(problem, n_starts - 1)
    if effort == "best":
        results = race_scp(problem, starts, config)
    elif n_jobs == 1 or len(starts) == 1:
        results = tuple(solve_scp(problem, start, config) for start in starts)
    else:
        import joblib

        jobs = (joblib.delayed(solve_scp)(problem, start, config) for start in starts)
        results = tuple(joblib.Parallel(n_jobs=n_jobs)(jobs))
    return MultistartResult(rel, results, distinct_optima(results))


def race_scp(
    problem: Problem, warm_starts: Sequence[Trajectory], config: SCPConfig | None = None
) -> tuple[SCPResult, ...]:
    """SCP from several warm starts of which those that fall behind are given up.

    A subproblem's cost is close to that of the solution it leads to, so one subproblem is solved
    from each warm start, and the cheapest is refined first; another is refined until its cost is
    above the best solution's by so much that it will hardly fall below, or its path is the best
    solution's. It takes about half the time of refining all, a third where several warm starts lead
    to the same optimum, and loses little: the cheapest is missed where the cost falls late.

    Args:
        problem: What to solve.
        warm_starts: References, each with ``problem.n_steps`` controls; at least one.
        config: Settings of every loop, but for the time limit, which is that of the race;
            ``reroutes`` plays no part, the warm starts are the routes.

    Returns:
        One result per warm start, in their order; those given up have the status ``OUTRUN``. The
        time of each is that of the race.

    Raises:
        ValueError: Without a warm start.
    """
    if not warm_starts:
        raise ValueError("race_scp needs at least one warm start.")
    config = replace(config or SCPConfig(), reroutes=0)
    loops = [prepare_scp(problem, start, config) for start in warm_starts]
    for loop in loops:
        if isinstance(loop, SCPLoop):
            loop.step()
    runners = [loop for loop in loops if isinstance(loop, SCPLoop)]
    best: SCPLoop | None = None
    for loop in sorted(runners, key=lambda loop: loop.cost):
        while not loop.done:
            if best is not None and _is_beaten(loop, best):
                loop.give_up()
            else:
                loop.step()
        if loop.solved and (best is None or loop.cost < best.cost):
            best = loop
    return tuple(loop.result() if isinstance(loop, SCPLoop) else loop for loop in loops)


def _is_beaten(loop: SCPLoop, best: SCPLoop) -> bool:
    """Whether a loop will hardly lead to anything cheaper than the best one did."""
    if loop.cost > _BEHIND[min(loop.iterations, 2) - 1] * best.cost:
        return True
    assert loop.trajectory is not None
    assert best.trajectory is not None
    return _apart(loop.trajectory, best.trajectory) < _SAME_POSITION


def _apart(first: Trajectory, second: Trajectory) -> float:
    """Largest distance of two trajectories' nodes along either axis in m."""
    return float(np.abs(first.states[:, :2] - second.states[:, :2]).max())


def distinct_optima(results: tuple[SCPResult, ...]) -> tuple[SCPResult, ...]:
    """The solved results without repetitions, cheapest first."""
    found: list[SCPResult] = []
    for result in sorted((r for r in results if r.solved), key=lambda r: r.cost):
        if not any(_same(result, other) for other in found):
            found.append(result)
    return tuple(found)


def _same(first: SCPResult, second: SCPResult) -> bool:
    if abs(first.cost - second.cost) > _SAME_COST:
        return False
    assert first.trajectory is not None
    assert second.trajectory is not None
    return _apart(first.trajectory, second.trajectory) < _SAME_POSITION
