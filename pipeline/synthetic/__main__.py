"""``python -m pipeline.synthetic`` is ``gradetrace sample-logs``."""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path

from pipeline.errors import PipelineError
from pipeline.synthetic import calibration_sites, command, yard
from pipeline.synthetic.calibration_logs import LOGS

DRAWN_LOGS = 5
DRAWN_MINUTES = 3.0


def main(arguments: list[str] | None = None) -> None:
    """Render what the arguments ask for; without any, the committed sample and the benchmarks' logs."""
    parser = argparse.ArgumentParser(
        prog="gradetrace sample-logs",
        description="Render logs of a site whose truth is known. Without options: the committed sample and the "
        f"{DRAWN_LOGS} drawn 1280x960 logs of {DRAWN_MINUTES:g} minutes that the benchmarks use.",
    )
    parser.add_argument(
        "--site",
        choices=(*command.SITES, *LOGS, *calibration_sites.NAMES, yard.NAME),
        help=f"which site; one log of it is made ({yard.NAME}: those of all calibrations in one folder)",
    )
    parser.add_argument("--size", choices=tuple(command.SIZES), help="640 (640x480) or 1280 (1280x960)")
    parser.add_argument("--minutes", type=float, help="at least this long, in whole cycles")
    parser.add_argument(
        "--seed", type=int, help=f"of every draw; the committed sample is {command.SAMPLE_SEED}"
    )
    parser.add_argument("--folder", type=Path, help="where the log and the files beside it go")
    parser.add_argument(
        "--jobs", type=int, default=len(os.sched_getaffinity(0)), help="processes that render"
    )
    parser.add_argument("--sample", action="store_true", help="the committed sample only")
    wanted = parser.parse_args(arguments)
    one = (wanted.site, wanted.size, wanted.minutes, wanted.seed, wanted.folder)
    if wanted.sample:
        _make(wanted.jobs, folder=wanted.folder)
    elif any(value is not None for value in one):
        own_size = (*calibration_sites.NAMES, yard.NAME)
        small = wanted.site in own_size or (wanted.minutes is None and wanted.seed is None)
        _make(
            wanted.jobs,
            folder=wanted.folder,
            site=wanted.site or "trench",
            minutes=wanted.minutes,
            size=wanted.size or ("640" if small else "1280"),
            seed=command.SAMPLE_SEED if wanted.seed is None else wanted.seed,
        )
    else:
        _make(wanted.jobs)
        for seed in range(1, DRAWN_LOGS + 1):
            _make(wanted.jobs, size="1280", minutes=DRAWN_MINUTES, seed=seed)


def _make(jobs: int, **what) -> None:
    begun = time.monotonic()
    since: list[float] = []  # of each log the first frame

    def progress(done: int, of: int) -> None:
        if done == 1:
            since.append(time.monotonic())
        if done == of or (done % 10 == 0 and sys.stderr.isatty()):
            rate = (done - 1) / max(time.monotonic() - since[-1], 1e-9)
            end = "\n" if done == of else "\r"
            sys.stderr.write(f"log {len(since)}: frames {done}/{of}, {rate:.1f} per second   {end}")
            sys.stderr.flush()

    path = command.make(jobs=jobs, progress=progress, **what)
    size = sum(p.stat().st_size for p in (path.rglob("*") if path.is_dir() else [path])) / 1e6
    sys.stdout.write(f"{path}: {size:.1f} MB in {time.monotonic() - begun:.0f} s\n")


if __name__ == "__main__":
    try:
        main()
    except PipelineError as error:
        sys.stderr.write(f"gradetrace: {error}\n")
        sys.exit(error.exit_code)
