"""What the number of SCP iterations depends on: the warm start, the trust region, the tolerance.

``python -m benchmarks.iterations`` solves held-out problems from warm starts of growing fidelity,
from a model's proposal to the solution itself, with the paper's tolerance of the cost and with that
of ``SCPConfig.quick``, then REL's and the proposal in other trust regions, and prints a Markdown
table; ``--out FILE`` writes it as JSON. Two is the least: SCP stops when two solutions agree.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from art_policy.evaluation import evaluation_problems
from art_policy.model import load_model
from art_policy.multi_hypothesis import interpolation_matrix
from art_policy.rollout import decode_poses, propose
from benchmarks.planning import Row, machine, markdown
from freeflyer_env import Problem
from freeflyer_env.planning import SCPConfig, Trajectory, solve_rel, solve_scp
from freeflyer_env.robot import FloatArray

KNOTS = [(20, "uniform"), (20, "ends"), (40, "uniform"), (40, "ends")]
#: First half-width of the trust region in m: the paper's, and others.
FIRST, TRUST_REGIONS = SCPConfig().trust_region_start, (3.0, 1.0, 0.3)
SETTINGS = {"paper": SCPConfig(), "quick": SCPConfig.quick()}


def warm_starts(
    problem: Problem, proposal: Trajectory, solution: Trajectory, rel: Trajectory
) -> Iterator[tuple[str, Trajectory]]:
    """Warm starts by name, each from what a model proposed or from the solution that SCP found."""
    proposed, solved = proposal.states[:-1, :3], solution.states[:-1, :3]
    yield "REL", rel
    yield "proposal", proposal
    yield "proposal, controls it implies", with_controls(problem, proposed)
    yield "proposal, headings of the solution", mixed(problem, proposed, solved)
    yield "proposal, positions of the solution", mixed(problem, solved, proposed)
    for n_knots, spacing in KNOTS:
        poses = through_knots(problem, solved, n_knots, spacing)
        name = f"solution through {n_knots} knots, spacing: {spacing}"
        yield name, Trajectory.from_poses(problem, poses)
    yield "the last, controls it implies", with_controls(problem, poses)
    yield "solution, its controls left out", Trajectory.from_poses(problem, solved)
    yield "solution", solution


def with_controls(problem: Problem, poses: FloatArray) -> Trajectory:
    return Trajectory.from_poses(problem, poses, with_controls=True)


def mixed(problem: Problem, positions: FloatArray, headings: FloatArray) -> Trajectory:
    return Trajectory.from_poses(problem, np.column_stack([positions[:, :2], headings[:, 2]]))


def through_knots(problem: Problem, poses: FloatArray, n_knots: int, spacing: str) -> FloatArray:
    """The poses ``(N, 3)`` as a model with so many knots could say them at best."""
    share = np.linspace(0.0, 1.0, len(poses))[:, None]
    line = (1.0 - share) * problem.start[:3] + share * problem.goal[:3]
    matrix = interpolation_matrix(n_knots, len(poses), spacing).numpy()
    knots = np.linalg.lstsq(matrix, poses - line, rcond=None)[0]
    return decode_poses(problem, knots[None], spacing)[0]


def measure(model_name: str, n_problems: int) -> list[Row]:
    """One row for each kind of warm start: iterations and failures under both tolerances."""
    model = load_model(model_name)
    found: dict[str, dict[str, list[float]]] = {}
    for _, _, problem in evaluation_problems(n_problems, seed=11):
        rel = solve_rel(problem).trajectory
        proposal = propose(model, problem)[0].trajectory
        solution = solve_scp(problem, proposal).trajectory
        if rel is None or solution is None:
            continue
        cases = [(*case, FIRST) for case in warm_starts(problem, proposal, solution, rel)]
        for first in TRUST_REGIONS:
            cases.append((f"REL, trust region from {first:g} m", rel, first))
            cases.append((f"proposal, trust region from {first:g} m", proposal, first))
        for name, warm_start, first in cases:
            row = found.setdefault(name, {})
            for setting, config in SETTINGS.items():
                config = replace(config, trust_region_start=first)
                result = solve_scp(problem, warm_start, config)
                row.setdefault(setting, []).append(result.iterations if result.solved else np.nan)
    return [
        {
            "warm start": name,
            "problems": len(row["paper"]),
            **{f"iterations, {setting}": float(np.nanmean(row[setting])) for setting in SETTINGS},
            "failures": int(np.isnan(row["paper"]).sum()),
        }
        for name, row in found.items()
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", default="art-general")
    parser.add_argument("--problems", type=int, default=150)
    parser.add_argument("--out", type=Path, help="JSON file")
    options = parser.parse_args()
    if options.problems < 1:
        parser.error(f"--problems must be at least 1, got {options.problems}")
    rows = measure(options.model, options.problems)
    print(markdown(rows))
    if options.out:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        data = {"machine": machine(), "model": options.model, "rows": rows}
        options.out.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
