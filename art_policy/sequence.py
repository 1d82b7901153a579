"""Problems and trajectories as tensors, and the exact symmetries that turn one example into many.

Units stay SI here; the models scale what they read. Two symmetries of the optimal control problem
are applied to whole batches (:meth:`ProblemBatch.mirrored`, :meth:`ProblemBatch.reversed`); the
third, quarter turns of the body, is built into the models, which see headings only through
``cos 4 psi``, ``sin 4 psi`` and the turn from start to goal.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from freeflyer_env.robot import Robot
from freeflyer_env.scenario import Problem, Scenario

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
        discs: ``(B, M, 5)`` rows ``(x, y, keep-out radius, v_x, v_y)`` at time zero in m and m/s;
            radius zero is padding.
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
        """Stacks problems; the number of obstacles may differ.

        An obstacle that moves along waypoints is taken to move uniformly from where it is at time
        zero to where it is at the final time.
        """
        most = max((len(problem.scenario.obstacles) for problem in problems), default=0)
        discs = np.zeros((len(problems), most, 5), dtype=np.float32)
        for row, problem in zip(discs, problems):
            obstacles = problem.scenario.obstacles
            row[: len(obstacles), :2] = obstacles.centres
            row[: len(obstacles), 2] = problem.scenario.keep_out_radii
            if obstacles.moving:
                way = obstacles.centres_at(problem.final_time) - obstacles.centres
                row[: len(obstacles), 3:] = way / problem.final_time
        numbers = np.array(
            [(*problem.start, *problem.goal, problem.final_time) for problem in problems],
            dtype=np.float32,
        ).reshape(-1, 13)
        table = torch.from_numpy(numbers)
        return cls(table[:, :6], table[:, 6:12], torch.from_numpy(discs), table[:, 12])

    @classmethod
    def joined(cls, batches: Sequence[ProblemBatch]) -> ProblemBatch:
        """Batches behind one another; the number of discs may differ."""
        most = max(batch.discs.shape[1] for batch in batches)
        discs = [F.pad(b.discs, (0, 0, 0, most - b.discs.shape[1])) for b in batches]
        return cls(
            torch.cat([batch.start for batch in batches]),
            torch.cat([batch.goal for batch in batches]),
            torch.cat(discs),
            torch.cat([batch.final_time for batch in batches]),
        )

    def __getitem__(self, index: Tensor) -> ProblemBatch:
        return ProblemBatch(*(getattr(self, item.name)[index] for item in fields(self)))

    def by_number_of_discs(self, size: int) -> tuple[list[ProblemBatch], Tensor]:
        """Parts of at most ``size`` problems with about as many discs, hardly padded.

        Returns:
            The parts, fewest discs first, and the places ``(B,)`` of the problems among them: row
            ``i`` of this batch is row ``places[i]`` of the parts one after the other.
        """
        present = self.present
        counts, first = present.sum(1), (~present).byte().argsort(dim=1, stable=True)
        discs = self.discs.gather(1, first[..., None].expand_as(self.discs))
        order, parts = counts.argsort(stable=True), []
        for index in order.split(size):
            part = replace(self[index], discs=discs[index, : int(counts[index].max())])
            parts.append(part)
        return parts, order.argsort()

    def discs_at(self, times: Tensor) -> Tensor:
        """Rows ``(B, L, M, 3)``, ``(x, y, keep-out radius)``, at times ``(B, L)`` in s."""
        centres = self.discs[:, None, :, :2] + times[:, :, None, None] * self.discs[:, None, :, 3:]
        radius = self.discs[:, None, :, 2:3].expand(-1, times.shape[1], -1, -1)
        return torch.cat([centres, radius], dim=3)

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
        ends = self.start, self.goal, self.discs
        return self._mapped(which, ends, MIRROR_STATE[axis], size, axis)

    def reversed(self, which: Tensor, size: float, dt: float = Scenario.dt) -> ProblemBatch:
        """Reverses time and mirrors in x, so that the start stays on the left, where ``which``.

        Args:
            which: Where to reverse.
            size: Size of the table along x in m.
            dt: Step in s; the last impulse acts one step before the final time.
        """
        centres = self.discs_at(self.final_time[:, None] - dt)[:, 0]
        discs = torch.cat([centres, -self.discs[..., 3:]], dim=2)
        return self._mapped(which, (self.goal, self.start, discs), REVERSE_STATE, size, 0)

    def _mapped(
        self,
        which: Tensor,
        ends: tuple[Tensor, Tensor, Tensor],
        signs: tuple[float, ...],
        size: float,
        axis: int,
    ) -> ProblemBatch:
        start, goal, discs = ends
        sign, shift = start.new_tensor(signs), start.new_zeros(6)
        shift[axis] = size
        discs = discs.clone()
        discs[..., axis] = size - discs[..., axis]
        discs[..., 3 + axis] = -discs[..., 3 + axis]
        return ProblemBatch(
            torch.where(which[:, None], start * sign + shift, self.start),
            torch.where(which[:, None], goal * sign + shift, self.goal),
            torch.where(which[:, None, None], discs, self.discs),
            self.final_time,
        )


def random_flags(batch: int, generator: torch.Generator) -> Tensor:
    """``(batch,)`` fair coin tosses."""
    return torch.rand(batch, generator=generator) < 0.5


#: Random discs move in one problem of so many, at up to this speed in m/s, as in general-v0.
_MOVING_SHARE, DISC_SPEED = 0.25, 0.025


def random_discs(
    problems: ProblemBatch, table: tuple[float, float], generator: torch.Generator
) -> Tensor:
    """Rows ``(B, M, 5)`` as in :attr:`ProblemBatch.discs`, drawn as random scenes draw theirs."""
    scenario, shape = Scenario(), problems.discs.shape[:2]
    draw = torch.rand(*shape, 5, generator=generator)
    radius = 0.1 + 0.1 * draw[..., 0]
    x = 0.5 + (table[0] - 1.0) * draw[..., 1]
    y = radius + (table[1] - 2.0 * radius) * draw[..., 2]
    moving = torch.rand(shape[0], 1, generator=generator) < _MOVING_SHARE
    speed, course = DISC_SPEED * draw[..., 3] * moving, 2.0 * math.pi * draw[..., 4]
    keep_out = (radius + scenario.robot.radius) * scenario.keep_out_factor
    rows = torch.stack([x, y, keep_out, speed * course.cos(), speed * course.sin()], dim=2)
    return rows.to(problems.discs.device)


@dataclass(frozen=True, eq=False)
class SequenceBatch:
    """Windows of ``L`` steps of trajectories, with what the paper's eq. 3 puts at each step.

    Attributes:
        problems: The ``B`` problems.
        states: ``(B, L, 6)`` states before each impulse.
        controls: ``(B, L, 3)`` impulses per unit mass.
        next_states: ``(B, L, 6)`` states one step later.
        returns_to_go: ``(B, L)`` minus the cost from here on, in m/s (eq. 5).
        constraints_to_go: ``(B, L)`` violating nodes from here on (eq. 5, 6).
        time_to_go: ``(B, L)`` in s.
        valid: ``(B, L)`` False where a trajectory is shorter than the window.
    """

    problems: ProblemBatch
    states: Tensor
    controls: Tensor
    next_states: Tensor
    returns_to_go: Tensor
    constraints_to_go: Tensor
    time_to_go: Tensor
    valid: Tensor

    def __len__(self) -> int:
        return len(self.states)

    def to(self, device: torch.device | str) -> SequenceBatch:
        """The same on another device."""
        return SequenceBatch(*(getattr(self, item.name).to(device) for item in fields(self)))

    @classmethod
    def from_controls(
        cls,
        problems: ProblemBatch,
        controls: Tensor,
        n_steps: Tensor,
        dt: float,
        robot: Robot,
    ) -> SequenceBatch:
        """Whole trajectories from their controls.

        Args:
            problems: The ``B`` problems.
            controls: ``(B, L, 3)``, zero beyond the end.
            n_steps: ``(B,)`` number of controls of each.
            dt: Step in s.
            robot: Gives ``m / J``.
        """
        gain = controls.new_tensor(robot.control_gain)
        after = problems.start[:, None, 3:] + (controls * gain).cumsum(1)  # rates after impulses
        way = dt * after.cumsum(1)
        poses = torch.cat([torch.zeros_like(way[:, :1]), way[:, :-1]], dim=1)
        poses = problems.start[:, None, :3] + poses
        rates = torch.cat([problems.start[:, None, 3:], after[:, :-1]], dim=1)
        step = torch.arange(controls.shape[1], device=controls.device)
        valid = step < n_steps[:, None]
        times = (dt * step).expand(valid.shape)
        inside = keep_out_depth(problems.discs_at(times), poses[..., :2]) > KEEP_OUT_TOLERANCE
        return cls(
            problems,
            torch.cat([poses, rates], dim=2),
            controls,
            torch.cat([poses + dt * after, after], dim=2),
            _to_go(-controls.abs().sum(2)),
            _to_go((inside & valid).float()),
            problems.final_time[:, None] - dt * step,
            valid,
        )

    def window(self, first: Tensor, length: int) -> SequenceBatch:
        """The ``length`` steps that begin at ``first`` ``(B,)``."""
        index = first[:, None] + torch.arange(length, device=first.device)
        inside = index < self.valid.shape[1]
        index = index.clamp(max=self.valid.shape[1] - 1)
        rows = torch.arange(len(self), device=first.device)[:, None]
        parts = {item.name: getattr(self, item.name)[rows, index] for item in fields(self)[1:]}
        parts["valid"] = parts["valid"] & inside
        return SequenceBatch(self.problems, **parts)


#: Depth in m from which a node of a float32 rollout counts as inside a keep-out disc. Solutions
#: touch the discs to rounding; nodes of relaxed trajectories are centimetres inside.
KEEP_OUT_TOLERANCE = 1e-4


def keep_out_depth(discs: Tensor, positions: Tensor) -> Tensor:
    """How deep positions ``(B, L, 2)`` are inside the discs ``(B, L, M, 3)``, ``(B, L)`` in m.

    As :func:`freeflyer_env.constraints.keep_out_depth`, for a scene per row; padding is ignored.
    """
    if not discs.shape[2]:
        return torch.full_like(positions[..., 0], -torch.inf)
    gaps = (positions[:, :, None] - discs[..., :2]).norm(dim=3)  # (B, L, M)
    depth = discs[..., 2] - gaps
    return depth.masked_fill(discs[..., 2] <= 0.0, -torch.inf).amax(2)


def reverse_controls(controls: Tensor, n_steps: Tensor) -> Tensor:
    """Controls ``(B, L, 3)`` of the trajectories reversed in time and mirrored in x."""
    device = controls.device
    index = n_steps[:, None] - 1 - torch.arange(controls.shape[1], device=device)
    rows = torch.arange(len(controls), device=device)[:, None]
    flipped = controls[rows, index.clamp(min=0)] * controls.new_tensor(REVERSE_CONTROL)
    return flipped * (index >= 0)[..., None]


def _to_go(values: Tensor) -> Tensor:
    """Sums from each step to the end, along the last axis."""
    return values.flip(-1).cumsum(-1).flip(-1)
