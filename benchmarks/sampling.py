"""Ways to get a warm start out of an autoregressive model, compared on the same problems.

``python -m benchmarks.sampling`` lets a model generate once, or several times and takes the
sequence with the fewest nodes inside obstacles; lets it go on where the hypotheses of another model
lead; and ends the sequences at the goal in several ways. Every warm start is refined by SCP with
hard keep-out. ``--onnx`` adds the exported model, which answers the same, but sooner. ``--out
FILE`` writes the JSON of ``freeflyer evaluate``.
"""

from __future__ import annotations

import argparse
import functools
import importlib
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import joblib
import numpy as np
import torch

from art_policy.deployment import OnnxART, export_onnx
from art_policy.evaluation import evaluation_problems, markdown_table
from art_policy.evaluation.protocol import Outcome, ProblemRecord
from art_policy.evaluation.statistics import report, save_report
from art_policy.generation import generate
from art_policy.model import ART, load_model
from art_policy.rollout import propose
from freeflyer_env import Problem
from freeflyer_env.constraints import nodes_inside
from freeflyer_env.planning import SCPConfig, Trajectory, solve_multistart, solve_rel, solve_scp

#: Samples of which the best goes first.
COUNTS = (1, 2, 4, 8, 16)

#: Controls at the end that may change for a sequence to end at the goal, otherwise all may.
LANDINGS = {"left where they end": 0, "the last 8 steered": 8, "the last 20 steered": 20}


def sampled(model: ART | OnnxART, problem: Problem, rel: Trajectory, count: int) -> Trajectory:
    """The best of several sequences, as generated: it may miss the goal."""
    returns = np.full(count, -rel.cost)
    found = generate(model, [problem] * count, returns, draws=list(range(count)))
    paths = [Trajectory.from_controls(problem, controls) for controls in found]
    landed = [path.landed(problem) for path in paths]
    # Judged as the planner judges them: where they would be once they end at the goal.
    merit = [nodes_inside(problem, one.states, 1e-3) + min(one.cost, 1.0) for one in landed]
    return paths[int(np.argmin(merit))]


def landed(problem: Problem, path: Trajectory, last: int | None) -> Trajectory:
    """The path with its last controls, or all, changed so that it ends at the goal."""
    return path if last == 0 else path.landed(problem, last)


@functools.lru_cache(maxsize=4)
def _model(name: str) -> ART | OnnxART:
    torch.set_num_threads(1)
    return load_model(name)


def measure(
    name: str, guide: str, exported: str | None, scene: str, index: int, problem: Problem
) -> ProblemRecord | None:
    """All ways on one problem."""
    rel = solve_rel(problem)
    line = rel.trajectory
    if line is None:
        return None
    model, other = _model(name), _model(guide)
    ways: dict[str, Callable[[], Trajectory]] = {}

    def add(label: str, which: ART | OnnxART, count: int, last: int | None = None) -> None:
        ways[label] = lambda: landed(problem, sampled(which, problem, line, count), last)

    for count in COUNTS:
        add(f"{count} sample{'s' * (count > 1)}", model, count)
    if exported:
        for count in (1, 8):
            add(f"{count} sample{'s' * (count > 1)}, ONNX", _model(exported), count)
    for label, last in LANDINGS.items():
        add(f"8 samples, {label}", model, 8, last)
    for count in (1, 4):

        def guided(count: int = count) -> Trajectory:
            guides = [one.trajectory for one in propose(other, problem, count)]
            return propose(model, problem, 1, line, guides)[0].trajectory

        ways[f"after the opening of {count} hypothes{'e' if count > 1 else 'i'}s"] = guided
    outcomes = {"REL": _refined(problem, line, rel.solve_time)}
    for label, way in ways.items():
        began = time.perf_counter()
        warm_start = way()
        elapsed = time.perf_counter() - began
        outcomes[label] = _refined(problem, warm_start, rel.solve_time + elapsed)
    starts = solve_multistart(problem, 8).best
    costs = [outcome.cost for outcome in outcomes.values()]
    best = min([*costs, starts.cost if starts.solved else np.inf])
    size = len(problem.scenario.obstacles)
    c_rel = int(line.violations(problem).sum())
    return ProblemRecord(scene, index, problem.final_time, size, c_rel, rel.cost, best, outcomes)


def _refined(problem: Problem, warm_start: Trajectory, elapsed: float) -> Outcome:
    began = time.perf_counter()
    result = solve_scp(problem, warm_start, SCPConfig())
    cost = result.cost if result.solved else np.inf
    return Outcome(result.solved, cost, result.iterations, elapsed + time.perf_counter() - began)


def main() -> None:
    """Measures, prints, writes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", default="art-rs")
    parser.add_argument("--guide", default="art-scene-random", help="proposes the hypotheses")
    parser.add_argument("--problems", type=int, default=300)
    parser.add_argument("--scenes", default="held-out")
    parser.add_argument("--final-time", type=float, nargs="+", default=[40.0])
    parser.add_argument("--onnx", action="store_true", help="also the exported model")
    parser.add_argument("--workers", type=int, default=-1)
    parser.add_argument("--out", type=Path, help="JSON file")
    options = parser.parse_args()
    problems = evaluation_problems(options.problems, options.scenes, options.final_time, seed=19)
    with tempfile.TemporaryDirectory() as folder:
        exported = None
        if options.onnx:
            exported = str(Path(folder) / "model.onnx")
            export_onnx(ART.from_pretrained(options.model), exported)
        # By the module's name, which a worker can import; of __main__ it would know nothing.
        run = joblib.delayed(importlib.import_module("benchmarks.sampling").measure)
        jobs = (run(options.model, options.guide, exported, *problem) for problem in problems)
        with joblib.parallel_config(backend="loky", inner_max_num_threads=1):
            found = joblib.Parallel(n_jobs=options.workers)(jobs)
    command = f"python -m benchmarks.sampling --model {options.model} --problems {options.problems}"
    command += f" --guide {options.guide} --scenes {options.scenes}" + " --onnx" * options.onnx
    command += " --final-time " + " ".join(f"{value:g}" for value in options.final_time)
    data = report([record for record in found if record], options.model, command)
    print(markdown_table(data["groups"]["all"]))
    if options.out:
        save_report({**data, "records": []}, options.out)


if __name__ == "__main__":
    main()
