"""Re-planning in flight: a horizon that shrinks to the goal, warm-started by what was planned."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from freeflyer_env.planning.homotopy import push_out
from freeflyer_env.planning.multistart import race_scp
from freeflyer_env.planning.result import SCPResult
from freeflyer_env.planning.scp import SCPConfig, solve_scp
from freeflyer_env.planning.trajectory import Trajectory
from freeflyer_env.robot import FloatArray
from freeflyer_env.scenario import Problem


class RecedingHorizon:
    """Plans again and again from the current state to the same goal.

    Each plan covers the time that is left; its warm start is the last plan without the steps that
    have passed. Where no solution is found the last plan stays, so there is always one to follow.

    Args:
        problem: What was planned at time zero.
        plan: The plan of time zero; solved here if None.
        config: Settings of SCP. Default: elastic, so that a disturbed state near an obstacle does
            not stop it.
        least_steps: Shortest horizon in steps: when less time is left, the goal is reached later.
        propose: Gives further warm starts of a problem, a model's proposals for example. They race
            with the last plan, so that another way round an obstacle can be taken.

    Attributes:
        plan: The present plan, None if there has been none.
        planned_at: Time in s at which the present plan begins.
    """

    def __init__(
        self,
        problem: Problem,
        plan: Trajectory | None = None,
        config: SCPConfig | None = None,
        least_steps: int = 10,
        propose: Callable[[Problem], Sequence[Trajectory]] | None = None,
    ) -> None:
        if least_steps < 2:
            raise ValueError(f"least_steps must be at least 2, got {least_steps}.")
        self.problem, self.least_steps = problem, least_steps
        self.config, self.propose = config or SCPConfig(elastic=True), propose
        self.plan, self.planned_at = plan, 0.0
        if plan is None:
            result = solve_scp(problem, config=self.config)
            self.plan = result.trajectory if result.solved else None

    def replan(self, state: FloatArray, time: float) -> SCPResult:
        """Plans from ``state`` at ``time`` and keeps the plan if it is a solution.

        Args:
            state: ``(6,)`` measured state. One inside a keep-out disc or off the table is taken to
                the nearest place where it may be.
            time: In s since time zero of the problem.
        """
        problem = self.problem_from(state, time)
        result = self._solve(problem, self._shifted(problem, time))
        if result.solved:
            self.plan, self.planned_at = result.trajectory, time
        return result

    def _solve(self, problem: Problem, shifted: Trajectory | None) -> SCPResult:
        if self.propose is None:
            return solve_scp(problem, shifted, self.config)
        starts = [] if shifted is None else [shifted]
        starts += self.propose(problem)
        if not starts:
            return solve_scp(problem, None, self.config)
        best = min(race_scp(problem, starts, self.config), key=lambda result: result.cost)
        if best.solved or not self.config.reroutes:
            return best
        return solve_scp(problem, starts[0], self.config)

    def problem_from(self, state: FloatArray, time: float) -> Problem:
        """The problem that is left at ``time``: obstacles moved on, heading near the plan's."""
        scenario, dt = self.problem.scenario, self.problem.scenario.dt
        if scenario.obstacles.moving:
            scenario = replace(scenario, obstacles=scenario.obstacles.after(time))
        start = np.array(state, dtype=np.float64)
        start[:2] = push_out(scenario, start[:2], margin=1e-9)
        expected = self.problem.start[2]
        if self.plan is not None:
            expected = self.plan.states[min(self._passed(time), self.plan.n_steps), 2]
        start[2] += 2.0 * np.pi * np.round((expected - start[2]) / (2.0 * np.pi))
        steps = max(self.problem.n_steps - round(time / dt), self.least_steps)
        return Problem(scenario, start, self.problem.goal, steps * dt)

    def _passed(self, time: float) -> int:
        """Steps of the present plan that have passed."""
        return max(round((time - self.planned_at) / self.problem.scenario.dt), 0)

    def _shifted(self, problem: Problem, time: float) -> Trajectory | None:
        """The present plan from ``time`` on; beyond its end the goal is held."""
        if self.plan is None:
            return None
        ahead = self._passed(time) + np.arange(problem.n_steps)
        nodes = np.minimum(ahead, self.plan.n_steps - 1)
        poses = Trajectory.from_poses(problem, self.plan.states[nodes, :3])
        controls = np.where((ahead == nodes)[:, None], self.plan.controls[nodes], 0.0)
        return Trajectory(poses.states, controls, poses.dt)
