"""What a model was trained on, so that it can say when it is asked for something else."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from art_policy.sequence import ProblemBatch
from freeflyer_env.scenario import Problem


@dataclass(frozen=True)
class Envelope:
    """Ranges of the problems of a training.

    Attributes:
        final_time: Shortest and longest final time in s, of problems that begin at rest if there
            are any.
        n_obstacles: Smallest and largest number of obstacles.
        obstacle_speed: Largest speed of an obstacle in m/s.
        end_speed: Largest speed of a start or a goal in m/s.
    """

    final_time: tuple[float, float]
    n_obstacles: tuple[int, int]
    obstacle_speed: float
    end_speed: float

    @classmethod
    def of(cls, problems: ProblemBatch) -> Envelope:
        """The ranges of these problems."""
        counts, speeds = problems.present.sum(1), problems.discs[..., 3:].norm(dim=2)
        begin, end = (each[:, 3:5].norm(dim=1) for each in (problems.start, problems.goal))
        times = problems.final_time[begin == 0.0] if (begin == 0.0).any() else problems.final_time
        return cls(
            (_rounded(times.min()), _rounded(times.max())),
            (int(counts.min()), int(counts.max())),
            _rounded(speeds.max()) if speeds.numel() else 0.0,
            _rounded(max(begin.max(), end.max())),
        )

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Envelope:
        """The ranges that ``dataclasses.asdict`` described."""
        pairs = {name: tuple(data[name]) for name in ("final_time", "n_obstacles")}
        return cls(**{**data, **pairs})

    def outside(self, problem: Problem) -> str | None:
        """In what a problem lies outside of the ranges, or None."""
        obstacles = problem.scenario.obstacles
        speed = 0.0
        if obstacles.moving:
            way = obstacles.centres_at(problem.final_time) - obstacles.centres
            speed = float((way**2).sum(axis=1).max() ** 0.5) / problem.final_time
        ends = (problem.start, problem.goal)
        end_speed = float(max((end[3:5] ** 2).sum() ** 0.5 for end in ends))
        for what, unit, value, (low, high) in (
            ("final time", " s", problem.final_time, self.final_time),
            ("number of obstacles", "", len(obstacles), self.n_obstacles),
            ("speed of the obstacles", " m/s", speed, (0.0, self.obstacle_speed)),
            ("speed at start or goal", " m/s", end_speed, (0.0, self.end_speed)),
        ):
            slack = 1e-3 * (high - low) + 1e-4
            if not low - slack <= value <= high + slack:
                return (
                    f"the {what}, {value:g}{unit}, is not in the {low:g} to {high:g}{unit} that "
                    "the model was trained on"
                )
        return None


def _rounded(value: Any) -> float:
    return round(float(value), 4)
