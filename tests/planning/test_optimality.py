"""SCP's solutions against those of the nonlinear problem, which IPOPT solves independently.

The optima compared are local ones. Besides its homotopy class, a local optimum of the
time-discretised problem has its contacts: *which* nodes touch a disc. Optima of one class whose
contacts are one node apart differ by up to 2e-3 in cost. Either method may settle on either.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from freeflyer_env import Obstacles, Problem, sample_problem
from freeflyer_env.constraints import check
from freeflyer_env.planning import SCPResult, Trajectory, solve_rel, solve_scp
from freeflyer_env.planning.reference import solve_reference_subproblem

pytest.importorskip("casadi")

from nonlinear import NonlinearResult, solve_nonlinear

#: Relative difference in cost up to which two solutions are the same local optimum.
SAME = 1e-6
#: Seeds of problems of 20 s that SCP solves from REL: actuation and keep-out bind there.
SHORT = (94, 99, 102, 115)
#: Seeds of problems with moving discs that SCP solves from REL.
MOVING = (0, 2, 9)


@dataclass(frozen=True)
class Comparison:
    """A problem, SCP's solution, and IPOPT's from SCP's warm start and from SCP's solution."""

    problem: Problem
    scp: SCPResult
    same_start: NonlinearResult
    restarted: NonlinearResult

    @property
    def excess(self) -> float:
        """By how much SCP's cost exceeds that of IPOPT from the same start, relatively."""
        return self.scp.cost / self.same_start.cost - 1.0


def compare(problem: Problem) -> Comparison | None:
    """The comparison, or None if SCP does not solve the problem from REL."""
    warm_start = solve_rel(problem).trajectory
    assert warm_start is not None
    scp = solve_scp(problem, warm_start)
    if not scp.solved:
        return None
    # A small barrier parameter: the local optimum nearby, not one past the next contact.
    restarted = solve_nonlinear(problem, scp.trajectory, barrier=1e-5)
    return Comparison(problem, scp, solve_nonlinear(problem, warm_start), restarted)


@pytest.fixture(scope="module")
def comparisons() -> list[Comparison]:
    """Twenty random problems of 40 s that SCP solves, four of 20 s, three with moving discs."""
    found: list[Comparison] = []
    for seed in range(40):
        if len(found) < 20 and (one := compare(sample_problem(np.random.default_rng(seed)))):
            found.append(one)
    assert len(found) == 20
    short = [sample_problem(np.random.default_rng(seed), final_time=20.0) for seed in SHORT]
    for problem in [*short, *(in_motion(seed) for seed in MOVING)]:
        one = compare(problem)
        assert one is not None
        found.append(one)
    return found


def in_motion(seed: int) -> Problem:
    """A random problem of 40 s whose discs move by up to 0.16 m along each axis."""
    rng = np.random.default_rng(seed)
    problem = sample_problem(rng)
    still = problem.scenario.obstacles
    velocities = rng.uniform(-0.004, 0.004, (len(still), 2))
    obstacles = Obstacles(still.centres, still.radii, velocities)
    return replace(problem, scenario=replace(problem.scenario, obstacles=obstacles))


def test_nonlinear_solutions_satisfy_the_independent_check(comparisons):
    for one in comparisons:
        for result in (one.same_start, one.restarted):
            assert result.solved, result.message
            assert check(one.problem, result.states, result.controls).satisfied(1e-6)


def test_solutions_of_scp_are_local_optima_of_the_nonlinear_problem(comparisons):
    for one in comparisons:
        assert one.restarted.cost == pytest.approx(one.scp.cost, rel=SAME)


def test_from_the_same_start_scp_costs_at_most_one_per_cent_more(comparisons):
    for one in comparisons:
        assert one.excess <= 0.01
    assert sum(abs(one.excess) <= SAME for one in comparisons) >= 0.9 * len(comparisons)


def test_where_costs_differ_both_are_local_optima(comparisons):
    for one in comparisons:
        if abs(one.excess) > SAME:
            other = Trajectory(
                one.same_start.states, one.same_start.controls, one.problem.scenario.dt
            )
            again = solve_scp(one.problem, other)
            assert again.solved
            assert again.cost == pytest.approx(one.same_start.cost, rel=SAME)


def test_solutions_of_scp_are_fixed_points(comparisons):
    for one in comparisons:
        # The subproblem is convex: what is optimal in this wide trust region is so in the last one.
        status, cost, _ = solve_reference_subproblem(
            one.problem, one.scp.trajectory, 10.0, solver="HIGHS"
        )
        assert status == "optimal"
        assert cost == pytest.approx(one.scp.cost, rel=SAME)
