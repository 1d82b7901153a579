"""Many problems at once, over processes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, overload

import numpy as np

from freeflyer_env.planning.multistart import MultistartResult, solve_multistart
from freeflyer_env.planning.result import SCPResult, SCPStatus
from freeflyer_env.planning.scp import SCPConfig, solve_scp
from freeflyer_env.planning.trajectory import Trajectory
from freeflyer_env.scenario import Problem


@overload
def solve_many(
    problems: Iterable[Problem],
    warm_starts: Sequence[Trajectory | None] | None = None,
    config: SCPConfig | None = None,
    *,
    n_starts: None = None,
    n_jobs: int = -1,
    progress: bool = False,
) -> list[SCPResult]: ...


@overload
def solve_many(
    problems: Iterable[Problem],
    warm_starts: None = None,
    config: SCPConfig | None = None,
    *,
    n_starts: int,
    n_jobs: int = -1,
    progress: bool = False,
) -> list[MultistartResult]: ...


def solve_many(
    problems: Iterable[Problem],
    warm_starts: Sequence[Trajectory | None] | None = None,
    config: SCPConfig | None = None,
    *,
    n_starts: int | None = None,
    n_jobs: int = -1,
    progress: bool = False,
) -> list[Any]:
    """Solves problems in parallel; results come in the problems' order, failures among them.

    The work goes through joblib: its own processes by default, and whatever backend
    ``joblib.parallel_config`` names. For several machines register Ray once and name it::

        from ray.util.joblib import register_ray

        register_ray()
        with joblib.parallel_config(backend="ray"):
            results = solve_many(problems)

    Args:
        problems: What to solve.
        warm_starts: One for each problem (None: from REL), or None for REL throughout.
        config: Settings of every SCP loop.
        n_starts: If given, :func:`solve_multistart` with so many starts is run on each problem.
        n_jobs: Processes; -1: one per processor, 1: none besides this one.
        progress: Whether to show a progress bar.

    Returns:
        One :class:`SCPResult` per problem, or one :class:`MultistartResult` with ``n_starts``. A
        problem whose solution raised an exception has the status ``NUMERICAL_FAILURE`` and the
        exception in its message.

    Raises:
        ValueError: If there are more or fewer warm starts than problems, or both warm starts and
            ``n_starts`` are given.
    """
    import joblib
    from tqdm import tqdm

    problems = list(problems)
    if warm_starts is not None and n_starts is not None:
        raise ValueError("Give solve_many warm_starts or n_starts, not both.")
    if n_starts is not None and n_starts < 1:
        raise ValueError(f"n_starts must be at least 1, got {n_starts}.")
    starts = [None] * len(problems) if warm_starts is None else list(warm_starts)
    if len(starts) != len(problems):
        raise ValueError(
            f"solve_many needs one warm start per problem, got {len(starts)} for {len(problems)}."
        )
    jobs = [
        joblib.delayed(_solve_one)(problem, start, config, n_starts)
        for problem, start in zip(problems, starts)
    ]
    results: list[Any] = []
    with tqdm(total=len(problems), unit="problem", disable=not progress) as bar:
        try:
            found: Iterator[Any] = joblib.Parallel(n_jobs=n_jobs, return_as="generator")(jobs)
        except ValueError:  # a backend that gives its results all at once, as Ray's does
            found = iter(joblib.Parallel(n_jobs=n_jobs)(jobs))
        for result in found:
            results.append(result)
            bar.update()
    return results


def _solve_one(
    problem: Problem, start: Trajectory | None, config: SCPConfig | None, n_starts: int | None
) -> SCPResult | MultistartResult:
    try:
        if n_starts is not None:
            return solve_multistart(problem, n_starts, config)
        return solve_scp(problem, start, config)
    except ImportError:
        raise  # a missing package is the caller's to install, not a property of the problem
    except Exception as error:  # one bad problem must not lose the others
        message = f"{SCPStatus.NUMERICAL_FAILURE.remedy[:-1]}: {type(error).__name__}: {error}."
        failed = SCPResult(SCPStatus.NUMERICAL_FAILURE, None, 0, (), np.nan, None, message)
        return failed if n_starts is None else MultistartResult(failed, (failed,), ())
