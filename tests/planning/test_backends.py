"""Every backend against the others, their multipliers, and what happens where they cannot help."""

import numpy as np
import pytest

from freeflyer_env import HELD_OUT_SCENES, Problem, sample_problem
from freeflyer_env.planning import SCPConfig, Trajectory, solve_multistart, solve_scp, straight_line
from freeflyer_env.planning.backends import BACKENDS, check_backend, make_backend
from freeflyer_env.planning.program import SolverStatus
from freeflyer_env.planning.reference import solve_reference_subproblem
from freeflyer_env.planning.subproblem import Subproblem

EXACT = ("piqp", "clarabel", "qoco", "highs")


def subproblem_for(problem, backend="piqp", n_obstacles=None, **options):
    scenario = problem.scenario
    count = len(scenario.obstacles) if n_obstacles is None else n_obstacles
    return Subproblem(problem.n_steps, count, scenario.dt, scenario.robot, backend, **options)


def hard_cases(n_cases, seed):
    """Subproblems about straight lines (many infeasible), REL, and perturbed solutions."""
    rng = np.random.default_rng(seed)
    for index in range(n_cases):
        final_time = (20.0, 25.0, 30.0, 40.0)[index % 4]
        scenario = HELD_OUT_SCENES[index % 3] if index % 2 else None
        problem = sample_problem(rng, scenario, final_time)
        reference, trust_region = straight_line(problem), 10.0
        if index % 3 == 1:
            best = solve_multistart(problem, 3).best.trajectory
            if best is not None:
                noise = rng.normal(0.0, 0.02, best.states.shape)
                reference = Trajectory(best.states + noise, best.controls, best.dt)
                trust_region = (10.0, 0.3, 0.1)[index // 3 % 3]
        yield problem, reference, trust_region


def test_exact_backends_agree_on_200_subproblems():
    shared = {}
    verdicts = []
    for problem, reference, trust_region in hard_cases(200, seed=8):
        costs = {}
        for name in EXACT:
            size = (name, problem.n_steps)
            solver = shared.setdefault(size, subproblem_for(problem, name))
            solution = solver.solve(problem, reference, trust_region)
            costs[name] = solution.trajectory.cost if solution.trajectory else np.inf
            assert solution.status is not SolverStatus.FAILED
            if solution.trajectory is not None:
                assert solver.kkt_residuals().worst < 2e-6
        verdicts.append(np.isfinite(costs["highs"]))
        assert {np.isfinite(cost) for cost in costs.values()} == {verdicts[-1]}
        if verdicts[-1]:
            for name in EXACT:
                assert costs[name] == pytest.approx(costs["highs"], rel=1e-5), name
    assert 60 <= sum(verdicts) <= 150, "the sample should hold feasible and infeasible programs"


def test_ball_trust_region_agrees_with_the_statement_and_binds():
    rng = np.random.default_rng(3)
    for index in range(3):
        problem = sample_problem(rng, HELD_OUT_SCENES[index], 25.0)
        best = solve_multistart(problem, 4).best.trajectory
        assert best is not None
        reference = Trajectory(
            best.states + rng.normal(0, 0.02, best.states.shape), best.controls, 0.5
        )
        for radius in (0.12, 0.5):
            status, objective, _ = solve_reference_subproblem(
                problem, reference, radius, ball=True, solver="CLARABEL"
            )
            for name in ("clarabel", "qoco"):
                solver = subproblem_for(problem, name, ball=True)
                found = solver.solve(problem, reference, radius)
                assert (found.trajectory is not None) == (status == "optimal")
                if found.trajectory is None:
                    assert found.status is SolverStatus.INFEASIBLE
                    continue
                assert found.trajectory.cost == pytest.approx(objective, rel=1e-5)
                change = (found.trajectory.states - reference.states)[1:-2]
                assert np.linalg.norm(change, axis=1).max() <= radius + 1e-6
                assert solver.kkt_residuals().worst < 1e-6


@pytest.mark.parametrize("options", [{"elastic": True}, {"between_nodes": True}])
def test_variants_agree_with_the_statement(options):
    rng = np.random.default_rng(5)
    stated = {"between_nodes": options.get("between_nodes", False)}
    for index in range(6):
        problem = sample_problem(rng, HELD_OUT_SCENES[index % 3], 25.0)
        reference = straight_line(problem)
        if options.get("elastic"):
            stated["slack_price"] = 5000.0
        solver = subproblem_for(problem, **options)
        found = solver.solve(problem, reference, 10.0)
        status, objective, _ = solve_reference_subproblem(
            problem, reference, 10.0, solver="HIGHS", **stated
        )
        assert (found.trajectory is not None) == (status == "optimal")
        if found.trajectory is not None:
            limit = problem.scenario.robot.delta_v_max(0.5)
            priced = found.trajectory.cost + 5000.0 * limit * found.slack
            assert priced == pytest.approx(objective, rel=1e-6)


def test_cvxpy_as_a_backend_of_scp():
    problem = sample_problem(np.random.default_rng(3), HELD_OUT_SCENES[0], 25.0)
    fast = solve_scp(problem)
    stated = solve_scp(problem, config=SCPConfig(backend="cvxpy:highs"))
    assert stated.status is fast.status
    assert stated.cost == pytest.approx(fast.cost, rel=1e-4)
    assert stated.kkt is None
    assert fast.kkt.worst < 1e-6


@pytest.mark.parametrize(
    "settings",
    [{"backend": name} for name in ("clarabel", "qoco", "highs")]
    + [{"backend": "clarabel", "trust_region_shape": "ball"}],
)
def test_scp_with_other_backends(settings):
    for seed in range(4):
        problem = sample_problem(np.random.default_rng(seed), HELD_OUT_SCENES[seed % 3])
        warm = solve_multistart(problem, 3).best
        other = solve_scp(problem, warm.trajectory, SCPConfig(**settings))
        assert other.solved
        assert other.trajectory.check(problem).satisfied()
        assert other.cost == pytest.approx(warm.cost, rel=2e-3)
        assert other.kkt.worst < 1e-5


def test_osqp_is_rough_but_not_wrong():
    for seed in range(3):
        problem = sample_problem(np.random.default_rng(seed), n_obstacles=0)
        goal = problem.start + np.array([0.3, 0.1, 0.4, 0.0, 0.0, 0.0])
        near = Problem(problem.scenario, problem.start, goal, 10.0)
        exact, rough = (
            subproblem_for(near, name).solve(near, straight_line(near), 10.0)
            for name in ("piqp", "osqp")
        )
        assert rough.status is not SolverStatus.INFEASIBLE
        if rough.trajectory is not None:
            assert rough.trajectory.cost == pytest.approx(exact.trajectory.cost, rel=2e-3)


def test_names_and_abilities():
    with pytest.raises(ValueError, match="Did you mean 'piqp'"):
        make_backend("pqip")
    with pytest.raises(ValueError, match="use one of clarabel, qoco"):
        SCPConfig(trust_region_shape="ball")
    with pytest.raises(ValueError, match="no solver 'NOBODY'"):
        SCPConfig(backend="cvxpy:nobody")
    with pytest.raises(ValueError, match="'box' or 'ball'"):
        SCPConfig(trust_region_shape="cube")
    for name in BACKENDS:
        check_backend(name)
