"""ART: one class for both heads, with saving and loading."""

from __future__ import annotations

import difflib
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from safetensors.torch import load_file, save_file
from torch import nn

from art_policy.autoregressive import Autoregressive
from art_policy.layers import ARTConfig
from art_policy.multi_hypothesis import MultiHypothesis

if TYPE_CHECKING:
    from art_policy.deployment import OnnxART
    from art_policy.generation import TorchSteps
    from art_policy.sequence import ProblemBatch

PRETRAINED_DIR = Path(__file__).parent / "pretrained"
WEIGHTS_NAME, CONFIG_NAME = "model.safetensors", "config.json"


class ART(nn.Module):
    """The Autonomous Rendezvous Transformer: proposes trajectories for a problem.

    Use :func:`art_policy.rollout.propose` to get trajectories; calling the module gives the raw
    outputs of its head, ``MultiHypothesis`` or ``Autoregressive``.

    Attributes:
        config: Size and kind.
        net: The network of the configured head.
    """

    def __init__(self, config: ARTConfig) -> None:
        super().__init__()
        self.config = config
        sequential = config.head == "autoregressive"
        self.net: MultiHypothesis | Autoregressive
        self.net = Autoregressive(config) if sequential else MultiHypothesis(config)

    def forward(self, *args: Any, **kwargs: Any) -> Any:
        """The head's forward pass."""
        return self.net(*args, **kwargs)

    def steps(self, problems: ProblemBatch, use_cache: bool = True) -> TorchSteps:
        """One step after the other (autoregressive head)."""
        assert isinstance(self.net, Autoregressive)
        return self.net.steps(problems, use_cache)

    @property
    def num_parameters(self) -> int:
        """Number of trainable numbers."""
        return sum(parameter.numel() for parameter in self.parameters())

    @property
    def device(self) -> torch.device:
        """Where the weights are."""
        return next(self.parameters()).device

    def save_pretrained(self, folder: str | Path, half: bool = False) -> None:
        """Writes ``model.safetensors`` and ``config.json`` into ``folder``.

        Args:
            folder: Where to; made if needed.
            half: Whether to write matrices as float16, half the size; they are read as float32.
        """
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        weights = {name: value.contiguous() for name, value in self.state_dict().items()}
        if half:
            weights = {
                name: value.half() if value.dim() >= 2 else value for name, value in weights.items()
            }
        save_file(weights, folder / WEIGHTS_NAME)
        text = json.dumps(self.config.to_dict(), indent=2)
        (folder / CONFIG_NAME).write_text(text + "\n", encoding="utf-8")

    @classmethod
    def from_pretrained(cls, name_or_path: str | Path, device: str = "cpu") -> ART:
        """A model ready for inference.

        Args:
            name_or_path: A name that ships with the package (:func:`shipped_models`), a folder
                written by :meth:`save_pretrained`, or a Hugging Face repository ``owner/name``.
            device: Where to put the weights.

        Raises:
            FileNotFoundError: If there is no such model; the message lists the shipped names.
            ValueError: If the files do not describe a model of this version.
        """
        folder = _find(name_or_path)
        for name in (CONFIG_NAME, WEIGHTS_NAME):
            if not (folder / name).is_file():
                raise FileNotFoundError(f"{folder} holds no model: {name} is missing.")
        try:
            config = ARTConfig.from_dict(json.loads((folder / CONFIG_NAME).read_text("utf-8")))
            model = cls(config)
            model.load_state_dict(load_file(folder / WEIGHTS_NAME))
        except RuntimeError as error:
            raise ValueError(f"The weights in {folder} do not fit its config.json.") from error
        return model.to(device).eval()


def load_model(name_or_path: str | Path) -> ART | OnnxART:
    """A model for inference: an exported ``.onnx`` file, or what :meth:`ART.from_pretrained` takes.

    Raises:
        FileNotFoundError: If there is no such model.
        ValueError: If the files do not describe a model of this version.
    """
    if str(name_or_path).endswith(".onnx"):
        from art_policy.deployment import OnnxART

        return OnnxART(name_or_path)
    return ART.from_pretrained(name_or_path)


def shipped_models() -> list[str]:
    """Names of the models that ship with the package."""
    return sorted(path.parent.name for path in PRETRAINED_DIR.glob(f"*/{CONFIG_NAME}"))


def _find(name_or_path: str | Path) -> Path:
    name = str(name_or_path)
    if (PRETRAINED_DIR / name / CONFIG_NAME).is_file():
        return PRETRAINED_DIR / name
    if Path(name).is_dir():
        return Path(name)
    if name.count("/") == 1 and not name.startswith(("/", ".")):
        return _download(name)
    raise FileNotFoundError(_unknown(name))


def _download(repository: str) -> Path:
    try:
        from huggingface_hub import snapshot_download
    except ImportError:
        raise FileNotFoundError(
            f"{_unknown(repository)} To fetch it from Hugging Face: pip install huggingface-hub."
        ) from None
    try:
        files = [WEIGHTS_NAME, CONFIG_NAME]
        return Path(snapshot_download(repository, allow_patterns=files))
    except Exception as error:
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise FileNotFoundError(f"{_unknown(repository)} Hugging Face says: {reason}") from error


def _unknown(name: str) -> str:
    shipped = shipped_models()
    near = difflib.get_close_matches(name, shipped, n=1)
    hint = f" Did you mean {near[0]!r}?" if near else ""
    return f"No model is called {name!r}.{hint} Shipped: {', '.join(shipped) or 'none'}."
