"""The command line on real input, and its one-line errors."""

import json

import numpy as np
import pytest

from art_policy.cli import main
from freeflyer_env import HELD_OUT_SCENES, sample_problem


def run(capsys, *arguments):
    code = main([*arguments, "--json"])
    captured = capsys.readouterr()
    assert code == 0, captured.err
    return json.loads(captured.out)


def test_plan_writes_a_plan_that_can_be_read_again(capsys, tmp_path, untrained_model):
    out = tmp_path / "plan.json"
    first = run(capsys, "plan", "--seed", "3", "--model", untrained_model, "--out", str(out))
    assert first["status"] == "solved"
    assert first["cost"] > 0
    data = json.loads(out.read_text())
    assert np.array(data["states"]).shape == (81, 6)
    again = run(capsys, "plan", "--problem", str(out), "--model", untrained_model)
    assert again["cost"] == pytest.approx(first["cost"], rel=1e-9)
    assert again["problem"] == first["problem"]


def test_plan_takes_start_goal_scene_and_final_time(capsys, untrained_model):
    result = run(
        capsys, "plan", "--scene", "held-out-3", "--final-time", "50", "--model", "rel",
        "--start", "0.2", "1.2", "0", "--goal", "3.3", "1.0", "6.5",
    )  # fmt: skip
    assert result["problem"]["start"][:3] == [0.2, 1.2, 0.0]
    assert result["problem"]["goal"][2] == pytest.approx(6.5 - 2 * np.pi)
    assert result["problem"]["final_time"] == 50.0
    assert result["source"] == "rel"


def test_fly_writes_an_animation(capsys, tmp_path, untrained_model):
    out = tmp_path / "flight.gif"
    result = run(capsys, "fly", "--seed", "3", "--model", untrained_model, "--out", str(out))
    assert result["flight"]["success"]
    assert result["flight"]["final_position_error_m"] < 0.02
    assert out.read_bytes()[:3] == b"GIF"


def test_generate_train_evaluate_and_render(capsys, tmp_path, monkeypatch):
    recipe = tmp_path / "tiny.toml"
    recipe.write_text(
        'id = "freeflyer/tiny-v0"\ndescription = "Tiny."\nn_problems = 12\nseed = 1\nn_starts = 2\n'
    )
    root = tmp_path / "minari"
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(root))
    made = run(capsys, "generate", str(recipe), "--workers", "1", "--out", str(root))
    assert made["dataset"] == "freeflyer/tiny-v0"
    model = tmp_path / "model"
    settings = json.dumps({"batch_size": 8, "threads": 1, "validation_fraction": 0.3})
    trained = run(
        capsys, "train", "freeflyer/tiny-v0", "--steps", "4", "--out", str(model),
        "--model-config", '{"width": 32, "n_layers": 1, "n_heads": 2}', "--train-config", settings,
    )  # fmt: skip
    assert trained["parameters"] > 1000
    report = tmp_path / "report.json"
    result = run(
        capsys, "evaluate", str(model), "--problems", "3", "--candidates", "1", "--workers", "1",
        "--out", str(report),
    )  # fmt: skip
    assert set(result["groups"]["all"]) >= {"REL", "ART"}
    assert report.is_file()
    picture = tmp_path / "episode.png"
    run(capsys, "render", "freeflyer/tiny-v0", "--episode", "1", "--out", str(picture))
    assert picture.stat().st_size > 1000
    assert run(capsys, "info", str(model))["parameters"] == trained["parameters"]


def test_info_lists_what_there_is(capsys):
    data = run(capsys, "info")
    assert "scene-random-v0" in " ".join(data["recipes"])
    assert "held-out-1" in data["scenes"]
    assert main(["info"]) == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["plan", "--model", "art-scene-randon"], "No model is called"),
        (["plan", "--model", "rel", "--scene", "held-out-9"], "Did you mean 'held-out-"),
        (["plan", "--model", "rel", "--final-time", "0.7"], "multiple of dt = 0.5"),
        (["plan", "--model", "rel", "--final-time", "nan"], "multiple of dt"),
        (["plan", "--model", "rel", "--start", "nan", "1", "0"], "start must be finite"),
        (["plan", "--model", "rel", "--goal", "9", "1", "0"], "goal (9.000, 1.000) m is off"),
        (["plan", "--problem", "missing.json"], "missing.json"),
        (["plan", "--model", "rel", "--out", "plan.txt"], "must end in .json or .png"),
        (["fly", "--model", "rel", "--final-time", "2"], "no plan to fly"),
        (["generate", "scene-randm-v0"], "Did you mean"),
        (["train", "freeflyer/nothing-v0", "--out", "x", "--steps", "1"], "freeflyer/nothing-v0"),
        (["evaluate", "no-such-model"], "No model is called"),
        (["render", "freeflyer/nothing-v0", "--out", "x.mp4"], "must end in .gif or .png"),
        (["info", "no-such-model"], "No model is called"),
        (["plan", "--problem", "list.json"], "must hold a JSON object"),
        (["plan", "--problem", "null.json"], "numbers and lists of numbers"),
        (["plan", "--problem", "null.json", "--goal", "3", "1", "0"], "leave out --goal"),
        (["plan", "--problem", "list.json/x"], "list.json/x"),
        (["plan", "--model", "rel", "--out", "list.json/plan.json"], "cannot be written"),
        (["train", "x", "--out", "x", "--steps", "1", "--model-config", "{"], "--model-config"),
        (["train", "x", "--out", "x", "--steps", "1", "--train-config", '{"lr": 1}'], "'lr'"),
        (["train", "x", "--out", "list.json", "--steps", "1"], "must be a folder"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(capsys, tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    (tmp_path / "list.json").write_text("[1, 2]")
    zeros = [0.2, 1.0, 0, 0, 0, 0]
    problem = {"start": zeros, "goal": zeros, "obstacles": [], "final_time": None}
    (tmp_path / "null.json").write_text(json.dumps(problem))
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert message in error
    assert len(error.strip().splitlines()) == 1


def test_a_start_inside_an_obstacle_is_named(capsys):
    x, y = sample_problem(np.random.default_rng(0), HELD_OUT_SCENES[0]).scenario.obstacles.centres[
        0
    ]
    arguments = ["plan", "--model", "rel", "--scene", "held-out-1", "--start", str(x), str(y), "0"]
    assert main(arguments) == 2
    assert "inside the keep-out zone of obstacle 0" in capsys.readouterr().err


@pytest.mark.parametrize("value", ["many", "0", "-2"])
def test_wrong_options_exit_with_2(value):
    with pytest.raises(SystemExit) as stop:
        main(["plan", "--candidates", value])
    assert stop.value.code == 2


def test_sharing_commands_are_one_line_where_they_cannot(capsys, monkeypatch, tmp_path):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    assert main(["upload", "freeflyer/absent-v0", "--remote", "hf://nobody"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("freeflyer upload: error:")
    assert error.count("\n") == 1
    assert main(["download", "no id", "--remote", "hf://nobody"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
