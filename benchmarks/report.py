"""The page of an 8 h shift, its size, seconds and memory: `make bench-report`.

576,000 frames of two cameras with 1.7 million tags in them, 288,000 epochs of the cutting edge, a trench of 200 m in
cells of 5 cm and stations of half a metre, 120 check shots, six pictures of noise (which JPEG can do least about).
The stage runs twice, each time in a process of its own: the pages must be the same bytes. Bars: 3 MB and 2 GB.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from benchmarks._results import keep_result

HOURS, RATE_HZ, LENGTH_M = 8.0, 10.0, 200.0
PAGE_BAR_MB, MEMORY_BAR_MB = 3.0, 2000.0


@dataclass(frozen=True)
class Row:
    """One run of the stage."""

    hours: float
    trench_m: float
    stations: int
    pictures: int
    figures: int
    page_mb: float
    json_mb: float
    seconds: float
    memory_mb: float
    """Largest resident size of its process."""
    sha256: str


def measured(folder: Path, hours: float, length_m: float) -> Row:
    """Run the report stage on a run folder that is there, in this process."""
    from pipeline.progress import Silence
    from pipeline.stages import report, stage_named
    from pipeline.stages.job import open_job

    job = open_job(folder / "shift.mcap", runs=folder / "runs").at(stage_named("report"), "f" * 64)
    started = time.perf_counter()
    report.run(job, Silence())
    seconds = time.perf_counter() - started
    html, content = (job.folder.file(name).read_bytes() for name in ("report.html", "report.json"))
    told = json.loads(content)
    return Row(
        hours=hours,
        trench_m=length_m,
        stations=sum(len(told[name]["rows"]) for name in ("stations", "stations_beyond") if told[name]),
        pictures=html.count(b"data:image/jpeg"),
        figures=sum(not figure["why"] for figure in told["figures"].values()),
        page_mb=len(html) / 1e6,
        json_mb=len(content) / 1e6,
        seconds=seconds,
        memory_mb=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        sha256=hashlib.sha256(html).hexdigest(),
    )


def main() -> int:
    """Make the tables, run the stage twice, print the table and the line, keep the result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--hours", type=float, default=HOURS)
    parser.add_argument("--length", type=float, default=LENGTH_M, help="of the trench, metres")
    parser.add_argument("--measure", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.measure:
        print(json.dumps(vars(measured(options.measure, options.hours, options.length))))
        return 0
    from benchmarks._shift_tables import job_of_a_shift

    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        job_of_a_shift(folder, options.hours, RATE_HZ, options.length)
        command = [sys.executable, "-m", "benchmarks.report", "--measure", scratch]
        command += ["--hours", str(options.hours), "--length", str(options.length)]
        rows = [
            Row(**json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout))
            for _ in range(2)
        ]
    print(f"{'stations':>9}{'pictures':>10}{'figures':>9}{'page MB':>9}{'json MB':>9}{'s':>7}{'MB':>7}  page")
    for row in rows:
        print(
            f"{row.stations:>9}{row.pictures:>10}{row.figures:>9}{row.page_mb:>9.2f}{row.json_mb:>9.2f}"
            f"{row.seconds:>7.1f}{row.memory_mb:>7.0f}  {row.sha256[:12]}"
        )
    first, second = rows
    line = (
        f"report: {options.hours:g} h, {options.length:g} m of trench: page {first.page_mb:.2f} MB "
        f"(bar {PAGE_BAR_MB:g}), {first.seconds:.0f} s, {max(row.memory_mb for row in rows):.0f} MB "
        f"(bar {MEMORY_BAR_MB:.0f}), "
        f"two runs {'the same' if first.sha256 == second.sha256 else 'DIFFERENT'} bytes"
    )
    keep_result("report", rows, line)
    print(line)
    met = first.page_mb <= PAGE_BAR_MB and max(row.memory_mb for row in rows) <= MEMORY_BAR_MB
    return int(not met or first.sha256 != second.sha256 or first.pictures < 2)


if __name__ == "__main__":
    sys.exit(main())
