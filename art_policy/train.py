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
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn
from tqdm.auto import tqdm

from art_policy.autoregressive import Autoregressive
from art_policy.examination import Examiner
from art_policy.layers import ARTConfig
from art_policy.model import ART
from art_policy.model_card import write_card
from art_policy.throughput import flops_per_example, peak_flops
from art_policy.train_config import TrainConfig
from art_policy.train_io import Interrupt, Log
from art_policy.training_data import HypothesisSet, SequenceSet
from art_policy.transfer import begin_with

if TYPE_CHECKING:
    from accelerate import Accelerator

    from freeflyer_datasets.loading import PackedDataset

ExampleSet = HypothesisSet | SequenceSet

logger = logging.getLogger(__name__)

CHECKPOINT_NAME, BEST_NAME = "checkpoint.pt", "best"


class _Objective(nn.Module):
    """A model's loss as a module, which can be spread over processes."""

    def __init__(self, model: ART) -> None:
        super().__init__()
        self.model = model

    def forward(self, batch: Any) -> tuple[Tensor, dict[str, Tensor]]:
        return self.model.net.loss(batch)


@dataclass
class _State:
    """A run: what a checkpoint holds, and one step of it."""

    model: ART
    objective: Callable[..., tuple[Tensor, dict[str, Tensor]]]
    average: list[Tensor]
    optimizer: torch.optim.Optimizer
    accelerator: Accelerator
    settings: dict[str, Any]
    step: int = 0
    seconds: float = 0.0
    best: float = math.inf

    @classmethod
    def create(
        cls,
        model_config: ARTConfig,
        config: TrainConfig,
        data: dict[str, Any],
        accelerator: Accelerator,
    ) -> _State:
        torch.manual_seed(config.seed)
        model = ART(model_config).to(accelerator.device)
        if config.init is not None:
            begin_with(model, config.init)
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
        objective: Any = _Objective(model)
        if config.compile:
            objective = torch.compile(objective)
        objective, optimizer = accelerator.prepare(objective, optimizer)
        return cls(model, objective, average, optimizer, accelerator, settings)

    def save(self, path: Path) -> None:
        """Writes the checkpoint; a crash leaves the old one or the new one, never half of one."""
        content = {
            "model": self.model.state_dict(),
            "average": self.average,
            "optimizer": self.optimizer.state_dict(),
            "step": self.step,
            "seconds": self.seconds,
            "best": self.best,
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
        self.best = content.get("best", math.inf)

    def advance(self, batches: Iterator[Any], config: TrainConfig) -> dict[str, float | Tensor]:
        """One optimiser step; returns figures to log."""
        began = time.perf_counter()
        batch = next(batches)
        rate = config.rate(config.progress(self.step, self.seconds))
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        rank = self.accelerator.process_index
        torch.manual_seed(_seed(config.seed, self.step) + (rank << 56))  # of dropout
        self.model.train()
        with _autocast(config, self.accelerator.device):
            loss, figures = self.objective(batch)
        self.accelerator.backward(loss)
        norm = torch.nn.utils.clip_grad_norm_(
            self.model.parameters(), config.gradient_clip, error_if_nonfinite=True
        )
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        self.step += 1
        self.update_average(config.ema_decay)
        speed = len(batch) * self.accelerator.num_processes / (time.perf_counter() - began)
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
    """Trains a model and writes it, its log, its checkpoint and its card into ``out``.

    It runs on one processor or GPU, and on several or on several machines where it is started by
    ``accelerate launch``; there ``batch_size`` is the number of examples of all together, and
    ``max_steps`` has to be given.

    Args:
        data: Packed dataset, or several; a share of the problems of each is held out for
            validation.
        model_config: Size and kind of the model.
        config: How to train.
        out: Folder for ``model.safetensors``, ``config.json``, ``README.md``, ``log.jsonl``,
            ``tensorboard``, ``checkpoint.pt``, and ``best``, the model that planned best so far.

    Returns:
        The model with averaged weights that planned best, in evaluation mode; of several processes
        the first one knows it, the others return the last one. After Ctrl-C too: everything is
        saved.

    Raises:
        ValueError: If a checkpoint in ``out`` is of a different run, or there is nothing to train
            on.
    """
    from accelerate import Accelerator

    accelerator = Accelerator(cpu=config.device == "cpu")
    if accelerator.num_processes > 1 and config.max_minutes is not None:
        raise ValueError("Several processes must agree on the length: give max_steps alone.")
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    if config.threads:
        torch.set_num_threads(config.threads)
    datasets = list(data) if isinstance(data, Sequence) else [data]
    training, validation = _examples(datasets, model_config, config)
    if accelerator.device.type == "cuda":
        # A batch is gathered where it is used; and float32 products there are rounded to 11 bits,
        # 2 mm of a position, for eight times the speed.
        training, validation = training.to(accelerator.device), validation.to(accelerator.device)
        torch.set_float32_matmul_precision("high")
    if not len(training):
        raise ValueError("The dataset has no solved trajectory to train on.")
    model_config = dataclasses.replace(model_config, envelope=training.envelope)
    names = " + ".join(each.dataset_id for each in datasets)
    source = {"dataset": names, "examples": len(training)}
    state = _State.create(model_config, config, source, accelerator)
    # Weights that training begins with bring the scales that they were trained with.
    if config.init is None and isinstance(training, SequenceSet):
        assert isinstance(state.model.net, Autoregressive)
        spread = torch.linspace(0, len(training) - 1, min(len(training), 2048)).long()
        sample = training.batch(spread, torch.Generator())
        state.model.net.fit_scales(sample.to(accelerator.device))
    checkpoint = out / CHECKPOINT_NAME
    if resume and checkpoint.exists():
        state.load(checkpoint)
        logger.info("Resuming at step %d of %s.", state.step, checkpoint)
    elif accelerator.is_main_process:
        shutil.rmtree(out / BEST_NAME, ignore_errors=True)
    log = Log(out, state.step) if accelerator.is_main_process else None
    examiner = Examiner(datasets, config)
    if log:
        logger.info("%d examples, %d parameters.", len(training), state.model.num_parameters)
    finished = _loop(state, training, validation, examiner, config, log, out)
    model = state.averaged_model()
    if log:
        if finished:
            _examine(state, model, validation, examiner, config, log, out)
        state.save(checkpoint)
        if (out / BEST_NAME).is_dir():
            model = ART.from_pretrained(out / BEST_NAME, str(accelerator.device))
        model.save_pretrained(out)
        dtype = torch.bfloat16 if _is_half(config, accelerator.device) else torch.float32
        peak = accelerator.num_processes * peak_flops(accelerator.device, dtype)
        flops = flops_per_example(state.model, training)
        write_card(out, state.settings, log.rows(), flops, peak)
        log.close()
    accelerator.wait_for_everyone()
    return model


def _loop(
    state: _State,
    training: ExampleSet,
    validation: ExampleSet,
    examiner: Examiner,
    config: TrainConfig,
    log: Log | None,
    out: Path,
) -> bool:
    """Optimiser steps until the schedule ends, or until Ctrl-C; whether it came to the end."""
    batches = _batches(training, state.step, config, state.accelerator)
    start = saved = time.perf_counter()
    before = state.seconds
    layout = "{percentage:3.0f}% |{bar}| {elapsed}<{remaining}"
    bar = tqdm(total=100, desc="training", leave=False, bar_format=layout, disable=log is None)
    with Interrupt() as interrupt, bar:
        while (progress := config.progress(state.step, state.seconds)) < 1.0:
            if _anyone(interrupt.seen, state.accelerator):
                break
            figures = state.advance(batches, config)
            now = time.perf_counter()
            state.seconds = before + now - start
            bar.update(100.0 * progress - bar.n)
            if log is None:
                continue
            if state.step % config.log_every == 0:
                log.write(step=state.step, minutes=state.seconds / 60.0, **figures)
            if state.step % config.validate_every == 0:
                _examine(state, state.averaged_model(), validation, examiner, config, log, out)
            if now - saved > 60.0 * config.checkpoint_minutes:
                state.save(out / CHECKPOINT_NAME)
                state.averaged_model().save_pretrained(out)
                saved = now
    finished = config.progress(state.step, state.seconds) >= 1.0
    if not finished:
        logger.warning("Interrupted at step %d; saving.", state.step)
    return finished


def _anyone(flag: bool, accelerator: Accelerator) -> bool:
    """Whether the flag is set in any process; all of them ask together."""
    if accelerator.num_processes == 1:
        return flag
    return bool(accelerator.reduce(torch.tensor(float(flag), device=accelerator.device)) > 0.0)


def _examine(
    state: _State,
    model: ART,
    validation: ExampleSet,
    examiner: Examiner,
    config: TrainConfig,
    log: Log,
    out: Path,
) -> None:
    """Validates a model, lets it plan, and keeps it if none planned better."""
    figures = _validate(model, validation, config) if len(validation) else {}
    if config.solve_problems:
        planned = examiner.examine(model)
        figures |= planned
        if planned["val_excess"] <= state.best:
            state.best = planned["val_excess"]
            model.save_pretrained(out / BEST_NAME)
    if figures:
        log.write(step=state.step, **figures)


def _examples(
    datasets: Sequence[PackedDataset], model: ARTConfig, config: TrainConfig
) -> tuple[ExampleSet, ExampleSet]:
    """What to train on, and what to validate on."""
    splits = [dataset.split(config.validation_fraction) for dataset in datasets]
    pairs = list(zip(datasets, splits))
    if model.head == "autoregressive":
        settings: Any = {
            "constant_budget": model.constraint_to_go == "constant",
            "max_optima": config.max_optima,
            "relaxed_returns": model.returns_to_go == "relaxed",
        }
        size = model.table, model.context_length

        def sequences(side: int, openings: float) -> SequenceSet:
            sets = [SequenceSet(d, s[side], *size, **settings, openings=openings) for d, s in pairs]
            return SequenceSet.joined(sets)

        return sequences(0, config.openings), sequences(1, 0.0)
    most = config.max_discs if config.augment else None

    def hypotheses(side: int, tails: float, max_discs: int | None) -> HypothesisSet:
        limits: Any = {"tails": tails, "max_discs": max_discs, "max_optima": config.max_optima}
        return HypothesisSet.joined(
            [HypothesisSet(d, s[side], model.table, **limits) for d, s in pairs]
        )

    return hypotheses(0, config.tails, most), hypotheses(1, 0.0, None)


def _batch_size(training: ExampleSet, config: TrainConfig) -> int:
    return min(config.batch_size, len(training))


def _batches(
    training: ExampleSet, step: int, config: TrainConfig, accelerator: Accelerator
) -> Iterator[Any]:
    """Endless batches from ``step`` on; every epoch in its own order, its last part dropped.

    Each process takes its share of a batch.
    """
    rank, count = accelerator.process_index, accelerator.num_processes
    size = _batch_size(training, config)
    per_epoch = len(training) // size
    generator, epoch, order = torch.Generator(), -1, torch.empty(0)
    while True:
        if step // per_epoch != epoch:
            epoch = step // per_epoch
            generator.manual_seed(_seed(config.seed, -1 - epoch))
            order = torch.randperm(len(training), generator=generator)
        first = step % per_epoch * size
        generator.manual_seed(_seed(config.seed, step) + (rank << 56))
        index = order[first : first + size][rank::count]
        batch = training.batch(index, generator if config.augment else None)
        yield batch.to(accelerator.device)
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
        batch: Any = validation.batch(index, None).to(model.device)
        with _autocast(config, model.device):
            loss, figures = model.net.loss(batch)
        for name, value in {"loss": loss, **figures}.items():
            sums[name] = sums.get(name, 0.0) + float(value) * len(index)
    return {f"val_{name}": value / count for name, value in sums.items()}


def _autocast(config: TrainConfig, device: torch.device) -> torch.autocast:
    return torch.autocast(device.type, dtype=torch.bfloat16, enabled=_is_half(config, device))


def _is_half(config: TrainConfig, device: torch.device) -> bool:
    """Whether matrix products are in bfloat16."""
    if config.precision == "auto":
        return device.type == "cuda" or torch.cpu._is_avx512_bf16_supported()
    return config.precision == "bfloat16"
