"""Storage: episodes in Minari's HDF5 layout, written directly with h5py.

Minari's own writer takes any array that it is given and needs five times the space, so episodes
are checked here before they are written, and the fields that are constant over one are compressed.
One group an episode::

    episode_7                     attributes: id, total_steps and those of EPISODE_ATTRIBUTES
      observations
        state                     (N + 1, 6) float32
        goal                      (N + 1, 6) float32
        obstacles                 (N + 1, M, 3) float32, rows (x, y, radius), zero-padded;
                                  (N + 1, M, 5) with (v_x, v_y) if the recipe's obstacles move
        time_to_go                (N + 1, 1) float32
      actions                     (N, 3) float32, impulses per unit mass (dv_x, dv_y, h)
      rewards                     (N,) float64, -||u||_1
      terminations, truncations   (N,) bool
      infos                       empty
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any

import gymnasium as gym
import h5py
import numpy as np
from h5py import h5a, h5d, h5g, h5p, h5s, h5t
from numpy.typing import NDArray

from freeflyer_datasets.shards import LABEL_SCP, Shard
from freeflyer_env import dynamics
from freeflyer_env.constraints import FEASIBILITY_TOLERANCE, keep_out_depth
from freeflyer_env.scenario import Obstacles, Scenario
from freeflyer_env.spaces import rows_at

#: Attributes of every episode besides Minari's own ``id`` and ``total_steps``.
EPISODE_ATTRIBUTES = {
    "problem_index": "index of the problem in its recipe",
    "label": "0: relaxed (REL), 1: SCP optimum",
    "rank": "0 for the cheapest optimum of the problem, 1 for the next; 0 for REL",
    "success": "1 if every constraint holds, keep-out included",
    "status": "how the solver ended",
    "iterations": "convex subproblems solved",
    "start_number": "warm start that led here, 0 being REL; -1 for REL itself",
    "cost": "sum of ||u||_1 in m/s, minus the return",
    "violation": "largest violation of a constraint; keep-out is left out for REL",
    "rel_cost": "cost of the problem's relaxed trajectory in m/s",
    "c_rel": "nodes of the relaxed trajectory inside a keep-out zone",
}

_FILE_NAME = "main_data.hdf5"
_FLOATS = ("cost", "violation", "rel_cost")


class EpisodeError(ValueError):
    """An episode that must not be stored; the message says which one and why."""


@dataclass(frozen=True, eq=False)
class Episode:
    """One episode as it is stored; see the module's description for the shapes."""

    observations: dict[str, NDArray[np.float32]]
    actions: NDArray[np.float32]
    rewards: NDArray[np.float64]
    terminations: NDArray[np.bool_]
    truncations: NDArray[np.bool_]
    attributes: dict[str, Any]


def shard_episodes(shard: Shard, scenario: Scenario | None = None) -> Iterator[Episode]:
    """The episodes of a shard, in its order.

    Args:
        shard: Where from.
        scenario: Gives robot and step.
    """
    scenario = scenario or Scenario()
    for index in range(shard.n_trajectories):
        local = int(shard.problem[index])
        controls = shard.controls_of(index)
        n_steps = len(controls)
        states = dynamics.rollout(
            shard.start[local], controls.astype(np.float64), scenario.dt, scenario.robot
        )
        repeat = n_steps + 1
        times = scenario.dt * np.arange(repeat)
        # Every trajectory reaches the goal, so it ends as it does in the environment: terminated.
        last = np.arange(n_steps) == n_steps - 1
        success = shard.label[index] == LABEL_SCP or shard.c_rel[local] == 0
        attributes = {
            name: getattr(shard, name)[index].item()
            for name in ("label", "rank", "iterations", "start_number", "cost", "violation")
        }
        yield Episode(
            observations={
                "state": states.astype(np.float32),
                "goal": np.repeat(shard.goal[local].astype(np.float32)[None], repeat, axis=0),
                "obstacles": rows_at(shard.obstacles[local], times),
                "time_to_go": (shard.final_time[local] - times[:, None]).astype(np.float32),
            },
            actions=controls,
            rewards=-np.abs(controls.astype(np.float64)).sum(axis=1),
            terminations=last,
            truncations=np.zeros(n_steps, dtype=bool),
            attributes={
                **attributes,
                "problem_index": shard.first + local,
                "success": int(success),
                "status": str(shard.status[index]),
                "rel_cost": shard.rel_cost[local].item(),
                "c_rel": shard.c_rel[local].item(),
            },
        )


