"""The trajectory: what planners return and warm starts are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from freeflyer_env import constraints, dynamics
from freeflyer_env.robot import FloatArray
from freeflyer_env.scenario import Problem


@dataclass(frozen=True, eq=False)
class Trajectory:
    """States and controls on the nodes of the optimal control problem.

    Attributes:
        states: ``(N + 1, 6)`` states before each impulse, and after the last one (SI, global
            frame).
        controls: ``(N, 3)`` impulses per unit mass ``(dv_x, dv_y, h)``.
        dt: Step in s.
    """

    states: FloatArray
    controls: FloatArray
    dt: float

    def __post_init__(self) -> None:
        states = np.asarray(self.states, dtype=np.float64)
        controls = np.asarray(self.controls, dtype=np.float64)
        if states.ndim != 2 or states.shape[1] != 6 or controls.shape != (len(states) - 1, 3):
            raise ValueError(
                "A Trajectory needs states (N + 1, 6) and controls (N, 3), got "
                f"{states.shape} and {controls.shape}."
            )
        object.__setattr__(self, "states", states)
        object.__setattr__(self, "controls", controls)

    @classmethod
    def from_controls(cls, problem: Problem, controls: FloatArray) -> Trajectory:
        """The trajectory that ``controls`` ``(N, 3)`` produce from the problem's start."""
        dt, robot = problem.scenario.dt, problem.scenario.robot
        return cls(dynamics.rollout(problem.start, controls, dt, robot), controls, dt)

    @classmethod
    def from_poses(
        cls, problem: Problem, poses: FloatArray, *, with_controls: bool = False
    ) -> Trajectory:
        """A warm start through the poses ``(N, 3)`` of the nodes; the ends are the problem's.

        Args:
            problem: Gives start, goal and step.
            poses: ``(r_x, r_y, psi)`` at each node.
            with_controls: Whether the controls are those that the poses imply (they may exceed the
                actuation limit), or zero.
        """
        dt, robot, n = problem.scenario.dt, problem.scenario.robot, len(poses)
        states = np.empty((n + 1, 6))
        states[:n, :3], rates = poses, states[:, 3:]
        states[0] = problem.start
        states[-2, :3], states[-1] = problem.goal[:3], problem.goal
        np.subtract(states[1:n, :3], states[: n - 1, :3], out=rates[1:n])
        rates[1:n] /= dt
        controls = np.zeros((n, 3))
        if with_controls:
            controls = (rates[1:] - rates[:-1]) / robot.control_gain
        return cls(states, controls, dt)

    def stretched(self, problem: Problem) -> Trajectory:
        """The same path in another problem's time, between its start and goal: a warm start."""
        share = np.linspace(0.0, 1.0, self.n_steps)
        at = np.linspace(0.0, 1.0, problem.n_steps)
        poses = [np.interp(at, share, self.states[:-1, axis]) for axis in range(3)]
        return Trajectory.from_poses(problem, np.column_stack(poses))

    def landed(self, problem: Problem, last: int | None = None) -> Trajectory:
        """The trajectory with the least change of its controls that makes it end at the goal.

        It is the projection onto the dynamics and the goal, without the actuation limits: 2-norm of
        the change, each axis for itself.

        Args:
            problem: Gives the goal.
            last: How many of the last controls may change, at least 2; all if None.
        """
        steps = np.arange(self.n_steps)[-(last or self.n_steps) :]
        miss = (problem.goal - self.states[-1]).reshape(2, 3)  # pose, rates
        # The pose and the rate at the end per unit of each control.
        effect = np.array([self.dt * (self.n_steps - 1 - steps), np.ones(len(steps))])
        change = effect.T @ np.linalg.solve(effect @ effect.T, miss)
        controls = self.controls.copy()
        controls[steps] += change / problem.scenario.robot.control_gain
        return type(self).from_controls(problem, controls)

    @property
    def n_steps(self) -> int:
        return len(self.controls)

    @property
    def times(self) -> FloatArray:
        """``(N + 1,)`` times of the states in s; the last impulse acts at ``(N - 1) dt``."""
        return self.dt * np.arange(self.n_steps + 1, dtype=np.float64)

    @property
    def cost(self) -> float:
        """``sum_i ||u_i||_1``, the objective (paper, eq. 4a)."""
        return float(np.abs(self.controls).sum())

    def rewards(self) -> FloatArray:
        """``(N,)`` rewards ``r_i = -||u_i||_1``."""
        return -np.abs(self.controls).sum(axis=1)

    def violations(self, problem: Problem) -> FloatArray:
        """``(N,)`` constraint indicator ``C(t_i)`` (paper, eq. 6)."""
        return constraints.violations(problem.scenario, self.states, self.controls)

    def between_nodes_depth(self, problem: Problem) -> float:
        """Largest depth inside a keep-out disc on the way between two nodes in m, or 0; exact."""
        depth = constraints.between_nodes_depth(problem, self.states)
        return float(np.maximum(depth, 0.0).max())

    def check(self, problem: Problem) -> constraints.ConstraintReport:
        """Largest violation of each family of constraints."""
        return constraints.check(problem, self.states, self.controls)


def to_go(values: FloatArray) -> FloatArray:
    """Sums from each index to the end of the last axis: returns-to-go (paper, eq. 5)."""
    return np.cumsum(np.asarray(values)[..., ::-1], axis=-1)[..., ::-1]
