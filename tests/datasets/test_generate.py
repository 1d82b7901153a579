"""Generation: shards are reproducible, resumable, checked, and what they claim to be."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from freeflyer_datasets import LABEL_REL, LABEL_SCP, Recipe, generate
from freeflyer_datasets.generate import solve_problems
from freeflyer_datasets.shards import ShardError, iterate_shards, list_shards, read_shard
from freeflyer_env.planning import Trajectory, solve_multistart


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in list_shards(folder)}


def test_bytes_do_not_depend_on_workers(recipe: Recipe, shards: Path, tmp_path: Path):
    report = generate(recipe, tmp_path, workers=2, progress=False)
    assert contents(tmp_path) == contents(shards)
    assert (report.new_shards, report.kept_shards) == (3, 0)
    assert report.n_problems == recipe.n_problems
    assert not report.failed_problems
    assert not list(tmp_path.glob("*.tmp"))


def test_missing_and_damaged_shards_alone_are_made_again(
    recipe: Recipe, shards: Path, tmp_path: Path
):
    shutil.copytree(shards, tmp_path, dirs_exist_ok=True)
    first, second, third = list_shards(tmp_path)
    first.unlink()
    content = bytearray(second.read_bytes())
    content[len(content) // 2] ^= 1
    second.write_bytes(content)
    kept = third.stat().st_mtime_ns
    report = generate(recipe, tmp_path, workers=1, progress=False)
    assert contents(tmp_path) == contents(shards)
    assert (report.new_shards, report.kept_shards) == (2, 1)
    assert report.remade_shards == (second.name,)
    assert third.stat().st_mtime_ns == kept
    assert "1 damaged" in str(report)


@pytest.mark.parametrize("damage", [b"", b"not a zip file", None])
def test_truncated_and_foreign_files_are_recognised(shards: Path, tmp_path: Path, damage):
    path = tmp_path / "shard-000000.npz"
    content = list_shards(shards)[0].read_bytes()
    path.write_bytes(content[: len(content) // 2] if damage is None else damage)
    with pytest.raises(ShardError, match="shard-000000"):
        read_shard(path)


def test_a_longer_run_starts_with_the_shards_of_a_shorter_one(
    recipe: Recipe, shards: Path, tmp_path: Path
):
    generate(recipe, tmp_path, n_problems=5, workers=1, progress=False)
    assert [read_shard(path).n_problems for path in list_shards(tmp_path)] == [4, 1]
    report = generate(recipe, tmp_path, workers=1, progress=False)
    assert report.kept_shards == 1
    assert contents(tmp_path) == contents(shards)
    report = generate(recipe, tmp_path, n_problems=5, workers=1, progress=False)
    assert (report.new_shards, report.kept_shards) == (0, 2)
    assert sum(shard.n_problems for shard in iterate_shards(tmp_path, 5)) == 5


def test_a_problem_does_not_depend_on_those_solved_before(recipe: Recipe):
    together, alone = solve_problems(recipe, 0, 3), solve_problems(recipe, 2, 1)
    first = int(np.searchsorted(together.problem, 2))
    np.testing.assert_array_equal(together.controls[together.offsets[first] :], alone.controls)
    np.testing.assert_array_equal(together.head(2).offsets, together.offsets[: first + 1])


def test_a_folder_holds_one_recipe(recipe: Recipe, shards: Path, tmp_path: Path):
    shutil.copytree(shards, tmp_path, dirs_exist_ok=True)
    other = Recipe(id=recipe.id, description="Other.", n_problems=1, seed=3)
    with pytest.raises(ValueError, match=r"another recipe \(recipe.json\)"):
        generate(other, tmp_path, progress=False)
    (tmp_path / "recipe.json").unlink()
    with pytest.raises(ValueError, match=r"another recipe \(shard-000000.npz\)"):
        generate(other, tmp_path, progress=False)


def test_records_are_what_the_planner_finds(recipe: Recipe, shards: Path):
    shard = next(iterate_shards(shards))
    for local in range(2):
        problem = recipe.problem(local)
        assert shard.problem_at(local).to_dict() == problem.to_dict()
        found = solve_multistart(problem, n_starts=recipe.n_starts)
        rows = np.flatnonzero(shard.problem == local)
        results = [found.rel, *found.optima]
        assert len(rows) == len(results)
        assert shard.label[rows].tolist() == [LABEL_REL] + [LABEL_SCP] * len(found.optima)
        assert shard.rank[rows].tolist() == [0, *range(len(found.optima))]
        for row, result in zip(rows, results):
            assert result.trajectory is not None
            np.testing.assert_array_equal(
                shard.controls_of(row), np.float32(result.trajectory.controls)
            )
            assert shard.iterations[row] == result.iterations
            assert shard.cost[row] == pytest.approx(result.trajectory.cost, rel=1e-6)


def test_stored_trajectories_are_feasible(shards: Path):
    for shard in iterate_shards(shards):
        assert shard.violation.max() < 1e-6
        for index in range(shard.n_trajectories):
            problem = shard.problem_at(int(shard.problem[index]))
            controls = shard.controls_of(index).astype(float)
            trajectory = Trajectory.from_controls(problem, controls)
            report = trajectory.check(problem)
            if shard.label[index] == LABEL_SCP:
                assert report.satisfied(1e-6)
            else:
                inside = trajectory.violations(problem).sum()
                assert shard.c_rel[shard.problem[index]] == inside
                assert shard.rel_cost[shard.problem[index]] == trajectory.cost


def test_an_exception_is_the_failure_of_its_problem(recipe: Recipe, monkeypatch, caplog):
    import freeflyer_env.planning as planning

    target = recipe.problem(1).start

    def explode(problem, n_starts):
        if np.array_equal(problem.start, target):
            raise ZeroDivisionError("as a test")
        return solve_multistart(problem, n_starts=n_starts)

    monkeypatch.setattr(planning, "solve_multistart", explode)
    shard = solve_problems(recipe, 0, 2)
    assert shard.failure.tolist() == ["", "ZeroDivisionError: as a test"]
    assert set(shard.problem) == {0}
    assert shard.c_rel[1] == -1
    assert np.isnan(shard.rel_cost[1])
    assert "problem 1 of freeflyer/tiny-v0" in caplog.text


def test_when_everything_fails_nothing_is_written(recipe: Recipe, tmp_path: Path, monkeypatch):
    import freeflyer_env.planning as planning

    def explode(problem, n_starts):
        raise ZeroDivisionError("as a test")

    monkeypatch.setattr(planning, "solve_multistart", explode)
    with pytest.raises(RuntimeError, match=r"All 2 problems from 0 on failed.*as a test"):
        generate(recipe, tmp_path, n_problems=2, workers=1, progress=False)
    assert not list_shards(tmp_path)


def test_only_the_best_optimum_is_kept_on_request(recipe: Recipe):
    fields = {**recipe.to_dict(), "optima": "best", "id": "freeflyer/best-v0"}
    best, every = (solve_problems(one, 0, 3) for one in (Recipe.from_dict(fields), recipe))
    assert set(best.rank) == {0}
    kept = every.rank == 0
    np.testing.assert_array_equal(best.cost, every.cost[kept])
    np.testing.assert_array_equal(best.problem, every.problem[kept])


def test_asking_for_more_than_there_is(shards: Path, tmp_path: Path):
    with pytest.raises(ValueError, match="holds 10 problems, 11 are asked for"):
        list(iterate_shards(shards, 11))
    with pytest.raises(ValueError, match="no shards"):
        list(iterate_shards(tmp_path))


def test_import_is_light():
    code = (
        "import sys, freeflyer_datasets;"
        "print(sorted({'minari', 'h5py', 'joblib', 'scipy', 'torch'} & set(sys.modules)))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.stdout.strip() == "[]", result.stderr
