"""Training of both heads: one loop, seeded, and resumable from its last checkpoint.

Everything random in step ``i`` is a function of ``(seed, i)`` alone: the order of the examples,
their augmentation, dropout. A run that was cut off and resumed therefore gives the same weights as
one that was not, as long as its schedule counts steps (``max_steps``); with ``max_minutes`` the
learning rate follows the clock.
"""

from __future__ import annotations

import dataclasses
import logging
import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from tqdm.auto import tqdm

from art_policy.autoregressive import Autoregressive
from art_policy.layers import ARTConfig
from art_policy.model import ART
from art_policy.train_io import Interrupt, JsonLines
from art_policy.training_data import HypothesisSet, SequenceSet

if TYPE_CHECKING:
    from freeflyer_datasets.loading import PackedDataset

ExampleSet = HypothesisSet | SequenceSet

logger = logging.getLogger(__name__)

CHECKPOINT_NAME, LOG_NAME = "checkpoint.pt", "log.jsonl"
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
        tails: Multi-hypothesis only: share of the problems of which one is added that begins in
            flight, for re-planning.
        max_discs: Multi-hypothesis only: if given, augmentation adds up to so many discs to a scene
            where they leave the best optimum what it is.
        init: Model whose weights training begins with, as :meth:`ART.from_pretrained` takes it;
            None for random ones.
        validation_fraction: Share of the problems that are held out.
        log_every: Steps between lines of the log.
        validate_every: Steps between validations.
        checkpoint_minutes: Minutes between checkpoints.
        precision: ``"bfloat16"`` for autocast, ``"float32"``, or ``"auto"``: bfloat16 where the
            processor has instructions for it.
        threads: Threads of PyTorch, or None to leave that alone.
        seed: Of everything random.
        device: Where to train.
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
    tails: float = 0.25
    max_discs: int | None = None
    init: str | None = None
    validation_fraction: float = 0.05
    log_every: int = 50
    validate_every: int = 500
    checkpoint_minutes: float = 3.0
    precision: str = "auto"
    threads: int | None = None
    seed: int = 0
    device: str = "cpu"
    compile: bool = False

    def __post_init__(self) -> None:
        if self.max_steps is None and self.max_minutes is None:
            raise ValueError("TrainConfig needs max_steps or max_minutes (or both).")
        for name in ("max_steps", "max_minutes", "batch_size", "learning_rate", "gradient_clip",
                     "log_every", "validate_every", "checkpoint_minutes"):  # fmt: skip
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"TrainConfig.{name} must be positive, got {value}.")
        for name in ("warmup_share", "ema_decay"):
            if not 0.0 <= getattr(self, name) < 1.0:
                raise ValueError(
                    f"TrainConfig.{name} must be in [0, 1), got {getattr(self, name)}."
                )
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


