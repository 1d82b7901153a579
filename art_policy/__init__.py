"""ART: transformers that propose warm starts for trajectory optimisation, and their planners."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from art_policy.layers import ARTConfig
    from art_policy.model import ART
    from art_policy.planner import Plan, PlannerConfig, PlannerWrapper, WarmStartPlanner

_MODULES = {
    "ART": "art_policy.model",
    "ARTConfig": "art_policy.layers",
    "Plan": "art_policy.planner",
    "PlannerConfig": "art_policy.planner",
    "PlannerWrapper": "art_policy.planner",
    "WarmStartPlanner": "art_policy.planner",
}

__all__ = ["ART", "ARTConfig", "Plan", "PlannerConfig", "PlannerWrapper", "WarmStartPlanner"]


def __getattr__(name: str) -> Any:
    """Imports the public names when they are first used: PyTorch takes seconds."""
    if name in _MODULES:
        import importlib

        return getattr(importlib.import_module(_MODULES[name]), name)
    raise AttributeError(f"module 'art_policy' has no attribute {name!r}")