def check_episode(
    episode: Episode, observation_space: gym.spaces.Dict, action_space: gym.spaces.Box
) -> None:
    """Checks what Minari does not: lengths, types, spaces, dynamics, goal, return and constraints.

    Raises:
        EpisodeError: If something is wrong.
    """

    def require(condition: bool, reason: str) -> None:
        if not condition:
            attributes = episode.attributes
            raise EpisodeError(
                f"Problem {attributes['problem_index']}, label {attributes['label']}, rank "
                f"{attributes['rank']}: {reason}"
            )

    n_steps = len(episode.actions)
    require(set(episode.observations) == set(observation_space), "observation keys differ")
    for name, value in episode.observations.items():
        _check_array(require, f"observations.{name}", value, n_steps + 1, observation_space[name])
    _check_array(require, "actions", episode.actions, n_steps, action_space)
    for name in ("rewards", "terminations", "truncations"):
        value = getattr(episode, name)
        require(value.shape == (n_steps,), f"{name} has shape {value.shape}, not ({n_steps},)")
    ends = episode.terminations | episode.truncations
    require(bool(ends[-1]) and not ends[:-1].any(), "an episode must end at its last step only")
    scenario = Scenario()
    states = episode.observations["state"].astype(np.float64)
    controls = episode.actions.astype(np.float64)
    exact = dynamics.rollout(states[0], controls, scenario.dt, scenario.robot)
    residual = float(np.abs(states - exact).max())
    require(residual <= 1e-6, f"the states are {residual:.1e} from the rollout of the actions")
    miss = float(np.abs(exact[-1] - episode.observations["goal"][0]).max())
    require(miss <= FEASIBILITY_TOLERANCE, f"the last state is {miss:.1e} from the goal")
    gap = abs(float(episode.rewards.sum()) + episode.attributes["cost"])
    require(gap <= 1e-9, f"the return differs from minus the cost by {gap:.1e}")
    obstacles = Obstacles.from_rows(episode.observations["obstacles"][0])
    times = scenario.dt * np.arange(n_steps, dtype=np.float64)
    depth = keep_out_depth(replace(scenario, obstacles=obstacles), exact[:-1, :2], times)
    # Float32 may move a node that touches a disc to its other side.
    least, most = (int((depth > margin).sum()) for margin in (2 * FEASIBILITY_TOLERANCE, 0.0))
    expected = 0 if episode.attributes["label"] == LABEL_SCP else episode.attributes["c_rel"]
    require(least <= expected <= most, f"{least} to {most} nodes violate keep-out, not {expected}")


def _check_array(require: Any, name: str, value: NDArray[Any], rows: int, space: Any) -> None:
    shape = (rows, *space.shape)
    require(value.shape == shape, f"{name} has shape {value.shape}, not {shape}")
    require(value.dtype == space.dtype, f"{name} is {value.dtype}, not {space.dtype}")
    require(bool(np.isfinite(value).all()), f"{name} is not finite")
    inside = bool((value >= space.low).all() and (value <= space.high).all())
    require(inside, f"{name} leaves its space")


