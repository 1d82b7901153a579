"""Beginning a training with the weights of another model."""

from __future__ import annotations

import torch

from art_policy.model import ART
from art_policy.multi_hypothesis import MultiHypothesis, hats, knot_places


def begin_with(model: ART, name: str) -> None:
    """Begins with the weights of another model.

    More hypotheses than it has begin anew; other knots begin where its own put them. Several modes
    begin as one that had none, but for what is drawn, and grow apart.
    """
    other = ART.from_pretrained(name)
    ours, theirs = model.config.to_dict(), other.config.to_dict()
    changed = [key for key in ours if ours[key] != theirs[key]]
    free = {"n_hypotheses", "n_knots", "knot_spacing", "dropout", "envelope", "returns_to_go"}
    if other.config.n_modes == 1:
        free.add("n_modes")
    if changed := sorted(set(changed) - free):
        raise ValueError(
            f"TrainConfig.init: {name!r} is of another {', '.join(changed)} than the model that is "
            "to be trained."
        )
    weights = other.state_dict()
    if isinstance(model.net, MultiHypothesis):
        queries = model.net.query_embedding.detach().clone()
        both = min(len(queries), other.config.n_hypotheses)
        queries[:both] = weights["net.query_embedding"][:both]
        weights["net.query_embedding"] = queries
        places = knot_places(model.config.n_knots, model.config.knot_spacing)[1:-1]
        values = hats(other.config.n_knots, places, other.config.knot_spacing).float()
        for name in ("net.knot_decoder.linear.weight", "net.knot_decoder.linear.bias"):
            by_knot = weights[name].unflatten(0, (-1, 3))  # (n_knots, 3, ...)
            weights[name] = torch.einsum("ij,j...->i...", values, by_knot).flatten(0, 1)
    elif model.config.n_modes > other.config.n_modes:
        drawn = model.state_dict()
        for name in ("net.control_decoder.linear.weight", "net.control_decoder.linear.bias"):
            repeats = (model.config.n_modes,) + (1,) * (weights[name].dim() - 1)
            weights[name] = drawn[name] + weights[name].repeat(repeats)
        weights |= {name: drawn[name] for name in drawn if name.startswith("net.mode_decoder.")}
    model.load_state_dict(weights)
