"""The card, its pictures, and what `freeflyer info` tells of a dataset."""

from __future__ import annotations

import json
import re
import shutil
import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from art_policy import cli
from freeflyer_datasets import LABEL_REL, Recipe, describe, list_recipes
from freeflyer_datasets.card import dataset_card, package_versions, recipe_toml
from freeflyer_datasets.describe import describe_text, find_local, list_local
from freeflyer_datasets.export import Credits, export
from freeflyer_datasets.pictures import HISTOGRAMS, PLATE, draw_pictures
from freeflyer_datasets.shards import Shard, iterate_shards, join_shards
from freeflyer_datasets.summary import Statistics, share, wilson_interval

pytest.importorskip("minari")


@pytest.fixture(scope="module")
def exported(shards: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data root that holds the tiny dataset; tests must not change it."""
    root = tmp_path_factory.mktemp("root")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(root))
        export(shards)
    return root


@pytest.fixture
def folder(exported: Path, recipe: Recipe, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of the exported dataset, in Minari's data root; tests must not change it."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(exported))
    return exported / recipe.id


@pytest.fixture
def card(folder: Path) -> str:
    return (folder / "README.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def whole(shards: Path) -> Shard:
    """All problems in one shard."""
    return join_shards(iterate_shards(shards))


def without_rel(shard: Shard, n_lost: int) -> Shard:
    """The shard with its last problems failed: without any trajectory."""
    kept = shard.head(shard.n_problems - n_lost)
    lost = np.arange(shard.n_problems) >= shard.n_problems - n_lost
    names = ("start", "goal", "obstacles", "final_time")
    return replace(
        kept,
        **{name: getattr(shard, name) for name in names},
        c_rel=np.where(lost, -1, shard.c_rel).astype(np.int32),
        rel_cost=np.where(lost, np.nan, shard.rel_cost),
        failure=np.where(lost, "as a test", shard.failure),
    )


# -- statistics and card -------------------------------------------------------------------------


def test_the_counts_of_the_card_agree_with_the_shards(card: str, folder: Path, whole: Shard):
    is_rel = whole.label == LABEL_REL
    solved = np.unique(whole.problem[~is_rel])
    several = np.bincount(whole.problem[~is_rel]) > 1
    feasible = int((whole.c_rel == 0).sum())
    size = (folder / "data" / "main_data.hdf5").stat().st_size
    for row in (
        f"| problems | {whole.n_problems} |",
        "| without any trajectory | 0 |",
        f"| episodes | {whole.n_trajectories} (REL {is_rel.sum()}, SCP {(~is_rel).sum()}) |",
        f"| steps | {len(whole.controls):,} |",
        f"| size in MB | {size / 1e6:.1f} |",
        f"| size of an episode in kB | {size / 1e3 / whole.n_trajectories:.1f} |",
        f"| REL trajectories that happen to be feasible | {feasible} of 10 |",
        f"| problems with a REL trajectory | {is_rel.sum()} of 10 |",
        f"| problems with an optimum | {len(solved)} of 10 |",
        f"| problems with several optima | {several.sum()} of 10 |",
    ):
        assert row in card
    low, high = (100 * end for end in wilson_interval(feasible, 10))
    assert f"{10 * feasible:.2f} % | {low:.2f} to {high:.2f} % |" in card


def test_statistics_are_the_same_from_one_shard_and_from_three(shards: Path, whole: Shard):
    one, three = Statistics.of_shards([whole]), Statistics.of_shards(iterate_shards(shards))
    assert one.summary() == three.summary()
    assert json.loads(json.dumps(one.summary())) == one.summary()
    with pytest.raises(ValueError, match="no shards"):
        Statistics.of_shards([])


def test_failed_problems_count_among_the_problems(whole: Shard, recipe: Recipe):
    statistics = Statistics.of_shards([without_rel(whole, 4)])
    assert (statistics.n_problems, statistics.n_failed) == (10, 4)
    assert statistics.summary()["with_optimum"][0] == statistics.solved.sum() / 10
    text = dataset_card(recipe, statistics, package_versions(), 1)
    assert "| problems with a REL trajectory | 6 of 10 | 60.00 % |" in text
    assert "| without any trajectory | 4 |" in text


@pytest.mark.parametrize(
    ("successes", "n", "low", "high"),
    [(0, 10, 0.0, 0.2775), (5, 10, 0.2366, 0.7634), (81, 263, 0.2553, 0.3662), (0, 0, 0, 1)],
)
def test_wilsons_interval(successes: int, n: int, low: float, high: float):
    """The third row is the example of Newcombe (1998)."""
    assert wilson_interval(successes, n) == pytest.approx((low, high), abs=1e-4)
    assert wilson_interval(n - successes, n) == pytest.approx((1 - high, 1 - low), abs=1e-4)
    assert share(successes, n) == ([successes / n, *wilson_interval(successes, n)] if n else [])
    with pytest.raises(ValueError, match="n_successes"):
        wilson_interval(n + 1, n)


def test_the_recipe_on_the_card_is_the_recipe(card: str, recipe: Recipe):
    text = re.search(r"```toml\n(.*?)```", card, re.DOTALL)
    assert text is not None
    assert Recipe.from_dict(tomllib.loads(text[1])) == recipe


@pytest.mark.parametrize("name", list_recipes())
def test_every_recipe_survives_its_toml(name: str):
    from freeflyer_datasets import load_recipe

    recipe = load_recipe(name)
    parsed = Recipe.from_dict(tomllib.loads(recipe_toml(recipe, 7)))
    assert parsed == replace(recipe, n_problems=7)
    assert len(recipe_toml(recipe, 7)) < 600


def test_odd_descriptions_and_times_survive_toml(recipe: Recipe):
    text = 'A "quoted" \\ back\tslash, \x7f, ü, \U0001f680.'
    times = (40.0, 40.5, 41.0, 41.5, 42.0, 42.5, 43.5)  # no range
    odd = replace(recipe, description=text, final_times=times)
    assert Recipe.from_dict(tomllib.loads(recipe_toml(odd, 10))) == odd


def test_what_only_one_start_tells_is_on_the_card(recipe: Recipe, whole: Shard):
    statistics = Statistics.of_shards([whole])
    for n_starts, expected in ((1, True), (2, False)):
        one = replace(recipe, n_starts=n_starts)
        text = dataset_card(one, statistics, package_versions(), 1)
        assert ("SCP started from REL alone |" in text) == expected
        assert ("with several optima" in text) != expected


def test_front_matter_citation_and_versions(card: str):
    front = card.split("---\n")[1]
    for line in ("license: mit", "viewer: false", "size_categories: [n<1K]"):
        assert line in front.splitlines()
    assert card.count("```bibtex\n@software{") == card.count("@misc{") == 1
    assert card.count("{") == card.count("}")
    for package, number in package_versions().items():
        assert f"{package} {number}" in card
    assert {"freeflyer-gym", "Python", "numpy", "piqp", "minari"} <= package_versions().keys()


def test_minari_shows_nothing_as_missing(folder: Path):
    from minari.storage.local import list_local_datasets
    from minari.utils import get_dataset_spec_dict

    shown = get_dataset_spec_dict(list_local_datasets()["freeflyer/tiny-v0"])
    assert not [key for key, text in shown.items() if text in ("", "None", "Not provided")]
    assert shown["Email"] == Credits().author_email
    assert " " not in Credits().code_permalink, "Minari shows it as a link"


# -- pictures ------------------------------------------------------------------------------------


def test_the_pictures_are_small_and_always_the_same(
    folder: Path, card: str, shards: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    import matplotlib
    from PIL import Image

    for key, value in (("font.size", 20.0), ("axes.facecolor", "black")):
        monkeypatch.setitem(matplotlib.rcParams, key, value)
    statistics = Statistics.of_shards(iterate_shards(shards))
    names = draw_pictures(tmp_path, statistics, next(iterate_shards(shards)))
    assert names == [HISTOGRAMS, PLATE]
    assert matplotlib.rcParams["font.size"] == 20.0
    for name in names:
        content = (folder / name).read_bytes()
        assert 5_000 < len(content) < 300_000
        assert (tmp_path / name).read_bytes() == content
        assert f"({name})" in card
        with Image.open(folder / name) as picture:
            assert picture.info.keys() <= {"dpi"}, "neither text nor time"


def test_there_are_pictures_without_any_trajectory(whole: Shard, tmp_path: Path, recipe: Recipe):
    nothing = without_rel(whole, 10)
    statistics = Statistics.of_shards([nothing])
    names = draw_pictures(tmp_path, statistics, nothing)
    text = dataset_card(recipe, statistics, package_versions(), 1, names)
    assert "| episodes | 0 (REL 0, SCP 0) |" in text


def test_without_matplotlib_there_are_only_no_pictures(
    shards: Path,
    data_root: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    folder = data_root / export(shards)
    assert caplog.text.count("no pictures") == 1
    assert not list(folder.glob("*.png"))
    assert "![" not in (folder / "README.md").read_text()


# -- freeflyer info ------------------------------------------------------------------------------


def test_info_describes_a_dataset(folder: Path, recipe: Recipe, capsys):
    assert list_local() == [recipe.id]
    assert find_local("tiny-v0") == recipe.id
    data = describe(recipe.id)
    assert describe("tiny-v0") == data
    assert Recipe.from_dict(data["recipe"]) == recipe
    assert data["episodes"] == sum(data["statistics"]["episodes"].values())
    assert cli.main(["info", recipe.id]) == 0
    printed = capsys.readouterr().out
    assert printed == describe_text(data) + "\n"
    assert recipe_toml(recipe, 10).splitlines()[0] in printed
    for text in (str(folder), "30, 40 s", "REL feasible", "C_REL", "MB", "REL 10, SCP"):
        assert text in printed
    assert cli.main(["info", recipe.id, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == data


def test_an_earlier_dataset_is_described_by_its_episodes(
    folder: Path, recipe: Recipe, data_root: Path, monkeypatch: pytest.MonkeyPatch, capsys
):
    whole = describe(recipe.id)["statistics"]
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(data_root))
    path = shutil.copytree(folder, data_root / recipe.id) / "data" / "metadata.json"
    metadata = json.loads(path.read_text())
    for name in ("statistics", "versions", "recipe"):
        del metadata[name]
    path.write_text(json.dumps(metadata))
    data = describe(recipe.id)
    assert data["statistics"].pop("problems_looked_at") == 10
    shared = data["statistics"].keys() & whole.keys()
    assert len(shared) == 7
    for name in shared:
        assert data["statistics"][name] == pytest.approx(whole[name], rel=1e-5), name
    # Of another maker: the attributes are missing.
    path.with_name("main_data.hdf5").unlink()
    assert describe(recipe.id)["statistics"] == {}
    assert cli.main(["info", recipe.id]) == 0
    assert "did not make this dataset" in capsys.readouterr().out


def test_unfinished_datasets_are_not_listed(data_root: Path):
    for name in (".shards/freeflyer/tiny-v0", "freeflyer/.tiny-v0.12.tmp"):
        (data_root / name / "data").mkdir(parents=True)
        (data_root / name / "data" / "metadata.json").write_text("{}")
    assert list_local() == []


def test_info_describes_a_model(capsys):
    pytest.importorskip("torch")
    from art_policy.model import shipped_models

    name = shipped_models()[0]
    assert cli.main(["info", name, "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["model"] == name
    assert data["parameters"] > 10_000


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("freeflyer/tiny-v1", "Did you mean 'freeflyer/tiny-v0'?"),
        ("tiny", "Did you mean 'freeflyer/tiny-v0'?"),
        ("other/tiny-v0", "Did you mean 'freeflyer/tiny-v0'"),
        ("freeflyer/scene-random-v0", "Make it with: freeflyer generate scene-random-v0"),
        ("freeflyer/scene-14-v0", " or 'scene-15-v0'"),
        ("art-scene-randon", "Did you mean 'art-scene-random'"),
        ("nothing-like-it", "recipes: general-v0"),
        ("../x-v0", "No model is called '../x-v0', and no dataset here"),
    ],
)
def test_an_unknown_name_is_one_line(folder: Path, name: str, message: str, capsys):
    assert cli.main(["info", name]) == 2
    printed = capsys.readouterr()
    assert message in printed.err
    assert len(printed.err.splitlines()) == 1
    assert printed.out == ""
