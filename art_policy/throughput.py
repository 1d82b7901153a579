"""How much work a training step is, and how much of it this machine could do."""

from __future__ import annotations

import time
from typing import Any

import torch
from torch.utils.flop_counter import FlopCounterMode

#: Sizes of the matrix products that a machine is measured by; one that takes longer is not doubled.
_SMALLEST, _SIZE, _SECONDS = 256, 2048, 0.02


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
    """Operations a second that a large matrix product reaches here, with the threads set.

    A processor without instructions for ``dtype`` gets a smaller one, or it would take minutes.
    """
    size = _SMALLEST
    while (elapsed := _product_seconds(size, device, dtype)) < _SECONDS and size < _SIZE:
        size *= 2
    fastest = min([elapsed, *(_product_seconds(size, device, dtype) for _ in range(3))])
    return 2.0 * size**3 / fastest


def _product_seconds(size: int, device: torch.device, dtype: torch.dtype) -> float:
    a = torch.randn(size, size, device=device).to(dtype)
    for _ in range(2):  # the second one is warm
        began = time.perf_counter()
        a @ a
        if device.type == "cuda":
            torch.cuda.synchronize()
    return time.perf_counter() - began
