"""Train a small ART from scratch on a sample of a dataset, and warm-start new problems with it.

A real model takes about a hundred thousand problems and an hour; this one shows every step in less
than a minute.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

import numpy as np

from art_policy.layers import ARTConfig
from art_policy.rollout import propose
from art_policy.train import TrainConfig, train
from freeflyer_datasets import load_sample
from freeflyer_env import HELD_OUT_SCENES, sample_problem
from freeflyer_env.planning import solve_rel, solve_scp


def main() -> None:
    dataset = load_sample("scene-random-v0")
    with tempfile.TemporaryDirectory() as folder:
        print(f"{dataset.n_problems} problems, {len(dataset)} trajectories")
        config = TrainConfig(max_steps=100, batch_size=64, learning_rate=2e-3, ema_decay=0.98)
        out = Path(folder, "model")
        model = train(dataset, ARTConfig(width=96, n_layers=3, n_heads=3), config, out)
        last = json.loads((out / "log.jsonl").read_text().splitlines()[-1])
        print(f"{model.num_parameters} parameters, validation: {last}")

    rng = np.random.default_rng(1)
    for number in range(5):
        problem = sample_problem(rng, HELD_OUT_SCENES[number % 3])
        rel = solve_scp(problem, solve_rel(problem).trajectory)
        proposal = propose(model, problem)[0]
        art = solve_scp(problem, proposal.trajectory)
        print(
            f"problem {number}: from REL {rel.cost:.4f} m/s in {rel.iterations} iterations, "
            f"from ART {art.cost:.4f} m/s in {art.iterations}"
        )


if __name__ == "__main__":
    main()