@dataclass
class _State:
    """A run: what a checkpoint holds, and one step of it."""

    model: ART
    compute_loss: Callable[..., tuple[Tensor, dict[str, Tensor]]]
    average: list[Tensor]
    optimizer: torch.optim.Optimizer
    settings: dict[str, Any]
    step: int = 0
    seconds: float = 0.0

    @classmethod
    def create(cls, model_config: ARTConfig, config: TrainConfig, data: dict[str, Any]) -> _State:
        torch.manual_seed(config.seed)
        model = ART(model_config).to(config.device)
        if config.init is not None:
            _initialise(model, config.init)
        matrices = [p for p in model.parameters() if p.dim() >= 2]
        vectors = [p for p in model.parameters() if p.dim() < 2]
        groups = [
            {"params": matrices, "weight_decay": config.weight_decay},
            {"params": vectors, "weight_decay": 0.0},
        ]
        rate = config.learning_rate
        optimizer = torch.optim.AdamW(groups, lr=rate, betas=(0.9, 0.98), fused=True)
        average = [p.detach().clone() for p in model.parameters()]
        settings = {
            "model": model_config.to_dict(),
            "train": dataclasses.asdict(config),
            "data": data,
        }
        compute_loss = torch.compile(model.net.loss) if config.compile else model.net.loss
        return cls(model, compute_loss, average, optimizer, settings)

    def save(self, path: Path) -> None:
        """Writes the checkpoint; a crash leaves the old one or the new one, never half of one."""
        content = {
            "model": self.model.state_dict(),
            "average": self.average,
            "optimizer": self.optimizer.state_dict(),
            "step": self.step,
            "seconds": self.seconds,
            "settings": self.settings,
        }
        temporary = path.with_suffix(".tmp")
        torch.save(content, temporary)
        os.replace(temporary, path)

    def load(self, path: Path) -> None:
        content = torch.load(path, map_location=self.model.device, weights_only=True)
        for kind in ("model", "train", "data"):
            ours, theirs = self.settings[kind], content["settings"].get(kind, {})
            changed = sorted(k for k in ours.keys() | theirs.keys() if ours.get(k) != theirs.get(k))
            if changed := [name for name in changed if name not in _MAY_CHANGE]:
                raise ValueError(
                    f"{path} is of a run with another {', '.join(changed)}; "
                    "train into another folder, or pass resume=False to start anew."
                )
        self.model.load_state_dict(content["model"])
        self.optimizer.load_state_dict(content["optimizer"])
        for mine, stored in zip(self.average, content["average"]):
            mine.copy_(stored)
        self.step, self.seconds = content["step"], content["seconds"]

    def advance(self, batch: Any, config: TrainConfig) -> dict[str, float | Tensor]:
        """One optimiser step; returns figures to log."""
        began = time.perf_counter()
        rate = config.rate(config.progress(self.step, self.seconds))
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        torch.manual_seed(_seed(config.seed, self.step))  # of dropout
        self.model.train()
        with _autocast(config):
            loss, figures = self.compute_loss(batch)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(
            self.model.parameters(), config.gradient_clip, error_if_nonfinite=True
        )
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        self.step += 1
        self.update_average(config.ema_decay)
        speed = len(batch) / (time.perf_counter() - began)
        return {"lr": rate, "loss": loss, "norm": norm, "samples_per_s": speed, **figures}

    def update_average(self, decay: float) -> None:
        weight = 1.0 - min(decay, (1.0 + self.step) / (10.0 + self.step))
        torch._foreach_lerp_(self.average, [p.detach() for p in self.model.parameters()], weight)

    def averaged_model(self) -> ART:
        """A copy of the model with the averaged weights, for validation and release."""
        model = ART(self.model.config).to(self.model.device)
        model.load_state_dict(self.model.state_dict())
        with torch.no_grad():
            for parameter, value in zip(model.parameters(), self.average):
                parameter.copy_(value)
        return model.eval()


#: Settings in which a resumed run may differ from the one that wrote the checkpoint.
_MAY_CHANGE = frozenset(
    {"threads", "log_every", "validate_every", "checkpoint_minutes", "compile", "device",
     "max_minutes", "max_steps"}
)  # fmt: skip


def train(
    data: PackedDataset | Sequence[PackedDataset],
    model_config: ARTConfig,
    config: TrainConfig,
    out: str | Path,
    resume: bool = True,
) -> ART:
    """Trains a model and writes it, its log and its checkpoint into ``out``.

    Args:
        data: Packed dataset, or several; a share of the problems of each is held out for
            validation.
        model_config: Size and kind of the model.
        config: How to train.
        out: Folder for ``model.safetensors``, ``config.json``, ``log.jsonl``, ``checkpoint.pt``.
        resume: Whether to go on from a checkpoint in ``out``.

    Returns:
        The model with averaged weights, in evaluation mode. After Ctrl-C too: everything is saved.

    Raises:
        ValueError: If a checkpoint in ``out`` is of a different run, or there is nothing to train
            on.
    """
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    if config.threads:
        torch.set_num_threads(config.threads)
    datasets = list(data) if isinstance(data, Sequence) else [data]
    training, validation = _examples(datasets, model_config, config)
    if not len(training):
        raise ValueError("The dataset has no solved trajectory to train on.")
    model_config = dataclasses.replace(model_config, envelope=training.envelope)
    source = {"dataset": " + ".join(each.dataset_id for each in datasets)}
    state = _State.create(model_config, config, {**source, "examples": len(training)})
    if isinstance(state.model.net, Autoregressive) and isinstance(training, SequenceSet):
        sample = training.batch(torch.arange(min(len(training), 2048)), torch.Generator())
        state.model.net.fit_scales(sample)
    checkpoint = out / CHECKPOINT_NAME
    if resume and checkpoint.exists():
        state.load(checkpoint)
        logger.info("Resuming at step %d of %s.", state.step, checkpoint)
    log = JsonLines(out / LOG_NAME, state.step)
    logger.info("%d problems, %d parameters.", len(training), state.model.num_parameters)
    _loop(state, training, validation, config, log, checkpoint)
    state.save(checkpoint)
    model = state.averaged_model()
    if len(validation):
        log.write(step=state.step, **_validate(model, validation, config))
    model.save_pretrained(out)
    return model


