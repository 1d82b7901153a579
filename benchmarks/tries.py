"""What matters for the multi-hypothesis model: variants of it, each trained for as many steps.

``python -m benchmarks.tries DATASET --out FOLDER`` trains every variant (resumable: what is there
is kept), then compares them all in one evaluation on held-out and on random scenes, and writes
``tries.json`` and a Markdown table. Two variants are other kinds of model: flow matching, the usual
generative baseline, and paths that are conditioned on the homotopy class. ``DATASET`` is a Minari
id or a folder of shards.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import shlex
import sys
import time
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import torch
from torch import Tensor, nn

from art_policy.cli_models import open_dataset
from art_policy.evaluation import evaluation_problems
from art_policy.evaluation.protocol import ProblemRecord, evaluate_problem
from art_policy.evaluation.statistics import finite, summarise
from art_policy.layers import ARTConfig, Block, Decoder, Encoder, initialise
from art_policy.model import ART
from art_policy.multi_hypothesis import (
    HypothesisBatch,
    HypothesisLoss,
    MultiHypothesis,
    disc_features,
    interpolation_matrix,
    problem_features,
)
from art_policy.sequence import ProblemBatch
from art_policy.train import train
from art_policy.train_config import TrainConfig
from art_policy.train_io import LOG_NAME
from benchmarks.planning import markdown
from freeflyer_datasets import PackedDataset
from freeflyer_env.planning.homotopy import homotopy_starts
from freeflyer_env.scenario import Obstacles, Problem, Scenario

#: The base variant: its model, and its problems at most. It is half the size of the shipped models.
BASE, _BASE = ARTConfig(width=128, n_heads=4), 20_000

#: Name, problems, changes of the model, changes of the loss, changes of the training.
VARIANTS: list[tuple[str, int, dict[str, Any], dict[str, Any], dict[str, Any]]] = [
    ("base: 6 hypotheses, 40 knots, width 128", _BASE, {}, {}, {}),
    ("2,500 problems", 2_500, {}, {}, {}),
    ("5,000 problems", 5_000, {}, {}, {}),
    ("10,000 problems", 10_000, {}, {}, {}),
    ("1 hypothesis", _BASE, {"n_hypotheses": 1}, {}, {}),
    ("3 hypotheses", _BASE, {"n_hypotheses": 3}, {}, {}),
    ("12 hypotheses", _BASE, {"n_hypotheses": 12}, {}, {}),
    ("20 knots", _BASE, {"n_knots": 20}, {}, {}),
    ("20 knots, equally spaced", _BASE, {"n_knots": 20, "knot_spacing": "uniform"}, {}, {}),
    ("width 64", _BASE, {"width": 64}, {}, {}),
    ("width 256", _BASE, {"width": 256}, {}, {"learning_rate": 7e-4}),
    ("2 layers", _BASE, {"n_layers": 2}, {}, {}),
    ("the cheapest optimum alone as label", _BASE, {}, {}, {"max_optima": 1}),
    ("all optima count the same", _BASE, {}, {"others_weight": 1.0}, {}),
    ("no pull on idle hypotheses", _BASE, {}, {"idle_weight": 0.0}, {}),
    ("sharper scores", _BASE, {}, {"cost_temperature": 0.005}, {}),
    ("no symmetries", _BASE, {}, {}, {"augment": False}),
    ("a fourth of the examples begins in flight", _BASE, {}, {}, {"tails": 0.25}),
    ("discs added where they change no optimum", _BASE, {}, {}, {"max_discs": 8}),
]


class FlowMatching(nn.Module):
    """Paths by conditional flow matching: a velocity field from noise to deviations at knots.

    The trunk is that of the multi-hypothesis head; each query embeds a noisy path and its time.
    Samples are drawn from fixed noise and carry no scores.
    """

    _STEPS = 8

    def __init__(self, config: ARTConfig) -> None:
        super().__init__()
        self.config = config
        self.problem_encoder = Encoder(20, config.width)
        self.disc_encoder = Encoder(14, config.width)
        self.path_encoder = Encoder(3 * config.n_knots + 1, config.width)
        self.blocks = nn.ModuleList(Block(config) for _ in range(config.n_layers))
        self.velocity_decoder = Decoder(config.width, 3 * config.n_knots)
        initialise(self, config.n_layers)
        self.register_buffer("scale", torch.tensor([0.25, 0.25, 0.5]))
        noise = torch.randn(
            config.n_hypotheses, config.n_knots, 3, generator=torch.Generator().manual_seed(0)
        )
        self.register_buffer("noise", noise)

    @property
    def device(self) -> torch.device:
        """Where the weights are."""
        return self.noise.device

    def velocity(self, problems: ProblemBatch, paths: Tensor, time: Tensor) -> Tensor:
        """Velocity of noisy normalised paths ``(B, Q, n_knots, 3)`` at times ``(B, Q)``."""
        size = paths.shape[1]
        tokens = torch.cat(
            [
                self.path_encoder(torch.cat([paths.flatten(2), time[..., None]], dim=2)),
                self.problem_encoder(problem_features(problems, self.config.table))[:, None],
                self.disc_encoder(disc_features(problems, self.config.table)),
            ],
            dim=1,
        )
        # Samples of one problem must not see one another.
        length = tokens.shape[1]
        mask = torch.ones(length, length, dtype=torch.bool, device=tokens.device)
        mask[:size, :size] = torch.eye(size, dtype=torch.bool)
        mask[size:, :size] = False
        for block in self.blocks:
            tokens = block(tokens, mask=mask)
        return self.velocity_decoder(tokens[:, :size]).view(paths.shape)

    def loss(self, batch: HypothesisBatch, generator: torch.Generator) -> Tensor:
        """Squared error of the velocity along the straight way from noise to the best optimum."""
        matrix = interpolation_matrix(self.config.n_knots, batch.paths.shape[2])
        inverse = torch.linalg.pinv(matrix).to(self.device)  # (n_knots, S)
        target = torch.einsum("ks,bsc->bkc", inverse, batch.paths[:, 0])
        target = (target / self.scale)[:, None].expand(-1, 4, -1, -1)
        noise = torch.randn(target.shape, generator=generator).to(self.device)
        time = torch.rand(target.shape[:2], generator=generator).to(self.device)
        paths = noise + time[..., None, None] * (target - noise)
        return (self.velocity(batch.problems, paths, time) - (target - noise)).square().mean()

    def forward(self, problems: ProblemBatch) -> tuple[Tensor, Tensor]:
        """Deviations at the knots ``(B, H, n_knots, 3)``, and no opinion on them ``(B, H)``."""
        paths = self.noise.expand(len(problems), -1, -1, -1)
        for step in range(self._STEPS):
            time = torch.full(paths.shape[:2], step / self._STEPS)
            paths = paths + self.velocity(problems, paths, time) / self._STEPS
        return paths * self.scale, torch.zeros(paths.shape[:2])


class Conditioned(nn.Module):
    """One path for each homotopy class: disc tokens say on which side the disc is to be passed.

    It learns from every optimum; the classes to propose are those of :func:`.homotopy_starts`,
    shortest path first.
    """

    def __init__(self, config: ARTConfig) -> None:
        super().__init__()
        self.config = config
        self.query_embedding = nn.Parameter(torch.randn(1, config.width))
        self.problem_encoder = Encoder(20, config.width)
        self.disc_encoder = Encoder(15, config.width)
        self.blocks = nn.ModuleList(Block(config) for _ in range(config.n_layers))
        self.knot_decoder = Decoder(config.width, 3 * config.n_knots)
        initialise(self, config.n_layers)
        self.register_buffer("scale", torch.tensor([0.25, 0.25, 0.5]))

    @property
    def device(self) -> torch.device:
        """Where the weights are."""
        return self.query_embedding.device

    def knots(self, problems: ProblemBatch, sides: Tensor) -> Tensor:
        """Deviations ``(B, n_knots, 3)`` of paths with the discs on ``sides`` ``(B, M)``, +-1."""
        discs = torch.cat([disc_features(problems, self.config.table), sides[..., None]], dim=2)
        tokens = torch.cat(
            [
                self.query_embedding.expand(len(problems), -1, -1),
                self.problem_encoder(problem_features(problems, self.config.table))[:, None],
                self.disc_encoder(discs),
            ],
            dim=1,
        )
        for block in self.blocks:
            tokens = block(tokens)
        return self.knot_decoder(tokens[:, 0]).view(-1, self.config.n_knots, 3) * self.scale

    def loss(self, batch: HypothesisBatch, generator: torch.Generator) -> Tensor:
        """Distance to an optimum drawn for each problem, whose class is told."""
        rows = torch.arange(len(batch))
        known = batch.costs.isfinite().float()
        drawn = torch.multinomial(known.cpu(), 1, generator=generator)[:, 0].to(self.device)
        target = batch.paths[rows, drawn]  # (B, S, 3)
        share = torch.linspace(0.0, 1.0, target.shape[1], device=self.device)[:, None]
        way = (batch.problems.goal - batch.problems.start)[:, None, :2]
        positions = batch.problems.start[:, None, :2] + share * way + target[..., :2]
        knots = self.knots(batch.problems, sides_of(positions, batch.problems.discs))
        matrix = interpolation_matrix(self.config.n_knots, target.shape[1]).to(self.device)
        errors = torch.einsum("sk,bkc->bsc", matrix, knots) - target
        weight = errors.new_tensor([1.0, 1.0, HypothesisLoss.heading_weight])
        squares = (errors.square() * weight).sum(2).mean(1)
        scale = HypothesisLoss.length_scale
        return ((scale**2 + squares).sqrt() - scale).mean() / scale

    def forward(self, problems: ProblemBatch) -> tuple[Tensor, Tensor]:
        """Deviations at the knots ``(B, H, n_knots, 3)``, and ranks of the classes ``(B, H)``."""
        size = self.config.n_hypotheses
        found = [self._classes(problems[row]) for row in torch.arange(len(problems)).split(1)]
        knots = torch.stack([torch.stack((part * size)[:size]) for part in found])
        ranks = -torch.arange(size, dtype=torch.float32).expand(len(problems), -1)
        return knots, ranks

    def _classes(self, problem: ProblemBatch) -> list[Tensor]:
        """Paths ``(n_knots, 3)`` of the classes of one problem, the shortest first."""
        rows = problem.discs[0][problem.present[0]].double().numpy()
        ends = problem.start[0].double().numpy(), problem.goal[0].double().numpy()
        scene = Scenario(Obstacles.from_rows(rows))
        whole = Problem(scene, *ends, float(problem.final_time))
        starts = homotopy_starts(whole, self.config.n_hypotheses)
        paths = torch.tensor(np.array([start.states[:-1, :2] for start in starts])).float()
        sides = sides_of(paths, problem.discs.expand(len(starts), -1, -1))
        index = torch.zeros(len(starts), dtype=torch.long)
        return list(self.knots(problem[index], sides))


def sides_of(paths: Tensor, discs: Tensor) -> Tensor:
    """``(B, M)``: 1 where paths ``(B, S, 2)`` pass a disc on their left, -1 on their right."""
    offset = discs[:, None, :, :2] - paths[:, :, None]  # (B, S, M, 2)
    direction = torch.gradient(paths, dim=1)[0][:, :, None].expand_as(offset)
    nearest = offset.square().sum(3).argmin(1)[:, None, :, None].expand(-1, -1, -1, 2)
    o, d = offset.gather(1, nearest)[:, 0], direction.gather(1, nearest)[:, 0]
    return (d[..., 0] * o[..., 1] - d[..., 1] * o[..., 0]).sign()


#: Models of another kind: class and file, by name.
OTHERS: dict[str, tuple[type[FlowMatching | Conditioned], str]] = {
    "flow matching, 8 steps": (FlowMatching, "flow.pt"),
    "conditioned on the homotopy class": (Conditioned, "conditioned.pt"),
}


def train_other(name: str, data: PackedDataset, config: TrainConfig, folder: Path) -> None:
    """Trains a model of another kind on as many problems as the base variant."""
    from art_policy.training_data import HypothesisSet

    kind, file = OTHERS[name]
    path = folder / file
    if path.is_file():
        return
    torch.manual_seed(0)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    model = kind(BASE).to(device)
    training = HypothesisSet(data, first_problems(data, _BASE), model.config.table).to(device)
    assert config.max_steps
    optimizer = torch.optim.AdamW(model.parameters(), lr=config.learning_rate, weight_decay=0.05)
    average = [p.detach().clone() for p in model.parameters()]
    generator = torch.Generator().manual_seed(0)
    for step in range(config.max_steps):
        for group in optimizer.param_groups:
            group["lr"] = config.rate(step / config.max_steps)
        index = torch.randint(len(training), (config.batch_size,), generator=generator)
        with torch.autocast(device, torch.bfloat16, enabled=device == "cuda"):
            loss = model.loss(training.batch(index, generator), generator)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        optimizer.zero_grad()
        torch._foreach_lerp_(average, [p.detach() for p in model.parameters()], 0.005)
    with torch.no_grad():
        for parameter, value in zip(model.parameters(), average):
            parameter.copy_(value)
    folder.mkdir(parents=True, exist_ok=True)
    torch.save(model.cpu().state_dict(), path)


def load_others(folder: Path) -> dict[str, nn.Module]:
    """The models of other kinds that are there."""
    models: dict[str, nn.Module] = {}
    for name, (kind, file) in OTHERS.items():
        if (folder / file).is_file():
            models[name] = kind(BASE)
            models[name].load_state_dict(torch.load(folder / file, weights_only=True))
            models[name].eval()
    return models


def first_problems(data: PackedDataset, count: int) -> np.ndarray:
    """Training trajectories of the first problems."""
    training = data.split()[0]
    return training[np.asarray(data.problem_index)[training] < count]


class _First(PackedDataset):
    """The first problems of a dataset, with the same validation problems as the whole."""

    limit: int = 0

    def split(self, validation_fraction: float = 0.05) -> tuple[np.ndarray, np.ndarray]:
        training, validation = super().split(validation_fraction)
        return training[np.asarray(self.problem_index)[training] < self.limit], validation


def first(data: PackedDataset, count: int) -> PackedDataset:
    """A view of the first problems for :func:`train`."""
    values = {field.name: getattr(data, field.name) for field in dataclasses.fields(data)}
    part = _First(**values)
    object.__setattr__(part, "limit", count)
    return part


def variant_folder(folder: Path, index: int) -> Path:
    """Where a variant lies."""
    return folder / f"variant-{index:02d}"


def train_variant(data: PackedDataset, index: int, config: TrainConfig, folder: Path) -> None:
    """Trains one variant, unless its card, which is written last, is there."""
    if (variant_folder(folder, index) / "README.md").is_file():
        return
    _, count, model, loss, changes = VARIANTS[index]
    config = dataclasses.replace(config, **changes)
    MultiHypothesis.loss.__defaults__ = (HypothesisLoss(**loss),)
    model_config = dataclasses.replace(BASE, **model)
    train(first(data, count), model_config, config, variant_folder(folder, index))


def evaluate_some(
    folder: Path, variants: list[int], problems: list[tuple[str, int, Problem]], n_starts: int
) -> list[ProblemRecord]:
    """All methods on some problems, in a worker."""
    torch.set_num_threads(1)
    models: dict[str, Any] = {
        VARIANTS[i][0]: ART.from_pretrained(variant_folder(folder, i)) for i in variants
    }
    models |= load_others(folder)
    return [evaluate_problem(models, *problem, 4, n_starts) for problem in problems]


def last_validation(folder: Path) -> dict[str, float]:
    """The figures of the last validation in a log."""
    lines = [json.loads(line) for line in (folder / LOG_NAME).read_text().splitlines()]
    return next((line for line in reversed(lines) if "val_loss" in line), {})


def main() -> None:
    """Trains, evaluates, prints."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--problems", type=int, default=300, help="of each kind")
    parser.add_argument("--variants", type=int, nargs="+", default=list(range(len(VARIANTS))))
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--starts", type=int, default=13, help="starts for the best known solution")
    parser.add_argument("--workers", type=int, default=-1, help="processes of the evaluation")
    parser.add_argument("--only-train", action="store_true", help="leave the evaluation for later")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    data = open_dataset(options.dataset)
    config = TrainConfig(
        max_steps=options.steps,
        threads=options.threads,
        tails=0.0,
        ema_decay=0.995,
        solve_problems=0,
        validate_every=options.steps,
    )
    for index in options.variants:
        train_variant(data, index, config, options.out)
        print(f"trained: {VARIANTS[index][0]}", flush=True)
    for name in OTHERS if 0 in options.variants else ():
        train_other(name, data, config, options.out)
        print(f"trained: {name}", flush=True)
    if options.only_train:
        return
    rows: dict[str, dict[str, Any]] = {
        VARIANTS[i][0]: last_validation(variant_folder(options.out, i)) for i in options.variants
    }
    names = [*rows, *load_others(options.out)]
    for scenes in ("held-out", "random"):
        problems = list(evaluation_problems(options.problems, scenes, seed=3))
        parts = [problems[i : i + 5] for i in range(0, len(problems), 5)]
        run = joblib.delayed(evaluate_some)
        jobs = (run(options.out, options.variants, part, options.starts) for part in parts)
        with joblib.parallel_config(backend="loky", inner_max_num_threads=1):
            found = joblib.Parallel(n_jobs=options.workers)(jobs)
        groups = summarise([record for part in found for record in part])
        for name in names:
            four = max((g for g in groups if g.startswith(f"{name}, best of")), default=name)
            row = rows.setdefault(name, {})
            row[f"{scenes}, first"], row[f"{scenes}, best of 4"] = groups[name], groups[four]
        for name in ("REL", "best known"):
            rows.setdefault(name, {})[f"{scenes}, first"] = groups[name]
    content: dict[str, Any] = {"command": f"python -m benchmarks.tries {shlex.join(sys.argv[1:])}"}
    content |= {"steps": options.steps, "problems": options.problems, "starts": options.starts}
    content |= {"made": time.strftime("%Y-%m-%d"), "rows": table_rows(rows), "variants": rows}
    path = options.out / "tries.json"
    path.write_text(json.dumps(finite(content), indent=1) + "\n", encoding="utf-8")
    print(markdown(table_rows(rows)))


def table_rows(rows: dict[str, dict[str, Any]]) -> list[dict[str, object]]:
    """The comparison, a row for each variant."""
    table: list[dict[str, object]] = []
    for name, row in rows.items():
        distance = row.get("val_chosen_distance")
        line: dict[str, object] = {"variant": name}
        line["first to optimum, mm"] = "-" if distance is None else f"{1e3 * distance:.0f}"
        for scenes in ("held-out", "random"):
            one = row[f"{scenes}, first"]
            four = row.get(f"{scenes}, best of 4", one)
            line[f"{scenes}: infeasible"] = f"{one['infeasible_rate']:.1%}"
            gains = (x["suboptimality_improvement"] for x in (one, four))
            line[f"{scenes}: improvement, 1 and 4"] = ", ".join(f"{x:+.1%}" for x in gains)
            iterations = one["mean_iterations"] or math.nan
            line[f"{scenes}: iterations"] = "-" if math.isnan(iterations) else f"{iterations:.2f}"
        table.append(line)
    return table


if __name__ == "__main__":
    main()
