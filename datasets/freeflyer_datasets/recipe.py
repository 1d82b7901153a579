"""Recipes: what a dataset is made of, as a small TOML file.

::

    id = "freeflyer/scene-random-v0"
    description = "A new random scene for every problem."
    n_problems = 400_000
    seed = 6
    scenes = "random"                  # or a list of scene names, drawn uniformly
    n_obstacles = 4                    # or [1, 6]; random scenes only
    obstacle_speeds = [0.0]            # or [0.0, 0.02]: half of the random scenes move
    final_times = [40.0]               # drawn uniformly; or { range = [40.0, 100.0] }
    n_starts = 6                       # 1: SCP from the relaxed solution alone
    optima = "all"                     # every distinct local optimum; or "best", or "first"

Problem ``i`` of a recipe depends on ``(seed, i)`` alone: :meth:`Recipe.problem`.
"""

from __future__ import annotations

import dataclasses
import difflib
import hashlib
import json
import re
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from freeflyer_env.sampling import sample_problem
from freeflyer_env.scenario import SCENES, Obstacles, Problem, Scenario

_ID_PATTERN = re.compile(r"(?:[-\w]+/)*[-\w]+-v\d+")
#: What is kept of a problem's solutions; see :class:`Recipe`.
OPTIMA = ("all", "best", "first")

_MAX_STARTS = 64
_MAX_OBSTACLES = 12
_MAX_STEPS = 1000
_DT = Scenario().dt


