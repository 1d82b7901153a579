"""How much work a training step is, and how much of it this machine could do."""

from __future__ import annotations

import time
from typing import Any

import torch
from torch.utils.flop_counter import FlopCounterMode

_SIZE, _SECONDS = 2048, 0.3  # of the matrix product that a machine is measured by


def flops_per_example(model: Any, training: Any, count: int = 16) -> float:
    """Floating-point operations of matrix products, forward and backward, per example.

    Args:
        model: What is trained.
        training: Its examples; the first ones are looked at.
        count: How many.
    """
    index = torch.arange(min(count, len(training)))
    batch = training.batch(index, torch.Generator().manual_seed(0)).to(model.device)
    with FlopCounterMode(display=False) as counter:
        model.net.loss(batch)[0].backward()
    model.zero_grad(set_to_none=True)
    return counter.get_total_flops() / len(index)


def peak_flops(device: torch.device, dtype: torch.dtype) -> float:
    """Operations a second that a large matrix product reaches here, with the threads set."""
    a = torch.randn(_SIZE, _SIZE, device=device).to(dtype)
    a @ a
    began, count = time.perf_counter(), 0
    while time.perf_counter() - began < _SECONDS:
        a @ a
        count += 1
        if device.type == "cuda":
            torch.cuda.synchronize()
    return 2.0 * _SIZE**3 * count / (time.perf_counter() - began)
