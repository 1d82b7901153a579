"""Generation: solves a recipe's problems in parallel and writes them as shards.

A shard's bytes depend on the recipe alone: not on the number of workers, their order, an
interruption, or how many problems were asked for. Starting an interrupted run again resumes it: at
most the shards that were in work are lost.
"""

from __future__ import annotations

import errno
import json
import logging
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from freeflyer_datasets.recipe import Recipe
from freeflyer_datasets.shards import (
    LABEL_REL,
    LABEL_SCP,
    Shard,
    ShardError,
    read_shard,
    shard_path,
    write_shard,
)
from freeflyer_env.constraints import nodes_inside
from freeflyer_env.scenario import Problem

if TYPE_CHECKING:
    from freeflyer_env.planning import SCPResult

logger = logging.getLogger(__name__)

_UNSOLVED = "the relaxed problem was not solved"

#: Time in s after which a start of one problem is given up; a hundred times what one takes.
_TIME_LIMIT = 60.0

#: How often the work goes on after a worker was killed from outside.
_MOST_RESTARTS = 5

#: Where the workers run; see :func:`generate`.
ENGINES = ("local", "ray")

#: Problems in a shard; the last shard of a run may have fewer.
SHARD_SIZE = 100


class GenerationError(RuntimeError):
    """Generation cannot go on; the message says why and what to do. What was made is safe."""


@dataclass(frozen=True)
class GenerationReport:
    """What :func:`generate` did.

    Attributes:
        folder: Where the shards are.
        n_problems: Problems that the shards hold now.
        n_trajectories: Trajectories that the new shards hold.
        new_shards: Shards that were made.
        kept_shards: Good shards that were there.
        remade_shards: Names of the damaged shards that were made again.
        failed_problems: Indices of the problems of new shards that have no trajectory.
        elapsed: Wall time in s.
    """

    folder: Path
    n_problems: int
    n_trajectories: int
    new_shards: int
    kept_shards: int
    remade_shards: tuple[str, ...]
    failed_problems: tuple[int, ...]
    elapsed: float

    def __str__(self) -> str:
        lines = (
            f"{self.n_problems} problems in {str(self.folder)!r}: {self.new_shards} shards made "
            f"({self.n_trajectories} trajectories, {self.elapsed:.0f} s), {self.kept_shards} kept"
        )
        if self.remade_shards:
            lines += f", {len(self.remade_shards)} damaged ones made again"
        if self.failed_problems:
            lines += f"; {len(self.failed_problems)} problems have no trajectory"
        return lines + "."


def generate(
    recipe: Recipe,
    out: str | Path,
    n_problems: int | None = None,
    workers: int | None = None,
    progress: bool = True,
    engine: str = "local",
) -> GenerationReport:
    """Solves the first ``n_problems`` problems of a recipe and writes them as shards.

    Good shards that are there already are kept. After an interruption, call it again.

    Args:
        recipe: What to make.
        out: Folder of the shards; made if need be. One recipe per folder.
        n_problems: How many problems; the recipe's own number if None.
        workers: Processes, each with one thread; one per processor if None.
        progress: Whether to show a progress bar with rate and time left.
        engine: ``"local"``, processes of this machine, or ``"ray"``, a Ray cluster: the one that
            the process is connected to, or a local one. All machines need to see ``out``.

    Returns:
        What was made, kept and made again.

    Raises:
        ValueError: If ``out`` holds shards of another recipe.
        GenerationError: If shards cannot be written (a full disk), workers are killed again and
            again (no memory), or every problem of a shard raised an exception. What was written
            stays, and the next call goes on from there.
    """
    from tqdm import tqdm

    began = time.perf_counter()
    if engine not in ENGINES:
        raise ValueError(f"engine must be one of {ENGINES}, got {engine!r}.")
    n_problems = recipe.n_problems if n_problems is None else n_problems
    if n_problems < 1:
        raise ValueError(f"n_problems must be at least 1, got {n_problems}.")
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    _write_recipe(folder, recipe)
    _remove_leftovers(folder)
    missing, kept, damaged = _missing_shards(folder, recipe, n_problems)
    done_before = n_problems - sum(count for _, count in missing)
    bar = tqdm(total=n_problems, unit="problem", disable=not progress, smoothing=0.1)
    n_trajectories, failed = 0, []
    with bar:
        bar.update(done_before)
        bar.initial = done_before  # the rate is that of this run
        for count, trajectories, failures in _run(folder, recipe, missing, workers, engine):
            bar.update(count)
            n_trajectories += trajectories
            failed += failures
    return GenerationReport(
        folder=folder,
        n_problems=n_problems,
        n_trajectories=n_trajectories,
        new_shards=len(missing),
        kept_shards=kept,
        remade_shards=tuple(damaged),
        failed_problems=tuple(sorted(failed)),
        elapsed=time.perf_counter() - began,
    )


