"""Really planning with a model while it is trained: what its loss is only a stand-in for."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from art_policy.rollout import propose_batch
from freeflyer_env.planning import SCPConfig, solve_rel, solve_scp, straight_line

if TYPE_CHECKING:
    from art_policy.model import ART
    from art_policy.rollout import Proposal
    from art_policy.train_config import TrainConfig
    from freeflyer_datasets.loading import PackedDataset
    from freeflyer_env.planning import Trajectory
    from freeflyer_env.scenario import Problem

_LABEL_SCP = 1

#: A failed plan counts as one that costs so much more than the best known one.
_FAILURE = 0.5


class Examiner:
    """Held-out problems of the datasets, spread evenly, with their best known costs.

    Args:
        datasets: What the model is trained on.
        config: How; gives the number of problems and which are held out.
    """

    def __init__(self, datasets: Sequence[PackedDataset], config: TrainConfig) -> None:
        share = -(-config.solve_problems // len(datasets))
        self._tasks: list[tuple[Problem, float]] = []
        self._rels: list[Trajectory] | None = None
        for data in datasets:
            held_out = data.split(config.validation_fraction)[1]
            best = held_out[(np.asarray(data.label)[held_out] == _LABEL_SCP)
                            & (np.asarray(data.rank)[held_out] == 0)]  # fmt: skip
            for row in best[np.linspace(0, len(best) - 1, min(share, len(best))).astype(int)]:
                problem = data.problem(int(data.problem_index[row]))
                self._tasks.append((problem, float(data.cost[row])))

    def examine(self, model: ART) -> dict[str, float]:
        """Refines the model's first candidate for every problem, without REL to fall back on.

        Returns:
            ``val_infeasible``, the share of failures; ``val_excess``, the mean relative cost above
            the best known, a failure counted as 0.5; ``val_iterations`` of those that succeeded.
        """
        excess, iterations = [], []
        for proposals, (problem, cost) in zip(self._propose(model), self._tasks):
            result = solve_scp(problem, proposals[0].trajectory, SCPConfig.quick())
            excess.append(result.cost / cost - 1.0 if result.solved else _FAILURE)
            if result.solved:
                iterations.append(result.iterations)
        failures = len(self._tasks) - len(iterations)
        return {
            "val_infeasible": failures / max(len(self._tasks), 1),
            "val_excess": float(np.mean(excess)) if excess else 0.0,
            "val_iterations": float(np.mean(iterations)) if iterations else float("nan"),
        }

    def _propose(self, model: ART) -> list[list[Proposal]]:
        """The first candidates of all problems at once."""
        problems = [problem for problem, _ in self._tasks]
        if model.config.head != "autoregressive":
            return propose_batch(model, problems)
        if self._rels is None:
            self._rels = [solve_rel(p).trajectory or straight_line(p) for p in problems]
        return propose_batch(model, problems, rels=self._rels)
