"""The settings of a training run, and its learning rate."""

from __future__ import annotations

import math
from dataclasses import dataclass

PRECISIONS = ("auto", "float32", "bfloat16")


@dataclass(frozen=True)
class TrainConfig:
    """How to train.

    Attributes:
        max_steps: Number of optimiser steps, or None if only the clock counts.
        max_minutes: Minutes of training, over all resumed runs, or None. Whichever comes first
            ends the run, and the learning rate reaches its end there.
        batch_size: Examples in a step (at most as many as there are).
        learning_rate: Peak rate of AdamW; linear warm-up, then cosine decay to a hundredth.
        weight_decay: Of matrices; vectors are not decayed.
        warmup_share: Share of the run that warms up.
        gradient_clip: Largest norm of the gradient.
        ema_decay: Decay of the running average of the weights, which is what is saved.
        augment: Whether examples are put under random symmetries of the problem.
        max_optima: Most optima of one problem that are learned from, cheapest first.
        tails: Multi-hypothesis only: share of the problems of which one is added that begins in
            flight, for re-planning.
        openings: Autoregressive only: share of the batches that hold only the first 16 steps of
            their trajectories. There the way is chosen, nearly all of the error is made, and a
            batch costs a fifth.
        max_discs: Multi-hypothesis only: if given, augmentation adds discs to a scene, until it has
            at most so many, where they leave the best optimum what it is.
        init: Model whose weights training begins with, as :meth:`ART.from_pretrained` takes it;
            None for random ones.
        validation_fraction: Share of the problems that are held out.
        log_every: Steps between lines of the log.
        validate_every: Steps between validations.
        solve_problems: Held-out problems that the model's first candidate is refined for at each
            validation; the model that does best at it is what training returns. 0: none.
        checkpoint_minutes: Minutes between checkpoints.
        precision: ``"bfloat16"`` for autocast, ``"float32"``, or ``"auto"``: bfloat16 where the
            processor has instructions for it.
        threads: Threads of PyTorch, or None to leave that alone.
        seed: Of everything random.
        device: ``"auto"``, where Accelerate finds something quicker than the CPU, or ``"cpu"``.
        compile: Whether to use ``torch.compile``.
    """

    max_steps: int | None = None
    max_minutes: float | None = None
    batch_size: int = 512
    learning_rate: float = 1e-3
    weight_decay: float = 0.05
    warmup_share: float = 0.03
    gradient_clip: float = 1.0
    ema_decay: float = 0.999
    augment: bool = True
    max_optima: int = 4
    tails: float = 0.25
    openings: float = 0.0
    max_discs: int | None = None
    init: str | None = None
    validation_fraction: float = 0.05
    log_every: int = 50
    validate_every: int = 500
    solve_problems: int = 300
    checkpoint_minutes: float = 3.0
    precision: str = "auto"
    threads: int | None = None
    seed: int = 0
    device: str = "auto"
    compile: bool = False

    def __post_init__(self) -> None:
        if self.max_steps is None and self.max_minutes is None:
            raise ValueError("TrainConfig needs max_steps or max_minutes (or both).")
        for name in ("max_steps", "max_minutes", "batch_size", "learning_rate", "gradient_clip",
                     "max_optima",
                     "max_discs", "log_every", "validate_every", "checkpoint_minutes"):  # fmt: skip
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"TrainConfig.{name} must be positive, got {value}.")
        for name in ("warmup_share", "ema_decay"):
            if not 0.0 <= getattr(self, name) < 1.0:
                raise ValueError(
                    f"TrainConfig.{name} must be in [0, 1), got {getattr(self, name)}."
                )
        if self.solve_problems < 0:
            raise ValueError(
                f"TrainConfig.solve_problems must not be negative, got {self.solve_problems}."
            )
        if self.device not in ("auto", "cpu"):
            raise ValueError(f"TrainConfig.device must be 'auto' or 'cpu', got {self.device!r}.")
        if self.precision not in PRECISIONS:
            raise ValueError(
                f"TrainConfig.precision must be one of {PRECISIONS}, got {self.precision!r}."
            )

    def progress(self, step: int, seconds: float) -> float:
        """Share of the run that is done, 0 to 1, by steps or by the clock."""
        by_steps = step / self.max_steps if self.max_steps else 0.0
        by_clock = seconds / (60.0 * self.max_minutes) if self.max_minutes else 0.0
        return min(max(by_steps, by_clock), 1.0)

    def rate(self, progress: float) -> float:
        """Learning rate at a share of the run."""
        if progress < self.warmup_share:
            return self.learning_rate * max(progress / self.warmup_share, 0.01)
        share = (progress - self.warmup_share) / (1.0 - self.warmup_share)
        return self.learning_rate * (0.01 + 0.99 * 0.5 * (1.0 + math.cos(math.pi * share)))
