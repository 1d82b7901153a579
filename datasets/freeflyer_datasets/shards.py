"""Shards: the files that generation writes, each a fixed run of problems with their trajectories.

A shard is one ``.npz`` file that carries its own checksum. It is written under another name and
renamed, so a shard that exists is complete, and one that was damaged later is recognised.
"""

from __future__ import annotations

import hashlib
import os
import zipfile
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from freeflyer_env.scenario import Obstacles, Problem, Scenario

#: Label of a trajectory: the relaxed solution, without keep-out, or an SCP optimum.
LABEL_REL, LABEL_SCP = 0, 1

_FORMAT = "freeflyer-shard-1"
_DAMAGE = (OSError, KeyError, EOFError, TypeError, ValueError, zipfile.BadZipFile, zlib.error)


class ShardError(ValueError):
    """A shard file is damaged, or is not a shard."""


@dataclass(frozen=True, eq=False)
class Shard:
    """Problems ``first ... first + P - 1`` of a recipe and their ``T`` trajectories.

    Attributes:
        fingerprint: :attr:`Recipe.fingerprint` of the recipe.
        first: Index of the first problem.
        start: ``(P, 6)`` start states.
        goal: ``(P, 6)`` goal states.
        obstacles: ``(P, M, 3)`` rows (x, y, radius) in m, zero-padded; ``(P, M, 5)`` with
            velocities (v_x, v_y) in m/s if the recipe's obstacles move.
        final_time: ``(P,)`` in s.
        c_rel: ``(P,)`` nodes of the relaxed trajectory inside a keep-out disc; -1 if it failed.
        rel_cost: ``(P,)`` cost of the relaxed trajectory in m/s; NaN if it failed.
        failure: ``(P,)`` why a problem has no trajectories, else empty.
        problem: ``(T,)`` index of each trajectory's problem within the shard, ascending.
        label: ``(T,)`` :data:`LABEL_REL` or :data:`LABEL_SCP`.
        rank: ``(T,)`` 0 for the cheapest optimum of its problem, 1 for the next; REL has 0.
        status: ``(T,)`` value of the :class:`~freeflyer_env.planning.SCPStatus`.
        iterations: ``(T,)`` subproblems solved.
        start_number: ``(T,)`` which warm start led there, 0 being REL; -1 for the REL trajectory.
        cost: ``(T,)`` cost of the stored (float32) controls in m/s.
        violation: ``(T,)`` largest violation of a constraint, keep-out left out for REL.
        offsets: ``(T + 1,)`` where each trajectory's controls start.
        controls: ``(sum N, 3)`` float32 controls of all trajectories.
    """

    fingerprint: str
    first: int
    start: NDArray[np.float64]
    goal: NDArray[np.float64]
    obstacles: NDArray[np.float64]
    final_time: NDArray[np.float64]
    c_rel: NDArray[np.int32]
    rel_cost: NDArray[np.float64]
    failure: NDArray[np.str_]
    problem: NDArray[np.int32]
    label: NDArray[np.uint8]
    rank: NDArray[np.uint8]
    status: NDArray[np.str_]
    iterations: NDArray[np.int32]
    start_number: NDArray[np.int32]
    cost: NDArray[np.float64]
    violation: NDArray[np.float64]
    offsets: NDArray[np.int64]
    controls: NDArray[np.float32]

    @property
    def n_problems(self) -> int:
        """Number ``P`` of problems, failed ones included."""
        return len(self.start)

    @property
    def n_trajectories(self) -> int:
        """Number ``T`` of trajectories."""
        return len(self.label)

    def problem_at(self, index: int) -> Problem:
        """Problem ``index`` (within the shard)."""
        scenario = Scenario(obstacles=Obstacles.from_rows(self.obstacles[index]))
        return Problem(scenario, self.start[index], self.goal[index], float(self.final_time[index]))

    def controls_of(self, index: int) -> NDArray[np.float32]:
        """``(N, 3)`` float32 controls of trajectory ``index``."""
        return self.controls[self.offsets[index] : self.offsets[index + 1]]

    def head(self, n_problems: int) -> Shard:
        """The shard's first ``n_problems`` problems alone."""
        if n_problems >= self.n_problems:
            return self
        count = int(np.searchsorted(self.problem, n_problems))
        values: dict[str, Any] = {item.name: getattr(self, item.name) for item in fields(self)}
        for name in ("start", "goal", "obstacles", "final_time", "c_rel", "rel_cost", "failure"):
            values[name] = values[name][:n_problems]
        for name in ("problem", "label", "rank", "status", "iterations", "start_number"):
            values[name] = values[name][:count]
        for name in ("cost", "violation"):
            values[name] = values[name][:count]
        values["offsets"] = self.offsets[: count + 1]
        values["controls"] = self.controls[: self.offsets[count]]
        return Shard(**values)

    def digest(self) -> str:
        """SHA-256 of everything in the shard."""
        return _digest(_arrays(self))


