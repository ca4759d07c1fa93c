"""Errors of calibrated quantities over their stated sigmas, figures of procedures, and the bars for both."""

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

    def __str__(self) -> str:
        shown = "" if self.held else "  (shown only)"
        covered = "" if np.isnan(self.coverage) else f", {100 * self.coverage:.1f} % within 1.96"
        return f"{self.name}: error over sigma {self.rms:.2f} RMS{covered}{shown} {self.note}".rstrip()


@dataclass(frozen=True)
class AtMost:
    """One figure of a procedure: its largest over all draws, or its RMS."""

    name: str
    draws: int
    value: float
    bar: float
    unit: str
    note: str = ""

    @property
    def missed(self) -> bool:
        """Whether the bar is missed."""
        return not self.value <= self.bar

    def __str__(self) -> str:
        return f"{self.name}: {self.value:.3g} {self.unit} (bar {self.bar:g}) {self.note}".rstrip()


Row = Normalised | AtMost


def normalised(name: str, z: np.ndarray, held: bool = True, note: str = "") -> Normalised:
    """RMS and coverage of errors over their sigmas (draws, ...); what is not finite was exact and is left out."""
    known = z[np.isfinite(z)]
    return Normalised(
        name,
        len(z),
        float(np.sqrt(np.mean(known**2))),
        float(np.mean(np.abs(known) < SIGMAS_95)),
        held,
        note,
    )
