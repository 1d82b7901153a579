"""The evaluation protocol: its problems, its arithmetic, its report."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from art_policy.evaluation import (
    Outcome,
    ProblemRecord,
    evaluate,
    evaluation_problems,
    markdown_table,
    report,
    save_report,
    summarise,
)
from art_policy.evaluation.figures import figures


def record(rel_cost, costs, c_rel=0):
    outcomes = {
        name: Outcome(np.isfinite(cost), cost, iterations, 0.01)
        for name, (cost, iterations) in costs.items()
    }
    best = min(cost for cost, _ in costs.values())
    return ProblemRecord("held-out-1", 0, 40.0, 4, c_rel, rel_cost, best, outcomes)


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
    assert groups["4 obstacles, T_f = 40 s"]["ART"] == groups["all"]["ART"]


def test_intervals_are_of_a_paired_bootstrap():
    """The same excess on every problem leaves no doubt, a coin's toss does."""
    rng = np.random.default_rng(0)
    sure, unsure = [], []
    for _ in range(200):
        cost = rng.uniform(1.5, 3.0)
        sure.append(record(1.0, {"REL": (cost, 4), "ART": (0.5 + 0.5 * cost, 2)}))
        unsure.append(record(1.0, {"REL": (2.0, 4), "ART": (rng.choice([1.5, 2.5]), 4)}))
    certain, doubtful = (summarise(records)["ART"] for records in (sure, unsure))
    assert certain["suboptimality_improvement"] == pytest.approx(0.5)
    assert certain["suboptimality_improvement_interval"] == pytest.approx([0.5, 0.5])
    assert certain["iterations_improvement_interval"] == pytest.approx([0.5, 0.5])
    low, high = doubtful["suboptimality_improvement_interval"]
    assert low < doubtful["suboptimality_improvement"] < high
    assert high - low == pytest.approx(4 * 0.5 / np.sqrt(200), rel=0.15)


def test_the_best_known_is_better_than_any_method_alone():
    records = [
        record(1.0, {"REL": (2.0, 4), "ART": (1.5, 3)}),
        record(1.0, {"REL": (1.5, 4), "ART": (2.0, 3)}),
    ]
    figures = summarise(records)
    assert figures["ART"]["suboptimality_improvement"] == pytest.approx(0.0)
    assert figures["best known"]["suboptimality_improvement"] == pytest.approx(1 / 3)
    assert figures["best known"]["infeasible"] == 0


def test_without_a_gap_there_is_no_improvement(tmp_path):
    free = [record(1.0, {"REL": (1.0, 2), "ART": (1.0 + 1e-7, 2)})]
    summary = summarise(free)
    assert np.isnan(summary["ART"]["suboptimality_improvement"])
    assert "| - |" in markdown_table(summary).splitlines()[-2]
    # Its figure shows the other numbers of obstacles all the same.
    free = [replace(each, n_obstacles=0) for each in free]
    others = [record(1.0, {"REL": (2.0, 4), "ART": (1.5, 3)})]
    figures(report(free + others, "model"), tmp_path)
    with Image.open(tmp_path / "by_obstacles.png") as picture:
        colors = {color for _, color in picture.convert("RGB").getcolors(1 << 20)}
    assert {(127, 135, 148), (183, 189, 200)} <= colors  # both methods' lines


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
    clutter = evaluation_problems(10, "clutter", (40.0, 80.0))
    for _, index, problem in clutter:
        obstacles = problem.scenario.obstacles
        assert len(obstacles) == 8 + index // 2
        gaps = np.linalg.norm(obstacles.centres[:, None] - obstacles.centres, axis=2)
        gaps -= obstacles.radii[:, None] + obstacles.radii
        assert gaps[~np.eye(len(obstacles), dtype=bool)].min() > 0.36
    cells = evaluation_problems(12, "random", (40.0, 60.0), n_obstacles=(0, 2, 8))
    assert {(p.final_time, len(p.scenario.obstacles)) for _, _, p in cells} == {
        (time, count) for time in (40.0, 60.0) for count in (0, 2, 8)
    }
    ((_, _, moving),) = evaluation_problems(1, "random", obstacle_speed=0.02)
    assert moving.scenario.obstacles.moving
    with pytest.raises(ValueError, match="for scenes 'random' and 'clutter'"):
        evaluation_problems(1, "held-out", n_obstacles=(2,))
    with pytest.raises(ValueError, match="at least 1"):
        evaluation_problems(0)
    with pytest.raises(ValueError, match="Did you mean 'held-out-1'"):
        evaluation_problems(1, "heldout-1")


METHODS = {
    *("REL", "REL, elastic", "ART", "ART, best of 2", "ART, best of 2 and REL"),
    *("multi-start, best of 2", "multi-start, best of 4", "multi-start, equal time"),
}


def test_end_to_end(untrained_model, tmp_path):
    problems = evaluation_problems(6, final_times=(30.0, 40.0))
    run = dict(n_candidates=2, n_starts=4, workers=1, progress=False)
    records = evaluate(untrained_model, problems, **run)
    assert [r.index for r in records] == list(range(6))
    for r in records:
        assert set(r.outcomes) == METHODS
        costs = {name: outcome.cost for name, outcome in r.outcomes.items()}
        # A race may give up, rarely, what would have been cheapest by a little in the end.
        assert costs["ART, best of 2"] <= 1.05 * costs["ART"]
        assert costs["multi-start, best of 2"] <= 1.05 * costs["REL"]
        assert costs["ART, best of 2 and REL"] <= min(costs["REL"], costs["ART, best of 2"])
        assert r.best_known <= min(costs.values())
        assert r.rel_cost <= costs["REL"] + 1e-6
        assert ProblemRecord.from_dict(json.loads(json.dumps(r.to_dict()))) == r
    data = report(records, "untrained")
    assert markdown_table(data["groups"]["all"]).count("\n") == 10
    save_report(data, tmp_path / "sub" / "report.json")
    loaded = json.loads((tmp_path / "sub" / "report.json").read_text())
    assert len(loaded["records"]) == 6
    names = {path.name for path in figures(loaded, tmp_path / "figures")}
    assert names == {"cost_against_time.png", "by_c_rel.png", "by_final_time.png"}


def test_an_interrupted_evaluation_goes_on(untrained_model, tmp_path):
    problems, partial = evaluation_problems(3), tmp_path / "report.json.partial"
    run = dict(n_candidates=1, n_starts=2, workers=1, progress=False, partial=partial)
    whole = evaluate(untrained_model, problems, **run)
    lines = partial.read_text().splitlines()
    assert len(lines) == 4
    partial.write_text("\n".join([*lines[:2], lines[2][:30]]))  # killed while writing
    again = evaluate(untrained_model, problems, **run)
    assert again[0] == whole[0]  # times included: it was not run again
    assert again[1].outcomes["REL"].cost == whole[1].outcomes["REL"].cost
    assert len(partial.read_text().splitlines()) == 4
    with pytest.raises(ValueError, match="of another evaluation"):
        evaluate(untrained_model, evaluation_problems(4), **run)


def test_several_models_are_compared_under_their_names(untrained_model, tmp_path):
    import shutil

    shutil.copytree(untrained_model, tmp_path / "other")
    models = [Path(untrained_model), tmp_path / "other"]
    (record,) = evaluate(
        models, evaluation_problems(1), n_candidates=1, n_starts=2, workers=1, progress=False
    )
    assert {"other", models[0].name} <= set(record.outcomes)
    with pytest.raises(ValueError, match="different names"):
        evaluate([untrained_model, untrained_model], evaluation_problems(1))
