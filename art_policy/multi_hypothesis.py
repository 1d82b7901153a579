"""The multi-hypothesis head: several whole trajectories and their scores in one forward pass.

A problem becomes a short sequence: one token for start, goal and final time, one for each
obstacle, and one learned query for each hypothesis. A bidirectional transformer mixes them; each
query is then decoded into a score and a path, given as the deviation from uniform motion along the
straight line::

    q(s) = (1 - s) q_start + s q_goal + sum_k phi_k(s) d_k,      s = t / t_last,  q = (x, y, psi)

with hat functions ``phi_k`` at knots that lie closest where the robot accelerates and brakes. The
ends are exact, and any number of nodes can be read off. There is no order among obstacles, and no
limit to their number.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from art_policy.layers import ARTConfig, Block, Decoder, Encoder, initialise
from art_policy.perception import PictureEncoder, ScanEncoder, pictures, scans
from art_policy.sequence import ProblemBatch, random_discs, random_flags

_N_PROBLEM_FEATURES = 20
_N_DISC_FEATURES = 14
_RATE_SCALE = (10.0, 10.0, 5.0)  # s/m, s/m, s/rad
_SHORTEST = 5.0  # s: shorter final times are described as this one
_POSE_SCALE = (0.25, 0.25, 0.5)  # m, m, rad: size of a typical deviation
_ROBOT_RADIUS = 0.15  # m: half the width of the gap that lets the robot pass
_PART = 128  # problems of similar size that are trained on together
_DECOY_MARGIN = 0.02  # m: paths are compared at few times, and may dip between them


@lru_cache(maxsize=64)
def interpolation_matrix(n_knots: int, n_nodes: int, spacing: str = "ends") -> Tensor:
    """``(n_nodes, n_knots)`` values of the hat functions at equally spaced nodes."""
    return hats(n_knots, torch.linspace(0.0, 1.0, n_nodes, dtype=torch.float64), spacing).float()


def hats(n_knots: int, places: Tensor, spacing: str) -> Tensor:
    """Values of the hat functions ``(S, n_knots)`` at ``places`` ``(S,)`` between 0 and 1."""
    knots = knot_places(n_knots, spacing)
    left, here, right = knots[:-2], knots[1:-1], knots[2:]
    rise, fall = (
        (places[:, None] - left) / (here - left),
        (right - places[:, None]) / (right - here),
    )
    return torch.minimum(rise, fall).clamp(min=0.0)


def knot_places(n_knots: int, spacing: str) -> Tensor:
    """``(n_knots + 2,)`` places of the knots from 0 to 1, both ends included.

    Those closer at the ends lie half-way between uniform knots and Chebyshev's.
    """
    uniform = torch.linspace(0.0, 1.0, n_knots + 2, dtype=torch.float64)
    if spacing == "uniform":
        return uniform
    return 0.5 * uniform + 0.25 * (1.0 - (math.pi * uniform).cos())


@dataclass(frozen=True, eq=False)
class HypothesisBatch:
    """Training examples: problems and their known optima, cheapest first.

    Attributes:
        problems: ``B`` problems.
        paths: ``(B, R, S, 3)`` deviations ``(r_x, r_y, psi)`` of the optima from the straight
            line, at ``S`` equally spaced times; m and rad.
        costs: ``(B, R)`` costs in m/s, infinite where a problem has fewer than ``R`` optima.
    """

    problems: ProblemBatch
    paths: Tensor
    costs: Tensor

    def __len__(self) -> int:
        return len(self.problems)

    def to(self, device: torch.device | str) -> HypothesisBatch:
        """The same on another device."""
        return HypothesisBatch(
            self.problems.to(device), self.paths.to(device), self.costs.to(device)
        )

    def augmented(
        self, table: tuple[float, float], dt: float, generator: torch.Generator
    ) -> HypothesisBatch:
        """Each example under a random one of the four symmetries of mirror and time reversal."""
        batch = len(self.problems)
        device = self.costs.device
        mirror, reverse = (random_flags(batch, generator).to(device) for _ in range(2))
        problems = self.problems.mirrored(mirror, table[1]).reversed(reverse, table[0], dt)
        flip = self.paths.new_tensor([1.0, -1.0, -1.0])
        paths = torch.where(mirror[:, None, None, None], self.paths * flip, self.paths)
        flip = self.paths.new_tensor([-1.0, 1.0, -1.0])
        paths = torch.where(reverse[:, None, None, None], paths.flip(2) * flip, paths)
        return HypothesisBatch(problems, paths, self.costs)

    def with_decoys(
        self, table: tuple[float, float], dt: float, most: int, generator: torch.Generator
    ) -> HypothesisBatch:
        """Each example with more discs, at rest or moving, in a random share of its free rows.

        Scenes with ``most`` discs or more are left alone, others get no more than that.

        No disc comes near the cheapest optimum, which therefore stays what it is: more constraints
        make nothing cheaper. Other optima that the discs do touch are dropped.
        """
        discs, added = self.problems.discs, random_discs(self.problems, table, generator)
        device = discs.device
        share = torch.linspace(0.0, 1.0, self.paths.shape[2], device=device)[::2]
        way = self.problems.goal - self.problems.start
        line = self.problems.start[:, None, :2] + share[:, None] * way[:, None, :2]
        positions = line[:, None] + self.paths[:, :, ::2, :2]  # (B, R, S / 2, 2)
        times = share * (self.problems.final_time[:, None] - dt)  # (B, S / 2)
        centres = added[:, None, :, :2] + times[..., None, None] * added[:, None, :, 3:]
        gaps = (positions[:, :, :, None] - centres[:, None]).norm(dim=4).amin(2)  # (B, R, M)
        near = gaps < added[:, None, :, 2] + _DECOY_MARGIN
        draw = torch.rand(discs.shape[:2], generator=generator)
        wanted = (draw < torch.rand(len(discs), 1, generator=generator)).to(device)
        present = self.problems.present
        placed = wanted & ~near[:, 0] & ~present  # (B, M)
        placed &= placed.cumsum(1) + present.sum(1, keepdim=True) <= most
        lost = (near & placed[:, None]).any(2)  # never the cheapest
        problems = replace(self.problems, discs=torch.where(placed[..., None], added, discs))
        return HypothesisBatch(problems, self.paths, self.costs.masked_fill(lost, math.inf))


@dataclass(frozen=True)
class HypothesisLoss:
    """Weights of the training loss.

    Attributes:
        heading_weight: Weight of a squared heading error in rad against one of position in m.
        others_weight: Weight of the optima other than the cheapest.
        idle_weight: Weight of the pull on hypotheses that no optimum claimed, towards the cheapest.
        score_weight: Weight of the scores' cross-entropy.
        cost_temperature: Relative excess cost at which an optimum's share of the score target has
            fallen by a factor of e.
        length_scale: Distance in m below which the error counts squared rather than linearly.
    """

    heading_weight: float = 0.1
    others_weight: float = 0.3
    idle_weight: float = 0.02
    score_weight: float = 0.2
    cost_temperature: float = 0.02
    length_scale: float = 0.3


class MultiHypothesis(nn.Module):
    """Problem in, ``n_hypotheses`` trajectories and scores out."""

    def __init__(self, config: ARTConfig) -> None:
        super().__init__()
        self.config = config
        self.problem_encoder = Encoder(_N_PROBLEM_FEATURES, config.width)
        if "vector" in config.modalities:
            self.disc_encoder = Encoder(_N_DISC_FEATURES, config.width)
        if "image" in config.modalities:
            self.picture_encoder = PictureEncoder(config.width)
        if "lidar" in config.modalities:
            self.scan_encoder = ScanEncoder(config.width)
        self.query_embedding = nn.Parameter(torch.randn(config.n_hypotheses, config.width))
        self.dropout = nn.Dropout(config.dropout)
        self.blocks = nn.ModuleList(Block(config) for _ in range(config.n_layers))
        self.knot_decoder = Decoder(config.width, 3 * config.n_knots)
        self.score_decoder = Decoder(config.width, 1)
        initialise(self, config.n_layers)

    def forward(self, problems: ProblemBatch) -> tuple[Tensor, Tensor]:
        """Proposals for each problem.

        Returns:
            Deviations at the knots ``(B, H, n_knots, 3)`` in m, m, rad, and score logits
            ``(B, H)``.
        """
        # Not len(problems), which would become a constant in an exported model.
        batch, n_queries = problems.start.shape[0], self.config.n_hypotheses
        table, modalities = self.config.table, self.config.modalities
        tokens = [
            self.query_embedding.expand(batch, -1, -1),
            self.problem_encoder(problem_features(problems, table))[:, None],
        ]
        if "image" in modalities:
            tokens.append(self.picture_encoder(pictures(problems, table)))
        if "lidar" in modalities:
            poses, discs = problems.start[:, None, :3], problems.discs[:, None, :, :3]
            tokens.append(self.scan_encoder(poses, scans(poses, discs, table)))
        mask = None
        if "vector" in modalities:
            mask = _padding_mask(problems, sum(part.shape[1] for part in tokens))
            tokens.append(self.disc_encoder(disc_features(problems, table)))
        x = self.dropout(torch.cat(tokens, dim=1))  # (B, H + 1 + scene tokens, width)
        for block in self.blocks[:-1]:
            x = block(x, mask=mask)
        x = self.blocks[-1](x, mask=mask, n_queries=n_queries)  # (B, H, width)
        knots = self.knot_decoder(x).view(batch, n_queries, self.config.n_knots, 3)
        return knots * knots.new_tensor(_POSE_SCALE), self.score_decoder(x).squeeze(-1)

    def _in_parts(self, problems: ProblemBatch) -> tuple[Tensor, Tensor]:
        """As :meth:`forward`; on a CPU without the work that padding makes."""
        if problems.start.device.type != "cpu" or bool(problems.present.all()):
            return self(problems)
        parts, places = problems.by_number_of_discs(_PART)
        knots, scores = zip(*(self(part) for part in parts))
        return torch.cat(knots)[places], torch.cat(scores)[places]

    def loss(
        self, batch: HypothesisBatch, weights: HypothesisLoss = HypothesisLoss()
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Winner-takes-all regression and cross-entropy of the scores.

        Returns:
            The loss, and figures to log: ``distance`` to the cheapest optimum of the nearest and
            ``chosen_distance`` of the best-scored hypothesis in m, ``agreement`` of the two, and
            the ``regret``, the relative excess cost of the optimum nearest to the best-scored one.
        """
        knots, scores = self._in_parts(batch.problems)
        n_knots, spacing = self.config.n_knots, self.config.knot_spacing
        matrix = interpolation_matrix(n_knots, batch.paths.shape[2], spacing).to(knots.device)
        with torch.autocast(knots.device.type, enabled=False):
            paths = torch.einsum("sk,bhkc->bhsc", matrix, knots)  # (B, H, S, 3)
            distances = _distances(paths, batch.paths, weights.heading_weight)  # (B, R, H)
        owner, known = _assign(distances.detach(), batch.costs)  # (B, R)
        delta = weights.length_scale
        errors = (delta**2 + distances.square()).sqrt() - delta

        share = torch.full_like(batch.costs, weights.others_weight)
        share[:, 0] = 1.0
        matched = errors.gather(2, owner[..., None]).squeeze(2)  # (B, R)
        regression = (matched * share * known).sum(1).mean()
        claimed = F.one_hot(owner, scores.shape[1]).bool() & known[..., None]  # (B, R, H)
        idle = (errors[:, 0] * ~claimed.any(1)).mean()

        excess = (batch.costs / batch.costs[:, :1] - 1.0).nan_to_num(posinf=math.inf)
        merit = torch.softmax(-excess / weights.cost_temperature, dim=1)  # (B, R)
        target = torch.zeros_like(scores).scatter_add(1, owner, merit * known)
        choice = -(target * F.log_softmax(scores, dim=1)).sum(1).mean()

        loss = (regression + weights.idle_weight * idle) / delta + weights.score_weight * choice
        chosen = scores.argmax(1)
        reached = distances.gather(2, chosen[:, None, None].expand(-1, distances.shape[1], 1))
        nearest = reached.squeeze(2).masked_fill(~known, math.inf).argmin(1)
        figures = {
            "distance": distances[:, 0].amin(1).mean(),
            "chosen_distance": reached[:, 0].mean(),
            "score_loss": choice,
            "agreement": (chosen == owner[:, 0]).float().mean(),
            "regret": excess.gather(1, nearest[:, None]).mean(),
        }
        return loss, {name: value.detach() for name, value in figures.items()}