class EpisodeWriter:
    """Writes episodes to a new HDF5 file; a context manager.

    Args:
        path: The file.
    """

    def __init__(self, path: Path) -> None:
        # Version 1.10 of the format: groups and single chunks without index blocks, 3 x smaller.
        self._file = h5py.File(path, "w", libver=("v110", "v110"))
        self._group_settings = h5p.create(h5p.GROUP_CREATE)
        self._group_settings.set_attr_phase_change(64, 48)
        self._layouts: dict[tuple[tuple[int, ...], bool], Any] = {}
        self._spaces: dict[tuple[int, ...], Any] = {}
        self._types = {
            np.dtype(kind): h5t.py_create(np.dtype(kind)) for kind in ("<f4", "<f8", "<i4", "?")
        }
        self._text = h5py.string_dtype()
        self._text_type = h5t.py_create(self._text, logical=True)
        self._scalar = h5s.create(h5s.SCALAR)
        self.n_episodes = 0
        self.n_steps = 0

    def __enter__(self) -> EpisodeWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._file.close()

    def write(self, episode: Episode) -> None:
        """Appends an episode (unchecked; see :func:`check_episode`)."""
        n_steps = len(episode.actions)
        name = b"episode_%d" % self.n_episodes
        group = h5g.create(self._file.id, name, gcpl=self._group_settings)
        observations = h5g.create(group, b"observations")
        for key, value in episode.observations.items():
            self._array(observations, key, value, compress=key != "state")
        self._array(group, "actions", episode.actions)
        self._array(group, "rewards", episode.rewards)
        self._array(group, "terminations", episode.terminations, compress=True)
        self._array(group, "truncations", episode.truncations, compress=True)
        # Present though empty: without it EpisodeData.infos is None, which its repr cannot print.
        h5g.create(group, b"infos")
        attributes = {"id": self.n_episodes, "total_steps": n_steps, **episode.attributes}
        for key, value in attributes.items():
            self._attribute(group, key, value)
        self.n_episodes += 1
        self.n_steps += n_steps

    def _array(self, group: Any, name: str, value: NDArray[Any], compress: bool = False) -> None:
        value = np.ascontiguousarray(value)
        shape = value.shape
        key = (shape, compress)
        if key not in self._layouts:
            layout = h5p.create(h5p.DATASET_CREATE)
            layout.set_obj_track_times(False)
            if compress:
                layout.set_chunk(shape)
                layout.set_shuffle()
                layout.set_deflate(4)
            self._layouts[key] = layout
            self._spaces[shape] = h5s.create_simple(shape)
        dataset = h5d.create(
            group, name.encode(), self._types[value.dtype], self._spaces[shape], self._layouts[key]
        )
        dataset.write(h5s.ALL, h5s.ALL, value)

    def _attribute(self, group: Any, name: str, value: int | float | str) -> None:
        if isinstance(value, str):
            kind, array = self._text_type, np.array(value, dtype=self._text)
        else:
            array = np.array(value, dtype="<f8" if isinstance(value, float) else "<i4")
            kind = self._types[array.dtype]
        h5a.create(group, name.encode(), kind, self._scalar).write(array)


def iterate_episodes(data_folder: Path) -> Iterator[dict[str, Any]]:
    """What the packed form needs of each episode, in order.

    Args:
        data_folder: The ``data`` folder of a Minari dataset of this package.

    Yields:
        ``controls`` (N, 3) and the attributes ``problem_index``, ``label``, ``rank`` and ``cost``;
        with the first episode of a problem also ``rel_cost``, ``c_rel`` and the problem's
        ``start``, ``goal``, ``obstacles`` and ``final_time``.

    Raises:
        ValueError: If the dataset was not made by this package.
    """
    previous: int | float = -1
    with h5py.File(data_folder / _FILE_NAME, "r") as file:
        for number in range(len(file)):
            try:
                group = h5g.open(file.id, b"episode_%d" % number)
                names = ("problem_index", "label", "rank", "cost")
                episode: dict[str, Any] = {name: _read_number(group, name) for name in names}
                episode["controls"] = _read_array(group, b"actions")
                if episode["problem_index"] != previous:
                    previous = episode["problem_index"]
                    episode |= {name: _read_number(group, name) for name in ("rel_cost", "c_rel")}
                    episode |= _read_problem(group)
            except KeyError as error:
                raise ValueError(
                    f"Episode {number} in {str(data_folder)!r} lacks {error}: not a dataset of "
                    f"freeflyer_datasets."
                ) from error
            yield episode


def _read_problem(group: Any) -> dict[str, Any]:
    first = {
        name: _read_array(group, b"observations/" + name.encode())[0]
        for name in ("state", "goal", "obstacles", "time_to_go")
    }
    return {
        "start": first["state"],
        "goal": first["goal"],
        "obstacles": first["obstacles"],
        "final_time": first["time_to_go"][0],
    }


def _read_array(group: Any, name: bytes) -> NDArray[np.float32]:
    dataset = h5d.open(group, name)
    value = np.empty(dataset.shape, dtype="<f4")
    dataset.read(h5s.ALL, h5s.ALL, value)
    return value


def _read_number(group: Any, name: str) -> int | float:
    value = np.empty((), dtype="<f8" if name in _FLOATS else "<i4")
    h5a.open(group, name.encode()).read(value)
    return value.item()


def dataset_folder(dataset_id: str) -> Path:
    """Where Minari keeps a dataset: ``MINARI_DATASETS_PATH``, or its default, and the id."""
    from minari.storage import get_dataset_path

    return Path(get_dataset_path(dataset_id))


def minari_source(folder: Path) -> str:
    """Tells whether a Minari dataset has changed: a hash of its metadata and the data's size."""
    metadata = (folder / "data" / "metadata.json").read_bytes()
    size = (folder / "data" / _FILE_NAME).stat().st_size
    return f"{hashlib.sha256(metadata).hexdigest()}:{size}"