def shard_path(folder: Path, number: int) -> Path:
    """Where shard ``number`` lies."""
    return folder / f"shard-{number:06d}.npz"


def list_shards(folder: Path) -> list[Path]:
    """The shards in a folder, in the order of their problems."""
    return sorted(folder.glob("shard-*.npz"))


def join_shards(shards: Iterable[Shard]) -> Shard:
    """One shard of the problems of consecutive shards."""
    parts = list(shards)
    offsets = np.cumsum([0, *(len(part.controls) for part in parts)])
    firsts = np.cumsum([0, *(part.n_problems for part in parts)])
    values: dict[str, Any] = {}
    for item in fields(Shard):
        if item.name not in ("fingerprint", "first", "offsets", "problem"):
            values[item.name] = np.concatenate([getattr(part, item.name) for part in parts])
    values["problem"] = np.concatenate(
        [part.problem + first for part, first in zip(parts, firsts)]
    ).astype(np.int32)
    values["offsets"] = np.concatenate(
        [np.zeros(1, dtype=np.int64)] + [part.offsets[1:] + by for part, by in zip(parts, offsets)]
    )
    return Shard(parts[0].fingerprint, parts[0].first, **values)


def write_shard(path: Path, shard: Shard, *, compressed: bool = False) -> None:
    """Writes a shard so that ``path`` is either absent or complete. Same shard, same bytes."""
    save = np.savez_compressed if compressed else np.savez
    arrays = _arrays(shard)
    temporary = path.with_name(f"{path.name}.{os.getpid()}.tmp")
    try:
        with open(temporary, "wb") as file:
            arrays["digest"] = np.array(_digest(arrays))
            save(file, allow_pickle=False, **arrays)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def read_shard(path: Path) -> Shard:
    """Reads a shard and checks its checksum.

    Raises:
        ShardError: If the file is damaged or something else.
        FileNotFoundError: If there is no such file.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        digest = str(arrays.pop("digest"))
        if str(arrays["format"]) != _FORMAT:
            raise ValueError(f"its format is {arrays['format']}, not {_FORMAT}")
        if _digest(arrays) != digest:
            raise ValueError("it does not match its checksum")
        del arrays["format"]
        fingerprint, first = str(arrays.pop("fingerprint")), int(arrays.pop("first"))
        return Shard(fingerprint, first, **arrays)
    except FileNotFoundError:
        raise
    except _DAMAGE as error:
        raise ShardError(f"{path.name} cannot be read: {error}.") from error


def iterate_shards(folder: Path, n_problems: int | None = None) -> Iterator[Shard]:
    """Shards of a folder from problem 0 on, without a gap, up to ``n_problems`` problems.

    Raises:
        ShardError: If a shard is damaged, or of another recipe than the first one.
        ValueError: If there are no shards, or fewer problems than asked for.
    """
    done, fingerprint = 0, None
    for number, path in enumerate(list_shards(folder)):
        if path != shard_path(folder, number) or (n_problems is not None and done >= n_problems):
            break
        shard = read_shard(path)
        fingerprint = fingerprint or shard.fingerprint
        if shard.fingerprint != fingerprint:
            raise ShardError(f"{path.name} is of another recipe than the shards before it.")
        if shard.first != done:
            break
        shard = shard if n_problems is None else shard.head(n_problems - done)
        done += shard.n_problems
        yield shard
    if done == 0:
        raise ValueError(f"There are no shards in {str(folder)!r}; generate some first.")
    if n_problems is not None and done < n_problems:
        raise ValueError(f"{str(folder)!r} holds {done} problems, {n_problems} are asked for.")


def source_digest(folder: Path, n_problems: int | None = None) -> str:
    """Hash of the checksums of the shards in a folder: tells whether they have changed."""
    sha, done = hashlib.sha256(), 0
    for path in list_shards(folder):
        if n_problems is not None and done >= n_problems:
            break
        with np.load(path, allow_pickle=False) as file:
            sha.update(str(file["digest"]).encode())
            done += len(file["final_time"])
    return sha.hexdigest()


def _arrays(shard: Shard) -> dict[str, NDArray[Any]]:
    arrays = {item.name: np.asarray(getattr(shard, item.name)) for item in fields(shard)}
    return {"format": np.array(_FORMAT), **arrays}


def _digest(arrays: dict[str, NDArray[Any]]) -> str:
    sha = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        sha.update(f"{name}:{array.dtype.str}:{array.shape}:".encode())
        sha.update(array.tobytes())
    return sha.hexdigest()