def _distances(paths: Tensor, optima: Tensor, heading_weight: float) -> Tensor:
    """Root mean squared distance ``(B, R, H)`` between proposals and optima, heading weighted."""
    weight = (paths.new_tensor([1.0, 1.0, heading_weight]) / paths.shape[2]).sqrt()
    a, b = (optima * weight).flatten(2), (paths * weight).flatten(2)  # (B, R | H, 3 S)
    squares = a.square().sum(2)[:, :, None] + b.square().sum(2)[:, None]
    return (squares - 2.0 * a @ b.transpose(1, 2)).clamp(min=1e-10).sqrt()


def _assign(distances: Tensor, costs: Tensor) -> tuple[Tensor, Tensor]:
    """Each optimum's own hypothesis, cheapest optimum first, none given away twice.

    Returns:
        Index of the hypothesis ``(B, R)``, and whether that optimum exists and got one ``(B, R)``.
    """
    n_hypotheses = distances.shape[2]
    taken = torch.zeros_like(distances[:, 0], dtype=torch.bool)
    owners = []
    for rank in range(distances.shape[1]):
        free = distances[:, rank].masked_fill(taken, math.inf)
        owner = free.argmin(1)
        exists = costs[:, rank].isfinite()
        taken = taken | (F.one_hot(owner, n_hypotheses).bool() & exists[:, None])
        owners.append(owner)
    order = torch.arange(distances.shape[1], device=costs.device)
    return torch.stack(owners, dim=1), costs.isfinite() & (order < n_hypotheses)