def _run(
    folder: Path,
    recipe: Recipe,
    missing: list[tuple[int, int]],
    workers: int | None,
    engine: str,
) -> Iterator[tuple[int, int, list[int]]]:
    """Makes the missing shards in workers; goes on where some of these are killed."""
    import joblib
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    n_jobs = workers or joblib.cpu_count()
    left = list(missing)
    for _ in range(1 + _MOST_RESTARTS):
        jobs = [
            joblib.delayed(_make_shard)(folder, recipe, number, count, SHARD_SIZE)
            for number, count in left
        ]
        try:
            if engine == "ray":
                yield from _run_on_ray(jobs, n_jobs)
            else:
                with joblib.parallel_config(backend="loky", inner_max_num_threads=1):
                    yield from joblib.Parallel(n_jobs, return_as="generator_unordered")(jobs)
            return
        except TerminatedWorkerError:
            left = [item for item in left if not shard_path(folder, item[0]).is_file()]
            logger.warning(
                "A worker was killed, perhaps for want of memory; going on with %d shards.",
                len(left),
            )
        except OSError as error:
            reason = "the disk is full" if error.errno == errno.ENOSPC else str(error)
            raise GenerationError(
                f"A shard cannot be written in {str(folder)!r}: {reason}. The finished ones are "
                "safe; make room and start again to go on."
            ) from error
    raise GenerationError(
        f"Workers were killed {1 + _MOST_RESTARTS} times; use fewer (workers={n_jobs // 2 or 1}) "
        "or find out what kills them (memory?), and start again to go on."
    )


def _run_on_ray(jobs: list[Any], n_jobs: int) -> Iterator[tuple[int, int, list[int]]]:
    """Through joblib's Ray backend, some shards a worker at a time: it gives results in lists."""
    import joblib

    try:
        from ray.util.joblib import register_ray
    except ImportError as error:
        raise ModuleNotFoundError(
            'engine="ray" needs Ray: pip install "freeflyer-gym[cluster]".'
        ) from error
    register_ray()
    with joblib.parallel_config(backend="ray"):
        for first in range(0, len(jobs), 4 * n_jobs):
            yield from joblib.Parallel(n_jobs)(jobs[first : first + 4 * n_jobs])


def solve_problems(recipe: Recipe, first: int, count: int) -> Shard:
    """Solves problems ``first ... first + count - 1`` of a recipe.

    An exception is recorded as the failure of its problem; a missing package is raised.
    """
    problems = [recipe.problem(index) for index in range(first, first + count)]
    rows: list[dict[str, Any]] = []
    c_rel, rel_cost = np.full(count, -1, np.int32), np.full(count, np.nan)
    failures = [""] * count
    for local, problem in enumerate(problems):
        try:
            records = _solve(recipe, problem)
        except ImportError:
            raise
        except Exception as error:  # recorded with its index: one bad problem must not stop a run
            failures[local] = f"{type(error).__name__}: {error}"[:200]
            logger.warning("problem %d of %s: %s", first + local, recipe.id, failures[local])
            continue
        if not records:
            failures[local] = _UNSOLVED
            continue
        c_rel[local] = nodes_inside(problem, records[0]["trajectory"].states)
        rel_cost[local] = records[0]["trajectory"].cost
        rows += [{"problem": local, **record} for record in records]
    return _pack(recipe, first, problems, c_rel, rel_cost, failures, rows)


def _solve(recipe: Recipe, problem: Problem) -> list[dict[str, Any]]:
    """The records of one problem: REL, then its optima, cheapest first."""
    from freeflyer_env.planning import SCPConfig, solve_multistart

    config = SCPConfig(time_limit=_TIME_LIMIT)
    found = solve_multistart(problem, recipe.n_starts, config, effort=recipe.optima)
    if found.rel.trajectory is None:
        return []
    records = [_record(problem, found.rel, LABEL_REL, rank=0, start_number=-1)]
    optima = found.optima[:1] if recipe.optima == "best" else found.optima
    numbers = {id(result): number for number, result in enumerate(found.results)}
    for rank, optimum in enumerate(optima):
        records.append(_record(problem, optimum, LABEL_SCP, rank, numbers[id(optimum)]))
    return records


def _record(
    problem: Problem, result: SCPResult, label: int, rank: int, start_number: int
) -> dict[str, Any]:
    from freeflyer_env.planning import Trajectory

    assert result.trajectory is not None
    controls = result.trajectory.controls.astype(np.float32)
    trajectory = Trajectory.from_controls(problem, controls.astype(np.float64))
    report = vars(trajectory.check(problem))
    skipped = ("keep_out",) if label == LABEL_REL else ()
    return {
        "label": label,
        "rank": rank,
        "start_number": start_number,
        "status": result.status.value,
        "iterations": result.iterations,
        "trajectory": trajectory,
        "controls": controls,
        "violation": max(value for name, value in report.items() if name not in skipped),
    }


