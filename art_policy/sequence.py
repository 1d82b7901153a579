"""Problems and trajectories as tensors, and the exact symmetries that turn one example into many.

Units stay SI here; the models scale what they read. Two symmetries of the optimal control problem are
applied to whole batches (:meth:`ProblemBatch.mirrored`, :meth:`ProblemBatch.reversed`); the third,
quarter turns of the body, is built into the models, which see headings only through
``cos 4 psi, sin 4 psi`` and the turn from start to goal.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from freeflyer_env.scenario import Problem

#: What mirroring in x or in y does to the signs of a state and of a control.
MIRROR_STATE = ((-1.0, 1.0, -1.0, -1.0, 1.0, -1.0), (1.0, -1.0, -1.0, 1.0, -1.0, -1.0))
MIRROR_CONTROL = ((-1.0, 1.0, -1.0), (1.0, -1.0, -1.0))

#: What reversing time and mirroring in x together do to them (besides the order of the nodes).
REVERSE_STATE = (-1.0, 1.0, -1.0, 1.0, -1.0, 1.0)
REVERSE_CONTROL = (-1.0, 1.0, -1.0)


@dataclass(frozen=True, eq=False)
class ProblemBatch:
    """Problems as float32 tensors.

    Attributes:
        start: ``(B, 6)`` states at time zero, SI.
        goal: ``(B, 6)`` goal states.
        discs: ``(B, M, 3)`` rows ``(x, y, keep-out radius)`` in m; radius zero is padding.
        final_time: ``(B,)`` in s.
    """

    start: Tensor
    goal: Tensor
    discs: Tensor
    final_time: Tensor

    def __len__(self) -> int:
        return len(self.start)

    @property
    def present(self) -> Tensor:
        """``(B, M)`` True where a disc is real."""
        return self.discs[..., 2] > 0.0

    @classmethod
    def from_problems(cls, problems: Sequence[Problem]) -> ProblemBatch:
        """Stacks problems; the number of obstacles may differ."""
        most = max((len(problem.scenario.obstacles) for problem in problems), default=0)
        discs = np.zeros((len(problems), most, 3), dtype=np.float32)
        for row, problem in zip(discs, problems):
            scenario = problem.scenario
            row[: len(scenario.obstacles), :2] = scenario.obstacles.centres
            row[: len(scenario.obstacles), 2] = scenario.keep_out_radii
        numbers = np.array(
            [(*problem.start, *problem.goal, problem.final_time) for problem in problems],
            dtype=np.float32,
        ).reshape(-1, 13)
        table = torch.from_numpy(numbers)
        return cls(table[:, :6], table[:, 6:12], torch.from_numpy(discs), table[:, 12])

    def __getitem__(self, index: Tensor) -> ProblemBatch:
        return ProblemBatch(*(getattr(self, item.name)[index] for item in fields(self)))

    def to(self, device: torch.device | str) -> ProblemBatch:
        """The same on another device."""
        return ProblemBatch(*(getattr(self, item.name).to(device) for item in fields(self)))

    def mirrored(self, which: Tensor, size: float, axis: int = 1) -> ProblemBatch:
        """Mirrors the problems where ``which`` ``(B,)`` is True.

        Args:
            which: Where to mirror.
            size: Size of the table along ``axis`` in m.
            axis: The coordinate that changes sign: 0 for x, 1 for y.
        """
        return self._mapped(which, self.start, self.goal, MIRROR_STATE[axis], size, axis)

    def reversed(self, which: Tensor, size: float) -> ProblemBatch:
        """Reverses time and mirrors in x, which puts the start on the left again, where ``which``."""
        return self._mapped(which, self.goal, self.start, REVERSE_STATE, size, 0)

    def _mapped(
        self,
        which: Tensor,
        start: Tensor,
        goal: Tensor,
        signs: tuple[float, ...],
        size: float,
        axis: int,
    ) -> ProblemBatch:
        sign, shift = start.new_tensor(signs), start.new_zeros(6)
        shift[axis] = size
        discs = self.discs.clone()
        discs[..., axis] = size - discs[..., axis]
        return ProblemBatch(
            torch.where(which[:, None], start * sign + shift, self.start),
            torch.where(which[:, None], goal * sign + shift, self.goal),
            torch.where(which[:, None, None], discs, self.discs),
            self.final_time,
        )


def random_flags(batch: int, generator: torch.Generator) -> Tensor:
    """``(batch,)`` fair coin tosses."""
    return torch.rand(batch, generator=generator) < 0.5
