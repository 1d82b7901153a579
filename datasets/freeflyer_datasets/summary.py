"""Statistics of a dataset, in one pass over its shards."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, SupportsInt

import numpy as np
from numpy.typing import NDArray

from freeflyer_datasets.shards import LABEL_REL, LABEL_SCP, Shard


@dataclass(frozen=True, eq=False)
class Statistics:
    """What the card and ``freeflyer info`` tell of a dataset.

    Attributes:
        n_problems: Problems, failed ones included.
        n_failed: Problems without a trajectory.
        n_steps: Steps of all trajectories.
        c_rel: ``(P,)`` nodes of REL inside a keep-out zone, of the problems with trajectories.
        rel_cost: ``(P,)`` cost of REL in m/s.
        best_cost: ``(P,)`` cost of the cheapest optimum in m/s; NaN where none was found.
        n_optima: ``(P,)`` number of optima kept.
        rel_iterations: ``(P,)`` subproblems solved for REL.
        scp_iterations: ``(number of optima,)`` subproblems solved for each optimum.
        violation: Largest violation of a constraint of any trajectory.
    """

    n_problems: int
    n_failed: int
    n_steps: int
    c_rel: NDArray[np.int32]
    rel_cost: NDArray[np.float64]
    best_cost: NDArray[np.float64]
    n_optima: NDArray[np.int64]
    rel_iterations: NDArray[np.int32]
    scp_iterations: NDArray[np.int32]
    violation: float

    @property
    def n_trajectories(self) -> int:
        """Number of episodes."""
        return len(self.rel_cost) + len(self.scp_iterations)

    def summary(self) -> dict[str, Any]:
        """Plain numbers for a dataset's metadata, costs in m/s.

        Shares are ``[share, lower, upper]`` with the 95 % interval, distributions
        ``[5 %, 50 %, 95 %, mean]``.
        """
        solved = self.solved
        return {
            "problems": self.n_problems,
            "failed": self.n_failed,
            "episodes": {"REL": len(self.rel_cost), "SCP": len(self.scp_iterations)},
            "steps": self.n_steps,
            "rel_feasible": share((self.c_rel == 0).sum(), len(self.c_rel)),
            "with_optimum": share(solved.sum(), self.n_problems),
            "with_several_optima": share((self.n_optima > 1).sum(), self.n_problems),
            "optima_per_problem": quantiles(self.n_optima),
            "rel_cost": quantiles(self.rel_cost),
            "best_cost": quantiles(self.best_cost[solved]),
            "best_over_rel": quantiles(self.best_cost[solved] / self.rel_cost[solved]),
            "c_rel": quantiles(self.c_rel),
            "rel_iterations": quantiles(self.rel_iterations),
            "scp_iterations": quantiles(self.scp_iterations),
            "largest_violation": self.violation,
        }

    @property
    def solved(self) -> NDArray[np.bool_]:
        """``(P,)`` whether an optimum was found."""
        return np.isfinite(self.best_cost)

    @classmethod
    def of_shards(cls, shards: Iterable[Shard]) -> Statistics:
        """Statistics of the shards of one dataset, read once, one at a time.

        Raises:
            ValueError: If there are no shards.
        """
        parts = [_shard_columns(shard) for shard in shards]
        if not parts:
            raise ValueError("There are no shards to make statistics of.")
        columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        return cls(
            n_problems=int(columns.pop("n_problems").sum()),
            n_failed=int(columns.pop("n_failed").sum()),
            n_steps=int(columns.pop("n_steps").sum()),
            violation=float(columns.pop("violation").max()),
            **columns,
        )


def _shard_columns(shard: Shard) -> dict[str, np.ndarray]:
    is_rel, is_best = shard.label == LABEL_REL, (shard.label == LABEL_SCP) & (shard.rank == 0)
    kept = shard.problem[is_rel]
    best = np.full(shard.n_problems, np.nan)
    best[shard.problem[is_best]] = shard.cost[is_best]
    optima = np.bincount(shard.problem[~is_rel], minlength=shard.n_problems)
    return {
        "n_problems": np.array([shard.n_problems]),
        "n_failed": np.array([shard.n_problems - len(kept)]),
        "n_steps": np.array([len(shard.controls)]),
        "c_rel": shard.c_rel[kept],
        "rel_cost": shard.rel_cost[kept],
        "best_cost": best[kept],
        "n_optima": optima[kept],
        "rel_iterations": shard.iterations[is_rel],
        "scp_iterations": shard.iterations[~is_rel],
        "violation": np.array([shard.violation.max(initial=0.0)]),
    }


def wilson_interval(n_successes: int, n: int, z: float = 1.96) -> tuple[float, float]:
    """Wilson's score interval of a proportion.

    Args:
        n_successes: Successes among them.
        n: Observations.
        z: Quantile of the normal distribution; 1.96 for 95 %.

    Returns:
        Lower and upper end; (0, 1) without observations.

    Raises:
        ValueError: If ``n_successes`` is not in [0, n].
    """
    if not 0 <= n_successes <= n:
        raise ValueError(f"n_successes must be in [0, {n}], got {n_successes}.")
    if n == 0:
        return 0.0, 1.0
    p, extra = n_successes / n, z * z / n
    middle = (p + extra / 2) / (1 + extra)
    half = z / (1 + extra) * float(np.sqrt(p * (1 - p) / n + extra / (4 * n)))
    return max(middle - half, 0.0), min(middle + half, 1.0)


def share(count: SupportsInt, n: int) -> list[float]:
    """``[share, lower, upper]`` of ``count`` in ``n``, with the 95 % interval; ``[]`` of none."""
    return [int(count) / n, *wilson_interval(int(count), n)] if n else []


def quantiles(values: NDArray[Any]) -> list[float]:
    """``[5 %, 50 %, 95 %, mean]``; ``[]`` of none."""
    if not len(values):
        return []
    return [*np.quantile(values, [0.05, 0.5, 0.95]).tolist(), float(np.mean(values))]
