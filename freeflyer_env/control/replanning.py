"""Model-predictive control on the whole problem: SCP re-plans in flight."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from freeflyer_env.control.pid import PIDTracker
from freeflyer_env.control.reference import Tracker
from freeflyer_env.robot import FloatArray

if TYPE_CHECKING:
    from freeflyer_env.planning.receding_horizon import RecedingHorizon
    from freeflyer_env.planning.result import SCPResult
    from freeflyer_env.planning.scp import SCPConfig
    from freeflyer_env.planning.trajectory import Trajectory
    from freeflyer_env.scenario import Problem


class ReplanningTracker:
    """Re-plans with SCP from the measured state; another tracker follows the latest plan.

    Args:
        problem: The problem that is flown.
        period: Time between re-plans in s.
        config: Settings of SCP; default: those of :class:`RecedingHorizon`.
        follower: Follows the latest plan; default: PID with the paper's gains.
        least_steps: With fewer steps to go the last plan is flown to its end.
        propose: Gives further warm starts, as for :class:`RecedingHorizon`; for a model's use
            ``WarmStartPlanner.proposals``.

    Attributes:
        results: The SCP result of every re-plan of the flight.
    """

    def __init__(
        self,
        problem: Problem,
        period: float = 0.5,
        config: SCPConfig | None = None,
        follower: Tracker | None = None,
        least_steps: int = 10,
        propose: Callable[[Problem], Sequence[Trajectory]] | None = None,
    ) -> None:
        if not period > 0.0:
            raise ValueError(f"ReplanningTracker.period must be positive, got {period}.")
        self.problem, self.period, self.config = problem, period, config
        self.least_steps, self.propose = least_steps, propose
        self.follower: Tracker = follower or PIDTracker(problem.scenario.robot)
        self.reset()

    def reset(self) -> None:
        """Forgets the flight."""
        self.follower.reset()
        self.results: list[SCPResult] = []
        self._horizon: RecedingHorizon | None = None
        self._due = self.period

    def reference(self, trajectory: Trajectory, time: float) -> FloatArray:
        """State ``(6,)`` that the tracker wants to be in at ``time`` in s."""
        plan, began = self._present(trajectory)
        return self.follower.reference(plan, time - began)

    def duties(
        self, state: FloatArray, trajectory: Trajectory, time: float, dt: float
    ) -> FloatArray:
        """Thruster duties ``(8,)``; re-plans first if it is time. Arguments as for PID."""
        from freeflyer_env.planning.receding_horizon import RecedingHorizon

        if self._horizon is None:
            self._horizon = RecedingHorizon(
                self.problem, trajectory, self.config, self.least_steps, self.propose
            )
        step = self.problem.scenario.dt
        left = self.problem.final_time - time
        if time > self._due - 1e-9 and left > self.least_steps * step - 1e-9:
            # Thrusters spread each impulse over a step, half a step later on average.
            ahead = np.array(state, dtype=np.float64)
            ahead[:3] += 0.5 * step * ahead[3:]
            self.results.append(self._horizon.replan(ahead, time))
            self._due = time + self.period
        plan, began = self._present(trajectory)
        return self.follower.duties(state, plan, time - began, dt)

    def _present(self, trajectory: Trajectory) -> tuple[Trajectory, float]:
        if self._horizon is None or self._horizon.plan is None:
            return trajectory, 0.0
        return self._horizon.plan, self._horizon.planned_at