@dataclass(frozen=True)
class Recipe:
    """How the problems of a dataset are drawn and solved.

    Attributes:
        id: Minari dataset id, ``namespace/name-vN``.
        description: One or two sentences for the dataset card.
        n_problems: How many problems; each gives one relaxed and at least zero SCP trajectories.
        seed: Seed of the problems.
        scenes: ``"random"`` for a new scene in every problem, or names of
            :data:`freeflyer_env.SCENES` that are drawn uniformly.
        n_obstacles: Smallest and largest number of obstacles of a random scene; an int means both.
            None with named scenes.
        obstacle_speeds: Largest speeds of the obstacles in m/s, one of which is drawn uniformly for
            each problem; random scenes only. Each obstacle moves uniformly in a random direction.
        final_times: Final times in s, drawn uniformly.
        n_starts: Warm starts that SCP is started from; the first one is the relaxed solution.
        optima: ``"all"`` keeps every distinct local optimum, ``"best"`` the cheapest of a race,
            ``"first"`` that of the first start that is solved: SCP from REL as in the paper, and
            other starts only where that fails; about four times as fast.

    Raises:
        ValueError: On a value out of range; the message names the field, the value and the range.
    """

    id: str
    description: str
    n_problems: int
    seed: int
    scenes: str | tuple[str, ...] = "random"
    n_obstacles: int | tuple[int, int] | None = None
    obstacle_speeds: tuple[float, ...] = (0.0,)
    final_times: tuple[float, ...] = (40.0,)
    n_starts: int = 6
    optima: str = "all"

    def __post_init__(self) -> None:
        if not isinstance(self.id, str) or not _ID_PATTERN.fullmatch(self.id):
            raise ValueError(
                f"id must look like 'namespace/name-v0' (letters, digits, -, _), got {self.id!r}."
            )
        if not isinstance(self.description, str) or not self.description.strip():
            raise ValueError(f"description must be a sentence, got {self.description!r}.")
        _require_int("n_problems", self.n_problems, 1, 100_000_000)
        _require_int("seed", self.seed, 0, 2**63 - 1)
        _require_int("n_starts", self.n_starts, 1, _MAX_STARTS)
        if self.optima not in OPTIMA:
            raise ValueError(f"optima must be one of {OPTIMA}, got {self.optima!r}.")
        object.__setattr__(self, "scenes", _scenes(self.scenes))
        object.__setattr__(self, "n_obstacles", _obstacle_range(self.n_obstacles, self.scenes))
        object.__setattr__(self, "final_times", _final_times(self.final_times))
        object.__setattr__(self, "obstacle_speeds", self._checked_speeds())

    @property
    def max_obstacles(self) -> int:
        """Largest number of obstacles that a problem of this recipe can have."""
        if isinstance(self.n_obstacles, tuple):
            return self.n_obstacles[1]
        return max(len(SCENES[name]) for name in self.scenes)

    @property
    def moving(self) -> bool:
        """Whether the obstacles of some problems move."""
        return any(self.obstacle_speeds)

    @property
    def fingerprint(self) -> str:
        """Hash of all that decides what a problem and its trajectories are.

        Not part of it are the description and ``n_problems``: a longer dataset starts with the
        problems of a shorter one.
        """
        fields = dataclasses.asdict(self)
        del fields["description"], fields["n_problems"]
        if not self.moving:  # as for recipes from before there were speeds
            del fields["obstacle_speeds"]
        text = json.dumps(fields, sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()

    def problem(self, index: int) -> Problem:
        """Problem ``index``, which depends on ``(seed, index)`` alone.

        Every number in it is exact in float32, so that a problem read back from a dataset is the
        same problem.
        """
        rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(index,)))
        final_time = self.final_times[rng.integers(len(self.final_times))]
        if isinstance(self.n_obstacles, tuple):
            low, high = self.n_obstacles
            n_obstacles = int(rng.integers(low, high + 1))
            speed = rng.choice(self.obstacle_speeds) if self.moving else 0.0
            return sample_problem(
                rng, final_time=final_time, n_obstacles=n_obstacles, obstacle_speed=speed
            )
        name = self.scenes[rng.integers(len(self.scenes))]
        rows = np.float32(SCENES[name].rows())
        scenario = replace(Scenario.named(name), obstacles=Obstacles.from_rows(rows))
        return sample_problem(rng, scenario, final_time)

    def _checked_speeds(self) -> tuple[float, ...]:
        # No observation can tell of an obstacle that is farther off the table than its height.
        most = Scenario.table[1] / max(self.final_times)
        speeds = self.obstacle_speeds
        if not isinstance(speeds, list | tuple) or not speeds:
            raise ValueError(f"obstacle_speeds must be a list of speeds in m/s, got {speeds!r}.")
        for speed in speeds:
            if type(speed) not in (int, float) or not 0.0 <= speed <= most:
                raise ValueError(
                    f"obstacle_speeds must be in [0, {most:g}] m/s for final times of up to "
                    f"{max(self.final_times):g} s, got {speed!r}."
                )
        if any(speeds) and self.scenes != "random":
            raise ValueError("obstacle_speeds is for scenes = 'random' only; remove it.")
        return tuple(float(speed) for speed in speeds)

    def to_dict(self) -> dict[str, Any]:
        """The fields as plain values, for JSON; :meth:`from_dict` is its inverse."""
        fields: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(self)))
        return {key: value for key, value in fields.items() if value is not None}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Recipe:
        """A recipe from a mapping with the keys of a recipe file.

        Raises:
            ValueError: On an unknown, missing or bad key.
        """
        known = [field.name for field in dataclasses.fields(cls)]
        for key in data:
            if key not in known:
                near = difflib.get_close_matches(key, known, n=1)
                hint = f" Did you mean {near[0]!r}?" if near else ""
                raise ValueError(f"unknown key {key!r}.{hint} Known keys: {', '.join(known)}.")
        missing = [key for key in ("id", "description", "n_problems", "seed") if key not in data]
        if missing:
            raise ValueError(f"missing key {missing[0]!r}; a recipe needs it.")
        values = dict(data)
        for key in ("scenes", "n_obstacles", "obstacle_speeds", "final_times"):
            if isinstance(values.get(key), list):
                values[key] = tuple(values[key])
        if isinstance(values.get("final_times"), Mapping):
            values["final_times"] = _expand_range(values["final_times"])
        return cls(**values)


def load_recipe(name_or_path: str | Path) -> Recipe:
    """Loads a recipe by the name of a packaged one, or from a TOML file.

    Args:
        name_or_path: ``"scene-random-v0"``, ``"freeflyer/scene-random-v0"``, the name without its
            version, or the path of a ``.toml`` file.

    Raises:
        ValueError: If there is no such recipe, or the file has a mistake; the message names the
            file and the key.
    """
    path = _recipe_path(name_or_path)
    try:
        return Recipe.from_dict(tomllib.loads(path.read_text(encoding="utf-8")))
    except (ValueError, TypeError) as error:
        raise ValueError(f"Recipe {path.name}: {error}") from error


