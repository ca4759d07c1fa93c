"""Errors of calibrated quantities over their stated sigmas, and the bars that they are held against."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

RMS_BAR = (0.85, 1.15)
COVERAGE_BAR = (0.92, 0.98)
SIGMAS_95 = 1.96


@dataclass(frozen=True)
class Normalised:
    """One quantity over all draws."""

    name: str
    draws: int
    rms: float
    """Of error over sigma."""
    coverage: float
    """Share of errors within 1.96 sigmas."""
    held: bool
    """Whether the bars are for it; parts of a quantity over few draws stray by a tenth and are shown only."""
    note: str = ""

    @property
    def missed(self) -> bool:
        """Whether a bar is missed."""
        inside = RMS_BAR[0] <= self.rms <= RMS_BAR[1] and COVERAGE_BAR[0] <= self.coverage <= COVERAGE_BAR[1]
        return self.held and not inside


def normalised(name: str, z: np.ndarray, held: bool = True, note: str = "") -> Normalised:
    """RMS and coverage of errors over their sigmas (draws, ...)."""
    return Normalised(
        name, len(z), float(np.sqrt(np.mean(z**2))), float(np.mean(np.abs(z) < SIGMAS_95)), held, note
    )
