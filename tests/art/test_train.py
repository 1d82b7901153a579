"""The training loop: it learns, repeats itself exactly, and goes on where it stopped."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from art_policy import train as train_module
from art_policy.autoregressive import Autoregressive
from art_policy.examination import Examiner
from art_policy.layers import ARTConfig
from art_policy.model import ART
from art_policy.sequence import DISC_SPEED
from art_policy.train import CHECKPOINT_NAME, train
from art_policy.train_config import TrainConfig
from art_policy.train_io import LOG_NAME
from art_policy.training_data import SequenceSet, problem_batch
from art_policy.transfer import begin_with
from freeflyer_datasets.loading import PackedDataset

TINY = ARTConfig(width=32, n_layers=2, n_heads=2, n_hypotheses=4, dropout=0.1)
TINY_SEQUENCE = replace(TINY, head="autoregressive", context_length=12, tokens_per_step=2)
HEADS = pytest.mark.parametrize(
    "model",
    [TINY, TINY_SEQUENCE, replace(TINY_SEQUENCE, n_modes=3)],
    ids=["hypotheses", "sequence", "modes"],
)

SHORT = TrainConfig(max_steps=6, batch_size=8, log_every=2, validate_every=4, precision="float32")


def log_of(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / LOG_NAME).read_text().splitlines()]


@HEADS
def test_same_seed_same_bytes(dataset: PackedDataset, tmp_path: Path, model: ARTConfig) -> None:
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        train(dataset, model, replace(SHORT, seed=seed), tmp_path / name)
    a, b, c = ((tmp_path / name / "model.safetensors").read_bytes() for name in "abc")
    assert a == b
    assert a != c


@HEADS
def test_resuming_changes_nothing(
    dataset: PackedDataset, tmp_path: Path, model: ARTConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    train(dataset, model, SHORT, tmp_path / "whole")
    calls, update = 0, train_module._State.update_average

    def interrupt(state: Any, decay: float) -> None:
        nonlocal calls
        calls += 1
        update(state, decay)
        if calls == 3:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(train_module._State, "update_average", interrupt)
    train(dataset, model, SHORT, tmp_path / "parts")
    assert torch.load(tmp_path / "parts" / CHECKPOINT_NAME, weights_only=True)["step"] == 3
    train(dataset, model, SHORT, tmp_path / "parts")
    assert calls == SHORT.max_steps
    whole, parts = (tmp_path / name / "model.safetensors" for name in ("whole", "parts"))
    assert whole.read_bytes() == parts.read_bytes()
    steps = [row["step"] for row in log_of(tmp_path / "parts") if "lr" in row]
    assert steps == [2, 4, 6]


def test_hypotheses_overfit_a_tiny_set(dataset: PackedDataset, tmp_path: Path) -> None:
    model = replace(TINY, width=64, dropout=0.0)
    config = replace(SHORT, max_steps=800, batch_size=24, learning_rate=3e-3, ema_decay=0.9,
                     augment=False, tails=0.0, log_every=10,
                     validate_every=1000)  # fmt: skip
    train(dataset, model, config, tmp_path)
    rows = [row for row in log_of(tmp_path) if "lr" in row]
    assert rows[-1]["distance"] < 0.03
    assert rows[-1]["distance"] < 0.3 * rows[0]["distance"]
    assert rows[-1]["agreement"] > 0.8


@pytest.mark.parametrize("n_modes", [1, 3])
def test_sequences_overfit_a_tiny_set(dataset: PackedDataset, tmp_path: Path, n_modes: int) -> None:
    model = replace(TINY_SEQUENCE, width=64, dropout=0.0, context_length=40, n_modes=n_modes)
    config = replace(SHORT, max_steps=300, batch_size=8, learning_rate=3e-3, ema_decay=0.9,
                     augment=False, log_every=50, validate_every=1000)  # fmt: skip
    train(dataset, model, config, tmp_path)
    rows = [row for row in log_of(tmp_path) if "lr" in row]
    assert rows[-1]["control_loss"] < 0.4
    assert rows[-1]["state_loss"] < 0.05


def test_a_model_knows_what_it_was_trained_on(dataset: PackedDataset, tmp_path: Path) -> None:
    train(dataset, TINY, replace(SHORT, max_steps=1), tmp_path)
    envelope = ART.from_pretrained(tmp_path).config.envelope
    assert envelope is not None
    assert envelope.final_time == (30.0, 40.0)
    assert envelope.n_obstacles == (2, 4)
    assert 0.01 < envelope.obstacle_speed <= 0.02
    assert envelope.end_speed > 0.05  # of the problems that begin in flight
    more = replace(SHORT, max_steps=1, max_discs=6, init=str(tmp_path))
    train([dataset, dataset], replace(TINY, n_hypotheses=5), more, tmp_path / "more")
    envelope = ART.from_pretrained(tmp_path / "more").config.envelope
    assert envelope is not None
    assert envelope.n_obstacles == (2, 6)
    assert envelope.obstacle_speed == DISC_SPEED


def test_other_knots_and_more_hypotheses_begin_with_the_same_paths(
    dataset: PackedDataset, tmp_path: Path
) -> None:
    torch.manual_seed(1)
    first = replace(TINY, n_knots=6, knot_spacing="uniform")
    model = ART(first).eval()
    model.save_pretrained(tmp_path)
    finer = ART(replace(first, n_knots=13)).eval()  # every second knot is where one was
    begin_with(finer, str(tmp_path))
    problems = problem_batch(dataset, np.arange(3))
    with torch.inference_mode():
        (paths, scores), (fine_paths, fine_scores) = model(problems), finer(problems)
    torch.testing.assert_close(fine_paths[:, :, 1::2], paths)
    torch.testing.assert_close(fine_scores, scores)
    more = ART(replace(first, n_hypotheses=6)).eval()
    begin_with(more, str(tmp_path))
    ours, theirs = (dict(each.named_parameters())["net.query_embedding"] for each in (more, model))
    torch.testing.assert_close(ours[:4], theirs, atol=0.0, rtol=0.0)


def test_several_modes_begin_near_the_one_that_was(dataset: PackedDataset, tmp_path: Path) -> None:
    single = ART(TINY_SEQUENCE).eval()
    single.save_pretrained(tmp_path)
    several = ART(replace(TINY_SEQUENCE, n_modes=3)).eval()
    begin_with(several, str(tmp_path))
    tokens = torch.randn(5, TINY_SEQUENCE.width)
    assert isinstance(single.net, Autoregressive)
    assert isinstance(several.net, Autoregressive)
    with torch.inference_mode():
        one, _ = single.net.decode_controls(tokens)
        modes, logits = several.net.decode_controls(tokens)
    assert logits.shape == (5, 3)
    spread = 0.02 * TINY_SEQUENCE.width**0.5
    assert (modes - one).std() == pytest.approx(spread, rel=0.5)
    several.save_pretrained(tmp_path)
    with pytest.raises(ValueError, match="n_modes"):
        begin_with(single, str(tmp_path))


def test_openings_are_the_first_steps(dataset: PackedDataset) -> None:
    rows, generator = np.arange(len(dataset)), torch.Generator().manual_seed(0)
    openings = SequenceSet(dataset, rows, (3.5, 2.5), 100, openings=1.0)
    batch = openings.batch(torch.arange(8), generator)
    assert batch.states.shape == (8, 16, 6)
    torch.testing.assert_close(batch.states[:, 0], batch.problems.start)
    assert openings.batch(torch.arange(8), None).states.shape[1] > 16  # not of validation


def test_training_from_a_model_keeps_its_scales(dataset: PackedDataset, tmp_path: Path) -> None:
    train(dataset, TINY_SEQUENCE, replace(SHORT, max_steps=1), tmp_path / "first")
    first = ART.from_pretrained(tmp_path / "first")
    with torch.no_grad():
        first.net.control_scale.mul_(2.0)
    first.save_pretrained(tmp_path / "first")
    config = replace(SHORT, max_steps=1, init=str(tmp_path / "first"))
    second = train(dataset, TINY_SEQUENCE, config, tmp_path / "second")
    torch.testing.assert_close(second.net.control_scale, first.net.control_scale)


def test_validation_problems_are_never_trained_on(dataset: PackedDataset) -> None:
    training, validation = dataset.split(0.2)
    ours = set(dataset.problem_index[training])
    assert not ours & set(dataset.problem_index[validation])


def test_the_clock_ends_the_schedule() -> None:
    config = TrainConfig(max_minutes=2.0)
    assert config.progress(10_000, 60.0) == 0.5
    assert config.progress(0, 121.0) == 1.0
    both = TrainConfig(max_minutes=2.0, max_steps=100)
    assert both.progress(80, 60.0) == 0.8
    rates = [config.rate(share) for share in (0.0, 0.03, 0.5, 1.0)]
    assert rates[0] < 0.1 * rates[1]
    assert rates[1] == pytest.approx(config.learning_rate)
    assert rates[1] > rates[2] > rates[3]
    assert rates[3] == pytest.approx(0.01 * config.learning_rate)


def test_a_run_with_other_settings_is_not_resumed(dataset: PackedDataset, tmp_path: Path) -> None:
    short = replace(SHORT, max_steps=1)
    train(dataset, TINY, short, tmp_path)
    with pytest.raises(ValueError, match="another learning_rate; train into another folder"):
        train(dataset, TINY, replace(short, learning_rate=1e-4), tmp_path)
    with pytest.raises(ValueError, match="another width"):
        train(dataset, replace(TINY, width=64), short, tmp_path)
    train(dataset, replace(TINY, width=64), short, tmp_path, resume=False)


def test_autocast_stays_close_to_float32(dataset: PackedDataset, tmp_path: Path) -> None:
    losses = []
    for precision in ("float32", "bfloat16"):
        folder = tmp_path / precision
        train(dataset, TINY, replace(SHORT, precision=precision, max_steps=4), folder)
        losses.append(next(row["loss"] for row in log_of(folder) if row["step"] == 4))
    assert losses[0] == pytest.approx(losses[1], rel=0.02)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"max_steps": None}, "needs max_steps or max_minutes"),
        ({"max_steps": 0}, "max_steps must be positive, got 0"),
        ({"learning_rate": -1.0}, "learning_rate must be positive, got -1.0"),
        ({"ema_decay": 1.0}, r"ema_decay must be in \[0, 1\), got 1.0"),
        ({"precision": "float16"}, "precision must be one of .* got 'float16'"),
    ],
)
def test_bad_settings(changes: dict[str, Any], match: str) -> None:
    with pytest.raises(ValueError, match=match):
        replace(SHORT, **changes)


def test_training_begins_with_the_weights_of_another_model(
    dataset: PackedDataset, tmp_path: Path
) -> None:
    first = train(dataset, TINY, SHORT, tmp_path / "first")
    config = replace(SHORT, init=str(tmp_path / "first"), learning_rate=1e-12)
    second = train(dataset, TINY, config, tmp_path / "second")
    for a, b in zip(first.parameters(), second.parameters()):
        torch.testing.assert_close(a, b, atol=1e-6, rtol=1e-6)
    with pytest.raises(ValueError, match="is of another width than the model"):
        train(dataset, replace(TINY, width=2 * TINY.width), config, tmp_path / "third")


def test_training_keeps_the_model_that_plans_best(
    dataset: PackedDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scores = iter([0.3, 0.1, 0.2])
    monkeypatch.setattr(
        train_module.Examiner, "examine", lambda examiner, model: {"val_excess": next(scores)}
    )
    train(dataset, TINY, replace(SHORT, validate_every=2, max_steps=5), tmp_path)
    log = log_of(tmp_path)
    assert [row["val_excess"] for row in log if "val_excess" in row] == [0.3, 0.1, 0.2]
    best, kept = (tmp_path / name / "model.safetensors" for name in ("best", "."))
    assert best.read_bytes() == kept.read_bytes()
    last = torch.load(tmp_path / CHECKPOINT_NAME, weights_only=True)["average"]
    kept_model = ART.from_pretrained(tmp_path)
    assert any((a != b).any() for a, b in zip(last, kept_model.parameters()))


def test_examining_is_planning_without_rel(dataset: PackedDataset) -> None:
    examiner = Examiner([dataset], replace(SHORT, solve_problems=5, validation_fraction=0.5))
    torch.manual_seed(0)
    figures = examiner.examine(ART(TINY).eval())
    assert 0.0 <= figures["val_infeasible"] <= 1.0
    assert -0.01 < figures["val_excess"] <= 0.5
    assert Examiner([dataset], replace(SHORT, solve_problems=0)).examine(ART(TINY)) is not None


def test_a_card_and_tensorboard_are_left_behind(dataset: PackedDataset, tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    train(dataset, TINY_SEQUENCE, SHORT, tmp_path)
    card = (tmp_path / "README.md").read_text()
    assert "autoregressive ART" in card
    assert "TFLOP/s of matrix products" in card
    assert "freeflyer/tiny-v0" in card
    assert list((tmp_path / "tensorboard").glob("events.*"))


def test_two_processes_train_as_one_does(dataset: PackedDataset, tmp_path: Path) -> None:
    settings = {"threads": 1, "log_every": 1, "augment": False, "precision": "float32",
                "batch_size": 8, "solve_problems": 4, "tails": 0.0}  # fmt: skip
    command = ["-m", "art_policy.cli", "train", str(dataset.path), "--steps", "3",
               "--model-config", json.dumps({"width": 32, "n_layers": 1, "n_heads": 2}),
               "--train-config", json.dumps(settings)]  # fmt: skip
    launch = ["-m", "accelerate.commands.launch", "--cpu", "--num_processes", "2", "--num_machines",
              "1", "--mixed_precision", "no", "--dynamo_backend", "no"]  # fmt: skip
    for name, start in (("one", command), ("two", [*launch, *command])):
        done = subprocess.run(
            [sys.executable, *start, "--out", str(tmp_path / name)],
            capture_output=True, text=True, timeout=200, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr[-2000:]
    one, two = ([row for row in log_of(tmp_path / name) if "lr" in row] for name in ("one", "two"))
    assert len(one) == len(two) == 3
    weights = [load_file(tmp_path / name / "model.safetensors") for name in ("one", "two")]
    for name, value in weights[0].items():
        torch.testing.assert_close(value, weights[1][name], atol=2e-4, rtol=1e-3)
