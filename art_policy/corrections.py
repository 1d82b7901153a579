"""Corrections: what would have been optimal after what a model did (DAgger, Ross et al. 2011).

A model that only ever saw optimal trajectories does not know what to do once it has left them. It
is let run; from a random node of where it came, SCP finds the optimal rest. These rests are
problems that begin in flight, and a dataset like any other: train on it and on the first one.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from tqdm.auto import tqdm

from art_policy.generation import generate
from freeflyer_datasets.loading import PackedDataset
from freeflyer_datasets.packing import Chunk, write_pack
from freeflyer_datasets.shards import LABEL_REL, LABEL_SCP
from freeflyer_env.constraints import nodes_inside
from freeflyer_env.planning import SCPConfig, Trajectory, race_scp, solve_rel
from freeflyer_env.robot import FloatArray
from freeflyer_env.scenario import Problem

if TYPE_CHECKING:
    from art_policy.model import ART

logger = logging.getLogger(__name__)

_SHORTEST = 10  # steps that are left at least
_BATCH = {"cpu": 256, "cuda": 2048}  # problems that are generated at once
_CHUNK = 32  # that a process solves at once


def collect_corrections(
    model: ART,
    data: PackedDataset,
    n_problems: int,
    out: str | Path,
    workers: int | None = None,
    seed: int = 0,
    progress: bool = True,
) -> PackedDataset:
    """Lets a model run on training problems and solves for what is left, from a random node on.

    SCP starts from the model's own continuation, from the known optimum's, and from REL; the
    cheapest result is kept. Nodes from which nothing leads to the goal are left out.

    Args:
        model: An autoregressive model.
        data: The dataset that it was trained on; its validation problems are not touched.
        n_problems: How many problems to run, each once.
        out: Folder of the packed dataset, which must not exist.
        workers: Processes; one per processor if None.
        seed: Of the choice of problems and nodes.
        progress: Whether to show a progress bar.

    Returns:
        The packed dataset: of each problem in flight its REL trajectory and its optimum.

    Raises:
        ValueError: If the model proposes whole paths, ``out`` exists, or nothing was solved.
    """
    import joblib

    if model.config.head != "autoregressive":
        raise ValueError(
            "Corrections are for autoregressive models; a multi-hypothesis model is trained on "
            "problems that begin in flight by TrainConfig.tails."
        )
    out = Path(out)
    if out.exists():
        raise ValueError(f"{str(out)!r} exists; choose another folder or delete it.")
    rng = np.random.default_rng(seed)
    training = data.split()[0]
    optima = training[
        (np.asarray(data.label)[training] == LABEL_SCP) & (np.asarray(data.rank)[training] == 0)
    ]
    rows = rng.permutation(optima)[:n_problems]
    tasks = list(_departures(model, data, rows, rng))
    chunks = [tasks[i : i + _CHUNK] for i in range(0, len(tasks), _CHUNK)]
    found: list[_Correction] = []
    with (
        joblib.parallel_config(backend="loky", inner_max_num_threads=1),
        tqdm(total=len(tasks), unit="problem", desc="correcting", disable=not progress) as bar,
    ):
        jobs = (joblib.delayed(_solve)(chunk) for chunk in chunks)
        for part in joblib.Parallel(n_jobs=workers or -1, return_as="generator")(jobs):
            found += [correction for correction in part if correction is not None]
            bar.update(min(_CHUNK, len(tasks) - bar.n))
    logger.info("%d of %d problems in flight were solved.", len(found), len(tasks))
    if not found:
        raise ValueError("From nowhere that the model went is there a way to the goal.")
    temporary = out.with_name(out.name + ".tmp")
    temporary.mkdir(parents=True, exist_ok=True)
    write_pack(temporary, data.dataset_id, f"corrections:{seed}", iter([_chunk(found, data)]))
    temporary.rename(out)
    return PackedDataset.open(out)


#: A problem in flight, the model's controls from there, and the known optimum's poses.
_Departure = tuple[Problem, FloatArray, FloatArray]

#: The problem, REL's trajectory and the optimal one.
_Correction = tuple[Problem, Trajectory, Trajectory]


def _departures(
    model: ART, data: PackedDataset, rows: np.ndarray, rng: np.random.Generator
) -> Iterator[_Departure]:
    size = _BATCH.get(model.device.type, 256)
    for first in range(0, len(rows), size):
        part = rows[first : first + size]
        numbers = np.asarray(data.problem_index)[part]
        problems = [data.problem(int(number)) for number in numbers]
        runs = generate(model, problems, -np.asarray(data.rel_cost)[numbers])
        for row, problem, controls in zip(part, problems, runs):
            step = int(rng.integers(1, max(problem.n_steps - _SHORTEST, 2)))
            state = Trajectory.from_controls(problem, controls).states[step]
            poses = data.states([row])[0][step:-1, :3]
            rest = _in_flight(problem, state, step)
            if not rest.defects():
                yield rest, controls[step:], poses


def _in_flight(problem: Problem, state: FloatArray, step: int) -> Problem:
    """What is left of a problem at a step, from a state."""
    passed = step * problem.scenario.dt
    later = replace(problem.scenario, obstacles=problem.scenario.obstacles.after(passed))
    return Problem(later, state, problem.goal, problem.final_time - passed)


def _solve(departures: list[_Departure]) -> list[_Correction | None]:
    return [_correct(*departure) for departure in departures]


def _correct(problem: Problem, controls: FloatArray, poses: FloatArray) -> _Correction | None:
    rel = solve_rel(problem).trajectory
    if rel is None:
        return None
    onwards = Trajectory.from_controls(problem, controls).landed(problem)
    starts = [onwards, Trajectory.from_poses(problem, poses), rel]
    best = min(race_scp(problem, starts, SCPConfig(time_limit=5.0)), key=lambda r: r.cost)
    return (problem, rel, best.trajectory) if best.solved and best.trajectory else None


def _chunk(found: list[_Correction], data: PackedDataset) -> Chunk:
    obstacles = np.zeros((len(found), *data.obstacles.shape[1:]))
    for number, (problem, _, _) in enumerate(found):
        table = problem.scenario.obstacles.rows()
        obstacles[number, : len(table), : table.shape[1]] = table
    trajectories = [trajectory for _, rel, best in found for trajectory in (rel, best)]
    return Chunk(
        start=np.array([problem.start for problem, _, _ in found]),
        goal=np.array([problem.goal for problem, _, _ in found]),
        obstacles=obstacles,
        final_time=np.array([problem.final_time for problem, _, _ in found]),
        c_rel=np.array([nodes_inside(problem, rel.states) for problem, rel, _ in found]),
        rel_cost=np.array([rel.cost for _, rel, _ in found]),
        problem_index=np.repeat(np.arange(len(found)), 2),
        label=np.tile([LABEL_REL, LABEL_SCP], len(found)),
        rank=np.zeros(2 * len(found), dtype=np.uint8),
        cost=np.array([trajectory.cost for trajectory in trajectories]),
        lengths=np.array([trajectory.n_steps for trajectory in trajectories]),
        controls=np.concatenate([t.controls for t in trajectories]).astype(np.float32),
    )
