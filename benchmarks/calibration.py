"""Calibrated quantities of drawn machines against their truth: `make bench-calibration`.

Each quantity's errors over its stated sigmas: RMS 0.85 to 1.15, and 92 to 98 % of them within 1.96 sigmas. Lenses,
clusters, axes and mounts come from rendered logs, buckets from drawn corners (a rendered log takes minutes apiece),
surveys and single axes from numbers. With the documented procedures cameras stand to each other within 0.02 deg and
2 mm at one sigma, and a bucket's angle is within 0.2 deg over the stroke.
"""

from __future__ import annotations

import argparse
import datetime
import sys
import time
from collections.abc import Callable
from dataclasses import asdict

from benchmarks._calibration_bars import Row
from benchmarks._calibration_bucket import buckets
from benchmarks._calibration_cluster import clusters, surveys
from benchmarks._calibration_intrinsics import intrinsics
from benchmarks._calibration_mounts import axes, mounts
from benchmarks._results import keep_result, kept_rows

DRAWS = 60
QUANTITIES: dict[str, Callable[[int], list[Row]]] = {
    "surveys": surveys,
    "axes": axes,
    "intrinsics": intrinsics,
    "clusters": clusters,
    "mounts": mounts,
    "buckets": buckets,
}
"""Name -> what draws so many machines and calibrates them."""


def main() -> int:
    """Run, print the table and the line, keep the result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=DRAWS)
    parser.add_argument(
        "--only", choices=tuple(QUANTITIES), help="one quantity; those of the others stay as kept"
    )
    wanted = parser.parse_args()
    rows: list[Row] = []
    for name in [wanted.only] if wanted.only else list(QUANTITIES):
        begun = time.monotonic()
        made = QUANTITIES[name](wanted.draws)
        print(*made, f"  ({name}: {time.monotonic() - begun:.0f} s)", sep="\n", flush=True)
        rows += made
    kept = {row["name"]: row for row in kept_rows("calibration")} if wanted.only else {}
    kept |= {row.name: {**asdict(row), "date": datetime.date.today().isoformat()} for row in rows}
    line = f"calibration: at least {min(row['draws'] for row in kept.values())} drawn; " + ", ".join(
        f"{row['name']} {row['value']:.3g} {row['unit']}"
        if "value" in row
        else f"{row['name']} {row['rms']:.2f} of sigma, {100 * row['coverage']:.0f} % covered"
        for row in kept.values()
        if row.get("held", True)
    )
    keep_result("calibration", list(kept.values()), line)
    print(line)
    missed = [row.name for row in rows if row.missed]
    for name in missed:
        print(f"missed bar: {name}")
    return int(bool(missed))


if __name__ == "__main__":
    sys.exit(main())
