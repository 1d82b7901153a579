"""The autoregressive head: the paper's model, a causal transformer over steps of a trajectory.

Each step contributes the tokens ``x_i, P_i, S_i, u_i`` (paper, eq. 3): the state; the performance
descriptors goal, reward-to-go, constraint-to-go and time-to-go; the scene descriptors; the
control. The control is predicted from the last token before it, the next state from the control::

    tokens_per_step = 4:   x_i  P_i  S_i -> u_i    u_i -> x_{i+1} (and the time-to-go)
    tokens_per_step = 2:   x_i + P_i + S_i -> u_i  u_i -> x_{i+1} (and the time-to-go)

There is no table of positions: an embedding of the time-to-go is added to every token of a step,
so that sub-sequences of any part of a trajectory can be told apart and sequences may be longer
than the context.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from art_policy.layers import ARTConfig, Block, Decoder, Encoder, KeyValueCache, initialise
from art_policy.perception import PictureEncoder, ScanEncoder, pictures, scans
from art_policy.sequence import ProblemBatch, SequenceBatch

if TYPE_CHECKING:
    from art_policy.generation import TorchSteps

_N_STATE, _N_PERFORMANCE, _N_DISC, _N_TIME = 8, 13, 3, 33
_TIME_SCALE = 40.0  # s
_IDLE_WEIGHT, _MODE_WEIGHT = 0.02, 0.1  # of the loss of several modes


class Autoregressive(nn.Module):
    """Predicts the next control, and the next state, from everything before.

    The buffers ``*_scale`` normalise what is read and predicted; :meth:`fit_scales` sets them from
    data, and they are saved with the weights.
    """

    rate_scale: Tensor
    change_scale: Tensor
    control_scale: Tensor
    budget_scale: Tensor

    def __init__(self, config: ARTConfig) -> None:
        super().__init__()
        self.config = config
        width = config.width
        self.state_encoder = Encoder(_N_STATE, width)
        self.performance_encoder = Encoder(_N_PERFORMANCE, width)
        if "vector" in config.modalities:
            self.disc_encoder = Encoder(_N_DISC, width)
        if "image" in config.modalities:
            self.picture_encoder = PictureEncoder(width)
        if "lidar" in config.modalities:
            self.scan_encoder = ScanEncoder(width)
        self.control_encoder = Encoder(3, width)
        self.time_encoder = Encoder(_N_TIME, width)
        self.dropout = nn.Dropout(config.dropout)
        self.blocks = nn.ModuleList(Block(config) for _ in range(config.n_layers))
        modes = config.n_modes
        self.control_decoder = Decoder(width, 3 * modes)
        if modes > 1:
            self.mode_decoder = Decoder(width, modes)
        self.outcome_decoder = Decoder(width, 7)  # change of state, time-to-go
        self.register_buffer("rate_scale", torch.tensor([0.1, 0.1, 0.1]))
        self.register_buffer("change_scale", torch.full((6,), 0.05))
        self.register_buffer("control_scale", torch.full((3,), 0.005))
        self.register_buffer("budget_scale", torch.tensor([0.3, 10.0]))  # reward, constraint
        initialise(self, config.n_layers)

    @property
    def window(self) -> int:
        """The context length in tokens."""
        return self.config.context_length * self.config.tokens_per_step

    @torch.no_grad()
    def fit_scales(self, batch: SequenceBatch) -> None:
        """Sets the normalisation to the standard deviations over a large batch."""
        valid = batch.valid
        change = (batch.next_states - batch.states)[valid]
        self.rate_scale.copy_(batch.states[valid][:, 3:].std(0).clamp(min=1e-3))
        self.change_scale.copy_(change.std(0).clamp(min=1e-4))
        self.control_scale.copy_(batch.controls[valid].std(0).clamp(min=1e-5))
        budget = torch.stack([batch.returns_to_go, batch.constraints_to_go], dim=-1)[valid]
        self.budget_scale.copy_(budget.std(0).clamp(min=0.05))

    def forward(self, batch: SequenceBatch) -> tuple[Tensor, Tensor]:
        """Teacher forcing: predictions at every step.

        Returns:
            Normalised controls ``(B, L, 3)``, the most probable ones if there are several, and
            outcomes ``(B, L, 7)``: the normalised change of the state, then the time-to-go in units
            of 40 s.
        """
        x = self._tokens(batch)
        modes, logits = self.decode_controls(x[:, :, -2])
        index = logits.argmax(-1, keepdim=True)[..., None].expand(*logits.shape[:-1], 1, 3)
        return modes.gather(-2, index).squeeze(-2), self.outcome_decoder(x[:, :, -1])

    def _tokens(self, batch: SequenceBatch) -> Tensor:
        """What the transformer makes of the tokens, ``(B, L, tokens a step, width)``."""
        size, length = batch.valid.shape
        described = self.embed_descriptors(
            batch.problems,
            batch.states,
            batch.returns_to_go,
            batch.constraints_to_go,
            batch.time_to_go,
            self.look(batch.problems),
        )
        control = self.embed_controls(batch.problems, batch.controls, batch.time_to_go)
        tokens = torch.cat([described, control], dim=2)  # (B, L, tokens a step, width)
        return self.transform(tokens.flatten(1, 2)).view(size, length, -1, self.config.width)

    def decode_controls(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Normalised controls ``(..., n_modes, 3)`` of tokens ``(..., width)``, and logits."""
        modes = self.control_decoder(x).unflatten(-1, (self.config.n_modes, 3))
        if self.config.n_modes == 1:
            return modes, torch.zeros_like(modes[..., 0])
        return modes, self.mode_decoder(x)

    def steps(self, problems: ProblemBatch, use_cache: bool = True) -> TorchSteps:
        """One step after the other, for :func:`art_policy.generation.generate`."""
        from art_policy.generation import TorchSteps

        return TorchSteps(self, problems, use_cache)

    def transform(self, tokens: Tensor, cache: KeyValueCache | None = None) -> Tensor:
        """Runs the transformer over tokens ``(B, L, width)`` that follow those in the cache.

        A token sees itself and the ``window - 1`` tokens before it, with a cache or without.
        """
        length, past = tokens.shape[1], 0
        if cache is not None:
            cache.forget(self.window - 1)
            past = cache.length
        mask = None
        if past or length > self.window:
            ones = torch.ones(length, past + length, dtype=torch.bool, device=tokens.device)
            mask = ones.tril(past).triu(past - self.window + 1)
        x = self.dropout(tokens)
        for layer, block in enumerate(self.blocks):
            x = block(x, mask=mask, causal=mask is None, cache=cache, layer=layer)
        return x

    def embed_descriptors(
        self,
        problems: ProblemBatch,
        states: Tensor,
        returns_to_go: Tensor,
        constraints_to_go: Tensor,
        time_to_go: Tensor,
        picture: Tensor | None = None,
    ) -> Tensor:
        """Tokens of what is known before the control: ``(B, L, 3 or 1, width)``.

        ``picture`` is what :meth:`look` saw.
        """
        budget = torch.stack([returns_to_go, constraints_to_go], dim=-1) / self.budget_scale
        parts = [
            self.state_encoder(self._state_features(problems, states)),
            self.performance_encoder(
                self._performance_features(problems, states, budget, time_to_go)
            ),
            self._embed_scene(problems, states, time_to_go, picture),
        ]
        if self.config.tokens_per_step == 2:
            parts = [torch.stack(parts).sum(0)]
        time = self._embed_time(problems, time_to_go)
        return torch.stack([part + time for part in parts], dim=2)

    def embed_controls(
        self, problems: ProblemBatch, controls: Tensor, time_to_go: Tensor
    ) -> Tensor:
        """Tokens of the controls ``(B, L, 3)``: ``(B, L, 1, width)``."""
        time = self._embed_time(problems, time_to_go)
        return (self.control_encoder(controls / self.control_scale) + time)[:, :, None]

    def loss(self, batch: SequenceBatch) -> tuple[Tensor, dict[str, Tensor]]:
        """Mean squared errors of control and state, and of the time-to-go if configured.

        With several modes, the one nearest to the control is drawn towards it, the others a little,
        and their probabilities are trained to name the nearest one.

        Returns:
            The loss, and its parts to log; with several modes also ``chosen_loss``, the error of
            the most probable one.
        """
        x = self._tokens(batch)
        modes, logits = self.decode_controls(x[:, :, -2])
        outcome = self.outcome_decoder(x[:, :, -1])
        change = (batch.next_states - batch.states) / self.change_scale
        time = batch.time_to_go[..., None] / _TIME_SCALE
        weight = batch.valid / batch.valid.sum()
        target = (batch.controls / self.control_scale)[..., None, :]
        errors = (modes - target).square().mean(-1)  # (B, L, n_modes)
        nearest, owner = errors.min(-1)
        figures = {"control_loss": (nearest * weight).sum()}
        loss = figures["control_loss"]
        if self.config.n_modes > 1:
            choice = F.cross_entropy(logits.flatten(0, 1), owner.flatten(), reduction="none")
            figures["mode_loss"] = (choice.view_as(weight) * weight).sum()
            chosen = errors.gather(-1, logits.argmax(-1, keepdim=True)).squeeze(-1)
            figures["chosen_loss"] = (chosen * weight).sum()
            idle = (errors.mean(-1) * weight).sum()
            loss = loss + _IDLE_WEIGHT * idle + _MODE_WEIGHT * figures["mode_loss"]
        figures["state_loss"] = _mean_square(outcome[..., :6] - change, weight)
        loss = loss + figures["state_loss"]
        if self.config.predict_time_to_go:
            figures["time_loss"] = _mean_square(outcome[..., 6:] - time, weight)
            loss = loss + figures["time_loss"]
        return loss, {name: value.detach() for name, value in figures.items()}

    def _state_features(self, problems: ProblemBatch, states: Tensor) -> Tensor:
        """``(B, L, 8)``; quarter turns of the body drop out."""
        size = states.new_tensor(self.config.table)
        psi = states[..., 2:3]
        turn = (psi - problems.start[:, None, 2:3]) / math.pi
        quarters = [(4.0 * psi).cos(), (4.0 * psi).sin()]
        position = 2.0 * states[..., :2] / size - 1.0
        return torch.cat([position, turn, *quarters, states[..., 3:] / self.rate_scale], dim=-1)

    def _embed_time(self, problems: ProblemBatch, time_to_go: Tensor) -> Tensor:
        """``(B, L, width)``, which tells the steps apart."""
        if "time_to_go" not in self.config.descriptors:
            time_to_go = problems.final_time[:, None] - time_to_go
        return self.time_encoder(time_features(time_to_go))

    def _performance_features(
        self, problems: ProblemBatch, states: Tensor, budget: Tensor, time_to_go: Tensor
    ) -> Tensor:
        """``(B, L, 13)``: the goal, on the table and relative to the state, and what is to go.

        Descriptors that the configuration leaves out are zero.
        """
        size = states.new_tensor(self.config.table)
        goal = problems.goal[:, None].expand_as(states)
        away = goal - states
        target = torch.cat(
            [
                2.0 * goal[..., :2] / size - 1.0,
                (4.0 * goal[..., 2:3]).cos(),
                (4.0 * goal[..., 2:3]).sin(),
                away[..., :2],
                away[..., 2:3] / math.pi,
                away[..., 3:] / self.rate_scale,
            ],
            dim=-1,
        )
        parts = {
            "goal": target,
            "reward_to_go": budget[..., :1],
            "constraint_to_go": budget[..., 1:],
            "time_to_go": time_to_go[..., None] / _TIME_SCALE,
        }
        given = self.config.descriptors
        return torch.cat(
            [part if name in given else torch.zeros_like(part) for name, part in parts.items()],
            dim=-1,
        )

    def look(self, problems: ProblemBatch) -> Tensor | None:
        """``(B, width)`` of the top view at time zero; None for a model that sees no images."""
        if "image" not in self.config.modalities:
            return None
        return self.picture_encoder(pictures(problems, self.config.table)).mean(1)

    def _embed_scene(
        self, problems: ProblemBatch, states: Tensor, time_to_go: Tensor, picture: Tensor | None
    ) -> Tensor:
        """``(B, L, width)``: the sum over the modalities, and over the discs, in no order."""
        scene = torch.zeros(*states.shape[:2], self.config.width, device=states.device)
        if picture is not None:
            scene = scene + picture[:, None]
        discs = problems.discs_at(problems.final_time[:, None] - time_to_go)  # (B, L, M, 3)
        if "lidar" in self.config.modalities:
            poses = states[..., :3]
            scene = scene + self.scan_encoder(poses, scans(poses, discs, self.config.table))
        if "vector" in self.config.modalities:
            offset = states[:, :, None, :2] - discs[..., :2]  # (B, L, M, 2)
            clearance = offset.norm(dim=3, keepdim=True) - discs[..., 2:]
            features = torch.cat([offset, clearance], dim=3)
            if self.config.scene_descriptors == "absolute":
                features = discs
            present = problems.present[:, None, :, None]
            scene = scene + (self.disc_encoder(features) * present).sum(2)
        return scene


def time_features(time_to_go: Tensor) -> Tensor:
    """``(..., 33)``: the time-to-go, and its sines and cosines at periods from 1 s to 400 s."""
    octaves = torch.linspace(0.0, 1.0, (_N_TIME - 1) // 2, device=time_to_go.device)
    phase = 2.0 * math.pi * time_to_go[..., None] / (400.0**octaves)
    return torch.cat([time_to_go[..., None] / _TIME_SCALE, phase.sin(), phase.cos()], dim=-1)


def _mean_square(error: Tensor, weight: Tensor) -> Tensor:
    """Mean over components, weighted mean over steps."""
    return (error.square().mean(-1) * weight).sum()