@torch.compiler.disable
def _padding_mask(problems: ProblemBatch, n_others: int) -> Tensor | None:
    """``(B, 1, 1, L)`` True at real tokens, or None where nothing is padded."""
    present = problems.present
    # Attention is faster without a mask; an exported model cannot choose.
    if not torch.compiler.is_exporting() and bool(present.all()):
        return None
    return F.pad(present, (n_others, 0), value=True)[:, None, None, :]


def problem_features(problems: ProblemBatch, table: tuple[float, float]) -> Tensor:
    """``(B, 20)`` scaled description of start, goal and final time."""
    size = problems.start.new_tensor(table)
    start, goal = problems.start[:, :3], problems.goal[:, :3]
    way = goal[:, :2] - start[:, :2]
    span = way.norm(dim=1, keepdim=True).clamp(min=1e-6)
    final_time = problems.final_time[:, None].clamp(min=_SHORTEST)
    rate_scale = problems.start.new_tensor(_RATE_SCALE)
    headings = 4.0 * torch.stack([start[:, 2], goal[:, 2]], dim=1)  # quarter turns drop out
    return torch.cat(
        [
            2.0 * start[:, :2] / size - 1.0,
            2.0 * goal[:, :2] / size - 1.0,
            headings.cos(),
            headings.sin(),
            (goal[:, 2:] - start[:, 2:]) / math.pi,
            (final_time / 40.0).log(),
            40.0 / final_time,
            span / size[0],
            way / span,
            problems.start[:, 3:] * rate_scale,
            problems.goal[:, 3:] * rate_scale,
        ],
        dim=1,
    )