def _pack(
    recipe: Recipe,
    first: int,
    problems: list[Problem],
    c_rel: np.ndarray,
    rel_cost: np.ndarray,
    failures: list[str],
    rows: list[dict[str, Any]],
) -> Shard:
    obstacles = np.zeros((len(problems), recipe.max_obstacles, 5 if recipe.moving else 3))
    for local, problem in enumerate(problems):
        table = problem.scenario.obstacles.rows()
        obstacles[local, : len(table), : table.shape[1]] = table
    lengths = [len(row["controls"]) for row in rows]

    def column(name: str, dtype: Any) -> np.ndarray:
        return np.array([row[name] for row in rows], dtype=dtype)

    return Shard(
        fingerprint=recipe.fingerprint,
        first=first,
        start=np.array([problem.start for problem in problems]),
        goal=np.array([problem.goal for problem in problems]),
        obstacles=obstacles,
        final_time=np.array([problem.final_time for problem in problems]),
        c_rel=c_rel,
        rel_cost=rel_cost,
        failure=np.array(failures, dtype="U200"),
        problem=column("problem", np.int32),
        label=column("label", np.uint8),
        rank=column("rank", np.uint8),
        status=column("status", "U24"),
        iterations=column("iterations", np.int32),
        start_number=column("start_number", np.int32),
        cost=np.array([row["trajectory"].cost for row in rows], dtype=np.float64),
        violation=column("violation", np.float64),
        offsets=np.concatenate([[0], np.cumsum(lengths, dtype=np.int64)]).astype(np.int64),
        controls=np.concatenate([row["controls"] for row in rows] or [np.empty((0, 3), "f4")]),
    )


def _make_shard(
    folder: Path, recipe: Recipe, number: int, count: int, shard_size: int = SHARD_SIZE
) -> tuple[int, int, list[int]]:
    """Makes one shard in a worker; returns how many problems and trajectories, and failures."""
    first = number * shard_size
    shard = solve_problems(recipe, first, count)
    failed = [first + int(local) for local in np.flatnonzero(shard.failure != "")]
    if all(shard.failure != "") and not all(shard.failure == _UNSOLVED):
        raise GenerationError(
            f"All {count} problems from {first} on failed, so the shard was not written. "
            f"The first one: {shard.failure[0]}"
        )
    write_shard(shard_path(folder, number), shard)
    return count, shard.n_trajectories, failed


def _missing_shards(
    folder: Path, recipe: Recipe, n_problems: int
) -> tuple[list[tuple[int, int]], int, list[str]]:
    """Number and size of the shards to make; how many are kept; names of the damaged ones."""
    missing: list[tuple[int, int]] = []
    damaged: list[str] = []
    kept = 0
    for number, first in enumerate(range(0, n_problems, SHARD_SIZE)):
        path, count = shard_path(folder, number), min(SHARD_SIZE, n_problems - first)
        try:
            shard = read_shard(path)
            if shard.fingerprint != recipe.fingerprint:
                raise _other_recipe(folder, path.name)
            if shard.first != first or shard.n_problems > SHARD_SIZE:
                raise ShardError(f"{path.name} holds other problems than it should.")
            if shard.n_problems >= count:
                kept += 1
                continue
            # The last shard of a shorter run.
        except FileNotFoundError:
            pass
        except ShardError as error:
            logger.warning("%s It is made again.", error)
            damaged.append(path.name)
        missing.append((number, count))
    return missing, kept, damaged


def _remove_leftovers(folder: Path) -> None:
    """Removes what killed processes were writing; those of living ones are left alone."""
    for path in folder.glob("*.tmp"):
        owner = path.name.split(".")[-2]
        if not owner.isdigit() or not _is_alive(int(owner)):
            path.unlink(missing_ok=True)


def _is_alive(process: int) -> bool:
    if os.name == "nt":  # signal 0 is Ctrl-C there
        return False
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True


def _write_recipe(folder: Path, recipe: Recipe) -> None:
    """Leaves the recipe beside its shards, and refuses a folder of another one."""
    path = folder / "recipe.json"
    if path.is_file():
        try:
            other = Recipe.from_dict(json.loads(path.read_text(encoding="utf-8")))
        except (ValueError, TypeError):
            logger.warning("%s cannot be read and is written again.", path)
        else:
            if other.fingerprint != recipe.fingerprint:
                raise _other_recipe(folder, path.name)
    temporary = path.with_name(f"{path.name}.{os.getpid()}.tmp")
    temporary.write_text(json.dumps(recipe.to_dict(), indent=2) + "\n", encoding="utf-8")
    os.replace(temporary, path)


def _other_recipe(folder: Path, name: str) -> ValueError:
    return ValueError(
        f"{str(folder)!r} holds shards of another recipe ({name}); use another folder or delete it."
    )
