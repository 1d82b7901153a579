"""Planning with a learned warm start: ART proposes, SCP refines, a monitor watches.

:class:`WarmStartPlanner` plans one problem; :class:`PlannerWrapper` plans at every reset of an
environment.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from freeflyer_env.constraints import keep_out_depth
from freeflyer_env.planning import (
    SCPConfig,
    SCPResult,
    SCPStatus,
    Trajectory,
    race_scp,
    solve_rel,
    solve_scp,
    straight_line,
)
from freeflyer_env.scenario import Problem

if TYPE_CHECKING:
    from art_policy.deployment import OnnxART
    from art_policy.model import ART

#: A warm start this deep inside a keep-out disc (m) is not worth refining.
_DEEPEST_WARM_START = 0.1

#: First half-width of the trust region for a model's candidates (m, rad, m/s, rad/s). They need no
#: wider one, and in a wider one SCP wanders among solutions of the same cost before it settles.
_TRUST_REGION = 3.0

#: Homotopy classes tried where the model's proposals and REL lead nowhere.
_REROUTES = 12

_REL_ROLES = ("fallback", "portfolio", "never")


@dataclass(frozen=True)
class PlannerConfig:
    """Settings of :class:`WarmStartPlanner`.

    Attributes:
        n_candidates: How many of the model's proposals race (:func:`.race_scp`); the cheapest
            result is kept.
        rel: What becomes of REL, the classical warm start: ``"fallback"``, refined if no candidate
            leads to a feasible plan, or if the problem is unlike those that the model was trained
            on; ``"portfolio"``, always refined too, so that the plan is never
            worse than REL + SCP; ``"never"``, to see what the model does alone. Unless ``"never"``,
            other homotopy classes are the last resort where REL fails, too.
        scp: Settings of the SCP loop. For the model's candidates its ``reroutes`` play no part, and
            the trust region begins at 3 m or less.
    """

    n_candidates: int = 1
    rel: str = "fallback"
    scp: SCPConfig = field(default_factory=SCPConfig)

    def __post_init__(self) -> None:
        if self.n_candidates < 1:
            raise ValueError(
                f"PlannerConfig.n_candidates must be at least 1, got {self.n_candidates}."
            )
        if self.rel not in _REL_ROLES:
            raise ValueError(f"PlannerConfig.rel must be one of {_REL_ROLES}, got {self.rel!r}.")


@dataclass(frozen=True, eq=False)
class Plan:
    """A plan and how it came about.

    Attributes:
        result: The chosen SCP result; ``result.solved`` says whether it can be flown.
        warm_start: The reference that SCP started from.
        source: Where the chosen warm start came from: ``"art"``, ``"rel"``, or ``"reroute"``,
            another homotopy class.
        timings: Wall times in s: ``propose``, ``rel``, ``scp`` and ``total``.
        iterations: Subproblems solved by all refinements; those of REL itself are not counted.
        monitor: What the monitor distrusted or had to replace, one line each; empty if nothing.
    """

    result: SCPResult
    warm_start: Trajectory
    source: str
    timings: dict[str, float]
    iterations: int
    monitor: tuple[str, ...]

    @property
    def trajectory(self) -> Trajectory | None:
        """The planned trajectory, None where planning failed."""
        return self.result.trajectory if self.result.solved else None


class WarmStartPlanner:
    """Plans with a model's warm starts, and with REL where they fail.

    Args:
        model: Makes the proposals; None plans with REL alone, the classical baseline.
        config: Settings.
    """

    def __init__(self, model: ART | OnnxART | None, config: PlannerConfig | None = None) -> None:
        self.model = model
        self.config = config or PlannerConfig()

    def plan(self, problem: Problem) -> Plan:
        """Plans one problem.

        Args:
            problem: Start, goal, scene and final time.

        Returns:
            The plan. Where every warm start failed its result says why; nothing is raised.
        """
        role = "portfolio" if self.model is None else self.config.rel
        search = _Search(problem, self.config, wants_rel=role == "portfolio")
        if problem.defects():
            line = straight_line(problem)
            search.attempts.append(("rel", line, solve_scp(problem, line, self.config.scp)))
            return search.finish()
        if self.model is not None:
            self._try_model(search)
        if (
            not search.attempts
            or search.wants_rel
            or (role == "fallback" and not search.any_solved)
        ):
            search.refine_rel()
        if self.model is not None and role != "never" and not search.any_solved:
            search.reroute()
        return search.finish()

    def _try_model(self, search: _Search) -> None:
        from art_policy.rollout import propose

        assert self.model is not None
        needs_rel = self.model.config.head == "autoregressive"
        rel = search.solve_rel().trajectory if needs_rel else None
        if needs_rel and rel is None:
            search.monitor.append("REL failed, so there is no reward-to-go to ask the model for")
            return
        envelope = self.model.config.envelope
        if self.config.rel != "never" and envelope and (why := envelope.outside(search.problem)):
            search.monitor.append(f"REL refined too: {why}")
            search.wants_rel = True
        began = time.perf_counter()
        proposals = propose(self.model, search.problem, self.config.n_candidates, rel=rel)
        search.timings["propose"] = time.perf_counter() - began
        trusted = {}
        for number, proposal in enumerate(proposals):
            reason = distrust(search.problem, proposal.trajectory)
            if reason and self.config.rel != "never":
                search.monitor.append(f"candidate {number} not refined: {reason}")
            else:
                trusted[f"candidate {number}"] = proposal.trajectory
        search.race(trusted)

    def proposals(self, problem: Problem) -> list[Trajectory]:
        """The model's warm starts of a problem, those that are distrusted left out; best first."""
        from art_policy.rollout import propose

        if self.model is None:
            return []
        rel = None
        if self.model.config.head == "autoregressive":
            rel = solve_rel(problem, self.config.scp).trajectory
            if rel is None:
                return []
        found = propose(self.model, problem, self.config.n_candidates, rel=rel)
        return [one.trajectory for one in found if not distrust(problem, one.trajectory)]