def disc_features(problems: ProblemBatch, table: tuple[float, float]) -> Tensor:
    """``(B, M, 14)`` scaled description of each disc, on the table and relative to the way.

    A moving disc is described where uniform motion along the way would pass it.
    """
    size = problems.start.new_tensor(table)
    radius, velocity = problems.discs[..., 2:3], problems.discs[..., 3:]
    start, goal = problems.start[:, None, :2], problems.goal[:, None, :2]
    span = (goal - start).norm(dim=2, keepdim=True).clamp(min=1e-6)
    along = (goal - start) / span
    time = problems.final_time[:, None, None]
    closing = (span - time * (velocity * along).sum(2, keepdim=True)).clamp(min=1e-3)
    ahead = ((problems.discs[..., :2] - start) * along).sum(2, keepdim=True)
    centre = problems.discs[..., :2] + velocity * time * (ahead / closing).clamp(0.0, 1.0)
    offset = centre - start
    progress = (offset * along).sum(2, keepdim=True)
    side = along[..., :1] * offset[..., 1:] - along[..., 1:] * offset[..., :1]  # left positive
    low, high = _ROBOT_RADIUS, size[1] - _ROBOT_RADIUS
    return torch.cat(
        [
            2.0 * centre / size - 1.0,
            10.0 * (radius - 0.33),
            2.0 * progress / span - 1.0,
            2.0 * side,
            4.0 * (side - radius),
            4.0 * (side + radius),
            offset.norm(dim=2, keepdim=True) - radius,
            (centre - goal).norm(dim=2, keepdim=True) - radius,
            2.0 * (centre[..., 1:] - radius - low),
            2.0 * (high - centre[..., 1:] - radius),
            (radius - side.abs()).clamp(min=0.0) * 4.0,
            40.0 * (velocity * along).sum(2, keepdim=True),
            40.0 * (along[..., :1] * velocity[..., 1:] - along[..., 1:] * velocity[..., :1]),
        ],
        dim=2,
    )