def _loop(
    state: _State,
    training: ExampleSet,
    validation: ExampleSet,
    config: TrainConfig,
    log: JsonLines,
    checkpoint: Path,
) -> None:
    """Optimiser steps until the schedule ends, or until Ctrl-C."""
    batches = _batches(training, state.step, config)
    start = saved = time.perf_counter()
    before = state.seconds
    layout = "{percentage:3.0f}% |{bar}| {elapsed}<{remaining}"
    bar = tqdm(total=100, desc="training", leave=False, bar_format=layout)
    with Interrupt() as interrupt, bar:
        while (progress := config.progress(state.step, state.seconds)) < 1.0 and not interrupt.seen:
            figures = state.advance(next(batches), config)
            now = time.perf_counter()
            state.seconds = before + now - start
            bar.update(100.0 * progress - bar.n)
            if state.step % config.log_every == 0:
                log.write(step=state.step, minutes=state.seconds / 60.0, **figures)
            if state.step % config.validate_every == 0 and len(validation):
                log.write(step=state.step, **_validate(state.averaged_model(), validation, config))
            if now - saved > 60.0 * config.checkpoint_minutes:
                state.save(checkpoint)
                state.averaged_model().save_pretrained(checkpoint.parent)
                saved = now
    if interrupt.seen:
        logger.warning("Interrupted at step %d; saving.", state.step)


def _examples(
    datasets: Sequence[PackedDataset], model: ARTConfig, config: TrainConfig
) -> tuple[ExampleSet, ExampleSet]:
    """What to train on, and what to validate on."""
    splits = [dataset.split(config.validation_fraction) for dataset in datasets]
    pairs = list(zip(datasets, splits))
    if model.head == "autoregressive":
        settings = (model.table, model.context_length, model.constraint_to_go == "constant")
        training, validation = (
            SequenceSet.joined([SequenceSet(d, s[side], *settings) for d, s in pairs])
            for side in range(2)
        )
        return training, validation
    tails, most = config.tails, config.max_discs
    return (
        HypothesisSet.joined([HypothesisSet(d, s[0], model.table, tails, most) for d, s in pairs]),
        HypothesisSet.joined([HypothesisSet(d, s[1], model.table) for d, s in pairs]),
    )


def _initialise(model: ART, name: str) -> None:
    """Begins with the weights of another model; another number of hypotheses begins anew."""
    other = ART.from_pretrained(name)
    ours, theirs = model.config.to_dict(), other.config.to_dict()
    changed = [key for key in ours if ours[key] != theirs[key]]
    if changed := sorted(set(changed) - {"n_hypotheses", "dropout", "envelope"}):
        raise ValueError(
            f"TrainConfig.init: {name!r} is of another {', '.join(changed)} than the model that is "
            "to be trained."
        )
    weights = other.state_dict()
    if ours["n_hypotheses"] != theirs["n_hypotheses"]:
        del weights["net.query_embedding"]
    model.load_state_dict(weights, strict=False)


def _batch_size(training: ExampleSet, config: TrainConfig) -> int:
    return min(config.batch_size, len(training))


def _batches(training: ExampleSet, step: int, config: TrainConfig) -> Iterator[Any]:
    """Endless batches from ``step`` on; every epoch in its own order, its last part dropped."""
    size = _batch_size(training, config)
    per_epoch = len(training) // size
    generator, epoch, order = torch.Generator(), -1, torch.empty(0)
    while True:
        if step // per_epoch != epoch:
            epoch = step // per_epoch
            generator.manual_seed(_seed(config.seed, -1 - epoch))
            order = torch.randperm(len(training), generator=generator)
        first = step % per_epoch * size
        generator.manual_seed(_seed(config.seed, step))
        index = order[first : first + size]
        batch = training.batch(index, generator if config.augment else None)
        yield batch.to(config.device) if config.device != "cpu" else batch
        step += 1


def _seed(seed: int, step: int) -> int:
    """Seeds of the steps (not negative) and of the epochs' orders (negative) never coincide."""
    return seed * 2**32 + step % 2**32


@torch.no_grad()
def _validate(model: ART, validation: ExampleSet, config: TrainConfig) -> dict[str, float]:
    """Mean figures over held-out problems (4,096 of them at most), names prefixed by ``val_``."""
    count = min(len(validation), 4096)
    sums: dict[str, float] = {}
    for index in torch.linspace(0, len(validation) - 1, count).long().split(512):
        batch: Any = validation.batch(index, None).to(config.device)
        with _autocast(config):
            loss, figures = model.net.loss(batch)
        for name, value in {"loss": loss, **figures}.items():
            sums[name] = sums.get(name, 0.0) + float(value) * len(index)
    return {f"val_{name}": value / count for name, value in sums.items()}


def _autocast(config: TrainConfig) -> torch.autocast:
    kind = torch.device(config.device).type
    enabled = config.precision == "bfloat16"
    if config.precision == "auto":
        enabled = kind == "cuda" or torch.cpu._is_avx512_bf16_supported()
    return torch.autocast(kind, dtype=torch.bfloat16, enabled=enabled)
