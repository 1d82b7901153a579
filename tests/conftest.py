"""Shared fixtures."""

from __future__ import annotations

import os

import pytest

os.environ.setdefault("SDL_VIDEODRIVER", "dummy")


@pytest.fixture(scope="session")
def untrained_model(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Folder of a small multi-hypothesis model with random weights, for what needs any model."""
    import torch

    from art_policy import ART, ARTConfig

    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("untrained")
    ART(ARTConfig(width=32, n_layers=1, n_heads=2, n_hypotheses=3)).save_pretrained(folder)
    return str(folder)
