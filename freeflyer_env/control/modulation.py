"""Pulse-width modulation: duties become on/off pulses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from freeflyer_env.robot import FloatArray


class PulseWidthModulator:
    """Turns duties into on/off pulses, one period at a time.

    On-times are whole numbers of sub-steps. What rounding leaves over is carried to the next
    period, so that small duties act on average instead of vanishing. So is the time of a pulse that
    is shorter than the valves allow: it adds up until it is worth a pulse. A thruster whose duty is
    zero forgets what it carried.

    Args:
        sub_steps: Sub-steps in a period, at least 1.
        min_sub_steps: Shortest pulse that is fired, in sub-steps, 0 to ``sub_steps``; 0 and 1 allow
            every pulse.

    Raises:
        ValueError: If an argument is out of range.
    """

    def __init__(self, sub_steps: int, min_sub_steps: int = 0) -> None:
        if sub_steps < 1:
            raise ValueError(f"PulseWidthModulator.sub_steps must be at least 1, got {sub_steps}.")
        if not 0 <= min_sub_steps <= sub_steps:
            raise ValueError(
                "PulseWidthModulator.min_sub_steps must be from 0 to sub_steps "
                f"({sub_steps}), got {min_sub_steps}."
            )
        self.sub_steps, self.min_sub_steps = sub_steps, min_sub_steps
        self.reset()

    def reset(self) -> None:
        """Forgets what was carried over."""
        self.carried = np.zeros(8)

    def pulses(self, duties: FloatArray) -> NDArray[np.bool_]:
        """Which thruster is on in which sub-step of the next period.

        Args:
            duties: ``(..., 8)`` in [0, 1]; the same batch in every period.

        Returns:
            ``(..., sub_steps, 8)``; each pulse lies in the middle of the period.
        """
        wanted = np.minimum(np.maximum(duties, 0.0), 1.0) * self.sub_steps + self.carried
        # Rounding first strips the float noise that could tip an on-time over.
        on = np.floor(np.rint(wanted * 1e9) * 1e-9 + 0.5)
        on = np.minimum(np.maximum(on, 0.0), self.sub_steps)
        if self.min_sub_steps > 1:
            on = np.where(on < self.min_sub_steps, 0.0, on)
        most = max(self.min_sub_steps, 1)
        left = np.minimum(np.maximum(wanted - on, -1.0), most)
        self.carried = np.where(np.asarray(duties) > 0.0, left, 0.0)
        first = (self.sub_steps - on) // 2
        index = np.arange(self.sub_steps)[:, None]
        return (index >= first[..., None, :]) & (index < (first + on)[..., None, :])
