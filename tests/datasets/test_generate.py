"""Generation: shards are reproducible, resumable, checked, and what they claim to be."""

from __future__ import annotations

import errno
import importlib
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from freeflyer_datasets import LABEL_REL, LABEL_SCP, Recipe, generate
from freeflyer_datasets.generate import GenerationError, solve_problems
from freeflyer_datasets.shards import ShardError, iterate_shards, list_shards, read_shard
from freeflyer_env.planning import Trajectory, solve_multistart

GENERATE_MODULE = importlib.import_module("freeflyer_datasets.generate")


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

    def explode(problem, n_starts, config, **options):
        if np.array_equal(problem.start, target):
            raise ZeroDivisionError("as a test")
        return solve_multistart(problem, n_starts, config, **options)

    monkeypatch.setattr(planning, "solve_multistart", explode)
    shard = solve_problems(recipe, 0, 2)
    assert shard.failure.tolist() == ["", "ZeroDivisionError: as a test"]
    assert set(shard.problem) == {0}
    assert shard.c_rel[1] == -1
    assert np.isnan(shard.rel_cost[1])
    assert "problem 1 of freeflyer/tiny-v0" in caplog.text


def test_when_everything_fails_nothing_is_written(recipe: Recipe, tmp_path: Path, monkeypatch):
    import freeflyer_env.planning as planning

    def explode(problem, n_starts, config, **options):
        raise ZeroDivisionError("as a test")

    monkeypatch.setattr(planning, "solve_multistart", explode)
    with pytest.raises(GenerationError, match=r"All 2 problems from 0 on failed.*as a test"):
        generate(recipe, tmp_path, n_problems=2, workers=1, progress=False)
    assert not list_shards(tmp_path)


GENERATE = """
import importlib, sys
from freeflyer_datasets import Recipe
module = importlib.import_module("freeflyer_datasets.generate")
module.SHARD_SIZE = 3
recipe = Recipe("freeflyer/killed-v0", "Killed.", 60, 5, final_times=(30.0,), n_starts=2)
print("ready", flush=True)
module.generate(recipe, sys.argv[1], workers=int(sys.argv[2]), progress=False)
"""


def start_generation(folder: Path, workers: int = 1) -> subprocess.Popen:
    process = subprocess.Popen(
        [sys.executable, "-c", GENERATE, str(folder), str(workers)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    assert process.stdout is not None
    process.stdout.readline()
    return process


@pytest.mark.slow
def test_killed_at_ten_random_moments_the_bytes_are_the_same(tmp_path: Path):
    undisturbed, killed = tmp_path / "undisturbed", tmp_path / "killed"
    process = start_generation(undisturbed)
    process.communicate()
    assert process.returncode == 0
    rng = np.random.default_rng(0)
    for number in range(10):
        process = start_generation(killed, workers=1 + number % 2)
        time.sleep(rng.uniform(0.0, 0.4))
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
    made = len(list_shards(killed))
    process = start_generation(killed)
    process.communicate()
    assert process.returncode == 0
    assert made < 20, "it was killed too late to matter"
    assert contents(killed) == contents(undisturbed)
    assert len(contents(killed)) == 20
    assert not list(killed.glob("*.tmp"))


def test_a_killed_worker_is_reported_and_the_work_goes_on(recipe: Recipe, shards, tmp_path, caplog):
    killer = Path(tmp_path / "kill-once")
    killer.touch()
    report = generate(KillsItsWorker(recipe, killer), tmp_path / "out", workers=2, progress=False)
    assert "A worker was killed" in caplog.text
    assert report.n_problems == recipe.n_problems
    assert contents(tmp_path / "out") == contents(shards)


class KillsItsWorker:
    """A recipe that kills the process in which it is first asked for problem 5."""

    def __init__(self, recipe: Recipe, killer: Path) -> None:
        self.recipe, self.killer = recipe, killer

    def __getattr__(self, name: str):
        if name.startswith("__") or name == "recipe":
            raise AttributeError(name)
        return getattr(self.recipe, name)

    def problem(self, index: int):
        if index == 5 and self.killer.is_file():
            self.killer.unlink()
            os.kill(os.getpid(), signal.SIGKILL)
        return self.recipe.problem(index)


def test_a_full_disk_is_one_line_and_loses_nothing(recipe: Recipe, tmp_path, monkeypatch):
    write = GENERATE_MODULE.write_shard

    def full(path, shard):
        if shard.first:
            raise OSError(errno.ENOSPC, "No space left on device")
        write(path, shard)

    monkeypatch.setattr(GENERATE_MODULE, "write_shard", full)
    with pytest.raises(GenerationError, match=r"the disk is full\. The finished ones are safe"):
        generate(recipe, tmp_path, workers=1, progress=False)
    assert len(list_shards(tmp_path)) == 1
    monkeypatch.setattr(GENERATE_MODULE, "write_shard", write)
    assert generate(recipe, tmp_path, workers=1, progress=False).kept_shards == 1


def test_leftovers_of_killed_processes_are_removed(recipe: Recipe, shards, tmp_path):
    shutil.copytree(shards, tmp_path, dirs_exist_ok=True)
    gone, alive = tmp_path / "shard-000001.npz.999999999.tmp", tmp_path / f"x.{os.getpid()}.tmp"
    gone.touch()
    alive.touch()
    generate(recipe, tmp_path, workers=1, progress=False)
    assert not gone.exists()
    assert alive.exists()


def test_a_local_ray_cluster_makes_the_same_bytes(recipe: Recipe, shards, tmp_path):
    ray = pytest.importorskip("ray")
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
    try:
        generate(recipe, tmp_path, workers=2, progress=False, engine="ray")
    finally:
        ray.shutdown()
    assert contents(tmp_path) == contents(shards)
    with pytest.raises(ValueError, match="engine must be one of"):
        generate(recipe, tmp_path, engine="spark")


def test_the_first_optimum_is_scp_from_rel_unless_that_fails(recipe: Recipe):
    fields = {**recipe.to_dict(), "optima": "first", "id": "freeflyer/first-v0"}
    first, every = (solve_problems(one, 0, 6) for one in (Recipe.from_dict(fields), recipe))
    assert sorted(set(first.problem[first.label == LABEL_SCP])) == sorted(
        set(every.problem[every.label == LABEL_SCP])
    )
    for row in np.flatnonzero(first.label == LABEL_SCP):
        same = (every.problem == first.problem[row]) & (every.label == LABEL_SCP)
        assert first.rank[row] == 0
        assert first.start_number[row] <= every.start_number[same].min()
        assert np.abs(every.cost[same] - first.cost[row]).min() < 1e-4


def test_only_the_best_optimum_is_kept_on_request(recipe: Recipe):
    fields = {**recipe.to_dict(), "optima": "best", "id": "freeflyer/best-v0"}
    best, every = (solve_problems(one, 0, 3) for one in (Recipe.from_dict(fields), recipe))
    assert set(best.rank) == {0}
    kept = every.rank == 0
    # A race solves the subproblems in another order, which shows in the solver's last digits.
    np.testing.assert_allclose(best.cost, every.cost[kept], rtol=1e-8)
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
