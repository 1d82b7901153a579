"""From a model to warm starts, whichever head it has."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from art_policy.generation import SteppedModel, generate
from art_policy.multi_hypothesis import interpolation_matrix
from art_policy.sequence import ProblemBatch
from freeflyer_env.constraints import nodes_inside
from freeflyer_env.planning.homotopy import push_out
from freeflyer_env.planning.trajectory import Trajectory
from freeflyer_env.robot import FloatArray
from freeflyer_env.scenario import Problem

if TYPE_CHECKING:
    from art_policy.deployment import OnnxART
    from art_policy.model import ART


@dataclass(frozen=True, eq=False)
class Proposal:
    """A warm start that a model proposes.

    Attributes:
        trajectory: The warm start; it has the problem's number of steps.
        score: Higher is better: the log-probability, in the model's opinion, of leading to the best
            optimum (multi-hypothesis), or minus the number of nodes inside keep-out discs and the
            cost in m/s (autoregressive).
    """

    trajectory: Trajectory
    score: float


def propose(
    model: ART | OnnxART,
    problem: Problem,
    n_candidates: int = 1,
    rel: Trajectory | None = None,
    guides: Sequence[Trajectory] | None = None,
) -> list[Proposal]:
    """Warm starts for one problem, best first.

    Args:
        model: A trained model.
        problem: What to plan.
        n_candidates: Most proposals; a multi-hypothesis model has ``n_hypotheses``.
        rel: REL's trajectory; an autoregressive model needs its cost as the reward-to-go.
        guides: Other warm starts, those of a multi-hypothesis model for example. An autoregressive
            model goes on where their first 16 steps lead, one sequence for each guide, instead
            of choosing its own way.
    """
    rels = None if rel is None else [rel]
    every_guide = None if guides is None else [guides]
    return propose_batch(model, [problem], n_candidates, rels, every_guide)[0]


def propose_batch(
    model: ART | OnnxART,
    problems: Sequence[Problem],
    n_candidates: int = 1,
    rels: Sequence[Trajectory] | None = None,
    guides: Sequence[Sequence[Trajectory]] | None = None,
) -> list[list[Proposal]]:
    """As :func:`propose`, for many problems in one pass.

    Raises:
        ValueError: If ``n_candidates`` is not positive, REL's trajectories are missing where the
            model needs them, or there are guides for a model that proposes whole paths.
    """
    if n_candidates < 1:
        raise ValueError(f"n_candidates must be at least 1, got {n_candidates}.")
    if not problems:
        return []
    if model.config.head == "autoregressive":
        if rels is None or len(rels) != len(problems):
            raise ValueError(
                "An autoregressive model needs REL's trajectory of each problem for its "
                "reward-to-go; pass rel=solve_rel(problem).trajectory."
            )
        costs = [rel.cost for rel in rels]
        if guides:
            return _guided(model, problems, n_candidates, costs, guides)
        return _sequences(model, problems, n_candidates, costs)
    if guides:
        raise ValueError("Guides are for autoregressive models; this one proposes whole paths.")
    return _hypotheses(model, problems, n_candidates)


@torch.inference_mode()
def _hypotheses(
    model: ART | OnnxART, problems: Sequence[Problem], n_candidates: int
) -> list[list[Proposal]]:
    config = model.config
    batch = ProblemBatch.from_problems(problems)
    # In training the goal is to the right; other problems are looked at in a mirror.
    to_left = batch.goal[:, 0] < batch.start[:, 0]
    mirrored = batch.mirrored(to_left, config.table[0], axis=0) if bool(to_left.any()) else batch
    knots, scores = model(mirrored.to(model.device))
    scores, order = scores.log_softmax(dim=1).topk(min(n_candidates, config.n_hypotheses), dim=1)
    knots = knots.gather(1, order[..., None, None].expand(-1, -1, *knots.shape[2:])).cpu()
    knots[to_left] *= knots.new_tensor([-1.0, 1.0, -1.0])
    return [
        [
            Proposal(Trajectory.from_poses(problem, poses), score)
            for poses, score in zip(
                decode_poses(problem, deviation.numpy(), config.knot_spacing), values
            )
        ]
        for problem, deviation, values in zip(problems, knots, scores.tolist())
    ]


def decode_poses(problem: Problem, knots: FloatArray, spacing: str = "ends") -> FloatArray:
    """Poses at the nodes from deviations at the knots, on the table and out of the keep-out discs.

    Args:
        problem: Gives the ends, the number of nodes and the scene.
        knots: ``(H, n_knots, 3)`` deviations from the straight line in m, m, rad.
        spacing: Of the knots, as in :class:`ARTConfig`.

    Returns:
        ``(H, N, 3)`` poses ``(r_x, r_y, psi)``; the ends are the problem's.
    """
    matrix = interpolation_matrix(knots.shape[1], problem.n_steps, spacing).numpy()
    share = np.linspace(0.0, 1.0, problem.n_steps)[:, None]
    line = (1.0 - share) * problem.start[:3] + share * problem.goal[:3]
    poses = line + matrix @ knots.astype(np.float64)  # (N, 3) + (H, N, 3)
    times = problem.node_times[:-1]
    poses[..., :2] = push_out(problem.scenario, poses[..., :2], times=times)
    poses[:, 0], poses[:, -1] = problem.start[:3], problem.goal[:3]
    return poses


#: Candidates of an autoregressive model with one mode ask for REL's cost times 1, 1.05, 1.1 ...:
#: REL's cost is a lower bound, which the obstacles may put out of reach.
_COST_STEP = 0.05

#: One with several modes is sampled at least so often, and asks for REL's cost each time: the first
#: impulse decides on which side the obstacles are passed, and which samples pass them is seen at
#: once.
_N_SAMPLES = 16

#: Steps of a guide that a model is made to begin with.
_PROMPT = 16

#: A node so deep in a keep-out disc (m) counts as inside.
_INSIDE = 1e-3


def _sequences(
    model: SteppedModel, problems: Sequence[Problem], n_candidates: int, rel_costs: Sequence[float]
) -> list[list[Proposal]]:
    several = model.config.n_modes > 1
    count = max(n_candidates, _N_SAMPLES) if several else n_candidates
    factors = np.ones(count) if several else 1.0 + _COST_STEP * np.arange(count)
    tasks = [problem for problem in problems for _ in factors]
    returns = -np.outer(rel_costs, factors).ravel()
    draws = list(range(count)) * len(problems)
    found = generate(model, tasks, returns, draws=draws)
    return _ranked(tasks, found, [count] * len(problems), n_candidates)


def _guided(
    model: SteppedModel,
    problems: Sequence[Problem],
    n_candidates: int,
    rel_costs: Sequence[float],
    guides: Sequence[Sequence[Trajectory]],
) -> list[list[Proposal]]:
    counts = [len(several) for several in guides]
    tasks = [problem for problem, count in zip(problems, counts) for _ in range(count)]
    prompts = [
        Trajectory.from_poses(problem, guide.states[:-1, :3], with_controls=True).controls[:_PROMPT]
        for problem, several in zip(problems, guides)
        for guide in several
    ]
    found = generate(model, tasks, -np.repeat(rel_costs, counts), prompts=prompts)
    return _ranked(tasks, found, counts, n_candidates)


def _ranked(
    tasks: Sequence[Problem],
    sequences: Sequence[FloatArray],
    counts: Sequence[int],
    n_candidates: int,
) -> list[list[Proposal]]:
    """Proposals of several problems, each with a number of sequences, best first."""
    proposals = iter(
        [
            _judge(problem, Trajectory.from_controls(problem, controls).landed(problem))
            for problem, controls in zip(tasks, sequences)
        ]
    )
    groups = [[next(proposals) for _ in range(count)] for count in counts]
    return [sorted(group, key=lambda p: -p.score)[:n_candidates] for group in groups]


def _judge(problem: Problem, trajectory: Trajectory) -> Proposal:
    """Scores a generated trajectory by its nodes inside keep-out discs, then by its cost."""
    inside = nodes_inside(problem, trajectory.states, _INSIDE)
    return Proposal(trajectory, -float(inside + min(trajectory.cost, 1.0)))
