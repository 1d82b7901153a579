"""Datasets: generation a core, the share of solver time in it, storage, loading, windows.

``python -m benchmarks.datasets`` makes everything in a temporary folder; with ``--shards FOLDER``
shards that are there are packed and opened, to see large sizes.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.planning import machine, markdown
from freeflyer_datasets import PackedDataset, generate, load_recipe
from freeflyer_datasets.generate import solve_problems
from freeflyer_env.planning import backends

OPEN = """
import resource, sys, time
from freeflyer_datasets import PackedDataset
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
began = time.perf_counter()
data = PackedDataset.open(sys.argv[1])
elapsed = time.perf_counter() - began
memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
print(len(data), elapsed, memory / 1024)
"""


def generation(name: str, n_problems: int) -> dict[str, object]:
    """Problems a second of one core, and how much of the time is inside the solver."""
    recipe, inside = load_recipe(name), 0.0
    solve = backends.PIQPBackend.solve

    def timed(self: backends.PIQPBackend, program: object) -> object:
        nonlocal inside
        began = time.perf_counter()
        found = solve(self, program)  # type: ignore[arg-type]
        inside += time.perf_counter() - began
        return found

    solve_problems(recipe, 0, 2)
    backends.PIQPBackend.solve = timed  # type: ignore[assignment,method-assign]
    try:
        began = time.perf_counter()
        shard = solve_problems(recipe, 0, n_problems)
        elapsed = time.perf_counter() - began
    finally:
        backends.PIQPBackend.solve = solve  # type: ignore[method-assign]
    return {
        "dataset": name,
        "problems/s a core": n_problems / elapsed,
        "trajectories/s a core": shard.n_trajectories / elapsed,
        "inside the solver": f"{inside / elapsed:.0%}",
    }


def storage(folder: Path, n_problems: int) -> dict[str, object]:
    """Writes and reads a Minari dataset of 80-step episodes."""
    import minari

    from freeflyer_datasets.export import export
    from freeflyer_datasets.storage import dataset_folder

    os.environ["MINARI_DATASETS_PATH"] = str(folder / "minari")
    shards = folder / "shards"
    generate(load_recipe("scene-random-v0"), shards, n_problems, progress=False)
    began = time.perf_counter()
    dataset_id = export(shards)
    written = time.perf_counter() - began
    dataset = minari.load_dataset(dataset_id)
    size = (dataset_folder(dataset_id) / "data" / "main_data.hdf5").stat().st_size
    began = time.perf_counter()
    read = sum(len(episode.actions) for episode in dataset)
    elapsed = time.perf_counter() - began
    count = dataset.total_episodes
    assert read == dataset.total_steps
    return {
        "episodes": int(count),
        "kB an episode": size / count / 1e3,
        "check and write, ms": 1e3 * written / count,
        "read through Minari, ms": 1e3 * elapsed / count,
    }


def loading(shards: Path, cache: Path) -> dict[str, object]:
    """Packs shards, opens the pack in a fresh process, draws windows of 100 steps."""
    began = time.perf_counter()
    data = PackedDataset.from_shards(shards, cache=cache)
    packed = time.perf_counter() - began
    opened = subprocess.run(
        [sys.executable, "-c", OPEN, str(data.path)], capture_output=True, text=True, check=True
    )
    count, seconds, memory = (float(word) for word in opened.stdout.split())
    rng = np.random.default_rng(0)
    drawn, began = 0, time.perf_counter()
    while time.perf_counter() - began < 3.0:
        rows = rng.integers(len(data), size=1024)
        data.windows(rows, rng.integers(data.n_steps[rows]), 100)
        drawn += len(rows)
    return {
        "trajectories": int(count),
        "pack, s": packed,
        "open, s": seconds,
        "memory of the process, MB": memory,
        "kB a trajectory": sum(p.stat().st_size for p in data.path.glob("*.npy")) / count / 1e3,
        "windows/s": drawn / (time.perf_counter() - began),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--problems", type=int, default=60)
    parser.add_argument("--shards", type=Path, help="shards to pack instead of the new ones")
    options = parser.parse_args()
    print(machine())
    names = ("scene-random-v0", "time-4-v0")
    print(markdown([generation(name, options.problems) for name in names]))
    with tempfile.TemporaryDirectory() as folder:
        print(f"\n{markdown([storage(Path(folder), options.problems)])}")
        shards = options.shards or Path(folder) / "shards"
        print(f"\n{markdown([loading(shards, Path(folder) / 'packed')])}")
    print(f"\nlargest memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")


if __name__ == "__main__":
    main()
