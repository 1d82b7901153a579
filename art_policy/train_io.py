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


class JsonLines:
    """JSON lines; of a resumed run, lines past the checkpoint are dropped first."""

    def __init__(self, path: Path, step: int) -> None:
        self._path = path
        lines = path.read_text("utf-8").splitlines() if step and path.exists() else []
        kept = [line for line in lines if _is_whole(line) and json.loads(line)["step"] <= step]
        path.write_text("".join(f"{line}\n" for line in kept), encoding="utf-8")

    def write(self, **figures: Any) -> None:
        row = {name: _plain(value) for name, value in figures.items()}
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")
        logger.info(" ".join(f"{name}={value:.4g}" for name, value in row.items()))


def _is_whole(line: str) -> bool:
    """Whether a line was written to its end before the process was killed."""
    return line.startswith("{") and line.endswith("}")


def _plain(value: Any) -> float | int:
    value = value.detach() if isinstance(value, Tensor) else value
    return value if isinstance(value, int) else round(float(value), 6)
