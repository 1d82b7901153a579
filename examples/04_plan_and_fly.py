"""Plan with a learned warm start and fly the plan with the thrusters, as Gymnasium sees it."""

from __future__ import annotations

import gymnasium as gym

from art_policy import ART, PlannerWrapper, WarmStartPlanner
from freeflyer_env.control import fly


def main() -> None:
    planner = WarmStartPlanner(ART.from_pretrained("art-general"))
    env = gym.make(
        "freeflyer_env:FreeFlyer-v0",
        action_mode="thrusters",
        scenario="held-out-1",
        terminate_early=False,
    )
    env = PlannerWrapper(env, planner)
    for seed in range(3):
        _, info = env.reset(seed=seed)
        plan = info["plan"]
        print(
            f"seed {seed}: {plan.result.status.value}, cost {plan.result.cost:.3f} m/s, "
            f"warm start from {plan.source.upper()}, {plan.iterations} iterations, "
            f"{1e3 * plan.timings['total']:.0f} ms"
        )
        if plan.trajectory is not None:
            flight = fly(env, plan.trajectory)
            print(
                f"  flown: {1e3 * flight.final_error[0]:.1f} mm from the goal, tracking within "
                f"{1e3 * flight.tracking_error:.1f} mm, {flight.firing_time:.1f} s of firing"
            )


if __name__ == "__main__":
    main()