def list_recipes() -> list[str]:
    """Names of the packaged recipes, such as ``"scene-random-v0"``."""
    return sorted(path.stem for path in packaged_folder("recipes").glob("*.toml"))


def packaged_folder(name: str) -> Path:
    """A folder of data: in an installed package beside this file, in a checkout one level up."""
    here = Path(__file__).resolve().parent
    packaged = here / name
    return packaged if packaged.is_dir() else here.parent / name


def _recipe_path(name_or_path: str | Path) -> Path:
    path = Path(name_or_path)
    if path.suffix == ".toml":
        if not path.is_file():
            raise ValueError(f"There is no recipe file {str(path)!r}.")
        return path
    names = list_recipes()
    name = str(name_or_path).removeprefix("freeflyer/")
    if name not in names:
        versions = [known for known in names if re.fullmatch(rf"{re.escape(name)}-v\d+", known)]
        if not versions:
            near = difflib.get_close_matches(name, names, n=1)
            hint = f" Did you mean {near[0]!r}?" if near else ""
            raise ValueError(f"No recipe is called {name!r}.{hint} Known: {', '.join(names)}.")
        name = max(versions, key=lambda known: int(known.rsplit("-v", 1)[1]))
    return packaged_folder("recipes") / f"{name}.toml"


def _require_int(name: str, value: object, low: int, high: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise ValueError(f"{name} must be a whole number in [{low}, {high}], got {value!r}.")
    return value


def _scenes(scenes: object) -> str | tuple[str, ...]:
    if scenes == "random":
        return "random"
    if isinstance(scenes, str):
        scenes = (scenes,)
    if not isinstance(scenes, Iterable) or not (names := tuple(scenes)):
        raise ValueError(f"scenes must be 'random' or a list of scene names, got {scenes!r}.")
    for name in names:
        if name not in SCENES:
            near = difflib.get_close_matches(str(name), ["random", *SCENES], n=1)
            hint = f" Did you mean {near[0]!r}?" if near else ""
            raise ValueError(
                f"scenes must be 'random' or names of known scenes, got {name!r}.{hint} "
                f"Known: {', '.join(SCENES)}."
            )
    return names


def _obstacle_range(value: object, scenes: str | tuple[str, ...]) -> tuple[int, int] | None:
    if scenes != "random":
        if value is not None:
            raise ValueError(
                f"n_obstacles is for scenes = 'random' only, got {value!r}; remove it."
            )
        return None
    value = 4 if value is None else value
    low, high = value if isinstance(value, tuple) and len(value) == 2 else (value, value)
    low = _require_int("n_obstacles", low, 0, _MAX_OBSTACLES)
    high = _require_int("n_obstacles", high, 0, _MAX_OBSTACLES)
    if low > high:
        raise ValueError(f"n_obstacles must be [smallest, largest], got [{low}, {high}].")
    return low, high


def _final_times(values: object) -> tuple[float, ...]:
    if not isinstance(values, Iterable) or isinstance(values, str) or not (times := tuple(values)):
        raise ValueError(
            f"final_times must be a list of times in s or {{ range = [lo, hi] }}, got {values!r}."
        )
    return tuple(_require_time(time) for time in times)


def _require_time(time: object) -> float:
    low, high = 2 * _DT, _MAX_STEPS * _DT
    number = float(time) if type(time) in (int, float) else np.nan  # type: ignore[arg-type]
    if low <= number <= high and abs(number / _DT - round(number / _DT)) <= 1e-9:
        return number
    raise ValueError(
        f"final_times must be multiples of dt = {_DT} s in [{low}, {high}] s, got {time!r}."
    )


def _expand_range(table: Mapping[str, Any]) -> tuple[float, ...]:
    """All multiples of dt in ``{range = [lo, hi]}``."""
    ends = table.get("range")
    if set(table) != {"range"} or not isinstance(ends, list) or len(ends) != 2:
        raise ValueError(
            f"final_times must be a list or {{ range = [lo, hi] }}, got {dict(table)}."
        )
    low, high = (round(_require_time(time) / _DT) for time in ends)
    if low > high:
        raise ValueError(f"final_times.range must be [smallest, largest], got {ends}.")
    return tuple(_DT * steps for steps in range(low, high + 1))
