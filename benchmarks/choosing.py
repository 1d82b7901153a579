"""Which of a model's proposals should go first: the model's score against merits of the path.

``python -m benchmarks.choosing`` refines every proposal of a model for problems of held-out, random
and cluttered scenes, and compares ways to choose one of them beforehand: by the model's score, by
what the path itself says (its cost, its length, its largest impulse), by the cost after one
subproblem of SCP, and by merits fitted to the outcomes of the other half of the problems. It prints
a Markdown table of how many of the chosen were infeasible, the excess cost of the others over the
cheapest outcome, and their iterations; ``--out FILE`` writes it as JSON.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import joblib
import numpy as np

from art_policy.evaluation import evaluation_problems
from art_policy.model import load_model
from art_policy.rollout import propose
from benchmarks.planning import Row, machine, markdown
from freeflyer_env import Problem
from freeflyer_env.planning import SCPConfig, Trajectory, solve_scp
from freeflyer_env.planning.scp import SCPLoop, prepare_scp
from freeflyer_env.robot import FloatArray

SCENES = ("held-out", "random", "clutter")

#: What is known of a proposal before it is refined; the last takes a subproblem.
FEATURES = ("score", "cost", "length", "impulse", "cost after one subproblem")

#: Excess cost that a failure counts as in a fitted merit.
FAILURE = 0.5


def features(problem: Problem, path: Trajectory, score: float) -> list[float]:
    """One proposal's :data:`FEATURES`; lower is meant to be better."""
    implied = Trajectory.from_poses(problem, path.states[:-1, :3], with_controls=True)
    steps = np.diff(path.states[:-1, :2], axis=0)
    loop = prepare_scp(problem, path, SCPConfig())
    assert isinstance(loop, SCPLoop)
    loop.step()
    return [
        -score,
        float(np.abs(implied.controls).sum()),
        float(np.linalg.norm(steps, axis=1).sum()),
        float(np.abs(implied.controls).max()),
        loop.cost if np.isfinite(loop.cost) else 10.0,
    ]


def judge(model_name: str, problem: Problem) -> dict[str, FloatArray]:
    """All proposals of one problem: what is known of them, and what became of them."""
    model = load_model(model_name)
    known, outcomes = [], []
    for proposal in propose(model, problem, model.config.n_hypotheses):
        known.append(features(problem, proposal.trajectory, proposal.score))
        result = solve_scp(problem, proposal.trajectory)
        outcomes.append((result.cost if result.solved else np.inf, result.iterations))
    table = np.array(outcomes)
    return {"features": np.array(known), "cost": table[:, 0], "iterations": table[:, 1]}


def fitted(problems: list[dict[str, FloatArray]], columns: list[int]) -> list[FloatArray]:
    """Predicted excess costs from a ridge regression on the other half of the problems."""
    rows = [_relative(one["features"])[:, columns] for one in problems]
    targets = [
        np.minimum(np.nan_to_num(_excess(one["cost"]), posinf=FAILURE), FAILURE) for one in problems
    ]
    merits = []
    for index, row in enumerate(rows):
        others = [i for i in range(len(rows)) if (i - index) % 2]
        x, y = (
            np.concatenate([rows[i] for i in others]),
            np.concatenate([targets[i] for i in others]),
        )
        x = _with_squares(x)
        weights = np.linalg.solve(x.T @ x + 1e-3 * len(x) * np.eye(x.shape[1]), x.T @ y)
        merits.append(_with_squares(row) @ weights)
    return merits


def _relative(known: FloatArray) -> FloatArray:
    """The features in units of the problem's smallest one; scores are log-probabilities already."""
    least = known.min(axis=0, keepdims=True)
    scale = np.where(least > 1e-9, least, 1.0)
    scale[:, 0] = 1.0
    return (known - least) / scale


def _with_squares(x: FloatArray) -> FloatArray:
    clipped = np.clip(x, 0.0, 3.0)
    return np.column_stack([np.ones(len(x)), clipped, clipped**2, np.minimum(clipped, 0.1)])


def _excess(cost: FloatArray) -> FloatArray:
    least = cost.min()
    return cost / least - 1.0 if np.isfinite(least) else np.full_like(cost, np.inf)


def compare(problems: list[dict[str, FloatArray]]) -> dict[str, str]:
    """What each way to choose leads to: infeasible, excess cost, iterations."""
    ways = {
        f"least {name}": [p["features"][:, i] for p in problems] for i, name in enumerate(FEATURES)
    }
    ways["best score"] = ways.pop("least score")
    ways["fitted to score and path"] = fitted(problems, [0, 1, 2, 3])
    ways["fitted to all"] = fitted(problems, [0, 1, 2, 3, 4])
    ways["the cheapest outcome"] = [p["cost"] for p in problems]
    found = {}
    for name in ("best score", *(way for way in ways if way != "best score")):
        chosen = [int(np.argmin(merit)) for merit in ways[name]]
        costs = np.array([p["cost"][i] for p, i in zip(problems, chosen)])
        excess = np.array([_excess(p["cost"])[i] for p, i in zip(problems, chosen)])
        solved = np.isfinite(costs)
        iterations = [p["iterations"][i] for p, i, ok in zip(problems, chosen, solved) if ok]
        found[name] = (
            f"{1.0 - solved.mean():.1%}, {excess[solved].mean():.2%}, {np.mean(iterations):.2f}"
        )
    return found


def main() -> None:
    """Refines everything, compares, prints."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", default="art-general")
    parser.add_argument("--problems", type=int, default=300, help="of each kind of scene")
    parser.add_argument("--workers", type=int, default=-1)
    parser.add_argument("--out", type=Path, help="JSON file")
    options = parser.parse_args()
    if options.problems < 4:
        parser.error(f"--problems must be at least 4, got {options.problems}")
    table: dict[str, Row] = {}
    for scenes in SCENES:
        jobs = (
            joblib.delayed(judge)(options.model, problem)
            for _, _, problem in evaluation_problems(options.problems, scenes, seed=13)
        )
        with joblib.parallel_config(backend="loky", inner_max_num_threads=1):
            found = compare(joblib.Parallel(n_jobs=options.workers)(jobs))
        for name, text in found.items():
            table.setdefault(name, {"chosen by": name})[scenes] = text
    rows = list(table.values())
    print(markdown(rows))
    if options.out:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        data = {"machine": machine(), "model": options.model, "problems": options.problems}
        data["rows"] = rows
        options.out.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
