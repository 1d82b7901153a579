"""Flying a plan: reference, PID tracking, re-planning (MPC), pulse-width modulation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from freeflyer_env.robot import FloatArray, Robot, body_from_world

if TYPE_CHECKING:
    import gymnasium as gym

    from freeflyer_env.planning.receding_horizon import RecedingHorizon
    from freeflyer_env.planning.result import SCPResult
    from freeflyer_env.planning.scp import SCPConfig
    from freeflyer_env.planning.trajectory import Trajectory
    from freeflyer_env.scenario import Problem


class PulseWidthModulator:
    """Turns duties into on/off pulses, one period at a time.

    On-times are whole numbers of sub-steps. What rounding leaves over is carried to the next
    period, so that small duties act on average instead of vanishing.

    Args:
        sub_steps: Sub-steps in a period.
    """

    def __init__(self, sub_steps: int) -> None:
        self.sub_steps = sub_steps
        self.reset()

    def reset(self) -> None:
        """Forgets what was carried over."""
        self.carried = np.zeros(8)

    def pulses(self, duties: FloatArray) -> NDArray[np.bool_]:
        """Which thruster is on in which sub-step of the next period.

        Args:
            duties: ``(8,)`` in [0, 1].

        Returns:
            ``(sub_steps, 8)``; each pulse lies in the middle of the period.
        """
        wanted = np.clip(duties, 0.0, 1.0) * self.sub_steps + self.carried
        # Rounding first strips the float noise that could tip an on-time over.
        on = np.clip(np.floor(np.round(wanted, 9) + 0.5), 0, self.sub_steps).astype(int)
        self.carried = np.where(np.asarray(duties) > 0.0, np.clip(wanted - on, -1.0, 1.0), 0.0)
        first = (self.sub_steps - on) // 2
        index = np.arange(self.sub_steps)[:, None]
        return (index >= first) & (index < first + on)


def reference_at(trajectory: Trajectory, time: float) -> tuple[FloatArray, FloatArray]:
    """Reference of a tracker at ``time``: where the plan is, and how its velocity changes.

    The plan's impulses act at the nodes; thrusters need time. The reference spreads each impulse
    evenly over the step that it begins. That is a motion with piecewise constant acceleration which
    the thrusters can follow, half a step behind the plan: a plan from rest to rest is followed from
    start to goal. A plan that begins in motion is to be made from where the robot will be half a
    step later, as :class:`MPCTracker` does; one that ends in motion passes its goal that much late.

    Args:
        trajectory: The plan.
        time: In s; before 0 the plan's first state is held, beyond the end its last.

    Returns:
        State ``(6,)`` and acceleration ``(3,)`` (m/s^2, m/s^2, rad/s^2).
    """
    dt, n = trajectory.dt, trajectory.n_steps
    time = max(time, 0.0)
    index = int(np.floor(time / dt + 1e-9))
    if index >= n:
        return trajectory.states[-1].copy(), np.zeros(3)
    tau = time - index * dt
    before, after = trajectory.states[index, 3:], trajectory.states[index + 1, 3:]
    acceleration = (after - before) / dt
    behind = 0.5 * dt * before
    pose = trajectory.states[index, :3] - behind + before * tau + 0.5 * acceleration * tau**2
    return np.concatenate([pose, before + acceleration * tau]), acceleration


class PIDTracker:
    """PID control of position and heading about a plan, with the plan's impulses fed forward.

    Args:
        robot: Mass properties and thrusters.
        kp: Gains on ``(r_x, r_y, psi)`` in N/m, N/m, N m/rad (paper, Sec. IV-D).
        ki: Gains on the integral of the error.
        kd: Gains on ``(v_x, v_y, omega)`` in N s/m, N s/m, N m s/rad.
        feedforward: Whether the plan's acceleration is fed forward. Without it the paper's gains
            leave the robot up to 10 cm behind, with it 0.3 mm.
    """

    def __init__(
        self,
        robot: Robot,
        kp: Sequence[float] = (2.0, 2.0, 0.2),
        ki: Sequence[float] = (0.0, 0.0, 0.0),
        kd: Sequence[float] = (10.0, 10.0, 0.4),
        feedforward: bool = True,
    ) -> None:
        self.robot, self.feedforward = robot, feedforward
        gains = [np.asarray(gain, dtype=np.float64) for gain in (kp, ki, kd)]
        if any(gain.shape != (3,) or not (gain >= 0.0).all() for gain in gains):
            raise ValueError(f"Gains must be three numbers >= 0 each, got {kp}, {ki}, {kd}.")
        self._kp, self._ki, self._kd = gains
        self.reset()

    def reset(self) -> None:
        """Forgets the integral of the error."""
        self._integral = np.zeros(3)

    def reference(self, trajectory: Trajectory, time: float) -> FloatArray:
        """State ``(6,)`` that the tracker wants to be in at ``time`` in s."""
        return reference_at(trajectory, time)[0]

    def duties(
        self, state: FloatArray, trajectory: Trajectory, time: float, dt: float
    ) -> FloatArray:
        """Thruster duties ``(8,)`` for the control period that starts at ``time``.

        Args:
            state: ``(6,)`` measured state.
            trajectory: The plan to follow.
            time: In s since the plan's start.
            dt: Length of the control period in s.
        """
        reference, acceleration = reference_at(trajectory, time)
        error = reference - state
        self._integral += error[:3] * dt
        wrench = self._kp * error[:3] + self._ki * self._integral + self._kd * error[3:]
        if self.feedforward:
            wrench += acceleration * [self.robot.mass, self.robot.mass, self.robot.inertia]
        # The heading in the middle of the period, where the pulses are.
        return self.robot.allocate(body_from_world(state[2] + 0.5 * dt * state[5], wrench))


class MPCTracker:
    """Model-predictive control: re-plans from the measured state, PID follows the latest plan.

    Args:
        problem: The problem that is flown.
        period: Time between re-plans in s.
        config: Settings of SCP; default: those of :class:`RecedingHorizon`.
        pid: Follows the plan between re-plans; default: PID with the paper's gains.
        least_steps: With fewer steps to go the last plan is flown to its end.

    Attributes:
        results: The SCP result of every re-plan of the flight.
    """

    def __init__(
        self,
        problem: Problem,
        period: float = 0.5,
        config: SCPConfig | None = None,
        pid: PIDTracker | None = None,
        least_steps: int = 10,
    ) -> None:
        if not period > 0.0:
            raise ValueError(f"MPCTracker.period must be positive, got {period}.")
        self.problem, self.period, self.config = problem, period, config
        self.pid, self.least_steps = pid or PIDTracker(problem.scenario.robot), least_steps
        self.reset()

    def reset(self) -> None:
        """Forgets the flight."""
        self.pid.reset()
        self.results: list[SCPResult] = []
        self._horizon: RecedingHorizon | None = None
        self._due = self.period

    def reference(self, trajectory: Trajectory, time: float) -> FloatArray:
        """State ``(6,)`` that the tracker wants to be in at ``time`` in s."""
        plan, began = self._present(trajectory)
        return self.pid.reference(plan, time - began)

    def duties(
        self, state: FloatArray, trajectory: Trajectory, time: float, dt: float
    ) -> FloatArray:
        """Thruster duties ``(8,)``; re-plans first if it is time. Arguments as for PID."""
        from freeflyer_env.planning.receding_horizon import RecedingHorizon

        if self._horizon is None:
            self._horizon = RecedingHorizon(self.problem, trajectory, self.config, self.least_steps)
        step = self.problem.scenario.dt
        left = self.problem.final_time - time
        if time > self._due - 1e-9 and left > self.least_steps * step - 1e-9:
            # Thrusters spread each impulse over a step, half a step later on average.
            ahead = np.array(state, dtype=np.float64)
            ahead[:3] += 0.5 * step * ahead[3:]
            self.results.append(self._horizon.replan(ahead, time))
            self._due = time + self.period
        plan, began = self._present(trajectory)
        return self.pid.duties(state, plan, time - began, dt)

    def _present(self, trajectory: Trajectory) -> tuple[Trajectory, float]:
        if self._horizon is None or self._horizon.plan is None:
            return trajectory, 0.0
        return self._horizon.plan, self._horizon.planned_at


@dataclass(frozen=True, eq=False)
class Flight:
    """A recorded flight.

    Attributes:
        times: ``(K + 1,)`` in s.
        states: ``(K + 1, 6)``.
        duties: ``(K, 8)`` commanded duties.
        firing_time: Cumulative on-time of all eight thrusters in s, as the paper reports it.
        contacts: Number of contacts.
        contact_impulse: Sum of the contacts' impulses in N s.
        tracking_error: Largest distance from the tracker's reference in m.
        final_error: ``(position, heading, speed, rate)`` away from the goal at the end (m, rad,
            ...).
        success: What the environment said at the end.
    """

    times: FloatArray
    states: FloatArray
    duties: FloatArray
    firing_time: float
    contacts: int
    contact_impulse: float
    tracking_error: float
    final_error: tuple[float, ...]
    success: bool


def fly(
    env: gym.Env,
    trajectory: Trajectory,
    tracker: PIDTracker | MPCTracker | None = None,
    on_step: Callable[[], Any] | None = None,
) -> Flight:
    """Flies a plan in an environment that was just reset to the plan's problem.

    Args:
        env: ``FreeFlyer-v0`` with ``action_mode="thrusters"`` and ``terminate_early=False``.
        trajectory: The plan.
        tracker: Default: PID with the paper's gains.
        on_step: Called after every step, to draw frames for example.

    Raises:
        ValueError: If the environment has another action mode.
    """
    base: Any = env.unwrapped
    if base.action_mode != "thrusters":
        raise ValueError(
            f"fly() needs action_mode='thrusters', the environment has {base.action_mode!r}."
        )
    tracker = tracker or PIDTracker(base.robot)
    tracker.reset()
    period, states = base.control_dt, [base.state]
    commands: list[FloatArray] = []
    info: dict[str, Any] = {}
    contacts, impulse, worst, done = 0, 0.0, 0.0, False
    while not done:
        time = len(commands) * period
        duties = tracker.duties(states[-1], trajectory, time, period)
        _, _, terminated, truncated, info = env.step(duties.astype(np.float32))
        done = terminated or truncated
        commands.append(duties)
        states.append(base.state)
        contacts += info["contacts"]["count"]
        impulse += info["contacts"]["impulse"]
        target = tracker.reference(trajectory, time + period)
        worst = max(worst, float(np.linalg.norm(target[:2] - states[-1][:2])))
        if on_step is not None:
            on_step()
    return Flight(
        times=period * np.arange(len(states)),
        states=np.array(states),
        duties=np.array(commands),
        firing_time=float(np.sum(info["firing_time"])),
        contacts=contacts,
        contact_impulse=impulse,
        tracking_error=worst,
        final_error=tuple(float(item) for item in info["goal_error"]),
        success=bool(info["is_success"]),
    )
