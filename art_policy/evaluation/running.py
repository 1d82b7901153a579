"""Running the protocol: in parallel, and so that an interrupted evaluation goes on."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from art_policy.evaluation.protocol import ProblemRecord, evaluate_problem
from art_policy.evaluation.statistics import finite
from freeflyer_env.planning import SCPConfig
from freeflyer_env.sampling import sample_problem
from freeflyer_env.scenario import Problem, Scenario

if TYPE_CHECKING:
    from art_policy.deployment import OnnxART
    from art_policy.model import ART

Problems = Sequence[tuple[str, int, Problem]]

_Settings = tuple[int, int, SCPConfig]  # most candidates, most starts, settings of SCP

_CHUNK = 10  # problems a process takes at once


def evaluate(
    models: str | Path | Sequence[str | Path],
    problems: Problems,
    n_candidates: int = 4,
    n_starts: int = 13,
    config: SCPConfig | None = None,
    workers: int | None = None,
    progress: bool = True,
    partial: Path | None = None,
) -> list[ProblemRecord]:
    """Runs every method on every problem, in parallel over processes with one thread each.

    Args:
        models: What :meth:`ART.from_pretrained` takes, one or several. A single one is reported as
            ``"ART"``, several by their names.
        problems: As :func:`evaluation_problems` gives them.
        n_candidates: Largest number of candidates, at most as many as a model has hypotheses.
        n_starts: Starts of multi-start that the best known solution is taken from.
        config: Settings of the SCP that all methods share; the paper's if None.
        workers: Processes; one per processor if None.
        progress: Whether to show a progress bar.
        partial: File that collects the records on the way (JSON lines). What is in it already is
            not evaluated again; the caller deletes it in the end.

    Returns:
        A record for each problem, in order.

    Raises:
        ValueError: If an argument is out of range, or ``partial`` belongs to another evaluation.
    """
    import joblib
    from tqdm import tqdm

    for name, value in (("candidates", n_candidates), ("starts", n_starts)):
        if value < 1:
            raise ValueError(f"The number of {name} must be at least 1, got {value}.")
    given = [models] if isinstance(models, str | Path) else list(models)
    names = ["ART"] if len(given) == 1 else [Path(model).name for model in given]
    if len(set(names)) < len(names):
        raise ValueError(f"The models must have different names, got {', '.join(names)}.")
    stamped = tuple((name, str(model), _stamp(model)) for name, model in zip(names, given))
    settings = (n_candidates, n_starts, config or SCPConfig())
    done = _Journal(partial, _fingerprint(stamped, problems, settings))
    todo = [item for item in problems if item[1] not in done.records]
    chunks = [todo[i : i + _CHUNK] for i in range(0, len(todo), _CHUNK)]
    with (
        joblib.parallel_config(backend="loky", inner_max_num_threads=1),
        tqdm(total=len(problems), initial=len(problems) - len(todo), unit="problem",
             disable=not progress) as bar,
    ):  # fmt: skip
        jobs = (joblib.delayed(_evaluate_chunk)(stamped, chunk, settings) for chunk in chunks)
        for records in joblib.Parallel(n_jobs=workers or -1, return_as="generator")(jobs):
            done.add(records)
            bar.update(len(records))
    return [done.records[index] for _, index, _ in problems]


class _Journal:
    """Records by the number of their problem, kept in a file too if one is given."""

    def __init__(self, path: Path | None, fingerprint: str) -> None:
        self.path, self.records = path, dict[int, ProblemRecord]()
        if path is None:
            return
        header = json.dumps({"evaluation": fingerprint})
        lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
        if lines and lines[0] != header:
            raise ValueError(
                f"{str(path)!r} is of another evaluation (problems, models or settings differ): "
                "delete it, or write to another file."
            )
        for line in lines[1:]:
            try:
                record = ProblemRecord.from_dict(json.loads(line))
            except (ValueError, KeyError, TypeError):
                break  # the line that was being written when the process died
            self.records[record.index] = record
        path.parent.mkdir(parents=True, exist_ok=True)
        kept = [header, *(self._line(record) for record in self.records.values())]
        path.write_text("\n".join(kept) + "\n", encoding="utf-8")

    def add(self, records: Sequence[ProblemRecord]) -> None:
        """Keeps records."""
        self.records |= {record.index: record for record in records}
        if self.path is not None:
            with self.path.open("a", encoding="utf-8") as file:
                file.writelines(self._line(record) + "\n" for record in records)

    @staticmethod
    def _line(record: ProblemRecord) -> str:
        return json.dumps(finite(record.to_dict()))


def _fingerprint(
    models: tuple[tuple[str, str, str], ...], problems: Problems, settings: _Settings
) -> str:
    content = [
        [(name, stamp) for name, _, stamp in models],
        [(scene, index, problem.to_dict()) for scene, index, problem in problems],
        *settings[:2],
        asdict(settings[2]),
    ]
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()


def _stamp(model: str | Path) -> str:
    """A hash of a model's weights; its name where they are not here yet."""
    from art_policy.model import PRETRAINED_DIR, WEIGHTS_NAME

    folders = (Path(model), PRETRAINED_DIR / str(model))
    for weights in (Path(model), *(folder / WEIGHTS_NAME for folder in folders)):
        if weights.is_file():
            return hashlib.sha256(weights.read_bytes()).hexdigest()
    return str(model)


def _evaluate_chunk(
    stamped: tuple[tuple[str, str, str], ...],
    chunk: list[tuple[str, int, Problem]],
    settings: _Settings,
) -> list[ProblemRecord]:
    with _one_thread():
        models = {name: _load(path, stamp) for name, path, stamp in stamped}
        records = []
        for scene, index, problem in chunk:
            _warm_up(stamped, problem.n_steps, len(problem.scenario.obstacles))
            records.append(evaluate_problem(models, scene, index, problem, *settings))
        return records


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """PyTorch on one thread for a while."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@functools.lru_cache(maxsize=8)
def _load(model: str, stamp: str) -> ART | OnnxART:
    """The model, once per process and state of its weights."""
    from art_policy.model import load_model

    return load_model(model)


@functools.lru_cache(maxsize=64)
def _warm_up(stamped: tuple[tuple[str, str, str], ...], n_steps: int, n_obstacles: int) -> None:
    """Solves a problem of this size untimed: the first one assembles, the others overwrite."""
    rng = np.random.default_rng(0)
    problem = sample_problem(rng, None, n_steps * Scenario().dt, n_obstacles)
    models = {name: _load(path, stamp) for name, path, stamp in stamped}
    evaluate_problem(models, "warm-up", 0, problem, 2, 2)
