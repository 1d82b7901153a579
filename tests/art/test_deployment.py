"""Exported models give what the model gives."""

import numpy as np
import pytest
import torch

from art_policy import ART, ARTConfig
from art_policy.deployment import OnnxART, export_onnx
from art_policy.generation import generate
from art_policy.model import load_model
from art_policy.planner import WarmStartPlanner
from art_policy.rollout import propose_batch
from art_policy.sequence import ProblemBatch
from freeflyer_env import sample_problem

pytest.importorskip("onnxruntime")
pytest.importorskip("onnxscript")


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """The shipped model, exported."""
    return export_onnx(
        ART.from_pretrained("art-scene-random"), tmp_path_factory.mktemp("x") / "m.onnx"
    )


def problems(count, n_obstacles):
    return [
        sample_problem(np.random.default_rng(seed), n_obstacles=n_obstacles, final_time=final_time)
        for seed, final_time in zip(range(count), (40.0, 60.0, 100.0))
    ]


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("n_obstacles", [0, 1, 4, 7])
def test_it_gives_the_same_for_any_batch_and_any_scene(exported, count, n_obstacles):
    model, other = ART.from_pretrained("art-scene-random"), load_model(exported)
    batch = ProblemBatch.from_problems(problems(count, n_obstacles))
    with torch.inference_mode():
        for ours, theirs in zip(model(batch), other(batch)):
            torch.testing.assert_close(ours, theirs, atol=5e-5, rtol=0)
    assert other.config == model.config


def test_padding_is_ignored(exported):
    mixed = problems(1, 2) + problems(1, 6)
    alone = propose_batch(load_model(exported), mixed[:1], 2)[0]
    together = propose_batch(load_model(exported), mixed, 2)[0]
    for one, other in zip(alone, together):
        np.testing.assert_allclose(one.trajectory.states, other.trajectory.states, atol=1e-4)


def test_the_planner_takes_it(exported):
    plan = WarmStartPlanner(load_model(exported)).plan(problems(1, 4)[0])
    assert plan.result.solved
    assert plan.source == "art"


def test_eight_bits_are_near_enough(exported, tmp_path):
    model = ART.from_pretrained("art-scene-random")
    small = export_onnx(model, tmp_path / "small.onnx", int8=True)
    assert small.stat().st_size < 0.4 * exported.stat().st_size
    assert [path.name for path in tmp_path.iterdir()] == ["small.onnx"]
    some = problems(3, 4)
    for ours, theirs in zip(propose_batch(model, some), propose_batch(OnnxART(small), some)):
        gap = ours[0].trajectory.states[:, :2] - theirs[0].trajectory.states[:, :2]
        assert np.sqrt((gap**2).sum(axis=1).mean()) < 0.02


@pytest.mark.parametrize(
    "config",
    [
        ARTConfig.small(width=32, n_heads=2, n_layers=2, n_modes=3),
        # Longer sequences than the context.
        ARTConfig.small(width=32, n_heads=2, n_layers=2, context_length=20),
        ARTConfig.paper(width=32, n_heads=2, n_layers=2),
    ],
    ids=["modes", "short context", "four tokens"],
)
def test_autoregressive_models_generate_the_same(config, tmp_path):
    torch.manual_seed(1)
    model = ART(config).eval()
    other = load_model(export_onnx(model, tmp_path / "m.onnx"))
    some = problems(2, 3)  # of 80 and 120 steps
    returns, draws = np.array([-0.2, -0.3]), [0, 1]
    ours, theirs = (generate(m, some, returns, draws=draws) for m in (model, other))
    for one, two in zip(ours, theirs):
        assert np.abs(one).max() > 1e-4
        np.testing.assert_allclose(one, two, atol=1e-6)


def test_what_cannot_be_exported_or_loaded(tmp_path):
    import onnx

    with pytest.raises(ValueError, match="Only models that know the discs"):
        export_onnx(ART(ARTConfig(width=32, n_heads=1, modalities=("image",))), tmp_path / "m.onnx")
    with pytest.raises(FileNotFoundError, match="There is no file"):
        load_model(tmp_path / "none.onnx")
    ends = [onnx.helper.make_tensor_value_info(name, 1, [1]) for name in "xy"]
    node = onnx.helper.make_node("Relu", ["x"], ["y"])
    graph = onnx.helper.make_graph([node], "other", ends[:1], ends[1:])
    onnx.save(onnx.helper.make_model(graph, ir_version=9), tmp_path / "other.onnx")
    with pytest.raises(ValueError, match="not written by freeflyer export"):
        load_model(tmp_path / "other.onnx")
    (tmp_path / "no.onnx").write_bytes(b"no")
    with pytest.raises(ValueError, match="not an ONNX model that runs"):
        load_model(tmp_path / "no.onnx")