class _Search:
    """The attempts at one problem, with what they cost."""

    def __init__(self, problem: Problem, config: PlannerConfig, wants_rel: bool) -> None:
        self.problem, self.config, self.wants_rel = problem, config, wants_rel
        self.began = time.perf_counter()
        self.timings = {"propose": 0.0, "rel": 0.0, "scp": 0.0}
        self.attempts: list[tuple[str, Trajectory, SCPResult]] = []
        self.monitor: list[str] = []
        self._rel: SCPResult | None = None

    @property
    def any_solved(self) -> bool:
        return any(result.solved for _, _, result in self.attempts)

    def solve_rel(self) -> SCPResult:
        if self._rel is None:
            self._rel = solve_rel(self.problem, self.config.scp)
            self.timings["rel"] += self._rel.solve_time
        return self._rel

    def race(self, warm_starts: dict[str, Trajectory]) -> None:
        """Refines a model's candidates, by name; those that fall behind are given up."""
        if not warm_starts:
            return
        began = time.perf_counter()
        first = min(_TRUST_REGION, self.config.scp.trust_region_start)
        config = replace(
            self.config.scp,
            trust_region_start=first,
            trust_region_end=min(first, self.config.scp.trust_region_end),
        )
        results = race_scp(self.problem, list(warm_starts.values()), config)
        self.timings["scp"] += time.perf_counter() - began
        for (name, warm_start), result in zip(warm_starts.items(), results):
            self._add("art", name, warm_start, result)

    def _add(self, source: str, name: str, warm_start: Trajectory, result: SCPResult) -> None:
        self.attempts.append((source, warm_start, result))
        if not result.solved and result.status is not SCPStatus.OUTRUN:
            self.monitor.append(f"{name}: {result.status.value}")

    def refine_rel(self) -> None:
        rel = self.solve_rel()
        if rel.trajectory is None:
            self.attempts.append(("rel", straight_line(self.problem), rel))
            self.monitor.append(f"REL: {rel.status.value}")
        else:
            result = solve_scp(self.problem, rel.trajectory, self.config.scp)
            self.timings["scp"] += result.solve_time
            self._add("rel", "REL", rel.trajectory, result)

    def reroute(self) -> None:
        """The last resort: other homotopy classes, and slack on keep-out."""
        rel = self.solve_rel()
        start = rel.trajectory or straight_line(self.problem)
        config = replace(self.config.scp, elastic=True, reroutes=_REROUTES)
        result = solve_scp(self.problem, rel.trajectory, config)
        self.timings["scp"] += result.solve_time
        self._add("reroute", "reroute", start, result)

    def finish(self) -> Plan:
        source, warm_start, result = min(self.attempts, key=lambda attempt: attempt[2].cost)
        self.timings["total"] = time.perf_counter() - self.began
        iterations = sum(attempt[2].iterations for attempt in self.attempts)
        return Plan(result, warm_start, source, self.timings, iterations, tuple(self.monitor))


def distrust(problem: Problem, warm_start: Trajectory) -> str | None:
    """Why a warm start should not be refined, or None.

    The runtime monitor that the paper's conclusions call for, in its first form: cheap tests that a
    warm start is a trajectory of this problem at all.
    """
    if warm_start.n_steps != problem.n_steps:
        return f"it has {warm_start.n_steps} steps, the problem {problem.n_steps}"
    if not (np.isfinite(warm_start.states).all() and np.isfinite(warm_start.controls).all()):
        return "it is not finite"
    miss = float(np.abs(warm_start.states[0, :3] - problem.start[:3]).max())
    if miss > 1e-3:
        return f"it starts {miss:.3f} away from the start"
    nodes, times = warm_start.states[:-1, :2], problem.node_times[:-1]
    depth = float(keep_out_depth(problem.scenario, nodes, times).max())
    if depth > _DEEPEST_WARM_START:
        return f"it passes {depth:.3f} m deep through a keep-out disc"
    return None


class PlannerWrapper(gym.Wrapper):
    """Plans the environment's problem at every reset and puts the plan into ``info["plan"]``.

    Args:
        env: A ``FreeFlyer-v0`` environment, wrapped or not.
        planner: Makes the plans.
    """

    def __init__(self, env: gym.Env, planner: WarmStartPlanner) -> None:
        super().__init__(env)
        self.planner = planner
        self.plan: Plan | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Resets, plans, and shows the plan in the rendering."""
        observation, info = self.env.reset(seed=seed, options=options)
        base: Any = self.unwrapped
        self.plan = self.planner.plan(base.problem)
        trajectory = self.plan.trajectory
        base.set_plan(None if trajectory is None else trajectory.states)
        return observation, {**info, "plan": self.plan}
