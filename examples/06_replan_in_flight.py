"""Model-predictive control: a robot that is pushed off its plan finds its way to the goal.

The same flight under the paper's PID, under MPC that tracks the plan (a small quadratic program
every 0.1 s), and with SCP that re-plans the rest of the flight twice a second. All get there; PID
and MPC fight their way back to the old plan, re-planning makes a new one, clear of the obstacles.
"""

from __future__ import annotations

import gymnasium as gym
import numpy as np

from freeflyer_env import Scenario, sample_problem
from freeflyer_env.control import PIDTracker, ReplanningTracker, Tracker, TrackingMPC, fly
from freeflyer_env.planning import SCPConfig, solve_scp

PUSH_AT, PUSH = 12.0, (-0.04, 0.05, 0.4)  # s; m/s, m/s, rad/s


def main() -> None:
    scenario = Scenario.named("held-out-1")
    problem = sample_problem(np.random.default_rng(4), scenario)
    plan = solve_scp(problem, config=SCPConfig.robust())
    assert plan.trajectory is not None, plan.message
    env = gym.make(
        "freeflyer_env:FreeFlyer-v0",
        action_mode="thrusters",
        scenario=scenario,
        terminate_early=False,
    )
    base = env.unwrapped

    def push_once() -> None:
        if abs(base.time - PUSH_AT) < 1e-6:
            base.push(PUSH)

    replanning = ReplanningTracker(problem, config=SCPConfig(elastic=True, between_nodes=True))
    trackers: dict[str, Tracker] = {
        "PID": PIDTracker(scenario.robot),
        "MPC": TrackingMPC(scenario),
        "re-planning": replanning,
    }
    for name, tracker in trackers.items():
        env.reset(options={"problem": problem})
        flight = fly(env, plan.trajectory, tracker, on_step=push_once)
        print(
            f"{name}: {1e3 * flight.final_error[0]:.1f} mm from the goal, at most "
            f"{100 * flight.tracking_error:.1f} cm off its plan, {flight.firing_time:.1f} s of "
            f"firing, {flight.contacts} contacts"
        )
    times = [1e3 * result.solve_time for result in replanning.results]
    print(
        f"SCP planned {len(times)} times: {np.median(times):.0f} ms each (median), "
        f"{max(times):.0f} ms at most, {sum(r.solved for r in replanning.results)} solved"
    )


if __name__ == "__main__":
    main()
