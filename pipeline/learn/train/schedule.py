"""Schedule of the learning rate, and detection of divergence.

Source: paper section 4.5.4: cosine from 3e-4 to 3e-7.
"""

from __future__ import annotations

import math

from pipeline.core.errors import BoresightError

__all__ = ["DivergedError", "DivergenceGuard", "cosine_rate"]

_PATIENCE = 20  # reports before any is judged
_SMOOTHING = 0.05  # of the loss: about the last twenty reports count


class DivergedError(BoresightError):
    """Training that diverges: `step` and the loss."""

    def __init__(self, step: int, reason: str) -> None:
        self.step, self.reason = step, reason
        super().__init__(f"training diverged at step {step}: {reason}")


def cosine_rate(progress: float, first: float, last: float) -> float:
    """Learning rate at `progress` (0..1, held beyond)."""
    share = min(max(progress, 0.0), 1.0)
    return last + 0.5 * (first - last) * (1 + math.cos(math.pi * share))


class DivergenceGuard:
    """Raises if the loss is not finite, or a multiple of its smallest smoothed value."""

    def __init__(self, factor: float) -> None:
        self._factor = factor
        self._smooth: float | None = None
        self._least = math.inf
        self._seen = 0

    def check(self, step: int, loss: float, gradient_norm: float) -> None:
        """Check the loss of one step."""
        if not math.isfinite(loss):
            raise DivergedError(step, f"the loss is {loss}")
        if not math.isfinite(gradient_norm):
            raise DivergedError(step, f"the gradient's norm is {gradient_norm}")
        self._seen += 1
        self._smooth = loss if self._smooth is None else self._smooth + _SMOOTHING * (loss - self._smooth)
        self._least = min(self._least, self._smooth)
        # Likelihood terms may take the sum below zero: a loss near zero has no useful multiple.
        limit = self._factor * max(abs(self._least), 1.0)
        if self._seen > _PATIENCE and self._smooth > limit:
            told = f"is more than {self._factor:g} times its least, {self._least:.3g}"
            raise DivergedError(step, f"the smoothed loss {self._smooth:.3g} {told}")

    def state_dict(self) -> dict[str, float | int | None]:
        """For checkpoints."""
        return {"smooth": self._smooth, "least": self._least, "seen": self._seen}

    def load_state_dict(self, state: dict[str, float | int | None]) -> None:
        """From checkpoints."""
        smooth, least, seen = state["smooth"], state["least"], state["seen"]
        self._smooth = None if smooth is None else float(smooth)
        self._least = math.inf if least is None else float(least)
        self._seen = int(seen or 0)
