"""Loading: the packed form of a dataset, memory-mapped, that training reads.

Goal and obstacles are stored once a problem, and of each trajectory only the controls, from which
its states follow exactly. A packed dataset is a cache: it is made from a Minari dataset or from
shards, and made again when its source has changed.
"""

from __future__ import annotations

import difflib
import json
import logging
import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from freeflyer_datasets.packing import (
    ARRAYS,
    PACKED_VERSION,
    Chunk,
    chunk_of_shard,
    chunks_of_episodes,
    describe_file,
    write_pack,
)
from freeflyer_datasets.recipe import packaged_folder
from freeflyer_datasets.shards import iterate_shards, read_shard, source_digest
from freeflyer_env import dynamics
from freeflyer_env.robot import FloatArray, Robot
from freeflyer_env.scenario import Obstacles, Problem, Scenario
from freeflyer_env.spaces import rows_at

if TYPE_CHECKING:
    from freeflyer_env.planning import Trajectory

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class PackedDataset:
    """``P`` problems and ``T`` trajectories in memory-mapped arrays (SI units, global frame).

    Attributes:
        path: The folder of the ``.npy`` files.
        dataset_id: Minari id of the dataset.
        dt: Step in s.
        start: ``(P, 6)`` start states.
        goal: ``(P, 6)`` goal states.
        obstacles: ``(P, M, 3)`` rows (x, y, radius) in m, zero-padded; ``(P, M, 5)`` with
            velocities (v_x, v_y) in m/s if any move.
        final_time: ``(P,)`` in s.
        c_rel: ``(P,)`` nodes of the problem's REL trajectory that violate keep-out.
        rel_cost: ``(P,)`` cost of the REL trajectory in m/s.
        problem_index: ``(T,)`` row of each trajectory's problem, ascending.
        label: ``(T,)`` ``LABEL_REL`` or ``LABEL_SCP``.
        rank: ``(T,)`` 0 for the cheapest SCP optimum of its problem, 1 for the next; REL has 0.
        cost: ``(T,)`` cost in m/s.
        offsets: ``(T + 1,)`` where each trajectory's controls start.
        controls: ``(sum N, 3)`` float32 controls of all trajectories.
    """

    path: Path
    dataset_id: str
    dt: float
    start: NDArray[np.float64]
    goal: NDArray[np.float64]
    obstacles: NDArray[np.float64]
    final_time: NDArray[np.float64]
    c_rel: NDArray[np.int32]
    rel_cost: NDArray[np.float64]
    problem_index: NDArray[np.int32]
    label: NDArray[np.uint8]
    rank: NDArray[np.uint8]
    cost: NDArray[np.float32]
    offsets: NDArray[np.int64]
    controls: NDArray[np.float32]

    robot: Robot = field(default_factory=Robot)

    @classmethod
    def open(cls, path: str | Path, verify: bool = False) -> PackedDataset:
        """Opens a packed dataset, without reading it.

        Args:
            path: Its folder.
            verify: Whether to read everything once and compare checksums.

        Raises:
            ValueError: If the folder is no packed dataset of this version, or a file is damaged.
        """
        path = Path(path)
        try:
            meta = json.loads((path / "meta.json").read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise ValueError(f"{str(path)!r} is not a packed dataset: {error}") from error
        if meta.get("version") != PACKED_VERSION:
            raise ValueError(
                f"{str(path)!r} has packed version {meta.get('version')}, this code reads "
                f"{PACKED_VERSION}; delete the folder, it is only a cache."
            )
        for name in ARRAYS:
            _check_file(path / f"{name}.npy", meta["files"][name], verify)
        arrays = {name: np.load(path / f"{name}.npy", mmap_mode="r") for name in ARRAYS}
        return cls(path, meta["dataset_id"], meta["dt"], **arrays)

    @classmethod
    def from_shards(
        cls, folder: str | Path, n_problems: int | None = None, cache: str | Path | None = None
    ) -> PackedDataset:
        """Packs the shards that are in a folder by now, from problem 0 to the first gap.

        Args:
            folder: Where :func:`freeflyer_datasets.generate` writes, finished or not.
            n_problems: How many problems; all if None.
            cache: Where to keep the packed form; ``folder/packed`` if None.
        """
        folder = Path(folder)
        recipe = json.loads((folder / "recipe.json").read_text(encoding="utf-8"))
        source = f"{source_digest(folder, n_problems)}:{n_problems}"

        def chunks() -> Iterator[Chunk]:
            return (chunk_of_shard(shard) for shard in iterate_shards(folder, n_problems))

        return _cached(Path(cache or folder / "packed"), recipe["id"], source, chunks)

    @classmethod
    def from_minari(cls, dataset_id: str, cache: str | Path | None = None) -> PackedDataset:
        """Packs a Minari dataset of this package, which must be on this machine.

        Args:
            dataset_id: Such as ``"freeflyer/scene-random-v0"``.
            cache: Where to keep the packed form; ``packed`` beside the dataset's ``data`` if None.

        Raises:
            FileNotFoundError: If Minari has no such dataset here.
            ValueError: If the dataset was not made by this package.
        """
        from freeflyer_datasets.storage import dataset_folder, iterate_episodes, minari_source

        folder = dataset_folder(dataset_id)
        if not (folder / "data" / "metadata.json").is_file():
            raise FileNotFoundError(
                f"There is no dataset {dataset_id!r} in {str(folder)!r}. Make it with "
                f"freeflyer_datasets.build, or set MINARI_DATASETS_PATH to where it lies."
            )

        def chunks() -> Iterator[Chunk]:
            return chunks_of_episodes(iterate_episodes(folder / "data"))

        return _cached(Path(cache or folder / "packed"), dataset_id, minari_source(folder), chunks)

    def __len__(self) -> int:
        return len(self.label)

    def __reduce__(self) -> tuple[Any, ...]:
        # A memory map would be pickled by value, into every worker of a data loader.
        return type(self).open, (self.path,)

    @property
    def n_problems(self) -> int:
        """Number ``P`` of problems."""
        return len(self.start)

    @property
    def n_steps(self) -> NDArray[np.int64]:
        """``(T,)`` number of controls of each trajectory."""
        return np.diff(self.offsets)

    def problem(self, index: int) -> Problem:
        """Problem ``index`` (a row of :attr:`start`; see :attr:`problem_index`)."""
        obstacles = Obstacles.from_rows(self.obstacles[index])
        scenario = Scenario(obstacles=obstacles, robot=self.robot, dt=self.dt)
        return Problem(scenario, self.start[index], self.goal[index], float(self.final_time[index]))

    def trajectory(self, index: int) -> Trajectory:
        """Trajectory ``index``: its controls, and the states that follow from them."""
        from freeflyer_env.planning import Trajectory

        states = self.states([index])[0]
        return Trajectory(states, self.controls_of([index])[0].astype(np.float64), self.dt)

    def controls_of(self, indices: ArrayLike) -> NDArray[np.float32]:
        """``(B, N, 3)`` controls of trajectories of equal length.

        Raises:
            ValueError: If their lengths differ.
        """
        rows = np.asarray(indices, dtype=np.int64).reshape(-1)
        first, lengths = self.offsets[rows], self.offsets[rows + 1] - self.offsets[rows]
        if len(rows) and (lengths != lengths[0]).any():
            raise ValueError(
                f"The trajectories of a batch must have equal lengths, got {np.unique(lengths)}."
            )
        n_steps = int(lengths[0]) if len(rows) else 0
        return self.controls[first[:, None] + np.arange(n_steps)]

    def states(self, indices: ArrayLike) -> FloatArray:
        """``(B, N + 1, 6)`` states of trajectories of equal length, in float64."""
        rows = np.asarray(indices, dtype=np.int64).reshape(-1)
        start = np.asarray(self.start[self.problem_index[rows]])
        controls = self.controls_of(rows).astype(np.float64)
        return dynamics.rollout(start, controls, self.dt, self.robot)

    def windows(
        self, indices: ArrayLike, first: ArrayLike, length: int
    ) -> tuple[FloatArray, NDArray[np.float32], NDArray[np.bool_]]:
        """Sub-sequences of trajectories, of any lengths.

        Args:
            indices: ``(B,)`` trajectories.
            first: ``(B,)`` first step of each window.
            length: Number ``K`` of steps.

        Returns:
            States ``(B, K, 6)`` before each step, controls ``(B, K, 3)``, and ``(B, K)`` whether
            the step exists. Beyond a trajectory's end the controls are zero and the state stays.
        """
        rows = np.asarray(indices, dtype=np.int64).reshape(-1)
        begin = np.asarray(first, dtype=np.int64).reshape(-1)
        n_steps = self.offsets[rows + 1] - self.offsets[rows]
        if (begin < 0).any() or (begin >= n_steps).any() or length < 1:
            raise ValueError("Windows must begin within their trajectories and have a length.")
        # Step by step, the windows side by side: sums over steps are additions of whole rows.
        ahead = begin + np.arange(length)[:, None]  # (K, B)
        inside = ahead < n_steps
        # (`take` is four times as fast as an array of indices in brackets.)
        position = self.offsets[rows] + np.minimum(ahead, n_steps - 1)
        controls = np.asarray(self.controls).take(position.ravel(), axis=0).reshape(length, -1)
        exists = np.repeat(inside, 3, axis=1)
        controls *= exists
        rates = controls[:-1] * np.tile(self.robot.control_gain, len(rows))
        # A last impulse is not followed by a drift, so that pose and rates are those of the end.
        poses = exists[1:] * self.dt
        state = self._states_at(rows, begin)
        pose, rate = state[:, :3].ravel(), state[:, 3:].ravel()
        for rates_after, poses_after in zip(rates, poses):
            rate = np.add(rate, rates_after, out=rates_after)
            poses_after *= rate
            pose = np.add(pose, poses_after, out=poses_after)
        states = np.empty((len(rows), length, 6))
        states[:, 0] = state
        shape = (length - 1, len(rows), 3)
        states[:, 1:, :3] = poses.reshape(shape).swapaxes(0, 1)
        states[:, 1:, 3:] = rates.reshape(shape).swapaxes(0, 1)
        by_window = np.ascontiguousarray(controls.reshape(length, -1, 3).swapaxes(0, 1))
        return states, by_window, np.ascontiguousarray(inside.T)

    def _states_at(self, rows: NDArray[np.int64], step: NDArray[np.int64]) -> FloatArray:
        """States ``(B, 6)`` of trajectories before one of their steps each, ``(B,)``.

        Two sums over the controls before step ``k`` are enough: ``v_k = v_0 + sum u_i``, and
        ``p_k = p_0 + dt (k v_0 + sum (k - i) u_i)``.
        """
        state = np.asarray(self.start[self.problem_index[rows]])
        # The controls of all trajectories in one run, summed piece by piece.
        ends = np.cumsum(step)
        begins, number = ends - step, np.arange(step.sum())
        position = number + np.repeat(self.offsets[rows] - begins, step)
        controls = np.asarray(self.controls).take(position, axis=0).astype(np.float64)
        moved, impulse, weighted = step > 0, np.zeros((len(rows), 3)), np.zeros((len(rows), 3))
        if len(number):
            impulse[moved] = np.add.reduceat(controls, begins[moved])
            controls *= (np.repeat(ends, step) - number)[:, None]
            weighted[moved] = np.add.reduceat(controls, begins[moved])
        gain = self.robot.control_gain
        state[:, :3] += self.dt * (step[:, None] * state[:, 3:] + weighted * gain)
        state[:, 3:] += impulse * gain
        return state

    def transitions(self, indices: ArrayLike | None = None) -> dict[str, NDArray[np.float32]]:
        """Trajectories as flat arrays, one row a step, for offline-RL libraries such as d3rlpy.

        Args:
            indices: ``(B,)`` trajectories; all if None.

        Returns:
            ``observations`` ``(sum N, D)``, the environment's observation flattened as
            ``gymnasium.spaces.flatten`` does it (goal, obstacles, state, time to go); ``actions``
            ``(sum N, 3)``; ``rewards`` and ``terminals`` ``(sum N,)``. For d3rlpy:
            ``d3rlpy.dataset.MDPDataset(**data.transitions())``.
        """
        rows = np.arange(len(self)) if indices is None else np.asarray(indices, dtype=np.int64)
        observations, actions, terminals = [], [], []
        for row in rows.reshape(-1):
            problem = self.problem_index[row]
            states = self.states([row])[0, :-1]
            n_steps = len(states)
            times = self.dt * np.arange(n_steps)
            goal = np.broadcast_to(self.goal[problem], (n_steps, 6))
            obstacles = rows_at(self.obstacles[problem], times).reshape(n_steps, -1)
            to_go = self.final_time[problem] - times[:, None]
            observations.append(np.hstack([goal, obstacles, states, to_go]).astype(np.float32))
            actions.append(self.controls_of([row])[0])
            terminals.append((np.arange(n_steps) == n_steps - 1).astype(np.float32))
        flat = np.concatenate(actions) if actions else np.empty((0, 3), np.float32)
        return {
            "observations": np.concatenate(observations),
            "actions": flat,
            "rewards": -np.abs(flat).sum(axis=1),
            "terminals": np.concatenate(terminals),
        }

    def split(self, validation_fraction: float = 0.05) -> tuple[np.ndarray, np.ndarray]:
        """Indices of the training and of the validation trajectories.

        It is problems that are split, so all trajectories of one are on one side. A problem stays
        on its side when the dataset grows.

        Args:
            validation_fraction: Share of the problems held out, in (0, 1); at least one problem is.
        """
        if not 0.0 < validation_fraction < 1.0:
            raise ValueError(f"validation_fraction must be in (0, 1), got {validation_fraction}.")
        score = _hash_unit(np.arange(self.n_problems))
        threshold = max(validation_fraction, float(np.nextafter(score.min(), 1.0)))
        held_out = (score < threshold)[self.problem_index]
        return np.flatnonzero(~held_out), np.flatnonzero(held_out)


def list_samples() -> list[str]:
    """Names of the samples that come with the package, such as ``"scene-random-v0"``."""
    return sorted(path.stem for path in packaged_folder("samples").glob("*.npz"))


def load_sample(name: str) -> PackedDataset:
    """The first 200 problems of a dataset, with all their trajectories; nothing is downloaded.

    Args:
        name: Of the dataset, ``"scene-random-v0"`` or ``"freeflyer/scene-random-v0"``.

    Returns:
        The packed form, kept in a hidden folder of Minari's data root.

    Raises:
        ValueError: If there is no such sample; the message names the nearest one.
    """
    from freeflyer_datasets.storage import dataset_folder

    short, names = name.removeprefix("freeflyer/"), list_samples()
    if short not in names:
        near = difflib.get_close_matches(short, names, n=1)
        hint = f" Did you mean {near[0]!r}?" if near else ""
        raise ValueError(f"No sample is called {name!r}.{hint} There are: {', '.join(names)}.")
    shard = read_shard(packaged_folder("samples") / f"{short}.npz")
    cache = dataset_folder(f".samples/{short}")
    return _cached(
        cache, f"freeflyer/{short}", shard.digest(), lambda: iter([chunk_of_shard(shard)])
    )


def _cached(
    path: Path, dataset_id: str, source: str, chunks: Callable[[], Iterator[Chunk]]
) -> PackedDataset:
    """The packed dataset at ``path`` if it is of this source and sound, else a new one."""
    try:
        meta = json.loads((path / "meta.json").read_text(encoding="utf-8"))
        if meta.get("source") == source and meta.get("dataset_id") == dataset_id:
            return PackedDataset.open(path)
        logger.info("The cache %s is stale and is made again.", path)
    except (OSError, ValueError, KeyError) as error:
        if path.exists():
            logger.warning("The cache %s is made again: %s", path, error)
    temporary = path.with_name(f"{path.name}.{os.getpid()}.tmp")
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    try:
        write_pack(temporary, dataset_id, source, chunks())
        shutil.rmtree(path, ignore_errors=True)
        temporary.rename(path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return PackedDataset.open(path)


def _check_file(path: Path, expected: dict[str, Any], verify: bool) -> None:
    if not path.is_file() or path.stat().st_size != expected["bytes"]:
        raise ValueError(f"{str(path)!r} is missing or truncated; delete its folder, a cache.")
    if verify and describe_file(path) != expected:
        raise ValueError(f"{str(path)!r} does not match its checksum; delete its folder, a cache.")


def _hash_unit(values: NDArray[Any]) -> FloatArray:
    """A fixed pseudo-random number in [0, 1) for each integer (the finaliser of SplitMix64)."""
    z = (values.astype(np.uint64) + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = (z ^ (z >> np.uint64(31))) >> np.uint64(11)
    return z.astype(np.float64) * 2.0**-53
