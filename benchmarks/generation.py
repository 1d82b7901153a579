"""How long an autoregressive model takes for a trajectory, against planning it without one.

``python -m benchmarks.generation`` generates trajectories of 80 steps with the small variant and
with one of the paper's size, in every way that the package runs them, on one thread and for one
problem after the other: the time does not depend on what the weights are. ``--out FILE`` writes the
table as JSON.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from art_policy.deployment import OnnxART, export_onnx
from art_policy.generation import SteppedModel, generate
from art_policy.layers import ARTConfig
from art_policy.model import ART
from benchmarks.planning import Row, draw, machine, markdown, median_ms
from freeflyer_env import Problem
from freeflyer_env.planning import solve_rel, solve_scp

SIZES = {"small": ARTConfig.small(), "paper size": ARTConfig.paper()}


def ways(model: ART, folder: Path) -> dict[str, Callable[[Problem], object]]:
    """Everything that runs the model, by name."""

    def run(net: SteppedModel, count: int, use_cache: bool = True) -> Callable[[Problem], object]:
        def work(problem: Problem) -> object:
            returns, draws = np.full(count, -0.2), list(range(count))
            return generate(net, [problem] * count, returns, draws=draws, use_cache=use_cache)

        return work

    exported = {
        name: OnnxART(export_onnx(model, folder / f"{name}.onnx", int8=name == "INT8"))
        for name in ("ONNX", "INT8")
    }
    found = {"PyTorch, no cache": run(model, 1, use_cache=False), "PyTorch": run(model, 1)}
    found |= {name: run(net, 1) for name, net in exported.items()}
    found["PyTorch, 8 at once"] = run(model, 8)
    return found | {f"{name}, 8 at once": run(net, 8) for name, net in exported.items()}


def main() -> None:
    """Measures, prints, writes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--problems", type=int, default=12)
    parser.add_argument("--out", type=Path, help="JSON file")
    options = parser.parse_args()
    torch.set_num_threads(1)
    items = [(problem,) for problem in draw(options.problems)]
    baseline = median_ms(lambda problem: solve_scp(problem, solve_rel(problem).trajectory), items)
    rows: list[Row] = [
        {"model": "none", "million parameters": 0.0, "run by": "(REL + SCP)",
         "ms a trajectory": baseline, "against REL + SCP": 1.0}
    ]  # fmt: skip
    for name, config in SIZES.items():
        model = ART(config).eval()
        with tempfile.TemporaryDirectory() as folder:
            for way, work in ways(model, Path(folder)).items():
                elapsed = median_ms(work, items)
                rows.append(
                    {
                        "model": name,
                        "million parameters": model.num_parameters / 1e6,
                        "run by": way,
                        "ms a trajectory": elapsed,
                        "against REL + SCP": elapsed / baseline,
                    }
                )
    print(f"{machine()}\n\n{markdown(rows)}")
    if options.out:
        command = f"python -m benchmarks.generation --problems {options.problems}"
        data = {"command": command, "machine": machine(), "rows": rows}
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(json.dumps(data, indent=1) + "\n")


if __name__ == "__main__":
    main()
