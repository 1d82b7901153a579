"""FreeFlyer: a planar spacecraft robot as a Gymnasium environment, and its trajectory optimisation.

Importing this package registers ``FreeFlyer-v0``; planners live in :mod:`freeflyer_env.planning`.
"""

from gymnasium.envs.registration import register, registry

from freeflyer_env.robot import Robot
from freeflyer_env.sampling import sample_obstacles, sample_problem
from freeflyer_env.scenario import (
    HELD_OUT_SCENES,
    SCENES,
    TRAINING_SCENES,
    Obstacles,
    Problem,
    Scenario,
    unwrap_goal,
)

__version__ = "0.1.0"

if "FreeFlyer-v0" not in registry:
    register(
        id="FreeFlyer-v0",
        entry_point="freeflyer_env.env:FreeFlyerEnv",
        vector_entry_point="freeflyer_env.vector_env:FreeFlyerVectorEnv",
    )

__all__ = [
    "HELD_OUT_SCENES",
    "SCENES",
    "TRAINING_SCENES",
    "Obstacles",
    "Problem",
    "Robot",
    "Scenario",
    "sample_obstacles",
    "sample_problem",
    "unwrap_goal",
]
