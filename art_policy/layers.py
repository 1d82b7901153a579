"""The configuration of ART and the layers that its two heads share."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from art_policy.envelope import Envelope

HEADS = ("multi_hypothesis", "autoregressive")
SCENE_DESCRIPTORS = ("relative", "absolute")
DESCRIPTORS = ("goal", "reward_to_go", "constraint_to_go", "time_to_go")
CONSTRAINT_TO_GO = ("decremented", "constant")
RETURNS_TO_GO = ("hindsight", "relaxed")
MODALITIES = ("vector", "image", "lidar")
KNOT_SPACINGS = ("uniform", "ends")


@dataclass(frozen=True)
class ARTConfig:
    """Size and kind of a model; saved beside its weights.

    Attributes:
        head: ``"multi_hypothesis"``: several whole trajectories in one pass, each with a score.
            ``"autoregressive"``: the paper's model, one control after the other.
        width: Embedding dimension.
        n_layers: Number of transformer blocks.
        n_heads: Number of attention heads; divides ``width``.
        modalities: How the scene is seen, one or several of ``"vector"`` (the discs), ``"image"``
            (from above, at time zero) and ``"lidar"``.
        dropout: Dropout rate of attention, residual branches and embeddings.
        table: Size of the table in m, for which the positions are scaled.
        n_hypotheses: Multi-hypothesis only: number of proposals.
        n_knots: Multi-hypothesis only: number of interior knots of a proposal.
        knot_spacing: Multi-hypothesis only: ``"uniform"``, or closer together at the ``"ends"``,
            where the robot accelerates and brakes; which says an optimum twice as exactly.
        context_length: Autoregressive only: the paper's ``K``, in time steps.
        tokens_per_step: Autoregressive only: 4 as in the paper (state, performance, scene,
            control), or 2 (the three descriptors summed into one token, control).
        scene_descriptors: Autoregressive only: ``"relative"`` or ``"absolute"`` obstacles
            (paper, Sec. IV-C, question 3).
        n_modes: Autoregressive only: number of controls that are predicted at each step, each with
            a probability. 1 is the paper's; more keep two ways round an obstacle from being
            averaged to one through it.
        descriptors: Autoregressive only: the performance descriptors that are read (paper, Sec.
            III-A), any of ``"goal"``, ``"reward_to_go"``, ``"constraint_to_go"``, ``"time_to_go"``.
            Without the last, steps are told apart by the time since the start.
        constraint_to_go: Autoregressive only: ``"decremented"`` at each violation, as in the paper
            (eq. 6), or ``"constant"``, as in its authors' code.
        returns_to_go: Autoregressive only: the reward-to-go with which an optimal trajectory begins
            in training: minus its own cost in ``"hindsight"``, as in the paper; ``"relaxed"``,
            minus REL's cost, which is what generation asks for, whether or not it can be had.
        predict_time_to_go: Autoregressive only: adds the time-to-go to the loss (the paper's FT
            loss).
        envelope: Ranges of what the model was trained on; training fills it in.
    """

    head: str = "multi_hypothesis"
    width: int = 192
    n_layers: int = 4
    n_heads: int = 6
    modalities: tuple[str, ...] = ("vector",)
    dropout: float = 0.0
    table: tuple[float, float] = (3.5, 2.5)
    n_hypotheses: int = 6
    n_knots: int = 40
    knot_spacing: str = "ends"
    context_length: int = 100
    tokens_per_step: int = 4
    scene_descriptors: str = "relative"
    n_modes: int = 1
    descriptors: tuple[str, ...] = DESCRIPTORS
    constraint_to_go: str = "decremented"
    returns_to_go: str = "hindsight"
    predict_time_to_go: bool = False
    envelope: Envelope | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "table", tuple(float(side) for side in self.table))
        self._require_choice("head", HEADS)
        self._require_choice("scene_descriptors", SCENE_DESCRIPTORS)
        self._require_choice("tokens_per_step", (2, 4))
        self._require_choice("constraint_to_go", CONSTRAINT_TO_GO)
        self._require_choice("returns_to_go", RETURNS_TO_GO)
        self._require_choice("knot_spacing", KNOT_SPACINGS)
        for name, known in (("descriptors", DESCRIPTORS), ("modalities", MODALITIES)):
            object.__setattr__(self, name, tuple(getattr(self, name)))
            if unknown := set(getattr(self, name)) - set(known):
                raise ValueError(
                    f"ARTConfig.{name} must be of {', '.join(map(repr, known))}, "
                    f"got {sorted(unknown)}."
                )
        if not self.modalities:
            raise ValueError(f"ARTConfig.modalities needs one of {MODALITIES}.")
        for name in (
            "width", "n_layers", "n_heads", "n_hypotheses", "n_knots", "context_length", "n_modes"
        ):  # fmt: skip
            if not getattr(self, name) >= 1:
                raise ValueError(f"ARTConfig.{name} must be at least 1, got {getattr(self, name)}.")
        if self.width % self.n_heads:
            raise ValueError(
                "ARTConfig.width must be a multiple of n_heads, "
                f"got {self.width} and {self.n_heads}."
            )
        if not 0.0 <= self.dropout < 1.0:
            raise ValueError(f"ARTConfig.dropout must be in [0, 1), got {self.dropout}.")
        if len(self.table) != 2 or not all(side > 0.0 for side in self.table):
            raise ValueError(f"ARTConfig.table must be two positive sides in m, got {self.table}.")

    def _require_choice(self, name: str, choices: tuple[Any, ...]) -> None:
        if getattr(self, name) not in choices:
            known = ", ".join(map(repr, choices))
            raise ValueError(
                f"ARTConfig.{name} must be one of {known}, got {getattr(self, name)!r}."
            )

    @classmethod
    def paper(cls, **changes: Any) -> ARTConfig:
        """The paper's model: autoregressive, six layers, six heads, width 384, dropout 0.1."""
        paper = cls(head="autoregressive", width=384, n_layers=6, n_heads=6, dropout=0.1)
        return dataclasses.replace(paper, **changes)

    @classmethod
    def small(cls, **changes: Any) -> ARTConfig:
        """An autoregressive model that trains on a laptop: four layers, four heads, width 128."""
        small = cls(head="autoregressive", width=128, n_layers=4, n_heads=4, tokens_per_step=2)
        return dataclasses.replace(small, **changes)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON; :meth:`from_dict` is its inverse."""
        lists = {name: list(getattr(self, name)) for name in ("table", "descriptors", "modalities")}
        return {**dataclasses.asdict(self), **lists}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> ARTConfig:
        """The configuration that :meth:`to_dict` described; unknown fields are refused."""
        unknown = set(data) - {field.name for field in dataclasses.fields(cls)}
        if unknown:
            raise ValueError(
                f"Unknown fields in the model's config.json: {sorted(unknown)}; "
                "it was saved by a newer version."
            )
        envelope = data.get("envelope")
        envelope = envelope and Envelope.from_dict(envelope)
        # Models were saved without the spacing when there was but one.
        return cls(**{"knot_spacing": "uniform", **data, "envelope": envelope})


@dataclass
class KeyValueCache:
    """Keys and values of the past, each ``(B, heads, L, width / heads)``, by layer."""

    keys: list[Tensor] = dataclasses.field(default_factory=list)
    values: list[Tensor] = dataclasses.field(default_factory=list)

    @property
    def length(self) -> int:
        """Number of tokens stored."""
        return self.keys[0].shape[2] if self.keys else 0

    def forget(self, keep: int) -> None:
        """Drops all but the last ``keep`` tokens."""
        if self.length > keep:
            first = self.length - keep
            self.keys = [key[:, :, first:] for key in self.keys]
            self.values = [value[:, :, first:] for value in self.values]

    def extend(self, layer: int, key: Tensor, value: Tensor) -> tuple[Tensor, Tensor]:
        """Appends along time and returns everything stored for ``layer``."""
        if layer == len(self.keys):
            self.keys.append(key)
            self.values.append(value)
        else:
            self.keys[layer] = torch.cat([self.keys[layer], key], dim=2)
            self.values[layer] = torch.cat([self.values[layer], value], dim=2)
        return self.keys[layer], self.values[layer]


#: Longest sequence for which PyTorch's fused attention, on a CPU and with its backward pass, takes
#: longer than the operations that it is made of: up to six times as long for bfloat16.
_SHORT_ON_CPU = 160


def attend(
    q: Tensor, k: Tensor, v: Tensor, mask: Tensor | None, causal: bool, dropout: float
) -> Tensor:
    """``scaled_dot_product_attention``, by the quickest way to train short sequences on a CPU."""
    if not (q.requires_grad and q.device.type == "cpu" and q.shape[2] <= _SHORT_ON_CPU):
        return F.scaled_dot_product_attention(q, k, v, mask, dropout, causal)
    weights = (q * q.shape[3] ** -0.5) @ k.transpose(2, 3)
    if causal:
        mask = torch.ones(weights.shape[2:], dtype=torch.bool, device=q.device).tril()
    if mask is not None:
        weights = weights.masked_fill(~mask, -math.inf)
    return F.dropout(weights.softmax(3), dropout) @ v


class Attention(nn.Module):
    """Multi-head self-attention."""

    def __init__(self, config: ARTConfig) -> None:
        super().__init__()
        self.n_heads, self.dropout = config.n_heads, config.dropout
        self.qkv = nn.Linear(config.width, 3 * config.width)
        self.out = nn.Linear(config.width, config.width)

    def forward(
        self,
        x: Tensor,
        mask: Tensor | None = None,
        causal: bool = False,
        cache: KeyValueCache | None = None,
        layer: int = 0,
        n_queries: int | None = None,
    ) -> Tensor:
        """Attends within ``x`` ``(B, L, width)``, and to the cached past if there is one.

        Args:
            x: Tokens.
            mask: Bool, broadcast to ``(B, heads, L, L + past)``, True where attention is allowed.
            causal: Whether a token sees only itself and earlier ones (without a past).
            cache: Past of all layers; extended by these tokens.
            layer: Index of this layer in the cache.
            n_queries: If given, only the first tokens attend, and only their outputs are returned.
        """
        batch, length, width = x.shape
        qkv = self.qkv(x).view(batch, length, 3, self.n_heads, width // self.n_heads)
        q, k, v = qkv.permute(2, 0, 3, 1, 4)  # each (B, heads, L, width / heads)
        if cache is not None:
            k, v = cache.extend(layer, k, v)
        q = q[:, :, :n_queries]
        y = attend(q, k, v, mask, causal, self.dropout if self.training else 0.0)
        y = y.transpose(1, 2).reshape(batch, -1, width)  # heads side by side again
        return self.out(y)


class Block(nn.Module):
    """Pre-LN transformer block: ``x + attention(norm(x))``, then ``x + mlp(norm(x))``."""

    def __init__(self, config: ARTConfig) -> None:
        super().__init__()
        self.norm_1 = nn.LayerNorm(config.width)
        self.attention = Attention(config)
        self.norm_2 = nn.LayerNorm(config.width)
        self.mlp = nn.Sequential(
            nn.Linear(config.width, 4 * config.width),
            nn.GELU(approximate="tanh"),
            nn.Linear(4 * config.width, config.width),
        )
        self.dropout = nn.Dropout(config.dropout)

    def forward(self, x: Tensor, n_queries: int | None = None, **attention: Any) -> Tensor:
        """Maps ``(B, L, width)`` to the same, or only the first ``n_queries`` tokens of it.

        The keywords are those of :class:`Attention`.
        """
        attended = self.attention(self.norm_1(x), n_queries=n_queries, **attention)
        x = x[:, :n_queries] + self.dropout(attended)
        return x + self.dropout(self.mlp(self.norm_2(x)))


class Encoder(nn.Module):
    """Modality encoder: numbers of one kind ``(..., n_in)`` to embeddings ``(..., width)``.

    Runs in float32 under autocast: bfloat16 would round positions to a centimetre.
    """

    def __init__(self, n_in: int, width: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(n_in, width), nn.GELU(), nn.Linear(width, width))

    def forward(self, x: Tensor) -> Tensor:
        with torch.autocast(x.device.type, enabled=False):
            return self.layers(x.float())


class Decoder(nn.Module):
    """Normalisation and a linear map from embeddings to outputs, in float32."""

    def __init__(self, width: int, n_out: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.linear = nn.Linear(width, n_out)

    def forward(self, x: Tensor) -> Tensor:
        with torch.autocast(x.device.type, enabled=False):
            return self.linear(self.norm(x.float()))


def initialise(module: nn.Module, n_layers: int) -> None:
    """GPT-2's initialisation: small weights, smaller still where a residual branch ends."""
    for name, parameter in module.named_parameters():
        if parameter.dim() < 2 or "embedding" in name:
            continue
        if name.startswith("blocks."):
            ends_branch = name.endswith(("out.weight", "mlp.2.weight"))
            std = 0.02 / math.sqrt(2 * n_layers) if ends_branch else 0.02
            nn.init.normal_(parameter, std=std)
    for child in module.modules():
        if isinstance(child, Decoder):
            nn.init.normal_(child.linear.weight, std=0.02)
            nn.init.zeros_(child.linear.bias)
        elif isinstance(child, Attention):
            nn.init.zeros_(child.qkv.bias)
            nn.init.zeros_(child.out.bias)
