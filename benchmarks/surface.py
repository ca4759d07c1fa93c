"""The swept cutting edge of a shift on cells of 5 cm, time and memory: `make bench-surface`.

A machine digs a trench of 120 m in cycles of 20 s (drag, lift, swing, return) and retreats; the edge is known at a
million epochs, those of two cameras at 10 Hz and of a sensor at 15 Hz over eight hours. Bars: 30 s and 2 GB for
the surface with its floor, sigmas and states; what is measured is the whole process, input included.
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from dataclasses import dataclass

import numpy as np

from benchmarks._results import keep_result
from pipeline.surface.alignment import Alignment, polyline
from pipeline.surface.as_built import as_built
from pipeline.surface.design import ProfileDesign
from pipeline.tracks.poses import CuttingEdge

HOURS = 8
LENGTH_M = 120.0
CELL_M = 0.05
SECONDS_BAR, MEGABYTES_BAR = 30.0, 2000.0


@dataclass(frozen=True)
class Row:
    """One run."""

    epochs: int
    cells: int
    cells_cut: int
    passes: int
    seconds: float
    megabytes: float
    """Largest resident size of the process."""


def trench() -> tuple[Alignment, ProfileDesign]:
    """A trench with a bend, 2 m deep, 1.2 m wide."""
    alignment = polyline(np.array([[500_000.0, 4_000_000], [500_060, 4_000_020], [500_120, 4_000_020]]))
    both = np.ones(2)
    return alignment, ProfileDesign("bench", np.array([0, LENGTH_M]), 98 * both, 1.2 * both, 0.5 * both)


def shift(alignment: Alignment, epochs: int) -> CuttingEdge:
    """The cutting edge of a shift."""
    rng = np.random.default_rng(0)
    t = np.linspace(0, HOURS * 3600, epochs)
    cycle, phase = np.divmod(t, 20.0)
    phase /= 20.0
    drag = phase < 0.3
    station = 5 + cycle * (LENGTH_M - 10) / cycle.max()
    station += np.where(drag, 4 * (1 - phase / 0.3), 4 * (phase - 0.3) / 0.7)
    bowl = np.maximum(-2.0, -2.0 + 1.5 * np.abs(phase / 0.15 - 1) ** 8) + 0.3 * (cycle % 4) / 4
    h = 100 + np.where(drag, bowl, 1.0) + rng.normal(0, 0.003, epochs)
    offset = np.where(drag, 0.0, 6 * np.sin(np.pi * (phase - 0.3) / 0.7))
    p = np.empty((epochs, 3, 3))
    for i, x in enumerate((-0.6, 0.0, 0.6)):
        p[:, i, :2], p[:, i, 2] = alignment.points(station, offset + x), h
    cov, common = np.zeros((epochs, 3, 6)), np.zeros((epochs, 3, 6))
    cov[..., [0, 3, 5]], common[..., [0, 3, 5]] = 3e-5, 1e-5
    time_ns = 1_750_000_000_000_000_000 + np.round(t * 1e9).astype(np.int64)
    return CuttingEdge(time_ns, p, np.ones(epochs, bool), cov, common)


def main() -> int:
    """Run, print the table and the line, keep the result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--epochs", type=int, default=1_000_000)
    epochs = parser.parse_args().epochs
    alignment, design = trench()
    edge = shift(alignment, epochs)
    started = time.perf_counter()  # numba's compiling included: a first run has it too
    built = as_built(edge, alignment, design, CELL_M)
    seconds = time.perf_counter() - started
    megabytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    row = Row(epochs, built.grid.size, int(built.cut.sum()), int(built.passes.sum()), seconds, megabytes)
    print(f"{'epochs':>9} {'cells':>8} {'cut':>8} {'passes':>9} {'s':>6} {'MB':>6}")
    print(
        f"{row.epochs:9d} {row.cells:8d} {row.cells_cut:8d} {row.passes:9d} {row.seconds:6.1f} {row.megabytes:6.0f}"
    )
    line = (
        f"surface: {epochs / 1e6:g} M epochs into {CELL_M * 1000:.0f} mm cells in {seconds:.1f} s, {megabytes:.0f} MB "
        f"(bars {SECONDS_BAR:.0f} s, {MEGABYTES_BAR:.0f} MB)"
    )
    keep_result("surface", [row], line)
    print(line)
    return int(seconds > SECONDS_BAR or megabytes > MEGABYTES_BAR)


if __name__ == "__main__":
    sys.exit(main())
