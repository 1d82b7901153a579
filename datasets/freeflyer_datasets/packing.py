"""Packing: writes the ``.npy`` files of a packed dataset, a chunk of problems at a time."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from freeflyer_datasets.shards import Shard
from freeflyer_env.scenario import Scenario

#: Version of the packed form; a cache of another version is made again.
PACKED_VERSION = 1

#: Names of the ``.npy`` files.
ARRAYS = (
    *("start", "goal", "obstacles", "final_time", "c_rel", "rel_cost"),
    *("problem_index", "label", "rank", "cost", "offsets", "controls"),
)


@dataclass(frozen=True, eq=False)
class Chunk:
    """Some problems with their trajectories; ``problem_index`` counts from the chunk's first."""

    start: NDArray[Any]
    goal: NDArray[Any]
    obstacles: NDArray[Any]
    final_time: NDArray[Any]
    c_rel: NDArray[Any]
    rel_cost: NDArray[Any]
    problem_index: NDArray[Any]
    label: NDArray[Any]
    rank: NDArray[Any]
    cost: NDArray[Any]
    lengths: NDArray[Any]
    controls: NDArray[Any]


_PER_PROBLEM = ("start", "goal", "obstacles", "final_time", "c_rel", "rel_cost")
_DTYPES = {
    **dict.fromkeys(("start", "goal", "obstacles", "final_time", "rel_cost"), np.float64),
    **dict.fromkeys(("c_rel", "problem_index"), np.int32),
    **dict.fromkeys(("label", "rank"), np.uint8),
    "cost": np.float32,
    "lengths": np.int64,
}


def chunk_of_shard(shard: Shard) -> Chunk:
    """The problems of a shard that have trajectories."""
    kept = np.unique(shard.problem)
    return Chunk(
        start=shard.start[kept],
        goal=shard.goal[kept],
        obstacles=shard.obstacles[kept],
        final_time=shard.final_time[kept],
        c_rel=shard.c_rel[kept],
        rel_cost=shard.rel_cost[kept],
        problem_index=np.searchsorted(kept, shard.problem),
        label=shard.label,
        rank=shard.rank,
        cost=shard.cost,
        lengths=np.diff(shard.offsets),
        controls=shard.controls,
    )


def chunks_of_episodes(episodes: Iterator[dict[str, Any]], size: int = 2000) -> Iterator[Chunk]:
    """Groups episodes, whose problems' first one is REL, into chunks of about ``size``."""
    block: list[dict[str, Any]] = []
    for episode in episodes:
        is_new = not block or episode["problem_index"] != block[-1]["problem_index"]
        if is_new and len(block) >= size:
            yield _chunk_of_episodes(block)
            block = []
        block.append(episode)
    if block:
        yield _chunk_of_episodes(block)


def _chunk_of_episodes(block: list[dict[str, Any]]) -> Chunk:
    numbers = np.array([episode["problem_index"] for episode in block])
    is_first = np.diff(numbers, prepend=-1) != 0
    firsts = [episode for episode, first in zip(block, is_first) if first]
    columns = {name: np.array([row[name] for row in firsts]) for name in _PER_PROBLEM}
    columns |= {name: np.array([row[name] for row in block]) for name in ("label", "rank", "cost")}
    return Chunk(
        **columns,
        problem_index=np.cumsum(is_first) - 1,
        lengths=np.array([len(episode["controls"]) for episode in block]),
        controls=np.concatenate([episode["controls"] for episode in block]),
    )


def write_pack(folder: Path, dataset_id: str, source: str, chunks: Iterator[Chunk]) -> None:
    """Writes the files of a packed dataset into an empty folder.

    Args:
        folder: Where to.
        dataset_id: Minari id of the dataset.
        source: What the pack was made from, to be compared later.
        chunks: The problems and trajectories, in order.

    Raises:
        ValueError: If there are no trajectories.
    """
    columns: dict[str, list[NDArray[Any]]] = {name: [] for name in _DTYPES}
    n_problems, n_controls = 0, 0
    with open(folder / "controls.npy", "wb") as file:
        _write_header(file, 0)
        for chunk in chunks:
            for item in fields(chunk):
                if item.name != "controls":
                    columns[item.name].append(getattr(chunk, item.name))
            columns["problem_index"][-1] = chunk.problem_index + n_problems
            n_problems += len(chunk.start)
            n_controls += len(chunk.controls)
            file.write(np.ascontiguousarray(chunk.controls, dtype="<f4").tobytes())
        file.seek(0)
        _write_header(file, n_controls)
    if not n_controls:
        raise ValueError(f"{dataset_id} has no trajectories to pack.")
    arrays = {name: np.concatenate(parts).astype(_DTYPES[name]) for name, parts in columns.items()}
    arrays["offsets"] = np.concatenate([[0], np.cumsum(arrays.pop("lengths"))]).astype(np.int64)
    for name, array in arrays.items():
        np.save(folder / f"{name}.npy", array)
    meta = {
        "version": PACKED_VERSION,
        "dataset_id": dataset_id,
        "dt": Scenario().dt,
        "source": source,
        "n_problems": n_problems,
        "n_trajectories": len(arrays["label"]),
        "files": {name: describe_file(folder / f"{name}.npy") for name in ARRAYS},
    }
    (folder / "meta.json").write_text(json.dumps(meta, indent=2) + "\n", encoding="utf-8")


def _write_header(file: Any, n_rows: int) -> None:
    """The ``.npy`` header of ``(n_rows, 3)`` float32; NumPy pads it, so it can be overwritten."""
    header = {"descr": "<f4", "fortran_order": False, "shape": (n_rows, 3)}
    np.lib.format.write_array_header_1_0(file, header)


def describe_file(path: Path) -> dict[str, Any]:
    """Size and checksum of a file."""
    with open(path, "rb") as file:
        return {
            "bytes": path.stat().st_size,
            "sha256": hashlib.file_digest(file, "sha256").hexdigest(),
        }
