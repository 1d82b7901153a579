"""Models see what the environment's camera and lidar show."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import gymnasium as gym
import numpy as np
import pytest
import torch

from art_policy.generation import generate
from art_policy.layers import MODALITIES, ARTConfig
from art_policy.model import ART
from art_policy.perception import IMAGE_SIZE, N_RAYS, as_pictures, pictures, scans
from art_policy.rollout import propose
from art_policy.sequence import ProblemBatch
from art_policy.training_data import HypothesisSet, SequenceSet
from freeflyer_datasets.loading import PackedDataset
from freeflyer_env import Problem, Scenario, sample_problem

TABLE = Scenario().table
TINY = ARTConfig(width=32, n_layers=1, n_heads=2, n_hypotheses=3)
SUBSETS = [set_ for n in (1, 2, 3) for set_ in combinations(MODALITIES, n)]


@pytest.fixture(scope="module")
def problems() -> list[Problem]:
    rng = np.random.default_rng(8)
    return [sample_problem(rng, n_obstacles=count) for count in (4, 2, 0)]


@pytest.mark.parametrize("index", range(3))
def test_pictures_and_scans_are_the_environments(problems: list[Problem], index: int) -> None:
    problem = problems[index]
    env = gym.make(
        "freeflyer_env:FreeFlyer-v0",
        scenario=problem.scenario,
        observation=("image", "lidar"),
        image_size=IMAGE_SIZE,
        lidar_rays=N_RAYS,
    )
    observation, _ = env.reset(options={"problem": problem})
    batch = ProblemBatch.from_problems([problem])
    mine = pictures(batch, TABLE)
    theirs = as_pictures(observation["image"][None])
    assert (mine - theirs).abs().max() <= 1.5 / 255.0  # the radii are float32 here
    poses = batch.start[:, None, :3]
    scan = scans(poses, batch.discs_at(torch.zeros(1, 1)), TABLE)[0, 0].numpy()
    np.testing.assert_allclose(scan, observation["lidar"], atol=2e-5)


@pytest.mark.parametrize("modalities", SUBSETS, ids="+".join)
def test_every_modality_matters_and_no_other(
    dataset: PackedDataset, modalities: tuple[str, ...]
) -> None:
    torch.manual_seed(0)
    every = np.arange(len(dataset))
    for head in ("multi_hypothesis", "autoregressive"):
        config = replace(TINY, head=head, modalities=modalities, context_length=20)
        model = ART(config).eval()
        assert ARTConfig.from_dict(config.to_dict()) == config
        with torch.no_grad():
            for parameter in model.parameters():
                parameter.add_(0.05 * torch.randn_like(parameter))
        if head == "autoregressive":
            batch = SequenceSet(dataset, every, TABLE, 20).batch(torch.arange(4), None)
        else:
            batch = HypothesisSet(dataset, every, TABLE).batch(torch.arange(4), None)
        loss = model.net.loss(batch)[0]
        loss.backward()
        assert all(p.grad is not None and p.grad.isfinite().all() for p in model.parameters())
        names = {name.split(".")[1] for name, _ in model.named_parameters()}
        encoders = {"vector": "disc_encoder", "image": "picture_encoder", "lidar": "scan_encoder"}
        assert {key for key, name in encoders.items() if name in names} == set(modalities)


def test_a_model_of_images_and_scans_proposes(problems: list[Problem]) -> None:
    torch.manual_seed(0)
    config = replace(TINY, modalities=("image", "lidar"))
    proposals = propose(ART(config).eval(), problems[0], 2)
    assert len(proposals) == 2
    net = ART(replace(config, head="autoregressive", context_length=8)).eval().net
    cached, whole = (
        generate(net, problems[:1], np.array([-0.2]), use_cache=flag) for flag in (True, False)
    )
    np.testing.assert_allclose(cached[0], whole[0], atol=1e-5)


def test_other_camera_images_are_refused() -> None:
    with pytest.raises(ValueError, match="make the environment with image_size"):
        as_pictures(np.zeros((1, 80, 112, 3), np.uint8))


def test_modalities_are_checked() -> None:
    with pytest.raises(ValueError, match="modalities must be of 'vector', 'image', 'lidar'"):
        ARTConfig(modalities=("radar",))
    with pytest.raises(ValueError, match="needs one of"):
        ARTConfig(modalities=())
