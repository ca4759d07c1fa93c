"""Consistency of the adjustment by Monte Carlo: normalised errors of the cutting edge, with and without the border.

Statics, motion and corners are drawn from their covariances; each drawn network is adjusted from its own planar
start. Bars: mean normalised errors inside their 95 % bands, and outside them when the files are taken as exact.
"""

from __future__ import annotations

import sys
import time

import numpy as np

from benchmarks._results import keep_result
from tests.estimation.monte_carlo import band, nees, sample, small

RUNS = 200
CASES = (
    ("potentiometer", False, False),
    ("bucket marker", True, False),
    ("files taken as exact", False, True),
)


def main() -> int:
    """Print the table and the verdict; 1 if a bar is missed."""
    print(f"{'network':22} {'runs':>4} {'edge /3':>9} {'band':>12} {'elevation':>9} {'pose /6':>9} {'band':>12} "
          f"{'statics':>7} {'cover 95':>8} {'s':>5}")  # fmt: skip
    missed, figures, rows = [], [], []
    for name, marker, trust_files in CASES:
        runs = RUNS // 4 if trust_files else RUNS
        started = time.monotonic()
        found = sample(runs, small(marker), trust_files)
        edge, pose, cover = nees(found.edge), nees(found.pose), float(np.mean(np.abs(found.elevation) < 1.96))
        three, six = band(runs, 3), band(runs, 6)
        inside = three[0] < edge < three[1] and six[0] < pose < six[1]
        statics = float(np.mean(found.statics**2)) if found.statics.size else float("nan")
        print(f"{name:22} {runs:4d} {edge:9.2f} {three[0]:5.2f} .. {three[1]:4.2f} "
              f"{nees(found.elevation):9.2f} {pose:9.2f} {six[0]:5.2f} .. {six[1]:4.2f} {statics:7.2f} "
              f"{cover:8.3f} {time.monotonic() - started:5.0f}")  # fmt: skip
        rows.append({"network": name, "runs": runs, "edge": edge, "edge_band": three, "pose": pose, "pose_band": six,
                     "statics": statics, "cover_95": cover})  # fmt: skip
        if inside == trust_files:
            missed.append(name)
        bar = f"outside {three[0]:.2f}-{three[1]:.2f}" if trust_files else f"{three[0]:.2f}-{three[1]:.2f}"
        figures.append(f"{name} {edge:.2f} ({bar})")
    line = f"consistency: edge NEES {', '.join(figures)}" + (
        f"; MISSED: {', '.join(missed)}" if missed else ""
    )
    keep_result("consistency", rows, line)
    print(line)
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
