"""Both heads: what they may see, what they must not, and that they come back from disk."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from art_policy.layers import KNOT_SPACINGS, ARTConfig, KeyValueCache
from art_policy.model import ART, CONFIG_NAME, WEIGHTS_NAME
from art_policy.multi_hypothesis import (
    HypothesisLoss,
    _assign,
    interpolation_matrix,
    knot_places,
)
from art_policy.sequence import ProblemBatch, SequenceBatch
from art_policy.training_data import HypothesisSet, SequenceSet, problem_batch
from freeflyer_datasets.loading import PackedDataset

TINY = ARTConfig(width=32, n_layers=2, n_heads=2, n_hypotheses=4)
TINY_SEQUENCE = replace(TINY, head="autoregressive", context_length=16)


def make(config: ARTConfig) -> ART:
    torch.manual_seed(0)
    model = ART(config).eval()
    with torch.no_grad():
        for parameter in model.parameters():  # large enough that every path matters
            parameter.add_(0.2 * torch.randn_like(parameter))
    return model


def sequences(dataset: PackedDataset, config: ARTConfig, count: int = 6) -> SequenceBatch:
    trajectories = np.arange(len(dataset))
    training = SequenceSet(dataset, trajectories, config.table, config.context_length)
    return training.batch(torch.arange(count), None)


def problems(dataset: PackedDataset) -> ProblemBatch:
    return problem_batch(dataset, np.arange(12))


@pytest.mark.parametrize("tokens_per_step", [2, 4])
def test_a_later_step_does_not_change_an_earlier_prediction(
    dataset: PackedDataset, tokens_per_step: int
) -> None:
    config = replace(TINY_SEQUENCE, tokens_per_step=tokens_per_step)
    model, batch, cut = make(config), sequences(dataset, config), 9
    control, outcome = model(batch)
    changed = {}
    for name in ("states", "controls", "returns_to_go", "constraints_to_go"):
        value = getattr(batch, name).clone()
        value[:, cut:] += 1.0
        changed[name] = value
    other_control, other_outcome = model(replace(batch, **changed))
    assert torch.equal(control[:, :cut], other_control[:, :cut])
    assert torch.equal(outcome[:, :cut], other_outcome[:, :cut])
    assert (control[:, cut:] != other_control[:, cut:]).any(dim=-1).all()


@pytest.mark.parametrize("tokens_per_step", [2, 4])
def test_a_control_is_predicted_without_seeing_it(
    dataset: PackedDataset, tokens_per_step: int
) -> None:
    config = replace(TINY_SEQUENCE, tokens_per_step=tokens_per_step)
    model, batch = make(config), sequences(dataset, config)
    controls = batch.controls.clone()
    controls[:, 5] += 0.01
    before, after = model(batch)[0], model(replace(batch, controls=controls))[0]
    assert torch.equal(before[:, :6], after[:, :6])
    assert (before[:, 6:] != after[:, 6:]).any()


@pytest.mark.parametrize("name", ["states", "returns_to_go", "constraints_to_go", "time_to_go"])
def test_every_descriptor_matters(dataset: PackedDataset, name: str) -> None:
    model, batch = make(TINY_SEQUENCE), sequences(dataset, TINY_SEQUENCE)
    value = getattr(batch, name).clone()
    value[:, 4] += 0.3
    assert (model(batch)[0][:, 4] != model(replace(batch, **{name: value}))[0][:, 4]).any(1).all()


@pytest.mark.parametrize(
    ("left_out", "name"),
    [("reward_to_go", "returns_to_go"), ("constraint_to_go", "constraints_to_go")],
)
def test_descriptors_that_are_left_out_do_not_matter(
    dataset: PackedDataset, left_out: str, name: str
) -> None:
    given = tuple(each for each in TINY_SEQUENCE.descriptors if each != left_out)
    model, batch = make(replace(TINY_SEQUENCE, descriptors=given)), sequences(dataset, TINY)
    other = replace(batch, **{name: getattr(batch, name) + 0.3})
    assert torch.equal(model(batch)[0], model(other)[0])


def test_without_goal_and_time_to_go(dataset: PackedDataset) -> None:
    model = make(replace(TINY_SEQUENCE, descriptors=("reward_to_go",)))
    batch = sequences(dataset, TINY)
    later = replace(
        batch,
        time_to_go=batch.time_to_go + 5.0,
        problems=replace(
            batch.problems,
            goal=batch.problems.goal + 0.1,
            final_time=batch.problems.final_time + 5.0,
        ),
    )
    torch.testing.assert_close(model(batch)[0], model(later)[0], atol=1e-5, rtol=1e-5)


def test_cached_and_uncached_agree_beyond_the_context(dataset: PackedDataset) -> None:
    net = make(replace(TINY_SEQUENCE, context_length=5)).net
    tokens = torch.randn(3, 61, TINY.width)
    with torch.inference_mode():
        whole, cache = net.transform(tokens), KeyValueCache()
        parts = [net.transform(part, cache) for part in tokens.split([3, *[4] * 14, 2], dim=1)]
    torch.testing.assert_close(torch.cat(parts, dim=1), whole, atol=1e-5, rtol=1e-4)
    assert cache.length <= net.window + 4


@pytest.mark.parametrize("config", [TINY, TINY_SEQUENCE])
def test_order_and_padding_of_obstacles_do_not_matter(
    dataset: PackedDataset, config: ARTConfig
) -> None:
    model = make(config)
    batch = sequences(dataset, config)
    problem = batch.problems
    shuffled = torch.cat([torch.zeros_like(problem.discs[:, :2]), problem.discs.flip(1)], dim=1)
    other = replace(problem, discs=shuffled)
    first, second = problem, other
    if config.head == "autoregressive":
        first, second = batch, replace(batch, problems=other)
    for a, b in zip(model(first), model(second)):
        torch.testing.assert_close(a, b, atol=1e-4, rtol=1e-4)


def test_no_obstacles_at_all(dataset: PackedDataset) -> None:
    batch = problems(dataset)
    knots, scores = make(TINY)(replace(batch, discs=batch.discs[:, :0]))
    assert knots.shape == (12, 4, TINY.n_knots, 3)
    assert scores.isfinite().all()


def test_training_in_parts_of_similar_size_changes_nothing(dataset: PackedDataset) -> None:
    batch, model = problems(dataset), make(TINY)
    assert not batch.present.all()
    batch = replace(batch, discs=batch.discs.flip(1))  # padding first
    parts, places = batch.by_number_of_discs(5)
    counts = [part.present.sum(1) for part in parts]
    assert [len(part) for part in parts] == [5, 5, 2]
    assert all(part.discs.shape[1] == count.max() for part, count in zip(parts, counts))
    assert torch.equal(torch.cat(counts)[places], batch.present.sum(1))
    for ours, theirs in zip(model.net._in_parts(batch), model(batch)):
        torch.testing.assert_close(ours, theirs)


@pytest.mark.parametrize("spacing", KNOT_SPACINGS)
def test_interpolation_is_exact_for_piecewise_linear_paths_and_pins_the_ends(spacing: str) -> None:
    matrix = interpolation_matrix(20, 85, spacing)
    assert matrix[[0, -1]].abs().max() == 0.0
    places = knot_places(20, spacing)
    torch.testing.assert_close(places, 1.0 - places.flip(0))
    values = matrix @ places[1:-1].float()  # a ramp whose far end is pinned to zero
    before = torch.linspace(0.0, 1.0, 85) <= places[-2]
    torch.testing.assert_close(values[before], torch.linspace(0.0, 1.0, 85)[before])


def test_knots_lie_closest_at_the_ends() -> None:
    gaps = knot_places(40, "ends").diff()
    assert gaps[20] > 2.0 * gaps[0] > 0.0
    torch.testing.assert_close(knot_places(3, "uniform"), torch.linspace(0, 1, 5).double())


def test_assignment_gives_no_hypothesis_twice_and_serves_the_cheapest_first() -> None:
    distances = torch.tensor([[[0.1, 0.5, 0.9], [0.2, 0.4, 0.8]]])
    owner, known = _assign(distances, torch.tensor([[1.0, 1.1]]))
    assert owner.tolist() == [[0, 1]]
    assert known.all()
    owner, known = _assign(distances, torch.tensor([[1.0, float("inf")]]))
    assert known.tolist() == [[True, False]]


def test_loss_is_zero_regression_for_a_perfect_hypothesis(dataset: PackedDataset) -> None:
    training = HypothesisSet(dataset, np.arange(len(dataset)), TINY.table)
    batch = training.batch(torch.arange(len(training)), None)
    model = make(TINY)
    flat = replace(batch, paths=torch.zeros_like(batch.paths))
    with torch.no_grad():
        model.net.knot_decoder.linear.weight.zero_()
        model.net.knot_decoder.linear.bias.zero_()
    with torch.no_grad():
        loss, figures = model.net.loss(flat, HypothesisLoss(score_weight=0.0))
    assert float(loss) == pytest.approx(0.0, abs=1e-3)
    assert float(figures["distance"]) == pytest.approx(0.0, abs=1e-4)


@pytest.mark.parametrize("config", [TINY, TINY_SEQUENCE])
def test_save_and_load(tmp_path: Path, dataset: PackedDataset, config: ARTConfig) -> None:
    model = make(config)
    if config.head == "autoregressive":
        model.net.fit_scales(sequences(dataset, config))
    model.save_pretrained(tmp_path)
    loaded = ART.from_pretrained(tmp_path)
    assert loaded.config == config
    assert loaded.num_parameters == model.num_parameters
    assert not loaded.training
    data = problems(dataset) if config.head != "autoregressive" else sequences(dataset, config)
    for a, b in zip(model(data), loaded(data)):
        assert torch.equal(a, b)


def test_paper_size() -> None:
    model = ART(ARTConfig.paper())
    assert model.config.tokens_per_step == 4
    assert 10e6 < model.num_parameters < 12e6
    assert model.net.window == 400


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"head": "diffusion"}, "head must be one of 'multi_hypothesis', 'autoregressive'"),
        ({"width": 100, "n_heads": 6}, "multiple of n_heads, got 100 and 6"),
        ({"n_layers": 0}, "n_layers must be at least 1, got 0"),
        ({"dropout": 1.0}, r"dropout must be in \[0, 1\), got 1.0"),
        ({"tokens_per_step": 3}, "tokens_per_step must be one of 2, 4, got 3"),
        ({"descriptors": ["gaol"]}, r"descriptors must be of 'goal', .*, got \['gaol'\]"),
        ({"table": (3.5, -1.0)}, "table must be two positive sides"),
    ],
)
def test_bad_configurations(changes: dict, match: str) -> None:
    with pytest.raises(ValueError, match=match):
        replace(TINY, **changes)


def test_unknown_and_broken_models(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"No model is called 'art-none'.*Shipped: "):
        ART.from_pretrained("art-none")
    with pytest.raises(FileNotFoundError, match=r"config\.json is missing"):
        ART.from_pretrained(tmp_path)
    make(TINY).save_pretrained(tmp_path)
    (tmp_path / WEIGHTS_NAME).unlink()
    with pytest.raises(FileNotFoundError, match=r"model\.safetensors is missing"):
        ART.from_pretrained(tmp_path)
    make(replace(TINY, n_layers=1)).save_pretrained(tmp_path / "other")
    (tmp_path / "other" / CONFIG_NAME).write_text((tmp_path / CONFIG_NAME).read_text())
    with pytest.raises(ValueError, match=r"do not fit its config\.json"):
        ART.from_pretrained(tmp_path / "other")
    data = {**TINY.to_dict(), "n_experts": 4}
    (tmp_path / "other" / CONFIG_NAME).write_text(json.dumps(data))
    with pytest.raises(ValueError, match=r"Unknown fields.*n_experts"):
        ART.from_pretrained(tmp_path / "other")
