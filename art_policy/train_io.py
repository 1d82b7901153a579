"""What a training run tells the outside, and what it hears from it."""

from __future__ import annotations

import json
import logging
import signal
import threading
from pathlib import Path
from typing import Any

from torch import Tensor

logger = logging.getLogger(__name__)

LOG_NAME = "log.jsonl"


class Interrupt:
    """Turns Ctrl-C into a flag, so that no step is cut in half; a second one stops at once."""

    def __init__(self) -> None:
        self.seen = False
        self._previous: Any = None

    def __enter__(self) -> Interrupt:
        if threading.current_thread() is threading.main_thread():
            self._previous = signal.signal(signal.SIGINT, self._handle)
        return self

    def __exit__(self, *error: object) -> None:
        if self._previous is not None:
            signal.signal(signal.SIGINT, self._previous)

    def _handle(self, number: int, frame: object) -> None:
        self.seen = True
        signal.signal(signal.SIGINT, self._previous)


class Log:
    """Figures of a run: ``log.jsonl``, and ``tensorboard`` where TensorBoard is installed.

    Of a resumed run, what was written after the checkpoint is dropped first.

    Args:
        folder: The model's.
        step: Step at which the run goes on; 0 begins a new log.
    """

    def __init__(self, folder: Path, step: int) -> None:
        self._path = folder / LOG_NAME
        lines = self._path.read_text("utf-8").splitlines() if self._path.exists() else []
        kept = [line for line in lines if _is_whole(line) and json.loads(line)["step"] <= step]
        kept = kept if step else []
        self._path.write_text("".join(f"{line}\n" for line in kept), encoding="utf-8")
        self._board: Any = None
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            return
        self._board = SummaryWriter(str(folder / "tensorboard"), purge_step=step + 1)

    def write(self, step: int, **figures: Any) -> None:
        """Adds figures of a step."""
        row = {name: _plain(value) for name, value in {"step": step, **figures}.items()}
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")
        logger.info(" ".join(f"{name}={value:.4g}" for name, value in row.items()))
        if self._board:
            for name, value in row.items():
                kind = "validation" if name.startswith("val_") else "training"
                self._board.add_scalar(f"{kind}/{name.removeprefix('val_')}", value, step)

    def rows(self) -> list[dict[str, Any]]:
        """Everything that was written, in order."""
        return [json.loads(line) for line in self._path.read_text("utf-8").splitlines()]

    def close(self) -> None:
        """Writes what TensorBoard still holds."""
        if self._board:
            self._board.close()


def _is_whole(line: str) -> bool:
    """Whether a line was written to its end before the process was killed."""
    return line.startswith("{") and line.endswith("}")


def _plain(value: Any) -> float | int:
    value = value.detach() if isinstance(value, Tensor) else value
    return value if isinstance(value, int) else round(float(value), 6)
