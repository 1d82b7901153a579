"""From a model to warm starts, whichever head it has."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from art_policy.multi_hypothesis import MultiHypothesis, interpolation_matrix
from art_policy.sequence import ProblemBatch
from freeflyer_env.planning.multistart import push_out
from freeflyer_env.planning.trajectory import Trajectory
from freeflyer_env.robot import FloatArray
from freeflyer_env.scenario import Problem

if TYPE_CHECKING:
    from art_policy.model import ART


@dataclass(frozen=True, eq=False)
class Proposal:
    """A warm start that a model proposes.

    Attributes:
        trajectory: The warm start; it has the problem's number of steps.
        score: The model's opinion, higher is better: the log-probability of leading to the best
            optimum (multi-hypothesis), or minus the cost in m/s (autoregressive).
    """

    trajectory: Trajectory
    score: float


def propose(
    model: ART, problem: Problem, n_candidates: int = 1, rel: Trajectory | None = None
) -> list[Proposal]:
    """Warm starts for one problem, best first.

    Args:
        model: A trained model.
        problem: What to plan.
        n_candidates: Most proposals; a multi-hypothesis model has ``n_hypotheses``.
        rel: REL's trajectory; an autoregressive model needs its cost as the reward-to-go.
    """
    return propose_batch(model, [problem], n_candidates, None if rel is None else [rel])[0]


def propose_batch(
    model: ART,
    problems: Sequence[Problem],
    n_candidates: int = 1,
    rels: Sequence[Trajectory] | None = None,
) -> list[list[Proposal]]:
    """As :func:`propose`, for many problems in one pass.

    Raises:
        ValueError: If ``n_candidates`` is not positive.
    """
    if n_candidates < 1:
        raise ValueError(f"n_candidates must be at least 1, got {n_candidates}.")
    if not problems:
        return []
    return _hypotheses(model, problems, n_candidates)


@torch.inference_mode()
def _hypotheses(model: ART, problems: Sequence[Problem], n_candidates: int) -> list[list[Proposal]]:
    config = model.config
    batch = ProblemBatch.from_problems(problems)
    # The models are trained on problems whose goal is to the right; others are looked at in a mirror.
    to_left = batch.goal[:, 0] < batch.start[:, 0]
    mirrored = batch.mirrored(to_left, config.table[0], axis=0) if bool(to_left.any()) else batch
    knots, scores = model(mirrored.to(model.device))
    scores, order = scores.log_softmax(dim=1).topk(min(n_candidates, config.n_hypotheses), dim=1)
    knots = knots.gather(1, order[..., None, None].expand(-1, -1, *knots.shape[2:])).cpu()
    knots[to_left] *= knots.new_tensor([-1.0, 1.0, -1.0])
    return [
        [
            Proposal(Trajectory.from_poses(problem, poses), score)
            for poses, score in zip(decode_poses(problem, deviation.numpy()), values)
        ]
        for problem, deviation, values in zip(problems, knots, scores.tolist())
    ]


def decode_poses(problem: Problem, knots: FloatArray) -> FloatArray:
    """Poses at the nodes from deviations at the knots, on the table and out of the keep-out discs.

    Args:
        problem: Gives the ends, the number of nodes and the scene.
        knots: ``(H, n_knots, 3)`` deviations from the straight line in m, m, rad.

    Returns:
        ``(H, N, 3)`` poses ``(r_x, r_y, psi)``; the ends are the problem's.
    """
    matrix = interpolation_matrix(knots.shape[1], problem.n_steps).numpy()
    share = np.linspace(0.0, 1.0, problem.n_steps)[:, None]
    line = (1.0 - share) * problem.start[:3] + share * problem.goal[:3]
    poses = line + matrix @ knots.astype(np.float64)  # (N, 3) + (H, N, 3)
    poses[..., :2] = push_out(problem.scenario, poses[..., :2])
    poses[:, 0], poses[:, -1] = problem.start[:3], problem.goal[:3]
    return poses
