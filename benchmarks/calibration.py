"""Calibrated quantities of drawn machines, from rendered logs, against their truth: `make bench-calibration`.

Each quantity's errors over its stated sigmas: RMS 0.85 to 1.15, and 92 to 98 % of them within 1.96 sigmas.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable

from benchmarks._calibration_bars import Normalised
from benchmarks._calibration_intrinsics import intrinsics
from benchmarks._results import keep_result

DRAWS = 60
QUANTITIES: dict[str, Callable[[int], list[Normalised]]] = {"intrinsics": intrinsics}
"""Name -> what draws so many machines and calibrates them."""


def main() -> int:
    """Run, print the table and the line, keep the result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=DRAWS)
    parser.add_argument("--only", choices=tuple(QUANTITIES), help="one quantity; nothing is kept then")
    wanted = parser.parse_args()
    names = [wanted.only] if wanted.only else list(QUANTITIES)
    rows = [row for name in names for row in QUANTITIES[name](wanted.draws)]
    for row in rows:
        bar = "" if row.held else "  (shown only)"
        print(
            f"{row.name}: error over sigma {row.rms:.2f} RMS, {100 * row.coverage:.1f} % within 1.96{bar} {row.note}"
        )
    held = [row for row in rows if row.held]
    line = f"calibration: {wanted.draws} drawn; " + ", ".join(
        f"{row.name} {row.rms:.2f} of sigma, {100 * row.coverage:.0f} % covered" for row in held
    )
    if not wanted.only:
        keep_result("calibration", rows, line)
    print(line)
    missed = [row.name for row in rows if row.missed]
    for name in missed:
        print(f"missed bar: {name}")
    return int(bool(missed))


if __name__ == "__main__":
    sys.exit(main())
