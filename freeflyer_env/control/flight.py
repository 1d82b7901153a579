"""Flying a plan in the environment, and the record of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from freeflyer_env.control.pid import PIDTracker
from freeflyer_env.control.reference import Tracker
from freeflyer_env.robot import FloatArray

if TYPE_CHECKING:
    import gymnasium as gym

    from freeflyer_env.planning.trajectory import Trajectory


#: A plan that begins further than this many m from the robot is not for it.
_FAR_FROM_START = 0.1


@dataclass(frozen=True, eq=False)
class Flight:
    """A recorded flight.

    Attributes:
        times: ``(K + 1,)`` in s.
        states: ``(K + 1, 6)`` true states, SI units, global frame.
        duties: ``(K, 8)`` commanded duties.
        firing_time: Cumulative on-time of all eight thrusters in s, as the paper reports it.
        contacts: Number of contacts.
        contact_impulse: Sum of the contacts' impulses in N s.
        tracking_error: Largest distance from the tracker's reference in m.
        final_error: ``(position, heading, speed, rate)`` away from the goal at the end in m, rad,
            m/s, rad/s.
        success: What the environment said at the end.
        rms_error: Root of the mean square of the distance from the tracker's reference in m.
        fuel: Impulse of all thrusters in N s, at their nominal thrust.
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
    rms_error: float
    fuel: float


def fly(
    env: gym.Env,
    trajectory: Trajectory,
    tracker: Tracker | None = None,
    on_step: Callable[[], Any] | None = None,
) -> Flight:
    """Flies a plan in an environment that was just reset to the plan's problem.

    The tracker sees the measured state; the record and its errors are of the true one.

    Args:
        env: ``FreeFlyer-v0`` with ``action_mode="thrusters"`` and ``terminate_early=False``.
        trajectory: The plan.
        tracker: Default: PID with the paper's gains.
        on_step: Called after every step, to draw frames for example.

    Raises:
        ValueError: If the environment has another action mode or a wrapper that changes actions, or
            if there is no plan, or one from elsewhere.
    """
    base: Any = env.unwrapped
    if base.action_mode != "thrusters":
        raise ValueError(
            f"fly() needs action_mode='thrusters', the environment has {base.action_mode!r}."
        )
    if env.action_space != base.action_space:
        raise ValueError("fly() sends duties: leave out wrappers that change the actions.")
    if trajectory is None:
        raise ValueError("fly() needs a plan; planning failed, see the result's message.")
    away = float(np.hypot(*(trajectory.states[0, :2] - base.state[:2])))
    if away > _FAR_FROM_START:
        raise ValueError(
            f"The plan starts {away:.2f} m from the robot: reset the environment with "
            "options={'problem': problem} of the plan."
        )
    tracker = tracker or PIDTracker(base.robot)
    tracker.reset()
    period, states = base.control_dt, [base.state]
    commands: list[FloatArray] = []
    distances: list[float] = []
    info: dict[str, Any] = {}
    contacts, impulse, done = 0, 0.0, False
    while not done:
        time = len(commands) * period
        duties = tracker.duties(base.measured_state, trajectory, time, period)
        _, _, terminated, truncated, info = env.step(duties.astype(np.float32))
        done = terminated or truncated
        commands.append(duties)
        states.append(base.state)
        contacts += info["contacts"]["count"]
        impulse += info["contacts"]["impulse"]
        target = tracker.reference(trajectory, time + period)
        distances.append(float(np.linalg.norm(target[:2] - states[-1][:2])))
        if on_step is not None:
            on_step()
    firing_time = float(np.sum(info["firing_time"]))
    return Flight(
        times=period * np.arange(len(states)),
        states=np.array(states),
        duties=np.array(commands),
        firing_time=firing_time,
        contacts=contacts,
        contact_impulse=impulse,
        tracking_error=max(distances),
        final_error=tuple(float(item) for item in info["goal_error"]),
        success=bool(info["is_success"]),
        rms_error=float(np.sqrt(np.mean(np.square(distances)))),
        fuel=base.robot.thrust * firing_time,
    )
