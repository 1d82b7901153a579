"""The evaluation protocol: its problems, its arithmetic, its report."""

import json

import numpy as np
import pytest

from art_policy.evaluate import (
    Outcome,
    ProblemRecord,
    evaluate,
    evaluation_problems,
    markdown_table,
    report,
    save_report,
    summarise,
    wilson_interval,
)


def record(rel_cost, costs, c_rel=0):
    outcomes = {
        name: Outcome(np.isfinite(cost), cost, iterations, 0.01)
        for name, (cost, iterations) in costs.items()
    }
    return ProblemRecord("held-out-1", 0, 40.0, c_rel, rel_cost, outcomes)


def test_figures_follow_the_protocol():
    inf = float("inf")
    records = [
        record(1.0, {"REL": (2.0, 4), "ART": (1.5, 3)}),
        record(1.0, {"REL": (1.0, 4), "ART": (1.0, 3)}),
        record(1.0, {"REL": (inf, 1), "ART": (1.2, 3)}, c_rel=12),
    ]
    figures = summarise(records)
    assert figures["REL"]["infeasible"] == 1
    assert figures["ART"]["infeasible_rate"] == 0.0
    assert figures["ART"]["n_common"] == 2
    assert figures["ART"]["suboptimality_improvement"] == pytest.approx(0.5)
    assert figures["ART"]["cost_improvement"] == pytest.approx(1 - 2.5 / 3.0)
    assert figures["ART"]["iterations_improvement"] == pytest.approx(0.25)
    assert figures["REL"]["suboptimality_improvement"] == 0.0
    groups = report(records, "model")["groups"]
    assert groups["C_REL >= 10"]["ART"]["n"] == 1
    assert "C_REL >= 15" not in groups


def test_wilson_interval():
    low, high = wilson_interval(8, 100)
    assert (low, high) == pytest.approx((0.0411, 0.1500), abs=1e-4)
    assert wilson_interval(0, 0) == (0.0, 1.0)
    assert wilson_interval(0, 50)[0] == 0.0


def test_problems_are_reproducible_and_spread():
    first = evaluation_problems(6, final_times=(40.0, 60.0))
    again = evaluation_problems(6, final_times=(40.0, 60.0))
    other = evaluation_problems(6, final_times=(40.0, 60.0), seed=1)
    assert {name for name, _, _ in first} == {"held-out-1", "held-out-2", "held-out-3"}
    assert {problem.final_time for _, _, problem in first} == {40.0, 60.0}
    for (_, _, a), (_, _, b), (_, _, c) in zip(first, again, other):
        np.testing.assert_array_equal(a.start, b.start)
        assert not np.array_equal(a.start, c.start)
    random = evaluation_problems(2, "random")
    rows = [problem.scenario.obstacles.rows() for _, _, problem in random]
    assert not np.array_equal(*rows)
    with pytest.raises(ValueError, match="at least 1"):
        evaluation_problems(0)
    with pytest.raises(ValueError, match="Did you mean 'held-out-1'"):
        evaluation_problems(1, "heldout-1")


def test_end_to_end(untrained_model, tmp_path):
    problems = evaluation_problems(6)
    records = evaluate(untrained_model, problems, n_candidates=2, workers=1, progress=False)
    assert [r.index for r in records] == list(range(6))
    for r in records:
        assert set(r.outcomes) == {"REL", "ART", "ART, best of 2", "multi-start, best of 2"}
        assert r.outcomes["ART, best of 2"].cost <= r.outcomes["ART"].cost
        assert r.outcomes["multi-start, best of 2"].cost <= r.outcomes["REL"].cost
        assert r.rel_cost <= r.outcomes["REL"].cost + 1e-6
    data = report(records, "untrained")
    assert markdown_table(data["groups"]["all"]).count("\n") == 5
    save_report(data, tmp_path / "sub" / "report.json")
    loaded = json.loads((tmp_path / "sub" / "report.json").read_text())
    assert len(loaded["records"]) == 6
