"""Recipes: loading, validation, and the problems that they draw."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from freeflyer_datasets import Recipe, list_recipes, load_recipe
from freeflyer_env import SCENES

GOOD = {"id": "freeflyer/x-v0", "description": "A test.", "n_problems": 5, "seed": 1}

# Dataset, number of final times, scenes, samples with one REL and one SCP trajectory a problem.
PAPER = [
    ("time-1-v0", 1, ("nominal",), 200_000),
    ("time-4-v0", 4, ("nominal",), 200_000),
    ("time-random-v0", 121, ("nominal",), 200_000),
    ("scene-1-v0", 1, ("nominal",), 200_000),
    ("scene-15-v0", 1, tuple(f"training-{i}" for i in range(1, 16)), 800_000),
    ("scene-random-v0", 1, "random", 800_000),
]


@pytest.mark.parametrize(("name", "n_times", "scenes", "samples"), PAPER)
def test_packaged_recipes_are_those_of_the_papers_table(name, n_times, scenes, samples):
    recipe = load_recipe(name)
    assert recipe.id == f"freeflyer/{name}"
    assert len(recipe.final_times) == n_times
    assert recipe.scenes == scenes
    assert 2 * recipe.n_problems == samples


def test_every_packaged_recipe_has_its_own_seed_and_solves():
    recipes = [load_recipe(name) for name in list_recipes()]
    assert len(recipes) == 7
    assert len({recipe.seed for recipe in recipes}) == len(recipes)
    for recipe in recipes:
        assert not recipe.problem(0).defects()
        assert Recipe.from_dict(recipe.to_dict()) == recipe


def test_names_resolve_with_and_without_namespace_and_version():
    names = ("scene-random-v0", "freeflyer/scene-random-v0", "scene-random")
    assert len({load_recipe(name).fingerprint for name in names}) == 1


def test_problem_depends_on_seed_and_index_alone():
    recipe = Recipe(**GOOD, n_obstacles=(1, 6), final_times=(40.0, 60.0))
    alone = recipe.problem(7)
    for index in range(7):
        recipe.problem(index)
    assert recipe.problem(7).to_dict() == alone.to_dict()
    assert recipe.problem(8).to_dict() != alone.to_dict()
    other = Recipe(**{**GOOD, "seed": 2}, n_obstacles=(1, 6), final_times=(40.0, 60.0))
    assert other.problem(7).to_dict() != alone.to_dict()


def test_problems_cover_the_recipe_and_are_exact_in_float32():
    recipe = Recipe(**GOOD, n_obstacles=(1, 3), final_times=(40.0, 60.0))
    problems = [recipe.problem(index) for index in range(60)]
    assert {len(problem.scenario.obstacles) for problem in problems} == {1, 2, 3}
    assert {problem.final_time for problem in problems} == {40.0, 60.0}
    named = Recipe(**GOOD, scenes=("training-1", "nominal"))
    scenes = {named.problem(index).scenario.obstacles.rows().tobytes() for index in range(20)}
    assert scenes == {
        np.float32(SCENES[name].rows()).astype(float).tobytes() for name in named.scenes
    }
    for problem in problems:
        for value in (problem.start, problem.goal, problem.scenario.obstacles.rows()):
            np.testing.assert_array_equal(value, np.float32(value).astype(float))


def test_obstacles_move_in_the_share_of_the_problems_that_the_recipe_asks_for():
    recipe = Recipe(**GOOD, obstacle_speeds=(0.0, 0.0, 0.0, 0.02))
    moving = [recipe.problem(index).scenario.obstacles for index in range(200)]
    speeds = [np.linalg.norm(obstacles.velocities, axis=1) for obstacles in moving]
    assert 30 <= sum(obstacles.moving for obstacles in moving) <= 70
    assert 0.015 < np.max(speeds) <= 0.02
    still = Recipe(**GOOD)
    assert still.fingerprint != recipe.fingerprint
    assert still.problem(3).to_dict() == Recipe(**GOOD, obstacle_speeds=(0.0,)).problem(3).to_dict()


def test_fingerprint_ignores_what_problems_do_not_depend_on():
    base = Recipe(**GOOD)
    assert Recipe(**{**GOOD, "n_problems": 9, "description": "Else."}).fingerprint == (
        base.fingerprint
    )
    for change in ({"seed": 2}, {"n_starts": 2}, {"optima": "best"}, {"final_times": (50.0,)}):
        assert Recipe(**{**GOOD, **change}).fingerprint != base.fingerprint


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"id": "no version"}, r"id must look like .*'no version'"),
        ({"description": " "}, "description must be a sentence"),
        ({"n_problems": 0}, r"n_problems must be .*\[1, .*got 0"),
        ({"n_problems": 1.5}, "n_problems must be a whole number"),
        ({"seed": -1}, r"seed must be .*\[0, .*got -1"),
        ({"seed": True}, "seed must be a whole number"),
        ({"n_starts": 0}, r"n_starts must be .*\[1, 64\].*got 0"),
        ({"obstacle_speeds": 0.1}, "must be a list of speeds in m/s, got 0.1"),
        ({"obstacle_speeds": [0.0, 0.1]}, r"in \[0, 0.0625\] m/s for final times of up to 40 s"),
        ({"obstacle_speeds": [0.05], "scenes": ["nominal"]}, "for scenes = 'random' only"),
        ({"optima": "some"}, "optima must be one of .*, got 'some'"),
        ({"scenes": ["nominl"]}, "Did you mean 'nominal'"),
        ({"scenes": []}, "scenes must be"),
        ({"scenes": 3}, "scenes must be"),
        ({"scenes": "nominal", "n_obstacles": 4}, "n_obstacles is for scenes = 'random' only"),
        ({"n_obstacles": 13}, r"n_obstacles must be .*\[0, 12\].*got 13"),
        ({"n_obstacles": [5, 2]}, r"n_obstacles must be \[smallest, largest\]"),
        ({"n_obstacles": [1, 2, 3]}, "n_obstacles must be"),
        ({"final_times": []}, "final_times must be a list"),
        ({"final_times": 40.0}, "final_times must be a list"),
        ({"final_times": [40.2]}, r"multiples of dt = 0.5 s .*got 40.2"),
        ({"final_times": [math.nan]}, "multiples of dt"),
        ({"final_times": [True]}, "multiples of dt"),
        ({"final_times": [0.5]}, r"in \[1.0, 500.0\] s, got 0.5"),
        ({"final_times": {"range": [60.0, 40.0]}}, r"range must be \[smallest, largest\]"),
        ({"final_times": {"rnge": [40.0, 60.0]}}, "range = "),
        ({"n_problem": 3}, "unknown key 'n_problem'. Did you mean 'n_problems'"),
    ],
)
def test_bad_values_name_field_value_and_range(change, match):
    with pytest.raises(ValueError, match=match):
        Recipe.from_dict({**GOOD, **change})


def test_missing_key_is_named():
    with pytest.raises(ValueError, match="missing key 'seed'"):
        Recipe.from_dict({key: value for key, value in GOOD.items() if key != "seed"})


def test_bad_files_are_named(tmp_path: Path):
    with pytest.raises(ValueError, match="Did you mean 'scene-random-v0'"):
        load_recipe("scene-randm-v0")
    with pytest.raises(ValueError, match="no recipe file"):
        load_recipe(tmp_path / "absent.toml")
    path = tmp_path / "mine.toml"
    path.write_text("id = ", encoding="utf-8")
    with pytest.raises(ValueError, match=r"Recipe mine\.toml"):
        load_recipe(path)
    path.write_text('id = "a/b-v0"\ndescription = "x"\nn_problems = 1\nseed = "one"\n')
    with pytest.raises(ValueError, match=r"Recipe mine\.toml: seed must be"):
        load_recipe(path)


def test_a_range_of_final_times_is_every_multiple_of_dt():
    recipe = Recipe.from_dict({**GOOD, "final_times": {"range": [40.0, 41.5]}})
    assert recipe.final_times == (40.0, 40.5, 41.0, 41.5)
